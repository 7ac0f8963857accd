"""`railnav navigate`: a run on a model."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from railnav.cli._verb import PATH, json_option
from railnav.errors import InputError

if TYPE_CHECKING:
    from railnav.navigation.explanation import Decision
    from railnav.run import Run


@click.command("navigate")
@click.argument("run", type=PATH)
@click.option(
    "-m",
    "--model",
    type=PATH,
    help="Reference track model, .gpkg (or .geojson); needed by the schemes track and map-corrector.",
)
@click.option("-o", "--output", type=PATH, required=True, help="Solution to write: .csv, .parquet, .gpkg or .geojson.")
@click.option("--smooth", is_flag=True, help="Use the whole run for every epoch (fixed-interval smoother).")
@click.option(
    "--integrity-risk",
    type=click.FloatRange(0, 0.5, min_open=True, max_open=True),
    default=1e-4,
    show_default=True,
    help="Risk, per epoch, that the error exceeds the protection level.",
)
@click.option(
    "--scheme",
    type=click.Choice(["track", "map-corrector", "loose", "tight", "odometer", "decentralised"]),
    default="track",
    show_default=True,
    help="How: the filter on the track; its fixed-gain substitute for small computers; or, without a map, the IMU aided by GNSS, "
    "by pseudoranges, by GNSS and wheels, or by two filters fused.",
)
@click.option(
    "--sensors",
    default="declared",
    show_default=True,
    metavar="declared|usual|GRADE|FILE",
    help="Errors of the sensors: as run.toml declares them; the usual ones, whatever it declares; those of a grade that simulate "
    "knows (survey, service, phone, mems, tactical); or a .toml with tables [gnss], [imu], [odometer].",
)
@click.option("--ranges", type=PATH, help="Pseudoranges for --scheme tight, .csv or .parquet.")
@click.option("--calibration", type=PATH, help="Calibration file of the IMU, .toml, where run.toml names none.")
@click.option("--explain", type=PATH, help="Write why tracks were chosen, .jsonl or .csv: candidates and evidence.")
@click.option("--alternatives", is_flag=True, help="Write all candidates beside a .csv, .parquet or .geojson solution.")
@json_option
def command(
    run: Path,
    model: Path | None,
    output: Path,
    smooth: bool,
    integrity_risk: float,
    scheme: str,
    sensors: str,
    ranges: Path | None,
    calibration: Path | None,
    explain: Path | None,
    alternatives: bool,
    as_json: bool,
) -> None:
    """Place a run on a model: track, offset, speed, and how sure that is.

    RUN is a folder with a run.toml. The solution has one row an epoch, with standard deviations, the protection level
    along the track, the probability of the track and the navigator's mode. Files .gpkg and .geojson open in QGIS.
    A .gpkg also holds a table "alternatives": all tracks the train can be on at epochs that are not certain; beside
    other files --alternatives writes it as NAME_alternatives.csv (or .parquet).

    Schemes without a map (loose, tight, odometer, decentralised) integrate the IMU; their solutions name no tracks,
    and what they found of the sensors (biases, mounting, time offset) is in --json.

    \b
    Example:
      railnav navigate demo/service -m demo/line.gpkg -o solution.gpkg --smooth
      railnav navigate demo/service -m demo/line.gpkg -o solution.csv --sensors service
    """  # noqa: D301
    from railnav.cli import _files
    from railnav.cli._describe import describe_solution, print_solution
    from railnav.cli._schemes import check_request, navigate_scheme
    from railnav.cli._terminal import print_json, progress

    only_track = {
        "--explain": explain is not None,
        "--alternatives": alternatives,
        "--sensors": sensors != "declared",
    }
    check_request(scheme, run=run, model=model, output=output, smooth=smooth, ranges=ranges, of_track=only_track)
    if scheme != "track" or model is None:
        from railnav.io.imu_calibration import calibrated_run
        from railnav.io.run import read_run

        recorded = calibrated_run(read_run(run), calibration)
        with progress() as report:
            solution = navigate_scheme(
                recorded,
                scheme,
                model=model,
                ranges=ranges,
                smooth=smooth,
                integrity_risk=integrity_risk,
                progress=report,
            )
        solution.to_file(output)
        facts = describe_solution(solution)
        if as_json:
            print_json({**facts, "output": output})
        else:
            print_solution(facts, f"{output} written")
        return
    _files.check_output(
        output, _files.SOLUTION_ENDINGS, inputs=[model, *_files.members(run), *([calibration] if calibration else [])]
    )
    if explain is not None:
        _files.check_output(explain, (".jsonl", ".csv"), inputs=[model, output, *_files.members(run)])
    beside = None
    if alternatives and output.suffix.lower() != ".gpkg":
        ending = ".parquet" if output.suffix.lower() == ".parquet" else ".csv"
        beside = _files.check_output(output.with_name(f"{output.stem}_alternatives{ending}"), (ending,))
    if alternatives and smooth:
        raise InputError("--alternatives with --smooth", remedy="the smoother keeps one path: leave out one of both")
    from railnav.io.imu_calibration import calibrated_run
    from railnav.io.run import read_run
    from railnav.navigation import navigate

    recorded, reference = _declaring(calibrated_run(read_run(run), calibration), sensors), _files.read_model(model)
    decisions: list[Decision] | None = None if explain is None else []
    with progress() as report:
        solution = navigate(
            recorded, reference, smooth=smooth, integrity_risk=integrity_risk, explain=decisions, progress=report
        )
    solution.to_file(output)
    if beside is not None:
        from railnav.io.solution import write_alternatives

        write_alternatives(solution, beside)
    if explain is not None and decisions is not None:
        from railnav.io.explanation import write_decisions

        write_decisions(decisions, explain)
    facts = describe_solution(solution)
    if as_json:
        more = {"explain": explain} if explain is not None else {}
        print_json({**facts, "output": output, **more, **({"alternatives": beside} if beside is not None else {})})
    else:
        print_solution(facts, " and ".join(str(p) for p in (output, beside, explain) if p is not None) + " written")


def _declaring(run: Run, sensors: str) -> Run:
    """The run, declaring the errors that --sensors asks for."""
    from dataclasses import replace

    from railnav.io.run_contents import read_sensors
    from railnav.run import GnssErrors, ImuErrors, OdometerErrors
    from railnav.simulation.sensors import OUTFITS, SHEET_OUTFITS, outfit_of

    told: tuple[GnssErrors | None, ImuErrors | None, OdometerErrors | None]
    if sensors == "declared":
        return run
    if sensors == "usual":
        told = None, None, None
    elif sensors in OUTFITS or sensors in SHEET_OUTFITS:
        outfit = outfit_of(sensors)
        carried = (outfit.gnss, outfit.imu, outfit.odometer)
        told = tuple(None if sensor is None else sensor.sheet for sensor in carried)  # type: ignore[assignment]
    elif sensors.lower().endswith(".toml"):
        told = read_sensors(Path(sensors))
    else:
        grades = ", ".join((*OUTFITS, *SHEET_OUTFITS))
        raise InputError(
            f"--sensors {sensors} is none that is known", remedy=f"declared, usual, one of {grades}, or a .toml file"
        )
    gnss, imu, odometer = told
    return replace(
        run,
        gnss=None if run.gnss is None else replace(run.gnss, errors=gnss),
        imu=None if run.imu is None else replace(run.imu, errors=imu),
        odometer=None if run.odometer is None else replace(run.odometer, errors=odometer),
    )
