"""KML 2.2 out: models, solutions and GNSS fixes for Google Earth and its like. Positions are WGS 84.

Lines lie on the ground: an altitude in KML counts from mean sea level, a height here from the ellipsoid, and an assumed geoid would be a
default in silence.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from railnav.errors import InputError
from railnav.io.atomic import atomic_path
from railnav.navigation.solution import Mode, Solution
from railnav.track.model import NodeKind, TrackModel

if TYPE_CHECKING:
    from railnav.run import Run

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Drawn lines keep within this distance of the knots, m.
DRAWING = 0.05
#: Colours as KML has them, alpha blue green red.
_MODE_COLOURS = {
    "initialising": "ffaaaaaa",
    "tracking": "ff44aa00",
    "coasting": "ff00aaff",
    "ambiguous": "ffcc00cc",
    "off-model": "ff0000ff",
    "lost": "ff000000",
}
_NODE_ICONS = {
    NodeKind.TURNOUT: "placemark_square",
    NodeKind.CROSSING: "cross-hairs",
    NodeKind.BUFFER_STOP: "forbidden",
}


def write_model_kml(model: TrackModel, path: str | Path) -> None:
    """Write a model's tracks and turnouts as KML, for the eye.

    Parameters
    ----------
    model : TrackModel
        What to draw.
    path : path
        File to write; replaced in one step if it exists.

    Notes
    -----
    Lines keep within 5 cm of the track. Heights, cant, covariance and movements are left out.

    Examples
    --------
    >>> import tempfile
    >>> from railnav import demo_line
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_model_kml(demo_line(), f"{folder}/line.kml")
    ...     Path(folder, "line.kml").read_text().count("<LineString>")
    36
    """
    with atomic_path(path) as draft, draft.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(line + "\n" for line in _model(model, Path(path).stem))


def write_solution_kml(solution: Solution, path: str | Path) -> None:
    """Write a solution as KML: a line for every stretch in one mode, and, where the start is known, a moving track.

    Parameters
    ----------
    solution : Solution
        What to draw.
    path : path
        File to write; replaced in one step if it exists.

    Raises
    ------
    InputError
        The solution has no row with a position.
    """
    placed = np.isfinite(solution.latitude) & np.isfinite(solution.longitude)
    if not placed.any():
        raise InputError("the solution has no row with a position", file=path)
    with atomic_path(path) as draft, draft.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(line + "\n" for line in _solution(solution, placed, Path(path).stem))


def write_run_kml(run: Run, path: str | Path) -> None:
    """Write the GNSS fixes of a run as a KML track in time.

    Raises
    ------
    InputError
        The run has no GNSS stream.
    """
    if run.gnss is None or not len(run.gnss):
        raise InputError("the run has no GNSS fixes to draw", file=path)
    fixes = run.gnss
    with atomic_path(path) as draft, draft.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(line + "\n" for line in _head(run.id))
        when = _instants(run.start, fixes.time)
        file.writelines(line + "\n" for line in _moving("fixes", when, fixes.latitude, fixes.longitude))
        file.write("</Document></kml>\n")


def _head(name: str) -> Iterator[str]:
    yield '<?xml version="1.0" encoding="UTF-8"?>'
    yield '<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2"><Document>'
    yield f"<name>{escape(name)}</name>"


def _coordinates(latitude: FloatArray, longitude: FloatArray) -> str:
    east, north = np.degrees(longitude).tolist(), np.degrees(latitude).tolist()
    return " ".join(f"{x:.8f},{y:.8f}" for x, y in zip(east, north, strict=True))


def _line(name: str, style: str, latitude: FloatArray, longitude: FloatArray, data: dict[str, str]) -> str:
    extended = "".join(
        f'<Data name="{key}"><value>{escape(value)}</value></Data>' for key, value in data.items() if value
    )
    return (
        f"<Placemark><name>{escape(name)}</name><styleUrl>#{style}</styleUrl><ExtendedData>{extended}</ExtendedData>"
        f"<LineString><tessellate>1</tessellate><altitudeMode>clampToGround</altitudeMode>"
        f"<coordinates>{_coordinates(latitude, longitude)}</coordinates></LineString></Placemark>"
    )


def _model(model: TrackModel, name: str) -> Iterator[str]:
    import shapely

    yield from _head(name)
    yield '<Style id="track"><LineStyle><color>ff2244dd</color><width>2</width></LineStyle></Style>'
    for kind, icon in _NODE_ICONS.items():
        yield (
            f'<Style id="{kind.name.lower()}"><IconStyle><scale>0.6</scale><Icon>'
            f"<href>http://maps.google.com/mapfiles/kml/shapes/{icon}.png</href></Icon></IconStyle>"
            "<LabelStyle><scale>0.6</scale></LabelStyle></Style>"
        )
    yield "<Folder><name>tracks</name>"
    for i, track in enumerate(model.track_id):
        own = model.knots(track)
        thin = shapely.simplify(shapely.linestrings(model.easting[own], model.northing[own]), DRAWING)
        east, north = shapely.get_coordinates(thin).T
        latitude, longitude, _ = model.frame.to_geodetic(east, north)
        ends = model.chainage(np.full(2, i), model.offset[own][[0, -1]]) / 1e3
        data = {"line": model.line[i], "name": model.name[i], "length_m": f"{float(model.lengths[i]):.3f}"}
        if np.isfinite(ends).all():
            data |= {"start_km": f"{ends[0]:.4f}", "end_km": f"{ends[1]:.4f}"}
        yield _line(track, "track", latitude, longitude, data)
    yield "</Folder><Folder><name>nodes</name>"
    for kind in _NODE_ICONS:
        rows = np.flatnonzero(model.nodes.kind == kind)
        if len(rows):
            latitude, longitude, _ = model.frame.to_geodetic(model.nodes.easting[rows], model.nodes.northing[rows])
            for row, place in zip(rows.tolist(), _coordinates(latitude, longitude).split(), strict=True):
                yield (
                    f"<Placemark><name>{escape(model.nodes.id[row])}</name><styleUrl>#{kind.name.lower()}</styleUrl>"
                    f"<Point><coordinates>{place}</coordinates></Point></Placemark>"
                )
    yield "</Folder></Document></kml>"


def _solution(solution: Solution, placed: NDArray[np.bool_], name: str) -> Iterator[str]:
    yield from _head(solution.run_id or name)
    for mode, colour in _MODE_COLOURS.items():
        yield f'<Style id="{mode}"><LineStyle><color>{colour}</color><width>4</width></LineStyle></Style>'
    yield "<Folder><name>by mode</name>"
    rows = np.flatnonzero(placed)
    breaks = np.flatnonzero((np.diff(solution.mode[rows]) != 0) | (np.diff(rows) > 1)) + 1
    for part in np.split(rows, breaks):
        # on to the next row, so that stretches meet
        reach = np.append(part, part[-1] + 1) if part[-1] + 1 < len(placed) and placed[part[-1] + 1] else part
        reach = reach if len(reach) > 1 else np.repeat(reach, 2)
        mode = Mode(int(solution.mode[part[0]])).label
        data = {
            "from_s": f"{solution.time[part[0]]:.3f}",
            "to_s": f"{solution.time[part[-1]]:.3f}",
            "track": solution.track_id[int(solution.track[part[0]])] if solution.track[part[0]] >= 0 else "",
        }
        yield _line(mode, mode, solution.latitude[reach], solution.longitude[reach], data)
    yield "</Folder>"
    if solution.start:
        start = datetime.fromisoformat(solution.start)
        yield from _moving(
            "train", _instants(start, solution.time[rows]), solution.latitude[rows], solution.longitude[rows]
        )
    yield "</Document></kml>"


def _instants(start: datetime, time: FloatArray) -> Iterator[str]:
    for seconds in time.tolist():
        yield (start + timedelta(seconds=seconds)).isoformat().replace("+00:00", "Z")


def _moving(name: str, when: Iterator[str], latitude: FloatArray, longitude: FloatArray) -> Iterator[str]:
    yield f"<Placemark><name>{name}</name><gx:Track><altitudeMode>clampToGround</altitudeMode>"
    for instant in when:
        yield f"<when>{instant}</when>"
    east, north = np.degrees(longitude).tolist(), np.degrees(latitude).tolist()
    for x, y in zip(east, north, strict=True):
        yield f"<gx:coord>{x:.8f} {y:.8f} 0</gx:coord>"
    yield "</gx:Track></Placemark>"
