"""Inner loop of the map-constrained inertial predictor and its correctors; SI and radians, no validation."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from railnav.attitude._kernels import multiply
from railnav.inertial._kernels import PREDICTOR_FIRST_ORDER, matrix_of, predictor_step, radii

#: Correctors: the source's rule; the same with the half-interval term; GNSS candidate always; arc length with fixed gains.
LITERAL, LITERAL_HALF, GNSS_ALWAYS, ARC = range(4)


@njit(cache=True)
def set_attitude(state, C, pitch, heading):  # (10,), (3, 3), rad
    """Write a level attitude (roll 0) of given pitch and heading."""
    sp, cp = math.sin(0.5 * pitch), math.cos(0.5 * pitch)
    sh, ch = math.sin(0.5 * heading), math.cos(0.5 * heading)
    q = multiply(ch, 0.0, 0.0, sh, cp, 0.0, sp, 0.0)
    for i in range(4):
        state[6 + i] = q[i]
    matrix_of(state, C)


@njit(cache=True)
def cartesian(state, field):  # (10,), (11,)
    """Earth-fixed coordinates of a state, rail (9)."""
    sine, cosine = math.sin(state[0]), math.cos(state[0])
    _, across = radii(sine, field)
    flat = (across + state[2]) * cosine
    return flat * math.cos(state[1]), flat * math.sin(state[1]), (across * (1.0 - field[1]) + state[2]) * sine


@njit(cache=True)
def tangent(points, i, closed):  # (m, 3), index
    """Unit tangent of the map at point i from its neighbours."""
    m = points.shape[0]
    if closed:
        a, b = (i - 1) % m, (i + 1) % m
    else:
        a, b = max(i - 1, 0), min(i + 1, m - 1)
    x, y, z = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
    n = math.sqrt(x * x + y * y + z * z)
    return x / n, y / n, z / n


@njit(cache=True)
def turned(latitude, longitude, x, y, z):  # rad, Earth-fixed
    """North, east and down components of an Earth-fixed vector."""
    sp, cp, sl, cl = math.sin(latitude), math.cos(latitude), math.sin(longitude), math.cos(longitude)
    return -sp * cl * x - sp * sl * y + cp * z, -sl * x + cl * y, -cp * cl * x - cp * sl * y - sp * z


@njit(cache=True)
def map_kernel(
    scheme,
    dtheta,
    dv,
    interval,
    field,
    row,
    gnss,
    points,
    place,
    azimuth,
    step,
    closed,
    window,
    policy,
    alpha,
    beta,
    out,
    chosen,
):
    # int, (n, 3) rad, (n, 3) m/s, (n,) s, (11,), (J,) samples after which to correct, (J, 3) m, map: (m, 3) m, (m, 3) rad rad m,
    # (m,) rad, m, flag, m; corrector, gains, (n + 1, 10), (J,): 1 where the INS candidate was taken
    """Predictor rail (1) to (8) with a correction to the map, rail (10) to (12) or by arc length, after given samples."""
    state = out[0].copy()
    C = np.empty((3, 3))
    matrix_of(state, C)
    before = state.copy()
    j, since = 0, 0.0
    m = points.shape[0]
    for k in range(interval.shape[0]):
        predictor_step(state, C, dtheta[k], dv[k], interval[k], field, scheme)
        since += interval[k]
        if j < row.shape[0] and row[j] == k:
            x, y, z = cartesian(state, field)
            best_u, best_c, at_u, at_c = 1e30, 1e30, -1, 0
            for s in range(m):
                d = (
                    (gnss[j, 0] - points[s, 0]) ** 2
                    + (gnss[j, 1] - points[s, 1]) ** 2
                    + (gnss[j, 2] - points[s, 2]) ** 2
                )
                if d < best_c:
                    best_c, at_c = d, s
                if d <= window * window:
                    e = (x - points[s, 0]) ** 2 + (y - points[s, 1]) ** 2 + (z - points[s, 2]) ** 2
                    if e < best_u:
                        best_u, at_u = e, s
            if at_u < 0:
                at_u = at_c
            if policy == ARC:
                ux, uy, uz = tangent(points, at_u, closed)
                foot_u = (x - points[at_u, 0]) * ux + (y - points[at_u, 1]) * uy + (z - points[at_u, 2]) * uz
                cx, cy, cz = tangent(points, at_c, closed)
                foot_c = (gnss[j, 0] - points[at_c, 0]) * cx
                foot_c += (gnss[j, 1] - points[at_c, 1]) * cy + (gnss[j, 2] - points[at_c, 2]) * cz
                apart = float(at_c - at_u)
                if closed and apart > 0.5 * m:
                    apart -= m
                elif closed and apart < -0.5 * m:
                    apart += m
                innovation = apart * step + foot_c - foot_u  # e = s_c - s_u
                tn, te, td = turned(state[0], state[1], ux, uy, uz)
                speed = state[3] * tn + state[4] * te + state[5] * td + beta * innovation / since
                where = (at_u * step + foot_u + alpha * innovation) / step
                a = int(math.floor(where))
                part = where - a
                if closed:
                    a %= m
                    b = (a + 1) % m
                else:
                    a = min(max(a, 0), m - 2)
                    part = min(max(where - a, 0.0), 1.0)
                    b = a + 1
                for i in range(3):
                    state[i] = (1.0 - part) * place[a, i] + part * place[b, i]
                ax, ay, az = tangent(points, a, closed)
                bx, by, bz = tangent(points, b, closed)
                ax, ay, az = (1.0 - part) * ax + part * bx, (1.0 - part) * ay + part * by, (1.0 - part) * az + part * bz
                norm = math.sqrt(ax * ax + ay * ay + az * az)
                tn, te, td = turned(state[0], state[1], ax / norm, ay / norm, az / norm)
                state[3], state[4], state[5] = speed * tn, speed * te, speed * td
                sign = 1.0 if speed >= 0.0 else -1.0
                set_attitude(state, C, math.asin(-sign * td), math.atan2(sign * te, sign * tn))
                chosen[j] = 0.0
            else:
                pick = at_c
                chosen[j] = 0.0
                if policy != GNSS_ALWAYS and best_u <= best_c:  # (10)
                    pick = at_u
                    chosen[j] = 1.0
                latitude, longitude, height = place[pick, 0], place[pick, 1], place[pick, 2]
                sine = math.sin(latitude)
                meridian, across = radii(sine, field)
                meridian += height
                across = (across + height) * math.cos(latitude)
                vn = (latitude - before[0]) / since * meridian  # (11)
                ve = (longitude - before[1]) / since * across
                vh = (height - before[2]) / since
                if policy == LITERAL_HALF:  # what the mean of the interval lags behind its end
                    vn += state[3] - (state[0] - before[0]) / since * meridian
                    ve += state[4] - (state[1] - before[1]) / since * across
                    vh += -state[5] - (state[2] - before[2]) / since
                heading = azimuth[pick]  # (12)
                if ve * math.sin(heading) + vn * math.cos(heading) < 0.0:
                    heading += math.pi
                speed = math.sqrt(vn * vn + ve * ve + vh * vh)
                pitch = math.asin(vh / speed) if speed > 1e-6 else 0.0
                state[0], state[1], state[2] = latitude, longitude, height
                state[3], state[4], state[5] = vn, ve, -vh
                set_attitude(state, C, pitch, heading)
            before[:] = state
            since = 0.0
            j += 1
        for i in range(10):
            out[k + 1, i] = state[i]
    return scheme == PREDICTOR_FIRST_ORDER
