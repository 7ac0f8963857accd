"""`railnav navigate`: a run on a model."""

from __future__ import annotations

from pathlib import Path

import click

from railnav.cli._verb import PATH, json_option


@click.command("navigate")
@click.argument("run", type=PATH)
@click.option("-m", "--model", type=PATH, required=True, help="Reference track model, .gpkg (or .geojson).")
@click.option("-o", "--output", type=PATH, required=True, help="Solution to write: .csv, .parquet, .gpkg or .geojson.")
@click.option("--smooth", is_flag=True, help="Use the whole run for every epoch (fixed-interval smoother).")
@click.option(
    "--integrity-risk",
    type=click.FloatRange(0, 0.5, min_open=True, max_open=True),
    default=1e-4,
    show_default=True,
    help="Risk, per epoch, that the error exceeds the protection level.",
)
@click.option("--calibration", type=PATH, help="Calibration file of the IMU, .toml, where run.toml names none.")
@json_option
def command(
    run: Path, model: Path, output: Path, smooth: bool, integrity_risk: float, calibration: Path | None, as_json: bool
) -> None:
    """Place a run on a model: track, offset, speed, and how sure that is.

    RUN is a folder with a run.toml. The solution has one row an epoch, with standard deviations, the protection level
    along the track, the probability of the track and the navigator's mode. Files .gpkg and .geojson open in QGIS.

    \b
    Example:
      railnav navigate demo/service -m demo/line.gpkg -o solution.gpkg --smooth
    """  # noqa: D301
    from railnav.cli import _files
    from railnav.cli._describe import describe_solution, print_solution
    from railnav.cli._terminal import print_json, progress

    _files.check_output(
        output, _files.SOLUTION_ENDINGS, inputs=[model, *_files.members(run), *([calibration] if calibration else [])]
    )
    from railnav.io.imu_calibration import calibrated_run
    from railnav.io.run import read_run
    from railnav.navigation import navigate

    recorded, reference = calibrated_run(read_run(run), calibration), _files.read_model(model)
    with progress() as report:
        solution = navigate(recorded, reference, smooth=smooth, integrity_risk=integrity_risk, progress=report)
    solution.to_file(output)
    facts = describe_solution(solution)
    if as_json:
        print_json({**facts, "output": output})
    else:
        print_solution(facts, f"{output} written")
