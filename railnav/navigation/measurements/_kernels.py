"""Measurement equations on track geometry and the rows they become (specification 19.3): SI, radians, no validation.

Every row gives ln p of its reading, so that hypotheses can be compared (15.4).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from railnav.matching._kernels import (
    AGREE_SINCE,
    BY_BALISE,
    BY_COURSE,
    BY_ODOMETER,
    BY_SIDE,
    BY_SPEED,
    BY_STANDSTILL,
    BY_YAW,
    COUNT,
    P_CANT,
    P_CANT_RATE,
    P_CURVATURE,
    P_D_EAST,
    P_D_NORTH,
    P_EAST,
    P_GRADIENT,
    P_GRADIENT_RATE,
    P_NORTH,
    P_SIGMA_BEND,
    P_SIGMA_CROSS,
    PASSED,
    POINT_SIZE,
    SIGN,
    SLIP_SINCE,
    credit,
    inlined,
    part,
    path_point,
    path_shape,
)
from railnav.navigation.columns import (
    ACCELERATION,
    ACCELEROMETER_BIAS,
    AGAINST,
    BALISE_OFFSET,
    BALISE_REACH,
    BALISE_TRACK,
    BEARING_LENGTH,
    BEND_CHANGE,
    BLIND_LENGTH,
    C_ACCELEROMETER_FAULTS,
    C_ALONG,
    C_ALONG_SIGMA,
    C_ALONG_TIME,
    C_BLAMED,
    C_BLAMED_WAY,
    C_DISTRUST,
    C_FIX_TIME,
    C_GNSS_SPEED,
    C_GNSS_SPEED_TIME,
    C_ODOMETER_FAULTS,
    C_RESCALED,
    C_RING,
    C_SCALE,
    C_SIGMA_EAST,
    C_SIGMA_NORTH,
    C_SLIPS,
    C_SPEED_STALE,
    C_SUSPECTS,
    C_YAW_DISTRUST,
    CONTRADICTS,
    CONTRADICTS_SHARE,
    COURSE_EAST,
    COURSE_NORTH,
    DEAD_WHEEL,
    DISTANCE,
    EAST,
    EVIDENCE_STEP,
    FORCE,
    FORCE_STEP,
    FORGET_WHEEL,
    FRAME_EAST,
    FRAME_NORTH,
    GAUSS_HERMITE_NODES,
    GAUSS_HERMITE_WEIGHTS,
    GNSS_EAST,
    GNSS_SPEED,
    GYRO_BIAS,
    GYRO_TILT,
    K_BALISE_MISSED,
    K_BALISE_SIGMA,
    K_CORRELATED,
    K_COURSE_DOUBT,
    K_COURSE_SIGMA,
    K_CURVATURE_DOUBT,
    K_CURVATURE_LENGTH,
    K_CURVATURE_SHIFT,
    K_GRAVITY,
    K_GYRO_FLOOR,
    K_GYRO_SCALE,
    K_ODOMETER_SCALE,
    K_ODOMETER_SIGMA,
    K_ODOMETER_SPEED,
    K_SIDE_NOISE,
    K_SIDE_SCALE,
    K_SIDE_TIME,
    K_SLIP_GATE,
    K_SLIP_LONGEST,
    K_SPEED_SHARE,
    K_SPEED_SIGMA,
    K_STILL_SIGMA,
    K_WHITE,
    KICK,
    MAP_CROSS,
    NORTH,
    ODOMETER_SCALE,
    POSITION,
    RING,
    ROW_GATE,
    S_COURSE,
    S_STRETCH,
    S_YAW,
    SCALE_GATE,
    SCALE_STEP,
    SHAKE_SPEED,
    SIDE,
    SIDE_BIAS,
    SIGMA_BALISE,
    SIGMA_EAST,
    SIGMA_FORCE,
    SIGMA_NORTH,
    SIGMA_SPEED,
    SIGMA_WHEEL,
    SIGMA_YAW,
    SLOPES,
    SPEED,
    SPEED_ERROR,
    SPEED_LATENCY,
    STEP_MOST,
    STRANGE_BALISE,
    TIME,
    TIME_TAG,
    W_COLUMN,
    W_F,
    W_H,
    W_KEEP,
    W_MOVE,
    WHEEL_DISTANCE,
    WHEEL_SPAN,
    WHEEL_SPEED,
    YAW_RATE,
)
from railnav.navigation.dynamics._kernels import (
    absorb,
    absorb_robustly,
    known_without,
    project,
    robust_row,
    stamps,
    take_back,
    timed,
    variance_of,
    widen,
)
from railnav.navigation.shape import EXACT
from railnav.units import RAIL_CENTRE_DISTANCE


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


@part
def gravity_pull(gravity, gradient):
    """Gravity along the track, g sin(alpha)."""
    return gravity * gradient / math.sqrt(1.0 + gradient * gradient)


@part
def antenna(point, lever, out):  # (POINT_SIZE,), (3,) -> out (4,): easting, northing, their derivatives along the path
    """Where the antenna is: the axis point plus the lever arm turned by bearing, grade and cant; its derivative t + omega x lever."""
    te, tn = point[P_D_EAST], point[P_D_NORTH]
    sin_phi = point[P_CANT] / RAIL_CENTRE_DISTANCE
    cos_phi = math.sqrt(1.0 - sin_phi * sin_phi)
    right = lever[1] * cos_phi - lever[2] * sin_phi
    forward = lever[0] + lever[2] * point[P_GRADIENT]  # a mast leans back uphill
    leaning = -(lever[1] * sin_phi / cos_phi + lever[2]) * point[P_CANT_RATE] / RAIL_CENTRE_DISTANCE
    tipping = lever[2] * point[P_GRADIENT_RATE]
    out[0] = point[P_EAST] + forward * te + right * tn
    out[1] = point[P_NORTH] + forward * tn - right * te
    bend = point[P_CURVATURE]
    along = 1.0 - right * bend + tipping
    aside = forward * bend + leaning
    out[2] = along * te + aside * tn
    out[3] = along * tn - aside * te


@inlined
def direction(fil, bank, h):
    """Which way an unsigned speed or distance counts: by the estimate where that is certain, else as the hypothesis has it."""
    if fil.signed == 1:
        return 1.0
    v = bank.x[h, fil.at[SPEED]]
    if v * v > 9.0 * variance_of(bank.P_sqrt[h], fil.at[SPEED]):
        bank.tags[h, SIGN] = 1 if v > 0.0 else -1
    return float(bank.tags[h, SIGN])


@inlined
def ring_speed(ring, latest, time, distance):  # odometer readings, index after the last, s, m -> m/s, s
    """Mean wheel speed over the last `WHEEL_SPAN`, and the span it really covers; 0 when readings do not reach back so far."""
    for m in range(1, RING):
        r = (latest - m) % RING
        if not ring[r, 0] > -np.inf:
            break
        span = time - ring[r, 0]
        if span >= WHEEL_SPAN - 1e-6:
            return (distance - ring[r, 1]) / span, span
    return 0.0, 0.0


@part
def second_opinion(shared, time, speed):
    """Whether the receiver's speed is fresh and agrees with a speed."""
    common = shared.common
    fresh = common[C_GNSS_SPEED_TIME] > time - 1.5 and common[C_SPEED_STALE] == 0.0 and time > common[C_DISTRUST]
    return fresh and common[C_GNSS_SPEED] > 1.0 and abs(common[C_GNSS_SPEED] - speed) < 0.3 + 0.01 * speed


@part
def against_speed(shared, time, wheel, speed):
    """Whether wheel and receiver agree with each other and not with the filter's speed."""
    told = shared.common[C_GNSS_SPEED]
    return second_opinion(shared, time, abs(wheel)) and abs(told - abs(speed)) > AGAINST + 2.0 * abs(told - abs(wheel))


@part
def contradicted(fil, shared, bank, h, time, wheel):
    """Difference of the receiver's speed from the wheel's, where its fixes too fall away from where the wheel has the train; else 0."""
    common = shared.common
    told = common[C_GNSS_SPEED]
    fresh = common[C_GNSS_SPEED_TIME] > time - 1.5 and common[C_SPEED_STALE] == 0.0 and time > common[C_DISTRUST]
    believable = common[C_SUSPECTS] == 0.0 and abs(common[C_ALONG]) < STEP_MOST
    if not (fresh and believable and common[C_ALONG_TIME] > time - 1.5):
        return 0.0
    away = told - wheel
    i_a = fil.at[ACCELERATION]
    pulls = abs(bank.x[h, i_a]) if i_a >= 0 else 0.5
    if abs(away) < CONTRADICTS + CONTRADICTS_SHARE * wheel + pulls:
        return 0.0
    ahead = common[C_ALONG] if bank.x[h, fil.at[SPEED]] >= 0.0 else -common[C_ALONG]
    ahead = ahead if away > 0.0 else -ahead
    return away if ahead > max(2.0 * abs(away), 2.0 * common[C_ALONG_SIGMA]) else 0.0


@inlined
def wheel_row(fil, shared, bank, work, h, row, leader):
    """Odometer distance: a slipping wheel is forgotten until it agrees with the speed again. Gives ln p, slip and shake variances.

    A wheel slips in all hypotheses or in none, as the heaviest one (`leader`, taken first) finds: else a slip would choose a track.
    """
    at = fil.at
    k = fil.settings
    x, P_sqrt = bank.x[h], bank.P_sqrt[h]
    h_row, f, keep, move = work.vector[W_H], work.vector[W_F], work.vector[W_KEEP], work.vector[W_MOVE]
    column = work.vector[W_COLUMN]
    i_d, i_v, i_a = at[WHEEL_DISTANCE], at[SPEED], at[ACCELERATION]
    time, distance = row[TIME], row[DISTANCE]
    variance = k[K_ODOMETER_SIGMA] ** 2
    for j in range(x.shape[0]):
        h_row[j] = 0.0
    h_row[i_d] = 1.0
    innovation = distance - x[i_d]
    s = project(P_sqrt, h_row, f) + variance
    wheel, span = ring_speed(shared.ring, int(shared.common[C_RING]), time, distance)
    differs = False
    agrees = False
    if span > 0.0:
        expected = (1.0 + x[at[ODOMETER_SCALE]]) * (x[i_v] - (0.5 * span * x[i_a] if i_a >= 0 else 0.0))
        if fil.signed == 0:
            expected = abs(expected)
        # 0.15 m/s^2 for what the speed did within the span
        sigma = math.sqrt(variance_of(P_sqrt, i_v) + 2.0 * variance / (span * span) + (0.15 * span) ** 2)
        differs = abs(wheel - expected) > k[K_SLIP_GATE] * sigma
        agrees = abs(wheel - expected) < 0.1 + 1.5 * sigma
    shake = 0.0
    away = 0.0
    info = bank.info[h]
    longest = False
    if h != leader:
        longest = info[SLIP_SINCE] > -np.inf and bank.info[leader, AGREE_SINCE] == -np.inf
        begins = info[SLIP_SINCE] == -np.inf and bank.info[leader, SLIP_SINCE] == time
        if not begins:
            info[SLIP_SINCE] = bank.info[leader, SLIP_SINCE]
            info[AGREE_SINCE] = bank.info[leader, AGREE_SINCE]
    elif info[SLIP_SINCE] == -np.inf:
        away = contradicted(fil, shared, bank, h, time, abs(wheel)) if span > 0.0 else 0.0
        begins = abs(innovation) > k[K_SLIP_GATE] * math.sqrt(s) or differs
        if not begins and abs(x[at[ODOMETER_SCALE]]) > SCALE_GATE * k[K_ODOMETER_SCALE]:
            begins = shared.common[C_RESCALED] == -np.inf
        begins = begins or away != 0.0
    elif at[ACCELEROMETER_BIAS] >= 0 and span > 0.0 and against_speed(shared, time, wheel, x[i_v]):
        begins = False  # wheel and receiver agree: it is the accelerometer that is wrong
        shared.common[C_BLAMED_WAY] = abs(wheel - abs(x[i_v])) * (time - info[SLIP_SINCE])
        info[SLIP_SINCE] = -np.inf
        info[AGREE_SINCE] = np.inf
        shared.common[C_ACCELEROMETER_FAULTS] += 1.0
        shared.common[C_BLAMED] = time
    else:
        begins = False
        longest = time - info[SLIP_SINCE] > k[K_SLIP_LONGEST]
        if longest and second_opinion(shared, time, abs(x[i_v])):
            longest = False  # the receiver confirms the speed: another wheel, or a dead one
            info[AGREE_SINCE] = np.inf
            shared.common[C_ODOMETER_FAULTS] += 1.0
            if span > 0.0 and abs(wheel) < DEAD_WHEEL * abs(x[i_v]):
                info[SLIP_SINCE] = time  # it slips on: no scale makes a speed of it
            else:
                info[SLIP_SINCE] = -np.inf
                shared.common[C_RESCALED] = time
        if longest:
            info[SLIP_SINCE] = -np.inf
            info[AGREE_SINCE] = -np.inf
        elif agrees:
            info[AGREE_SINCE] = min(info[AGREE_SINCE], time)
            if time - info[AGREE_SINCE] >= 1.0:
                info[SLIP_SINCE] = -np.inf
        else:
            info[AGREE_SINCE] = np.inf
    if begins:
        info[SLIP_SINCE] = time
        if abs(x[at[ODOMETER_SCALE]]) > SCALE_GATE * k[K_ODOMETER_SCALE] and shared.common[C_RESCALED] == -np.inf:
            # a slow slip that passed for a scale: forget it, and take the wheel for what it was
            widen(P_sqrt, at[ODOMETER_SCALE], SCALE_STEP, column)
            for j in range(x.shape[0]):
                h_row[j] = 0.0
            h_row[at[ODOMETER_SCALE]] = 1.0
            project(P_sqrt, h_row, f)
            absorb(x, P_sqrt, f, -x[at[ODOMETER_SCALE]], k[K_ODOMETER_SCALE] ** 2, keep, move)
            h_row[at[ODOMETER_SCALE]] = 0.0
            h_row[i_d] = 1.0
        info[AGREE_SINCE] = np.inf
        if h == leader:
            shared.common[C_SLIPS] += 1.0
        done = max(SHAKE_SPEED, abs(away))  # what the slip has already done
        shake = done * done
        widen(P_sqrt, i_v, done, column)
        if away != 0.0:
            widen(P_sqrt, at[POSITION], shared.common[C_ALONG], column)
            work.slot[h, S_STRETCH] += shared.common[C_ALONG] ** 2
        if i_a >= 0:
            widen(P_sqrt, i_a, KICK, column)
    elif longest:  # then it is the speed that is wrong
        shake = (1.0 + abs(wheel - abs(x[i_v]))) ** 2
        widen(P_sqrt, i_v, math.sqrt(shake), column)
        if i_a >= 0:
            widen(P_sqrt, i_a, KICK, column)
    if shared.common[C_BLAMED] == time:
        shake = (0.1 + abs(wheel - abs(x[i_v]))) ** 2
        widen(P_sqrt, i_v, math.sqrt(shake), column)
        widen(P_sqrt, at[ACCELEROMETER_BIAS], FORCE_STEP, column)
        widen(P_sqrt, at[POSITION], shared.common[C_BLAMED_WAY], column)
        work.slot[h, S_STRETCH] += shared.common[C_BLAMED_WAY] ** 2
    if shared.common[C_RESCALED] == time:
        widen(P_sqrt, at[ODOMETER_SCALE], SCALE_STEP, column)
    slip = 0.0
    evidence = -0.5 * (min(innovation * innovation / s, ROW_GATE) + math.log(s))
    if info[SLIP_SINCE] > -np.inf:
        slip = FORGET_WHEEL * FORGET_WHEEL
        widen(P_sqrt, i_d, FORGET_WHEEL, column)
        evidence = -0.5 * (ROW_GATE + math.log(variance))
    project(P_sqrt, h_row, f)
    absorb(x, P_sqrt, f, innovation, variance, keep, move)
    return evidence, slip, shake


@part
def wheel_speed_row(fil, bank, work, h, row):
    """Odometer speed, (1 + k) |v|."""
    k = fil.settings
    x = bank.x[h]
    h_row = work.vector[W_H]
    i_v, i_k = fil.at[SPEED], fil.at[ODOMETER_SCALE]
    sigma = row[SIGMA_WHEEL] if row[SIGMA_WHEEL] > 0.0 else k[K_ODOMETER_SPEED]
    sign = direction(fil, bank, h)
    h_row[i_v] = sign * (1.0 + x[i_k])
    h_row[i_k] = sign * x[i_v]
    innovation = row[WHEEL_SPEED] - sign * (1.0 + x[i_k]) * x[i_v]
    evidence = robust_row(
        x, bank.P_sqrt[h], h_row, innovation, sigma * sigma, work.vector[W_F], work.vector[W_KEEP], work.vector[W_MOVE]
    )
    h_row[i_k] = 0.0
    h_row[i_v] = 0.0
    return evidence


@inlined
def log_once(variance, shared_part, alike):
    """Log-determinant's share of a row whose variance holds a part that `alike` rows have in common: it counts once in them.

    Without it, the hypothesis whose model states the smaller error would gain with every row.
    """
    return math.log(variance - shared_part) + math.log(variance / (variance - shared_part)) / alike


@inlined
def somewhere(
    innovation, variance, counts, once
):  # (>= 5,) by Gauss-Hermite node -> -2 ln p of a mixture over the place
    """What a reading says of a hypothesis that does not know its place well: it fits if it fits anywhere there (15.4 over 19.3's nodes).

    The misfit of the node that fits best counts with every row; at which nodes it does not fit tells of the place, not of the track, and
    is the same until the train has moved by its uncertainty: it counts `once` a row. A turnout's toe 30 m ahead is then no evidence
    against its leg, whatever the spread of the place.
    """
    best = ROW_GATE
    for m in range(5):
        best = min(best, innovation[m] * innovation[m] / variance)
    p = 0.0
    for m in range(5):
        nis = min(innovation[m] * innovation[m] / variance, ROW_GATE)
        p += GAUSS_HERMITE_WEIGHTS[m] * math.exp(-0.5 * (nis - best))
    return counts * best - 2.0 * once * math.log(p)


@inlined
def inertial_rows(fil, net, shared, bank, work, h, row, dt):
    """Yaw rate and specific force to the right, linearised statistically over the position's spread (five-point Gauss-Hermite).

    omega_z = v bend + b_g + tilt v phi', f_y = v^2 bend - g lean + b_y with bend = kappa cos(alpha) cos(phi) - kappa_v sin(phi) and
    lean = cos(alpha) sin(phi) (19.3).
    """
    k = fil.settings
    x, P_sqrt = bank.x[h], bank.P_sqrt[h]
    h_row, probe, f, keep, move = (
        work.vector[W_H],
        work.probe,
        work.vector[W_F],
        work.vector[W_KEEP],
        work.vector[W_MOVE],
    )
    i_v, i_s, i_g, i_t, i_y = fil.at[SPEED], fil.at[POSITION], fil.at[GYRO_BIAS], fil.at[GYRO_TILT], fil.at[SIDE_BIAS]
    v = x[i_v]
    middle = x[i_s] - 0.5 * dt * v  # the mean since the epoch before belongs to the middle of the step
    spread = variance_of(P_sqrt, i_s)
    sd = math.sqrt(spread)
    mean = 0.0
    slope = 0.0
    square = 0.0
    lean = 0.0
    lean_slope = 0.0
    lean_square = 0.0
    roll = 0.0
    for m in range(5):
        path_shape(net, bank, h, middle + GAUSS_HERMITE_NODES[m] * sd, probe)
        bend = yaw_rate_kernel(1.0, probe[P_CURVATURE], probe[P_GRADIENT], probe[P_GRADIENT_RATE], probe[P_CANT])
        tilted = probe[P_CANT] / (RAIL_CENTRE_DISTANCE * math.sqrt(1.0 + probe[P_GRADIENT] * probe[P_GRADIENT]))
        w = GAUSS_HERMITE_WEIGHTS[m]
        work.mix[0, m] = bend
        work.mix[1, m] = tilted
        mean += w * bend
        slope += w * GAUSS_HERMITE_NODES[m] * bend
        square += w * bend * bend
        lean += w * tilted
        lean_slope += w * GAUSS_HERMITE_NODES[m] * tilted
        lean_square += w * tilted * tilted
        roll += w * probe[P_CANT_RATE] / RAIL_CENTRE_DISTANCE
    # what a line does not follow is the same until the train has moved by its own uncertainty
    again = max(1.0, sd / max(abs(v) * dt, 0.01))
    rest = again * max(square - mean * mean - slope * slope, 0.0)
    counts = min(1.0, abs(v) * dt / EVIDENCE_STEP)  # at walking pace many rows tell of one place
    once = min(counts, 1.0 / again)
    lean_rest = again * max(lean_square - lean * lean - lean_slope * lean_slope, 0.0)
    slope /= sd
    lean_slope /= sd
    if fil.slope > 0.0 and slope != 0.0:  # what the errors of a built model slope by is no landmark (garrote of slopes)
        part_of = SLOPES * fil.slope / slope
        slope *= max(0.0, 1.0 - part_of * part_of)
    # errors of the model's curvature are the same over some length: count them once a length, not once a row
    alike = max(1.0, k[K_CURVATURE_LENGTH] / max(abs(v) * dt, 0.1))
    rough = (probe[P_SIGMA_BEND] ** 2 + (slope * k[K_CURVATURE_SHIFT]) ** 2) * alike
    # where the model does not know where the track lies (a bridged tunnel) it does not know how it bends either
    poor = probe[P_SIGMA_CROSS] / (BLIND_LENGTH * BLIND_LENGTH)
    rough += poor * poor * max(1.0, BLIND_LENGTH / max(abs(v) * dt, 0.1))
    if row[YAW_RATE] == row[YAW_RATE] and row[TIME] >= shared.common[C_YAW_DISTRUST]:
        moving = min(1.0, abs(v) / 2.0)
        variance = (
            row[SIGMA_YAW] ** 2
            + (moving * k[K_GYRO_FLOOR]) ** 2
            + v * v * (rest + rough + (k[K_GYRO_SCALE] * mean) ** 2)
        )
        h_row[i_s] = v * slope
        h_row[i_v] = mean + x[i_t] * roll
        h_row[i_g] = 1.0
        h_row[i_t] = v * roll
        innovation = row[YAW_RATE] - v * (mean + x[i_t] * roll) - x[i_g]
        known = project(P_sqrt, h_row, f)
        work.slot[h, S_YAW] = innovation * innovation / (known + variance)
        if bank.live[0] > 1:
            # tracks side by side differ in curvature by less than a model is wrong: only a turnout's difference is evidence
            doubt = known_without(P_sqrt, f, i_s, v * slope) + variance - v * v * rest + (v * k[K_CURVATURE_DOUBT]) ** 2
            for m in range(5):
                work.mix[2, m] = innovation + v * (mean - work.mix[0, m])
            said = counts * log_once(doubt, v * v * rough, alike) + somewhere(work.mix[2], doubt, counts, once)
            credit(bank, h, BY_YAW, -0.5 * said)
        absorb_robustly(x, P_sqrt, f, known, innovation, variance, keep, move)
        h_row[i_g] = 0.0
        h_row[i_t] = 0.0
    if row[SIDE] == row[SIDE] and fil.canted == 1:
        v = x[i_v]
        said = v * v * mean - k[K_GRAVITY] * lean
        sway = k[K_SIDE_NOISE] * min(1.0, 0.1 + abs(v) / 5.0)
        variance = sway * sway * max(1.0, k[K_SIDE_TIME] / dt) + v**4 * (rest + rough) + k[K_GRAVITY] ** 2 * lean_rest
        variance += (k[K_SIDE_SCALE] * said) ** 2 * alike
        if row[SIGMA_FORCE] == row[SIGMA_FORCE]:
            variance += row[SIGMA_FORCE] ** 2
        h_row[i_s] = v * v * slope - k[K_GRAVITY] * lean_slope
        h_row[i_v] = 2.0 * v * mean
        h_row[i_y] = 1.0
        innovation = row[SIDE] - said - x[i_y]
        known = project(P_sqrt, h_row, f)
        if bank.live[0] > 1:
            doubt = known_without(P_sqrt, f, i_s, h_row[i_s]) + variance + (v * v * k[K_CURVATURE_DOUBT]) ** 2
            doubt -= v**4 * rest + k[K_GRAVITY] ** 2 * lean_rest
            for m in range(5):
                work.mix[2, m] = innovation + said - v * v * work.mix[0, m] + k[K_GRAVITY] * work.mix[1, m]
            said = counts * log_once(doubt, v**4 * rough, alike) + somewhere(work.mix[2], doubt, counts, once)
            credit(bank, h, BY_SIDE, -0.5 * said)
        absorb_robustly(x, P_sqrt, f, known, innovation, variance, keep, move)
        h_row[i_y] = 0.0
    h_row[i_s] = 0.0
    h_row[i_v] = 0.0


@part
def balise_place(net, bank, h, track, offset, s):  # -> path coordinate of a balise nearest to s, or nan
    """Where a hypothesis' path passes a balise."""
    best = np.nan
    for i in range(bank.tags[h, COUNT]):
        if bank.track[h, i] == track:
            local = offset if bank.way[h, i] > 0 else net.length[track] - offset
            at = bank.begin[h, i] + local
            if not abs(best - s) <= abs(at - s):
                best = at
    return best


@part
def balise_row(fil, net, bank, work, h, row):
    """A balise that is read: s - s_B; a hypothesis that does not pass it loses as much as a wrong reading is improbable."""
    k = fil.settings
    x, P_sqrt = bank.x[h], bank.P_sqrt[h]
    i_s = fil.at[POSITION]
    s_b = balise_place(net, bank, h, int(row[BALISE_TRACK]), row[BALISE_OFFSET], x[i_s])
    sigma = row[SIGMA_BALISE] if row[SIGMA_BALISE] > 0.0 else k[K_BALISE_SIGMA]
    reach = 4.0 * math.sqrt(variance_of(P_sqrt, i_s) + sigma * sigma) + BALISE_REACH
    if not abs(s_b - x[i_s]) <= reach:
        credit(bank, h, BY_BALISE, STRANGE_BALISE)
        return
    h_row = work.vector[W_H]
    h_row[i_s] = 1.0
    said = robust_row(
        x, P_sqrt, h_row, s_b - x[i_s], sigma * sigma, work.vector[W_F], work.vector[W_KEEP], work.vector[W_MOVE]
    )
    credit(bank, h, BY_BALISE, max(said, STRANGE_BALISE))
    h_row[i_s] = 0.0
    bank.info[h, PASSED] = max(bank.info[h, PASSED], s_b)


@part
def missed_balises(fil, net, bank, h):
    """Balises that a hypothesis has passed for certain and that were not read: ln(1 - p_D) each (19.3)."""
    x = bank.x[h]
    i_s = fil.at[POSITION]
    s = x[i_s]
    sure = s - 4.0 * math.sqrt(variance_of(bank.P_sqrt[h], i_s)) - BALISE_REACH
    begun = bank.info[h, PASSED]
    if sure <= begun:
        return
    missed = 0
    for i in range(bank.tags[h, COUNT]):
        track = bank.track[h, i]
        length = net.length[track]
        if bank.begin[h, i] > sure or bank.begin[h, i] + length < begun:
            continue
        for j in range(net.balise_start[track], net.balise_start[track + 1]):
            at = bank.begin[h, i] + (net.balise[j] if bank.way[h, i] > 0 else length - net.balise[j])
            if begun < at <= sure:
                missed += 1
    bank.info[h, PASSED] = sure
    if missed > 0:
        credit(bank, h, BY_BALISE, missed * math.log(fil.settings[K_BALISE_MISSED]))


@part
def course_row(fil, shared, bank, work, h, row, sign, sigma):
    """GNSS course as the velocity across the path where the antenna moves there; `sign` says which way the train runs along it."""
    at = fil.at
    k = fil.settings
    x, P_sqrt = bank.x[h], bank.P_sqrt[h]
    h_row, f, keep, move = work.vector[W_H], work.vector[W_F], work.vector[W_KEEP], work.vector[W_MOVE]
    point = work.point[h]
    i_s, i_v, i_t = at[POSITION], at[SPEED], at[TIME_TAG]
    speed, course_east, course_north = row[GNSS_SPEED], row[COURSE_EAST], row[COURSE_NORTH]
    stated = row[SIGMA_SPEED] > 0.0
    bend = point[P_CURVATURE]
    step = x[i_s] + x[i_v] * x[i_t] - point[POINT_SIZE]  # the course is of where the fix shows the train
    te = point[P_D_EAST] + step * bend * point[P_D_NORTH]
    tn = point[P_D_NORTH] - step * bend * point[P_D_EAST]
    across = sign * speed * (course_east * tn - course_north * te) / math.hypot(te, tn)
    across -= (
        speed * bend * fil.lever[0]
    )  # whichever way the train runs: the antenna's circle is turned against the track by as much
    floor = speed * k[K_COURSE_SIGMA] * (0.2 if stated else 3.0)
    bent = 0.5 * speed * BEND_CHANGE * variance_of(P_sqrt, i_s)
    h_row[i_s] = speed * bend
    h_row[i_t] = h_row[i_s] * x[i_v]
    # an error of the model's bearing is the same from fix to fix of a slow train
    turned = speed * fil.turned * point[P_SIGMA_CROSS]
    since = max(speed * (row[TIME] - shared.common[C_FIX_TIME]), 0.1)
    alike = max(1.0, BEARING_LENGTH / since)
    variance = sigma * sigma + floor * floor + bent * bent + alike * turned * turned
    # tracks side by side differ in bearing by less than a model is wrong: only a turnout's leg is evidence
    doubt = k[K_COURSE_DOUBT] + fil.turned * point[P_SIGMA_CROSS]
    doubt = project(P_sqrt, h_row, f) + variance + (speed * doubt) ** 2
    said = min(across * across / doubt, ROW_GATE) + log_once(doubt, alike * turned * turned, alike)
    if (
        point[P_SIGMA_CROSS] > EXACT
    ):  # a map's bends are wrong over the length of its errors: many fixes see one and the same
        said /= max(1.0, BLIND_LENGTH / since)
    work.slot[h, S_COURSE] -= 0.5 * said
    before = stamps(fil, x, P_sqrt)
    robust_row(x, P_sqrt, h_row, across, variance, f, keep, move)
    if not timed(fil):
        take_back(fil, x, P_sqrt, before, 2, work.vector[W_COLUMN])
    h_row[i_t] = 0.0
    h_row[i_s] = 0.0


@inlined
def speed_rows(fil, shared, bank, work, h, row):
    """GNSS speed, |v - latency a| + error, and course, the velocity across the path as the antenna moves there."""
    at = fil.at
    k = fil.settings
    x, P_sqrt = bank.x[h], bank.P_sqrt[h]
    h_row, f, keep, move = work.vector[W_H], work.vector[W_F], work.vector[W_KEEP], work.vector[W_MOVE]
    point = work.point[h]
    i_v, i_l, i_e, i_a = at[SPEED], at[SPEED_LATENCY], at[SPEED_ERROR], at[ACCELERATION]
    speed = row[GNSS_SPEED]
    course_east, course_north = row[COURSE_EAST], row[COURSE_NORTH]
    stated = row[SIGMA_SPEED] > 0.0
    sigma = row[SIGMA_SPEED] if stated else k[K_SPEED_SIGMA]
    v = x[i_v]
    if speed < 4.0 * sigma and abs(v) < 8.0 * sigma:  # near standstill the sign is not told
        h_row[i_v] = 1.0
        before = stamps(fil, x, P_sqrt)
        credit(bank, h, BY_SPEED, robust_row(x, P_sqrt, h_row, -v, speed * speed + sigma * sigma, f, keep, move))
        if not timed(fil):
            take_back(fil, x, P_sqrt, before, 2, work.vector[W_COLUMN])
        h_row[i_v] = 0.0
        return
    certain = v * v > 25.0 * variance_of(P_sqrt, i_v) and abs(v) > 3.0
    if (
        course_east == course_east
        and certain
        and v * (course_east * point[P_D_EAST] + course_north * point[P_D_NORTH]) < 0.0
    ):
        credit(
            bank, h, BY_COURSE, -0.5 * ROW_GATE
        )  # a train does not turn at speed: the course is wrong, or the hypothesis
        return
    if course_east == course_east:
        sign = 1.0 if course_east * point[P_D_EAST] + course_north * point[P_D_NORTH] > 0.0 else -1.0
    elif fil.signed == 0:
        sign = direction(fil, bank, h)
    else:
        sign = 1.0 if v >= 0.0 else -1.0
    a = 0.0
    if i_a >= 0:
        a = x[i_a]
        h_row[i_a] = -sign * x[i_l]
    elif row[FORCE] == row[FORCE]:
        a = row[FORCE] - x[at[ACCELEROMETER_BIAS]] - gravity_pull(k[K_GRAVITY], point[P_GRADIENT])
    share = k[K_SPEED_SHARE] * sigma
    h_row[i_v] = sign
    h_row[i_l] = -sign * a
    h_row[i_e] = share
    innovation = speed - sign * (v - x[i_l] * a) - share * x[i_e]
    before = stamps(fil, x, P_sqrt)
    credit(bank, h, BY_SPEED, robust_row(x, P_sqrt, h_row, innovation, sigma * sigma, f, keep, move))
    if not timed(fil):
        take_back(fil, x, P_sqrt, before, 2, work.vector[W_COLUMN])
    h_row[i_v] = 0.0
    h_row[i_l] = 0.0
    h_row[i_e] = 0.0
    if i_a >= 0:
        h_row[i_a] = 0.0
    if course_east == course_east and speed > 1.0 and abs(x[i_v]) > 1.0:
        course_row(fil, shared, bank, work, h, row, sign, sigma)


@inlined
def motion_rows(fil, net, shared, bank, work, h, row, dt, still):
    """Odometer speed, standstill, yaw gyro, GNSS speed and course of one hypothesis, where they are there."""
    at = fil.at
    h_row = work.vector[W_H]
    for j in range(h_row.shape[0]):
        h_row[j] = 0.0
    if row[WHEEL_SPEED] == row[WHEEL_SPEED] and at[ODOMETER_SCALE] >= 0:
        credit(bank, h, BY_ODOMETER, wheel_speed_row(fil, bank, work, h, row))
    if still:
        i_v = at[SPEED]
        h_row[i_v] = 1.0
        variance = fil.settings[K_STILL_SIGMA] ** 2
        before = stamps(fil, bank.x[h], bank.P_sqrt[h])
        rest = robust_row(
            bank.x[h],
            bank.P_sqrt[h],
            h_row,
            -bank.x[h, i_v],
            variance,
            work.vector[W_F],
            work.vector[W_KEEP],
            work.vector[W_MOVE],
        )
        if not timed(fil):
            take_back(fil, bank.x[h], bank.P_sqrt[h], before, 2, work.vector[W_COLUMN])
        credit(bank, h, BY_STANDSTILL, rest)
        h_row[i_v] = 0.0
    if at[GYRO_BIAS] >= 0 and dt > 0.0 and (row[YAW_RATE] == row[YAW_RATE] or row[SIDE] == row[SIDE]):
        inertial_rows(fil, net, shared, bank, work, h, row, dt)
    if row[BALISE_TRACK] >= 0.0:
        balise_row(fil, net, bank, work, h, row)
    if fil.reads_balises == 1:
        missed_balises(fil, net, bank, h)
    if row[GNSS_SPEED] == row[GNSS_SPEED] and at[SPEED_LATENCY] >= 0 and shared.common[C_SPEED_STALE] == 0.0:
        speed_rows(fil, shared, bank, work, h, row)


@part
def position_row(fil, net, shared, bank, work, h, row):
    """Rows of a GNSS fix, c(s + v tag) + lever + sigma b + frame, and its innovation; gives NIS and ln det S.

    `work` then holds rows, projections, innovation, white variances and the covariance S. A spread over which the path bends is
    linearised statistically (five-point Gauss-Hermite), else at the estimate.
    """
    at = fil.at
    k = fil.settings
    x, P_sqrt = bank.x[h], bank.P_sqrt[h]
    h_east, h_north, f_east, f_north = work.rows[h, 0], work.rows[h, 1], work.rows[h, 2], work.rows[h, 3]
    point, probe, place, fix = work.point[h], work.probe, work.place, work.fix[h]
    i_s, i_v, i_g, i_t = at[POSITION], at[SPEED], at[GNSS_EAST], at[TIME_TAG]
    i_fe, i_fn = at[FRAME_EAST], at[FRAME_NORTH]
    n = x.shape[0]
    for j in range(n):
        h_east[j] = 0.0
        h_north[j] = 0.0
    spread = variance_of(P_sqrt, i_s)
    extra_east = 0.0
    extra_north = 0.0
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
        sagitta = 0.5 * step * step * point[P_CURVATURE]
        h_east[i_s] = place[2]
        h_north[i_s] = place[3]
        at_east = place[0] + step * place[2] + sagitta * place[3]
        at_north = place[1] + step * place[3] - sagitta * place[2]
    h_east[i_t] = x[i_v] * h_east[i_s]
    h_north[i_t] = x[i_v] * h_north[i_s]
    h_east[i_v] = x[i_t] * h_east[i_s]
    h_north[i_v] = x[i_t] * h_north[i_s]
    scale = shared.common[C_SCALE] * k[K_CORRELATED]
    h_east[i_g] = scale * shared.common[C_SIGMA_EAST]
    h_north[i_g + 1] = scale * shared.common[C_SIGMA_NORTH]
    h_east[i_fe] = 1.0
    h_north[i_fn] = 1.0
    fix[0] = row[EAST] - at_east - h_east[i_g] * x[i_g] - x[i_fe]
    fix[1] = row[NORTH] - at_north - h_north[i_g + 1] * x[i_g + 1] - x[i_fn]
    i_m = at[MAP_CROSS]
    if i_m >= 0:  # the track lies to the right of where the model has it
        across = point[P_SIGMA_CROSS] / math.hypot(point[P_D_EAST], point[P_D_NORTH])
        h_east[i_m] = across * point[P_D_NORTH]
        h_north[i_m] = -across * point[P_D_EAST]
        fix[0] -= h_east[i_m] * x[i_m]
        fix[1] -= h_north[i_m] * x[i_m]
    fix[2] = (k[K_WHITE] * row[SIGMA_EAST]) ** 2 + extra_east
    fix[3] = (k[K_WHITE] * row[SIGMA_NORTH]) ** 2 + extra_north
    s_ee = project(P_sqrt, h_east, f_east) + fix[2]
    s_nn = project(P_sqrt, h_north, f_north) + fix[3]
    s_en = 0.0
    for j in range(n):
        s_en += f_east[j] * f_north[j]
    fix[4] = s_ee
    fix[5] = s_nn
    fix[6] = s_en
    det = s_ee * s_nn - s_en * s_en
    nis = (fix[0] * fix[0] * s_nn - 2.0 * fix[0] * fix[1] * s_en + fix[1] * fix[1] * s_ee) / det
    return nis, math.log(det)
