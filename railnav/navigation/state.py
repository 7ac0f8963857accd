"""What the navigator estimates, and what it assumes: the state by name, and the settings with their reasons."""

from __future__ import annotations

from dataclasses import astuple, dataclass, fields
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


class State(IntEnum):
    """States of the navigator, in an order that makes the transition matrix lower triangular.

    A run carries those that its streams need (`layout`). GNSS errors are E and N components; the correlated part is in units of
    the fix's own sigma, so that it grows and shrinks with it.
    """

    FRAME_EAST = 0  # constant part of the GNSS error of a run, m
    FRAME_NORTH = 1
    GNSS_EAST = 2  # correlated part of the GNSS error, first-order Gauss-Markov with variance 1, times the fix's sigma
    GNSS_NORTH = 3
    MAP_CROSS = (
        4  # the model's own error across the hypothesis' track, in units of its stated sigma, correlated over a length
    )
    TIME_TAG = 5  # a fix stamped t shows where the train is at t + this, s: loggers round, lose and spread stamps
    SPEED_LATENCY = 6  # how old the receiver's speed is, s: receivers smooth it, by 0.2 to 0.9 s
    SPEED_ERROR = 7  # correlated part of its error, in units of its sigma
    ODOMETER_SCALE = 8  # wheel distance = (1 + scale) * distance
    GYRO_BIAS = 9  # yaw gyro, rad/s
    GYRO_TILT = 10  # what the yaw gyro feels of the vehicle's roll rate: pitch of its mounting, rad
    SIDE_BIAS = 11  # accelerometer to the right, m/s^2; takes up the roll of the mounting too
    ACCELEROMETER_BIAS = 12  # forward accelerometer, m/s^2; takes up the tilt of the mounting too
    ACCELERATION = 13  # along the nose, m/s^2, Gauss-Markov; only where no accelerometer measures it
    SPEED = 14  # along the nose, m/s: negative when backing up
    POSITION = 15  # along the hypothesis' path, growing towards the nose, m
    WHEEL_DISTANCE = 16  # what the odometer would read without its rounding, m


def layout(*, imu: bool, odometer: str, speed: bool = True, map_error: bool = False) -> IntArray:
    """Index of each state in the vector that a run needs, -1 where it needs none.

    Parameters
    ----------
    imu : bool
        Whether accelerometer and gyro are there.
    odometer : str
        "distance", "speed" or "" (none).
    speed : bool
        Whether the receiver gives a speed.
    map_error : bool
        Whether the model's own error across its tracks is large enough to be estimated.

    Returns
    -------
    (17,) int array
        Index by `State`.

    Examples
    --------
    >>> layout(imu=False, odometer="").tolist()
    [0, 1, 2, 3, -1, 4, 5, 6, -1, -1, -1, -1, -1, 7, 8, 9, -1]
    """
    needed = {
        State.MAP_CROSS: map_error,
        State.SPEED_LATENCY: speed,
        State.SPEED_ERROR: speed,
        State.ODOMETER_SCALE: odometer != "",
        State.GYRO_BIAS: imu,
        State.GYRO_TILT: imu,
        State.SIDE_BIAS: imu,
        State.ACCELEROMETER_BIAS: imu,
        State.ACCELERATION: not imu,
        State.WHEEL_DISTANCE: odometer == "distance",
    }
    at = np.full(len(State), -1, np.int64)
    index = 0
    for state in State:
        if needed.get(state, True):
            at[state] = index
            index += 1
    return at


@dataclass(frozen=True, slots=True)
class Settings:
    """What the navigator assumes of sensors and trains: SI, one value each.

    The defaults are for single-frequency GNSS and MEMS inertial sensors on a train. Receivers' sigmas are taken as they are stated,
    then scaled by what the innovations show (`scale_prior`, within `scale_least` and `scale_most`).

    Attributes
    ----------
    gnss_correlation_time : float
        Correlation time of the GNSS error, s. Receivers on line 80 show 25-60 s, open-sky code positioning 100 s.
    gnss_correlated_share, gnss_white_share, gnss_frame_share : float
        Parts of a stated sigma: correlated, from fix to fix, and constant over the run.
    frame_sigma_least, frame_sigma_most : float
        Bounds of the constant part's sigma, m; it grows when a run's fixes lie aside by more than it allows.
    model_sigma : float
        Standard deviation of the model's frame, m; counts towards the constant part.
    model_length : float
        Length over which the model's error across its tracks is correlated, m; what is stated of it stands in the model's covariance.
    scale_start, scale_prior : float
        Factor on stated sigmas at the start, and the number of independent errors it is worth when it is scaled by what is seen.
    scale_least, scale_most : float
        Bounds of that scale.
    gate : float
        A fix whose squared normalised innovation exceeds this in every hypothesis is suspect (chi-square, 2: 1e-5).
    step_fixes : float
        After so many suspect fixes in a row the GNSS error is taken to have stepped.
    lost_after : float
        Seconds of suspect fixes after which the navigator starts afresh.
    time_tag_sigma, time_tag_walk : float
        Time stamps of fixes: sigma at the start, s, and random walk, s/sqrt(s). Sudden jumps along the track are taken up apart.
    time_tag_most : float
        Largest jump of the stamps that is told from a jump of the position, s.
    speed_sigma : float
        Sigma of GNSS speed where the receiver states none, m/s.
    speed_latency : float
        Sigma of the age of a receiver's speed, s.
    speed_error_share, speed_error_time : float
        Correlated part of the speed's sigma, and its correlation time, s.
    course_sigma : float
        Least sigma of the GNSS course, rad; it adds to sigma_speed / speed.
    acceleration_sigma, acceleration_time : float
        Train acceleration where no accelerometer measures it: standard deviation, m/s^2, and correlation time, s.
    accelerometer_noise : float
        Density of the forward accelerometer's noise, vibration included, m/s^2/sqrt(Hz).
    accelerometer_bias, accelerometer_walk : float
        Bias at the start, m/s^2, and its random walk, m/s^2/sqrt(s).
    gradient_walk : float
        Added to that walk where the model has no heights, m/s^2/sqrt(s).
    gyro_bias, gyro_walk : float
        Yaw gyro: bias at the start, rad/s, and its random walk, rad/s/sqrt(s).
    gyro_floor : float
        Least sigma of one yaw-rate mean of a moving vehicle, rad/s: hunting and track irregularity.
    gyro_scale : float
        Sigma of the yaw gyro's scale, tilt included.
    gyro_tilt : float
        Sigma of the unknown pitch of the IMU's mounting, rad: as the train rolls into canted curves, the yaw gyro feels it.
    side_bias, side_walk : float
        Accelerometer to the right: bias at the start (roll of the mounting times gravity included), m/s^2, and random walk,
        m/s^2/sqrt(s).
    side_noise, side_time, side_scale : float
        Its noise on a moving vehicle (sway), m/s^2, how long that is correlated, s, and the share of what it reads that a
        vehicle body leaning on its springs adds or takes.
    balise_sigma : float
        Sigma of a balise reading where none is stated, m.
    gnss_fault : float
        Probability that the receiver has gone astray within the last two minutes, in a way that its fixes do not show: the protection
        level then rests on the wheel alone since before that. 0: it is not reckoned with.
    frame_fault, frame_fault_sigma : float
        Probability that a run's frame is off by far more than is known of it (a wrong datum, an antenna elsewhere, a map moved), and
        the standard deviation of that, m. With `astray_rate` it limits what positions alone may say of tracks side by side.
    frame_walk : float
        How the constant part of the error across the track wanders, m/sqrt(s).
    track_missing : float
        Probability that a train starts on a track that the model lacks, beside one that it has. No track is declared before that is
        unlikely. 0.1 would leave nothing declared on a line that is known to a metre or two, where fixes cannot rule that track out.
    astray_rate, astray_walk, astray_time : float
        How often a receiver goes astray, or comes to a stretch where the track lies elsewhere than the model has it, 1/s; how its
        error across the track then wanders, m/sqrt(s), and how long that lasts on average, s.
    balise_missed : float
        Probability that a balise is passed and not read.
    curvature_sigma, curvature_shift, curvature_length : float
        Errors of the curvature of a model that states none of its own (see `railnav.navigation.shape`): of its value, 1/m, of the place
        where it changes, m, and the length over which both are correlated, m.
    course_doubt : float
        Difference in bearing that does not tell one track from another, rad; a turnout's legs part by 0.05 and more.
    curvature_doubt : float
        Difference in curvature that does not tell one track from another, 1/m: what a surveyed model may be wrong by in
        transitions. Tracks side by side differ by less, a turnout's leg by ten times as much.
    odometer_scale, odometer_scale_walk : float
        Wheel scale: sigma at the start, and random walk, 1/sqrt(s).
    odometer_sigma : float
        Rounding of a distance reading, m.
    odometer_slip : float
        Random creep of a rolling wheel, m/sqrt(m).
    odometer_speed_sigma : float
        Sigma of an odometer's speed where it states none, m/s.
    slip_gate : float
        Sigmas of disagreement at which a wheel slips or slides.
    slip_longest : float
        Longest slip, s; after it the wheel is believed again.
    standstill_sigma : float
        Sigma of the speed of a train found to stand, m/s.
    standstill_time : float
        How long wheels (or a GNSS speed) must rest before the train is held to stand, s.
    reverse_prior : float
        Prior probability that a train first moves against its nose.
    rival_prior : float
        Prior odds, a minute, that the train is on a track nearby that no hypothesis holds and the model does not lead to.
    track_confidence : float
        Posterior at which a track is declared; below it the mode is ambiguous.
    coasting_after : float
        Seconds without a GNSS fix after which the mode is coasting.
    lost_sigma : float
        Standard deviation along the track beyond which the position is lost, m.
    sigma_usable : float
        Fixes with a stated sigma beyond this are not used, m.
    evidence_memory : float
        How long the evidence of GNSS positions counts, s; a third of it on a model with errors of its own. Errors that last longer
        than any correlation time (a frame, a reflecting wall, a logger's fault) tell the same again and again; they must not add up
        to certainty.
    position_doubt : float
        Probability that model and receiver are together five times as wrong as they say; a model with errors of its own (a build of
        a few low-cost runs) is given a hundred times that.
    merge_distance : float
        Squared Mahalanobis distance below which hypotheses on one path are one.
    prune_below : float
        Posterior below which a hypothesis is dropped.
    most_hypotheses : float
        Hypotheses kept.
    gravity : float
        m/s^2.
    """

    gnss_correlation_time: float = 60.0
    gnss_correlated_share: float = 0.9
    gnss_white_share: float = 0.5
    gnss_frame_share: float = 0.3
    frame_sigma_least: float = 0.01
    frame_sigma_most: float = 20.0
    model_sigma: float = 0.0
    model_length: float = 1000.0
    scale_start: float = 1.0
    scale_prior: float = 3.0
    scale_least: float = 0.6
    scale_most: float = 6.0
    gate: float = 23.0
    step_fixes: float = 3.0
    lost_after: float = 30.0
    time_tag_sigma: float = 0.02
    time_tag_walk: float = 1e-3
    time_tag_most: float = 2.5
    speed_sigma: float = 0.4
    speed_latency: float = 0.5
    speed_error_share: float = 0.4
    speed_error_time: float = 30.0
    course_sigma: float = 0.01
    acceleration_sigma: float = 0.5
    acceleration_time: float = 12.0
    accelerometer_noise: float = 0.02
    accelerometer_bias: float = 0.15
    accelerometer_walk: float = 5e-4
    gradient_walk: float = 0.02
    gyro_bias: float = 0.01
    gyro_walk: float = 5e-6
    gyro_floor: float = 3e-4
    gyro_scale: float = 0.01
    gyro_tilt: float = 5e-3
    side_bias: float = 0.1
    side_walk: float = 2e-4
    side_noise: float = 0.15
    side_time: float = 1.0
    side_scale: float = 0.2
    balise_sigma: float = 0.5
    gnss_fault: float = 1e-3
    frame_fault: float = 0.015
    frame_fault_sigma: float = 8.0
    frame_walk: float = 0.03
    track_missing: float = 0.03
    astray_rate: float = 1e-3
    astray_walk: float = 1.2
    astray_time: float = 20.0
    balise_missed: float = 1e-3
    curvature_sigma: float = 2e-5
    curvature_shift: float = 0.4
    curvature_length: float = 20.0
    course_doubt: float = 0.01
    curvature_doubt: float = 2e-4
    odometer_scale: float = 0.01
    odometer_scale_walk: float = 2e-6
    odometer_sigma: float = 0.02
    odometer_slip: float = 0.002
    odometer_speed_sigma: float = 0.1
    slip_gate: float = 4.0
    slip_longest: float = 60.0
    standstill_sigma: float = 0.02
    standstill_time: float = 1.0
    reverse_prior: float = 0.02
    rival_prior: float = 1e-2
    track_confidence: float = 0.99
    coasting_after: float = 3.0
    lost_sigma: float = 500.0
    sigma_usable: float = 60.0
    evidence_memory: float = 600.0
    position_doubt: float = 1e-4
    merge_distance: float = 1.0
    prune_below: float = 1e-6
    most_hypotheses: float = 16.0
    gravity: float = 9.80665

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (np.isfinite(value) and value >= 0.0):
                raise ValueError(f"setting {field.name} is {value}: it must be finite and not negative")

    @classmethod
    def of_receiver(cls, receiver: str) -> Settings:
        """Defaults for a kind of receiver, as run.toml names it: phones and navigation chips state sigmas of their own making.

        Measured on line 80 against the median of the other runs: iPhones 2.5-3 m correlated over 33 s where they state 4-6 m;
        u-blox M8 4-6 m over 50 s, with 6-10 m that stay, where it states 1.5 m.

        Examples
        --------
        >>> Settings.of_receiver("ublox").scale_start
        3.0
        """
        kind = receiver.lower()
        if "iphone" in kind:
            return cls(gnss_correlation_time=35.0, scale_start=0.8)
        if any(name in kind for name in ("ublox", "u-blox")):
            return cls(gnss_correlation_time=50.0, scale_start=3.0, gnss_frame_share=2.0)
        if "mtk" in kind:
            return cls(gnss_correlation_time=40.0, gnss_frame_share=0.5)
        return cls()

    def packed(self) -> FloatArray:
        """All values in the order of the fields, as the kernels read them."""
        return np.array(astuple(self), np.float64)


#: Index of each setting in `Settings.packed`, by name.
SETTING = {field.name: i for i, field in enumerate(fields(Settings))}
