"""Every named fault, and what the navigator owes to it: an error inside its bound, never sure of a wrong track, and a word where it can."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import railnav as rn
from railnav.errors import InputError
from railnav.simulation import (
    FAULTS,
    MODEL_FAULTS,
    SERVICE,
    BaliseSensor,
    Leg,
    model_with_fault,
    with_fault,
    with_shifted_model,
)
from railnav.simulation.faults import Fault

#: Faults that the navigator does not master yet; `docs/accuracy.md` says so.
NOT_YET: set[str] = set()

ONSET = 130.0
SEEDS = (3, 4)
#: Rows whose error may exceed a bound stated for 1e-4 an epoch, of some 3,200 that are not independent.
BEYOND = 3


@pytest.fixture(scope="module")
def line():
    return rn.demo_line()


@pytest.fixture(scope="module")
def rides(line):
    """Five minutes on the right track of a double line, 4 m from the other, under open sky; simulated."""
    leg = Leg(("77R-03",), start=200.0, finish=7000.0)
    outfit = replace(SERVICE, balise=BaliseSensor())
    recorded = {seed: rn.simulate(line, leg, seed=seed, outfit=outfit, tunnels=False) for seed in SEEDS}
    return {
        subject: {
            seed: (run if subject == "balise" else replace(run, balise=None), truth)
            for seed, (run, truth) in recorded.items()
        }
        for subject in ("gnss", "odometer", "imu", "balise")
    }


def judged(run, truth, model):
    solution = rn.navigate(run, model)
    return solution, rn.evaluate(solution, truth, model=model)


def keeps_the_pact(solution, evaluation):
    """Errors inside the bound, and no wrong track named with confidence."""
    assert evaluation.selection.wrong_while_tracking == 0
    assert evaluation.integrity.events <= BEYOND, f"worst {evaluation.integrity.largest_ratio:.1f} times the bound"
    assert evaluation.jumps.illegal == ()


def as_they_stand(faults: dict[str, Fault]):
    """Faults as parameters; those not mastered must fail."""
    mark = pytest.mark.xfail(raises=AssertionError, strict=True, reason="not mastered yet")
    return [pytest.param(f, marks=[mark] if f.name in NOT_YET else []) for f in faults.values()]


@pytest.mark.parametrize("fault", as_they_stand(FAULTS), ids=lambda f: f.name)
def test_the_navigator_keeps_its_pact_under_every_fault(line, rides, fault: Fault):
    for seed, (run, truth) in rides[fault.subject].items():
        solution, evaluation = judged(with_fault(run, fault.name, start=ONSET, seed=seed), truth, line)
        keeps_the_pact(solution, evaluation)
        if fault.expected == "unharmed":
            _, sound = judged(run, truth, line)
            assert evaluation.along_statistics.rms < 2.0 * sound.along_statistics.rms
        if fault.expected == "flagged":
            window = (solution.time >= ONSET) & (solution.time <= ONSET + fault.duration + 60.0)
            assert set(solution.mode[window]) & {rn.Mode.COASTING, rn.Mode.AMBIGUOUS, rn.Mode.OFF_MODEL, rn.Mode.LOST}


def test_a_sound_run_is_tracked_closely(line, rides):
    for run, truth in rides["gnss"].values():
        solution, evaluation = judged(run, truth, line)
        keeps_the_pact(solution, evaluation)
        assert evaluation.along_statistics.rms < 1.0
        assert np.mean(solution.mode[solution.time > ONSET] == rn.Mode.TRACKING) > 0.9


FLAGS = {rn.Mode.COASTING, rn.Mode.AMBIGUOUS, rn.Mode.OFF_MODEL, rn.Mode.LOST}


@pytest.mark.parametrize("fault", as_they_stand(MODEL_FAULTS), ids=lambda f: f.name)
def test_a_model_out_of_date_never_makes_the_navigator_sure_of_a_wrong_track(line, rides, fault: Fault):
    stale = model_with_fault(line, fault.name, "77R-03", start=3000.0)
    for run, truth in rides["gnss"].values():
        if fault.name == "track-missing":
            solution = rn.navigate(run, stale)
            assert np.mean(np.isin(solution.mode, list(FLAGS))) > 0.5
            continue
        solution, evaluation = judged(run, truth, stale)
        keeps_the_pact(solution, evaluation)
        if fault.expected == "flagged":
            assert set(solution.mode[solution.time > 60.0]) & FLAGS


@pytest.mark.parametrize("aside", [2.0, -2.0])
def test_a_model_in_a_mistaken_frame(line, rides, aside):
    for run, truth in rides["gnss"].values():
        keeps_the_pact(*judged(run, truth, with_shifted_model(line, east=aside, north=0.0)))


def test_a_balise_read_under_another_name_moves_nothing(line, rides):
    for seed, (run, truth) in rides["balise"].items():
        _, evaluation = judged(with_fault(run, "balise-misnamed", start=ONSET, seed=seed), truth, line)
        assert np.abs(evaluation.along).max() < 10.0


def test_a_dead_wheel_does_not_stop_a_train_that_still_rolls(line):
    """The wheel's rest was taken for the train's at 0.7 m/s: 2 m at once, and 101 rows beyond the bound."""
    run, truth = rn.simulate(
        line, Leg(("77R-03",), start=200.0, finish=7000.0), seed=305, outfit=SERVICE, tunnels=False
    )
    keeps_the_pact(*judged(with_fault(run, "odometer-dead", start=ONSET, seed=305), truth, line))


def test_unknown_faults_of_a_model_are_refused(line):
    with pytest.raises(InputError, match="no fault 'gremlins' of a model"):
        model_with_fault(line, "gremlins", "77R-03", start=0.0)


def test_faults_leave_the_sound_run_alone_and_touch_one_stream(rides):
    run, _ = rides["balise"][SEEDS[0]]
    for name, fault in FAULTS.items():
        spoilt = with_fault(run, name, start=ONSET)
        for stream in ("gnss", "imu", "odometer", "balise"):
            same = getattr(spoilt, stream) is getattr(run, stream)
            assert same == (stream != fault.subject), name
        time = getattr(spoilt, fault.subject).time
        assert np.all(np.diff(time) > 0.0), name
        if not fault.whole_run:
            before = int(np.searchsorted(time, ONSET - 3.0))
            for column in ("latitude", "distance", "gyro", "specific_force"):
                old, new = (getattr(getattr(r, fault.subject), column, None) for r in (run, spoilt))
                if old is not None:
                    np.testing.assert_array_equal(old[:before], new[:before], err_msg=name)


def test_sixty_faults_have_names():
    assert len(FAULTS) >= 60


def test_unknown_and_impossible_faults_are_refused(rides):
    run, _ = rides["balise"][SEEDS[0]]
    with pytest.raises(InputError, match="no fault 'gremlins'"):
        with_fault(run, "gremlins", start=1.0)
    with pytest.raises(InputError, match="lies outside the run"):
        with_fault(run, "gnss-silent-60s", start=1e6)
