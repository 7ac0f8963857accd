"""The model store: every bit back, valid for QGIS and GDAL, foreign and damaged files refused in one line."""

from __future__ import annotations

import dataclasses
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from small import make_model

from railnav.errors import InputError, ModelError
from railnav.geodesy.grid import choose_frame
from railnav.io import geopackage
from railnav.io.container import decode_point, describe_crs, point_blobs
from railnav.io.geopackage import BLOB_COLUMNS, read_model, write_model
from railnav.track.model import MilePosts, Nodes, TrackModel


def edit(path, *statements):
    connection = sqlite3.connect(path)
    with connection:
        for statement, *values in statements:
            connection.execute(statement, values)
    connection.close()


def ask(path, question):
    connection = sqlite3.connect(path)
    rows = connection.execute(question).fetchall()
    connection.close()
    return rows


def bits(array):
    return np.ascontiguousarray(array).view(np.uint64 if array.dtype == np.float64 else array.dtype)


def assert_identical(before, after, where=""):
    for field in dataclasses.fields(before):
        x, y = getattr(before, field.name), getattr(after, field.name)
        if isinstance(x, np.ndarray):
            assert x.dtype == y.dtype, field.name
            np.testing.assert_array_equal(bits(x), bits(y), err_msg=where + field.name)
        elif isinstance(x, Nodes | MilePosts):
            assert_identical(x, y, f"{field.name}.")
        elif not field.name.startswith("_"):
            assert x == y, where + field.name


def plain(model):
    """Turn NaN into the one NaN that stands for "none", and -0 into 0, where SQLite keeps numbers rather than bits."""
    posts = model.mileposts
    return dataclasses.replace(model, mileposts=MilePosts(posts.track, posts.offset + 0.0, posts.chainage + 0.0))


# --- there and back ---------------------------------------------------------------------------------------------------


def test_model_comes_back_to_the_bit(tmp_path, small_model):
    small_model.to_file(tmp_path / "m.gpkg")
    again = TrackModel.read(tmp_path / "m.gpkg")
    assert_identical(small_model, again)
    assert again.frame == small_model.frame
    write_model(again, tmp_path / "m.gpkg")
    assert_identical(small_model, read_model(tmp_path / "m.gpkg"))
    assert [file.name for file in tmp_path.iterdir()] == ["m.gpkg"]


finite = st.floats(-1e6, 1e6)
text = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=8)


@settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
@given(data=st.data())
def test_any_model_comes_back_to_the_bit(tmp_path, data):
    knots = data.draw(st.lists(st.integers(2, 40), min_size=3, max_size=3))
    model, total = make_model(tuple(knots)), sum(knots)
    random = np.random.default_rng(data.draw(st.integers(0, 999)))
    posts = data.draw(st.lists(st.tuples(finite, finite), max_size=5, unique_by=lambda pair: pair[0]))
    model = dataclasses.replace(
        model,
        easting=random.uniform(0, 500, total),
        northing=random.uniform(0, 500, total),
        height=random.integers(0, 2**64, total, np.uint64).view(np.float64),  # any bits, also NaN with a payload
        covariance_g=random.integers(0, 2**64, (total, 6), np.uint64).view(np.float64),
        cant=np.full(total, -0.0),
        name=tuple(data.draw(st.tuples(text, text, text))),
        line=tuple(data.draw(st.tuples(text, text, text))),
        track_id=tuple(data.draw(st.lists(text.filter(bool), min_size=3, max_size=3, unique=True))),
        mileposts=MilePosts(
            np.zeros(len(posts), np.int64),
            np.array(sorted(offset for offset, _ in posts), dtype=np.float64),
            np.array([chainage for _, chainage in posts], dtype=np.float64),
        ),
        movements=np.zeros((0, 4), np.int64) if data.draw(st.booleans()) else model.movements,
        provenance={"key": data.draw(st.none() | st.integers() | finite | text | st.lists(text))},
    )
    write_model(model, tmp_path / "m.gpkg")
    assert_identical(plain(model), read_model(tmp_path / "m.gpkg"))


@pytest.mark.parametrize("crs", ["EPSG:32634", None])
def test_plane_comes_back_and_is_found_by_its_code(tmp_path, small_model, crs):
    frame = choose_frame(np.radians(47.5), np.radians(19.1), crs=crs)
    model = dataclasses.replace(small_model, frame=frame)
    write_model(model, tmp_path / "m.gpkg")
    assert read_model(tmp_path / "m.gpkg").frame == frame
    code = int(crs[5:]) if crs else 100001
    ((srs_id, organization, old, new),) = ask(
        tmp_path / "m.gpkg",
        "SELECT srs_id, organization, definition, definition_12_063 FROM gpkg_spatial_ref_sys WHERE srs_id NOT IN (-1, 0, 4326)",
    )
    assert (srs_id, organization) == (code, "EPSG" if crs else "NONE")
    assert old.startswith("PROJCS[")
    assert new.startswith("PROJCRS[")


def test_same_model_same_bytes(tmp_path, small_model, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    write_model(small_model, tmp_path / "a.gpkg")
    write_model(small_model, tmp_path / "b.gpkg")
    assert (tmp_path / "a.gpkg").read_bytes() == (tmp_path / "b.gpkg").read_bytes()
    assert ask(tmp_path / "a.gpkg", "SELECT DISTINCT last_change FROM gpkg_contents") == [("2023-11-14T22:13:20.000Z",)]


def test_column_that_never_changes_is_stored_once(tmp_path, small_model):
    write_model(small_model, tmp_path / "m.gpkg")
    rows = ask(
        tmp_path / "m.gpkg", "SELECT length(offset), length(height), length(cant), length(covariance_g) FROM knots"
    )
    assert rows == [(96, 8, 8, 576), (56, 56, 8, 48), (40, 40, 8, 240)]


def test_edits_of_names_and_mile_posts_count(tmp_path, small_model):
    write_model(small_model, tmp_path / "m.gpkg")
    edit(
        tmp_path / "m.gpkg",
        ("UPDATE tracks SET name = NULL, line = '81' WHERE fid = 2",),
        ("INSERT INTO mileposts (track, offset_m, chainage_m) VALUES ('80R-01', 3, 117003)",),
    )
    again = read_model(tmp_path / "m.gpkg")
    assert again.name[1] == ""
    assert again.line == ("80", "81", "")
    np.testing.assert_array_equal(again.mileposts.track, [0, 0, 0, 2])
    np.testing.assert_array_equal(again.mileposts.offset, [0, 3, 7.3, 1 / 3])


# --- a valid GeoPackage -----------------------------------------------------------------------------------------------


def test_header_and_catalogue(tmp_path, small_model):
    path = tmp_path / "m.gpkg"
    write_model(small_model, path)
    assert path.read_bytes()[68:72] == b"GPKG"
    assert ask(path, "PRAGMA user_version") == [(10300,)]
    assert ask(path, "PRAGMA integrity_check") == [("ok",)]
    assert ask(path, "PRAGMA foreign_key_check") == []
    assert ask(path, "SELECT srs_id FROM gpkg_spatial_ref_sys ORDER BY 1") == [(-1,), (0,), (4326,), (100001,)]
    assert ask(path, "SELECT table_name, data_type FROM gpkg_contents ORDER BY 1") == [
        ("knots", "attributes"),
        ("layer_styles", "attributes"),
        ("mileposts", "features"),
        ("movements", "attributes"),
        ("nodes", "features"),
        ("railnav_meta", "attributes"),
        ("tracks", "features"),
    ]
    assert ask(path, "SELECT table_name, geometry_type_name, srs_id, z, m FROM gpkg_geometry_columns ORDER BY 1") == [
        ("mileposts", "POINT", 100001, 2, 0),
        ("nodes", "POINT", 100001, 2, 0),
        ("tracks", "LINESTRING", 100001, 2, 0),
    ]
    assert ask(path, "SELECT extension_name FROM gpkg_extensions") == [("gpkg_crs_wkt",)]
    bounds = ask(path, "SELECT min_x, min_y, max_x, max_y FROM gpkg_contents WHERE table_name = 'tracks'")[0]
    assert bounds == (
        small_model.easting.min(),
        small_model.northing.min(),
        small_model.easting.max(),
        small_model.northing.max(),
    )
    row = ask(path, "SELECT track, line, name, length_m, start_km, end_km, start_node, end_node FROM tracks")[0]
    assert row[:3] == ("80R-01", "80", "")
    assert row[3] == small_model.length("80R-01")
    assert row[4] == pytest.approx(117.000125, abs=1e-12)
    assert row[6:] == ("A", "turnout 'W1'")


def test_lines_keep_within_5_mm_of_the_knots(tmp_path):
    random = np.random.default_rng(2)
    model = make_model((9000, 700, 50))
    along = np.arange(9750.0)
    bearing = np.sin(along / 300)
    model = dataclasses.replace(
        model,
        easting=4_500_000 + np.cumsum(np.sin(bearing)) + random.normal(0, 1e-4, 9750),
        northing=5_260_000 + np.cumsum(np.cos(bearing)),
    )
    write_model(model, tmp_path / "m.gpkg")
    blobs = [blob for (blob,) in ask(tmp_path / "m.gpkg", "SELECT geom FROM tracks ORDER BY fid")]
    for i, blob in enumerate(blobs):
        assert blob[:4] == b"GP\0\x03"
        line = shapely.from_wkb(blob[40:])
        part = slice(model.knot_start[i], model.knot_start[i + 1])
        knots = np.column_stack([model.easting[part], model.northing[part]])
        assert shapely.distance(shapely.points(knots), line).max() <= geopackage.DRAWING_TOLERANCE
        assert line.has_z == (i > 0)
        vertices = shapely.get_coordinates(line, include_z=True)
        np.testing.assert_array_equal(vertices[[0, -1], :2], knots[[0, -1]])
        assert len(vertices) < 0.8 * len(knots)
        np.testing.assert_array_equal(np.frombuffer(blob[8:40]), [line.bounds[k] for k in (0, 2, 1, 3)])


def test_ogr_opens_every_layer(tmp_path, small_model):
    if shutil.which("ogrinfo") is None:
        pytest.skip("ogrinfo (GDAL) is not installed")
    write_model(small_model, tmp_path / "m.gpkg")
    run = subprocess.run(["ogrinfo", "-al", tmp_path / "m.gpkg"], capture_output=True, text=True, check=True)
    assert run.stderr == ""
    for line in (
        "Layer name: tracks",
        "Geometry: 3D Line String",
        "Layer name: nodes",
        "Geometry: 3D Point",
        "Layer name: mileposts",
        "Layer name: movements",
        "Layer name: knots",
        'PROJCRS["WGS 84 / Gauss-Kruger zone 4"',
        "  name (String) = Füzesabony",
        "  kind (String) = buffer-stop",
    ):
        assert line in run.stdout, line


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("kind", "size"), [(1, 2), (1001, 3), (2001, 3), (3001, 4), (0x80000001, 3)])
@pytest.mark.parametrize("envelope", [0, 1, 2])
def test_points_of_other_writers_are_understood(order, kind, size, envelope):
    blob = b"GP\0" + bytes([(order == "<") | envelope << 1]) + b"\0" * 4 + b"\0" * (0, 32, 48)[envelope]
    blob += (
        bytes([order == "<"])
        + np.array(kind, f"{order}u4").tobytes()
        + np.arange(1.0, size + 1).astype(f"{order}f8").tobytes()
    )
    height = 3.0 if kind in (1001, 3001, 0x80000001) else np.nan
    np.testing.assert_array_equal(decode_point(blob), (1.0, 2.0, height))
    for end in range(len(blob)):
        assert decode_point(blob[:end]) is None
    assert decode_point("text") is None


def test_point_without_position_has_no_geometry():
    nan = np.nan
    blobs = point_blobs(4326, np.array([1, nan, 2]), np.array([1, 1, 2]), np.array([3, 3, nan]))
    assert blobs[1] is None
    assert decode_point(blobs[0]) == (1, 1, 3)
    np.testing.assert_array_equal(decode_point(blobs[2]), (2, 2, nan))


def test_system_that_wkt1_cannot_say_is_undefined_there():
    wkt = (
        'ENGCRS["yard",EDATUM["yard"],CS[Cartesian,2],AXIS["(E)",east,ORDER[1],LENGTHUNIT["metre",1]],'
        'AXIS["(N)",north,ORDER[2],LENGTHUNIT["metre",1]]]'
    )
    name, srs_id, organization, _, new = describe_crs(wkt)
    assert (name, srs_id, organization) == ("yard", 100001, "NONE")
    assert new.startswith("ENGCRS")


# --- refusals ---------------------------------------------------------------------------------------------------------


def refusal(path):
    with pytest.raises(ModelError) as caught:
        read_model(path)
    text = str(caught.value)
    assert text.startswith(str(path))
    assert "\n" not in text
    assert caught.value.file == Path(path)
    return text.removeprefix(str(path))


def test_files_that_are_no_models_are_refused(tmp_path, small_model):
    path = tmp_path / "m.gpkg"
    assert refusal(path) == ": does not exist; check the name"
    assert refusal(tmp_path) == ": is a folder; name the GeoPackage in it"
    path.write_bytes(b"")
    assert refusal(path) == ": is empty; make it again"
    path.write_bytes(b"time_s,latitude_deg\n" * 100)
    assert refusal(path).startswith(": is no GeoPackage, or a damaged one (file is not a database); make it again")
    path.unlink()
    edit(path, ("CREATE TABLE gpkg_contents (table_name TEXT)",))
    assert refusal(path) == (
        ": holds no reference track model (there is no table railnav_meta); "
        "railnav reads what railnav wrote; import a network from GeoJSON"
    )
    path.unlink()
    write_model(small_model, path)
    os.truncate(path, path.stat().st_size * 2 // 3)
    assert refusal(path).startswith(": is no GeoPackage, or a damaged one (database disk image is malformed)")


STATEMENTS = {
    "newer": (
        "UPDATE railnav_meta SET value = '2' WHERE key = 'schema_version'; "
        "UPDATE railnav_meta SET value = '\"railnav 3.0\"' WHERE key = 'created_by'",
        ": has schema version 2, and this railnav reads up to 1; use railnav 3.0 or later",
    ),
    "no version": (
        "DELETE FROM railnav_meta WHERE key = 'schema_version'",
        ", column railnav_meta: schema version 'None' is no number",
    ),
    "version true": (
        "UPDATE railnav_meta SET value = 'true' WHERE key = 'schema_version'",
        ", column railnav_meta: schema version 'True' is no number",
    ),
    "no JSON": (
        "UPDATE railnav_meta SET value = '{' WHERE key = 'provenance'",
        ", column railnav_meta: the value of 'provenance' is no JSON",
    ),
    "provenance": (
        "UPDATE railnav_meta SET value = '3' WHERE key = 'provenance'",
        ", column railnav_meta: provenance is no table",
    ),
    "other content": (
        "UPDATE railnav_meta SET value = '\"cake\"' WHERE key = 'content'",
        ": holds a cake, not a reference track model",
    ),
    "no plane": (
        "DELETE FROM railnav_meta WHERE key = 'crs_pipeline'",
        ", column railnav_meta: crs_pipeline is missing",
    ),
    "ballpark": (
        "UPDATE railnav_meta SET value = '-1' WHERE key = 'crs_accuracy_m'",
        ", column railnav_meta: crs_accuracy_m is -1; make the model again",
    ),
    "no knots table": ("DROP TABLE knots", ", column knots: the table is missing"),
    "no column": ("ALTER TABLE knots DROP COLUMN cant", ", column knots: column 'cant' is missing"),
    "no tracks": ("DELETE FROM tracks", ", column tracks: has no track"),
    "track gone": ("DELETE FROM tracks WHERE fid = 1", ", row 1, column knots.track: '80R-01' is no track"),
    "knots gone": ("DELETE FROM knots WHERE fid = 2", """, column knots: track "Gleis 3, 'süd'" has no knots"""),
    "no such knots": ("UPDATE knots SET track = 'x' WHERE fid = 2", ", row 2, column knots.track: 'x' is no track"),
    "count": (
        "UPDATE knots SET knots = 13 WHERE fid = 1",
        ", row 1, column knots.offset: is 96 bytes long where 13 knots need 104",
    ),
    "count huge": (
        "UPDATE knots SET knots = 1e300 WHERE fid = 1",
        ", row 1, column knots.knots: 1e+300 is no number of knots",
    ),
    "count one": ("UPDATE knots SET knots = 1 WHERE fid = 1", ", row 1, column knots.knots: 1 is no number of knots"),
    "count text": (
        "UPDATE knots SET knots = 'many' WHERE fid = 1",
        ", row 1, column knots.knots: 'many' is no finite number",
    ),
    "short": (
        "UPDATE knots SET easting = substr(easting, 9) WHERE fid = 3",
        ", row 3, column knots.easting: is 32 bytes long where 5 knots need 40",
    ),
    "float32": (
        "UPDATE knots SET easting = substr(easting, 1, 20) WHERE fid = 3",
        ", row 3, column knots.easting: is 20 bytes long where 5 knots need 40",
    ),
    "offset once": (
        "UPDATE knots SET offset = substr(offset, 1, 8) WHERE fid = 3",
        ", row 3, column knots.offset: is 8 bytes long where 5 knots need 40",
    ),
    "no blob": ("UPDATE knots SET cant = 'none' WHERE fid = 1", ", row 1, column knots.cant: is no BLOB"),
    "number": ("UPDATE knots SET cant = 0.5 WHERE fid = 1", ", row 1, column knots.cant: is no BLOB"),
    "other bits": (
        "UPDATE knots SET curvature = zeroblob(96) WHERE fid = 1",
        ", row 1, column knots.crc32: the geometry of track '80R-01' is damaged (checksum differs)",
    ),
    "node": ("UPDATE nodes SET node = 'X' WHERE fid = 1", ", row 1, column tracks.start_node: 'A' is no node"),
    "kind": (
        "UPDATE nodes SET kind = 'bridge' WHERE fid = 1",
        ", row 1, column nodes.kind: 'bridge' is no kind of node (joint, turnout,",
    ),
    "no geometry": ("UPDATE nodes SET geom = NULL WHERE fid = 2", ", row 2, column nodes.geom: is no point"),
    "movement": (
        "UPDATE movements SET end_b = 'middle' WHERE fid = 1",
        ", row 1, column movements.end_b: 'middle' is no end (start, finish)",
    ),
    "milepost": (
        "UPDATE mileposts SET chainage_m = 'km 7' WHERE fid = 3",
        ", row 3, column mileposts.chainage_m: 'km 7' is no finite number",
    ),
    "name": ("UPDATE tracks SET name = x'00ff' WHERE fid = 1", ", row 1, column tracks.name: b'\\x00\\xff' is no text"),
    "view": (
        "ALTER TABLE movements RENAME TO real; CREATE VIEW movements AS SELECT * FROM real",
        ", column movements: the table is missing",
    ),
}


@pytest.mark.parametrize("case", STATEMENTS)
def test_tables_that_do_not_agree_are_refused(tmp_path, small_model, case):
    script, message = STATEMENTS[case]
    path = tmp_path / "m.gpkg"
    write_model(small_model, path)
    edit(path, *((statement,) for statement in script.split("; ")))
    found = refusal(path)
    assert found.startswith(message), found


def test_geometry_that_makes_no_track_is_refused_with_the_file(tmp_path, small_model):
    path = tmp_path / "m.gpkg"
    write_model(small_model, path)
    offset = np.arange(12.0)[::-1]
    blobs = list(ask(path, f"SELECT {', '.join(BLOB_COLUMNS)} FROM knots WHERE fid = 1")[0])
    blobs[0] = offset.tobytes()
    edit(path, ("UPDATE knots SET offset = ?, crc32 = ? WHERE fid = 1", blobs[0], geopackage.checksum(blobs)))
    assert "offsets of track '80R-01' do not grow" in refusal(path)


def test_file_in_use_is_refused(tmp_path, small_model, monkeypatch):
    path = tmp_path / "m.gpkg"
    write_model(small_model, path)
    real = sqlite3.connect
    monkeypatch.setattr(sqlite3, "connect", lambda *args, **options: real(*args, **{**options, "timeout": 0.01}))
    other = real(path, isolation_level=None)
    other.execute("BEGIN EXCLUSIVE")
    assert refusal(path) == ": is in use by another program; close it there"
    other.execute("ROLLBACK")
    other.close()
    assert read_model(path).track_id == small_model.track_id


def test_file_open_elsewhere_is_read_with_its_log_and_not_replaced(tmp_path, small_model):
    path = tmp_path / "m.gpkg"
    write_model(small_model, path)
    other = sqlite3.connect(path, isolation_level=None)  # as QGIS keeps it open
    other.execute("PRAGMA journal_mode = WAL")
    other.execute("UPDATE tracks SET name = 'edited' WHERE fid = 1")
    assert read_model(path).name[0] == "edited"
    with pytest.raises(
        InputError, match=r"m.gpkg: the file is open in another program, .* \(m.gpkg-wal stands beside it\)"
    ):
        write_model(small_model, path)
    assert read_model(path).name[0] == "edited"
    other.close()
    write_model(small_model, path)
    assert read_model(path).name[0] == ""


def test_reading_changes_nothing(tmp_path, small_model):
    path = tmp_path / "m.gpkg"
    write_model(small_model, path)
    before = path.read_bytes()
    path.chmod(0o444)
    read_model(path)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["m.gpkg"]


def test_odd_names_of_files(tmp_path, small_model):
    for name in ("a b?mode=rwc#x.gpkg", "ä%20.gpkg", "'quoted'.gpkg"):
        write_model(small_model, tmp_path / name)
        assert read_model(tmp_path / name).track_id == small_model.track_id


def test_writing_refuses_what_could_not_be_read(tmp_path, small_model):
    path = tmp_path / "m.gpkg"
    write_model(small_model, path)
    before = path.read_bytes()
    twice = dataclasses.replace(small_model, track_id=("a", "b", "a"))
    with pytest.raises(ModelError, match=r"m.gpkg: track 'a' stands twice or is empty"):
        write_model(twice, path)
    nameless = dataclasses.replace(small_model, nodes=dataclasses.replace(small_model.nodes, id=("a", "b", "", "c")))
    with pytest.raises(ModelError, match=r"node '' stands twice or is empty"):
        write_model(nameless, path)
    for value in (np.int64(3), float("nan"), {1, 2}, Path()):
        with pytest.raises(ModelError, match="the provenance holds more than JSON values"):
            write_model(dataclasses.replace(small_model, provenance={"x": value}), path)
    with pytest.raises(InputError, match=r"the folder .* does not exist"):
        write_model(small_model, tmp_path / "gone" / "m.gpkg")
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["m.gpkg"]


# --- laws -------------------------------------------------------------------------------------------------------------


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_files_are_read_or_refused(tmp_path, small_model, data):
    whole = tmp_path / "m.gpkg"
    if not whole.exists():
        write_model(small_model, whole)
    content = bytearray(whole.read_bytes())
    for _ in range(data.draw(st.integers(0, 4))):
        place = data.draw(st.integers(0, len(content) - 1))
        patch = data.draw(st.binary(min_size=1, max_size=64))
        content[place : place + len(patch)] = patch
    del content[data.draw(st.just(len(content)) | st.integers(0, len(content))) :]
    broken = tmp_path / "broken.gpkg"
    broken.write_bytes(bytes(content))
    try:
        model = read_model(broken)
    except ModelError as error:
        assert error.file == broken  # noqa: PT017 - either outcome is lawful
        assert "\n" not in str(error)  # noqa: PT017
    else:
        for name in BLOB_COLUMNS:
            np.testing.assert_array_equal(bits(getattr(model, name)), bits(getattr(small_model, name)))


CHILD = """
import sys
sys.path.insert(0, sys.argv[2])
from small import make_model
from railnav.io.geopackage import write_model
models = [make_model((40_000, 20, 20), seed=seed) for seed in (1, 2)]
while True:
    for model in models:
        write_model(model, sys.argv[1])
        print("saved", flush=True)
"""


@pytest.mark.slow
def test_killed_save_leaves_one_whole_model(tmp_path):
    path = tmp_path / "m.gpkg"
    eastings = [make_model((40_000, 20, 20), seed=seed).easting for seed in (1, 2)]
    for delay in (0.005, 0.02, 0.05):
        child = subprocess.Popen([sys.executable, "-c", CHILD, path, Path(__file__).parent], stdout=subprocess.PIPE)
        child.stdout.readline()
        time.sleep(delay)
        child.send_signal(signal.SIGKILL)
        child.wait()
        child.stdout.close()
        model = read_model(path)
        assert any(np.array_equal(model.easting, easting) for easting in eastings)


README = Path(__file__).parents[2] / "track_models" / "README.md"


def test_schema_is_described_column_by_column(tmp_path, small_model):
    write_model(small_model, tmp_path / "m.gpkg")
    text = README.read_text(encoding="utf-8")
    for (table,) in ask(tmp_path / "m.gpkg", "SELECT table_name FROM gpkg_contents"):
        chapter = text.split(f"### `{table}`")[1].split("\n#")[0]
        for row in ask(tmp_path / "m.gpkg", f"PRAGMA table_info({table})"):
            if table != "railnav_meta" and row[1] not in ("fid", "geom"):
                assert f"`{row[1]}`" in chapter, f"{table}.{row[1]}"
    for (key,) in ask(tmp_path / "m.gpkg", "SELECT key FROM railnav_meta"):
        assert f"`{key}`" in text, key
    assert f"## Schema, version {geopackage.SCHEMA_VERSION}\n" in text


def test_example_of_the_schema_runs(tmp_path, small_model, monkeypatch):
    write_model(small_model, tmp_path / "line.gpkg")
    monkeypatch.chdir(tmp_path)
    code = README.read_text(encoding="utf-8").split("```python\n")[1].split("```")[0]
    names = {}
    monkeypatch.setattr(
        sqlite3, "connect", lambda path, connect=sqlite3.connect: names.setdefault("open", connect(path))
    )
    exec(code, names)
    names["open"].close()
    np.testing.assert_array_equal(names["easting"], small_model.easting[:12])
