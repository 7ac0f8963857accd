"""A solution: one row an output epoch, with where the train is and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import geopandas

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


class Mode(IntEnum):
    """What the navigator is doing; the names are those of the `mode` column."""

    INITIALISING = 0
    TRACKING = 1
    COASTING = 2
    AMBIGUOUS = 3
    OFF_MODEL = 4
    LOST = 5

    @property
    def label(self) -> str:
        """The word in the `mode` column, e.g. "off-model"."""
        return self.name.lower().replace("_", "-")


@dataclass(frozen=True, slots=True, eq=False)
class Alternatives:
    """Candidates of the rows whose track is not certain: (k,) arrays, by row, most probable first; the row's own track is among them.

    Attributes
    ----------
    row : (k,) int array
        Row of the solution.
    track : (k,) int array
        Index into the solution's `track_id`.
    offset : (k,) array
        m.
    probability : (k,) array
        Posterior; those of a row sum to at most 1 (what is missing lies on tracks below 1e-4, or outside the model).
    running_direction : (k,) int array
        +1 when the nose points to growing offset, -1 otherwise.
    """

    row: IntArray
    track: IntArray
    offset: FloatArray
    probability: FloatArray
    running_direction: IntArray

    @classmethod
    def none(cls) -> Alternatives:
        """No candidates: every row is certain, or nothing was kept."""
        whole, real = np.empty(0, np.int64), np.empty(0)
        return cls(whole, whole, real, real, whole)

    def __len__(self) -> int:
        return len(self.row)


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Frozen table of a navigated run; (m,) arrays, SI and radians, one row an epoch.

    Rows without a position (mode LOST, OFF_MODEL, or INITIALISING before any candidate) carry track -1 and NaN.

    Attributes
    ----------
    track_id, line : tuple of str
        The model's tracks and their lines; `track` indexes both.
    time : (m,) array
        Seconds since the run's start.
    track : (m,) int array
        Index into `track_id`, or -1.
    offset, chainage : (m,) array
        True offset on the track and published chainage, m.
    easting, northing, height : (m,) array
        Grid position of the reference point on the track axis, m.
    latitude, longitude : (m,) array
        WGS 84, rad.
    ellipsoidal_height : (m,) array
        WGS 84 ellipsoidal height, m (the `height_m` column).
    heading : (m,) array
        Where the vehicle's nose points, from true north, rad.
    speed, acceleration : (m,) array
        Along the nose, m/s and m/s^2: negative when backing up.
    sigma_along, sigma_cross : (m,) array
        Standard deviations, m: along from the filter, cross from the model's covariance.
    protection_level_along : (m,) array
        Bound on the along-track error at `integrity_risk`, m.
    track_probability : (m,) array
        Posterior probability of `track`.
    mode : (m,) int array
        `Mode` values.
    running_direction : (m,) int array
        +1 when the nose points to growing offset, -1 otherwise, 0 when unknown.
    run_id : str
    start : str
        UTC of time 0, ISO 8601.
    crs_wkt : str
        The model's plane.
    integrity_risk : float
        The risk at which the protection level holds, per epoch.
    smoothed : bool
        Whether rows are fixed-interval smoothed rather than filtered.
    simulated : bool
        Whether the run was simulated.
    diagnostics : dict
        Counts and settings: epochs, fixes used and rejected, decisions; JSON values only.
    alternatives : Alternatives
        All candidates of the rows whose track is not certain.
    """

    track_id: tuple[str, ...]
    line: tuple[str, ...]
    time: FloatArray
    track: IntArray
    offset: FloatArray
    chainage: FloatArray
    easting: FloatArray
    northing: FloatArray
    height: FloatArray
    latitude: FloatArray
    longitude: FloatArray
    ellipsoidal_height: FloatArray
    heading: FloatArray
    speed: FloatArray
    acceleration: FloatArray
    sigma_along: FloatArray
    sigma_cross: FloatArray
    protection_level_along: FloatArray
    track_probability: FloatArray
    mode: IntArray
    running_direction: IntArray
    run_id: str = ""
    start: str = ""
    crs_wkt: str = ""
    integrity_risk: float = 1e-4
    smoothed: bool = False
    simulated: bool = False
    diagnostics: dict[str, Any] = field(default_factory=dict)
    alternatives: Alternatives = field(default_factory=Alternatives.none)

    def __len__(self) -> int:
        return len(self.time)

    def to_geodataframe(self) -> geopandas.GeoDataFrame:
        """The rows as a GeoDataFrame of points in the model's plane (extra "frames"), columns as in a solution file."""
        from railnav.io.solution import solution_table  # a door upward, named in the import contract
        from railnav.track.tables import frame_of

        return frame_of(solution_table(self))

    def __arrow_c_stream__(self, requested_schema: object | None = None) -> object:
        """Arrow's PyCapsule protocol: `pyarrow.table(solution)`, `polars.from_arrow(solution)` and the like."""
        from railnav.io.solution import solution_table  # a door upward, named in the import contract

        return solution_table(self).__arrow_c_stream__(requested_schema)

    def to_file(self, path: str | Path) -> None:
        """Write .csv, .parquet, .gpkg or .geojson by the ending; see `railnav.io.solution.write_solution`."""
        from railnav.io.solution import write_solution  # a door upward, named in the import contract

        write_solution(self, path)
