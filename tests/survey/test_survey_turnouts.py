"""Models with turnouts are updated, and models grow where runs go beyond them; simulated, and on the suburban runs."""

from dataclasses import replace

import numpy as np
import pytest
from survey_simulator import PHONE, axis_error, centre_line, drive, knots, plane
from test_survey_topology import diverging

from railnav.errors import RunError
from railnav.io.run import read_run
from railnav.survey import build, difference, update
from railnav.survey.following import followed, joined_groups
from railnav.survey.joining import _reaching
from railnav.survey.nominal import through
from railnav.survey.profiles import Traverse
from railnav.track import TrackModel, validate
from railnav.track.model import NodeKind


def last(model):
    return model.provenance["updates"][-1]


def rms(v):
    return float(np.sqrt(np.nanmean(np.asarray(v) ** 2)))


def right_of(axis, model, track):
    """Errors of a track's knots across a true axis whose own bearing differs from the line's centre."""
    bearing = np.unwrap(np.arctan2(np.gradient(axis.east), np.gradient(axis.north)))
    k = knots(model, track)
    error, _ = replace(axis, bearing=bearing, curvature=np.gradient(bearing, axis.arc)).right_of(
        model.easting[k], model.northing[k]
    )
    return error


# ------------------------------------------------------------------------------------------- a model with turnouts


@pytest.fixture(scope="module")
def junction():
    """A single line with a branch, each way driven twice, and twice again later."""
    rng = np.random.default_rng([7, 31])
    frame = plane()
    axis = centre_line(7, 2.0, frame=frame)
    branch = axis.shifted(diverging(axis.arc, 0.55 * axis.arc[-1], gap=40.0))

    def make(first):
        return [
            drive(track, frame, rng, run_id=f"{name}-{first + n}", direction="up", day=first + n, stop=0.0)
            for n, (track, name) in enumerate([(axis, "main"), (axis, "main"), (branch, "branch"), (branch, "branch")])
        ]

    old, new = make(0), make(10)
    return axis, branch, frame, build(old), build([*old, *new]), new


def truth_of(junction, model, name):
    """Which of the two ways a track behind the toe is."""
    return min((junction[0], junction[1]), key=lambda axis: rms(right_of(axis, model, name)[40:-40]))


def test_a_model_with_a_turnout_carries_records(junction, tmp_path):
    _, _, _, model, _, _ = junction
    records = model.records
    assert len(model.track_id) == 3
    assert [NodeKind(int(k)) for k in model.nodes.kind].count(NodeKind.TURNOUT) == 1
    assert set(records.tracks) == {"up", "up-2"}
    assert records.parts == {"up": ["up/1", "up/2"]}
    assert records.surveyed("up/2") == "up"
    assert records.sections("up-2") == ["up-2"]
    model.to_file(tmp_path / "junction.gpkg")
    again = TrackModel.read(tmp_path / "junction.gpkg").records
    assert again.joins == records.joins
    assert again.parts == records.parts


def test_an_update_of_a_turnout_is_near_a_build_of_all_runs(junction):
    _, _, _, model, batch, new = junction
    refined = update(model, new)
    assert refined.track_id == model.track_id == batch.track_id
    assert (refined.movements == model.movements).all()
    assert validate(refined) == []
    found = difference(batch, refined)
    for i, name in enumerate(found.tracks):
        here = np.flatnonzero(found.track == i)[4:-4]
        apart = (found.slew - found.common_slew)[here] / (found.sigma_slew[here] / np.sqrt(2.0))
        assert rms(apart) < 1.2, name  # of a sigma of the build
    for name in refined.track_id:
        truth = truth_of(junction, refined, name)
        before, after = (rms(right_of(truth, m, name)[40:-40]) for m in (model, refined))
        assert after < max(1.15 * before, 0.006), name
        assert after < 0.02, name
    told = {t["track"]: t for t in last(refined)["tracks"]}
    assert set(told) == set(model.track_id)
    assert all(t["sigma_m"] < t["sigma_before_m"] for t in told.values())
    assert all(len(r["tracks"]) == 2 for r in last(refined)["runs"])
    assert last(refined)["beyond"] == []


def test_ends_still_meet_after_an_update_over_one_route(junction, tmp_path):
    _, _, _, model, _, new = junction
    refined = update(model, [r for r in new if r.id.startswith("branch")])
    refined.to_file(tmp_path / "refined.gpkg")
    again = TrackModel.read(tmp_path / "refined.gpkg")
    for node in range(len(again.nodes.id)):
        ends = [
            (again.easting[k][at], again.northing[k][at])
            for name in again.track_id
            for at, nodes in ((0, again.start_node), (-1, again.end_node))
            if nodes[again.track_index(name)] == node
            for k in [knots(again, name)]
        ]
        assert np.ptp(np.array(ends), axis=0).max() < 1e-3
    twice = update(again, [r for r in new if r.id.startswith("main")])
    assert len(twice.records.runs) == 8


def test_runs_take_lawful_ways_through_tracks():
    main = through(np.arange(0.0, 1000.0, 5.0), np.zeros(200), 5.0)
    x = np.arange(0.0, 400.0, 5.0)
    leg = through(500.0 + x, -np.minimum(x**2 / 600.0, 40.0 + 0.0 * x), 5.0)
    join = {"track": "leg", "end": 0, "parent": "main", "easting_m": 500.0, "northing_m": 0.0}
    assert joined_groups(["main", "leg", "far"], [join]) == [["main", "leg"], ["far"]]
    s = np.arange(2.0, 890.0, 4.0)

    class Fixes:
        time = np.arange(len(s)) * 0.2

    rng = np.random.default_rng(0)
    off = np.where(s > 500.0, np.minimum((s - 500.0) ** 2 / 600.0, 40.0), 0.0)
    for sigma in (0.02, 3.0):
        noise = sigma * rng.standard_normal(len(s))
        laid = {
            "main": Traverse(Fixes, s, off + noise, 1),
            "leg": Traverse(Fixes, np.where(s > 498.0, s - 500.0, np.nan), np.where(s > 498.0, noise, np.nan), 1),
        }
        lines = {"main": main, "leg": leg}
        way = followed(laid, lines, [join], np.ones(len(s), bool), sigma, frozenset())
        assert (way["main"] == (s < 500.0)).mean() > 0.98
        assert (way["leg"] == (s >= 500.0)).mean() > 0.98
        straight = {**laid, "main": Traverse(Fixes, s, noise, 1), "leg": replace_right(laid["leg"], -off + noise)}
        way = followed(straight, lines, [join], np.ones(len(s), bool), sigma, frozenset())
        assert way["main"].all()


def replace_right(t, right):
    return Traverse(t.fixes, t.offset, np.where(np.isfinite(t.offset), right, np.nan), t.sense)


def test_a_leg_that_stops_short_of_its_toe_is_bridged_by_an_arc(junction):
    _, _branch, _, model, _, _ = junction
    k = knots(model, "up-2")
    columns = {
        name: getattr(model, name)[k].copy()
        for name in ("offset", "easting", "northing", "height", "grid_bearing", "curvature", "gradient", "cant", "scale", "covariance_g")
    }  # fmt: skip
    from railnav.track.alignment import KnotTable

    whole = KnotTable(**columns)
    short = KnotTable(
        **{name: column[25:] - (column[25] if name == "offset" else 0.0) for name, column in columns.items()}
    )
    parent = whole  # its own first knot is the toe
    bridged = _reaching(short, 0, parent, 0)
    assert bridged.offset[0] == 0.0
    assert abs(bridged.offset[-1] - whole.offset[-1]) < 0.5
    near = np.hypot(bridged.easting[:40, None] - whole.easting[:60], bridged.northing[:40, None] - whole.northing[:60])
    assert near.min(axis=1).max() < 0.51  # knots lie half a metre from the next at most
    assert np.abs(bridged.curvature[:40]).max() < 1.0 / 150.0


# ------------------------------------------------------------------------------------------------------ longer and new


@pytest.fixture(scope="module")
def piece():
    rng = np.random.default_rng([3, 9])
    frame = plane()
    axis = centre_line(1, 3.0, frame=frame)
    old = [
        drive(axis, frame, rng, run_id=f"old-{p}", direction="up", day=p, begin=0.2, end=0.8, stop=0.0)
        for p in range(3)
    ]
    new = [drive(axis, frame, rng, run_id=f"new-{p}", direction="up", day=9 + p, stop=0.0) for p in range(2)]
    return axis, frame, build(old), new


def test_ways_beyond_the_ends_are_reported(piece):
    _, _, model, new = piece
    entry = last(update(model, new))
    assert len(entry["beyond"]) == 4
    assert {way["where"] for way in entry["beyond"]} == {"beyond the start of track up", "beyond the end of track up"}
    assert all(way["became"] is None and way["length_m"] > 500.0 for way in entry["beyond"])
    assert sum("--extend" in w for w in entry["warnings"]) == 2
    for run in entry["runs"]:
        assert "beyond the end of the track" in run["fixes"]["rejected"]
        counted = run["fixes"]["used"] + sum(v["count"] for v in run["fixes"]["rejected"].values())
        assert counted == run["fixes"]["total"]


def test_a_track_is_lengthened_at_both_ends(piece, tmp_path):
    axis, frame, model, new = piece
    longer = update(model, new, extend=True)
    assert longer.track_id == ("up",)
    assert longer.length("up") == pytest.approx(axis.arc[-1], abs=25.0)
    error, sigma = axis_error(longer, "up", axis)
    assert rms(error[15:-15]) < 0.015
    assert np.mean((error / sigma)[15:-15] ** 2) < 4.0
    assert validate(longer) == []
    (track,) = last(longer)["tracks"]
    assert track["new_m"] == pytest.approx(longer.length("up") - model.length("up"), abs=10.0)
    assert all(way["became"] == "up" for way in last(longer)["beyond"])
    assert not any("--extend" in w for w in last(longer)["warnings"])
    # what it became is a model like any other
    longer.to_file(tmp_path / "longer.gpkg")
    rng = np.random.default_rng(77)
    more = [drive(axis, frame, rng, run_id="more", direction="up", day=20, stop=0.0)]
    again = update(TrackModel.read(tmp_path / "longer.gpkg"), more)
    assert last(again)["beyond"] == []
    assert rms(axis_error(again, "up", axis)[0][15:-15]) < 0.015
    # heights grow with it
    k = knots(longer, "up")
    at = axis.right_of(longer.easting[k], longer.northing[k])[1]
    assert rms((longer.height[k] - axis.height[at])[15:-15]) < 0.06


def test_mile_posts_stay_where_they_stand_when_a_track_grows_at_its_start(piece):
    from railnav.track.model import MilePosts

    _, _, model, new = piece
    at = np.array([100.0, 900.0])
    posted = replace(model, mileposts=MilePosts(np.zeros(2, np.int64), at, np.array([5000.0, 5800.0])))
    longer = update(posted, new, extend=True)
    assert (longer.mileposts.chainage == posted.mileposts.chainage).all()
    for before, after in zip(at, longer.mileposts.offset, strict=True):
        a, b = model.at("up", before), longer.at("up", after)
        assert np.hypot(a.easting - b.easting, a.northing - b.northing) < 0.1
    assert longer.mileposts.offset[0] > 500.0


def test_kilometres_and_buffer_stops_stay_too(piece):
    from railnav.track.chainage import LineReference, LineReferences

    _, _, model, new = piece
    line = LineReference("7", np.arange(3), np.arange(4) * 1000.0, np.full(3, 1000.0))
    at = np.array([50.0, 1200.0])
    references = LineReferences((line,), np.zeros(2, np.int64), np.zeros(2, np.int64), at, at + 300.0)
    kinds = model.nodes.kind.copy()
    kinds[:] = NodeKind.BUFFER_STOP
    known = replace(model, references=references, line=("7",), nodes=replace(model.nodes, kind=kinds))
    longer = update(known, new, extend=True)
    assert longer.line == ("7",)
    assert (longer.references.position == references.position).all()
    for before, after in zip(at, longer.references.offset, strict=True):
        a, b = model.at("up", before), longer.at("up", after)
        assert np.hypot(a.easting - b.easting, a.northing - b.northing) < 0.1
    # its ends lie elsewhere now: other nodes, of which nobody said that they are buffer stops
    assert not set(longer.nodes.id) & set(model.nodes.id)
    assert (longer.nodes.kind == NodeKind.END_OF_MODEL).all()


def test_a_run_without_heights_does_not_lengthen_a_track_that_has_them(piece):
    _, _, model, new = piece
    flat = [replace(r, gnss=replace(r.gnss, height=None)) for r in new]
    told = last(update(model, flat, extend=True))
    assert {way["became"] for way in told["beyond"]} == {None}
    assert any("has heights and run" in w for w in told["warnings"])


def test_a_loop_becomes_a_track_with_two_turnouts(piece):
    axis, frame, _, _ = piece
    rng = np.random.default_rng(5)
    model = build([drive(axis, frame, rng, run_id=f"old-{p}", direction="up", day=p, stop=0.0) for p in range(3)])
    end = axis.arc[-1]
    loop = axis.shifted(np.minimum(diverging(axis.arc, 0.4 * end), diverging(end - axis.arc, 0.35 * end)))
    new = [drive(loop, frame, rng, run_id=f"loop-{p}", direction="up", day=9 + p, stop=0.0) for p in range(2)]
    plain = last(update(model, new))
    assert {way["where"].split(" from ")[0] for way in plain["beyond"]} == {"beside track up"}
    assert not any("contradict" in w for w in plain["warnings"])
    grown = update(model, new, extend=True)
    kinds = [NodeKind(int(k)) for k in grown.nodes.kind]
    assert kinds.count(NodeKind.TURNOUT) == 2
    assert set(grown.track_id) == {"up/1", "up/2", "up/3", "up-2"}
    assert validate(grown) == []
    routes = {r.tracks for r in grown.routes("up/1", "up/3")}
    assert routes == {("up/1", "up/2", "up/3"), ("up/1", "up-2", "up/3")}
    joins = sorted(
        float(axis.arc[axis.right_of(np.array([j["easting_m"]]), np.array([j["northing_m"]]))[1][0]])
        for j in grown.records.joins
    )
    assert joins == pytest.approx([0.4 * end, 0.65 * end], abs=8.0)
    assert rms(right_of(loop, grown, "up-2")[30:-30]) < 0.03
    # a section that is parted again gives its name to its parts, the others keep theirs
    second = axis.shifted(-np.minimum(diverging(axis.arc, 0.1 * end), diverging(end - axis.arc, 0.75 * end)))
    again = update(grown, [drive(second, frame, rng, run_id="second", direction="up", day=20, stop=0.0)], extend=True)
    assert {"up/1/1", "up/1/2", "up/1/3", "up/2", "up/3", "up-2", "up-3"} == set(again.track_id)


def test_a_run_tied_to_nothing_is_refused_or_named(piece):
    axis, frame, model, _ = piece
    rng = np.random.default_rng(8)
    away = replace(axis, east=axis.east + 900.0, north=axis.north + 900.0)
    with pytest.raises(RunError, match="another line"):
        update(model, [drive(away, frame, rng, run_id="away", day=9, stop=0.0)], extend=True)
    # half on the model, then lost for a kilometre, then elsewhere
    run = drive(axis, frame, rng, run_id="jump", direction="up", day=9, stop=0.0)
    half = len(run.gnss) // 2
    latitude = run.gnss.latitude.copy()
    latitude[half:] += np.radians(2000.0 / 111_000)
    told = last(update(model, [replace(run, gnss=replace(run.gnss, latitude=latitude))], extend=True))
    assert any("tied to no track" in way["cause"] for way in told["beyond"])
    assert any("tied to no track" in w for w in told["warnings"])


def test_rough_runs_lengthen_a_track_too(piece):
    axis, frame, _, _ = piece
    rng = np.random.default_rng(12)
    phones = {"receiver": PHONE, "stop": 0.0}
    model = build([drive(axis, frame, rng, run_id=f"a{p}", day=p, end=0.6, **phones) for p in range(3)])
    longer = update(
        model, [drive(axis, frame, rng, run_id=f"b{p}", day=9 + p, **phones) for p in range(3)], extend=True
    )
    (name,) = longer.track_id
    assert longer.length(name) > 0.9 * axis.arc[-1]
    error, sigma = axis_error(longer, name, axis)
    assert rms(error[60:-60]) < 4.0
    assert np.mean((error / sigma)[60:-60] ** 2) < 6.0


# --------------------------------------------------------------------------------------------------------- real runs


def test_suburban_runs_refine_the_junction(shared_data):
    folder = shared_data / "hev_cinkota"
    if not folder.is_dir():
        pytest.skip("hev_cinkota is not among the shared data")
    runs = [read_run(d) for d in sorted(folder.iterdir()) if d.is_dir()]
    batch, model = build(runs), build(runs[0::2])
    refined = update(model, runs[1::2])
    assert refined.track_id == model.track_id
    kinds = [NodeKind(int(k)) for k in refined.nodes.kind]
    assert kinds.count(NodeKind.TURNOUT) >= 1
    before, after = (difference(batch, m) for m in (model, refined))
    apart = [rms(d.slew - d.common_slew) for d in (before, after)]
    assert apart[1] < apart[0]
    assert last(refined)["beyond"] == [] or all(way["became"] is None for way in last(refined)["beyond"])


# -------------------------------------------------------------------------------------------------------- differences


def test_a_track_that_has_been_parted_is_compared_with_all_its_parts(piece):
    axis, frame, _, _ = piece
    rng = np.random.default_rng(15)
    model = build([drive(axis, frame, rng, run_id=f"old-{p}", direction="up", day=p, stop=0.0) for p in range(3)])
    end = axis.arc[-1]
    leg = axis.shifted(diverging(axis.arc, 0.5 * end, gap=30.0))
    w = np.interp(axis.arc, [0.7 * end, 0.7 * end + 10, 0.7 * end + 90, 0.7 * end + 100], [0.0, 1.0, 1.0, 0.0])
    slewed = axis.shifted(0.12 * w)
    new = [drive(leg, frame, rng, run_id="leg", direction="up", day=9, stop=0.0)]
    new += [drive(slewed, frame, rng, run_id=f"main-{p}", direction="up", day=10 + p, stop=0.0) for p in range(2)]
    grown = update(model, new, extend=True)
    assert {"up/1", "up/2"} < set(grown.track_id)
    found = difference(model, grown)
    assert found.tracks == ("up", "up")
    assert set(found.partner) == {"up/1", "up/2"}
    assert len(found.only_new) == 1
    assert np.isfinite(found.slew).mean() > 0.98
    assert len(found.slew) == pytest.approx(model.length("up") / 5.0, rel=0.03)
    across = [s for s in found.stretches if s.coordinate == "across"]
    assert len(across) == 1
    assert across[0].track == "up"
    assert 0.7 * end - 30.0 < across[0].first < across[0].last < 0.7 * end + 130.0
    assert across[0].shift == pytest.approx(0.12, abs=0.03)


def test_independent_models_with_turnouts_are_compared_by_their_chains(junction):
    _, _, _, model, _, new = junction
    other = build(new)
    found = difference(model, other)
    assert found.relation == "independent"
    assert set(found.tracks) == set(model.track_id)
    assert rms((found.slew - found.common_slew) / found.sigma_slew) < 2.5
    assert all(s.found_by == "window" for s in found.stretches)


def test_the_cli_tells_what_is_wrong_in_one_line(piece, tmp_path):
    from click.testing import CliRunner

    from railnav.cli import main
    from railnav.io.run import write_run

    axis, frame, model, new = piece
    model.to_file(tmp_path / "line.gpkg")
    replace(model, record_source=None).to_file(tmp_path / "bare.gpkg")
    write_run(new[0], tmp_path / "new")
    away = replace(axis, east=axis.east + 900.0, north=axis.north + 900.0)
    write_run(drive(away, frame, np.random.default_rng(1), run_id="away", day=9, stop=0.0), tmp_path / "away")
    for words, text in (
        (("line.gpkg", "new", "--crs", "31467"), "keeps the model's plane"),
        (("bare.gpkg", "new"), "carries no survey records"),
        (("line.gpkg", "away"), "another line"),
        (("line.gpkg", "nowhere"), "does not exist"),
    ):
        at = [str(tmp_path / w) if not w.startswith("-") and not w.isdigit() else w for w in words]
        done = CliRunner().invoke(main, ["update", *at, "-o", str(tmp_path / "out.gpkg")])
        assert done.exit_code == 1, (words, done.output)
        assert text in done.output
        assert len(done.output.strip().splitlines()) == 1
        assert not (tmp_path / "out.gpkg").exists()
    done = CliRunner().invoke(
        main, ["update", str(tmp_path / "line.gpkg"), str(tmp_path / "new"), "-o", str(tmp_path / "o.gpkg")]
    )
    assert done.exit_code == 0, done.output
    assert "beyond the end of track up" in done.output
    assert "--extend" in done.output
    done = CliRunner().invoke(
        main, ["update", str(tmp_path / "line.gpkg"), str(tmp_path / "new"), "-o", str(tmp_path / "l.gpkg"), "--extend"]
    )
    assert done.exit_code == 0, done.output
    assert TrackModel.read(tmp_path / "l.gpkg").length("up") > 1.3 * model.length("up")
