"""What a run declares of its sensors' errors, as the navigator's settings."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from railnav.navigation.epochs import SIGMA_PER_HDOP, UNSTATED_SIGMA
from railnav.navigation.state import Settings
from railnav.run import GnssErrors, GnssStream, ImuErrors, OdometerErrors, Run

#: Least share of a part of the receiver's error that is declared to be absent, and of a sigma that is declared to be nothing.
LEAST_SHARE = 1e-3
#: Least sigma of the stamps' offset, s; how long it takes a declared offset to be off by as much again, s.
LEAST_STAMP, STAMP_LASTS = 1e-4, 3600.0
#: Least sigma of a yaw-rate mean beside what its samples show, rad/s.
LEAST_SWAY = 1e-4
#: A declared receiver's scale is worth so many independent errors seen.
DECLARED_WORTH = 30.0


def settings_of(run: Run, base: Settings | None = None) -> Settings:
    """Settings for a run: the usual ones of its kind of receiver, and what it declares of its sensors in their place.

    Parameters
    ----------
    run : Run
        `run.gnss.errors`, `run.imu.errors` and `run.odometer.errors` are read, where they are there.
    base : Settings, optional
        Instead of `Settings.of_receiver`.

    Returns
    -------
    Settings

    Notes
    -----
    A receiver's parts are declared in metres and carried as shares of the sigma that it states (the median over the run), so that
    they grow and shrink with it. What a sheet cannot know of the vehicle keeps its usual value unless it is declared: sway and vibration.
    In curves a mounting that is off by m turns the side force into a forward one, m f_y: the walk of the accelerometer's bias is never
    taken for less than usual.

    Examples
    --------
    >>> from railnav.simulation import Leg, demo_line, simulate
    >>> run, _ = simulate(demo_line(spacing=20.0), Leg(("77R-01",), finish=300.0), seed=1, declare=True)
    >>> round(settings_of(run).gnss_white_share, 3)
    0.336
    """
    gnss, imu, odometer = run.gnss, run.imu, run.odometer
    settings = base or Settings.of_receiver("" if gnss is None else gnss.receiver)
    if gnss is not None and gnss.errors is not None:
        settings = _of_gnss(settings, gnss.errors, _usual_sigma(gnss))
    if imu is not None and imu.errors is not None:
        settings = _of_imu(settings, imu.errors)
    if odometer is not None and odometer.errors is not None:
        settings = _of_odometer(settings, odometer.errors)
    return settings


def _known(**values: float) -> dict[str, float]:
    """Those that are declared; max(NaN, least) is NaN in this order."""
    return {name: value for name, value in values.items() if not math.isnan(value)}


def _usual_sigma(gnss: GnssStream) -> float:
    """Sigma of a horizontal axis that the filter will take a fix of this receiver for, in the median, m."""
    unstated = np.full(len(gnss), UNSTATED_SIGMA)
    if gnss.hdop is not None:
        unstated = np.where(np.isfinite(gnss.hdop), SIGMA_PER_HDOP * gnss.hdop, unstated)
    both = [
        unstated if s is None else np.where(np.isfinite(s), s, unstated) for s in (gnss.sigma_east, gnss.sigma_north)
    ]
    return float(np.median(np.sqrt(0.5 * (both[0] ** 2 + both[1] ** 2))))


def _of_gnss(settings: Settings, errors: GnssErrors, stated: float) -> Settings:
    told = _known(
        gnss_white_share=max(errors.white / stated, LEAST_SHARE),
        gnss_correlated_share=max(errors.correlated / stated, LEAST_SHARE),
        gnss_frame_share=errors.frame_offset / stated,
        gnss_correlation_time=errors.correlation_time,
        speed_latency=max(errors.speed_latency, LEAST_SHARE),
        speed_error_share=max(errors.speed_correlated, LEAST_SHARE),
    )
    if not math.isnan(errors.stamp):
        stamp = max(errors.stamp, LEAST_STAMP)
        told |= {"time_tag_sigma": stamp, "time_tag_walk": stamp / math.sqrt(STAMP_LASTS)}
    if "gnss_white_share" in told and "gnss_correlated_share" in told:
        told |= {"scale_start": 1.0, "scale_prior": DECLARED_WORTH}
    return replace(settings, **told)


def _of_imu(settings: Settings, errors: ImuErrors) -> Settings:
    told = _known(
        gyro_bias=errors.gyro_bias,
        gyro_walk=errors.gyro_walk,
        gyro_scale=max(errors.gyro_scale, LEAST_SHARE),
        gyro_tilt=errors.mounting,
        gyro_floor=max(errors.sway, LEAST_SWAY),
        accelerometer_noise=errors.vibration,
        accelerometer_walk=max(errors.accelerometer_walk, settings.accelerometer_walk),
    )
    if not math.isnan(errors.accelerometer_bias) and not math.isnan(errors.mounting):
        bias = math.hypot(errors.accelerometer_bias, settings.gravity * errors.mounting)
        told |= {"accelerometer_bias": bias, "side_bias": bias}
    return replace(settings, **told)


def _of_odometer(settings: Settings, errors: OdometerErrors) -> Settings:
    told = _known(odometer_scale=max(errors.scale, 1e-4), odometer_slip=max(errors.creep, 1e-4))
    return replace(settings, **told)
