"""Truth files: where a train really was, from a simulation or a reference system."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from railnav.io.atomic import atomic_path
from railnav.io.tables import Column, FloatArray, Words, freeze, read_table, write_table
from railnav.truth import Truth

_COLUMNS = (
    Column("time_s"),
    Column("track", text=True),
    Column("offset_m"),
    Column("speed_m_s", complete=False),
    Column("latitude_deg", low=-90, high=90),
    Column("longitude_deg", low=-180, high=180),
    Column("height_m", complete=False),
    Column("heading_deg", complete=False),
)

_DECIMALS: Mapping[str, int] = {
    "time_s": 6,
    "offset_m": 5,
    "speed_m_s": 6,
    "latitude_deg": 10,
    "longitude_deg": 10,
    "height_m": 5,
    "heading_deg": 7,
}


def read_truth(path: str | Path) -> Truth:
    r"""Read a truth file, CSV or Parquet.

    Parameters
    ----------
    path : path
        Columns `time_s, track, offset_m, speed_m_s, latitude_deg, longitude_deg, height_m, heading_deg`, all required;
        speed, height and heading may have empty cells, which become NaN.

    Returns
    -------
    Truth
        SI and radians, arrays read-only. A CSV file cannot say whether it is simulated; `simulated` is then False.

    Raises
    ------
    InputError
        The file is missing or malformed, a column is missing, a value is empty, infinite or out of range, or time does
        not grow.

    Examples
    --------
    >>> import tempfile
    >>> header = "time_s,track,offset_m,speed_m_s,latitude_deg,longitude_deg,height_m,heading_deg"
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Path(folder, "truth.csv").write_text(f"{header}\n0.0,80R-01,60.0,0.0,49.978,9.027,180.1,38.0\n")
    ...     read_truth(f"{folder}/truth.csv").offset.tolist()
    [60.0]
    """
    table = read_table(path, _COLUMNS)
    track = table.words["track"]
    return Truth(
        track_id=track.word,
        time=table.increasing("time_s"),
        track=track.code,
        offset=table.number["offset_m"],
        speed=table.number["speed_m_s"],
        latitude=freeze(np.deg2rad(table.number["latitude_deg"])),
        longitude=freeze(np.deg2rad(table.number["longitude_deg"])),
        height=table.number["height_m"],
        heading=freeze(np.deg2rad(table.number["heading_deg"])),
        simulated=table.metadata.get("simulated") is True,
    )


def write_truth(truth: Truth, path: str | Path) -> None:
    """Write a truth file, CSV or Parquet by the ending, whole or not at all.

    Parameters
    ----------
    truth : Truth
        What to write.
    path : path
        File to write; replaced if it exists. CSV is rounded to 1e-6 s, 1e-10 degrees and 0.01 mm; Parquet keeps every bit.

    Raises
    ------
    InputError
        The file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> truth = Truth(("80R-01",), *(np.zeros(1, kind) for kind in (float, int, float, float, float, float, float, float)))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_truth(truth, f"{folder}/truth.parquet")
    ...     read_truth(f"{folder}/truth.parquet").track_id
    ('80R-01',)
    """
    columns: dict[str, FloatArray | Words] = {
        "time_s": truth.time,
        "track": Words(truth.track, truth.track_id),
        "offset_m": truth.offset,
        "speed_m_s": truth.speed,
        "latitude_deg": np.rad2deg(truth.latitude),
        "longitude_deg": np.rad2deg(truth.longitude),
        "height_m": truth.height,
        "heading_deg": np.rad2deg(truth.heading),
    }
    with atomic_path(path) as draft:
        write_table(draft, columns, decimals=_DECIMALS, metadata={"simulated": truth.simulated})
