"""Describe a model, a run or a solution: plain values for JSON, and the same in words for the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from railnav.cli._terminal import print_facts, print_table
from railnav.web import words

if TYPE_CHECKING:
    from railnav.evaluation import Evaluation
    from railnav.navigation.solution import Solution
    from railnav.run import Run
    from railnav.track.model import TrackModel
    from railnav.truth import Truth

_NODES = {
    "joint": ("joint", "joints"),
    "turnout": ("turnout", "turnouts"),
    "crossing": ("crossing", "crossings"),
    "buffer_stop": ("buffer stop", "buffer stops"),
    "end_of_model": ("end of the model", "ends of the model"),
}


def describe_model(model: TrackModel) -> dict[str, Any]:
    """Describe a model: tracks, nodes by kind, movements, plane and pinned operation, accuracy, provenance.

    Lengths in metres; `sigma_cross_m` is the median over the knots of the larger horizontal standard deviation's
    cross-track part.
    """
    import numpy as np

    from railnav.track.model import NodeKind

    tracks: list[dict[str, Any]] = []
    sigma = _cross_sigma(model)
    for index, track in enumerate(model.track_id):
        knots = slice(int(model.knot_start[index]), int(model.knot_start[index + 1]))
        known = sigma[knots][np.isfinite(sigma[knots])]
        heights = model.height[knots]
        tracks.append(
            {
                "track": track,
                "line": model.line[index],
                "name": model.name[index],
                "length_m": float(model.offset[knots][-1]),
                "knots": int(knots.stop - knots.start),
                "start_node": model.nodes.id[int(model.start_node[index])],
                "end_node": model.nodes.id[int(model.end_node[index])],
                "heights": bool(np.isfinite(heights).all()),
                "tightest_radius_m": _radius(float(np.abs(model.curvature[knots]).max())),
                "sigma_cross_m": float(np.median(known)) if len(known) else None,
                "sigma_cross_95_m": float(np.quantile(known, 0.95)) if len(known) else None,
            }
        )
    kinds = {kind.name.lower(): int(np.count_nonzero(model.nodes.kind == kind)) for kind in NodeKind}
    return {
        "kind": "model",
        "tracks": tracks,
        "length_m": float(sum(track["length_m"] for track in tracks)),
        "knots": len(model.offset),
        "nodes": kinds,
        "movements": len(model.movements),
        "mileposts": len(model.mileposts.track),
        "lines": [line.line for line in model.references.lines],
        "crs": model.frame.name,
        "operation": model.frame.operation,
        "pipeline": model.frame.pipeline,
        "operation_accuracy_m": float(model.frame.accuracy),
        "extent_m": {
            "easting": [float(model.easting.min()), float(model.easting.max())],
            "northing": [float(model.northing.min()), float(model.northing.max())],
        },
        "provenance": model.provenance,
    }


def _radius_words(radius: float | None) -> str:
    return words.length(radius) if radius is not None and radius < 2e4 else "straight"


def _radius(curvature: float) -> float | None:
    return 1.0 / curvature if curvature > 1e-6 else None


def _cross_sigma(model: TrackModel) -> Any:
    """Cross-track standard deviation of every knot, m; NaN where unknown."""
    import numpy as np

    east, north = np.cos(model.grid_bearing), -np.sin(model.grid_bearing)  # unit vector to the right of the track
    covariance = model.covariance_g
    variance = covariance[:, 0] * east**2 + 2 * covariance[:, 1] * east * north + covariance[:, 3] * north**2
    return np.sqrt(np.maximum(variance, 0.0))


#: More tracks, or more names of lines, than these are counted; JSON lists all.
MOST_TRACKS = 60
MOST_LINES = 12


def _line_words(lines: list[str]) -> str:
    """Return the names of lines in order, and how many more there are."""
    names = [line or "(without a name)" for line in sorted(lines)]
    more = len(names) - MOST_LINES
    return ", ".join(names[:MOST_LINES]) + (f" and {more} more" if more > 0 else "")


def print_model(facts: dict[str, Any], title: str) -> None:
    """Print what `describe_model` found."""
    kinds = {kind: many for kind, many in facts["nodes"].items() if many}
    provenance = facts["provenance"]
    print_facts(
        title,
        {
            "tracks": f"{len(facts['tracks'])}, together {words.length(facts['length_m'], 5)} ({facts['knots']:,} knots)",
            "nodes": ", ".join(words.count(n, *_NODES.get(kind, (kind, ""))) for kind, n in kinds.items()),
            "movements": f"{facts['movements']} permitted",
            "mileposts": facts["mileposts"] or "",
            "line references": _line_words(facts["lines"]),
            "plane": facts["crs"],
            "transformation": f"{facts['operation']} ({words.accuracy(facts['operation_accuracy_m'])})",
            "made by": _maker(provenance),
        },
    )
    print_table(
        "Tracks",
        ("track", "line", "name", "length", "tightest radius", "sigma across", "95 %", "heights", "from", "to"),
        [
            (
                track["track"],
                track["line"],
                track["name"],
                words.exact_length(track["length_m"]),
                _radius_words(track["tightest_radius_m"]),
                words.length(track["sigma_cross_m"], 2),
                words.length(track["sigma_cross_95_m"], 2),
                "yes" if track["heights"] else "no",
                track["start_node"],
                track["end_node"],
            )
            for track in facts["tracks"][:MOST_TRACKS]
        ],
        left=3,
    )
    if len(facts["tracks"]) > MOST_TRACKS:
        click.echo(f"  and {len(facts['tracks']) - MOST_TRACKS:,} more tracks; --json lists them all")


def _maker(provenance: dict[str, Any]) -> str:
    """Name the source of a model from the top-level texts of its provenance."""
    said = {key: value for key, value in provenance.items() if isinstance(value, str | int | float)}
    return "; ".join(
        key if value is True else str(value) if key == "made_by" else f"{key}: {value}" for key, value in said.items()
    )


def describe_run(run: Run) -> dict[str, Any]:
    """Describe a run: its streams with rows, duration, rate and longest gap, and the extent of its fixes."""
    import numpy as np

    streams: dict[str, dict[str, Any]] = {}
    for name in ("gnss", "imu", "odometer", "gyro_angles", "gauge", "balise"):
        stream = getattr(run, name)
        if stream is None:
            continue
        step = np.diff(stream.time)
        columns = [
            field
            for field in stream.__dataclass_fields__
            if isinstance(getattr(stream, field), np.ndarray)
            and np.ndim(getattr(stream, field))
            and field not in ("time", "lever_arm_b", "mounting")
        ]
        streams[name] = {
            "rows": len(stream.time),
            "from_s": float(stream.time[0]),
            "to_s": float(stream.time[-1]),
            "rate_hz": float(1.0 / np.median(step)) if len(step) else None,
            "longest_gap_s": float(step.max()) if len(step) else None,
            "columns": columns,
        }
    facts: dict[str, Any] = {
        "kind": "run",
        "id": run.id,
        "start": run.start.isoformat(),
        "direction": run.direction,
        "simulated": run.simulated,
        "duration_s": max(s["to_s"] for s in streams.values()) - min(s["from_s"] for s in streams.values())
        if streams
        else 0.0,
        "streams": streams,
    }
    if run.gnss is not None:
        facts["receiver"] = run.gnss.receiver
        facts["frame"] = run.gnss.frame
        if run.gnss.epoch is not None:
            facts["epoch"] = run.gnss.epoch
        if run.gnss.fixed_to:
            facts["fixed_to"] = run.gnss.fixed_to
        facts["extent_deg"] = {
            "latitude": [float(np.degrees(run.gnss.latitude.min())), float(np.degrees(run.gnss.latitude.max()))],
            "longitude": [float(np.degrees(run.gnss.longitude.min())), float(np.degrees(run.gnss.longitude.max()))],
        }
    return facts


def print_run(facts: dict[str, Any], title: str) -> None:
    """Print what `describe_run` found."""
    extent = facts.get("extent_deg")
    print_facts(
        title,
        {
            "run": facts["id"],
            "start": facts["start"],
            "direction": facts["direction"],
            "data": "simulated" if facts["simulated"] else "",
            "duration": words.duration(facts["duration_s"]),
            "receiver": facts.get("receiver", ""),
            "frame": facts.get("frame", "")
            + (f" at {facts['epoch']:.2f}" if "epoch" in facts else "")
            + (f", carried to {facts['fixed_to']}" if "fixed_to" in facts else ""),
            "extent": f"latitude {extent['latitude'][0]:.5f} to {extent['latitude'][1]:.5f}, "
            f"longitude {extent['longitude'][0]:.5f} to {extent['longitude'][1]:.5f} deg"
            if extent
            else "",
        },
    )
    print_table(
        "Streams",
        ("stream", "columns", "rows", "from", "to", "rate", "longest gap"),
        [
            (
                name,
                ", ".join(stream["columns"]),
                f"{stream['rows']:,}",
                f"{stream['from_s']:.2f} s",
                f"{stream['to_s']:.2f} s",
                f"{words.figures(stream['rate_hz'])} Hz",
                words.duration(stream["longest_gap_s"]),
            )
            for name, stream in facts["streams"].items()
        ],
        left=2,
    )
    for log in facts.get("logs", []):
        print_facts(
            f"Log {log['file']} ({log['format']})",
            {
                "fixes": f"{log['fixes']:,} from {log['good']:,} {log['unit']}",
                "held": ", ".join(f"{count:,} {kind}" for kind, count in log["counts"].items()),
                "broken": f"{log['broken']:,}, the first at {log['first_broken']}" if log["broken"] else "",
                "without a fix": f"{log['void']:,} instants" if log["void"] else "",
                "duplicates": f"{log['duplicates']:,} second fixes at one instant" if log["duplicates"] else "",
                "notes": "; ".join(log["notes"]),
            },
        )
    if facts.get("notes"):
        print_facts("Notes", {str(i + 1): note for i, note in enumerate(facts["notes"])})


def describe_solution(solution: Solution) -> dict[str, Any]:
    """Describe a solution: epochs, modes, the tracks in the order run, and how sure it is."""
    import numpy as np

    from railnav.navigation.solution import Mode

    # schemes without a map name no tracks
    placed = solution.track >= 0 if solution.track_id else np.isfinite(solution.latitude)
    order = solution.track[solution.track >= 0]
    changes = np.flatnonzero(np.diff(order, prepend=-1)) if len(order) else np.zeros(0, dtype=np.int64)
    modes = {mode.label: int(np.count_nonzero(solution.mode == mode)) for mode in Mode}
    return {
        "kind": "solution",
        "run": solution.run_id,
        "start": solution.start,
        "epochs": len(solution),
        "placed": int(np.count_nonzero(placed)),
        "duration_s": float(solution.time[-1] - solution.time[0]) if len(solution) else 0.0,
        "smoothed": bool(solution.smoothed),
        "simulated": bool(solution.simulated),
        "modes": {mode: n for mode, n in modes.items() if n},
        "tracks": [solution.track_id[int(order[k])] for k in changes],
        "sigma_along_m": _median_95(solution.sigma_along[placed]),
        "protection_level_along_m": _median_95(solution.protection_level_along[placed]),
        "integrity_risk": float(solution.integrity_risk),
        "top_speed_m_s": float(np.nanmax(np.abs(solution.speed[placed]))) if placed.any() else None,
        "diagnostics": solution.diagnostics,
    }


def _median_95(values: Any) -> dict[str, float | None]:
    import numpy as np

    values = values[np.isfinite(values)]
    if not len(values):
        return {"median": None, "95_percent": None}
    return {"median": float(np.median(values)), "95_percent": float(np.quantile(values, 0.95))}


def print_solution(facts: dict[str, Any], title: str) -> None:
    """Print what `describe_solution` found."""
    epochs = max(facts["epochs"], 1)
    tracks = facts["tracks"]
    path = " > ".join(tracks if len(tracks) <= 12 else [*tracks[:6], f"... {len(tracks) - 11} more ...", *tracks[-5:]])
    print_facts(
        title,
        {
            "run": facts["run"],
            "epochs": f"{facts['epochs']:,} in {words.duration(facts['duration_s'])}, "
            f"{words.share(facts['placed'] / epochs)} with a position",
            "kind": "smoothed (all of the run)" if facts["smoothed"] else "filtered (only what was known at the time)",
            "data": "simulated" if facts["simulated"] else "",
            "modes": ", ".join(f"{mode} {words.share(n / epochs)}" for mode, n in facts["modes"].items()),
            "path": path,
            "top speed": words.speed(facts["top_speed_m_s"]),
            "sigma along": _spread(facts["sigma_along_m"]),
            "protection level": f"{_spread(facts['protection_level_along_m'])} (risk {facts['integrity_risk']:g})",
            **_findings(facts["diagnostics"]),
        },
    )


def _findings(told: dict[str, Any]) -> dict[str, str]:
    """What the navigator found out about the sensors, in words; nothing where a file does not tell."""
    found: dict[str, str] = {}
    if "gnss_sigma_scale" in told:
        found["GNSS errors"] = f"{told['gnss_sigma_scale']:.2f} times the stated sigma"
    offset = told.get("frame_offset_m")
    if offset:
        sigma = told.get("frame_offset_sigma_m", 0.0)
        found["frame offset"] = f"{offset[0]:+.1f} m east, {offset[1]:+.1f} m north (prior sigma {sigma:.1f} m)"
    found |= _found_of_imu(told)
    names = {
        "fixes_suspect": "suspect fixes",
        "gnss_steps": "GNSS steps",
        "wheel_slips": "wheel slips",
        "balises_strange": "strange balises",
        "track_revisions": "revised tracks",
    }
    events = [f"{told[key]:,} {name}" for key, name in names.items() if told.get(key)]
    if events:
        found["events"] = ", ".join(events)
    return found


def _found_of_imu(told: dict[str, Any]) -> dict[str, str]:
    """What an inertial scheme estimated beside the way."""
    found: dict[str, str] = {}
    roll, pitch = told.get("levelled_roll_deg", 0.0), told.get("levelled_pitch_deg", 0.0)
    if max(abs(roll), abs(pitch)) > 0.01:
        found["levelled"] = f"roll {roll:+.1f}, pitch {pitch:+.1f} deg: as mounted the vehicle would not stand level"
    for key, name, factor, unit, parts in (
        ("time_offset_s", "time offset", 1e3, "ms, IMU against GNSS", ("",)),
        ("mounting_pitch_yaw_deg", "mounting", 1.0, "deg left over", ("pitch ", "yaw ")),
        ("odometer_scale", "odometer scale", 100.0, "%", ("",)),
    ):
        if isinstance(told.get(key), dict):
            pairs = zip(parts, told[key]["value"], told[key]["sigma"], strict=True)
            found[name] = ", ".join(f"{p}{factor * v:+.2f} +- {factor * s:.2f}" for p, v, s in pairs) + f" {unit}"
    return found


def _spread(values: dict[str, float | None]) -> str:
    return f"{words.length(values['median'], 2)} median, {words.length(values['95_percent'], 2)} for 95 % of epochs"


def describe_truth(truth: Truth) -> dict[str, Any]:
    """Describe a truth file: rows, duration, and the tracks in the order run."""
    import numpy as np

    changes = np.flatnonzero(np.diff(truth.track, prepend=-1))
    return {
        "kind": "truth",
        "rows": len(truth),
        "duration_s": float(truth.time[-1] - truth.time[0]),
        "tracks": [truth.track_id[int(truth.track[k])] for k in changes],
        "top_speed_m_s": float(np.abs(truth.speed).max()),
    }


def print_truth(facts: dict[str, Any], title: str) -> None:
    """Print what `describe_truth` found."""
    print_facts(
        title,
        {
            "rows": f"{facts['rows']:,} in {words.duration(facts['duration_s'])}",
            "path": " > ".join(facts["tracks"]),
            "top speed": words.speed(facts["top_speed_m_s"]),
        },
    )


def print_build(model: TrackModel, title: str) -> None:
    """Print what a build says of itself: runs, tracks, and on stderr its warnings."""
    from railnav.cli._terminal import print_warnings
    from railnav.web import report

    build = model.provenance["build"]
    print_facts(
        title,
        {
            "tracks": f"{len(model.track_id)}, together {words.length(float(model.lengths.sum()), 5)}",
            "plane": model.frame.name,
            "datum": (build.get("datum") or {}).get("rule", ""),
        },
    )
    columns, rows, left = report.run_rows(build)
    why = columns.index("rejected because")
    shorter = [[cell for k, cell in enumerate(row) if k != why] for row in [list(columns), *rows]]
    print_table("Runs", shorter[0], shorter[1:], left=left - 1)
    if any(report.rejected(run) for run in build["runs"]):
        click.secho("Rejected fixes", bold=True)
        for run in build["runs"]:
            reasons = report.rejected(run)
            if reasons:
                click.echo(f"  {run['id']}: {'; '.join(reasons)}")
        click.echo()
    columns, rows, left = report.track_rows(build)
    print_table("Tracks", columns, rows, left=left)
    print_warnings(build.get("warnings", []))


def print_evaluation(evaluation: Evaluation, title: str) -> None:
    """Print how good a solution is, and whether it knows."""
    from railnav.web import evaluation_report as report

    selection, integrity, found = evaluation.selection, evaluation.integrity, evaluation.consistency
    along, across, speed = evaluation.along_statistics, evaluation.across_statistics, evaluation.speed_statistics
    nees = ""
    if found.nees is not None and found.lower is not None and found.upper is not None:
        verdict = "inside" if found.inside else "OUTSIDE"
        nees = (
            f"{found.nees:.2f}, {verdict} {found.lower:.2f} to {found.upper:.2f} "
            f"({words.figures(found.effective, 2)} independent samples)"
        )
    jumps = ""
    if evaluation.jumps is not None:
        jumps = f"{len(evaluation.jumps.illegal)} illegal of {evaluation.jumps.changes} changes of track"
    print_facts(
        title,
        {
            "epochs": f"{evaluation.epochs:,}, {words.share(evaluation.availability)} with a position",
            "right track": f"{words.share(selection.rate)} (compared by {selection.compared_by}); "
            f"{selection.wrong_while_tracking} epochs sure of a wrong one",
            "error along": f"{words.length(along.rms)} RMS, {words.length(along.p95)} at 95 %, {words.length(along.max)} at worst",
            "error across": f"{words.length(across.rms)} RMS, {words.length(across.max)} at worst",
            "error of speed": f"{words.figures(speed.rms, 2)} m/s RMS",
            "NEES along": nees,
            "integrity": f"{integrity.events} of {integrity.rows:,} epochs beyond their bound "
            f"(median {words.length(integrity.median_level)}, risk {integrity.integrity_risk:g}), "
            f"{integrity.hazardous} hazardous at an alert limit of {words.length(integrity.alert_limit)}",
            "jumps": jumps,
        },
    )
    for name, (columns, rows, left) in (
        ("Errors along by mode", report.mode_rows(evaluation)),
        ("Without GNSS", report.coasting_rows(evaluation)),
        ("Is the track probability true?", report.reliability_rows(evaluation)),
        ("On a wrong track", report.wrong_rows(evaluation)),
    ):
        print_table(name, columns, rows, left=left)
