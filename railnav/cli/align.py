"""`railnav align`: which way a standing vehicle looks."""

from __future__ import annotations

from pathlib import Path

import click

from railnav.cli._verb import PATH, json_option

UNITS = ("L3G4200D", "IMU440", "RT3003", "STIM300", "ASM330LHH")


@click.command("align")
@click.argument("run", type=PATH)
@click.option("--calibration", type=PATH, help="Calibration file of the IMU, .toml.")
@click.option("--between", metavar="FROM-TO", help="Seconds of the run, e.g. 0-60.  [default: the longest rest]")
@click.option("--latitude", type=click.FloatRange(-90, 90), help="Latitude, degrees.  [default: from GNSS]")
@click.option(
    "--unit",
    type=click.Choice(UNITS),
    help="Data sheet of the IMU: what biases remain without a calibration, and wander with one.",
)
@click.option(
    "--gyro-bias",
    type=click.FloatRange(0, min_open=True),
    help="Gyro bias that may remain (1 sigma), degrees per hour.",
)
@click.option(
    "--accelerometer-bias",
    type=click.FloatRange(0, min_open=True),
    help="Accelerometer bias that may remain (1 sigma), mg.",
)
@click.option(
    "--antennas",
    nargs=2,
    metavar="N,E,D F,R,D",
    help="Two antennas: the measured vector from the first to the second, north, east, down, and the mounted one, forward, right, down, m.",
)
@click.option(
    "--antenna-sigma",
    type=click.FloatRange(0, min_open=True),
    default=0.01,
    show_default=True,
    help="Standard deviation of each level component of the measured vector, m.",
)
@click.option("--fine", is_flag=True, help="Refine by zero-velocity updates over the whole rest.")
@json_option
def command(
    run: Path,
    calibration: Path | None,
    between: str | None,
    latitude: float | None,
    unit: str | None,
    gyro_bias: float | None,
    accelerometer_bias: float | None,
    antennas: tuple[str, str] | None,
    antenna_sigma: float,
    fine: bool,
    as_json: bool,
) -> None:
    """Align a standing vehicle: roll, pitch, gyrocompass heading and latitude, with confidence intervals.

    RUN is a folder with a run.toml. The longest rest that neither GNSS nor odometer contradicts is used; a vehicle that moves is refused,
    with the evidence. Gyros that cannot see the Earth's rotation give no heading and no latitude, and it says so; then the heading of the
    first motion, from GNSS, is given if there is one.

    \b
    Example:
      railnav align demo/service --unit IMU440
    """  # noqa: D301
    from math import degrees, hypot, radians

    from railnav.cli._terminal import print_facts, print_json, print_warnings
    from railnav.errors import EstimationError, InputError
    from railnav.inertial.heading import heading_from_antennas
    from railnav.inertial.sensors import GRADES
    from railnav.inertial.standing import INTERVAL_95, align_standing
    from railnav.io.imu_calibration import calibrated_run, named_calibration, read_calibration
    from railnav.io.run import read_run

    window = _window(between) if between is not None else None
    vectors = [_three(text) for text in antennas] if antennas is not None else None
    recorded = read_run(run)
    if recorded.imu is None:
        raise InputError("the run has no IMU", file=run, remedy="there is nothing to align with")
    gyro = radians(gyro_bias) / 3600.0 if gyro_bias is not None else None
    force = 9.80665e-3 * accelerometer_bias if accelerometer_bias is not None else None
    remarks: list[str] = []
    sheets = None
    if unit is not None:
        sheets = GRADES[f"{unit} gyroscope"], GRADES[f"{'LSM303DLH' if unit == 'L3G4200D' else unit} accelerometer"]
    known = read_calibration(calibration) if calibration is not None else named_calibration(run)
    recorded = calibrated_run(recorded, calibration)
    if known is not None:
        left = [known.gyro_bias_sigma(), known.accelerometer_bias_sigma()]
        if sheets is not None:  # what the calibration leaves, and what the bias does in the run
            left = [
                None if one is None else hypot(one, sheet.instability) for one, sheet in zip(left, sheets, strict=True)
            ]
        elif (
            gyro is None
            and left[0] is not None
            and (known.gyroscope_noise is None or known.gyroscope_noise.bias_instability == 0.0)
        ):
            remarks.append(
                "the calibration does not say how far the gyros' biases wander: its own sigma is taken alone; name the data sheet "
                "with --unit"
            )
        gyro, force = (left[0] if gyro is None else gyro), (left[1] if force is None else force)
    if sheets is not None:
        biases = [hypot(sheet.bias, sheet.instability) for sheet in sheets]
        gyro, force = (biases[0] if gyro is None else gyro), (biases[1] if force is None else force)
    try:
        got = align_standing(
            recorded,
            between=window,
            latitude=None if latitude is None else radians(latitude),
            gyro_bias_sigma=gyro,
            accelerometer_bias_sigma=force,
            fine=fine,
        )
        a, best = got.alignment, got.fine
        roll, pitch = (a.roll, a.pitch) if best is None else (best.roll, best.pitch)
        seen: tuple[float | None, float | None] = (None, None)
        if vectors is not None:
            seen = heading_from_antennas(vectors[0], vectors[1], roll=roll, pitch=pitch, sigma=antenna_sigma)
    except EstimationError as error:
        raise InputError(str(error), file=run) from error
    sigma_roll, sigma_pitch = a.sigma_roll, a.sigma_pitch
    heading = a.heading if best is None else best.heading
    sigma_heading = a.sigma_heading if best is None else float(best.sigma_attitude_n[2])
    angles = {
        "roll": (roll, sigma_roll),
        "pitch": (pitch, sigma_pitch),
        "heading": (heading, sigma_heading),
        "latitude": (got.latitude, got.sigma_latitude),
        "heading_by_antennas": seen,
        "heading_of_first_motion": (got.velocity_heading, got.sigma_velocity_heading),
    }
    if as_json:
        out: dict[str, object] = {
            "run": recorded.id,
            "begin_s": got.begin,
            "end_s": got.end,
            "calibration": recorded.imu.calibration if recorded.imu else "",
            "method": "fine" if best is not None else a.method,
            "gyro_bias_sigma_deg_h": degrees(got.gyro_bias_sigma) * 3600.0,
            "accelerometer_bias_sigma_mg": got.accelerometer_bias_sigma / 9.80665e-3,
            "coning_deg_h": degrees(got.coning) * 3600.0,
            "rate_deg_h": [degrees(v) * 3600.0 for v in got.still.rate_ib_b],
            "specific_force_m_s2": got.still.specific_force_b,
        }
        for key, (value, sigma) in angles.items():
            known_both = value is not None and sigma is not None
            out[f"{key}_deg"] = degrees(value) if value is not None else None
            out[f"sigma_{key}_deg"] = degrees(sigma) if known_both and sigma is not None else None
        out |= {"heading_note": a.note, "latitude_note": got.latitude_note, "remarks": [*got.remarks, *remarks]}
        print_json(out)
        return

    def words(key: str, note: str = "") -> str:
        value, sigma = angles[key]
        if value is None or sigma is None:
            return note
        half = INTERVAL_95 * degrees(sigma)
        digits = max(0, min(5, 1 - _exponent(half)))
        shown = degrees(value) % 360.0 if "heading" in key else degrees(value)
        return f"{shown:.{digits}f} +- {half:.{digits}f} degrees (95 %)"

    print_facts(
        f"{recorded.id}: at rest from {got.begin:.1f} to {got.end:.1f} s",
        {
            "Roll (right side down)": words("roll"),
            "Pitch (nose up)": words("pitch"),
            "Heading": words("heading", f"none: {a.note}"),
            "Heading by two antennas": words("heading_by_antennas"),
            "Latitude": words("latitude", f"none: {got.latitude_note}"),
            "Heading of the first motion": words("heading_of_first_motion"),
            "Calibration": recorded.imu.calibration if recorded.imu else "",
        },
    )
    print_warnings([*got.remarks, *remarks])


def _exponent(value: float) -> int:
    from math import floor, log10

    return floor(log10(value)) if value > 0.0 else -5


def _three(text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise click.BadParameter(f"{text!r} is not three lengths in m, e.g. 0,2,0", param_hint="--antennas") from None
    return x, y, z


def _window(text: str) -> tuple[float, float]:
    begin, _, end = text.partition("-")
    try:
        window = float(begin), float(end)
    except ValueError:
        raise click.BadParameter(f"{text!r} is not FROM-TO in seconds, e.g. 0-60", param_hint="--between") from None
    if not window[0] < window[1] < float("inf"):
        raise click.BadParameter(f"{text!r} does not grow", param_hint="--between")
    return window
