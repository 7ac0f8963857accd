"""What can go wrong, named by the problem.

Every error that railnav raises on purpose descends from `RailnavError`; the command line turns it into one line and exit
code 1. A message says where (file, row, column), what is the matter and what would work.
"""

from __future__ import annotations

from pathlib import Path


class RailnavError(Exception):
    """Root of every error that railnav raises on purpose."""


class InputError(RailnavError):
    """A file cannot be used as it is.

    Parameters
    ----------
    cause : str
        What is wrong, with the offending value.
    file : path, optional
        The file at fault.
    row : int, optional
        Row as an editor counts it: the header of a table is row 1.
    column : str, optional
        Column, key or layer at fault.
    remedy : str, optional
        What would work.

    Examples
    --------
    >>> str(InputError("time runs backwards", file="gnss.csv", row=7, column="time_s", remedy="sort the rows"))
    'gnss.csv, row 7, column time_s: time runs backwards; sort the rows'
    """

    def __init__(
        self,
        cause: str,
        *,
        file: str | Path | None = None,
        row: int | None = None,
        column: str | None = None,
        remedy: str | None = None,
    ) -> None:
        self.cause, self.file, self.row, self.column, self.remedy = cause, file, row, column, remedy
        where = [str(file)] if file is not None else []
        if row is not None:
            where.append(f"row {row}")
        if column is not None:
            where.append(f"column {column}")
        text = f"{', '.join(where)}: {cause}" if where else cause
        super().__init__(f"{text}; {remedy}" if remedy else text)


class RunError(InputError):
    """A survey or service run is missing, malformed or empty."""


class ModelError(InputError):
    """A reference track model is missing, malformed, of a newer schema, or not a railnav model at all."""


class CrsError(RailnavError):
    """No coordinate system, or no usable transformation to one."""


class TrackError(RailnavError):
    """A track, node or offset that the model does not have, or a movement that it does not permit."""


class OffModelError(RailnavError):
    """A run that never touches the model."""


class EstimationError(RailnavError):
    """A least-squares problem without a unique solution, or a covariance that is none."""
