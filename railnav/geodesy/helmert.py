"""Helmert transformations between geocentric frames, with one sign of rotation: the coordinate frame's.

X' = T + (1 + s) R X with R = [[1, rz, -ry], [-rz, 1, rx], [ry, -rx, 1]] ("coordinate frame rotation", EPSG 1032, GOST 32453;
the "position vector" convention of the IERS, EPSG 1033 and PROJ's +towgs84 turns the other way round). The small-angle matrix
is the definition, as in the registries: for 20 arc seconds it differs from a rotation by 0.01 ppm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import CrsError

FloatArray = NDArray[np.float64]

#: Radians in an arc second.
ARC_SECOND = math.pi / 648000.0
#: Largest angle that the small-angle matrix is used for, rad (3.4 arc minutes: 0.5 ppm of distortion).
LARGEST_ANGLE = 1e-3

Convention = Literal["coordinate_frame", "position_vector"]


@dataclass(frozen=True, slots=True)
class Helmert:
    """Seven parameters, and their seven rates where the frames move against each other.

    Attributes
    ----------
    parameters : tuple of 7 float
        tx, ty, tz (m), rx, ry, rz (rad, coordinate frame), s (scale minus 1).
    rates : tuple of 7 float
        The same a year; zeros where the transformation is fixed.
    epoch : float
        Decimal year that the parameters are of; without meaning when all rates are 0.

    Examples
    --------
    >>> shift = Helmert.of((23.57, -140.95, -79.8), (0.0, -0.35, -0.79), -0.22, convention="coordinate_frame")
    >>> x = shift.apply(np.array([[2850680.9358, 2195319.8573, 5249043.0734]]))
    >>> np.round(x, 3).tolist()
    [[2850704.377, 2195189.343, 5248957.281]]
    """

    parameters: tuple[float, ...]
    rates: tuple[float, ...] = (0.0,) * 7
    epoch: float = 0.0

    def __post_init__(self) -> None:
        if len(self.parameters) != 7 or len(self.rates) != 7 or not np.isfinite([*self.parameters, *self.rates]).all():
            raise CrsError("a Helmert transformation has seven finite parameters, and seven rates or none")
        if max(abs(angle) for angle in self.parameters[3:6]) > LARGEST_ANGLE:
            angle = max(self.parameters[3:6], key=abs) / ARC_SECOND
            raise CrsError(f"a rotation of {angle:.0f} arc seconds joins no two datums; look at units and axes")

    @classmethod
    def of(
        cls,
        translation: ArrayLike,
        rotation_arcsec: ArrayLike = (0.0, 0.0, 0.0),
        scale_ppm: float = 0.0,
        *,
        convention: Convention,
        translation_rate: ArrayLike = (0.0, 0.0, 0.0),
        rotation_rate_arcsec: ArrayLike = (0.0, 0.0, 0.0),
        scale_rate_ppm: float = 0.0,
        epoch: float = 0.0,
    ) -> Self:
        """Seven or fourteen parameters in the units of registries; the convention of the angles must be said.

        Parameters
        ----------
        translation, translation_rate : (3,) array
            m, m a year.
        rotation_arcsec, rotation_rate_arcsec : (3,) array
            Arc seconds, arc seconds a year.
        scale_ppm, scale_rate_ppm : float
            Parts per million, and a year.
        convention : {"coordinate_frame", "position_vector"}
            Sign of the angles. The wrong one moves points in Russia by 11 to 26 m.
        epoch : float
            Decimal year of the parameters, where there are rates.

        Returns
        -------
        Helmert

        Raises
        ------
        CrsError
            Another convention, a number that is not finite, or an angle beyond 3.4 arc minutes.
        """
        if convention not in ("coordinate_frame", "position_vector"):
            raise CrsError(f"rotations are coordinate_frame or position_vector, not {convention!r}")
        sign = 1.0 if convention == "coordinate_frame" else -1.0

        def seven(shift: ArrayLike, angles: ArrayLike, scale: float) -> tuple[float, ...]:
            turned = sign * ARC_SECOND * np.asarray(angles, np.float64)
            return (*map(float, np.asarray(shift, np.float64)), *map(float, turned), float(scale) * 1e-6)

        return cls(
            seven(translation, rotation_arcsec, scale_ppm),
            seven(translation_rate, rotation_rate_arcsec, scale_rate_ppm),
            float(epoch),
        )

    @property
    def moves(self) -> bool:
        """Whether the parameters change with time."""
        return any(self.rates)

    def at(self, epoch: float) -> Helmert:
        """The transformation at an epoch (decimal year), without rates."""
        dt = epoch - self.epoch if self.moves else 0.0
        return Helmert(tuple(p + dt * r for p, r in zip(self.parameters, self.rates, strict=True)))

    @property
    def matrix(self) -> FloatArray:
        """(1 + s) R, (3, 3)."""
        rx, ry, rz, s = self.parameters[3:]
        return (1.0 + s) * np.array([[1.0, rz, -ry], [-rz, 1.0, rx], [ry, -rx, 1.0]])

    def apply(self, position_e: ArrayLike) -> FloatArray:
        """Positions in the target frame.

        Parameters
        ----------
        position_e : (n, 3) or (3,) array
            Geocentric, source frame, m.

        Returns
        -------
        array of the same shape
            Geocentric, target frame, m.
        """
        return np.asarray(np.asarray(position_e, np.float64) @ self.matrix.T + self.parameters[:3])

    def apply_inverse(self, position_e: ArrayLike) -> FloatArray:
        """Positions in the source frame, exactly: the matrix is solved, its angles are not just turned round."""
        moved = np.asarray(position_e, np.float64) - self.parameters[:3]
        return np.asarray(np.linalg.solve(self.matrix, moved.reshape(-1, 3).T).T.reshape(moved.shape))

    def step(self, *, inverse: bool = False) -> str:
        """The transformation as a step of a PROJ pipeline.

        Examples
        --------
        >>> Helmert.of((24.47, -130.89, -81.56), (0, 0, -0.13), -0.22, convention="coordinate_frame").step()
        'step proj=helmert x=24.47 y=-130.89 z=-81.56 rx=0 ry=0 rz=-0.13 s=-0.22 convention=coordinate_frame'
        """
        if self.moves:
            raise CrsError("a transformation that moves has no step of its own; ask for it at an epoch")
        tx, ty, tz, rx, ry, rz, s = self.parameters
        words = [f"x={_text(tx)}", f"y={_text(ty)}", f"z={_text(tz)}"]
        if any((rx, ry, rz, s)):
            words += [
                f"{name}={_text(angle / ARC_SECOND)}"
                for name, angle in zip(("rx", "ry", "rz"), (rx, ry, rz), strict=True)
            ]
            words += [f"s={_text(s * 1e6)}", "convention=coordinate_frame"]
        return f"step {'inv ' if inverse else ''}proj=helmert {' '.join(words)}"


def _text(value: float) -> str:
    """A number to 15 digits: what a registry wrote as 0.35 is 0.35 again."""
    return f"{value + 0.0:.15g}"
