"""Measure again what docs/accuracy.md and docs/performance.md claim: `make figures`, or with the names of sections.

    python docs/make_figures.py [--only NAME ...]

Each section of the two pages is the printed output of one script, with its command, the date and the machine. Sections not measured
now (by `--only`, or because the real data are absent) keep what they said before.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import subprocess
import sys
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Section:
    """One measurement: a name, a heading, what to know before reading, and the command that prints it."""

    name: str
    heading: str
    words: str
    command: str
    real_data: bool = False


PAGES = {
    "accuracy.md": (
        "# How accurate\n\nMeasured, not claimed: every block is the output of the command above it, and `make figures` "
        "measures it again. Real data carry no truth; what is simulated is called simulated.\n",
        (
            Section(
                "line80-unseen",
                "Real line: a model meets a run that it did not see",
                "122 km of double track, eight trains, each with a u-blox M8N and an iPhone, one with an MTK3339 "
                "too. There is no truth. A model is built without a run, or without all runs of that train, and judged by the robust "
                "spread (1.4826 MAD) of that run's distances across the track. The baseline is nearest-track snapping to medians of the "
                "other receivers. The spread holds the receiver's own noise, which no model can remove.",
                "python benchmarks/build.py",
                real_data=True,
            ),
            Section(
                "corridor",
                "Planes for trunk lines",
                "What planes make of a metre along whole lines: Gauss-Krueger with a change of zone at each boundary, one fitted oblique "
                "Mercator, sections of 200 km. The lines are rough, towns joined by geodesics.",
                "python benchmarks/corridor.py",
            ),
            Section(
                "survey-simulated",
                "Simulated survey: 2 cm GNSS, three passes over a double line",
                "The model's axis and length against the truth, and whether its stated covariance holds (NEES per knot is 1 when it "
                "does).",
                "python benchmarks/survey.py",
            ),
            Section(
                "records",
                "Surveys that are refined: honesty by kind, sequential against batch, slews found, a real line updated",
                "Simulated but for the last two parts: whether the stated covariance holds for each kind of survey (NEES is 1 when it "
                "does; bar 0.9 to 1.1; three passes over 4 km tell little of correlated errors, so that single builds scatter), five runs "
                "merged one by one against all at once (bar 1e-9 m), drifting increments taken for white and followed, updates against "
                "builds of all runs, slews found by windows (bar 95 % of 200, false alarms 1 %) and the axis after forgetting (bar 2 mm) "
                "beside naive merging; then line80, with the repeatability of its axis by receiver, and hev_cinkota.",
                "python benchmarks/records.py",
                real_data=True,
            ),
            Section(
                "navigate-accuracy",
                "Navigation of the sample run and of a real line",
                "The simulated sample run (14 minutes, double line, station siding, two outages; coloured GNSS errors), forward and "
                "smoothed, and lawful movement on the real line against snapping to the nearest track. The sample's truth counts offsets "
                "horizontally at height 0, 20 to 73 ppm shorter than ground length: up to 0.55 m of its along-track errors is that.",
                "python benchmarks/navigate.py",
                real_data=True,
            ),
            Section(
                "navigate-simulated",
                "Navigation of simulated runs over the bundled line",
                "Many seeds, so that the covariance can be judged: errors along the track, tracks, NEES pooled over runs, coverage. On "
                "this exact model the stated sigma is too large (NEES below its bounds): the navigator allows for errors of surveyed "
                "models in the place of curves, which this model does not have.",
                "python benchmarks/service.py",
            ),
            Section(
                "alignment",
                "Elements of alignments",
                "Simulated noise on sampled designs. A curve of R = 600 m and L = 80 m over seeds; a made-up line of 31 km; two main "
                "tracks of SBB and trams of Mannheim, as many of its axes in random order as the minutes allow, each metre with 5 mm, "
                "against their own element tables. A joint counts "
                "as one that such points can show if its change moves the shorter neighbour by over four sigmas of its mean.",
                "python benchmarks/alignment.py --seeds 40 --minutes 2",
                real_data=True,
            ),
            Section(
                "parallel",
                "Parallel tracks without a turnout, simulated",
                "Whether the stated track probability is true, and how long deciding takes.",
                "python benchmarks/parallel.py",
            ),
            Section(
                "monte-carlo",
                "What the navigator promises, by seeded Monte Carlo",
                "Simulated, on the bundled line, each case with its bar. The open-sky bar comes from a filter that "
                "is told the noise, and so is the navigator where the sensors are declared in run.toml; else it assumes coloured errors, "
                "as receivers have them, and is shown on both.",
                "python benchmarks/monte_carlo.py",
            ),
            Section(
                "protection-level",
                "How often the protection level fails",
                "Simulated: GNSS 1.5 m and odometer, six ways through the bundled line, a run of its own with fresh noise for every epoch.",
                "python benchmarks/protection_level.py --full",
            ),
            Section(
                "faults",
                "Named faults",
                "What goes wrong with sensors, simulated, and what the navigator makes of it. `railnav simulate "
                "--list-faults` says what each is.",
                "python benchmarks/faults.py",
            ),
            Section(
                "yardsticks",
                "The peers' yardsticks: many turnouts, rough GNSS",
                "Simulated: tracks 4.5 m apart, 1 Hz GNSS with 3 m white and 2 m coloured error, 194 turnouts. On such data the "
                "nearest track is right in 69 % of epochs, FMM, Valhalla and OSRM in 79 to 86 % (with moves that no train can make), a "
                "legal-path HMM with a 1 Hz gyro in 99.8 %; railpos errs 2.1 m along, with 46 to 61 % of errors inside its 95 % bound.",
                "python benchmarks/yardsticks.py",
            ),
            Section(
                "gaps",
                "Gaps cut into a real line's runs",
                "GNSS alone on a train: nothing else tells how fast it runs inside a gap.",
                "python benchmarks/gaps.py",
                real_data=True,
            ),
            Section(
                "train-start",
                "A real train at rest and starting",
                "Thirty seconds of a train without odometer and model: what its inertial unit tells standing, and how well it alone "
                "follows the start.",
                "python benchmarks/standing_train.py",
                real_data=True,
            ),
            Section(
                "claims",
                "What the inertial sources claim",
                "Every claim of the two sources behind the inertial suite, measured again on simulated data: what the source says, "
                "what comes out, and why where it cannot hold.",
                "python benchmarks/claims.py",
            ),
            Section(
                "geometry",
                "Track geometry: channels, defects, overlay, trends, lining (simulated)",
                "Recording cars on irregular track of the bundled line, everything simulated: filters against sinusoids, chords, channels "
                "against the fields they drove over, defects found and false, runs over each other, growth, the "
                "measured axis, and how fast.",
                "python benchmarks/geometry.py",
            ),
            Section(
                "outages",
                "Real drive without a map: an aided IMU with RTK withheld",
                "A car with RTK GNSS and a low-cost IMU; the fixes left out are the truth. Causal and smoothed, with and without what "
                "wheels can do (non-holonomic constraint, zero-velocity updates); mounting, arms, time offset and "
                "scale factors are estimated.",
                "python benchmarks/outages.py",
                real_data=True,
            ),
            Section(
                "integration",
                "The source's integration experiments, simulated",
                "Campus, city and road with an IMU440; GNSS whose errors last; a canyon with few satellites; two filters fused. Beside "
                "each ratio the specification's own.",
                "python benchmarks/integration.py",
            ),
            Section(
                "map-corrector",
                "The source's map corrector and what replaces it, simulated",
                "The three-lobed road loop: the literal rule does not meet its own figures; the arc-length corrector does.",
                "python benchmarks/map_corrector.py",
            ),
            Section(
                "formats",
                "Networks of other programs, in and out",
                "Cologne's railways from OpenStreetMap, 11 alignments of SBB's LandXML, Mannheim's table of tram "
                "axes, each against its own "
                "figures: joints, cant, profile, node coordinates, movements, what validate finds. Then models "
                "written in each format, read "
                "back and compared metre by metre; railML carries no cant.",
                "python benchmarks/formats.py",
                real_data=True,
            ),
        ),
    ),
    "performance.md": (
        "# How fast\n\nEvery block is the output of the command above it, measured on a shared two-core machine; `make figures` "
        "measures it again. Ratios against a peer in the same run mean more than seconds.\n",
        (
            Section("startup", "Starting", "A command line that answers at once.", "python benchmarks/startup.py"),
            Section(
                "demo",
                "The demo",
                "The whole way on the bundled line, first with nothing compiled, as on a fresh machine, then again.",
                "python benchmarks/demo.py",
            ),
            Section(
                "endurance",
                "A day on the line",
                "One simulated out-and-back ride repeated for 24 hours through one navigator: sensor epochs a second of one core, and its "
                "memory. The same errors of the receiver come again with every ride, which real ones do not.",
                "python benchmarks/endurance.py",
            ),
            Section(
                "chain",
                "The square-root chain",
                "Block-bidiagonal least squares, forward and smoothing, against scipy's banded solver including the building of its band.",
                "python benchmarks/chain.py",
            ),
            Section(
                "store",
                "The model store",
                "A synthetic network of 1,000 km at 1 m knots, written and read in processes of their own; the same in a PostGIS store.",
                "python benchmarks/store.py --postgis",
            ),
            Section(
                "build",
                "Building a real line",
                "All u-blox and iPhone runs of the line: over 250,000 fixes, 1,900 km of driving.",
                "python benchmarks/build.py --quick",
                real_data=True,
            ),
            Section(
                "navigate-speed",
                "Navigating",
                "GNSS epochs a second on the real line after loading, and the time of one live step (two trains; the whole line stands "
                "under accuracy).",
                "python benchmarks/navigate.py --quick",
                real_data=True,
            ),
            Section(
                "strapdown",
                "Strapdown mechanization",
                "IMU samples a second on one core.",
                "python benchmarks/strapdown.py",
            ),
            Section(
                "logs",
                "Reading logs",
                "Lines, rows and messages a second of simulated logs.",
                "python benchmarks/logs.py",
            ),
            Section(
                "logs-streamed",
                "Logs turned into a run folder piece by piece",
                "Memory must not grow with the log: one of ten times the size needs no more.",
                "python benchmarks/logs.py --stream --hours 5",
            ),
        ),
    ),
}


def measured(section: Section) -> str:
    """Run a section's command and return its block."""
    command = [sys.executable, *section.command.split()[1:]]
    environment = os.environ | {"COLUMNS": "110", "PYTHONPATH": str(ROOT)}
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, env=environment)
    if run.returncode:
        raise SystemExit(f"{section.command}: exit code {run.returncode}\n{run.stdout}{run.stderr}")
    day = datetime.now(UTC).date().isoformat()
    output = "\n".join(line.rstrip() for line in run.stdout.strip().splitlines())
    return (
        f"<!-- {section.name} -->\n## {section.heading}\n\n{section.words}\n\n    {section.command}\n\n"
        f"```\n{output}\n```\n\n{day}, {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}.\n"
    )


def blocks(page: Path) -> dict[str, str]:
    """What a page says now, by section."""
    if not page.exists():
        return {}
    parts = re.split(r"^<!-- ([a-z0-9-]+) -->\n", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {name: f"<!-- {name} -->\n{text.rstrip()}\n" for name, text in zip(parts[1::2], parts[2::2], strict=True)}


def main() -> None:
    """Measure the wanted sections and write the pages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="NAME", help="measure these sections alone")
    wanted = parser.parse_args().only
    names = {section.name for _, sections in PAGES.values() for section in sections}
    if unknown := set(wanted or ()) - names:
        parser.error(f"no section {', '.join(sorted(unknown))}; there are {', '.join(sorted(names))}")
    data = Path(os.environ.get("RAILNAV_DATA", ROOT.parent / "shared" / "data"))
    for file, (opening, sections) in PAGES.items():
        page = ROOT / "docs" / file
        known = blocks(page)
        for section in sections:
            if wanted and section.name not in wanted:
                continue
            if section.real_data and not data.is_dir():
                print(f"{section.name}: kept, the real data are not here", file=sys.stderr)
                continue
            print(f"{section.name}: {section.command}", file=sys.stderr)
            known[section.name] = measured(section)
        text = "\n".join([opening, *(known[s.name] for s in sections if s.name in known)])
        page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
