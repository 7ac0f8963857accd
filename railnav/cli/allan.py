"""`railnav allan`: the noise of an inertial unit at rest."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from railnav.cli._verb import PATH, json_option

TERMS = ("quantisation", "random_walk", "bias_instability", "gauss_markov", "rate_random_walk", "ramp")


@click.command("allan")
@click.argument("log", type=PATH)
@click.option("-o", "--output", type=PATH, help="Drawing of the curves: .png, .svg, .pdf or .html.")
@click.option("--calibration", type=PATH, help="Calibration file of the IMU, .toml: correct the samples first.")
@click.option("--between", metavar="FROM-TO", help="Seconds of the log, e.g. 0-3600.  [default: the longest rest]")
@click.option(
    "--term",
    "terms",
    type=click.Choice(TERMS),
    multiple=True,
    help="Part of the noise to look for; may be given more than once.  [default: random_walk, bias_instability, rate_random_walk]",
)
@json_option
def command(
    log: Path, output: Path | None, calibration: Path | None, between: str | None, terms: tuple[str, ...], as_json: bool
) -> None:
    """Measure the noise of an inertial unit at rest: Allan deviation, drawn, and the parameters that explain it.

    LOG is a run folder or a table with the columns of an IMU stream. Parameters are given in the units of data sheets, each with its
    standard deviation; a part that the log is too short to show is left empty.

    \b
    Example:
      railnav allan positions/01 -o allan.png
    """  # noqa: D301
    from railnav.cli import _files
    from railnav.cli._terminal import print_json, print_table
    from railnav.cli.align import _window
    from railnav.errors import EstimationError, InputError

    if output is not None:
        _files.check_output(output, _files.PICTURE_ENDINGS, inputs=_files.members(log) or [log])
        _files.need_report()
    from railnav.inertial.allan import unit_noise
    from railnav.io.imu_calibration import calibrated_stream
    from railnav.io.positions import read_positions

    found = read_positions(log)
    if not found.whole:
        raise InputError("is a folder of positions", file=log, remedy="name one of the logs in it")
    imu = found.logs[0].imu
    if calibration is not None:
        imu = calibrated_stream(imu, calibration)
    wanted = terms or ("random_walk", "bias_instability", "rate_random_walk")
    try:
        noise = unit_noise(imu, between=_window(between) if between is not None else None, terms=wanted)
    except (EstimationError, ValueError) as error:
        raise InputError(str(error), file=log) from error
    curves, fits = noise.curves, noise.fits
    if output is not None:
        from railnav.web.allan import allan_page, allan_picture

        title = f"{found.logs[0].name}: Allan deviation, {curves['gyro x'].duration:.0f} s"
        if output.suffix.lower() == ".html":
            _files.write_text(output, allan_page(curves, fits, title=title))
        else:
            from railnav.web.pictures import save

            save(allan_picture(curves, fits, title=title), output)
    if as_json:
        facts: dict[str, Any] = {
            "log": log,
            "begin_s": noise.begin,
            "end_s": noise.end,
            "interval_s": noise.interval,
            "output": output,
            "channels": {
                name: {
                    **{term: getattr(fit, term) for term in TERMS},
                    "correlation_time_s": fit.correlation_time,
                    "sigma": fit.sigma,
                    "misfit": fit.misfit,
                    "time_s": curves[name].time,
                    "deviation": curves[name].deviation,
                }
                for name, fit in fits.items()
            },
        }
        print_json(facts)
        return
    print_table(
        f"{found.logs[0].name}: noise from {curves['gyro x'].duration:.0f} s at {1.0 / noise.interval:.0f} Hz",
        ("channel", *(cell for term in wanted for cell in (term.replace("_", " "), "")), "misfit"),
        [_row(name, fit, wanted, curves[name].time) for name, fit in fits.items()],
    )
    if output is not None:
        click.echo(f"{output} written")


def _row(name: str, fit: Any, terms: tuple[str, ...], time: Any) -> tuple[str, ...]:
    """One channel in the units of data sheets; what does not stand out of its sigma is left empty."""
    from math import degrees

    gyro = name.startswith("gyro")
    hour, milli = degrees(1.0) * 3600.0, 1e3 / 9.80665
    units = {
        "quantisation": (hour, "arc seconds") if gyro else (1e3, "mm/s"),
        "random_walk": (degrees(1.0) * 60.0, "deg/sqrt(h)") if gyro else (60.0, "m/s/sqrt(h)"),
        "bias_instability": (hour, "deg/h") if gyro else (milli, "mg"),
        "gauss_markov": (hour, f"deg/h, {fit.correlation_time:.3g} s")
        if gyro
        else (milli, f"mg, {fit.correlation_time:.3g} s"),
        "rate_random_walk": (hour * 60.0, "deg/h/sqrt(h)") if gyro else (milli * 60.0, "mg/sqrt(h)"),
        "ramp": (hour * 3600.0, "deg/h/h") if gyro else (milli * 3600.0, "mg/h"),
    }
    cells: list[str] = []
    for term in terms:
        scale, unit = units[term]
        found = fit.stands_out(term, time)
        cells += [f"{getattr(fit, term) * scale:.3g} +- {fit.sigma[term] * scale:.1g}", unit] if found else ["", ""]
    return (name, *cells, f"{fit.misfit:.2f}")
