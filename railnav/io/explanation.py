"""Decisions of the navigator as a file: JSON lines, one decision a line, or CSV, one candidate a row."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from railnav.errors import InputError
from railnav.io.atomic import atomic_path
from railnav.navigation.explanation import EVIDENCE, Candidate, Decision

#: Endings that name a format.
EXPLANATION_ENDINGS = (".jsonl", ".csv")
_DECISION = ("time_s", "kind", "track", "probability", "mode")
_CANDIDATE = (
    "candidate",
    "candidate_offset_m",
    "candidate_direction",
    "candidate_probability",
    "candidate_speed_m_s",
    "candidate_sigma_along_m",
    "against",
)


def write_decisions(decisions: Sequence[Decision], path: str | Path) -> None:
    """Write why tracks were chosen, as .jsonl or .csv by the ending, whole or not at all.

    Parameters
    ----------
    decisions : sequence of Decision
        As `railnav.navigate` gives them in `explain`.
    path : path
        File to write; replaced in one step if it exists.

    Raises
    ------
    InputError
        The ending is neither, or the file cannot be written.

    Notes
    -----
    Times in seconds, offsets and sigmas in metres, speeds in m/s. Evidence is in nats relative to the best candidate of the decision:
    -7 makes a candidate a thousand times less likely. `against` names the kind of evidence that spoke most against a candidate.

    Examples
    --------
    >>> write_decisions([], "why.txt")
    Traceback (most recent call last):
    railnav.errors.InputError: why.txt: an explanation cannot be written as .txt; use .jsonl or .csv
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in EXPLANATION_ENDINGS:
        cause = f"an explanation cannot be written as {ending or 'a file without ending'}"
        raise InputError(cause, file=path, remedy="use .jsonl or .csv")
    with atomic_path(path) as draft:
        if ending == ".jsonl":
            with draft.open("w", encoding="utf-8") as file:
                for decision in decisions:
                    told = {**_head(decision), "candidates": [_candidate(one) for one in decision.candidates]}
                    file.write(json.dumps(told, ensure_ascii=False) + "\n")
            return
        with draft.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow([*_DECISION, *_CANDIDATE, *(f"evidence_{name}" for name in EVIDENCE)])
            for decision in decisions:
                for one in decision.candidates:
                    said = _candidate(one)
                    evidence = said.pop("evidence")
                    writer.writerow([*_head(decision).values(), *said.values(), *evidence.values()])


def _head(decision: Decision) -> dict[str, Any]:
    """What a decision says, with units in the names, rounded to what matters."""
    return {
        "time_s": round(decision.time, 6),
        "kind": decision.kind,
        "track": decision.track,
        "probability": round(decision.probability, 9),
        "mode": decision.mode,
    }


def _candidate(one: Candidate) -> dict[str, Any]:
    """A candidate of a decision, likewise."""
    return {
        "track": one.track,
        "offset_m": round(one.offset, 3),
        "direction": one.running_direction,
        "probability": round(one.probability, 9),
        "speed_m_s": round(one.speed, 4),
        "sigma_along_m": round(one.sigma_along, 4),
        "against": one.against,
        "evidence": {name: round(nats, 3) for name, nats in one.evidence.items()},
    }
