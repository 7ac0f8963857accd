"""Fix or link: contradictions within a run are told apart by two clones, and the build does what follows from it."""

from dataclasses import replace

import numpy as np
import pytest
from survey_simulator import Gyros, axis_error, centre_line, drive, plane

from railnav.survey import build, update
from railnav.survey.attribution import attribute
from railnav.survey.fixes import LINKS, USED, gather

FRAME = plane()


def ridden(seed, *, passes=1, **options):
    """Drives with gyros and odometer, and a fix in the middle of a way without a stop."""
    rng = np.random.default_rng([seed, 177])
    axis = centre_line(seed, 3.0, frame=FRAME)
    runs = [
        drive(axis, FRAME, rng, run_id=f"r{p}", direction="up", day=p, gyros=Gyros(), stop=20.0, **options)
        for p in range(passes)
    ]
    moved = np.diff(runs[0].odometer.distance, prepend=0.0)
    steady = [i for i in range(150, len(moved) - 200) if moved[i - 60 : i + 160].min() > 1.0]
    return runs, axis, int(rng.choice(steady))


def north(run, rows, metres):
    latitude = run.gnss.latitude.copy()
    latitude[rows] += metres / 6.37e6
    return replace(run, gnss=replace(run.gnss, latitude=latitude))


def slipped(run, time, metres):
    odometer = run.odometer
    return replace(run, odometer=replace(odometer, distance=odometer.distance + metres * (odometer.time >= time)))


def turned(run, time, angle):
    angles = run.gyro_angles
    return replace(run, gyro_angles=replace(angles, heading=angles.heading + angle * (angles.time >= time)))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_bad_fix_is_called_so_and_set_aside(seed):
    (run,), _, i = ridden(seed)
    fixes = gather(north(run, i, 0.3), FRAME)
    (found,) = attribute(fixes).found
    assert (found.wrong, found.first, found.last) == ("fix", i, i)
    assert found.size == pytest.approx(0.3, abs=0.06)
    assert found.evidence > 20.0
    assert found.statistic > found.limit
    assert list(np.flatnonzero(fixes.reason == LINKS)) == [i]
    assert np.count_nonzero(fixes.reason == USED) == len(fixes) - 1


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_an_odometer_that_slips_is_a_link(seed):
    (run,), _, i = ridden(seed)
    fixes = gather(slipped(run, run.gnss.time[i], 0.4), FRAME)
    (found,) = attribute(fixes).found
    assert (found.wrong, found.first, found.last) == ("link", i - 1, i)
    assert found.size == pytest.approx(0.4, abs=0.08)
    assert (fixes.reason == USED).all()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_gyro_that_jumps_is_a_link_found_where_it_jumped(seed):
    """5 mrad show as metres only later on; the break is sought back to where it explains the fixes best."""
    (run,), _, i = ridden(seed)
    (found,) = attribute(gather(turned(run, run.gnss.time[i], 0.005), FRAME)).found
    assert found.wrong == "link"
    assert abs(found.last - i) <= 8


@pytest.mark.parametrize("seed", [1, 2])
def test_fixes_that_stand_beside_for_a_while_are_fixes_for_no_slip_undoes_itself(seed):
    (run,), _, i = ridden(seed)
    fixes = gather(north(run, slice(i, i + 100), 0.3), FRAME)
    (found,) = attribute(fixes).found
    assert (found.wrong, found.first, found.last) == ("fix", i, i + 99)
    assert np.count_nonzero(fixes.reason == LINKS) == 100


def test_good_runs_have_no_verdicts():
    """1e-7 a fix: ten runs of some 700 fixes have none, in a thousand such sets one."""
    for seed in range(10):
        (run,), _, _ = ridden(20 + seed)
        found = attribute(gather(run, FRAME))
        assert found.found == ()
        assert found.judged > 500


def test_without_increments_nothing_is_judged():
    (run,), _, _ = ridden(4)
    assert attribute(gather(replace(run, odometer=None), FRAME)).judged == 0
    assert attribute(gather(replace(run, gyro_angles=None), FRAME)).judged == 0


def test_a_run_whose_increments_are_not_its_own_is_not_judged_but_told():
    (run,), _, _ = ridden(5)
    angles = run.gyro_angles
    wrong = replace(run, gyro_angles=replace(angles, heading=angles.heading + 0.3 * np.sin(angles.time)))
    fixes = gather(wrong, FRAME)
    found = attribute(fixes)
    assert found.found == ()
    assert "neither is judged by the other" in found.unsure
    assert (fixes.reason == USED).all()


def test_the_build_survives_slips_and_tells_them():
    """A gyro that jumps by 10 mrad and an odometer that slips by 1 m, of one of two runs through a tunnel."""
    runs, axis, _ = ridden(6, passes=2, tunnels=((0.45, 0.55),))
    jump, slip = float(runs[0].gnss.time[len(runs[0].gnss) // 4]), float(runs[0].gnss.time[-200])
    model = build([slipped(turned(runs[0], jump, 0.010), slip, 1.0), runs[1]])
    error, sigma = axis_error(model, "up", axis)
    inner = slice(20, -20)
    assert np.sqrt(np.mean(error[inner] ** 2)) < 0.015
    assert np.mean((error[inner] / sigma[inner]) ** 2) < 4.0
    told = [v for v in model.provenance["build"]["verdicts"]["list"] if v.get("evidence") is not None]
    assert [(v["what"], v["run"], v["unit"]) for v in told] == [("link", "r0", "m")] * 2
    assert sorted(v["time_s"] for v in told) == pytest.approx([jump, slip], abs=2.0)
    assert all(v["evidence"] > 20 and v["statistic"] > v["limit"] and v["offset_m"] > 0 for v in told)


def test_the_build_tells_a_bad_fix_with_its_evidence():
    runs, _, i = ridden(7, passes=2)
    model = build([north(runs[0], i, 0.3), runs[1]])
    told = [v for v in model.provenance["build"]["verdicts"]["list"] if v.get("evidence") is not None]
    assert [(v["what"], v["fixes"], v["reason"]) for v in told] == [
        ("fix", 1, "contradicts the run's own odometer and gyroscopes")
    ]
    assert told[0]["time_s"] == pytest.approx(runs[0].gnss.time[i])
    run = model.provenance["build"]["runs"][0]
    assert run["fixes"]["rejected"]["contradicts the run's own odometer and gyroscopes"]["count"] == 1


def test_base_stations_far_off_are_believed_where_they_say_so():
    """Stated sigmas grow from 10 to 130 mm along the run, and errors with them: no good fix is called bad."""
    for seed in range(3):
        rng = np.random.default_rng([seed, 9])
        (run,), _, _ = ridden(40 + seed)
        sigma = np.linspace(0.010, 0.130, len(run.gnss))
        stated = np.hypot(0.017, sigma)
        latitude = run.gnss.latitude + rng.standard_normal(len(sigma)) * sigma / 6.37e6
        longitude = run.gnss.longitude + rng.standard_normal(len(sigma)) * sigma / 4.1e6
        far = replace(run.gnss, latitude=latitude, longitude=longitude, sigma_east=stated, sigma_north=stated)
        found = attribute(gather(replace(run, gnss=far), FRAME))
        assert found.judged > 500
        assert found.found == ()
        bad = north(replace(run, gnss=far), 100, 0.4)
        assert [(a.wrong, a.first) for a in attribute(gather(bad, FRAME)).found] == [("fix", 100)]


def test_what_a_fix_weighs_across_depends_on_where_the_track_goes():
    """Stated 1 cm east and 4 cm north: a fix on a track to the east weighs 4 cm, on one to the north 1 cm."""
    from railnav.survey.nominal import curve
    from railnav.survey.profiles import profiles, traverse

    (run,), axis, _ = ridden(8)
    m = len(run.gnss)
    told = replace(run.gnss, sigma_east=np.full(m, 0.01), sigma_north=np.full(m, 0.04), sigma_up=np.full(m, 0.05))
    fixes = gather(replace(run, gnss=told), FRAME)
    nominal = curve(axis.east[::5], axis.north[::5], 5.0)
    laid = profiles([traverse(nominal, fixes, 60.0)], len(nominal), nominal.step)
    e, n = nominal.normal
    hit = laid.count[0] > 0
    np.testing.assert_allclose(laid.sigma[0, hit], np.hypot(0.01 * e, 0.04 * n)[hit], rtol=0.02)
    np.testing.assert_allclose(laid.height_sigma[0, hit], 0.05)


def test_the_update_tells_new_attributions_with_their_evidence():
    """A slip and a bad fix of the new run, at their places on the stored track; the run that is as good as the old ones has none."""
    runs, _, i = ridden(8, passes=4)
    at = float(runs[2].gnss.time[-200])
    spoilt = slipped(north(runs[2], i, 0.3), at, 1.0)
    model = update(build(runs[:2]), [spoilt, runs[3]])
    verdicts = model.provenance["updates"][-1]["verdicts"]
    told = {v["what"]: v for v in verdicts["list"] if v.get("evidence") is not None}
    assert set(told) == {"fix", "link"}
    assert verdicts["total"] >= 2
    for v in told.values():
        assert (v["run"], v["track"]) == ("r2", "up")
        assert v["evidence"] > 20
        assert v["statistic"] > v["limit"]
    assert told["link"]["time_s"] == pytest.approx(at, abs=2.0)
    assert told["fix"]["time_s"] == pytest.approx(float(runs[2].gnss.time[i]), abs=0.01)
    here = model.at("up", told["fix"]["offset_m"])
    assert (
        np.hypot(float(here.easting) - told["fix"]["easting_m"], float(here.northing) - told["fix"]["northing_m"]) < 1.0
    )
