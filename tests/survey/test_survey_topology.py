"""Topology from runs: a simulated station with turnouts at 2 cm, a real junction of suburban lines, and lines that have none."""

import numpy as np
import pytest
from survey_simulator import axis_error, centre_line, drive, plane

from railnav.io.run import read_run
from railnav.survey import build
from railnav.survey.nominal import Line
from railnav.survey.topology import parted_lines, ways_of_line
from railnav.track import validate
from railnav.track.model import NodeKind

GAP = 4.7


def diverging(s, toe, radius=300.0, gap=GAP):
    """Distance of a track that leaves by a turnout and runs parallel afterwards: two arcs of one radius."""
    x = np.clip(s - toe, 0.0, None)
    half = np.sqrt(radius * gap)
    return np.where(
        x < half, x * x / (2 * radius), np.where(x < 2 * half, gap - (2 * half - x) ** 2 / (2 * radius), gap)
    )


@pytest.fixture(scope="module")
def station():
    """Double line with a siding on the right and a crossover to the left, each way driven."""
    rng = np.random.default_rng([1, 5])
    frame = plane()
    axis = centre_line(1, 3.0, frame=frame)
    end = axis.arc[-1]
    toes = (0.4 * end, 0.65 * end, 0.8 * end)
    siding = axis.shifted(np.minimum(diverging(axis.arc, toes[0]), diverging(end - axis.arc, end - toes[1])))
    left = axis.shifted(-4.5)
    cross = axis.shifted(-diverging(axis.arc, toes[2], gap=4.5))
    drives = [(axis, "main", False), (axis, "main", False), (siding, "siding", False), (siding, "siding", False),
              (left, "left", True), (left, "left", True), (cross, "cross", False)]  # fmt: skip
    runs = [
        drive(track, frame, rng, run_id=f"{name}-{day}", direction="down" if back else "up", day=day, backwards=back)
        for day, (track, name, back) in enumerate(drives)
    ]
    return build(runs), axis, left, toes


def test_turnouts_of_a_station_are_found_with_lawful_movements(station):
    model, axis, _, toes = station
    kinds = [NodeKind(int(k)) for k in model.nodes.kind]
    assert kinds.count(NodeKind.TURNOUT) == 4
    assert kinds.count(NodeKind.END_OF_MODEL) == 4
    assert len(model.track_id) == 8
    assert len(model.movements) == 8  # two at each turnout, and none from leg to leg
    assert validate(model) == []
    turnouts = [i for i, k in enumerate(kinds) if k == NodeKind.TURNOUT]
    _, at = axis.right_of(model.nodes.easting[turnouts], model.nodes.northing[turnouts])
    found = np.sort(axis.arc[at])
    assert np.allclose(found[:3], toes, atol=8.0)
    assert found[3] == pytest.approx(toes[2] + 2 * np.sqrt(300.0 * 4.5), abs=10.0)


def test_routes_pass_the_siding_and_the_crossover(station):
    model, _, _, _ = station
    names = model.track_id
    first = next(n for n in names if n.endswith("up/1"))
    through = {r.tracks for r in model.routes(first, "up/4")}
    assert ("up/1", "up/2", "up/3", "up/4") in through
    assert ("up/1", "up-2", "up/3", "up/4") in through
    assert {r.tracks[-1] for r in model.routes("up/3", "down/2")} == {"down/2"}
    assert model.routes("up/2", "up-2") == [] or all(len(r.tracks) > 2 for r in model.routes("up/2", "up-2"))


def test_the_axes_stay_centimetres_from_the_truth(station):
    model, axis, left, _ = station
    for name, truth in (("up/1", axis), ("up/4", axis), ("down/1", left)):
        error, _ = axis_error(model, name, truth)
        assert np.sqrt(np.mean(error[30:-30] ** 2)) < 0.015
    report = model.provenance["build"]
    crossing = next(r for r in report["runs"] if r["id"].startswith("cross"))
    assert len(crossing["tracks"]) == 3
    assert any("turnouts were made" in w for w in report["warnings"])
    for run in report["runs"]:
        counted = run["fixes"]["used"] + sum(v["count"] for v in run["fixes"]["rejected"].values())
        assert counted == run["fixes"]["total"]
        assert run["fixes"]["used"] > 0.97 * run["fixes"]["total"]


def test_a_through_line_has_no_turnouts():
    rng = np.random.default_rng(2)
    value = 0.02 * rng.standard_normal((4, 300))
    value[2:] += 4.0
    design = np.broadcast_to([0.8, -0.6], (300, 2))
    assert ways_of_line(value, design, 5.0) is None
    assert ways_of_line(value + 2.0 * rng.standard_normal(value.shape), design, 5.0) is None  # too rough to tell
    assert ways_of_line(value[:1], design, 5.0) is None


def test_courses_that_share_a_stretch_part_at_a_toe():
    s = np.arange(0.0, 6000.0, 30.0)
    trunk = np.column_stack([s, 0 * s])
    branch = np.column_stack([s, np.where(s > 3000.0, (s - 3000.0) ** 2 / 1600.0, 0.0)])[:160]
    found = parted_lines([Line(trunk, [0]), Line(branch, [1])])
    assert [line.members for line in found.lines] == [[0, 1]]
    (leg,) = found.branches
    assert leg.at_start
    assert not leg.at_finish
    assert leg.course[0] == pytest.approx([3000.0, 0.0], abs=45.0)
    apart = parted_lines([Line(trunk, [0]), Line(trunk + np.array([0.0, 500.0]), [1])])
    assert apart.branches == []
    assert len(apart.lines) == 2


def test_suburban_runs_make_one_junction_with_three_legs(shared_data):
    folder = shared_data / "hev_cinkota"
    if not folder.is_dir():
        pytest.skip("hev_cinkota is not among the shared data")
    model = build([read_run(d) for d in sorted(folder.iterdir()) if d.is_dir()])
    kinds = [NodeKind(int(k)) for k in model.nodes.kind]
    assert kinds.count(NodeKind.TURNOUT) == 1
    assert kinds.count(NodeKind.END_OF_MODEL) == 3
    assert len(model.track_id) == 3
    node = kinds.index(NodeKind.TURNOUT)
    assert all(node in (int(a), int(b)) for a, b in zip(model.start_node, model.end_node, strict=True))
    assert len(model.movements) == 2
    pairs = [{model.track_id[a], model.track_id[b]} for a, _, b, _ in model.movements]
    (trunk,) = pairs[0] & pairs[1]  # both legs go on to Oers
    assert 5000.0 < model.length(trunk) < 7000.0
    assert validate(model) == [] or all(d.kind != "impossible turnout" for d in validate(model))
