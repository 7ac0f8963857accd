"""Inner loops of the inertial room: flat float64 arrays, SI and radians, no validation.

A strapdown state is (10,): latitude, longitude, height, velocity north, east, down, quaternion q_nb (scalar first). A gravity field is
(11,): see `mechanization.GravityField`. The memory of a step is (13,): angle and velocity increment of the step before (body axes), its
change of velocity (local axes), its length (0: there was none), its Coriolis acceleration.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from railnav.attitude._kernels import exponential, multiply, rotate

#: Elements of a gravity field.
(
    SEMI_MAJOR,
    ECCENTRICITY2,
    EQUATOR,
    SOMIGLIANA,
    FLATTENING,
    CENTRIFUGAL,
    FREE_AIR,
    DEFLECTION_N,
    DEFLECTION_E,
    ANOMALY,
    OMEGA,
) = range(11)
#: Beyond this latitude (89.9 degrees) north and east turn too fast.
POLAR_LATITUDE = 1.5690509975429023
#: Longest step, s; a longer one is cut into equal parts.
LONGEST_INTERVAL = 0.1
#: Schemes of `strapdown_kernel`.
CONING, MATRIX, EULER, PREDICTOR, PREDICTOR_FIRST_ORDER = range(5)


@njit(cache=True)
def allan_kernel(integral, factors, variance):  # (n + 1,) integral per sampling interval, (k,), (k,)
    """Overlapping Allan variance at each averaging factor."""
    points = integral.shape[0]
    for i in range(factors.shape[0]):
        m = factors[i]
        total = 0.0
        for k in range(points - 2 * m):
            d = integral[k + 2 * m] - 2.0 * integral[k + m] + integral[k]
            total += d * d
        variance[i] = total / (2.0 * m * m * (points - 2 * m))  # IEEE Std 952, C.11


@njit(cache=True)
def radii(sine, field):
    """Radii of curvature in the meridian and across it, m."""
    root = 1.0 / math.sqrt(1.0 - field[ECCENTRICITY2] * sine * sine)
    across = field[SEMI_MAJOR] * root
    return across * (1.0 - field[ECCENTRICITY2]) * (root * root), across


@njit(cache=True)
def gravity(sine, height, field):
    """Gravity north, east, down, m/s^2: normal gravity, its change with height, deflection of the vertical and anomaly."""
    s2 = sine * sine
    gamma = field[EQUATOR] * (1.0 + field[SOMIGLIANA] * s2) / math.sqrt(1.0 - field[ECCENTRICITY2] * s2)
    x = height / field[SEMI_MAJOR]
    if field[FREE_AIR] == 2.0:
        gamma *= (
            1.0 - 2.0 * (1.0 + field[FLATTENING] + field[CENTRIFUGAL] - 2.0 * field[FLATTENING] * s2) * x + 3.0 * x * x
        )
    elif field[FREE_AIR] == 1.0:
        gamma *= 1.0 - 2.0 * x
    return -gamma * field[DEFLECTION_N], -gamma * field[DEFLECTION_E], gamma + field[ANOMALY]


@njit(cache=True)
def frame_rates(sine, cosine, across, meridian, vn, ve, omega):
    """Rates w_ie_n (north, down) and w_en_n (north, east, down), rad/s; radii with the height added."""
    return omega * cosine, -omega * sine, ve / across, -vn / meridian, -ve * sine / (across * cosine)  # KZ(A.9), (A.10)


@njit(cache=True)
def coning_step(state, memory, dtheta, dv, h, field):  # (10,), (13,), (3,) rad, (3,) m/s, s
    """One strapdown step with coning, sculling and scrolling from this and the last increment; changes state and memory."""
    # second order of a linear rate through two intervals: h^2/(6 h1 (h + h1)), 1/12 if they are equal
    last = memory[9]
    c = 0.0
    if last > 0.0 and h <= 2.0 * last:
        c = h * h / (6.0 * last * (h + last))
    tx, ty, tz = dtheta[0], dtheta[1], dtheta[2]
    ux, uy, uz = dv[0], dv[1], dv[2]
    px, py, pz = memory[0], memory[1], memory[2]
    rx, ry, rz = memory[3], memory[4], memory[5]
    fx = tx + c * (py * tz - pz * ty)  # rotation vector of the step
    fy = ty + c * (pz * tx - px * tz)
    fz = tz + c * (px * ty - py * tx)
    # rotation of the increment back to the start of the step, 1/2 phi x u + 1/6 phi x (phi x u), and sculling
    ax, ay, az = fy * uz - fz * uy, fz * ux - fx * uz, fx * uy - fy * ux
    sx = ux + 0.5 * ax + (fy * az - fz * ay) / 6.0 + c * (py * uz - pz * uy + ry * tz - rz * ty)
    sy = uy + 0.5 * ay + (fz * ax - fx * az) / 6.0 + c * (pz * ux - px * uz + rz * tx - rx * tz)
    sz = uz + 0.5 * az + (fx * ay - fy * ax) / 6.0 + c * (px * uy - py * ux + rx * ty - ry * tx)

    height = state[2]
    vn, ve, vd = state[3], state[4], state[5]
    q0, q1, q2, q3 = state[6], state[7], state[8], state[9]
    gn, ge, gd = rotate(q0, q1, q2, q3, sx, sy, sz)
    sine, cosine = math.sin(state[0]), math.cos(state[0])
    kn, ke, kd = gravity(sine, height, field)
    meridian, across = radii(sine, field)
    north, east = 1.0 / (meridian + height), 1.0 / (across + height)
    # middle of the step, its velocity with the Coriolis acceleration of the step before
    half = 0.5 * h
    mn = vn + 0.5 * gn + half * (kn - memory[10])
    me = ve + 0.5 * ge + half * (ke - memory[11])
    md = vd + 0.5 * gd + half * (kd - memory[12])
    turn = mn * half * north
    s1, c1 = sine + cosine * turn, cosine - sine * turn
    secant = 1.0 / c1
    en, ed = field[OMEGA] * c1, -field[OMEGA] * s1
    wn, we, wd = me * east, -mn * north, -me * east * s1 * secant
    zn, ze, zd = (en + wn) * h, we * h, (ed + wd) * h
    cn, ce, cd = 2.0 * en + wn, we, 2.0 * ed + wd
    an, ae, ad = ce * md - cd * me, cd * mn - cn * md, cn * me - ce * mn
    # change of velocity: the frame has turned half way on average
    dn = gn - 0.5 * (ze * gd - zd * ge) + (kn - an) * h
    de = ge - 0.5 * (zd * gn - zn * gd) + (ke - ae) * h
    dd = gd - 0.5 * (zn * ge - ze * gn) + (kd - ad) * h
    memory[10], memory[11], memory[12] = an, ae, ad
    # mean velocity of the step: the trapezium less the part of a growing acceleration (scrolling)
    mn, me, md = vn + 0.5 * dn, ve + 0.5 * de, vd + 0.5 * dd
    if c > 0.0:
        s = h / (6.0 * (h + last))
        p = h / last
        mn -= s * (dn - p * memory[6])
        me -= s * (de - p * memory[7])
        md -= s * (dd - p * memory[8])
    state[0] += mn * h * north
    state[1] += me * h * east * secant
    state[2] = height - md * h
    state[3] = vn + dn
    state[4] = ve + de
    state[5] = vd + dd
    e0, e1, e2, e3 = exponential(fx, fy, fz)
    q0, q1, q2, q3 = multiply(q0, q1, q2, q3, e0, e1, e2, e3)
    e0, e1, e2, e3 = exponential(-zn, -ze, -zd)
    q0, q1, q2, q3 = multiply(e0, e1, e2, e3, q0, q1, q2, q3)
    unit = 1.5 - 0.5 * (q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    state[6], state[7], state[8], state[9] = q0 * unit, q1 * unit, q2 * unit, q3 * unit
    memory[0], memory[1], memory[2] = tx, ty, tz
    memory[3], memory[4], memory[5] = ux, uy, uz
    memory[6], memory[7], memory[8], memory[9] = dn, de, dd, h


@njit(cache=True)
def mean_step(state, dtheta, dv, h, field, scheme):  # (10,), (3,) rad, (3,) m/s, s
    """One step of the source's second-order (MATRIX) or first-order (EULER) scheme, KZ(1.46) to (1.51); 1 if pitch is vertical."""
    latitude, height = state[0], state[2]
    vn, ve, vd = state[3], state[4], state[5]
    q0, q1, q2, q3 = state[6], state[7], state[8], state[9]
    sine, cosine = math.sin(latitude), math.cos(latitude)
    meridian, across = radii(sine, field)
    en, ed, wn, we, wd = frame_rates(sine, cosine, across + height, meridian + height, vn, ve, field[OMEGA])
    kn, ke, kd = gravity(sine, height, field)
    gn, ge, gd = rotate(q0, q1, q2, q3, dv[0], dv[1], dv[2])
    zn, ze, zd = (en + wn) * h, we * h, (ed + wd) * h
    if scheme == EULER:
        # angles of q_nb, KZ(A.5)
        up = 2.0 * (q1 * q3 - q0 * q2)
        b, c = 2.0 * (q2 * q3 + q0 * q1), 1.0 - 2.0 * (q1 * q1 + q2 * q2)
        level = math.sqrt(b * b + c * c)
        if level < 1e-3:
            return 1
        roll, pitch = math.atan2(b, c), math.atan2(-up, level)
        heading = math.atan2(2.0 * (q1 * q2 + q0 * q3), 1.0 - 2.0 * (q2 * q2 + q3 * q3))
        tx, ty, tz = rotate(q0, -q1, -q2, -q3, zn, ze, zd)
        tx, ty, tz = dtheta[0] - tx, dtheta[1] - ty, dtheta[2] - tz
        sr, cr = math.sin(roll), math.cos(roll)
        turning = sr * ty + cr * tz
        roll += tx + math.tan(pitch) * turning  # KZ(1.46) with KZ(1.30)
        pitch += cr * ty - sr * tz
        heading += turning / level
        sr, cr = math.sin(0.5 * roll), math.cos(0.5 * roll)
        sp, cp = math.sin(0.5 * pitch), math.cos(0.5 * pitch)
        sh, ch = math.sin(0.5 * heading), math.cos(0.5 * heading)
        q0, q1 = cr * cp * ch + sr * sp * sh, sr * cp * ch - cr * sp * sh
        q2, q3 = cr * sp * ch + sr * cp * sh, cr * cp * sh - sr * sp * ch
    else:
        e0, e1, e2, e3 = exponential(dtheta[0], dtheta[1], dtheta[2])
        q0, q1, q2, q3 = multiply(q0, q1, q2, q3, e0, e1, e2, e3)
        e0, e1, e2, e3 = exponential(-zn, -ze, -zd)
        q0, q1, q2, q3 = multiply(e0, e1, e2, e3, q0, q1, q2, q3)
        unit = 1.5 - 0.5 * (q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
        q0, q1, q2, q3 = q0 * unit, q1 * unit, q2 * unit, q3 * unit
        an, ae, ad = rotate(q0, q1, q2, q3, dv[0], dv[1], dv[2])
        gn, ge, gd = 0.5 * (gn + an), 0.5 * (ge + ae), 0.5 * (gd + ad)
    cn, ce, cd = 2.0 * en + wn, we, 2.0 * ed + wd
    dn = gn + (kn - (ce * vd - cd * ve)) * h  # KZ(1.48) with the sign of g corrected
    de = ge + (ke - (cd * vn - cn * vd)) * h
    dd = gd + (kd - (cn * ve - ce * vn)) * h
    mn, me, md = vn + 0.5 * dn, ve + 0.5 * de, vd + 0.5 * dd
    hm = height - 0.5 * md * h
    after = latitude + mn * h / (meridian + hm)
    middle = 0.5 * (latitude + after)
    meridian, across = radii(math.sin(middle), field)
    state[0] = after
    state[1] += me * h / ((across + hm) * math.cos(middle))
    state[2] = height - md * h
    state[3], state[4], state[5] = vn + dn, ve + de, vd + dd
    state[6], state[7], state[8], state[9] = q0, q1, q2, q3
    return 0


@njit(cache=True)
def quaternion_of(C, state):  # (3, 3) nearly a rotation, (10,)
    """Write the quaternion of C, normalised, into a state (Shepperd)."""
    trace = C[0, 0] + C[1, 1] + C[2, 2]
    k = 0
    best = trace
    for i in range(3):
        if C[i, i] > best:
            best = C[i, i]
            k = i + 1
    a, b, c = C[2, 1] - C[1, 2], C[0, 2] - C[2, 0], C[1, 0] - C[0, 1]
    e, f, g = C[0, 1] + C[1, 0], C[0, 2] + C[2, 0], C[1, 2] + C[2, 1]
    if k == 0:
        w, x, y, z = 1.0 + trace, a, b, c
    elif k == 1:
        w, x, y, z = a, 1.0 + 2.0 * C[0, 0] - trace, e, f
    elif k == 2:
        w, x, y, z = b, e, 1.0 + 2.0 * C[1, 1] - trace, g
    else:
        w, x, y, z = c, f, g, 1.0 + 2.0 * C[2, 2] - trace
    n = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    if w < 0.0:
        n = -n
    state[6], state[7], state[8], state[9] = n * w, n * x, n * y, n * z


@njit(cache=True)
def matrix_of(state, C):  # (10,), (3, 3)
    """Write the matrix C_nb of a state's quaternion."""
    w, x, y, z = state[6], state[7], state[8], state[9]
    C[0, 0], C[0, 1], C[0, 2] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    C[1, 0], C[1, 1], C[1, 2] = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
    C[2, 0], C[2, 1], C[2, 2] = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)


@njit(cache=True)
def predictor_step(state, C, dtheta, dv, h, field, scheme):  # (10,), (3, 3), (3,) rad, (3,) m/s, s
    """One inner cycle of the road predictor, rail (1) to (8): PREDICTOR, or PREDICTOR_FIRST_ORDER as in the source.

    C is the attitude of the first-order scheme, which the source lets drift from orthonormality.
    """
    latitude, height = state[0], state[2]
    vn, ve, vd = state[3], state[4], state[5]
    q0, q1, q2, q3 = state[6], state[7], state[8], state[9]
    sine, cosine = math.sin(latitude), math.cos(latitude)
    meridian, across = radii(sine, field)
    meridian += height
    across += height
    en, ed, wn, we, wd = frame_rates(sine, cosine, across, meridian, vn, ve, field[OMEGA])
    kn, ke, kd = gravity(sine, height, field)
    zn, ze, zd = (en + wn) * h, we * h, (ed + wd) * h
    if scheme == PREDICTOR:  # M+ = exp(-w_E T0) M exp(w_C T0), specific force turned half way
        e0, e1, e2, e3 = exponential(0.5 * dtheta[0], 0.5 * dtheta[1], 0.5 * dtheta[2])
        f0, f1, f2, f3 = exponential(-0.5 * zn, -0.5 * ze, -0.5 * zd)
        q0, q1, q2, q3 = multiply(q0, q1, q2, q3, e0, e1, e2, e3)
        q0, q1, q2, q3 = multiply(f0, f1, f2, f3, q0, q1, q2, q3)
        gn, ge, gd = rotate(q0, q1, q2, q3, dv[0], dv[1], dv[2])
        q0, q1, q2, q3 = multiply(q0, q1, q2, q3, e0, e1, e2, e3)
        q0, q1, q2, q3 = multiply(f0, f1, f2, f3, q0, q1, q2, q3)
        unit = 1.5 - 0.5 * (q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
        state[6], state[7], state[8], state[9] = q0 * unit, q1 * unit, q2 * unit, q3 * unit
    else:  # (5), (1) with held samples
        gn = C[0, 0] * dv[0] + C[0, 1] * dv[1] + C[0, 2] * dv[2]
        ge = C[1, 0] * dv[0] + C[1, 1] * dv[1] + C[1, 2] * dv[2]
        gd = C[2, 0] * dv[0] + C[2, 1] * dv[1] + C[2, 2] * dv[2]
        old = C.copy()
        for j in range(3):
            after, last = (j + 1) % 3, (j + 2) % 3
            turn = old[:, after] * dtheta[last] - old[:, last] * dtheta[after]  # column j of C [dtheta x]
            C[0, j] += turn[0] - (ze * old[2, j] - zd * old[1, j])
            C[1, j] += turn[1] - (zd * old[0, j] - zn * old[2, j])
            C[2, j] += turn[2] - (zn * old[1, j] - ze * old[0, j])
        quaternion_of(C, state)
    cn, ce, cd = 2.0 * en + wn, we, 2.0 * ed + wd
    dn = gn + (kn - (ce * vd - cd * ve)) * h  # (4), (6)
    de = ge + (ke - (cd * vn - cn * vd)) * h
    dd = gd + (kd - (cn * ve - ce * vn)) * h
    mn, me, md = vn, ve, vd
    if scheme == PREDICTOR:  # trapezium
        mn, me, md = vn + 0.5 * dn, ve + 0.5 * de, vd + 0.5 * dd
    state[0] = latitude + mn * h / meridian  # (8)
    state[1] += me * h / (across * cosine)
    state[2] = height - md * h
    state[3], state[4], state[5] = vn + dn, ve + de, vd + dd


@njit(cache=True)
def strapdown_kernel(scheme, dtheta, dv, interval, field, out):  # (n, 3) rad, (n, 3) m/s, (n,) s, (11,), (n + 1, 10)
    """States after each sample from out[0]; n, or the sample at which it stopped: near a pole, or EULER with the nose vertical."""
    state = out[0].copy()
    memory = np.zeros(13)
    C = np.empty((3, 3))
    matrix_of(state, C)
    part_theta = np.empty(3)
    part_v = np.empty(3)
    for k in range(interval.shape[0]):
        parts = 1
        if interval[k] > LONGEST_INTERVAL:
            parts = int(math.ceil(interval[k] / LONGEST_INTERVAL - 1e-9))
        for i in range(3):
            part_theta[i] = dtheta[k, i] / parts
            part_v[i] = dv[k, i] / parts
        h = interval[k] / parts
        for _ in range(parts):
            if scheme == CONING:
                coning_step(state, memory, part_theta, part_v, h, field)
            elif scheme in (MATRIX, EULER):
                if mean_step(state, part_theta, part_v, h, field, scheme) != 0:
                    return k
            else:
                predictor_step(state, C, part_theta, part_v, h, field, scheme)
        for i in range(10):
            out[k + 1, i] = state[i]
        if not abs(state[0]) < POLAR_LATITUDE:
            return k
    return interval.shape[0]


@njit(cache=True)
def error_transition_kernel(
    state, force_n, h, field, gyro_time, force_time, Phi
):  # (10,), (3,) m/s^2, s, ..., (15, 15)
    """Transition I + F h of the fifteen errors, as `error_model.error_dynamics`; Phi is overwritten."""
    sine, cosine = math.sin(state[0]), math.cos(state[0])
    meridian, across = radii(sine, field)
    a, b = meridian + state[2], across + state[2]
    vn, ve, vd = state[3], state[4], state[5]
    t = sine / cosine
    omega = field[OMEGA]
    for i in range(15):
        for j in range(15):
            Phi[i, j] = 0.0
        Phi[i, i] = 1.0
    Phi[0, 2], Phi[0, 3] = -vn / (a * a) * h, h / a
    Phi[1, 0] = ve * t / (b * cosine) * h
    Phi[1, 2], Phi[1, 4] = -ve / (b * b * cosine) * h, h / (b * cosine)
    Phi[2, 5] = -h
    # rates and their derivatives by latitude (p), height (k) and velocity
    ien, ied = omega * cosine, -omega * sine
    wn, we, wd = ve / b, -vn / a, -ve * t / b
    ienp, iedp = -omega * sine, -omega * cosine
    wdp = -ve / (b * cosine * cosine)
    wnk, wek, wdk = -ve / (b * b), vn / (a * a), ve * t / (b * b)
    # v x (2 dw_ie + dw_en)
    pn, pd = 2.0 * ienp, 2.0 * iedp + wdp
    Phi[3, 0], Phi[4, 0], Phi[5, 0] = ve * pd * h, (vd * pn - vn * pd) * h, -ve * pn * h
    Phi[3, 2] = (ve * wdk - vd * wek) * h
    Phi[4, 2] = (vd * wnk - vn * wdk) * h
    gradient = 2.0 * field[EQUATOR] * (1.0 + field[SOMIGLIANA] * sine * sine)
    gradient /= math.sqrt(1.0 - field[ECCENTRICITY2] * sine * sine) * field[SEMI_MAJOR]
    Phi[5, 2] = (vn * wek - ve * wnk - gradient) * h
    # -(2 w_ie + w_en) x dv + v x dw_en(dv); dw_en = (dve/b, -dvn/a, -t dve/b)
    cn, ce, cd = 2.0 * ien + wn, we, 2.0 * ied + wd
    Phi[3, 3] += vd / a * h
    Phi[3, 4] = (cd - ve * t / b) * h
    Phi[3, 5] = -ce * h
    Phi[4, 3] = -cd * h
    Phi[4, 4] += (vd + vn * t) / b * h
    Phi[4, 5] = cn * h
    Phi[5, 3] = (ce - vn / a) * h
    Phi[5, 4] = (-cn - ve / b) * h
    fn, fe, fd = force_n[0] * h, force_n[1] * h, force_n[2] * h
    Phi[3, 7], Phi[3, 8] = -fd, fe
    Phi[4, 6], Phi[4, 8] = fd, -fn
    Phi[5, 6], Phi[5, 7] = -fe, fn
    Phi[6, 0], Phi[8, 0] = ienp * h, (iedp + wdp) * h
    Phi[6, 2], Phi[7, 2], Phi[8, 2] = wnk * h, wek * h, wdk * h
    Phi[6, 4], Phi[7, 3], Phi[8, 4] = h / b, -h / a, -t / b * h
    zn, ze, zd = (ien + wn) * h, we * h, (ied + wd) * h
    Phi[6, 7], Phi[6, 8] = zd, -ze
    Phi[7, 6], Phi[7, 8] = -zd, zn
    Phi[8, 6], Phi[8, 7] = ze, -zn
    q0, q1, q2, q3 = state[6], state[7], state[8], state[9]
    for j in range(3):
        x, y, z = rotate(q0, q1, q2, q3, 1.0 if j == 0 else 0.0, 1.0 if j == 1 else 0.0, 1.0 if j == 2 else 0.0)
        Phi[3, 12 + j], Phi[4, 12 + j], Phi[5, 12 + j] = x * h, y * h, z * h
        Phi[6, 9 + j], Phi[7, 9 + j], Phi[8, 9 + j] = -x * h, -y * h, -z * h
        Phi[9 + j, 9 + j] = 1.0 - h / gyro_time
        Phi[12 + j, 12 + j] = 1.0 - h / force_time
