"""The corrector of a few numbers: same interface as Navigator, honest bounds, never sure of a wrong track, all of a run's ways."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from railnav.errors import OffModelError, RunError
from railnav.evaluation import evaluate
from railnav.navigation import Epoch, Mode, Navigator, epochs
from railnav.navigation.schemes.arc import ArcGains, ArcNavigator
from railnav.navigation.schemes.arc_run import navigate_arc
from railnav.simulation import PHONE, SERVICE, demo_line, simulate


@pytest.fixture(scope="module")
def line():
    return demo_line()


@pytest.fixture(scope="module")
def drives(line):
    """A drive over crossovers, a station and a junction to the branch, with three outfits' worth of errors."""
    way = line.routes("77R-01", "78-01", at_most=1)[0]
    return {
        (name, seed): simulate(line, way, seed=seed, outfit=outfit)
        for name, outfit in (("service", SERVICE), ("phone", PHONE))
        for seed in (1, 2, 3)
    }


def test_errors_bounds_and_tracks(line, drives):
    for (name, seed), (run, truth) in drives.items():
        found = evaluate(navigate_arc(run, line), truth)
        assert found.along_statistics.rms < (2.5 if name == "service" else 4.5), (name, seed)
        assert found.selection.tracking_right == found.selection.tracking, (name, seed)  # sure of none that is wrong
        assert found.selection.tracking > 150
        assert found.integrity.events == 0, (name, seed)
        assert found.consistency.nees < 3.0
        assert found.positioned > 0.9 * found.epochs


def test_step_by_step_is_the_batch(line, drives):
    run, _ = drives["service", 1]
    whole = navigate_arc(run, line)
    live = ArcNavigator(line, odometer="distance", lever_arm_b=run.gnss.lever_arm_b)
    compared = 0
    for i, epoch in enumerate(epochs(run)):
        here = live.step(epoch)
        if i % 500 == 0 and here.track is not None:
            assert here.offset == whole.offset[i]
            assert here.track == line.track_id[whole.track[i]]
            assert here.mode == whole.mode[i]
            compared += 1
        if i > 3000:
            break
    assert compared >= 5


def test_the_interface_is_the_navigators(line):
    ours, other = ArcNavigator(line), Navigator(line, imu=False, odometer="")
    a, b = ours.step(Epoch(0.0)), other.step(Epoch(0.0))
    assert type(a) is type(b)
    assert a.mode == b.mode == Mode.INITIALISING
    assert a.track is None
    assert ours.model is line
    with pytest.raises(RunError, match="not later"):
        ours.step(Epoch(0.0))


def exact_epochs(line, tracks, speed=20.0, sigma=1.0, first=50.0, count=60):
    """Exact fixes of a train that runs through tracks in the sense of their offsets."""
    lengths = [line.length(t) for t in tracks]
    edges = np.append(0.0, np.cumsum(lengths))
    for k in range(count):
        s = first + speed * k
        i = min(int(np.searchsorted(edges, s, side="right")) - 1, len(tracks) - 1)
        p = line.at(tracks[i], min(s - edges[i], lengths[i]))
        latitude, longitude, _ = line.frame.to_geodetic(p.easting, p.northing, p.height)
        yield (
            s,
            Epoch(
                float(k),
                latitude=float(latitude),
                longitude=float(longitude),
                sigma_east=sigma,
                sigma_north=sigma,
                speed=speed,
                course=float(p.heading),
            ),
        )


def test_exact_fixes_are_followed_through_a_turnout_both_ways(line):
    forks = {}
    for a, end_a, b, _ in line.movements.tolist():
        forks.setdefault((a, end_a), []).append(b)
    (track, _), ways = next((k, v) for k, v in forks.items() if k[1] == 1 and len(v) > 1 and line.lengths[k[0]] > 400)
    for after in ways:
        tracks = [line.track_id[track], line.track_id[after]]
        live = ArcNavigator(line)
        seen = set()
        for s, epoch in exact_epochs(line, tracks, first=line.length(tracks[0]) - 300.0, count=20):
            here = live.step(epoch)
            seen.add(here.track)
            if here.track == tracks[0]:
                assert here.offset == pytest.approx(s, abs=2.0)
        assert tracks[1] in seen
        assert here.speed == pytest.approx(20.0, abs=0.5)


def test_two_tracks_side_by_side_stay_ambiguous(line):
    """A fix of 4 m on a double line tells no track from its neighbour; the bound covers both."""
    live = ArcNavigator(line)
    for _, epoch in exact_epochs(line, ["77R-01"], sigma=4.0, first=300.0, count=20):
        here = live.step(epoch)
    assert here.mode == Mode.AMBIGUOUS
    assert {here.track, *(a.track for a in here.alternatives)} >= {"77R-01", "77L-01"}
    assert here.track_probability + sum(a.probability for a in here.alternatives) == pytest.approx(1.0, abs=1e-3)
    assert here.protection_level_along > 3.9 * here.sigma_along


def test_without_fixes_sigma_grows_and_the_mode_says_so(line):
    live = ArcNavigator(line)
    for _, epoch in exact_epochs(line, ["77R-01"], speed=5.0, sigma=0.2, first=100.0, count=20):
        here = live.step(epoch)
    last = here
    for k in range(1, 20):
        here = live.step(Epoch(19.0 + k))
        assert here.sigma_along >= last.sigma_along
        last = here
    assert here.mode == Mode.COASTING
    assert here.sigma_along > 5.0


def test_wild_fixes_do_not_move_it_and_a_lost_train_says_so(line):
    live = ArcNavigator(line)
    rows = list(exact_epochs(line, ["77R-01"], sigma=1.0, first=300.0, count=40))
    for i, (_, epoch) in enumerate(rows[:20]):
        wild = replace(epoch, latitude=epoch.latitude + 1e-4) if i == 15 else epoch
        before = live.step(wild)
    assert abs(before.offset - rows[19][0]) < 2.0
    for _, epoch in rows[20:34]:
        here = live.step(replace(epoch, latitude=epoch.latitude + 1e-2))
    assert here.mode == Mode.LOST
    assert here.track is None


def test_bad_requests(line, drives):
    with pytest.raises(ValueError, match="integrity_risk"):
        ArcNavigator(line, integrity_risk=0.9)
    with pytest.raises(ValueError, match="odometer"):
        ArcNavigator(line, odometer="wheel")
    run, _ = drives["phone", 1]
    away = replace(run, gnss=replace(run.gnss, latitude=run.gnss.latitude + 0.1))
    with pytest.raises(OffModelError, match="never near"):
        navigate_arc(away, line)
    assert ArcGains().memory == 10.0
