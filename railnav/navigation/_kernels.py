"""Inner loops of the navigator: the arc-length square-root filter over all hypotheses, one epoch after the other.

Float64 arrays, SI, radians, no validation. Equation numbers are those of the specification (section 19). Kernels of
`railnav.matching` are compiled in: after a change there, this file's numba cache must be emptied too.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from railnav.matching._kernels import (
    AGREE_SINCE,
    CURRENT,
    FADING,
    MOVED,
    P_CANT,
    P_CURVATURE,
    P_D_EAST,
    P_D_NORTH,
    P_EAST,
    P_GRADIENT,
    P_GRADIENT_RATE,
    P_NORTH,
    POINT_SIZE,
    RECORD,
    SIGN,
    SLIP_SINCE,
    VERSION,
    COUNT,
    add_column,
    clone,
    drop,
    follow,
    leaving_end,
    entering_end,
    merge_all,
    normalise,
    path_index,
    path_point,
)
from railnav.navigation.solution import Mode
from railnav.navigation.state import SETTING, State
from railnav.units import RAIL_CENTRE_DISTANCE

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

FRAME_EAST, FRAME_NORTH, GNSS_EAST, GNSS_NORTH = (
    int(State.FRAME_EAST),
    int(State.FRAME_NORTH),
    int(State.GNSS_EAST),
    int(State.GNSS_NORTH),
)
TIME_TAG, SPEED_LATENCY, SPEED_ERROR = int(State.TIME_TAG), int(State.SPEED_LATENCY), int(State.SPEED_ERROR)
ODOMETER_SCALE, GYRO_BIAS, ACCELEROMETER_BIAS = (
    int(State.ODOMETER_SCALE),
    int(State.GYRO_BIAS),
    int(State.ACCELEROMETER_BIAS),
)
ACCELERATION, SPEED, POSITION, WHEEL_DISTANCE = (
    int(State.ACCELERATION),
    int(State.SPEED),
    int(State.POSITION),
    int(State.WHEEL_DISTANCE),
)

INITIALISING, TRACKING, COASTING, AMBIGUOUS, OFF_MODEL, LOST = (
    int(Mode.INITIALISING),
    int(Mode.TRACKING),
    int(Mode.COASTING),
    int(Mode.AMBIGUOUS),
    int(Mode.OFF_MODEL),
    int(Mode.LOST),
)

# settings by name
K_GNSS_TIME = SETTING["gnss_correlation_time"]
K_CORRELATED = SETTING["gnss_correlated_share"]
K_WHITE = SETTING["gnss_white_share"]
K_FRAME = SETTING["gnss_frame_share"]
K_FRAME_LEAST = SETTING["frame_sigma_least"]
K_MODEL = SETTING["model_sigma"]
K_FRAME_MOST = SETTING["frame_sigma_most"]
K_SCALE_START = SETTING["scale_start"]
K_SCALE_PRIOR = SETTING["scale_prior"]
K_SCALE_LEAST = SETTING["scale_least"]
K_SCALE_MOST = SETTING["scale_most"]
K_GATE = SETTING["gate"]
K_STEP_FIXES = SETTING["step_fixes"]
K_LOST_AFTER = SETTING["lost_after"]
K_TAG_WALK = SETTING["time_tag_walk"]
K_TAG_MOST = SETTING["time_tag_most"]
K_SPEED_SIGMA = SETTING["speed_sigma"]
K_SPEED_SHARE = SETTING["speed_error_share"]
K_SPEED_TIME = SETTING["speed_error_time"]
K_COURSE_SIGMA = SETTING["course_sigma"]
K_ACC_SIGMA = SETTING["acceleration_sigma"]
K_ACC_TIME = SETTING["acceleration_time"]
K_FORCE_NOISE = SETTING["accelerometer_noise"]
K_FORCE_WALK = SETTING["accelerometer_walk"]
K_GYRO_WALK = SETTING["gyro_walk"]
K_GYRO_FLOOR = SETTING["gyro_floor"]
K_GYRO_SCALE = SETTING["gyro_scale"]
K_CURVATURE_SIGMA = SETTING["curvature_sigma"]
K_CURVATURE_SHIFT = SETTING["curvature_shift"]
K_CURVATURE_LENGTH = SETTING["curvature_length"]
K_ODOMETER_WALK = SETTING["odometer_scale_walk"]
K_ODOMETER_SIGMA = SETTING["odometer_sigma"]
K_ODOMETER_SLIP = SETTING["odometer_slip"]
K_ODOMETER_SPEED = SETTING["odometer_speed_sigma"]
K_SLIP_GATE = SETTING["slip_gate"]
K_SLIP_LONGEST = SETTING["slip_longest"]
K_STILL_SIGMA = SETTING["standstill_sigma"]
K_STILL_TIME = SETTING["standstill_time"]
K_REVERSE = SETTING["reverse_prior"]
K_CONFIDENCE = SETTING["track_confidence"]
K_COASTING = SETTING["coasting_after"]
K_LOST_SIGMA = SETTING["lost_sigma"]
K_USABLE = SETTING["sigma_usable"]
K_MEMORY = SETTING["evidence_memory"]
K_MERGE = SETTING["merge_distance"]
K_PRUNE = SETTING["prune_below"]
K_MOST = SETTING["most_hypotheses"]
K_GRAVITY = SETTING["gravity"]

#: Columns of the epoch table: what one epoch brings, NaN where it brings none.
(
    TIME,
    EAST,  # GNSS antenna in the grid, m
    NORTH,
    SIGMA_EAST,
    SIGMA_NORTH,
    GNSS_SPEED,
    COURSE_EAST,  # unit vector of the course in the grid
    COURSE_NORTH,
    SIGMA_SPEED,
    DISTANCE,  # odometer
    WHEEL_SPEED,
    SIGMA_WHEEL,
    FORCE,  # forward specific force, mean since the epoch before
    YAW_RATE,  # about the down axis, mean since the epoch before, Earth rate taken off
    SIGMA_YAW,
) = range(15)
EPOCH_SIZE = 15

#: Columns of the output table.
(
    OUT_TRACK,
    OUT_WAY,
    OUT_OFFSET,
    OUT_SPEED,
    OUT_ACCELERATION,
    OUT_SIGMA,
    OUT_LEVEL,
    OUT_PROBABILITY,
    OUT_MODE,
    OUT_DIRECTION,
    OUT_HYPOTHESES,
    OUT_SIGMA_SPEED,
    OUT_FIX_AGE,
) = range(13)
OUTPUT_SIZE = 13

#: What all hypotheses share: clock, receiver and wheel watch, decision, counters.
(
    C_TIME,
    C_FIX_TIME,
    C_SUSPECTS,
    C_SUSPECT_SINCE,
    C_SCALE_SUM,
    C_SCALE_WEIGHT,
    C_SCALE,
    C_FRAME_SIGMA,
    C_SIGMA_EAST,
    C_SIGMA_NORTH,
    C_WHEEL_MOVED,
    C_WHEEL_SEEN,
    C_GNSS_STILL,
    C_GNSS_SPEED,
    C_GNSS_SPEED_TIME,
    C_OUT_TRACK,
    C_OUT_WAY,
    C_BREAK,
    C_FRESH,
    C_TRY,
    C_NOTHING_NEAR,
    C_STARTED,
    C_FIXES,
    C_SUSPECT_FIXES,
    C_STEPS,
    C_SLIPS,
    C_STARTS,
    C_REVISIONS,
    C_RING,
    C_SPEED_STALE,  # 1: the receiver repeats its last speed to the last digit: no news
    C_STOOD,  # 1: the train stood at the epoch before
    C_JUMPS,  # steps lately, forgotten over half a minute
    C_FRAME_TIME,  # when the constant part's prior was last looked at
    C_DISTRUST,  # until when a receiver's resting speed is not believed: its positions moved meanwhile
) = range(34)
COMMON_SIZE = 34
#: Odometer readings remembered: time, distance.
RING = 32
#: Wheel speed is the mean over this long, s.
WHEEL_SPAN = 0.5
#: Standard deviations that forget the wheel distance (m) and shake the speed (m/s).
FORGET_WHEEL, SHAKE_SPEED = 10.0, 0.1
#: How long a receiver that said "at rest" while its positions moved is not believed, s.
DISTRUST = 300.0
#: Acceleration of a departing train, m/s^2.
KICK = 0.7
#: Random walk of the speed while an accelerometer that should be there is silent, m/s^2/sqrt(Hz).
SILENT_NOISE = 0.4
#: Squared normalised innovation at which a single sensor row is held; its evidence saturates there.
ROW_GATE = 16.0

#: Columns of a record's numbers, kept for the smoother.
R_EPOCH, R_PARENT, R_VERSION, R_LOGW, R_PULL, R_SLIP, R_SHAKE, R_STEP, R_TAG, R_SIGN = range(10)
RECORD_SIZE = 10
#: Those of them that the filter fills as it goes: from R_PULL on.
PULLS = 6

#: Why the loop stopped.
DONE, NEEDS_START, NEEDS_ROOM = range(3)

GAUSS_HERMITE_NODES = np.array([-2.8569700138728056, -1.355626179974266, 0.0, 1.355626179974266, 2.8569700138728056])
GAUSS_HERMITE_WEIGHTS = np.array(
    [0.011257411327720689, 0.2220759220056126, 0.5333333333333333, 0.2220759220056126, 0.011257411327720689]
)


class Filter(NamedTuple):
    """What stays the same over a run."""

    at: IntArray  # (11,) index of each state, -1 absent
    settings: FloatArray  # Settings.packed()
    lever: FloatArray  # (3,) reference point to antenna: forward, right, down, m
    risk: FloatArray  # (2,) integrity risk, two-sided normal quantile
    signed: int  # 1: the odometer counts backwards when backing up


class Shared(NamedTuple):
    """What all hypotheses share and every epoch changes."""

    common: FloatArray  # (COMMON_SIZE,)
    ring: FloatArray  # (RING, 2)
    weight: FloatArray  # (slots,)


class Records(NamedTuple):
    """What the smoother needs: one record a hypothesis and epoch; windows by version. Empty arrays when nothing is kept."""

    x: FloatArray  # (records, n)
    P_sqrt: FloatArray  # (records, n, n)
    numbers: FloatArray  # (records, RECORD_SIZE)
    track: IntArray  # (versions, window)
    way: IntArray  # (versions, window)
    begin: FloatArray  # (versions, window)
    count: IntArray  # (versions,)
    used: IntArray  # (3,) records, versions, whether records are kept


# ---------------------------------------------------------------- measurement equations (19.3)


@njit(cache=True)
def yaw_rate_kernel(speed, curvature, gradient, gradient_rate, cant):
    """Rate about the down axis without Earth rate and bias: v (kappa cos(alpha) cos(phi) - kappa_v sin(phi))."""
    cos_alpha = 1.0 / math.sqrt(1.0 + gradient * gradient)
    sin_phi = cant / RAIL_CENTRE_DISTANCE
    cos_phi = math.sqrt(1.0 - sin_phi * sin_phi)
    kappa_v = gradient_rate * cos_alpha * cos_alpha
    return speed * (curvature * cos_alpha * cos_phi - kappa_v * sin_phi)


@njit(cache=True)
def specific_force_kernel(speed, acceleration, curvature, gradient, gradient_rate, cant, gravity, out):
    """Specific force, forward, right, down, of a vehicle that follows the track (19.3)."""
    cos_alpha = 1.0 / math.sqrt(1.0 + gradient * gradient)
    sin_alpha = gradient * cos_alpha
    sin_phi = cant / RAIL_CENTRE_DISTANCE
    cos_phi = math.sqrt(1.0 - sin_phi * sin_phi)
    kappa_v = gradient_rate * cos_alpha * cos_alpha
    side = speed * speed * curvature * cos_alpha
    up = gravity * cos_alpha + speed * speed * kappa_v
    out[0] = acceleration + gravity * sin_alpha
    out[1] = side * cos_phi - up * sin_phi
    out[2] = -(side * sin_phi + up * cos_phi)


@njit(cache=True)
def antenna(point, lever, out):  # (POINT_SIZE,), (3,) -> out (4,): easting, northing, their derivatives along the path
    """Where the antenna is: the axis point plus the lever arm turned by bearing and cant; its derivative t + omega x lever."""
    te, tn = point[P_D_EAST], point[P_D_NORTH]
    sin_phi = point[P_CANT] / RAIL_CENTRE_DISTANCE
    cos_phi = math.sqrt(1.0 - sin_phi * sin_phi)
    right = lever[1] * cos_phi - lever[2] * sin_phi
    forward = lever[0] + lever[2] * point[P_GRADIENT]  # down x sin(grade): a mast leans back uphill
    out[0] = point[P_EAST] + forward * te + right * tn
    out[1] = point[P_NORTH] + forward * tn - right * te
    k = point[P_CURVATURE]
    along = 1.0 - right * k
    out[2] = along * te + forward * k * tn
    out[3] = along * tn - forward * k * te


# ---------------------------------------------------------------- square-root steps


@njit(cache=True)
def transition(fil, x, dt, sign, force, pull, slip, shake, step, tag, F, Q, lead, new):
    """Fill the transition matrix F (lower triangular), the noise columns Q with their first rows and the predicted state (19.2).

    `sign` is the direction in which an unsigned odometer counts; `pull` is g sin(grade); slip, shake, step, tag are variances that forget the wheel distance, shake the speed and let the GNSS
    error and its time stamps jump. Gives the number of noise columns.
    """
    # x (n,), F (n, n), Q (12, n) one noise column a row, lead (12,), new (n,)
    at = fil.at
    k = fil.settings
    n = x.shape[0]
    for i in range(n):
        new[i] = x[i]
        for j in range(n):
            F[i, j] = 0.0
        F[i, i] = 1.0
    i_ge, i_v, i_s = at[GNSS_EAST], at[SPEED], at[POSITION]
    phi = math.exp(-dt / k[K_GNSS_TIME])
    F[i_ge, i_ge] = phi
    F[i_ge + 1, i_ge + 1] = phi
    new[i_ge] = phi * x[i_ge]
    new[i_ge + 1] = phi * x[i_ge + 1]
    i_e = at[SPEED_ERROR]
    fade = 1.0
    if i_e >= 0:
        fade = math.exp(-dt / k[K_SPEED_TIME])
        F[i_e, i_e] = fade
        new[i_e] = fade * x[i_e]
    v = x[i_v]
    F[i_s, i_v] = dt
    i_a = at[ACCELERATION]
    i_f = i_a
    accelerometer = i_a < 0 and force == force
    if i_a >= 0:  # Gauss-Markov acceleration
        ta = k[K_ACC_TIME]
        p = math.exp(-dt / ta)
        gain_v = ta * (1.0 - p)
        gain_s = ta * (dt - gain_v)
        F[i_a, i_a] = p
        F[i_v, i_a] = gain_v
        F[i_s, i_a] = gain_s
        new[i_a] = p * x[i_a]
        dv = gain_v * x[i_a]
        ds = v * dt + gain_s * x[i_a]
    elif accelerometer:  # a = f - b - g sin(alpha)
        i_f = at[ACCELEROMETER_BIAS]
        a = force - x[i_f] - pull
        F[i_v, i_f] = -dt
        F[i_s, i_f] = -0.5 * dt * dt
        dv = a * dt
        ds = v * dt + 0.5 * dt * a * dt
    else:
        dv = 0.0
        ds = v * dt
    new[i_v] = v + dv
    new[i_s] = x[i_s] + ds
    i_d = at[WHEEL_DISTANCE]
    rate = 0.0
    if i_d >= 0:
        i_k = at[ODOMETER_SCALE]
        rate = sign * (1.0 + x[i_k])
        new[i_d] = x[i_d] + rate * ds
        F[i_d, i_k] = sign * ds
        F[i_d, i_v] = rate * dt
        if i_f >= 0:
            F[i_d, i_f] = rate * F[i_s, i_f]
    # noise columns
    c = 0
    for i in range(2):
        for j in range(n):
            Q[c, j] = 0.0
        Q[c, i_ge + i] = math.sqrt(1.0 - phi * phi + step)
        lead[c] = i_ge + i
        c += 1
    for j in range(n):
        Q[c, j] = 0.0
    Q[c, at[TIME_TAG]] = math.sqrt(k[K_TAG_WALK] ** 2 * dt + tag)
    lead[c] = at[TIME_TAG]
    c += 1
    if i_e >= 0:
        for j in range(n):
            Q[c, j] = 0.0
        Q[c, i_e] = math.sqrt(1.0 - fade * fade)
        lead[c] = i_e
        c += 1
    root = math.sqrt(dt)
    for which in range(3):
        i = at[ODOMETER_SCALE + which]
        if i >= 0:
            walk = k[K_ODOMETER_WALK] if which == 0 else (k[K_GYRO_WALK] if which == 1 else k[K_FORCE_WALK])
            for j in range(n):
                Q[c, j] = 0.0
            Q[c, i] = walk * root
            lead[c] = i
            c += 1
    if i_a >= 0:  # white jerk, integrated three times (Cholesky root of its covariance)
        q = k[K_ACC_SIGMA] * math.sqrt(2.0 / k[K_ACC_TIME]) * root
        for m in range(3):
            for j in range(n):
                Q[c, j] = 0.0
            if m == 0:
                Q[c, i_a] = q
                Q[c, i_v] = q * dt / 2.0
                Q[c, i_s] = q * dt * dt / 6.0
            elif m == 1:
                Q[c, i_v] = q * dt / math.sqrt(12.0)
                Q[c, i_s] = q * dt * dt / math.sqrt(48.0)
            else:
                Q[c, i_s] = q * dt * dt / math.sqrt(720.0)
            if i_d >= 0:
                Q[c, i_d] = rate * Q[c, i_s]
            lead[c] = i_a if m == 0 else (i_v if m == 1 else i_s)
            c += 1
    else:  # white acceleration, integrated twice
        q = (k[K_FORCE_NOISE] if accelerometer else SILENT_NOISE) * root
        for m in range(2):
            for j in range(n):
                Q[c, j] = 0.0
            if m == 0:
                Q[c, i_v] = q
                Q[c, i_s] = q * dt / 2.0
            else:
                Q[c, i_s] = q * dt / math.sqrt(12.0)
            if i_d >= 0:
                Q[c, i_d] = rate * Q[c, i_s]
            lead[c] = i_v if m == 0 else i_s
            c += 1
    if shake > 0.0:
        for j in range(n):
            Q[c, j] = 0.0
        Q[c, i_v] = math.sqrt(shake)
        lead[c] = i_v
        c += 1
        if i_a >= 0:
            for j in range(n):
                Q[c, j] = 0.0
            Q[c, i_a] = KICK
            lead[c] = i_a
            c += 1
    if i_d >= 0:
        for j in range(n):
            Q[c, j] = 0.0
        Q[c, i_d] = math.sqrt(k[K_ODOMETER_SLIP] ** 2 * abs(ds) + slip)
        lead[c] = i_d
        c += 1
    return c


@njit(cache=True)
def predict(x, P_sqrt, F, Q, lead, columns, new):
    """Carry a state and its lower-triangular covariance root over one step: F is lower triangular, noise columns are rotated in."""
    n = x.shape[0]
    for i in range(n - 1, -1, -1):
        x[i] = new[i]
        diagonal = F[i, i]
        for j in range(i + 1):
            P_sqrt[i, j] *= diagonal
        for m in range(i):
            f = F[i, m]
            if f != 0.0:
                for j in range(m + 1):
                    P_sqrt[i, j] += f * P_sqrt[m, j]
    for c in range(columns):
        add_column(P_sqrt, Q[c], lead[c])


@njit(cache=True)
def project(P_sqrt, h, f):  # (n, n) lower, (n,), (n,) out: f = P_sqrt^T h
    """Row of a measurement in the coordinates of the covariance root; gives h P h^T."""
    n = h.shape[0]
    for j in range(n):
        f[j] = 0.0
    for i in range(n):
        if h[i] != 0.0:
            for j in range(i + 1):
                f[j] += P_sqrt[i, j] * h[i]
    s = 0.0
    for j in range(n):
        s += f[j] * f[j]
    return s


@njit(cache=True)
def absorb(x, P_sqrt, f, innovation, variance, keep, move):
    """Let one scalar row in, given its projection f (Carlson's rotations, lower-triangular form)."""
    n = x.shape[0]
    s = variance
    for j in range(n - 1, -1, -1):
        grown = s + f[j] * f[j]
        keep[j] = math.sqrt(s / grown)
        move[j] = f[j] / math.sqrt(s * grown)
        s = grown
    gain = innovation / s
    for i in range(n):
        cross = 0.0
        for j in range(i, -1, -1):
            t = P_sqrt[i, j]
            P_sqrt[i, j] = keep[j] * t - move[j] * cross
            cross += t * f[j]
        x[i] += cross * gain


@njit(cache=True)
def robust_row(x, P_sqrt, h, innovation, variance, f, keep, move):
    """Let one scalar row in; beyond the gate its variance grows until it fits, and its evidence saturates. Gives ln p."""
    s = project(P_sqrt, h, f) + variance
    nis = innovation * innovation / s
    evidence = -0.5 * (min(nis, ROW_GATE) + math.log(s))
    if nis > ROW_GATE:
        variance += innovation * innovation / ROW_GATE - s
    absorb(x, P_sqrt, f, innovation, variance, keep, move)
    return evidence


@njit(cache=True)
def reweigh_frame(x, P_sqrt, old, new, f, column, keep, move):
    """Change the prior of the constant GNSS error from sigma `old` to `new` after the fact, exactly; gives the change of ln weight.

    Dividing the posterior by N(0, old^2) and multiplying by N(0, new^2) is, narrowing, one more row f = 0; widening, it adds to P
    the rank-one term d k k^T / (1 - d P_ff) with k = P e_f, d = 1/old^2 - 1/new^2. Either way the evidence changes by
    ln(old/new) - ln(1 - d P_ff)/2 + d f^2 / (2 (1 - d P_ff)).
    """
    n = x.shape[0]
    d = 1.0 / (old * old) - 1.0 / (new * new)
    change = 0.0
    for axis in range(2):
        p = 0.0
        for j in range(n):
            f[j] = P_sqrt[axis, j] if j <= axis else 0.0
            p += f[j] * f[j]
        room = max(1.0 - d * p, 1e-9)
        mean = x[axis]
        change += math.log(old / new) - 0.5 * math.log(room) + 0.5 * d * mean * mean / room
        if d < 0.0:
            absorb(x, P_sqrt, f, -mean, -1.0 / d, keep, move)
            continue
        root = math.sqrt(d / room)
        for i in range(n):
            t = 0.0
            for j in range(min(i, axis) + 1):
                t += P_sqrt[i, j] * f[j]
            x[i] += t * d * mean / room
            column[i] = t * root
        add_column(P_sqrt, column, 0)
    return change


@njit(cache=True)
def mixture_bound(weight, mean, sigma, count, risk, quantile):  # (count,) each -> m
    """Smallest L with sum w [Q((L - mu)/sigma) + Q((L + mu)/sigma)] <= risk (section 22), by bisection from above."""
    if count == 1:
        return quantile * sigma[0]
    low = 0.0
    high = 0.0
    for i in range(count):
        high = max(high, abs(mean[i]) + (quantile + 0.1) * sigma[i])
    root = math.sqrt(0.5)
    for _ in range(30):
        middle = 0.5 * (low + high)
        total = 0.0
        for i in range(count):
            total += (
                0.5
                * weight[i]
                * (math.erfc((middle - mean[i]) / sigma[i] * root) + math.erfc((middle + mean[i]) / sigma[i] * root))
            )
        if total > risk:
            low = middle
        else:
            high = middle
        if high - low < 1e-3 * high:
            break
    return high


# ---------------------------------------------------------------- one hypothesis, one epoch


@njit(cache=True)
def wheel_row(fil, shared, bank, h, time, distance, h_row, f, keep, move, column):
    """Odometer distance: a slipping wheel is forgotten until it agrees with the speed again. Gives ln p, slip and shake variances."""
    at = fil.at
    k = fil.settings
    x = bank.x[h]
    P_sqrt = bank.P_sqrt[h]
    n = x.shape[0]
    i_d, i_v, i_k = at[WHEEL_DISTANCE], at[SPEED], at[ODOMETER_SCALE]
    variance = k[K_ODOMETER_SIGMA] ** 2
    for j in range(n):
        h_row[j] = 0.0
    h_row[i_d] = 1.0
    innovation = distance - x[i_d]
    s = project(P_sqrt, h_row, f) + variance
    # mean wheel speed over the last half second against the estimate
    common = shared.common
    ring = shared.ring
    span = 0.0
    wheel = 0.0
    for m in range(1, RING):
        r = (int(common[C_RING]) - m) % RING
        if not ring[r, 0] > -np.inf:
            break
        span = time - ring[r, 0]
        wheel = (distance - ring[r, 1]) / span
        if span >= WHEEL_SPAN - 1e-6:
            break
    differs = False
    agrees = False
    if span >= WHEEL_SPAN - 1e-6:
        p = 0.0
        for j in range(i_v + 1):
            p += P_sqrt[i_v, j] * P_sqrt[i_v, j]
        expected = (1.0 + x[i_k]) * (x[i_v] - 0.5 * span * (x[at[ACCELERATION]] if at[ACCELERATION] >= 0 else 0.0))
        if fil.signed == 0:
            expected = abs(expected)
        sigma = math.sqrt(p + 2.0 * variance / (span * span) + (0.15 * span) ** 2)
        differs = abs(wheel - expected) > k[K_SLIP_GATE] * sigma
        agrees = abs(wheel - expected) < 0.1 + 1.5 * sigma
    slip = 0.0
    shake = 0.0
    since = bank.info[h, SLIP_SINCE]
    if since == -np.inf:
        if abs(innovation) > k[K_SLIP_GATE] * math.sqrt(s) or differs:
            bank.info[h, SLIP_SINCE] = time
            bank.info[h, AGREE_SINCE] = np.inf
            since = time
            common[C_SLIPS] += 1.0
            shake = SHAKE_SPEED * SHAKE_SPEED
            for j in range(n):
                column[j] = 0.0
            column[i_v] = SHAKE_SPEED
            add_column(P_sqrt, column, i_v)
            if at[ACCELERATION] >= 0:
                for j in range(n):
                    column[j] = 0.0
                column[at[ACCELERATION]] = KICK
                add_column(P_sqrt, column, at[ACCELERATION])
    elif agrees:
        if bank.info[h, AGREE_SINCE] == np.inf:
            bank.info[h, AGREE_SINCE] = time
        if time - bank.info[h, AGREE_SINCE] >= 1.0:
            bank.info[h, SLIP_SINCE] = -np.inf
            since = -np.inf
    else:
        bank.info[h, AGREE_SINCE] = np.inf
    if since > -np.inf and time - since > k[K_SLIP_LONGEST]:
        bank.info[h, SLIP_SINCE] = -np.inf
        shake = (1.0 + abs(wheel - abs(x[i_v]))) ** 2
        for j in range(n):
            column[j] = 0.0
        column[i_v] = math.sqrt(shake)
        add_column(P_sqrt, column, i_v)
    evidence = 0.0
    if since > -np.inf:
        slip = FORGET_WHEEL * FORGET_WHEEL
        for j in range(n):
            column[j] = 0.0
        column[i_d] = FORGET_WHEEL
        add_column(P_sqrt, column, i_d)
        evidence = -0.5 * (K_SLIP_EVIDENCE + math.log(variance))
    else:
        evidence = -0.5 * (innovation * innovation / s + math.log(s))
    project(P_sqrt, h_row, f)
    absorb(x, P_sqrt, f, innovation, variance, keep, move)
    return evidence, slip, shake


#: Evidence of a slipping wheel: as bad as a reading at the gate.
K_SLIP_EVIDENCE = 16.0


@njit(cache=True)
def direction(fil, bank, h):
    """Which way an unsigned speed or distance counts: by the estimate where that is certain, else as the hypothesis has it."""
    if fil.signed == 1:
        return 1.0
    i_v = fil.at[SPEED]
    v = bank.x[h, i_v]
    p = 0.0
    for j in range(i_v + 1):
        p += bank.P_sqrt[h, i_v, j] ** 2
    if v * v > 9.0 * p:
        bank.tags[h, SIGN] = 1 if v > 0.0 else -1
    return float(bank.tags[h, SIGN])


@njit(cache=True)
def motion_rows(fil, net, shared, bank, h, row, dt, still, point, probe, h_row, f, keep, move):
    """Standstill, odometer speed, yaw gyro, GNSS speed and course of one hypothesis; gives ln p."""
    at = fil.at
    k = fil.settings
    x = bank.x[h]
    P_sqrt = bank.P_sqrt[h]
    n = x.shape[0]
    i_v, i_s, i_k, i_g = at[SPEED], at[POSITION], at[ODOMETER_SCALE], at[GYRO_BIAS]
    evidence = 0.0
    for j in range(n):
        h_row[j] = 0.0
    wheel = row[WHEEL_SPEED]
    if wheel == wheel and i_k >= 0:  # (1 + k) |v|
        sigma = row[SIGMA_WHEEL] if row[SIGMA_WHEEL] > 0.0 else k[K_ODOMETER_SPEED]
        sign = direction(fil, bank, h)
        h_row[i_v] = sign * (1.0 + x[i_k])
        h_row[i_k] = sign * x[i_v]
        innovation = wheel - sign * (1.0 + x[i_k]) * x[i_v]
        evidence += robust_row(x, P_sqrt, h_row, innovation, sigma * sigma, f, keep, move)
        h_row[i_k] = 0.0
        h_row[i_v] = 0.0
    if still:
        h_row[i_v] = 1.0
        evidence += robust_row(x, P_sqrt, h_row, -x[i_v], k[K_STILL_SIGMA] ** 2, f, keep, move)
        h_row[i_v] = 0.0
    rate = row[YAW_RATE]
    if rate == rate and i_g >= 0:
        # statistical linearisation of the yaw rate per metre over the position's spread
        v = x[i_v]
        middle = x[i_s] - 0.5 * dt * v  # the mean since the epoch before belongs to the middle of the step
        spread = 0.0
        for j in range(i_s + 1):
            spread += P_sqrt[i_s, j] * P_sqrt[i_s, j]
        sd = math.sqrt(spread)
        mean = 0.0
        slope = 0.0
        square = 0.0
        for m in range(5):
            path_point(net, bank, h, middle + GAUSS_HERMITE_NODES[m] * sd, probe)
            bend = yaw_rate_kernel(1.0, probe[P_CURVATURE], probe[P_GRADIENT], probe[P_GRADIENT_RATE], probe[P_CANT])
            weight = GAUSS_HERMITE_WEIGHTS[m]
            mean += weight * bend
            slope += weight * GAUSS_HERMITE_NODES[m] * bend
            square += weight * bend * bend
        slope /= sd
        rest = max(square - mean * mean - slope * slope * spread, 0.0)
        # errors of the model's curvature are the same over some length: count them once a length, not once a row
        alike = max(1.0, k[K_CURVATURE_LENGTH] / max(abs(v) * dt, 0.1))
        rough = (k[K_CURVATURE_SIGMA] ** 2 + (slope * k[K_CURVATURE_SHIFT]) ** 2) * alike
        moving = min(1.0, abs(v) / 2.0)
        variance = (
            row[SIGMA_YAW] ** 2
            + (moving * k[K_GYRO_FLOOR]) ** 2
            + v * v * (rest + rough + (k[K_GYRO_SCALE] * mean) ** 2)
        )
        h_row[i_s] = v * slope
        h_row[i_v] = mean
        h_row[i_g] = 1.0
        evidence += robust_row(x, P_sqrt, h_row, rate - v * mean - x[i_g], variance, f, keep, move)
        h_row[i_s] = 0.0
        h_row[i_v] = 0.0
        h_row[i_g] = 0.0
    speed = row[GNSS_SPEED]
    i_l, i_e = at[SPEED_LATENCY], at[SPEED_ERROR]
    if speed == speed and i_l >= 0 and shared.common[C_SPEED_STALE] == 0.0:
        v = x[i_v]
        stated = row[SIGMA_SPEED] > 0.0
        sigma = row[SIGMA_SPEED] if stated else k[K_SPEED_SIGMA]
        if speed < 4.0 * sigma and abs(v) < 8.0 * sigma:  # the sign is not told: near standstill
            h_row[i_v] = 1.0
            evidence += robust_row(x, P_sqrt, h_row, -v, speed * speed + sigma * sigma, f, keep, move)
            h_row[i_v] = 0.0
        else:  # |v - latency a| + error
            sign = float(bank.tags[h, SIGN])
            if row[COURSE_EAST] == row[COURSE_EAST]:
                sign = 1.0 if row[COURSE_EAST] * point[P_D_EAST] + row[COURSE_NORTH] * point[P_D_NORTH] > 0.0 else -1.0
            elif fil.signed == 0:
                sign = direction(fil, bank, h)
            elif abs(v) > 0.5:
                sign = 1.0 if v > 0.0 else -1.0
            i_a = at[ACCELERATION]
            a = 0.0
            if i_a >= 0:
                a = x[i_a]
                h_row[i_a] = -sign * x[i_l]
            elif row[FORCE] == row[FORCE]:
                g0 = point[P_GRADIENT]
                a = row[FORCE] - x[at[ACCELEROMETER_BIAS]] - k[K_GRAVITY] * g0 / math.sqrt(1.0 + g0 * g0)
            share = k[K_SPEED_SHARE] * sigma
            h_row[i_v] = sign
            h_row[i_l] = -sign * a
            h_row[i_e] = share
            innovation = speed - sign * (v - x[i_l] * a) - share * x[i_e]
            evidence += robust_row(x, P_sqrt, h_row, innovation, sigma * sigma, f, keep, move)
            h_row[i_v] = 0.0
            h_row[i_l] = 0.0
            h_row[i_e] = 0.0
            if i_a >= 0:
                h_row[i_a] = 0.0
        v = x[i_v]
        course = row[COURSE_EAST]
        if course == course and speed > 1.0 and abs(v) > 1.0:
            # velocity across the path, as the antenna moves there: v sin(course - bearing - kappa * lever)
            sign = 1.0 if v >= 0.0 else -1.0
            step = x[i_s] - point[POINT_SIZE]
            te = point[P_D_EAST] + step * point[P_CURVATURE] * point[P_D_NORTH]
            tn = point[P_D_NORTH] - step * point[P_CURVATURE] * point[P_D_EAST]
            length = math.hypot(te, tn) * sign
            across = speed * (course * tn - row[COURSE_NORTH] * te) / length
            across -= sign * speed * point[P_CURVATURE] * fil.lever[0]
            floor = speed * k[K_COURSE_SIGMA] * (0.2 if stated else 3.0)
            spread = 0.0
            for j in range(i_s + 1):
                spread += P_sqrt[i_s, j] * P_sqrt[i_s, j]
            bent = 0.5 * speed * K_BEND_CHANGE * spread
            h_row[i_s] = sign * speed * point[P_CURVATURE]
            variance = sigma * sigma + floor * floor + bent * bent
            evidence += robust_row(x, P_sqrt, h_row, across, variance, f, keep, move)
            h_row[i_s] = 0.0
    return evidence


#: Change of curvature a metre that the linearised course allows for, 1/m^2.
K_BEND_CHANGE = 1e-5


@njit(cache=True)
def position_row(fil, net, shared, bank, h, row, point, probe, place, h_east, h_north, f_east, f_north, two):
    """Innovation of a GNSS fix and its covariance; gives NIS and ln det S, `two` holds innovations and white variances.

    A spread over which the path bends is linearised statistically (five-point Gauss-Hermite), else at the estimate.
    """
    at = fil.at
    k = fil.settings
    common = shared.common
    x = bank.x[h]
    P_sqrt = bank.P_sqrt[h]
    i_s, i_g = at[POSITION], at[GNSS_EAST]
    n = x.shape[0]
    spread = 0.0
    for j in range(i_s + 1):
        spread += P_sqrt[i_s, j] * P_sqrt[i_s, j]
    for j in range(n):
        h_east[j] = 0.0
        h_north[j] = 0.0
    extra_east = 0.0
    extra_north = 0.0
    i_t, i_v = at[TIME_TAG], at[SPEED]
    seen = x[i_s] + x[i_v] * x[i_t]  # where the fix shows the train
    step = seen - point[POINT_SIZE]
    if abs(point[P_CURVATURE]) * spread > 0.1 or spread > 400.0:
        sd = math.sqrt(spread)
        mean_e = 0.0
        mean_n = 0.0
        slope_e = 0.0
        slope_n = 0.0
        base_e = 0.0
        base_n = 0.0
        for m in range(5):
            path_point(net, bank, h, seen + GAUSS_HERMITE_NODES[m] * sd, probe)
            antenna(probe, fil.lever, place)
            w = GAUSS_HERMITE_WEIGHTS[m]
            if m == 0:
                base_e = place[0]
                base_n = place[1]
            mean_e += w * (place[0] - base_e)
            mean_n += w * (place[1] - base_n)
            slope_e += w * GAUSS_HERMITE_NODES[m] * (place[0] - base_e)
            slope_n += w * GAUSS_HERMITE_NODES[m] * (place[1] - base_n)
            extra_east += w * (place[0] - base_e) ** 2
            extra_north += w * (place[1] - base_n) ** 2
        extra_east = max(extra_east - mean_e * mean_e - slope_e * slope_e, 0.0)
        extra_north = max(extra_north - mean_n * mean_n - slope_n * slope_n, 0.0)
        h_east[i_s] = slope_e / sd
        h_north[i_s] = slope_n / sd
        at_east = base_e + mean_e
        at_north = base_n + mean_n
    elif abs(step) > 2.0:
        path_point(net, bank, h, seen, probe)
        antenna(probe, fil.lever, place)
        h_east[i_s] = place[2]
        h_north[i_s] = place[3]
        at_east = place[0]
        at_north = place[1]
    else:
        antenna(point, fil.lever, place)
        bend = 0.5 * step * step * point[P_CURVATURE]
        h_east[i_s] = place[2]
        h_north[i_s] = place[3]
        at_east = place[0] + step * place[2] + bend * place[3]
        at_north = place[1] + step * place[3] - bend * place[2]
    h_east[i_t] = x[i_v] * h_east[i_s]
    h_north[i_t] = x[i_v] * h_north[i_s]
    h_east[i_v] = x[i_t] * h_east[i_s]
    h_north[i_v] = x[i_t] * h_north[i_s]
    scale = common[C_SCALE] * k[K_CORRELATED]
    h_east[i_g] = scale * common[C_SIGMA_EAST]
    h_north[i_g + 1] = scale * common[C_SIGMA_NORTH]
    h_east[at[FRAME_EAST]] = 1.0
    h_north[at[FRAME_NORTH]] = 1.0
    two[0] = row[EAST] - at_east - h_east[i_g] * x[i_g] - x[at[FRAME_EAST]]
    two[1] = row[NORTH] - at_north - h_north[i_g + 1] * x[i_g + 1] - x[at[FRAME_NORTH]]
    two[2] = (k[K_WHITE] * row[SIGMA_EAST]) ** 2 + extra_east
    two[3] = (k[K_WHITE] * row[SIGMA_NORTH]) ** 2 + extra_north
    s_ee = project(P_sqrt, h_east, f_east) + two[2]
    s_nn = project(P_sqrt, h_north, f_north) + two[3]
    s_en = 0.0
    for j in range(n):
        s_en += f_east[j] * f_north[j]
    two[4] = s_ee
    two[5] = s_nn
    two[6] = s_en
    det = s_ee * s_nn - s_en * s_en
    nis = (two[0] * two[0] * s_nn - 2.0 * two[0] * two[1] * s_en + two[1] * two[1] * s_ee) / det
    return nis, math.log(det)


# ---------------------------------------------------------------- all hypotheses, one epoch after the other


@njit(cache=True)
def watch(fil, shared, bank, row):
    """Look after the clock-work all hypotheses share: smoothed sigmas, the wheel's last movement, GNSS speed at rest."""
    k = fil.settings
    common = shared.common
    time = row[TIME]
    if row[EAST] == row[EAST] and row[SIGMA_EAST] <= k[K_USABLE]:
        dt = time - common[C_FIX_TIME]
        a = 1.0 - math.exp(-dt / 5.0) if dt < 1e6 else 1.0
        if not common[C_SIGMA_EAST] > 0.0:
            a = 1.0
        common[C_SIGMA_EAST] += a * (row[SIGMA_EAST] - common[C_SIGMA_EAST])
        common[C_SIGMA_NORTH] += a * (row[SIGMA_NORTH] - common[C_SIGMA_NORTH])
    common[C_SPEED_STALE] = 0.0
    if row[GNSS_SPEED] == row[GNSS_SPEED]:
        if row[GNSS_SPEED] == common[C_GNSS_SPEED] and (row[GNSS_SPEED] > 0.01 or time < common[C_DISTRUST]):
            common[C_SPEED_STALE] = 1.0
        common[C_GNSS_SPEED] = row[GNSS_SPEED]
        common[C_GNSS_SPEED_TIME] = time
        if row[GNSS_SPEED] > max(0.3, 0.0 if not row[SIGMA_SPEED] > 0.0 else min(3.0 * row[SIGMA_SPEED], 0.6)):
            common[C_GNSS_STILL] = np.inf
        elif common[C_GNSS_STILL] == np.inf:
            common[C_GNSS_STILL] = time
    wheel = row[DISTANCE]
    if wheel == wheel:
        before = shared.ring[(int(common[C_RING]) - 1) % RING, 1]
        if not wheel == before:
            common[C_WHEEL_MOVED] = time
        common[C_WHEEL_SEEN] = time
    elif row[WHEEL_SPEED] == row[WHEEL_SPEED]:
        if abs(row[WHEEL_SPEED]) > 0.05:
            common[C_WHEEL_MOVED] = time
        common[C_WHEEL_SEEN] = time


@njit(cache=True)
def stands(fil, shared, bank, time):
    """Whether the train is found to stand: wheels at rest and no GNSS speed against it, or, without wheels, GNSS speed at rest."""
    k = fil.settings
    common = shared.common
    best = bank.live[1]
    for i in range(bank.live[0]):
        if bank.logw[bank.live[1 + i]] > bank.logw[best]:
            best = bank.live[1 + i]
    i_v = fil.at[SPEED]
    p = 0.0
    for j in range(i_v + 1):
        p += bank.P_sqrt[best, i_v, j] ** 2
    if abs(bank.x[best, i_v]) > 0.5 + 3.0 * math.sqrt(p):
        return False
    if common[C_WHEEL_SEEN] > time - 1.0:
        if common[C_GNSS_SPEED_TIME] > time - 2.5 and common[C_GNSS_SPEED] > 1.0:
            return False
        return time - common[C_WHEEL_MOVED] >= k[K_STILL_TIME]
    if common[C_GNSS_SPEED_TIME] > time - 2.5 and common[C_SUSPECTS] == 0.0 and time > common[C_DISTRUST]:
        return time - common[C_GNSS_STILL] >= 3.0 * k[K_STILL_TIME]
    return False


@njit(cache=True)
def adapt(fil, shared, bank, time, point, dt, f, column, keep, move):
    """Learn the scale of the receiver's sigmas and, where fixes lie aside for good, widen the constant part's prior exactly."""
    k = fil.settings
    common = shared.common
    i_g = fil.at[GNSS_EAST]
    square = 0.0
    frame = 0.0
    for i in range(bank.live[0]):
        h = bank.live[1 + i]
        x = bank.x[h]
        L = bank.P_sqrt[h]
        te, tn = point[h, P_D_EAST], point[h, P_D_NORTH]
        size = te * te + tn * tn
        # variance of the error across the track, in units of its prior: from the first four rows of the root
        value = (tn * x[i_g] - te * x[i_g + 1]) ** 2
        for j in range(i_g + 2):
            value += (tn * L[i_g, j] - te * L[i_g + 1, j]) ** 2
        square += shared.weight[h] * min(value / size, 9.0)
        frame += shared.weight[h] * (
            x[0] * x[0] + x[1] * x[1] + L[0, 0] * L[0, 0] + L[1, 0] * L[1, 0] + L[1, 1] * L[1, 1]
        )
    fade = math.exp(-dt / 3600.0)
    part = min(0.5 * dt / k[K_GNSS_TIME], 1.0)
    common[C_SCALE_SUM] = fade * common[C_SCALE_SUM] + part * square * common[C_SCALE] ** 2
    common[C_SCALE_WEIGHT] = fade * common[C_SCALE_WEIGHT] + part
    scale = math.sqrt(
        (k[K_SCALE_PRIOR] * k[K_SCALE_START] ** 2 + common[C_SCALE_SUM]) / (k[K_SCALE_PRIOR] + common[C_SCALE_WEIGHT])
    )
    common[C_SCALE] = min(max(scale, k[K_SCALE_LEAST]), k[K_SCALE_MOST])
    # the constant part's prior follows what is seen of it (expectation-maximisation), once a minute
    if time - common[C_FRAME_TIME] < 60.0:
        return
    common[C_FRAME_TIME] = time
    old = common[C_FRAME_SIGMA]
    least = k[K_FRAME] * 0.5 * (common[C_SIGMA_EAST] + common[C_SIGMA_NORTH])
    least = min(max(math.hypot(least, k[K_MODEL]), k[K_FRAME_LEAST]), k[K_FRAME_MOST])
    new = min(max(math.sqrt(0.5 * frame), old / 1.5, least), 1.5 * old, k[K_FRAME_MOST])
    if abs(new / old - 1.0) > 0.2:
        for i in range(bank.live[0]):
            h = bank.live[1 + i]
            bank.logw[h] += reweigh_frame(bank.x[h], bank.P_sqrt[h], old, new, f, column, keep, move)
        common[C_FRAME_SIGMA] = new


@njit(cache=True)
def jump(fil, net, shared, bank, nis, row, point, probe, place, h_east, h_north, f_east, f_north, two):
    """What stepped when fixes have left every hypothesis: variances for the GNSS error (in its own units) and for the time stamps.

    A jump along the track that the speed turns into less than `time_tag_most` seconds is one of the stamps.
    """
    k = fil.settings
    best = bank.live[1]
    for i in range(bank.live[0]):
        if nis[bank.live[1 + i]] < nis[best]:
            best = bank.live[1 + i]
    position_row(fil, net, shared, bank, best, row, point[best], probe, place, h_east, h_north, f_east, f_north, two)
    te, tn = point[best, P_D_EAST], point[best, P_D_NORTH]
    size = math.hypot(te, tn)
    along = (two[0] * te + two[1] * tn) / size
    cross = (two[0] * tn - two[1] * te) / size
    across = (two[4] * tn * tn - 2.0 * two[6] * te * tn + two[5] * te * te) / (size * size)
    v = bank.x[best, fil.at[SPEED]]
    if abs(v) > 3.0 and abs(along / v) <= k[K_TAG_MOST] and cross * cross < k[K_GATE] * across:
        return 0.0, (along / v) ** 2
    sigma = shared.common[C_SCALE] * k[K_CORRELATED] * shared.common[C_SIGMA_EAST]
    return max((two[0] ** 2 + two[1] ** 2) / (sigma * sigma), 1.0), 0.0


@njit(cache=True)
def depart(fil, bank, pulls):
    """A train that stood leaves, and nothing tells which way: a clone of each hypothesis that has moved before goes back."""
    reverse = fil.settings[K_REVERSE]
    for i in range(bank.live[0]):
        h = bank.live[1 + i]
        if bank.tags[h, MOVED] == 1 and bank.live[0] < bank.used.shape[0]:
            g = clone(bank, h)
            bank.tags[g, SIGN] = -bank.tags[h, SIGN]
            bank.logw[g] += math.log(reverse)
            bank.logw[h] += math.log(1.0 - reverse)
            pulls[g] = pulls[h]


@njit(cache=True)
def kick(fil, bank, row, pulls, column):
    """A train that stood leaves: its acceleration is anything a train can do, and its speed what the receiver may already say."""
    i_v, i_a = fil.at[SPEED], fil.at[ACCELERATION]
    sigma = 0.3 + (row[GNSS_SPEED] if row[GNSS_SPEED] == row[GNSS_SPEED] else 0.0)
    for i in range(bank.live[0]):
        h = bank.live[1 + i]
        for state in range(2):
            column[:] = 0.0
            where = i_a if state == 0 else i_v
            if where >= 0:
                column[where] = KICK if state == 0 else sigma
                add_column(bank.P_sqrt[h], column, where)
        pulls[h, 2] = sigma * sigma


@njit(cache=True)
def lawful(bank, h, track, way):
    """Whether a hypothesis' window passes the track that was put out last: then its path leads on from there."""
    for i in range(bank.tags[h, COUNT]):
        if bank.track[h, i] == track and bank.way[h, i] == way:
            return True
    return bank.track[h, bank.tags[h, CURRENT]] == track


@njit(cache=True)
def put_out(fil, net, shared, bank, time, row, point, mass, mean, sigma, weights, probe, out):
    """Fill one output row from the posterior: the track, where on it, its probability, the mode and the protection level."""
    k = fil.settings
    at = fil.at
    common = shared.common
    live = bank.live[0]
    for j in range(OUTPUT_SIZE):
        out[j] = np.nan
    out[OUT_TRACK] = -1.0
    out[OUT_HYPOTHESES] = live
    out[OUT_FIX_AGE] = time - common[C_FIX_TIME]
    if live == 0:
        if common[C_NOTHING_NEAR] == 1.0:
            out[OUT_MODE] = OFF_MODEL
        elif common[C_STARTED] == 1.0:
            out[OUT_MODE] = LOST
        else:
            out[OUT_MODE] = INITIALISING
        common[C_OUT_TRACK] = -1.0
        return
    i_s, i_v = at[POSITION], at[SPEED]
    # posterior of the track each hypothesis stands on
    for i in range(live):
        h = bank.live[1 + i]
        track = bank.track[h, bank.tags[h, CURRENT]]
        total = 0.0
        for j in range(live):
            g = bank.live[1 + j]
            if bank.track[g, bank.tags[g, CURRENT]] == track:
                total += shared.weight[g]
        mass[h] = total
    best = -1
    held = -1
    last = int(common[C_OUT_TRACK])
    last_way = int(common[C_OUT_WAY])
    for i in range(live):
        h = bank.live[1 + i]
        if (
            best < 0
            or mass[h] > mass[best] + 1e-12
            or (mass[h] > mass[best] - 1e-12 and bank.logw[h] > bank.logw[best])
        ):
            best = h
        if last >= 0 and lawful(bank, h, last, last_way):
            if (
                held < 0
                or mass[h] > mass[held] + 1e-12
                or (mass[h] > mass[held] - 1e-12 and bank.logw[h] > bank.logw[held])
            ):
                held = h
    chosen = best
    if last >= 0 and held != best:
        # the best is not a lawful continuation of what was said: hold on until it is clearly better, then say so with a row apart
        if held >= 0 and mass[best] < k[K_CONFIDENCE] and mass[best] < 3.0 * mass[held]:
            chosen = held
        else:
            common[C_OUT_TRACK] = -1.0
            common[C_REVISIONS] += 1.0
            out[OUT_MODE] = LOST
            return
    h = chosen
    i = bank.tags[h, CURRENT]
    track, way = bank.track[h, i], bank.way[h, i]
    s = bank.x[h, i_s]
    length = net.length[track]
    # all hypotheses along the chosen one's tangent; those on its track make the estimate
    te, tn = point[h, P_D_EAST], point[h, P_D_NORTH]
    size = te * te + tn * tn
    middle = 0.0
    variance = 0.0
    forward = 0.0
    probability = 0.0
    count = 0
    for j in range(live):
        g = bank.live[1 + j]
        p = 0.0
        for m in range(i_s + 1):
            p += bank.P_sqrt[g, i_s, m] ** 2
        d = 0.0
        if g != h:
            d = ((point[g, P_EAST] - point[h, P_EAST]) * te + (point[g, P_NORTH] - point[h, P_NORTH]) * tn) / size
        c = bank.tags[g, CURRENT]
        if bank.track[g, c] == track:
            probability += shared.weight[g]
            middle += shared.weight[g] * d
            variance += shared.weight[g] * (p + d * d)
            if bank.way[g, c] == way:
                forward += shared.weight[g]
        weights[count] = shared.weight[g]
        mean[count] = d
        sigma[count] = math.sqrt(p)
        count += 1
    middle /= probability
    variance = variance / probability - middle * middle
    for j in range(count):
        mean[j] -= middle
    local = min(max(s + middle - bank.begin[h, i], 0.0), length)
    out[OUT_TRACK] = track
    out[OUT_WAY] = way
    out[OUT_OFFSET] = local if way > 0 else length - local
    out[OUT_SPEED] = bank.x[h, i_v]
    p = 0.0
    for m in range(i_v + 1):
        p += bank.P_sqrt[h, i_v, m] ** 2
    out[OUT_SIGMA_SPEED] = math.sqrt(p)
    if at[ACCELERATION] >= 0:
        out[OUT_ACCELERATION] = bank.x[h, at[ACCELERATION]]
    elif row[FORCE] == row[FORCE]:
        g0 = point[h, P_GRADIENT]
        out[OUT_ACCELERATION] = (
            row[FORCE] - bank.x[h, at[ACCELEROMETER_BIAS]] - k[K_GRAVITY] * g0 / math.sqrt(1.0 + g0 * g0)
        )
    out[OUT_SIGMA] = math.sqrt(variance)
    out[OUT_PROBABILITY] = min(probability, 1.0)
    out[OUT_LEVEL] = mixture_bound(weights, mean, sigma, count, fil.risk[0], fil.risk[1])
    out[OUT_DIRECTION] = 0.0
    if forward >= k[K_CONFIDENCE] * probability:
        out[OUT_DIRECTION] = way
    if probability < k[K_CONFIDENCE]:
        out[OUT_MODE] = AMBIGUOUS
    elif time - common[C_FIX_TIME] > k[K_COASTING]:
        out[OUT_MODE] = COASTING
    else:
        out[OUT_MODE] = TRACKING
    common[C_OUT_TRACK] = track
    common[C_OUT_WAY] = way


@njit(cache=True)
def keep_records(bank, records, epoch, pulls):
    """Append one record a living hypothesis, and its window when that has changed."""
    used = records.used
    for i in range(bank.live[0]):
        h = bank.live[1 + i]
        if bank.tags[h, VERSION] < 0:
            v = used[1]
            records.track[v] = bank.track[h]
            records.way[v] = bank.way[h]
            records.begin[v] = bank.begin[h]
            records.count[v] = bank.tags[h, COUNT]
            bank.tags[h, VERSION] = v
            used[1] = v + 1
        r = used[0]
        records.x[r] = bank.x[h]
        records.P_sqrt[r] = bank.P_sqrt[h]
        numbers = records.numbers[r]
        numbers[R_EPOCH] = epoch
        numbers[R_PARENT] = bank.tags[h, RECORD]
        numbers[R_VERSION] = bank.tags[h, VERSION]
        numbers[R_LOGW] = bank.logw[h]
        for j in range(PULLS):
            numbers[R_PULL + j] = pulls[h, j]
        bank.tags[h, RECORD] = r
        used[0] = r + 1


@njit(cache=True)
def run(fil, net, shared, bank, records, epochs, first, out):
    """Work through the epochs from `first`; gives where it stopped and why."""
    # epochs (m, EPOCH_SIZE), out (m, OUTPUT_SIZE)
    at = fil.at
    k = fil.settings
    common = shared.common
    n = bank.x.shape[1]
    slots = bank.x.shape[0]
    i_s, i_v, i_d = at[POSITION], at[SPEED], at[WHEEL_DISTANCE]
    F = np.empty((n, n))
    Q = np.empty((16, n))
    lead = np.empty(16, np.int64)
    new = np.empty(n)
    h_row = np.empty(n)
    h_two = np.empty(n)
    f = np.empty(n)
    f_two = np.empty(n)
    keep = np.empty(n)
    move = np.empty(n)
    column = np.empty(n)
    before = np.empty(n)
    two = np.empty(7)
    place = np.empty(4)
    probe = np.empty(POINT_SIZE + 1)
    point = np.empty((slots, POINT_SIZE + 1))
    pulls = np.zeros((slots, PULLS))
    nis = np.empty(slots)
    said = np.empty(slots)
    mass = np.empty(slots)
    mean = np.empty(slots)
    sigma = np.empty(slots)
    weights = np.empty(slots)
    for e in range(first, epochs.shape[0]):
        row = epochs[e]
        time = row[TIME]
        if records.used[2] == 1 and (
            records.used[0] + slots > records.x.shape[0] or records.used[1] + slots > records.track.shape[0]
        ):
            return e, NEEDS_ROOM
        usable = row[EAST] == row[EAST] and row[SIGMA_EAST] <= k[K_USABLE] and row[SIGMA_NORTH] <= k[K_USABLE]
        if bank.live[0] == 0 and usable and not time - common[C_TRY] < 1.0:
            return e, NEEDS_START
        watch(fil, shared, bank, row)
        dt = time - common[C_TIME] if common[C_FRESH] == 0.0 else 0.0
        common[C_TIME] = time
        if bank.live[0] == 0:
            _remember(shared, row)
            put_out(fil, net, shared, bank, time, row, point, mass, mean, sigma, weights, probe, out[e])
            continue
        # predict, keep the windows ahead
        i = 0
        while i < bank.live[0]:
            h = bank.live[1 + i]
            x = bank.x[h]
            P_sqrt = bank.P_sqrt[h]
            for j in range(PULLS):
                pulls[h, j] = 0.0
            if dt > 0.0:
                path_point(net, bank, h, x[i_s] + 0.5 * dt * x[i_v], probe)
                g0 = probe[P_GRADIENT]
                pull = k[K_GRAVITY] * g0 / math.sqrt(1.0 + g0 * g0)
                sign = direction(fil, bank, h)
                pulls[h, 5] = sign
                columns = transition(fil, x, dt, sign, row[FORCE], pull, 0.0, 0.0, 0.0, 0.0, F, Q, lead, new)
                predict(x, P_sqrt, F, Q, lead, columns, new)
                pulls[h, 0] = pull
            i += 1
        i = 0
        while i < bank.live[0]:
            h = bank.live[1 + i]
            x = bank.x[h]
            spread = 0.0
            for j in range(i_s + 1):
                spread += bank.P_sqrt[h, i_s, j] ** 2
            sd = math.sqrt(spread)
            bank.tags[h, CURRENT] = path_index(net, bank, h, x[i_s], bank.tags[h, CURRENT])
            margin = 4.0 * sd + 2.0 + abs(fil.lever[0])
            before_count = bank.live[0]
            ends = follow(net, bank, h, x[i_s], x[i_v], margin)
            for m in range(before_count, bank.live[0]):
                g = bank.live[1 + m]
                for j in range(PULLS):
                    pulls[g, j] = pulls[h, j]
            bank.tags[h, CURRENT] = path_index(net, bank, h, x[i_s], bank.tags[h, CURRENT])
            gone = sd > k[K_LOST_SIGMA]
            if ends != 0:
                c = bank.tags[h, COUNT] - 1 if ends > 0 else 0
                far = bank.begin[h, c] + (net.length[bank.track[h, c]] if ends > 0 else 0.0)
                end = (
                    leaving_end(bank.track[h, c], bank.way[h, c])
                    if ends > 0
                    else entering_end(bank.track[h, c], bank.way[h, c])
                )
                if net.stop[end] == 1:
                    for j in range(n):
                        h_row[j] = 0.0
                    h_row[i_s] = 1.0
                    robust_row(x, bank.P_sqrt[h], h_row, far - x[i_s], 1.0, f, keep, move)
                elif abs(x[i_s] - far) > 3.0 * sd + 5.0:
                    gone = True
                    common[C_NOTHING_NEAR] = 1.0
            if gone:
                drop(bank, i)
                continue
            i += 1
        if bank.live[0] == 0:
            _remember(shared, row)
            put_out(fil, net, shared, bank, time, row, point, mass, mean, sigma, weights, probe, out[e])
            continue
        still = stands(fil, shared, bank, time)
        if still:
            common[C_STOOD] = 1.0
        elif common[C_STOOD] == 1.0:
            common[C_STOOD] = 0.0
            if at[ACCELEROMETER_BIAS] < 0 and fil.signed == 0:
                depart(fil, bank, pulls)
            if at[ACCELEROMETER_BIAS] < 0:
                kick(fil, bank, row, pulls, column)
        distance = row[DISTANCE]
        if distance == distance and i_d >= 0 and not shared.ring[(int(common[C_RING]) - 1) % RING, 0] > -np.inf:
            for i in range(bank.live[0]):  # first reading
                h = bank.live[1 + i]
                bank.x[h, i_d] = distance
                for j in range(i_d):
                    bank.P_sqrt[h, i_d, j] = 0.0
                bank.P_sqrt[h, i_d, i_d] = k[K_ODOMETER_SIGMA]
            distance = np.nan
        for i in range(bank.live[0]):
            h = bank.live[1 + i]
            x = bank.x[h]
            if distance == distance and i_d >= 0:
                evidence, slip, shake = wheel_row(fil, shared, bank, h, time, distance, h_row, f, keep, move, column)
                bank.logw[h] += evidence
                pulls[h, 1] = slip
                pulls[h, 2] = shake
            path_point(net, bank, h, x[i_s], point[h])
            point[h, POINT_SIZE] = x[i_s]
            bank.logw[h] += motion_rows(
                fil, net, shared, bank, h, row, dt, still, point[h], probe, h_row, f, keep, move
            )
            if bank.tags[h, MOVED] == 0:
                p = 0.0
                for j in range(i_v + 1):
                    p += bank.P_sqrt[h, i_v, j] ** 2
                if abs(x[i_v]) > max(0.5, 3.0 * math.sqrt(p)):
                    bank.tags[h, MOVED] = 1
                    bank.logw[h] += math.log(k[K_REVERSE] if x[i_v] < 0.0 else 1.0 - k[K_REVERSE])
        if usable:
            least = np.inf
            for i in range(bank.live[0]):
                h = bank.live[1 + i]
                nis[h], logdet = position_row(
                    fil, net, shared, bank, h, row, point[h], probe, place, h_row, h_two, f, f_two, two
                )
                least = min(least, nis[h])
            step = 0.0
            tag = 0.0
            accepted = True
            if least > k[K_GATE] and common[C_FRESH] == 0.0:
                common[C_SUSPECT_FIXES] += 1.0
                if common[C_SUSPECTS] == 0.0:
                    common[C_SUSPECT_SINCE] = time
                common[C_SUSPECTS] += 1.0
                accepted = False
                if common[C_SUSPECTS] >= k[K_STEP_FIXES] and time - common[C_SUSPECT_SINCE] >= 1.0:
                    step, tag = jump(fil, net, shared, bank, nis, row, point, probe, place, h_row, h_two, f, f_two, two)
                    accepted = True
                    common[C_STEPS] += 1.0
                    if common[C_GNSS_SPEED] < 0.5 and at[SPEED_LATENCY] >= 0:
                        common[C_DISTRUST] = time + DISTRUST
                        kick(fil, bank, row, pulls, column)
            if accepted:
                common[C_SUSPECTS] = 0.0
                common[C_FIXES] += 1.0
                for i in range(bank.live[0]):
                    h = bank.live[1 + i]
                    x = bank.x[h]
                    P_sqrt = bank.P_sqrt[h]
                    if step > 0.0:
                        for axis in range(2):
                            for j in range(n):
                                column[j] = 0.0
                            column[at[GNSS_EAST] + axis] = math.sqrt(step)
                            add_column(P_sqrt, column, at[GNSS_EAST] + axis)
                        pulls[h, 3] = step
                    if tag > 0.0:
                        for j in range(n):
                            column[j] = 0.0
                        column[at[TIME_TAG]] = math.sqrt(tag)
                        add_column(P_sqrt, column, at[TIME_TAG])
                        pulls[h, 4] = tag
                    value, logdet = position_row(
                        fil, net, shared, bank, h, row, point[h], probe, place, h_row, h_two, f, f_two, two
                    )
                    held = k[K_GATE] + 10.0 if common[C_FRESH] == 0.0 else 1e4
                    said[h] = -0.5 * (min(value, held) + logdet)
                    for j in range(n):
                        before[j] = x[j]
                    absorb(x, P_sqrt, f, two[0], two[2], keep, move)
                    innovation = two[1]
                    for j in range(n):
                        innovation -= h_two[j] * (x[j] - before[j])
                    project(P_sqrt, h_two, f_two)
                    absorb(x, P_sqrt, f_two, innovation, two[3], keep, move)
                common[C_FIX_TIME], fix_dt = time, time - common[C_FIX_TIME]
                most = -np.inf
                for i in range(bank.live[0]):
                    most = max(most, said[bank.live[1 + i]])
                fade = math.exp(-fix_dt / k[K_MEMORY])
                for i in range(bank.live[0]):
                    h = bank.live[1 + i]
                    before_fading = bank.info[h, FADING]
                    bank.info[h, FADING] = fade * before_fading + said[h] - most
                    bank.logw[h] += bank.info[h, FADING] - before_fading
                common[C_JUMPS] *= math.exp(-fix_dt / 30.0)
                if step > 0.0:
                    common[C_JUMPS] += 1.0
            normalise(bank, shared.weight, k[K_PRUNE], int(k[K_MOST]))
            if accepted:
                if common[C_FRESH] == 0.0:
                    adapt(fil, shared, bank, time, point, min(fix_dt, 10.0), f, column, keep, move)
                    normalise(bank, shared.weight, k[K_PRUNE], int(k[K_MOST]))
            if common[C_JUMPS] > 4.0 or (not accepted and time - common[C_SUSPECT_SINCE] > k[K_LOST_AFTER]):
                common[C_JUMPS] = 0.0
                bank.used[:] = 0
                bank.live[0] = 0
                common[C_SUSPECTS] = 0.0
        else:
            normalise(bank, shared.weight, k[K_PRUNE], int(k[K_MOST]))
        common[C_FRESH] = 0.0
        if bank.live[0] > 1:
            for i in range(bank.live[0]):
                h = bank.live[1 + i]
                bank.tags[h, CURRENT] = path_index(net, bank, h, bank.x[h, i_s], bank.tags[h, CURRENT])
            merge_all(net, bank, i_s, i_v, k[K_MERGE], column)
            normalise(bank, shared.weight, k[K_PRUNE], int(k[K_MOST]))
        for i in range(bank.live[0]):
            h = bank.live[1 + i]
            x = bank.x[h]
            bank.tags[h, CURRENT] = path_index(net, bank, h, x[i_s], bank.tags[h, CURRENT])
            step = x[i_s] - point[h, POINT_SIZE]
            point[h, P_EAST] += step * point[h, P_D_EAST]
            point[h, P_NORTH] += step * point[h, P_D_NORTH]
        if records.used[2] == 1:
            keep_records(bank, records, e, pulls)
        _remember(shared, row)
        put_out(fil, net, shared, bank, time, row, point, mass, mean, sigma, weights, probe, out[e])
    return epochs.shape[0], DONE


@njit(cache=True)
def _remember(shared, row):
    """Keep the latest odometer reading."""
    if row[DISTANCE] == row[DISTANCE]:
        r = int(shared.common[C_RING])
        shared.ring[r, 0] = row[TIME]
        shared.ring[r, 1] = row[DISTANCE]
        shared.common[C_RING] = (r + 1) % RING
