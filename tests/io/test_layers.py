"""Track axes from layers: GeoPackage and Shapefile, mapped columns, planes, what is refused."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from railnav.errors import InputError
from railnav.io.layers import read_layer
from railnav.track.validation import validate

pyogrio = pytest.importorskip("pyogrio", reason="pyogrio is not installed (extra frames)")

E0, N0 = 3_461_000.0, 5_482_000.0


def arc(radius=500.0, east=E0, north=N0, length=200.0):
    s = np.linspace(0, length, 41)
    return np.column_stack([east + radius * (1 - np.cos(s / radius)), north + radius * np.sin(s / radius)])


def line(*points):
    return np.array(points)


MAIN = line((E0, N0 - 200), (E0, N0 - 100), (E0, N0))
ON = line((E0, N0), (E0, N0 + 100), (E0, N0 + 200))


@pytest.fixture
def write(tmp_path):
    def write_layer(lines, name="tracks.gpkg", crs="EPSG:31467", layer=None, kind="LineString", **columns):
        path = tmp_path / name
        shapes = np.array(
            [shapely.to_wkb(geometry if kind != "LineString" else shapely.LineString(geometry)) for geometry in lines]
        )
        pyogrio.raw.write(
            str(path), shapes, [np.array(v) for v in columns.values()], list(columns), layer=layer, geometry_type=kind, crs=crs,
            append=path.exists(),
        )  # fmt: skip
        return path

    return write_layer


@pytest.mark.parametrize("name", ["tracks.gpkg", "tracks.shp", "tracks.fgb"])
def test_axes_with_mapped_columns(write, name):
    path = write([MAIN, ON, arc()], name, GLEIS=["1", "2", "3"], STRECKE=[4000, 4000, 4001], VON=[1.0, 1.2, 1.2])
    model = read_layer(path, columns={"track": "GLEIS", "line": "STRECKE", "start_km": "VON"})
    assert dict(zip(model.track_id, model.line, strict=True)) == {"1": "4000", "2": "4000", "3": "4001"}
    assert len(model.movements) == 2
    assert float(model.at("2", 50.0).chainage) == pytest.approx(1250.0, abs=0.1)
    assert float(model.at("3", 100.0).curvature) == pytest.approx(1 / 500, rel=1e-3)
    assert model.frame.authority == ("EPSG", 31467)
    assert not [d for d in validate(model) if d.kind != "missing heights"]


def test_heights_and_geographic_coordinates(write):
    points = np.column_stack([8.46 + np.arange(5) * 1e-4, np.full(5, 49.5), 100 + np.arange(5.0)])
    shapes = [shapely.LineString(points)]
    path = write(shapes, "z.gpkg", "EPSG:4326", kind="LineString Z", track=["A"])
    model = read_layer(path)
    assert float(model.at("A", 0.0).height) == pytest.approx(100.0, abs=1e-3)
    assert "zone 2" in model.frame.name


def test_another_plane_is_asked_for(write):
    path = write([MAIN], track=["A"])
    model = read_layer(path, crs="EPSG:25832")
    there = read_layer(path)
    assert model.frame.authority == ("EPSG", 25832)
    # DHDN to ETRS89 turns and scales by a few ppm: on 200 m that is under 2 mm
    assert model.length("A") == pytest.approx(there.length("A"), abs=5e-3)


def test_parts_of_a_feature(write):
    both = shapely.MultiLineString([MAIN, np.add(ON, [0.0, 50.0])])
    joined = shapely.MultiLineString([MAIN, ON])
    model = read_layer(write([both], "m.gpkg", kind="MultiLineString", track=["A"]))
    assert model.track_id == ("A.1", "A.2")
    assert "has 2 parts" in model.provenance["import"]["notes"][0]
    assert read_layer(write([joined], "j.gpkg", kind="MultiLineString", track=["A"])).track_id == ("A",)


def test_what_is_refused(write, tmp_path):
    path = write([MAIN, ON], track=["A", "A"], other=["x", None])
    with pytest.raises(InputError, match="features 1 and 2 are both called 'A'"):
        read_layer(path)
    assert read_layer(path, columns={"track": "fid"}).track_id == ("1", "2")
    with pytest.raises(InputError, match="has no column 'GLEIS'; it has: track, other"):
        read_layer(path, columns={"track": "GLEIS"})
    with pytest.raises(InputError, match="feature 2 names no track"):
        read_layer(path, columns={"track": "other"})
    with pytest.raises(InputError, match="'gauge' is nothing of a track"):
        read_layer(path, columns={"gauge": "other"})
    with pytest.raises(InputError, match="has no layer 'x'; it has: tracks"):
        read_layer(path, layer="x")
    lone = write([MAIN], "lone.gpkg", other=["x"])
    with pytest.raises(InputError, match=r"which column names the tracks\?.*--columns track=COLUMN"):
        read_layer(lone)
    write([ON], "lone.gpkg", layer="second", other=["x"])
    with pytest.raises(InputError, match="several layers of lines; choose with --layer: lone, second"):
        read_layer(lone)
    points = write([shapely.Point(E0, N0)], "p.gpkg", kind="Point", track=["A"])
    with pytest.raises(InputError, match="no layer of lines"):
        read_layer(points)
    bare = write([MAIN], "bare.shp", crs="EPSG:31467", track=["A"])
    bare.with_suffix(".prj").unlink()
    with pytest.raises(InputError, match="does not say in which coordinate system"):
        read_layer(bare)
    assert read_layer(bare, crs="EPSG:31467").length("A") == pytest.approx(200.0, abs=0.05)
    far = write([line((E0, N0), (E0, N0 + 50_000.0))], "far.gpkg", track=["A"])
    with pytest.raises(InputError, match="50 km from the one before"):
        read_layer(far)
    nothing = write([line((E0, N0), (E0, N0 + 0.01))], "nothing.gpkg", track=["A"])
    with pytest.raises(InputError, match="feature 1: a line has no length"):
        read_layer(nothing)
    junk = tmp_path / "junk.shp"
    junk.write_bytes(b"no shapefile")
    with pytest.raises(InputError, match="cannot be read"):
        read_layer(junk)
