"""Tables of pseudoranges for tight coupling: one row a satellite and instant, satellites in Earth-fixed coordinates."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from railnav.errors import InputError
from railnav.inertial.aided import Ranges
from railnav.io.tables import Column, read_table, write_table

_COLUMNS = (
    Column("time_s"),
    *(Column(f"satellite_{axis}_m") for axis in "xyz"),
    *(Column(f"satellite_v{axis}_m_s") for axis in "xyz"),
    Column("pseudorange_m", positive=True),
    Column("range_rate_m_s"),
    Column("sigma_range_m", required=False, positive=True),
    Column("sigma_rate_m_s", required=False, positive=True),
)


def read_ranges(path: str | Path) -> Ranges:
    """Read pseudoranges and their rates from .csv or .parquet.

    Parameters
    ----------
    path : path
        Columns `time_s, satellite_x_m, satellite_y_m, satellite_z_m, satellite_vx_m_s, satellite_vy_m_s, satellite_vz_m_s,
        pseudorange_m, range_rate_m_s`, optional `sigma_range_m` (default 2 m), `sigma_rate_m_s` (0.05 m/s). Times count from the run's
        start; rows of one instant stand together. Ranges are corrected for the satellites' clocks and the atmosphere.

    Returns
    -------
    Ranges

    Raises
    ------
    InputError
        The file is missing or malformed, a column is missing, a value is not finite or out of range, time runs backwards.

    Examples
    --------
    >>> read_ranges("nowhere.csv")
    Traceback (most recent call last):
    railnav.errors.InputError: nowhere.csv: does not exist; check the name
    """
    table = read_table(path, _COLUMNS)
    number = table.number
    back = np.flatnonzero(np.diff(number["time_s"]) < 0.0)
    if back.size:
        raise InputError(
            "time runs backwards", file=path, row=int(back[0]) + 3, column="time_s", remedy="sort the rows by time"
        )
    position = np.stack([number[f"satellite_{axis}_m"] for axis in "xyz"], axis=1)
    far = np.linalg.norm(position, axis=1)
    if len(far) and far.min() < 7e6:
        raise InputError(
            f"a satellite {far.min() / 1000:.0f} km from the Earth's centre",
            file=path,
            row=int(np.argmin(far)) + 2,
            remedy="give Earth-centred, Earth-fixed coordinates in metres",
        )
    velocity = np.stack([number[f"satellite_v{axis}_m_s"] for axis in "xyz"], axis=1)
    return Ranges(
        number["time_s"],
        position,
        velocity,
        number["pseudorange_m"],
        number["range_rate_m_s"],
        number.get("sigma_range_m", np.asarray(2.0)),
        number.get("sigma_rate_m_s", np.asarray(0.05)),
    )


def write_ranges(ranges: Ranges, path: str | Path) -> None:
    """Write pseudoranges as `read_ranges` reads them, .csv or .parquet by the ending.

    Parameters
    ----------
    ranges : Ranges
    path : path

    Examples
    --------
    >>> callable(write_ranges)
    True
    """
    columns = {"time_s": ranges.time}
    columns |= {f"satellite_{axis}_m": ranges.satellite_position[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"satellite_v{axis}_m_s": ranges.satellite_velocity[:, i] for i, axis in enumerate("xyz")}
    columns |= {"pseudorange_m": ranges.pseudorange, "range_rate_m_s": ranges.range_rate}
    columns |= {"sigma_range_m": np.asarray(ranges.sigma_range), "sigma_rate_m_s": np.asarray(ranges.sigma_rate)}
    from railnav.io.atomic import atomic_path

    with atomic_path(Path(path)) as draft:
        write_table(draft, columns, decimals={name: 6 if name == "time_s" else 4 for name in columns})
