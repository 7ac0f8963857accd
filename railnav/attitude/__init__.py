"""Orientation of one frame against another: matrices, quaternions, rotation vectors, Euler angles, and their update.

A direction cosine matrix reads `v_n = C_nb @ v_b`; the quaternion of the same name, scalar first, does the same by
v_n = q v_b q*. Euler angles are roll, pitch, heading of body axes (forward, right, down) in north, east, down:
C_nb = Rz(heading) Ry(pitch) Rx(roll); roll positive right side down, pitch nose up, heading clockwise from true north.
Everything takes leading batch axes and returns new arrays.
"""

from __future__ import annotations

from railnav.attitude.conversions import (
    dcm_from_euler,
    dcm_from_quaternion,
    dcm_from_rotation_vector,
    euler_from_dcm,
    euler_from_quaternion,
    euler_rates,
    orthonormalise,
    quaternion_from_dcm,
    quaternion_from_euler,
    quaternion_from_rotation_vector,
    quaternion_multiply,
    rotation_vector_from_dcm,
    rotation_vector_from_quaternion,
    skew,
)
from railnav.attitude.orientation import (
    UpdateCoefficients,
    propagate,
    rotation_vector_from_increments,
    rotation_vector_from_rates,
    update_coefficients,
)

__all__ = [
    "UpdateCoefficients",
    "dcm_from_euler",
    "dcm_from_quaternion",
    "dcm_from_rotation_vector",
    "euler_from_dcm",
    "euler_from_quaternion",
    "euler_rates",
    "orthonormalise",
    "propagate",
    "quaternion_from_dcm",
    "quaternion_from_euler",
    "quaternion_from_rotation_vector",
    "quaternion_multiply",
    "rotation_vector_from_dcm",
    "rotation_vector_from_increments",
    "rotation_vector_from_quaternion",
    "rotation_vector_from_rates",
    "skew",
    "update_coefficients",
]
