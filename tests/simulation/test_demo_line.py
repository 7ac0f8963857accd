"""The bundled line: sound, within limits, and exactly what it says."""

from __future__ import annotations

import math

import numpy as np
import pytest

from railnav.geodesy.grid import choose_frame
from railnav.simulation import demo_line
from railnav.simulation.bundled import JUMP, LENGTH, TRACK_DISTANCE
from railnav.track import End, NodeKind, TrackModel, validate
from railnav.units import wrap_angle


def test_no_defects(line: TrackModel):
    assert validate(line) == []


def test_what_it_consists_of(line: TrackModel):
    kinds = {NodeKind(k): int((line.nodes.kind == k).sum()) for k in np.unique(line.nodes.kind)}
    # 8 crossovers with 2 turnouts each, 2 loops with 2, one branch; 2 joints where the chainage jumps
    assert kinds == {
        NodeKind.TURNOUT: 21,
        NodeKind.JOINT: 2,
        NodeKind.BUFFER_STOP: 1,
        NodeKind.END_OF_MODEL: 4,
    }
    for side in "RL":
        main = [t for t in line.track_id if t.startswith(f"77{side}")]
        assert sum(line.length(t) for t in main) == pytest.approx(LENGTH, rel=5e-4)
    assert {t["name"] for t in line.provenance["tunnels"]} == {"Summit tunnel", "Bend tunnel"}
    assert sum(t["to_m"] - t["from_m"] for t in line.provenance["tunnels"]) == pytest.approx(2 * 1960.0, rel=2e-3)
    assert set(line.line) == {"77", "78"}


def test_limits_of_railway_practice(line: TrackModel):
    assert np.abs(line.gradient).max() <= 0.0181
    assert np.abs(line.cant).max() <= 0.150
    assert np.abs(line.curvature).max() <= 1 / 299.9
    for track in line.track_id:
        part = line.knots(track)
        rise = np.abs(np.diff(line.cant[part])) / np.diff(line.offset[part])
        assert rise.max() <= 1 / 400  # cant gradient
    # the outer rail is the high one wherever there is cant and a bend
    both = (np.abs(line.cant) > 1e-6) & (np.abs(line.curvature) > 1e-9)
    assert (np.sign(line.cant[both]) == np.sign(line.curvature[both])).all()
    assert np.isfinite(line.height).all()
    assert np.diff(line.offset)[np.diff(line.offset) > 0].max() <= 1.01


def test_every_movement_is_tangential(line: TrackModel):
    for a, end_a, b, end_b in line.movements.tolist():
        i = line.knot_start[a + 1] - 1 if end_a == End.FINISH else line.knot_start[a]
        j = line.knot_start[b + 1] - 1 if end_b == End.FINISH else line.knot_start[b]
        out = line.grid_bearing[i] + (0.0 if end_a == End.FINISH else math.pi)
        into = line.grid_bearing[j] + (math.pi if end_b == End.FINISH else 0.0)
        assert abs(float(wrap_angle(into - out))) < 1e-6
        gap = [getattr(line, c)[i] - getattr(line, c)[j] for c in ("easting", "northing", "height")]
        assert math.hypot(*gap) < 1e-6
        sense = 1.0 if end_a != end_b else -1.0
        assert sense * line.gradient[i] == pytest.approx(line.gradient[j], abs=1e-9)


def test_main_tracks_are_four_metres_apart(line: TrackModel):
    for track in ("77R-03", "77R-11"):
        for offset in np.linspace(10.0, line.length(track) - 10.0, 60):
            here = line.at(track, offset)
            scale = line.scale[line.knots(track)].mean()
            left = [
                c
                for c in line.locate(float(here.easting), float(here.northing), within=6.0)
                if c.track.startswith("77L")
            ]
            assert left[0].cross / scale == pytest.approx(TRACK_DISTANCE, abs=3e-4)


def test_table_is_its_own_integral(line: TrackModel):
    fine = demo_line(spacing=0.25)
    generator = np.random.default_rng(3)
    for track in ("77R-03", "77X-03", "77S-4", "78-01"):
        offset = generator.uniform(0.0, line.length(track), 500)
        a, b = line.at(track, offset), fine.at(track, offset)
        for column, tolerance in (("easting", 2e-6), ("northing", 2e-6), ("height", 5e-6), ("grid_bearing", 1e-8)):
            np.testing.assert_allclose(getattr(a, column), getattr(b, column), atol=tolerance)
        part = line.knots(track)
        step, bend = np.diff(line.offset[part]), line.curvature[part]
        turned = np.diff(np.unwrap(line.grid_bearing[part]))
        np.testing.assert_allclose(turned, 0.5 * (bend[1:] + bend[:-1]) * step, atol=1e-9)


def test_offset_is_length_on_the_ground(line: TrackModel):
    for track in ("77L-10", "77S-1", "78-01"):
        p = line.knots(track)
        e, n, h, k = line.easting[p], line.northing[p], line.height[p], line.curvature[p]
        chord = line.frame.ground_length(e[:-1], n[:-1], h[:-1], e[1:], n[1:], h[1:])
        sagitta = (0.5 * (k[1:] + k[:-1])) ** 2 * np.diff(line.offset[p]) ** 3 / 24
        assert float((chord + sagitta).sum()) == pytest.approx(line.length(track), abs=1e-5)


def test_chainage_jumps_at_the_joint(line: TrackModel):
    before = line.at("77R-10", line.length("77R-10")).chainage
    after = line.at("77R-11", 0.0).chainage
    assert float(after - before) == pytest.approx(JUMP, abs=1e-6)
    assert float(line.at("77R-01", 0.0).chainage) == pytest.approx(40_000.0)
    # abreast of each other, both tracks carry the same chainage though their lengths differ
    here = line.at("77R-10", 2000.0)
    other = next(
        c for c in line.locate(float(here.easting), float(here.northing), within=6.0) if c.track.startswith("77L")
    )
    assert float(line.at(other.track, other.offset).chainage) == pytest.approx(float(here.chainage), abs=0.02)


def test_lawful_ways(line: TrackModel):
    assert line.routes("77L-01", "78-01"), "the branch can be reached from the left track"
    # over the crossovers the way is a little shorter in a left-hand bend: routes are ordered by true length, not by tidiness
    ways = line.routes("77R-01", "77R-13", at_most=16)
    assert list(ways) == sorted(ways, key=lambda r: r.length)
    assert ways[0].length == pytest.approx(LENGTH, rel=1e-3)
    # a crossover cannot be entered from its heel side: no way from 77R-13 back over 77X-07 without reversing
    assert all("77X-07" not in r.tracks for r in line.routes("77R-13", "77L-11"))


def test_same_every_time():
    a, b = demo_line(spacing=5.0), demo_line(spacing=5.0)
    assert a.track_id == b.track_id
    assert a.easting.tobytes() == b.easting.tobytes()


def test_lengths_do_not_depend_on_the_plane():
    wide = demo_line(spacing=10.0)
    other = demo_line(spacing=10.0, frame=choose_frame(math.radians(50.6), math.radians(10.9), crs="EPSG:25832"))
    assert other.frame.name != wide.frame.name
    np.testing.assert_allclose(other.lengths, wide.lengths, rtol=2e-7)


def test_script_writes_the_same_line(line: TrackModel, tmp_path):
    import runpy
    from pathlib import Path

    script = Path(__file__).parents[2] / "track_models" / "make_demo_line.py"
    runpy.run_path(str(script))["main"](tmp_path / "line.gpkg")
    back = TrackModel.read(tmp_path / "line.gpkg")
    assert back.track_id == line.track_id
    assert back.provenance["tunnels"] == line.provenance["tunnels"]
    np.testing.assert_allclose(back.easting, line.easting, atol=1e-6)
    np.testing.assert_allclose(back.offset, line.offset, atol=1e-6)
    assert validate(back) == []
