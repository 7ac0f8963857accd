"""Updates and differences of models in words, and a difference as a table or as points and lines for a map."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from railnav.cli._terminal import print_facts, print_table, print_warnings
from railnav.web import words

if TYPE_CHECKING:
    from railnav.survey.difference import Difference
    from railnav.track.model import TrackModel

#: Gross errors of an update that are printed; `--json` and the model hold up to 300.
MOST_GROSS = 12


def _mm(value: float | None) -> str:
    return "" if value is None else f"{value * 1e3:.1f} mm" if abs(value) < 1.0 else f"{value:.2f} m"


def print_update(entry: dict[str, Any], title: str) -> None:
    """Print what an update says of itself."""
    print_facts(
        title,
        {
            "runs": len(entry["runs"]),
            "tracks refined": len(entry["tracks"]),
            "weight of what was stored": f"{100 * entry['weight_of_stored']:.0f} %",
        },
    )
    print_table(
        "Runs",
        ("run", "receiver", "tracks", "fixes", "used", "frame east", "north"),
        [
            (
                r["id"], r["receiver"], ", ".join(r["tracks"]), r["fixes"]["total"], r["fixes"]["used"],
                _mm(r["frame_offset"]["east_m"]), _mm(r["frame_offset"]["north_m"]),
            )
            for r in entry["runs"]
        ],
        left=3,
    )  # fmt: skip
    print_table(
        "Tracks",
        ("track", "length", "new", "sigma before", "sigma now", "axis changed, RMS", "most", "moved stretches"),
        [
            (
                t["track"], words.length(t["length_m"], 5), _new(t), _mm(t["sigma_before_m"]), _mm(t["sigma_m"]),
                _mm(t["change_rms_m"]), _mm(t["change_max_m"]), sum(c["verdict"] == "moved" for c in t["changes"]),
            )
            for t in entry["tracks"]
        ],
    )  # fmt: skip
    print_table(
        "Beyond the model",
        ("run", "where", "length", "fixes", "became"),
        [
            (way["run"], way["where"], words.length(way["length_m"], 4), way["fixes"], way["became"] or "nothing yet")
            for way in entry["beyond"]
        ],
        left=2,
    )
    verdicts = entry.get("verdicts") or {"total": 0, "list": []}
    gravest = verdicts["list"][:MOST_GROSS]
    print_table(
        "Gross errors" if len(gravest) == verdicts["total"] else f"Gross errors: {verdicts['total']:,} set aside, the gravest",
        ("what", "run", "track", "why", "time, s", "offset, m", "fixes", "size", "evidence"),
        [
            (
                v["what"], v["run"], v["track"], v["reason"], "" if v["time_s"] is None else f"{v['time_s']:,.1f}",
                "" if v["offset_m"] is None else f"{v['offset_m']:,.0f}", v["fixes"] or "", words.length(v["size"], 3),
                "" if v.get("evidence") is None else f"{v['evidence']:.0f}",
            )
            for v in gravest
        ],
        left=4,
    )  # fmt: skip
    print_warnings(entry["warnings"])


def _new(track: dict[str, Any]) -> str:
    """How much of a track is new."""
    return words.length(track["new_m"], 4) if track["new_m"] else ""


def print_difference(found: Difference, title: str) -> None:
    """Print where tracks lie elsewhere."""
    told = found.summary()
    relation = {
        "update": "the second was refined from the first",
        "shared": "runs in common",
        "independent": "from different runs",
    }[found.relation]
    common = told["common_shift"]
    print_facts(
        title,
        {
            "models": relation,
            "common shift": "none: one datum"
            if found.relation == "update"
            else f"{_mm(common['east_m'])} east, {_mm(common['north_m'])} north, {_mm(common['up_m'])} up (datums; taken off)",
        },
    )
    print_table(
        "Tracks",
        ("track", "compared with", "slew RMS", "most", "sigma", "lift RMS", "most ", "sigma ", "moved"),
        [
            (
                t["track"], t["partner"], _mm(t["slew_rms_m"]), _mm(t["slew_max_m"]), _mm(t["sigma_slew_m"]), _mm(t["lift_rms_m"]),
                _mm(t["lift_max_m"]), _mm(t["sigma_lift_m"]), f"{t['moved_m']:.0f} m",
            )
            for t in told["tracks"]
        ],
        left=2,
    )  # fmt: skip
    print_table(
        "Moved",
        ("track", "what", "from, m", "to, m", "by", "sigma", "chi-square", "limit"),
        [
            (
                s.track, _sense(s.coordinate, s.shift), f"{s.first:.0f}", f"{s.last:.0f}", _mm(abs(s.shift)), _mm(s.sigma),
                f"{s.statistic:.0f}", f"{s.limit:.0f}",
            )
            for s in found.stretches
        ],
        left=2,
    )  # fmt: skip
    if not found.stretches:
        print("No stretch has moved by more than the errors explain.")  # noqa: T201 - words for the terminal
    missing = [f"track {t} is in the first model only" for t in found.only_old]
    missing += [f"track {t} is in the second model only" for t in found.only_new]
    print_warnings([*found.warnings, *missing])


def _sense(coordinate: str, shift: float) -> str:
    return (
        ("to the right" if shift > 0 else "to the left") if coordinate == "across" else ("up" if shift > 0 else "down")
    )


def write_difference(found: Difference, model: TrackModel, path: Path) -> None:
    """Write a difference, .csv (points) or .geojson (points, and a line for each moved stretch)."""
    from railnav.io.atomic import atomic_path

    text = _table(found) if path.suffix.lower() == ".csv" else _map(found, model)
    with atomic_path(path) as draft:
        draft.write_text(text, encoding="utf-8")


def _number(value: float) -> str:
    return "" if value != value else f"{value:.5f}"


def _table(found: Difference) -> str:
    lines = [
        "track,offset_m,easting_m,northing_m,slew_m,lift_m,common_slew_m,common_lift_m,sigma_slew_m,sigma_lift_m,moved"
    ]
    for i in range(len(found.offset)):
        cells = [
            found.tracks[found.track[i]],
            f"{found.offset[i]:.3f}",
            f"{found.easting[i]:.3f}",
            f"{found.northing[i]:.3f}",
            *(
                _number(float(c[i]))
                for c in (
                    found.slew, found.lift, found.common_slew, found.common_lift, found.sigma_slew, found.sigma_lift,
                )
            ),
            str(int(found.moved[i])),
        ]  # fmt: skip
        lines.append(",".join(cells))
    return "\n".join(lines) + "\n"


def _map(found: Difference, model: TrackModel) -> str:
    import numpy as np

    from railnav.cli._terminal import plain

    latitude, longitude, _ = model.frame.to_geodetic(found.easting, found.northing)
    at = np.round(np.degrees(np.column_stack([longitude, latitude])), 9).tolist()
    features: list[dict[str, Any]] = []
    for s in found.stretches:
        here = [
            p
            for p, i in zip(at, range(len(at)), strict=True)
            if found.tracks[found.track[i]] == s.track and s.first <= found.offset[i] <= s.last
        ]
        if len(here) >= 2:
            features.append(
                {
                    "type": "Feature",
                    "geometry": {"type": "LineString", "coordinates": here},
                    "properties": {
                        "track": s.track, "what": _sense(s.coordinate, s.shift), "from_m": s.first, "to_m": s.last,
                        "shift_m": s.shift, "sigma_m": s.sigma, "chi_square": s.statistic, "limit": s.limit,
                    },
                }
            )  # fmt: skip
    for i, p in enumerate(at):
        features.append(
            {
                "type": "Feature",
                "geometry": {"type": "Point", "coordinates": p},
                "properties": {
                    "track": found.tracks[found.track[i]],
                    "offset_m": round(float(found.offset[i]), 3),
                    "slew_m": float(found.slew[i]),
                    "lift_m": float(found.lift[i]),
                    "sigma_slew_m": float(found.sigma_slew[i]),
                    "sigma_lift_m": float(found.sigma_lift[i]),
                    "moved": bool(found.moved[i]),
                },
            }
        )
    return json.dumps(plain({"type": "FeatureCollection", "features": features}), allow_nan=False) + "\n"
