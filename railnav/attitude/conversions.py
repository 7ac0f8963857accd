"""Conversions between the descriptions of a rotation, exact for every angle, with the singular cases stated.

Each function takes any number of leading batch axes. A matrix or quaternion that is not a rotation is refused, not repaired:
`orthonormalise` repairs.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

#: A matrix or quaternion may miss orthonormality or unit length by this much and still count as a rotation.
ORTHONORMAL_TOLERANCE = 1e-6
#: Cosine of the pitch below which heading and roll cannot be told apart (0.02 arc seconds from the vertical).
GIMBAL_COSINE = 1e-7


def skew(vector: ArrayLike) -> FloatArray:
    """Matrix of a cross product: skew(a) @ b = a x b.

    Parameters
    ----------
    vector : (..., 3) array
        Any unit.

    Returns
    -------
    (..., 3, 3) array

    Raises
    ------
    ValueError
        Wrong shape, or a value that is not finite.

    Examples
    --------
    >>> skew([1.0, 2.0, 3.0]) @ np.array([0.0, 0.0, 1.0])
    array([ 2., -1.,  0.])
    """
    v = _checked("vector", vector, 3)
    x, y, z = np.moveaxis(v, -1, 0)
    zero = np.zeros_like(x)
    return _matrix([[zero, -z, y], [z, zero, -x], [-y, x, zero]])


def dcm_from_rotation_vector(rotation_vector: ArrayLike) -> FloatArray:
    """Matrix of a turn by |phi| about phi (Rodrigues): I + sin(p)/p [phi x] + (1 - cos p)/p^2 [phi x]^2, p = |phi|.

    Parameters
    ----------
    rotation_vector : (..., 3) array
        phi, rad, of any length.

    Returns
    -------
    (..., 3, 3) array
        C with v_old = C v_new, as in C_nb(k+1) = C_nb(k) C(phi).

    Raises
    ------
    ValueError
        Wrong shape, or a value that is not finite.

    Notes
    -----
    Both factors go through sinc: no division by zero, and small angles lose no digit.

    References
    ----------
    `spec/inertial.md` A9; Shuster, M. D.: A survey of attitude representations. J. Astronautical Sciences 41 (4), 1993, eq. 117.

    Examples
    --------
    >>> dcm_from_rotation_vector([0.0, 0.0, np.pi / 2]).round(12) @ np.array([1.0, 0.0, 0.0])
    array([0., 1., 0.])
    """
    v = _checked("rotation_vector", rotation_vector, 3)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    cross = skew(v)
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    return np.asarray(np.eye(3) + first * cross + second * (cross @ cross))


def rotation_vector_from_dcm(dcm: ArrayLike) -> FloatArray:
    """Rotation vector of a matrix, of length at most pi.

    Parameters
    ----------
    dcm : (..., 3, 3) array
        A rotation.

    Returns
    -------
    (..., 3) array
        rad. At exactly half a turn both signs are right; the one whose first component different from zero is positive is given.

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite, or not a rotation.

    Examples
    --------
    >>> rotation_vector_from_dcm(np.diag([-1.0, 1.0, -1.0])).round(6)
    array([0.      , 3.141593, 0.      ])
    """
    return rotation_vector_from_quaternion(quaternion_from_dcm(dcm))


def quaternion_from_rotation_vector(rotation_vector: ArrayLike) -> FloatArray:
    """Quaternion (cos p/2, sin(p/2) phi/p) of a rotation vector, p = |phi|.

    Parameters
    ----------
    rotation_vector : (..., 3) array
        rad.

    Returns
    -------
    (..., 4) array
        Scalar first; the scalar is negative where the turn exceeds pi (and keeps the sign of a full turn).

    Raises
    ------
    ValueError
        Wrong shape, or a value that is not finite.

    Examples
    --------
    >>> quaternion_from_rotation_vector([0.0, 0.0, np.pi / 2]).round(6)
    array([0.707107, 0.      , 0.      , 0.707107])
    """
    v = _checked("rotation_vector", rotation_vector, 3)
    half = 0.5 * np.linalg.norm(v, axis=-1)[..., None]
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * v], axis=-1)


def rotation_vector_from_quaternion(quaternion: ArrayLike) -> FloatArray:
    """Rotation vector of a unit quaternion, of length at most pi (the short way round).

    Parameters
    ----------
    quaternion : (..., 4) array
        Scalar first, unit length.

    Returns
    -------
    (..., 3) array
        rad.

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite, or not of unit length.

    Notes
    -----
    2 atan2(|v|, q0)/|v| keeps every digit at small angles and near half a turn, where arccos(q0) loses half of them.

    Examples
    --------
    >>> rotation_vector_from_quaternion([-1.0, 0.0, 0.0, 0.0])
    array([0., 0., 0.])
    """
    q = _short_way(_unit(quaternion))
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., :1])
    factor = np.where(sine > 0.0, angle / np.where(sine > 0.0, sine, 1.0), 2.0)
    return np.asarray(factor * q[..., 1:])


def dcm_from_quaternion(quaternion: ArrayLike) -> FloatArray:
    """Matrix C of a unit quaternion, C v = q v q*.

    Parameters
    ----------
    quaternion : (..., 4) array
        Scalar first, unit length; q and -q give the same matrix.

    Returns
    -------
    (..., 3, 3) array

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite, or not of unit length.

    Examples
    --------
    >>> dcm_from_quaternion([0.0, 1.0, 0.0, 0.0]).diagonal()
    array([ 1., -1., -1.])
    """
    w, x, y, z = np.moveaxis(_unit(quaternion), -1, 0)
    return _matrix(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def quaternion_from_dcm(dcm: ArrayLike) -> FloatArray:
    """Unit quaternion of a matrix, scalar not negative (Shepperd: the largest component is found first).

    Parameters
    ----------
    dcm : (..., 3, 3) array
        A rotation.

    Returns
    -------
    (..., 4) array
        Scalar first. At half a turn, where the scalar is zero, the first vector component different from zero is positive.

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite, or not a rotation.

    References
    ----------
    Shepperd, S. W.: Quaternion from rotation matrix. J. Guidance and Control 1 (3), 1978.

    Examples
    --------
    >>> quaternion_from_dcm(np.eye(3))
    array([1., 0., 0., 0.])
    """
    C = _rotation(dcm)
    d = np.diagonal(C, axis1=-2, axis2=-1)
    trace = d.sum(axis=-1)
    a, b, c = C[..., 2, 1] - C[..., 1, 2], C[..., 0, 2] - C[..., 2, 0], C[..., 1, 0] - C[..., 0, 1]
    e, f, g = C[..., 0, 1] + C[..., 1, 0], C[..., 0, 2] + C[..., 2, 0], C[..., 1, 2] + C[..., 2, 1]
    rows = np.stack(  # 4 q_k q for the four choices of the largest component k
        [
            np.stack([1.0 + trace, a, b, c], axis=-1),
            np.stack([a, 1.0 + 2.0 * d[..., 0] - trace, e, f], axis=-1),
            np.stack([b, e, 1.0 + 2.0 * d[..., 1] - trace, g], axis=-1),
            np.stack([c, f, g, 1.0 + 2.0 * d[..., 2] - trace], axis=-1),
        ],
        axis=-2,
    )
    largest = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    row = np.take_along_axis(rows, largest[..., None, None], axis=-2)[..., 0, :]
    return _short_way(row / np.linalg.norm(row, axis=-1, keepdims=True))


def dcm_from_euler(roll: ArrayLike, pitch: ArrayLike, heading: ArrayLike) -> FloatArray:
    """C_nb of roll, pitch and heading: Rz(heading) Ry(pitch) Rx(roll).

    Parameters
    ----------
    roll, pitch, heading : float or (...) array
        rad: right side down, nose up, clockwise from north.

    Returns
    -------
    (..., 3, 3) array
        v_n = C_nb v_b, body forward-right-down into north-east-down.

    Raises
    ------
    ValueError
        A value that is not finite.

    References
    ----------
    `spec/inertial.md` B1, KZ(A.4).

    Examples
    --------
    >>> dcm_from_euler(0.0, 0.0, np.pi / 2).round(12) @ np.array([1.0, 0.0, 0.0])
    array([0., 1., 0.])
    """
    r, p, h = np.broadcast_arrays(*(_finite(n, v) for n, v in (("roll", roll), ("pitch", pitch), ("heading", heading))))
    sr, cr, sp, cp, sh, ch = np.sin(r), np.cos(r), np.sin(p), np.cos(p), np.sin(h), np.cos(h)
    return _matrix(
        [
            [cp * ch, sr * sp * ch - cr * sh, cr * sp * ch + sr * sh],
            [cp * sh, sr * sp * sh + cr * ch, cr * sp * sh - sr * ch],
            [-sp, sr * cp, cr * cp],
        ]
    )


def euler_from_dcm(dcm: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Roll, pitch, heading of C_nb.

    Parameters
    ----------
    dcm : (..., 3, 3) array
        C_nb, a rotation.

    Returns
    -------
    roll, pitch, heading : (...) array
        rad, roll and heading in (-pi, pi], pitch in [-pi/2, pi/2].

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite, or not a rotation.

    Notes
    -----
    Singular where the nose points straight up or down: only heading - roll (up) or heading + roll (down) is defined there. Within
    1e-7 rad of it roll is 0 by convention and heading takes all; the matrix of the returned angles is still the one given. Pitch
    comes from atan2, not arcsin: nothing is clipped and nothing is lost near the vertical.

    References
    ----------
    `spec/inertial.md` B1, KZ(A.5).

    Examples
    --------
    >>> [round(float(v), 6) for v in euler_from_dcm(dcm_from_euler(0.1, 0.2, 0.3))]
    [0.1, 0.2, 0.3]
    """
    return _euler(_rotation(dcm))


def quaternion_from_euler(roll: ArrayLike, pitch: ArrayLike, heading: ArrayLike) -> FloatArray:
    """Quaternion q_nb of roll, pitch and heading, scalar not negative.

    Parameters
    ----------
    roll, pitch, heading : float or (...) array
        rad: right side down, nose up, clockwise from north.

    Returns
    -------
    (..., 4) array
        Scalar first.

    Raises
    ------
    ValueError
        A value that is not finite.

    Examples
    --------
    >>> quaternion_from_euler(0.0, 0.0, np.pi / 2).round(6)
    array([0.707107, 0.      , 0.      , 0.707107])
    """
    r, p, h = np.broadcast_arrays(*(_finite(n, v) for n, v in (("roll", roll), ("pitch", pitch), ("heading", heading))))
    sr, cr, sp, cp, sh, ch = (f(0.5 * v) for v in (r, p, h) for f in (np.sin, np.cos))
    return _short_way(
        np.stack(
            [
                cr * cp * ch + sr * sp * sh,
                sr * cp * ch - cr * sp * sh,
                cr * sp * ch + sr * cp * sh,
                cr * cp * sh - sr * sp * ch,
            ],
            axis=-1,
        )
    )


def euler_from_quaternion(quaternion: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Roll, pitch, heading of q_nb; the singular case as in `euler_from_dcm`.

    Parameters
    ----------
    quaternion : (..., 4) array
        q_nb, scalar first, unit length.

    Returns
    -------
    roll, pitch, heading : (...) array
        rad.

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite, or not of unit length.

    Examples
    --------
    >>> [round(float(v), 6) for v in euler_from_quaternion(quaternion_from_euler(0.1, -0.2, 3.0))]
    [0.1, -0.2, 3.0]
    """
    return _euler(dcm_from_quaternion(quaternion))


def euler_rates(roll: ArrayLike, pitch: ArrayLike, rate_nb_b: ArrayLike) -> FloatArray:
    """Rates of roll, pitch and heading of a body that turns at w_nb_b.

    Parameters
    ----------
    roll, pitch : float or (...) array
        rad.
    rate_nb_b : (..., 3) array
        Rate of the body against the local frame, in body axes, rad/s.

    Returns
    -------
    (..., 3) array
        d(roll, pitch, heading)/dt, rad/s.

    Raises
    ------
    ValueError
        Pitch within 1e-7 rad of the vertical, where the rates are infinite; wrong shapes; values that are not finite.

    References
    ----------
    `spec/inertial.md` B3, KZ(1.30).

    Examples
    --------
    >>> euler_rates(0.0, 0.0, [0.1, 0.2, 0.3])
    array([0.1, 0.2, 0.3])
    """
    r, p = np.broadcast_arrays(_finite("roll", roll), _finite("pitch", pitch))
    w = _checked("rate_nb_b", rate_nb_b, 3)
    cp = np.cos(p)
    if np.any(np.abs(cp) < GIMBAL_COSINE):
        raise ValueError(
            "pitch is a right angle: Euler rates are infinite there; update a quaternion or matrix instead"
        )
    turning = np.sin(r) * w[..., 1] + np.cos(r) * w[..., 2]
    return np.stack(
        [w[..., 0] + np.tan(p) * turning, np.cos(r) * w[..., 1] - np.sin(r) * w[..., 2], turning / cp], axis=-1
    )


def quaternion_multiply(left: ArrayLike, right: ArrayLike) -> FloatArray:
    """Hamilton product, q_ac = q_ab q_bc: the matrix of the product is the product of the matrices.

    Parameters
    ----------
    left, right : (..., 4) array
        Scalar first.

    Returns
    -------
    (..., 4) array

    Raises
    ------
    ValueError
        Wrong shape, or a value that is not finite.

    Examples
    --------
    >>> quaternion_multiply([0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0])
    array([0., 0., 0., 1.])
    """
    a, b = np.broadcast_arrays(_checked("left", left, 4), _checked("right", right, 4))
    scalar = a[..., :1] * b[..., :1] - np.sum(a[..., 1:] * b[..., 1:], axis=-1, keepdims=True)
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + np.cross(a[..., 1:], b[..., 1:])
    return np.concatenate([scalar, vector], axis=-1)


def orthonormalise(dcm: ArrayLike) -> FloatArray:
    """Rotation nearest to a matrix (least squares over its elements, by singular values).

    Parameters
    ----------
    dcm : (..., 3, 3) array
        A matrix that has drifted from orthonormality.

    Returns
    -------
    (..., 3, 3) array
        U V^T of dcm = U S V^T.

    Raises
    ------
    ValueError
        Wrong shape, a value that is not finite, or a determinant that is not positive: no rotation is meant.

    Examples
    --------
    >>> orthonormalise(1.001 * np.eye(3)).diagonal()
    array([1., 1., 1.])
    """
    C = _finite("dcm", dcm)
    if C.ndim < 2 or C.shape[-2:] != (3, 3):
        raise ValueError(f"dcm must have the shape (..., 3, 3), not {C.shape}")
    determinant = np.linalg.det(C)
    if np.any(determinant <= 0.0):
        raise ValueError(
            f"no rotation is near a matrix with determinant {np.min(determinant):.3g}; check the axis order"
        )
    U, _, Vt = np.linalg.svd(C)
    return np.asarray(U @ Vt)


def _euler(C: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    level = np.hypot(C[..., 2, 1], C[..., 2, 2])  # cos(pitch)
    gimbal = level < GIMBAL_COSINE
    pitch = np.arctan2(-C[..., 2, 0], level)
    roll = np.where(gimbal, 0.0, np.arctan2(C[..., 2, 1], C[..., 2, 2]))
    heading = np.where(gimbal, np.arctan2(-C[..., 0, 1], C[..., 1, 1]), np.arctan2(C[..., 1, 0], C[..., 0, 0]))
    return roll[()], pitch[()], heading[()]


def _matrix(rows: list[list[FloatArray]]) -> FloatArray:
    """Stack three rows of three (...) arrays into (..., 3, 3)."""
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _short_way(q: FloatArray) -> FloatArray:
    """Sign of a quaternion so that its first component different from zero is positive."""
    first = np.argmax(q != 0.0, axis=-1)[..., None]
    sign = np.where(np.take_along_axis(q, first, axis=-1) < 0.0, -1.0, 1.0)
    return np.asarray(q * sign + 0.0)  # no negative zeros


def _finite(name: str, value: ArrayLike) -> FloatArray:
    array = np.asarray(value, dtype=np.float64)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} holds a value that is not finite")
    return array


def _checked(name: str, value: ArrayLike, size: int) -> FloatArray:
    array = _finite(name, value)
    if array.ndim < 1 or array.shape[-1] != size:
        raise ValueError(f"{name} must have the shape (..., {size}), not {array.shape}")
    return array


def _unit(quaternion: ArrayLike) -> FloatArray:
    q = _checked("quaternion", quaternion, 4)
    norm = np.linalg.norm(q, axis=-1, keepdims=True)
    worst = float(np.max(np.abs(norm - 1.0), initial=0.0))
    if worst > ORTHONORMAL_TOLERANCE:
        raise ValueError(
            f"quaternion has not unit length (off by {worst:.2g}); divide it by its norm if it is meant as a rotation"
        )
    return np.asarray(q / norm)


def _rotation(dcm: ArrayLike) -> FloatArray:
    C = _finite("dcm", dcm)
    if C.ndim < 2 or C.shape[-2:] != (3, 3):
        raise ValueError(f"dcm must have the shape (..., 3, 3), not {C.shape}")
    worst = float(np.max(np.abs(C @ np.swapaxes(C, -1, -2) - np.eye(3)), initial=0.0))
    if worst > ORTHONORMAL_TOLERANCE:
        raise ValueError(
            f"dcm is not orthonormal (off by {worst:.2g}); orthonormalise() finds the rotation nearest to it"
        )
    if np.any(np.linalg.det(C) < 0.0):
        raise ValueError("dcm is a reflection (determinant -1); check the axis order and signs")
    return C
