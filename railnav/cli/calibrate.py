"""`railnav calibrate`: an inertial unit from a set of positions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from railnav.cli._verb import PATH, json_option

if TYPE_CHECKING:
    from railnav.inertial.positions import PositionLog
    from railnav.inertial.procedure import CalibrationResult
    from railnav.io.positions import PositionSet

METHODS = ("six-position", "modified-six-position", "multi-position", "modified-multi-position", "turns")
UNITS = ("L3G4200D", "IMU440", "RT3003", "STIM300", "ASM330LHH")


@click.command("calibrate")
@click.argument("positions", type=PATH)
@click.option(
    "--method",
    "methods",
    type=click.Choice(METHODS),
    multiple=True,
    required=True,
    help="How; twice to calibrate accelerometers at rest and gyros on a table in one go.",
)
@click.option("-o", "--output", type=PATH, help="Calibration file to write, .toml.")
@click.option(
    "--gravity", type=float, help="Local gravity, m/s2.  [default: from the latitude, GNSS, or positions.toml]"
)
@click.option("--latitude", type=click.FloatRange(-90, 90), help="Latitude of the bench, degrees.")
@click.option("--rate", type=click.FloatRange(0, 5000, min_open=True), help="Rate of the table, degrees per second.")
@click.option(
    "--turns",
    metavar="A,B,C",
    help="Turns from one position to the next about x, y and z, degrees, e.g. 60,120,30; the logs in the order of their names.",
)
@click.option(
    "--form",
    type=click.Choice(["symmetric", "lower"]),
    default="symmetric",
    show_default=True,
    help="Matrix of the multi-position methods: symmetric, or lower triangular with x as reference.",
)
@click.option(
    "--temperature-degree",
    type=click.IntRange(1, 5),
    help="Fit polynomials of this degree to series taken at several temperatures.",
)
@click.option("--keep", type=PATH, help="Earlier calibration file: what is not calibrated now is taken from it.")
@click.option("--name", help="Name of the unit.  [default: the folder's]")
@click.option(
    "--shortest",
    type=click.FloatRange(0.5, 3600),
    default=5.0,
    show_default=True,
    help="Shortest rest that counts when one long log is cut into positions, s.",
)
@click.option(
    "--plan", is_flag=True, help="Print which positions to take for the method, as a positions.toml, and stop."
)
@click.option("--simulate", is_flag=True, help="Make POSITIONS instead: a simulated set for the method.")
@click.option(
    "--unit", type=click.Choice(UNITS), default="IMU440", show_default=True, help="Data sheet of the simulated unit."
)
@click.option(
    "--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Of the simulation: the specimen."
)
@click.option(
    "--fault",
    metavar="NAME=SIZE",
    help='What failed in the simulated unit, e.g. "accelerometer bias x=0.05" (m/s2, share, rad or rad/s).',
)
@json_option
def command(
    positions: Path,
    methods: tuple[str, ...],
    output: Path | None,
    gravity: float | None,
    latitude: float | None,
    rate: float | None,
    turns: str | None,
    form: str,
    temperature_degree: int | None,
    keep: Path | None,
    name: str | None,
    shortest: float,
    plan: bool,
    simulate: bool,
    unit: str,
    seed: int,
    fault: str | None,
    as_json: bool,
) -> None:
    """Calibrate an inertial unit from positions: bias, scale and misalignment, with standard deviations.

    POSITIONS is a folder of run folders or of tables with IMU columns, one a position (positions.toml beside them says sides, rates and
    turns, where they matter), or one long log, which is cut where it rests. six-position: each axis up and down, levelled.
    multi-position: nine or more attitudes, none known. The modified forms: the same on a rate table, for gyros. turns: turns about all
    three axes at once, by known angles.

    \b
    Example:
      railnav calibrate positions --plan --method turns
      railnav calibrate positions --simulate --method multi-position --seed 7
      railnav calibrate positions --method multi-position -o imu.toml
    """  # noqa: D301
    if plan:
        from railnav.io.positions import plan_text

        if len(methods) != 1:
            raise click.UsageError("--plan is for one method")
        click.echo(plan_text(methods[0], rate=rate or 60.0), nl=False)  # type: ignore[arg-type]
        return
    if simulate:
        _simulate(positions, methods, unit, seed, latitude, rate, temperature_degree, fault, as_json)
        return
    if fault is not None:
        raise click.UsageError("--fault goes with --simulate")
    if output is None:
        raise click.UsageError("Missing option '-o' / '--output'.")
    from math import radians

    from railnav.cli import _files
    from railnav.cli._terminal import print_json
    from railnav.errors import EstimationError, InputError

    inputs = _files.members(positions) if positions.is_dir() else [positions]
    _files.check_output(output, (".toml",), inputs=inputs)
    from railnav.inertial.procedure import RATE_METHODS, calibrate_imu
    from railnav.io.imu_calibration import read_calibration, write_calibration
    from railnav.io.positions import read_positions

    found = read_positions(positions)
    place, g = bench(found, latitude, gravity)
    logs = split(found, shortest, by_rate=all(method in RATE_METHODS for method in methods), where=positions)
    if turns is not None:
        logs = _turned(logs, turns)
    table = radians(rate) if rate is not None else found.rate
    try:
        result = calibrate_imu(
            logs,
            methods,  # type: ignore[arg-type]
            gravity=g,
            latitude=place,
            rate=table,
            form=form,  # type: ignore[arg-type]
            temperature_degree=temperature_degree,
            keep=read_calibration(keep) if keep is not None else None,
            name=name or positions.resolve().stem,
            date=found.date,
        )
    except EstimationError as error:
        raise InputError(str(error), file=positions) from error
    write_calibration(result.calibration, output)
    if as_json:
        print_json({**facts(result), "output": output})
    else:
        _print(result, output)


def bench(found: PositionSet, latitude: float | None, gravity: float | None) -> tuple[float | None, float | None]:
    """Latitude, rad, and gravity, m/s2, of a bench: as named, else from the positions, else gravity from the latitude."""
    from math import radians

    from railnav.inertial.mechanization import GravityField

    place = radians(latitude) if latitude is not None else found.latitude
    if gravity is not None:
        return place, gravity
    if latitude is not None and place is not None:
        return place, float(GravityField().vector(place, 0.0)[2])
    return place, found.gravity


def split(found: PositionSet, shortest: float, *, by_rate: bool, where: Path) -> tuple[PositionLog, ...]:
    """Give the positions of a set, cut from one long log if that is what there is."""
    from railnav.errors import EstimationError, InputError
    from railnav.inertial.positions import cut_positions

    if not found.whole:
        return found.logs
    try:
        return cut_positions(found.logs[0].name, found.logs[0].imu, shortest=shortest, by_rate=by_rate)
    except (EstimationError, ValueError) as error:
        raise InputError(str(error), file=where) from error


def facts(result: CalibrationResult) -> dict[str, Any]:
    """What a calibration says, for machines."""
    unit = result.calibration
    out: dict[str, Any] = {"name": unit.name, "gravity_m_s2": unit.provenance.gravity, "remarks": result.remarks}
    for what, spelled in (("accelerometer", "m_s2"), ("gyroscope", "rad_s")):
        triad = getattr(unit, what)
        out[what] = triad and {
            "method": triad.method,
            f"bias_{spelled}": triad.bias,
            f"sigma_bias_{spelled}": triad.sigma_bias,
            "matrix": triad.matrix,
            "sigma_matrix": triad.sigma_matrix,
            "scale": triad.scale,
            f"residual_{spelled}": triad.residual,
            "positions": triad.positions,
            "condition": triad.condition,
        }
        noise = getattr(unit, f"{what}_noise")
        out[f"{what}_noise"] = noise and {
            "random_walk": noise.random_walk,
            "bias_instability": noise.bias_instability,
        }
    out["positions"] = [
        {
            "log": one.name,
            "up": one.up,
            "turning": one.turning,
            "force_m_s2": one.force.mean,
            "rate_rad_s": one.rate.mean,
            "duration_s": one.duration,
            "temperature_k": one.temperature,
        }
        for one in result.positions
    ]
    return out


def _print(result: CalibrationResult, output: Path) -> None:
    from math import degrees

    from railnav.cli._terminal import print_table, print_warnings

    print_table(
        "Positions",
        ("log", "up", "seconds", "force x", "force y", "force z, m/s2", "rate x", "rate y", "rate z, deg/s"),
        [
            (
                one.name,
                one.up + (" (turning)" if one.turning else ""),
                f"{one.duration:.0f}",
                *(f"{v:.4f}" for v in one.force.mean),
                *(f"{degrees(v):.4f}" for v in one.rate.mean),
            )
            for one in result.positions
        ],
        left=2,
    )
    unit = result.calibration
    for what, scale, words in (
        ("accelerometer", 1 / 9.80665e-3, "mg"),
        ("gyroscope", degrees(1.0) * 3600.0, "deg/h"),
    ):
        triad = getattr(unit, what)
        if triad is None:
            continue
        sigma, spread = triad.sigma_bias, triad.sigma_matrix
        response = triad.response
        rows = []
        for k, axis in enumerate("xyz"):
            others = [j for j in range(3) if j != k]
            rows.append(
                (
                    axis,
                    f"{triad.bias[k] * scale:.4g}",
                    "" if sigma is None else f"{sigma[k] * scale:.2g}",
                    f"{triad.scale[k] * 1e6:.0f}" if spread is None or spread[k, k] > 0.0 else "",
                    "" if spread is None or spread[k, k] == 0.0 else f"{spread[k, k] * 1e6:.0f}",
                    *(f"{response[k, j] * 1e3:.3f}" if response[k, j] != 0.0 else "" for j in others),
                )
            )
        click.secho(
            f"{what.capitalize()}: {triad.method}, {triad.positions} positions, condition {triad.condition:.2f}",
            bold=True,
        )
        print_table(
            "",
            ("axis", f"bias, {words}", "sigma", "scale, ppm", "sigma", "cross 1, mrad", "cross 2, mrad"),
            rows,
        )
    click.echo(f"{output} written")
    print_warnings(result.remarks)


def _turned(logs: tuple[PositionLog, ...], turns: str) -> tuple[PositionLog, ...]:
    from dataclasses import replace

    import numpy as np

    try:
        step = np.deg2rad([float(part) for part in turns.split(",")])
    except ValueError:
        step = np.zeros(0)
    if step.shape != (3,) or not np.isfinite(step).all():
        raise click.BadParameter(f"{turns!r} is not three angles in degrees, e.g. 60,120,30", param_hint="--turns")
    return tuple(replace(log, turns=k * step) for k, log in enumerate(logs))


def _simulate(
    folder: Path,
    methods: tuple[str, ...],
    unit: str,
    seed: int,
    latitude: float | None,
    rate: float | None,
    temperature_degree: int | None,
    fault: str | None,
    as_json: bool,
) -> None:
    from math import radians

    from railnav.cli import _files
    from railnav.cli._terminal import print_json
    from railnav.errors import RailnavError

    if len(methods) != 1:
        raise click.UsageError("--simulate makes the positions of one method")
    _files.check_output_folder(folder, mark="positions.toml")
    from railnav.io.positions import write_positions
    from railnav.simulation.positions import simulate_positions

    moved = None
    if fault is not None:
        what, _, size = fault.rpartition("=")
        try:
            moved = (what.strip(), float(size))
        except ValueError:
            raise click.BadParameter(f"{fault!r} is not NAME=SIZE", param_hint="--fault") from None
    try:
        made = simulate_positions(
            methods[0],  # type: ignore[arg-type]
            unit=unit,  # type: ignore[arg-type]
            seed=seed,
            latitude=radians(latitude if latitude is not None else 48.85),
            rate=radians(rate if rate is not None else 60.0),
            temperatures=None
            if temperature_degree is None
            else [263.15 + 20.0 * k for k in range(temperature_degree + 2)],
            fault=moved,
            series=1 if moved is not None else 0,
        )
    except ValueError as error:
        raise RailnavError(str(error)) from error
    write_positions(made.logs, folder, latitude=made.latitude)
    truth = {
        "simulated": True,
        "unit": unit,
        "seed": seed,
        "positions": len(made.logs),
        "accelerometer_bias_m_s2": made.accelerometer.bias,
        "accelerometer_scale": made.accelerometer.scale,
        "gyroscope_bias_rad_s": made.gyroscope.bias,
        "gyroscope_scale": made.gyroscope.scale,
        "output": folder,
    }
    if as_json:
        print_json(truth)
    else:
        click.echo(f"{folder} written: {len(made.logs)} positions of a simulated {unit}")
