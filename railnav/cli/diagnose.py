"""`railnav diagnose`: whether an inertial unit still is what its calibration says."""

from __future__ import annotations

from pathlib import Path

import click

from railnav.cli._verb import PATH, json_option


@click.command("diagnose")
@click.argument("positions", type=PATH)
@click.option("--against", type=PATH, required=True, help="Calibration file that the unit is held against, .toml.")
@click.option(
    "--gravity", type=float, help="Local gravity, m/s2.  [default: from the latitude, GNSS, or the calibration]"
)
@click.option("--latitude", type=click.FloatRange(-90, 90), help="Latitude of the place, degrees.")
@click.option(
    "--false-alarm",
    type=click.FloatRange(0, 1, min_open=True, max_open=True),
    default=1e-3,
    show_default=True,
    help="Share of healthy units that may be called failed.",
)
@click.option(
    "--tolerance",
    type=click.FloatRange(0),
    default=0.0,
    show_default=True,
    help="Change of bias, scale or misalignment that is allowed beyond noise: mg, a thousandth, mrad.",
)
@click.option(
    "--gyro-tolerance",
    type=click.FloatRange(0),
    default=0.0,
    show_default=True,
    help="Change of a gyro's bias that is allowed beyond noise, degrees per hour.",
)
@click.option(
    "--shortest",
    type=click.FloatRange(0.5, 3600),
    default=5.0,
    show_default=True,
    help="Shortest rest that counts when one long log is cut into positions, s.",
)
@json_option
@click.pass_context
def command(
    ctx: click.Context,
    positions: Path,
    against: Path,
    gravity: float | None,
    latitude: float | None,
    false_alarm: float,
    tolerance: float,
    gyro_tolerance: float,
    shortest: float,
    as_json: bool,
) -> None:
    """Say whether an inertial unit is healthy, or which sensor failed and why.

    POSITIONS is as for calibrate: logs at rest, their attitudes unknown. Dead, frozen and saturated axes are named first; then the length
    of the specific force is controlled in every position, and nine positions or more tell which bias, scale factor or misalignment moved
    since the calibration. Exit code 1 if anything failed.

    \b
    Example:
      railnav diagnose positions --against imu.toml
    """  # noqa: D301
    import math

    import numpy as np

    from railnav.cli._terminal import print_json, print_table
    from railnav.cli.calibrate import bench, split
    from railnav.errors import EstimationError, InputError
    from railnav.inertial.diagnosis import CAUSES
    from railnav.inertial.imu_diagnosis import diagnose_imu
    from railnav.io.imu_calibration import read_calibration
    from railnav.io.positions import read_positions

    calibration = read_calibration(against)
    found = read_positions(positions)
    place, g = bench(found, latitude, gravity)
    if g is None:
        g = calibration.provenance.gravity
        if not math.isfinite(g):
            raise InputError(
                "local gravity is unknown",
                file=positions,
                remedy="give --latitude or --gravity (0.5 % between equator and pole)",
            )
    logs = split(found, shortest, by_rate=False, where=positions)
    try:
        got = diagnose_imu(
            logs,
            calibration,
            gravity=g,
            latitude=place,
            false_alarm=false_alarm,
            tolerance=1e-3 * tolerance,
            gyro_tolerance=math.radians(gyro_tolerance) / 3600.0,
        )
    except EstimationError as error:
        raise InputError(str(error), file=positions) from error
    failures = got.failures
    nine = got.accelerometer
    change, sigma, limit = (np.degrees(x) * 3600.0 for x in (got.gyro_change, got.gyro_sigma, got.gyro_limit))
    if as_json:
        print_json(
            {
                "positions": positions,
                "against": against,
                "unit": calibration.name,
                "healthy": got.healthy,
                "failures": failures,
                "advice": got.advice,
                "gravity_m_s2": g,
                "control": None
                if got.control is None
                else {
                    "limit": got.limit,
                    "residual": dict(zip(got.names, got.control.residual.tolist(), strict=True)),
                },
                "accelerometer": None
                if nine is None
                else {
                    cause: {"change": nine.parameters[p], "sigma": nine.sigma[p], "limit": nine.limits[p]}
                    for p, cause in enumerate(CAUSES)
                },
                "gyroscope_bias_deg_h": {"change": change, "sigma": sigma, "limit": limit},
            }
        )
    else:
        if nine is not None:
            click.secho(
                f"{calibration.name}: change of the accelerometers since the calibration, in thousandths of gravity and mrad",
                bold=True,
            )
            print_table(
                "",
                ("cause", "change", "sigma", "limit", ""),
                [
                    (
                        cause,
                        f"{nine.parameters[p] * 1e3:+.3f}",
                        f"{nine.sigma[p] * 1e3:.3f}",
                        f"{nine.limits[p] * 1e3:.3f}",
                        "failed" if cause in nine.failed else "",
                    )
                    for p, cause in enumerate(CAUSES)
                ],
            )
        if np.isfinite(change).all():
            click.secho("Change of the gyros' biases, deg/h", bold=True)
            print_table(
                "",
                ("axis", "change", "sigma", "limit", ""),
                [
                    (
                        axis,
                        f"{change[k]:+.3g}",
                        f"{sigma[k]:.2g}",
                        f"{limit[k]:.2g}",
                        "failed" if abs(change[k]) > limit[k] else "",
                    )
                    for k, axis in enumerate("xyz")
                ],
            )
        for failure in failures:
            click.echo(f"failed: {failure}")
        if got.advice:
            click.echo(f"Note: {got.advice}")
        if got.healthy:
            click.echo(
                "healthy: nothing moved beyond its limit" + (", as far as these positions tell" if got.advice else "")
            )
    if failures:
        ctx.exit(1)
