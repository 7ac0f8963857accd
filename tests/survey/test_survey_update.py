"""Stored records, updates and differences: against what a build of all runs gives, and against simulated movements."""

import sqlite3
from dataclasses import replace

import numpy as np
import pytest
from survey_simulator import SURVEY, axis_error, centre_line, changed, double_line, drive, knots, only, plane

from railnav.errors import CrsError, ModelError, RunError
from railnav.survey import build, difference, update
from railnav.survey.axis import Chain, ErrorModel, solve, sweep
from railnav.survey.sides import stored_links
from railnav.survey.stored import keep_axis, mean_of
from railnav.track import TrackModel
from railnav.track.records import AxisRecords


def moved_axis(axis, first, last, size, ramp=8.0):
    """The axis with a slew of `size`, m, between two offsets."""
    w = np.interp(axis.arc, [first, first + ramp, last - ramp, last], [0.0, 1.0, 1.0, 0.0])
    return axis.shifted(size * (0.5 - 0.5 * np.cos(np.pi * w)))


def drives(axis, frame, rng, number, name, first_day, **options):
    return [
        drive(axis, frame, rng, run_id=f"{name}-{p + 1}", direction="up", day=first_day + p, **options)
        for p in range(number)
    ]


@pytest.fixture(scope="module")
def stock():
    rng = np.random.default_rng(1)
    frame = plane()
    axis = centre_line(1, 3.0, frame=frame)
    return axis, frame, build(drives(axis, frame, rng, 3, "old", 0)), drives(axis, frame, rng, 3, "new", 10)


def last(model):
    return model.provenance["updates"][-1]


# ------------------------------------------------------------------------------------------------------------ records


def test_records_hold_the_covariance_of_the_axis(stock):
    axis, _, model, _ = stock
    records = model.records
    t = records.tracks["up"]
    inner = t.across.chain().solve()
    assert np.abs(inner.state).max() == 0.0
    C = np.linalg.inv(records.across.rows.T @ records.across.rows)[:2, :2]
    sigma = np.sqrt((inner.covariance + t.across.lean @ C @ t.across.lean.transpose(0, 2, 1))[:, 0, 0])
    # the knots' sigma across, at the nodes
    k = knots(model, "up")
    _, stated = axis_error(model, "up", axis)
    at = np.linspace(0.0, 1.0, len(sigma))
    assert np.allclose(np.interp(at, np.linspace(0, 1, len(stated)), stated), sigma, rtol=0.03)
    assert np.allclose(model.easting[k][0], t.easting[0], atol=1e-3)


def test_records_go_through_a_file_and_are_read_when_asked_for(stock, tmp_path, monkeypatch):
    from railnav.io import geopackage_records

    path = tmp_path / "line.gpkg"
    stock[2].to_file(path)
    monkeypatch.setattr(geopackage_records, "read_records", lambda _: pytest.fail("read before asked for"))
    model = TrackModel.read(path)
    monkeypatch.undo()
    there, here = model.records, stock[2].records
    for name, t in here.tracks.items():
        for part in ("across", "up"):
            a, b = getattr(t, part), getattr(there.tracks[name], part)
            assert (a.rows == b.rows).all()
            assert (a.lean == b.lean).all()
            assert (a.noise == b.noise).all()
        assert (t.easting == there.tracks[name].easting).all()
        assert (t.height == there.tracks[name].height).all()
    assert there.receivers == here.receivers
    assert there.runs == tuple(here.runs)
    assert (there.across.rows == here.across.rows).all()


def test_damaged_or_changed_records_are_refused(stock, tmp_path):
    path = tmp_path / "line.gpkg"
    stock[2].to_file(path)
    model = TrackModel.read(path)
    with sqlite3.connect(path) as file:
        blob = bytearray(file.execute("SELECT across FROM records").fetchone()[0])
        blob[100] ^= 1
        file.execute("UPDATE records SET across = ?", (bytes(blob),))
    file.close()
    with pytest.raises(ModelError, match="has changed since"):
        _ = model.records
    with pytest.raises(ModelError, match="damaged"):
        _ = TrackModel.read(path).records


def test_a_file_without_records_is_read_and_cannot_be_updated(stock, tmp_path):
    path = tmp_path / "line.gpkg"
    replace(stock[2], record_source=None).to_file(path)
    model = TrackModel.read(path)
    assert model.records is None
    with pytest.raises(ModelError, match="carries no survey records"):
        update(model, stock[3])


def test_records_of_other_knots_are_refused(stock):
    with pytest.raises(ModelError, match="has been moved by"):
        update(replace(stock[2], easting=stock[2].easting + 0.5), stock[3])


# --------------------------------------------------------------------------------------------- sequential against batch


def chain_of(rng, K, N, *, step=5.0, correlated=0.01, noise=1e-5, time=0.25):
    """Runs of one straight track: white and correlated errors, at nodes."""
    elapsed = np.cumsum(np.full((K, N), time), axis=1)
    phi = np.exp(-time / 60.0)
    drift = np.zeros((K, N))
    drift[:, 0] = rng.standard_normal(K)
    for k in range(1, N):
        drift[:, k] = phi * drift[:, k - 1] + np.sqrt(1 - phi**2) * rng.standard_normal(K)
    return Chain(
        step=step,
        value=0.02 * rng.standard_normal((K, N)) + correlated * drift,
        lead=np.zeros((K, N)),
        variance=np.full((K, N), 0.02**2),
        time=elapsed,
        design=np.broadcast_to(np.array([0.6, -0.8]), (K, N, 2)),
        errors=[ErrorModel(0.02, correlated, 60.0, 0.025)] * K,
        bend=np.zeros(N),
        noise=np.full(N - 1, noise),
    )


@pytest.mark.parametrize("correlated", [1e-4, 0.01])
def test_merging_gives_what_all_runs_give(correlated):
    """White errors: to rounding. Correlated errors of the old runs are kept as the nearest chain: to a quarter of a sigma."""
    rng = np.random.default_rng(8)
    K, N, prior = 4, 400, 1.0 / 0.004
    every = chain_of(rng, K, N, correlated=correlated)
    part = [
        replace(every, value=every.value[a:b], lead=every.lead[a:b], variance=every.variance[a:b], time=every.time[a:b],
                design=every.design[a:b], errors=every.errors[a:b])
        for a, b in ((0, 2), (2, 4))
    ]  # fmt: skip

    def solved(chain, border_rows):
        swept = sweep(chain)
        R = np.vstack([swept.border, border_rows])
        value = np.append(swept.border_value, np.zeros(len(border_rows)))
        border = np.linalg.lstsq(R, value, rcond=None)[0]
        covariance = np.linalg.inv(R.T @ R)
        return solve(chain, swept, border, covariance, sure=True), border, covariance

    batch, _, _ = solved(every, prior * np.eye(2 * K))
    first, _border, covariance = solved(part[0], prior * np.eye(4))
    M = mean_of(range(2), [0.5, 0.5], 4, 2)
    kept = keep_axis(first, covariance, M, every.noise)
    # the old estimate becomes the nominal curve of the new runs
    y, _slope, bend = first.state.T
    new = replace(part[1], value=part[1].value - y, bend=bend)
    links = stored_links(kept, kept.chain(), np.zeros(N, bool), new)
    c = np.linalg.inv(np.linalg.cholesky(M @ covariance @ M.T))
    rows = np.zeros((6, 6))
    rows[:4, :4] = prior * np.eye(4)
    rows[4:, 4:] = c
    merged, _, _ = solved(replace(new, links=links), rows)
    sigma = np.sqrt(batch.covariance[:, 0, 0])
    off = np.abs(merged.state[:, 0] + y - batch.state[:, 0]) / sigma
    assert off.max() < (0.02 if correlated < 1e-3 else 0.6)
    assert np.sqrt(np.mean(off**2)) < (0.01 if correlated < 1e-3 else 0.3)
    assert np.allclose(np.sqrt(merged.covariance[:, 0, 0]), sigma, rtol=0.005 if correlated < 1e-3 else 0.1)


def test_an_update_is_near_a_build_from_all_runs(stock):
    axis, _, model, new = stock
    rng = np.random.default_rng(1)
    old = drives(axis, plane(), rng, 3, "old", 0)
    refined, whole = update(model, new), build([*old, *new])
    k = knots(refined, "up")
    found = difference(whole, refined)
    assert found.relation == "shared"
    inside = slice(40, -40)
    apart = (found.slew[inside]) / (found.sigma_slew[inside] / np.sqrt(2.0))
    assert np.sqrt(np.mean(apart**2)) < 0.7
    before, _ = axis_error(model, "up", axis)
    after, sigma = axis_error(refined, "up", axis)
    assert np.sqrt(np.mean(after**2)) < 1.05 * np.sqrt(np.mean(before**2))
    assert np.median(sigma) < 0.85 * np.median(axis_error(model, "up", axis)[1])
    assert 0.3 < np.mean((after / sigma) ** 2) < 2.0
    assert np.isfinite(refined.height[k]).all()
    told = last(refined)
    assert told["weight_of_stored"] == 1.0
    assert [r["id"] for r in told["runs"]] == [r.id for r in new]
    assert told["tracks"][0]["changes"] == []
    assert len(refined.records.runs) == 6


def test_updates_follow_one_another(stock, tmp_path):
    _axis, _, model, new = stock
    once = update(model, new[:1])
    once.to_file(tmp_path / "once.gpkg")
    twice = update(TrackModel.read(tmp_path / "once.gpkg"), new[1:])
    together = update(model, new)
    found = difference(together, twice)
    assert np.sqrt(np.nanmean(found.slew[40:-40] ** 2)) < 0.5 * np.nanmedian(found.sigma_slew)
    assert len(twice.provenance["updates"]) == 2
    assert len(twice.records.runs) == 6


def test_stored_knowledge_ages(stock):
    _, _, model, new = stock
    late = [replace(run, start=run.start.replace(year=run.start.year + 10)) for run in new]
    aged, plain = update(model, late, half_life=5.0), update(model, late)
    assert last(aged)["weight_of_stored"] == pytest.approx(0.25, abs=0.01)
    sigma = [np.sqrt(np.median(m.covariance_g[knots(m, "up"), 0])) for m in (plain, aged)]
    assert sigma[1] > 1.02 * sigma[0]


def test_mile_posts_nodes_and_untouched_tracks_stay():
    runs, _, _ = double_line(3, km=3.0, passes=2)
    model = build([r for r in runs if r.id.endswith("1")])
    refined = update(model, [r for r in runs if r.id == "up-2"])
    assert refined.track_id == model.track_id
    assert refined.nodes.id == model.nodes.id
    told = {t["track"]: t for t in last(refined)["tracks"]}
    assert told["up"]["runs"] == ["up-2"]
    if "down" in told:  # it moves with what is known of the frame, and only by that
        assert told["down"]["change_max_m"] < 0.02
    k = knots(refined, "up")
    assert refined.nodes.easting[refined.start_node[refined.track_index("up")]] == refined.easting[k][0]


# ------------------------------------------------------------------------------------------------------------ refusals


def test_a_run_that_is_in_the_model_already_is_refused(stock):
    _, frame, model, new = stock
    with pytest.raises(RunError, match="would count twice"):
        update(update(model, new[:1]), new[:1])
    with pytest.raises(RunError, match="given twice"):
        update(model, [new[0], new[0]])
    with pytest.raises(RunError, match="no runs"):
        update(model, [])
    with pytest.raises(CrsError, match="keeps the model's plane"):
        update(model, new, crs="EPSG:28409")
    with pytest.raises(CrsError, match="no coordinate system"):
        update(model, new, crs="Atlantis")
    with pytest.raises(ModelError, match="half-life"):
        update(model, new, half_life=-1.0)
    assert frame == plane()


def test_a_run_on_another_line_is_refused(stock):
    axis, frame, model, _ = stock
    rng = np.random.default_rng(1)
    away = replace(axis, east=axis.east + 500.0, north=axis.north - 900.0)
    with pytest.raises(RunError, match="another line"):
        update(model, drives(away, frame, rng, 1, "away", 9))
    beside = axis.shifted(4.5)
    with pytest.raises(RunError, match=r"4\.\d m beside track up all the way"):
        update(model, drives(beside, frame, rng, 1, "beside", 9))


# ------------------------------------------------------------------------------------------------------------ movement


@pytest.fixture(scope="module")
def slewed():
    rng = np.random.default_rng(21)
    frame = plane()
    axis = centre_line(2, 3.0, frame=frame)
    model = build(drives(axis, frame, rng, 4, "old", 0))
    middle = 0.5 * axis.arc[-1]
    after = moved_axis(axis, middle, middle + 140.0, 0.15, ramp=40.0)
    new = drives(after, frame, rng, 3, "new", 10)
    return axis, after, middle, model, update(model, new), frame


def test_a_slew_is_found_and_forgotten(slewed):
    _axis, after, middle, model, refined, _ = slewed
    changes = last(refined)["tracks"][0]["changes"]
    assert [(c["verdict"], c["coordinate"]) for c in changes] == [("moved", "across")]
    assert abs(changes[0]["from_m"] - middle) < 50
    assert abs(changes[0]["to_m"] - middle - 140.0) < 50
    assert changes[0]["shift_m"] == pytest.approx(0.15, abs=0.04)
    assert any("has moved 1" in w for w in last(refined)["warnings"])
    k = knots(refined, "up")
    zone = (refined.offset[k] > middle + 40) & (refined.offset[k] < middle + 100)
    error, sigma = axis_error(refined, "up", after)
    old_error, _ = axis_error(model, "up", after)
    assert np.sqrt(np.mean(old_error[zone[: len(old_error)]] ** 2)) > 0.1
    assert np.sqrt(np.mean(error[zone] ** 2)) < 0.02
    assert np.median(sigma[zone]) > 1.2 * np.median(sigma)  # the new runs alone hold it


def test_the_difference_lists_what_an_update_found(slewed):
    _axis, _, middle, model, refined, _ = slewed
    found = difference(model, refined)
    assert found.relation == "update"
    assert not found.common.any()
    assert [(s.coordinate, s.found_by) for s in found.stretches] == [("across", "update")]
    assert found.stretches[0].first < middle + 10
    assert found.moved.sum() * 5.0 == pytest.approx(found.stretches[0].last - found.stretches[0].first, abs=11.0)
    back = difference(refined, model)
    assert back.stretches[0].shift == -found.stretches[0].shift
    assert any("second model is older" in w for w in back.warnings)


def test_the_difference_of_independent_builds_finds_the_slew_and_tells_the_datum_apart(slewed):
    _, after, middle, model, _, frame = slewed
    rng = np.random.default_rng(31)
    receiver = replace(SURVEY, offset=(0.4, -0.3, 0.2))  # another base station: the datum differs
    other = build(drives(after, frame, rng, 4, "later", 20, receiver=receiver), crs=model.frame.crs_wkt)
    if other.frame.pipeline != model.frame.pipeline:
        other = replace(other, frame=model.frame)
    found = difference(model, other)
    assert found.relation == "independent"
    assert found.common == pytest.approx([0.4, -0.3, 0.2], abs=0.03)
    across = [s for s in found.stretches if s.coordinate == "across"]
    assert len(across) == 1
    assert across[0].first - 40 < middle < across[0].last
    assert across[0].shift == pytest.approx(0.15, abs=0.04)
    rest = found.slew - found.common_slew
    assert np.nanmean((rest[~found.moved] / found.sigma_slew[~found.moved]) ** 2) < 2.0
    text = found.summary()
    assert text["moved"][0]["found_by"] == "window"
    # without stored chains single points must do
    bare = difference(replace(model, record_source=None), other)
    assert {s.found_by for s in bare.stretches} == {"points"}


def test_without_movement_nothing_is_found(stock):
    _axis, _frame, model, new = stock
    other = build(new, crs=model.frame.crs_wkt)
    other = replace(other, frame=model.frame)
    assert difference(model, other).stretches == ()
    assert difference(model, model).stretches == ()


def test_runs_that_contradict_each_other_are_set_aside(stock):
    axis, frame, model, _ = stock
    rng = np.random.default_rng(3)
    middle = 0.4 * axis.arc[-1]
    left, right = (moved_axis(axis, middle, middle + 120.0, s) for s in (-0.4, 0.4))
    new = drives(left, frame, rng, 1, "left", 10) + drives(right, frame, rng, 1, "right", 11)
    refined = update(model, new)
    verdicts = {c["verdict"] for c in last(refined)["tracks"][0]["changes"] if c["coordinate"] == "across"}
    assert verdicts == {"contradiction"}
    k = knots(refined, "up")
    zone = (refined.offset[k] > middle + 20) & (refined.offset[k] < middle + 100)
    error, _ = axis_error(refined, "up", axis)
    assert np.abs(error[zone]).max() < 0.03  # the stored axis stays
    assert all("contradicts the other runs here" in r["fixes"]["rejected"] for r in last(refined)["runs"])


def test_another_track_is_not_called_a_movement(stock):
    axis, frame, model, _ = stock
    rng = np.random.default_rng(4)
    middle = 0.4 * axis.arc[-1]
    siding = moved_axis(axis, middle, middle + 500.0, 4.5, ramp=120.0)
    refined = update(model, drives(siding, frame, rng, 1, "siding", 10))
    verdicts = {c["verdict"] for c in last(refined)["tracks"][0]["changes"] if c["coordinate"] == "across"}
    assert verdicts == {"another track"}
    k = knots(refined, "up")
    zone = (refined.offset[k] > middle + 150) & (refined.offset[k] < middle + 350)
    error, _ = axis_error(refined, "up", axis)
    assert np.abs(error[zone]).max() < 0.05


def test_a_wild_fix_is_a_gross_error_and_no_movement(stock):
    _, _, model, new = stock
    run = new[0]
    latitude = run.gnss.latitude.copy()
    latitude[300:302] += np.radians(3.0 / 111_000)
    refined = update(model, [changed(run, latitude=latitude)])
    assert last(refined)["tracks"][0]["changes"] == []
    assert last(refined)["runs"][0]["fixes"]["rejected"]["gross error across the track"]["count"] == 2


def test_a_run_over_a_part_refines_that_part(stock):
    axis, _, model, new = stock
    part = only(new[0], np.arange(len(new[0].gnss)) < len(new[0].gnss) // 2)
    refined = update(model, [part])
    k = knots(refined, "up")
    before = np.sqrt(
        np.interp(refined.offset[k], model.offset[knots(model, "up")], axis_error(model, "up", axis)[1] ** 2)
    )
    after = axis_error(refined, "up", axis)[1]
    n = len(after)
    assert np.median((after / before)[n // 10 : n // 4]) < 0.95
    assert np.median((after / before)[-n // 4 : -n // 10]) > 0.95


def test_records_pack_and_unpack():
    rng = np.random.default_rng(1)
    rows = rng.normal(size=(5, 15))
    rows[:, [0, 3, 5]] = np.abs(rows[:, [0, 3, 5]]) + 1.0
    rows[-1, 6:] = 0.0
    a = AxisRecords(rows, rng.normal(size=(5, 3, 2)), np.ones(4))
    b = AxisRecords.of(a.chain(), a.lean, a.noise)
    assert (a.rows == b.rows).all()


@pytest.mark.slow
def test_updates_of_one_run_each_stay_honest():
    """Errors that are alike over a kilometre: a stored chain ties neighbours only, and must not take them for many."""
    nees, square = [], []
    for seed in range(720, 726):
        rng, frame = np.random.default_rng([seed, 77]), plane()
        axis = centre_line(seed, 2.5, frame=frame)
        runs = drives(axis, frame, rng, 7, "run", 0, stop=0.0)
        model = build(runs[:3])
        first = axis_error(model, "up", axis)[0]
        for run in runs[3:]:
            model = update(model, [run])
        error, sigma = axis_error(model, "up", axis)
        nees.append(np.mean((error / sigma)[20:-20] ** 2))
        square.append(np.mean(error[20:-20] ** 2) / np.mean(first[20:-20] ** 2))
    assert 0.6 < np.mean(nees) < 1.4  # 1.7 if every merge is believed
    assert np.mean(square) < 0.95


@pytest.mark.parametrize("known", [True, False])
def test_a_merged_axis_keeps_the_variance_it_is_told_to(known):
    rng = np.random.default_rng(2)
    chain = chain_of(rng, 2, 60)
    swept = sweep(chain)
    C = 1e-4 * np.eye(4)
    estimate = solve(chain, swept, np.zeros(4), C, sure=True)
    M = mean_of(range(2), [0.5, 0.5], 4, 2)
    plain = keep_axis(estimate, C, M, chain.noise).chain().solve().covariance[:, 0, 0]
    least = np.where(np.arange(60) < 30, 4.0, 0.25) * plain
    kept = keep_axis(estimate, C, M, chain.noise, least=least if known else None).chain().solve().covariance[:, 0, 0]
    assert np.allclose(kept, np.maximum(least, plain) if known else plain, rtol=1e-6)


def test_sizes_of_changes_are_told_in_millimetres_or_metres():
    from railnav.survey.update_report import _words

    part = {
        "from_m": 10.0,
        "to_m": 90.0,
        "coordinate": "across",
        "verdict": "moved",
        "shift_m": -0.012,
        "sigma_m": 0.0021,
        "runs": [],
    }
    assert "has moved 12 mm to the left (sigma 2 mm)" in _words("up", part)
    far = {**part, "verdict": "another track", "shift_m": 63.291, "sigma_m": 3.437}
    assert "lie 63.3 m to the right (sigma 3.4 m), farther than tracks are moved" in _words("up", far)
