"""The shared store against a real PostgreSQL with PostGIS that the tests start themselves."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

import railnav
from railnav.cli import main
from railnav.errors import ModelError, RailnavError
from railnav.geodesy import choose_frame
from railnav.io import postgis, postgis_server
from railnav.io.store_address import is_store, store_address
from railnav.track.model import TrackModel
from railnav.track.posts import references_from_posts

psycopg = pytest.importorskip("psycopg", reason="psycopg is not installed (extra stores)")


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    from postgres_server import NoServer, running_server

    with contextlib.ExitStack() as stack:
        try:
            address = stack.enter_context(running_server())
        except NoServer as why:
            pytest.skip(f"no PostgreSQL with PostGIS: {why}")
        yield address


@pytest.fixture(scope="module")
def model() -> TrackModel:
    plain = railnav.demo_line()
    return replace(plain, references=references_from_posts(plain))


def same(a: TrackModel, b: TrackModel) -> None:
    for field in fields(TrackModel):
        if field.name in ("_index", "record_source", "nodes", "mileposts"):
            continue
        one, other = getattr(a, field.name), getattr(b, field.name)
        if isinstance(one, np.ndarray):
            assert one.tobytes() == other.tobytes(), field.name
        else:
            assert one == other, field.name
    for part in ("nodes", "mileposts"):
        for field in fields(getattr(a, part)):
            one, other = getattr(getattr(a, part), field.name), getattr(getattr(b, part), field.name)
            np.testing.assert_array_equal(one, other)


def test_a_model_comes_back_to_the_bit(server, model):
    model.to_file(f"{server}?model=demo")
    same(TrackModel.read(f"{server}?model=demo"), model)


def test_versions_are_kept(server, model):
    address = f"{server}?model=versions"
    assert postgis.write_model(model, address, note="first") == 1
    changed = replace(model, name=tuple(f"{name}!" for name in model.name))
    assert postgis.write_model(changed, f"{address}&note=second") == 2
    assert TrackModel.read(address).name == changed.name
    assert TrackModel.read(f"{address}&version=1").name == model.name
    said = postgis.list_versions(address)
    assert [(v.version, v.note, v.tracks) for v in said] == [
        (1, "first", len(model.track_id)),
        (2, "second", len(model.track_id)),
    ]
    assert said[0].length == pytest.approx(float(model.lengths.sum()))
    with pytest.raises(ModelError, match="has no version 9 of 'versions'; the newest is 2"):
        TrackModel.read(f"{address}&version=9")
    with pytest.raises(ModelError, match="never overwritten"):
        model.to_file(f"{address}&version=1")


def test_other_planes_heights_and_names(server, model):
    """A custom plane, missing heights, names in any script, an empty provenance."""
    flat = replace(
        model,
        height=np.full_like(model.height, np.nan),
        gradient=np.zeros_like(model.gradient),
        name=tuple("Гл. путь №1 'x'; DROP TABLE model;--" for _ in model.track_id),
        provenance={"a": [1.5, None, "\\u0000 \" ' ;"], "b": {"ü": 1e-300}},
        frame=choose_frame(np.radians(47.5), np.radians(19.1), crs="EPSG:23700"),
    )
    name = "x'; DROP TABLE model; --"
    postgis.write_model(flat, f"{server}?model={name}")
    same(TrackModel.read(f"{server}?model={name}"), flat)


def test_programs_open_the_geometry(server, model):
    """Typed views with a system of their own: what QGIS lists; lines as long as the plane says, points where nodes are."""
    postgis.write_model(model, f"{server}?model=qgis")
    with psycopg.connect(server) as connection:
        rows = connection.execute(
            "SELECT f_table_name, type, srid, coord_dimension FROM geometry_columns WHERE f_table_name LIKE 'qgis %%' ORDER BY 1",
            (),
        ).fetchall()
        assert [(r[0], r[1], r[3]) for r in rows] == [
            ("qgis mileposts", "POINT", 3), ("qgis nodes", "POINT", 3), ("qgis tracks", "LINESTRING", 3),
        ]  # fmt: skip
        srid = rows[0][2]
        text = connection.execute("SELECT srtext FROM spatial_ref_sys WHERE srid = %s", (srid,)).fetchone()[0]
        assert "Gauss-Kruger zone" in text
        lines = connection.execute(
            'SELECT track, ST_Length(geom), ST_IsValid(geom) FROM railnav."qgis tracks" ORDER BY fid'
        ).fetchall()
        assert [line[0] for line in lines] == list(model.track_id)
        np.testing.assert_allclose([line[1] for line in lines], model.lengths, rtol=1e-3)
        assert all(line[2] for line in lines)
        east, north = connection.execute(
            'SELECT ST_X(geom), ST_Y(geom) FROM railnav."qgis nodes" ORDER BY fid LIMIT 1'
        ).fetchone()
        assert (east, north) == (model.nodes.easting[0], model.nodes.northing[0])


def test_geopandas_opens_them_as_other_programs_do(server, model):
    geopandas = pytest.importorskip("geopandas", reason="geopandas is not installed (extra frames)")
    postgis.write_model(model, f"{server}?model=frames")
    with psycopg.connect(server) as connection:
        blobs = connection.execute('SELECT ST_AsBinary(geom) FROM railnav."frames tracks" ORDER BY fid').fetchall()
    lines = geopandas.GeoSeries.from_wkb([row[0] for row in blobs])
    assert len(lines) == len(model.track_id)
    assert lines.is_valid.all()


def test_one_writer_at_a_time(server, model, monkeypatch):
    """While one transaction holds a model's lock, another waits and is refused by name; readers go on with what there is."""
    address = f"{server}?model=locked"
    postgis.write_model(model, address)
    monkeypatch.setattr(postgis_server, "LOCK_TIMEOUT", 1)
    where = store_address(address)
    with psycopg.connect(server) as holder:
        postgis.hold_lock(holder, where)
        begin = time.monotonic()
        with pytest.raises(ModelError, match="another writer is saving this model"):
            postgis.write_model(model, address)
        assert 0.8 < time.monotonic() - begin < 8.0
        assert TrackModel.read(address).track_id == model.track_id  # readers do not wait
        assert postgis.write_model(model, f"{server}?model=unlocked") == 1  # nor do writers of other models
    assert [v.version for v in postgis.list_versions(address)] == [1]
    assert postgis.write_model(model, address) == 2


def test_a_reader_keeps_its_snapshot(server, model, monkeypatch):
    """The version is deleted under a reader that has found it: the reader still gets it whole."""
    address = f"{server}?model=snapshot"
    postgis.write_model(model, address)
    find = postgis._find

    def find_and_lose(connection, where):
        found = find(connection, where)
        with psycopg.connect(server) as other:
            other.execute("DELETE FROM railnav.model WHERE name = 'snapshot'")
        return found

    monkeypatch.setattr(postgis, "_find", find_and_lose)
    same(TrackModel.read(address), model)
    monkeypatch.undo()
    with pytest.raises(ModelError, match="has no model 'snapshot'"):
        TrackModel.read(address)


def test_writers_at_once_make_versions_in_turn(server, model):
    address, made = f"{server}?model=race", []
    small = model

    def save() -> None:
        made.append(postgis.write_model(small, address))

    threads = [threading.Thread(target=save) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(made) == [1, 2, 3]
    same(TrackModel.read(f"{address}&version=2"), small)


def test_a_failed_save_leaves_nothing(server, model, monkeypatch):
    address = f"{server}?model=torn"

    def fail(*_: object) -> None:
        raise ValueError("halfway")

    monkeypatch.setattr(postgis, "show_newest", fail)
    with pytest.raises(ValueError, match="halfway"):
        postgis.write_model(model, address)
    monkeypatch.undo()
    assert postgis.list_versions(address) == []
    assert postgis.write_model(model, address) == 1


@pytest.mark.parametrize(
    ("statement", "words"),
    [
        (
            "UPDATE railnav.knots SET easting = set_byte(easting, 3, 77) WHERE ordinal = 0",
            "is damaged \\(checksum differs\\)",
        ),
        ("UPDATE railnav.knots SET northing = '\\x00' WHERE ordinal = 0", "has 1 bytes"),
        ("DELETE FROM railnav.knots WHERE ordinal = 0", "rows of knots for"),
        ("UPDATE railnav.movement SET track_a = 'gone' WHERE ordinal = 0", "a row names 'gone'"),
        ("UPDATE railnav.node SET kind = 'loop' WHERE ordinal = 0", "a row names 'loop'"),
        ("UPDATE railnav.version SET schema_version = 99", "has schema version 99"),
        ("UPDATE railnav.version SET crs = '[]'", "the plane or the provenance is damaged"),
        ("DELETE FROM railnav.track", "rows of knots for 0 tracks"),
    ],
)
def test_damage_is_refused(server, model, statement, words):
    address = f"{server}?model=damaged"
    version = postgis.write_model(model, address)
    with psycopg.connect(server) as connection:
        key = "version_id = (SELECT max(version_id) FROM railnav.version)"
        connection.execute(f"{statement} {'AND' if 'WHERE' in statement else 'WHERE'} {key}")
    with pytest.raises(ModelError, match=words):
        TrackModel.read(f"{address}&version={version}")


def test_refusals_name_the_store_and_no_password(server, model):
    with pytest.raises(ModelError, match="holds several models and none is named") as caught:
        TrackModel.read(server)
    password = server.split(":")[2].split("@")[0]
    assert password not in str(caught.value)
    wrong = server.replace(password, "wrong-secret")
    for address, words in (
        (f"{wrong}?model=demo", "cannot be reached"),
        ("postgresql://nobody:hush@127.0.0.1:1/none?model=a", "cannot be reached"),
        (f"{server}?model=nothing", "has no model 'nothing'"),
        (f"{server}?model=demo&schema=elsewhere", "holds no models"),
        (f"{server}?model=demo&version=x", "is no number"),
        (f"{server}?model=demo&statement_timeout=1", "cannot be reached"),
    ):
        with pytest.raises(ModelError, match=words) as caught:
            TrackModel.read(address)
        assert "wrong-secret" not in str(caught.value)
        assert "hush" not in str(caught.value)
        assert password not in str(caught.value)
    with pytest.raises(ModelError, match="names no model"):
        model.to_file(server)
    with pytest.raises(ModelError, match="JSON values"):
        replace(model, provenance={"x": float("nan")}).to_file(f"{server}?model=bad")
    with pytest.raises(ModelError, match="fails"):
        replace(model, name=tuple("a\0b" for _ in model.name)).to_file(f"{server}?model=bad")
    assert postgis.list_versions(f"{server}?model=bad") == []


def test_a_statement_has_a_limit(server, model, monkeypatch):
    postgis.write_model(model, f"{server}?model=slow")
    monkeypatch.setattr(postgis_server, "STATEMENT_TIMEOUT", 0.001)
    monkeypatch.setattr(
        postgis,
        "_find",
        lambda connection, where: connection.execute("SELECT pg_sleep(5)") and pytest.fail("not stopped"),
    )
    monkeypatch.setattr(
        postgis,
        "set_limits",
        lambda connection, **_: connection.execute("SELECT set_config('statement_timeout', '50', true)"),
    )
    with pytest.raises(ModelError, match="a statement took more than"):
        TrackModel.read(f"{server}?model=slow")


def test_a_reader_without_rights_to_write(server, model):
    """A guest may read and is refused by name when it saves."""
    postgis.write_model(model, f"{server}?model=guest")
    with psycopg.connect(server) as connection:
        connection.execute("CREATE ROLE guest LOGIN PASSWORD 'guest'")
        connection.execute("GRANT USAGE ON SCHEMA railnav TO guest")
        connection.execute("GRANT SELECT ON ALL TABLES IN SCHEMA railnav TO guest")
    password = server.split(":")[2].split("@")[0]
    guest = server.replace(f"tester:{password}", "guest:guest")
    same(TrackModel.read(f"{guest}?model=guest"), model)
    with pytest.raises(ModelError, match=r"refuses \(permission denied"):
        postgis.write_model(model, f"{guest}?model=guest")


def test_survey_records_travel(server, model):
    run, _ = railnav.simulate(model, ["77R-02", "77R-03"], seed=1)
    built = railnav.build([run])
    assert built.records is not None
    built.to_file(f"{server}?model=records")
    again = TrackModel.read(f"{server}?model=records")
    assert again.records is not None
    assert set(again.records.tracks) == set(built.records.tracks)
    again.to_file(f"{server}?model=records")  # read from one version while the next is saved
    assert set(TrackModel.read(f"{server}?model=records").records.tracks) == set(built.records.tracks)


def test_records_of_a_line_with_a_turnout_travel_with_their_joins_and_parts(server, monkeypatch):
    """A branch surveyed: what turnouts part into sections, and where tracks join, comes back whole, and later runs refine it."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "survey"))
    from survey_simulator import centre_line, drive, plane
    from test_survey_topology import diverging

    frame, rng = plane(), np.random.default_rng(41)
    axis = centre_line(3, 2.0, frame=frame)
    ways = {"main": axis, "branch": axis.shifted(diverging(axis.arc, 0.55 * axis.arc[-1], gap=40.0))}
    runs = [
        drive(way, frame, rng, run_id=f"{name}-{day}", direction="up", day=day)
        for day in range(2)
        for name, way in ways.items()
    ]
    built = railnav.build(runs)
    assert built.records is not None
    assert built.records.joins
    assert built.records.parts
    built.to_file(f"{server}?model=turnout")
    again = TrackModel.read(f"{server}?model=turnout")
    assert again.records is not None
    assert again.records.joins == built.records.joins
    assert again.records.parts == built.records.parts
    later = [drive(way, frame, rng, run_id=f"{name}-late", direction="up", day=9) for name, way in ways.items()]
    one, two = (railnav.update(m, later) for m in (built, again))
    assert one.track_id == two.track_id
    for name in one.track_id:
        assert two.length(name) == pytest.approx(one.length(name), abs=1e-6)


def test_verbs_take_an_address(server, model, tmp_path):
    model.to_file(tmp_path / "line.gpkg")

    def run(*arguments, ok=True):
        done = CliRunner().invoke(main, [str(a) for a in arguments])
        assert (done.exit_code == 0) == ok, done.output
        return done.output

    address = f"{server}?model=verbs"
    run("convert", tmp_path / "line.gpkg", "-o", address)
    assert "permitted" in run("info", address)
    run("convert", address, "-o", tmp_path / "back.gpkg")
    same(TrackModel.read(tmp_path / "back.gpkg"), model)
    assert "no defects" in run("validate", address)
    assert "verbs" in run("store", server)
    assert "has no model" in run("info", f"{server}?model=verbz", ok=False)
    password = server.split(":")[2].split("@")[0]
    for words in (
        run("info", address, "--json"),
        run("convert", tmp_path / "line.gpkg", "-o", address),
        run("convert", tmp_path / "line.gpkg", "-o", address, "--json"),
        run("convert", address, "-o", tmp_path / "line.shp", ok=False),
        run("navigate", address, "-m", address, "-o", tmp_path / "s.csv", ok=False),
        run("store", server),
    ):
        assert password not in words


# --- addresses, without a server ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "dsn", "model", "version", "shown"),
    [
        ("postgresql://h/d?model=a", "postgresql://h/d", "a", None, "postgresql://h/d?model=a"),
        ("postgresql:/h/d?model=a", "postgresql://h/d", "a", None, "postgresql://h/d?model=a"),  # as a path writes it
        ("postgres://u:p%40@h/d?model=a%20b&version=7", "postgresql://u:p%40@h/d", "a b", 7, "postgresql://h/d?model=a b&version=7"),
        ("postgresql://h/d?sslmode=require&model=a", "postgresql://h/d?sslmode=require", "a", None, "postgresql://h/d?model=a"),
        ("postgresql:///d?model=a", "postgresql:///d", "a", None, "postgresql:///d?model=a"),
        ("postgresql://h/d", "postgresql://h/d", "", None, "postgresql://h/d?model="),
    ],
)  # fmt: skip
def test_addresses(text, dsn, model, version, shown):
    where = store_address(text)
    assert (where.dsn, where.model, where.version, str(where)) == (dsn, model, version, shown)
    assert is_store(Path(text))
    again = store_address(Path(text))
    assert (again.model, again.version) == (model, version)


@given(st.text(max_size=40))
def test_any_address_is_read_or_refused(text):
    with contextlib.suppress(RailnavError):
        store_address(f"postgresql://{text}")
