"""What the verbs know of files: is an output path usable, and what kind of thing is an input."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterable, Sequence
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from railnav.errors import InputError, RailnavError
from railnav.io.store_address import is_store

if TYPE_CHECKING:
    from railnav.navigation.solution import Solution
    from railnav.track.model import TrackModel

MODEL_ENDINGS = (".gpkg", ".geojson", ".json")
#: What a model can be converted to.
EXPORT_ENDINGS = (*MODEL_ENDINGS, ".kml", ".xml", ".railml", ".csv", ".parquet")
SOLUTION_ENDINGS = (".csv", ".parquet", ".gpkg", ".geojson")
#: What a solution can be converted to besides.
DRAWN_ENDINGS = (".kml", ".mfjson")
PAGE_ENDINGS = (".html",)
PICTURE_ENDINGS = (".png", ".svg", ".pdf", ".html")

Kind = Literal["model", "solution", "run", "truth", "log"]


def check_output(path: Path, endings: Sequence[str], *, inputs: Iterable[Path] = ()) -> Path:
    """Refuse an output file that could not be written at the end, before the work begins.

    Parameters
    ----------
    path : Path
        Where the output shall go. A file that is there already is replaced.
    endings : sequence of str
        The endings that name a format.
    inputs : iterable of Path
        Files that the output must not replace.

    Returns
    -------
    Path
        The path, as given.

    Raises
    ------
    InputError
        If the ending is unknown, the folder is missing or closed, the path is a folder, or it is one of the inputs.

    Examples
    --------
    >>> check_output(Path("line.shp"), (".gpkg", ".geojson"))
    Traceback (most recent call last):
    railnav.errors.InputError: line.shp: an output of this ending is not known; use .gpkg or .geojson
    """
    if is_store(path) and ".gpkg" in endings:  # a shared store says itself what it cannot take
        return path
    if path.suffix.lower() not in endings:
        choice = " or ".join(filter(None, [", ".join(endings[:-1]), endings[-1]]))
        raise InputError("an output of this ending is not known", file=path, remedy=f"use {choice}")
    if path.is_dir():
        raise InputError("is a folder, not a file to write", file=path)
    _check_folder(path)
    for source in inputs:
        if _same(path, source):
            raise InputError("is also an input and would be overwritten", file=path, remedy="choose another output")
    return path


def check_output_folder(path: Path, *, mark: str | None = None) -> Path:
    """Refuse an output folder that holds something already, or whose parent is missing or closed.

    Parameters
    ----------
    path : Path
        Folder to make.
    mark : str, optional
        Name of a file that only this program writes there: a folder that holds it may be replaced.

    Raises
    ------
    InputError
        If the folder cannot be made, or would replace what is not ours.
    """
    if path.exists() and not path.is_dir():
        raise InputError("is a file, not a folder to write", file=path)
    _check_folder(path)
    if path.is_dir() and any(path.iterdir()) and not (mark and (path / mark).is_file()):
        raise InputError("the folder is not empty", file=path, remedy="choose a new folder, or remove this one first")
    return path


def _check_folder(path: Path) -> None:
    folder = path.absolute().parent
    if not folder.is_dir():
        raise InputError(f"there is no folder {folder}", file=path, remedy="make it first")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"the folder {folder} is not writable", file=path)


def _same(path: Path, source: Path) -> bool:
    if path.resolve() == source.resolve():
        return True
    return path.exists() and source.exists() and path.samefile(source)


def kind_of(path: Path) -> Kind:
    """Tell what a file or folder holds, from its name and its first bytes.

    Parameters
    ----------
    path : Path
        A run folder (with run.toml), a model (.gpkg, .geojson), a solution (.csv, .parquet, .gpkg, .geojson), a truth file (.csv,
        .parquet) or a receiver's log (see `railnav.io.logs`).

    Returns
    -------
    str
        "run", "model", "solution", "truth" or "log".

    Raises
    ------
    InputError
        If it is missing, or none of these.
    """
    if is_store(path):
        return "model"
    if not path.exists():
        raise InputError("no such file or folder", file=path)
    if path.is_dir():
        if not (path / "run.toml").is_file():
            if (path / "metadata.yaml").is_file():
                return "log"
            raise InputError("the folder holds no run.toml", file=path, remedy="name a run folder, or a file")
        return "run"
    if path.name == "run.toml":
        raise InputError("is the table of contents of a run", file=path, remedy=f"name its folder, {path.parent}")
    ending = path.suffix.lower()
    if ending == ".gpkg":
        return _kind_of_geopackage(path)
    if ending in (".geojson", ".json"):
        with path.open("rb") as file:
            head = file.read(65536)
        return (
            "solution"
            if b'"LineString"' not in head and (b'"Point"' in head or b'"sigma_along_m"' in head)
            else "model"
        )
    if ending in (".csv", ".parquet"):
        names = columns(path)
        if {"track", "offset_m", "heading_deg"} <= names and "mode" not in names:
            return "truth"
        return "solution"
    from railnav.io.logs import log_format

    if log_format(path) is not None:
        return "log"
    raise InputError(
        "neither a model (.gpkg, .geojson), a solution (.csv, .parquet, .gpkg, .geojson) nor a run folder", file=path
    )


def columns(path: Path) -> set[str]:
    """Names in the header of a table, .csv or .parquet."""
    from railnav.io.tables import header_of

    return header_of(path)


def _kind_of_geopackage(path: Path) -> Kind:
    """Tell a solution's GeoPackage from a model's by what it says it holds; foreign files are left to the model's reader."""
    from railnav.io.container import META

    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as connection:
            row = connection.execute(f"SELECT value FROM {META} WHERE key = 'content'").fetchone()  # noqa: S608 - a constant
    except sqlite3.Error:
        return "model"
    return "solution" if row and "solution" in str(row[0]) else "model"


def read_model(path: Path) -> TrackModel:
    """Read a model, .gpkg or .geojson, or of a store."""
    if path.suffix.lower() in (".geojson", ".json") and not is_store(path):
        from railnav.io.geojson import read_geojson

        return read_geojson(path)
    from railnav.io.geopackage import read_model as read_geopackage

    return read_geopackage(path)


def read_solution(path: Path) -> Solution:
    """Read a solution by its ending."""
    from railnav.io.solution import read_solution as read

    return read(path)


def write_model(model: TrackModel, path: Path) -> None:
    """Write a model by its ending: a store, or what other programs read."""
    ending = "" if is_store(path) else path.suffix.lower()
    if ending in (".geojson", ".json"):
        from railnav.io.geojson import write_geojson

        write_geojson(model, path)
        return
    if ending == ".kml":
        from railnav.io.kml import write_model_kml

        write_model_kml(model, path)
        return
    if ending == ".xml":
        from railnav.io.landxml_writer import write_landxml

        write_landxml(model, path)
        return
    if ending == ".railml":
        from railnav.io.railml_writer import write_railml

        write_railml(model, path)
        return
    if ending in (".csv", ".parquet"):
        from railnav.io.elements_writer import write_elements

        write_elements(model, path)
        return
    from railnav.io.geopackage import write_model as write_geopackage

    write_geopackage(model, path)


def write_solution(solution: Solution, path: Path) -> None:
    """Write a solution by its ending."""
    if path.suffix.lower() == ".kml":
        from railnav.io.kml import write_solution_kml

        write_solution_kml(solution, path)
    elif path.suffix.lower() == ".mfjson":
        from railnav.io.moving_features import write_moving_features

        write_moving_features(solution, path)
    else:
        solution.to_file(path)


def write_text(path: Path, text: str) -> None:
    """Write a page, whole or not at all."""
    from railnav.io.atomic import atomic_path

    with atomic_path(path) as draft:
        draft.write_text(text, encoding="utf-8")


def members(run: Path) -> list[Path]:
    """List the files of a run folder, which no output may replace; empty where there is no such folder."""
    return sorted(run.iterdir()) if run.is_dir() else []


def need_report() -> None:
    """Refuse to begin what needs the extra "report" when it is not installed.

    Raises
    ------
    RailnavError
        If plotly or matplotlib is not there.
    """
    missing = [name for name in ("matplotlib", "plotly") if find_spec(name) is None]
    if missing:
        raise RailnavError(
            f'pages and pictures need {" and ".join(missing)}; install with: pip install "railnav[report]"'
        )
