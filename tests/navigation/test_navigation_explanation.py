"""Candidates and decisions: what the solution says besides its best guess, and why."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from railnav.errors import InputError
from railnav.io.explanation import write_decisions
from railnav.io.solution import read_solution, write_alternatives
from railnav.navigation import Mode, Navigator, epochs, navigate
from railnav.navigation.explanation import EVIDENCE
from railnav.simulation import SERVICE, Leg, simulate


@pytest.fixture(scope="module")
def explained(line):
    """A train over a facing crossover to the other track: solution and decisions."""
    run, truth = simulate(
        line, Leg(("77R-01", "77X-01", "77L-02", "77L-03"), start=100.0, finish=900.0), seed=3, outfit=SERVICE
    )
    decisions = []
    return run, truth, navigate(run, line, explain=decisions), decisions


def test_the_candidates_of_a_row_are_told_apart_and_hold_its_track(explained):
    _, _, solution, _ = explained
    told = solution.alternatives
    assert len(told) > 0
    for row in np.unique(told.row):
        mine = told.row == row
        assert len(set(told.track[mine])) == mine.sum() > 1  # each track once, more than one
        assert (np.diff(told.probability[mine]) <= 1e-12).all()
        assert 0.99 < told.probability[mine].sum() <= 1.0 + 1e-9
        if solution.track[row] >= 0:
            assert solution.track[row] in told.track[mine]
    uncertain = np.flatnonzero(solution.mode == Mode.AMBIGUOUS)
    assert np.isin(uncertain, told.row).all()


def test_what_explains_a_decision_is_its_log_odds(explained):
    """The ledger is the whole of a weight: differences between candidates are their log odds."""
    _, _, _, decisions = explained
    assert {"declared", "changed"} <= {d.kind for d in decisions}
    checked = 0
    for decision in decisions:
        best = decision.candidates[0]
        assert best.against == ""
        assert set(best.evidence) == set(EVIDENCE)
        for other in decision.candidates[1:]:
            if other.probability > 1e-12 and other.running_direction == best.running_direction:
                checked += 1
                odds = np.log(other.probability / best.probability)
                assert sum(other.evidence.values()) == pytest.approx(odds, abs=0.1)
    assert checked > 5


def test_a_crossing_is_decided_by_what_turns_the_train(explained):
    _, _, _, decisions = explained
    over = [d for d in decisions if d.track == "77X-01"]
    assert over
    losers = [c for d in over for c in d.candidates if c.track != "77X-01" and c.probability < 0.5]
    assert losers
    assert {c.against for c in losers} <= {"yaw_rate", "side_force", "gnss_course", "gnss_position", "path"}


def test_explaining_changes_nothing(explained, line):
    run, _, solution, _ = explained
    again = navigate(run, line)
    assert np.array_equal(solution.offset, again.offset, equal_nan=True)
    assert np.array_equal(solution.track_probability, again.track_probability, equal_nan=True)


def test_the_live_navigator_tells_its_candidates(explained, line):
    run, _, _, _ = explained
    navigator = Navigator(line, lever_arm_b=run.gnss.lever_arm_b)
    for i, epoch in enumerate(epochs(run)):
        position = navigator.step(epoch)
        if i == 40:
            break
    told = navigator.candidates()
    assert sum(c.probability for c in told) == pytest.approx(1.0)
    assert position.track in {c.track for c in told}


def test_decisions_and_candidates_as_files(explained, tmp_path):
    _, _, solution, decisions = explained
    write_decisions(decisions, tmp_path / "why.jsonl")
    lines = [json.loads(line) for line in (tmp_path / "why.jsonl").read_text().splitlines()]
    assert [line["kind"] for line in lines] == [d.kind for d in decisions]
    write_decisions(decisions, tmp_path / "why.csv")
    with (tmp_path / "why.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == sum(len(d.candidates) for d in decisions)
    assert rows[0]["time_s"] == str(lines[0]["time_s"])
    assert float(rows[1]["evidence_gnss_position"]) == lines[0]["candidates"][1]["evidence"]["gnss_position"]
    write_alternatives(solution, tmp_path / "a.csv")
    with (tmp_path / "a.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(solution.alternatives)
    solution.to_file(tmp_path / "s.gpkg")
    back = read_solution(tmp_path / "s.gpkg")
    assert np.array_equal(back.alternatives.row, solution.alternatives.row)
    assert [back.track_id[t] for t in back.alternatives.track] == [
        solution.track_id[t] for t in solution.alternatives.track
    ]
    assert back.alternatives.probability == pytest.approx(solution.alternatives.probability)
    with pytest.raises(InputError, match=r"use \.jsonl or \.csv"):
        write_decisions(decisions, tmp_path / "why.txt")
