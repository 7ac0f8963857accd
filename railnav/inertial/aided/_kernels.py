"""Inner loops of the aided strapdown: a square-root error filter of any of its menus, and its smoother; SI and radians, no validation.

The root of the covariance is kept transposed, U = P_sqrt^T (upper triangular), so that all inner loops run along rows. States stand in
the order parameters, attitude, velocity, position: then the transition times the root is triangular but for its last nine rows, and
parameters that do not change cost nothing. `at` (8,) holds the first column of each group of parameters or -1, by `GROUPS`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from railnav.attitude._kernels import exponential, multiply, rotate
from railnav.estimation._kernels import smooth_kernel
from railnav.inertial._kernels import POLAR_LATITUDE, coning_step, error_transition_kernel, radii
from railnav.inertial.aided.layout import (
    ANTENNA,
    AXLE,
    BODY,
    CLOCK,
    FIX,
    FORCE_BIAS,
    FORCE_SCALE,
    GYRO_BIAS,
    GYRO_SCALE,
    MOUNTING,
    ODOMETER,
    REST,
    TIME,
)

#: Length over which the acceleration that carries a fix to its sample is averaged, s.
ACCELERATION_TIME = 0.03


@njit(cache=True, error_model="numpy")
def reflect(B, i, low, high, t):  # (r, n) rows, pivot row, rows low to high - 1, (n,) scratch
    """Householder reflection of rows i and low..high-1 that leaves column i in row i alone, positive."""
    n = B.shape[1]
    below = 0.0
    for j in range(low, high):
        below += B[j, i] * B[j, i]
    alpha = B[i, i]
    if below == 0.0:
        if alpha < 0.0:
            for r in range(i, n):
                B[i, r] = -B[i, r]
        return
    norm = math.sqrt(alpha * alpha + below)
    v = alpha - norm if alpha <= 0.0 else -below / (alpha + norm)
    beta = 2.0 * v * v / (below + v * v)
    inverse = 1.0 / v
    for r in range(i + 1, n):
        t[r] = B[i, r]
    for j in range(low, high):
        w = B[j, i] * inverse
        B[j, i] = w
        for r in range(i + 1, n):
            t[r] += w * B[j, r]
    for r in range(i + 1, n):
        t[r] *= beta
        B[i, r] -= t[r]
    for j in range(low, high):
        w = B[j, i]
        B[j, i] = 0.0
        for r in range(i + 1, n):
            B[j, r] -= w * t[r]
    B[i, i] = norm


@njit(cache=True, error_model="numpy")
def carry_columns(B, rows, Phi_t, decay, clock, feed, h, triangular, y):
    # (r, n): rows 0..rows-1 are columns x, (n, 9), (n - 9,), column of the clock's drift or -1, first column that feeds, s, flag, (9,)
    """Columns x become Phi x; the last nine states are fed by columns from `feed` on."""
    n = B.shape[1]
    nine = n - 9
    for j in range(rows):
        for a in range(9):
            y[a] = 0.0
        first = feed
        if triangular and j > feed:
            first = j
        for c in range(first, n):
            x = B[j, c]
            if x != 0.0:
                for a in range(9):
                    y[a] += x * Phi_t[c, a]
        if clock >= 0:
            B[j, clock + 1] += h * B[j, clock]
        for c in range(feed, nine):
            B[j, c] *= decay[c]
        for a in range(9):
            B[j, nine + a] = y[a]


@njit(cache=True, error_model="numpy")
def predict_root(B, Phi_t, decay, clock, feed, h, driven, spread, t, y):
    # (n + q, n): U above, scratch below, (n, 9), (n - 9,), int, int, s, (q,) columns of the noisy states, increasing, (q,) densities
    """U of P becomes U of Phi P Phi^T + Q; Q is diagonal."""
    n = B.shape[1]
    nine = n - 9
    q = driven.shape[0]
    carry_columns(B, n, Phi_t, decay, clock, feed, h, True, y)
    root = math.sqrt(h)
    for k in range(q):
        for r in range(n):
            B[n + k, r] = 0.0
        B[n + k, driven[k]] = spread[k] * root
    active = 0
    for i in range(nine):
        while active < q and driven[active] <= i:
            active += 1
        if active > 0:
            reflect(B, i, n, n + active, t)
    for i in range(nine, n):
        reflect(B, i, i + 1, n + q, t)


@njit(cache=True, error_model="numpy")
def row_variance(
    U, H, places, count, variance, f
):  # (n, n), (n,) with `count` places that are not zero, -, f (n,) out: U h
    """Variance of the innovation of one row; f = U h on the way."""
    s = variance
    n = f.shape[0]
    for j in range(n):
        total = 0.0
        for c in range(count):
            p = places[c]
            if p >= j:
                total += U[j, p] * H[p]
        f[j] = total
        s += total * total
    return s


@njit(cache=True, error_model="numpy")
def let_in(U, x, f, innovation, variance, cross):  # (n, n), (n,), (n,) U h, -, -, (n,) scratch
    """Let one scalar row in (Carlson's rotations)."""
    n = f.shape[0]
    for i in range(n):
        cross[i] = 0.0
    s = variance
    for j in range(n - 1, -1, -1):
        fj = f[j]
        grown = s + fj * fj
        keep = math.sqrt(s / grown)
        move = fj / math.sqrt(s * grown)
        s = grown
        for i in range(j, n):
            u = U[j, i]
            U[j, i] = keep * u - move * cross[i]
            cross[i] += u * fj
    gain = innovation / s
    for i in range(n):
        x[i] += cross[i] * gain


@njit(cache=True, error_model="numpy")
def fill_transition(Phi15, at, nine, turn, push, C, h, Phi_t):
    # (15, 15) of `error_transition_kernel`, (10,), n - 9, (3,) rad, (3,) m/s corrected increments, (3, 3), s, (n, 9) out
    """Transition of the last nine states in the filter's order, by column."""
    order = (6, 7, 8, 3, 4, 5, 0, 1, 2)
    for a in range(9):
        for c in range(9):
            Phi_t[nine + c, a] = Phi15[order[a], order[c]]
    bias, force = at[GYRO_BIAS], at[FORCE_BIAS]
    for j in range(3):
        for a in range(3):
            Phi_t[bias + j, a] = -C[a, j] * h
            Phi_t[force + j, 3 + a] = C[a, j] * h
    if at[GYRO_SCALE] >= 0:
        s = at[GYRO_SCALE]
        for j in range(3):
            for a in range(3):
                Phi_t[s + j, a] = -C[a, j] * turn[j]
    if at[FORCE_SCALE] >= 0:
        s = at[FORCE_SCALE]
        for j in range(3):
            for a in range(3):
                Phi_t[s + j, 3 + a] = C[a, j] * push[j]


@njit(cache=True, error_model="numpy")
def corrected(state, parameter, x, nine, after, value):  # (10,), (nine,), (n,), int, (10,) out, (nine,) out
    """Estimate less its error: p - dp, v - dv, exp(eps) C; parameters + theirs."""
    for i in range(nine):
        value[i] = parameter[i] + x[i]
    for i in range(3):
        after[i] = state[i] - x[nine + 6 + i]
        after[3 + i] = state[3 + i] - x[nine + 3 + i]
    e0, e1, e2, e3 = exponential(x[nine], x[nine + 1], x[nine + 2])
    q0, q1, q2, q3 = multiply(e0, e1, e2, e3, state[6], state[7], state[8], state[9])
    after[6], after[7], after[8], after[9] = q0, q1, q2, q3


@njit(cache=True, error_model="numpy")
def matrix(state, C):  # (10,), (3, 3) out
    """C_nb of a state."""
    w, x, y, z = state[6], state[7], state[8], state[9]
    C[0, 0], C[0, 1], C[0, 2] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    C[1, 0], C[1, 1], C[1, 2] = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
    C[2, 0], C[2, 1], C[2, 2] = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)


@njit(cache=True, error_model="numpy")
def innovations(kind, data, age, state, parameter, at, nine, nominal, turn, h, acceleration, field, C, z, H):
    # kind, (8,), s, (10,), (nine,), (10,), int, (8,) nominal arms and mounting, (3,) rad, s, (3,) m/s^2, (11,), (3, 3), (6,), (6, n)
    """Predicted - measured of one measurement, and its rows by the errors."""
    for r in range(6):
        for i in range(H.shape[1]):
            H[r, i] = 0.0
        z[r] = 0.0
    matrix(state, C)
    att, vel, pos = nine, nine + 3, nine + 6
    bg = at[GYRO_BIAS]
    wx, wy, wz = turn[0] / h, turn[1] / h, turn[2] / h
    if kind == FIX:
        sine = math.sin(state[0])
        meridian, across = radii(sine, field)
        north, east = meridian + state[2], (across + state[2]) * math.cos(state[0])
        lx, ly, lz = nominal[0], nominal[1], nominal[2]
        late = -age
        if at[ANTENNA] >= 0:
            g = at[ANTENNA]
            lx, ly, lz = lx + parameter[g], ly + parameter[g + 1], lz + parameter[g + 2]
        if at[TIME] >= 0:
            late += parameter[at[TIME]]
        ln = C[0, 0] * lx + C[0, 1] * ly + C[0, 2] * lz
        le = C[1, 0] * lx + C[1, 1] * ly + C[1, 2] * lz
        ld = C[2, 0] * lx + C[2, 1] * ly + C[2, 2] * lz
        sx, sy, sz = wy * lz - wz * ly, wz * lx - wx * lz, wx * ly - wy * lx  # of the antenna against the IMU, KZ(2.19)
        sn = C[0, 0] * sx + C[0, 1] * sy + C[0, 2] * sz
        se = C[1, 0] * sx + C[1, 1] * sy + C[1, 2] * sz
        sd = C[2, 0] * sx + C[2, 1] * sy + C[2, 2] * sz
        vn, ve, vd = state[3] + sn, state[4] + se, state[5] + sd
        # KZ(2.18); the estimate carried to the instant of the fix
        z[0] = (state[0] - data[0]) * north + ln + vn * late
        z[1] = (state[1] - data[1]) * east + le + ve * late
        z[2] = (state[2] - data[2]) - ld - vd * late
        z[3] = vn + acceleration[0] * late - data[3]
        z[4] = ve + acceleration[1] * late - data[4]
        z[5] = vd + acceleration[2] * late - data[5]
        H[0, pos], H[1, pos + 1], H[2, pos + 2] = north, east, 1.0
        H[0, att + 1], H[0, att + 2] = -ld, le
        H[1, att], H[1, att + 2] = ld, -ln
        H[2, att], H[2, att + 1] = le, -ln
        H[3, vel], H[4, vel + 1], H[5, vel + 2] = 1.0, 1.0, 1.0
        H[3, att + 1], H[3, att + 2] = -sd, se
        H[4, att], H[4, att + 2] = sd, -sn
        H[5, att], H[5, att + 1] = -se, sn
        for a in range(3):  # estimated rate - true rate = bg: C (bg x l)
            H[3 + a, bg] = C[a, 2] * ly - C[a, 1] * lz
            H[3 + a, bg + 1] = C[a, 0] * lz - C[a, 2] * lx
            H[3 + a, bg + 2] = C[a, 1] * lx - C[a, 0] * ly
        if at[ANTENNA] >= 0:
            g = at[ANTENNA]
            for j in range(3):
                H[0, g + j], H[1, g + j], H[2, g + j] = -C[0, j], -C[1, j], C[2, j]
            for a in range(3):  # -C [w x]
                H[3 + a, g] = -(C[a, 1] * wz - C[a, 2] * wy)
                H[3 + a, g + 1] = -(C[a, 2] * wx - C[a, 0] * wz)
                H[3 + a, g + 2] = -(C[a, 0] * wy - C[a, 1] * wx)
        for i in range(H.shape[1]):  # the way between fix and sample
            H[0, i] += late * H[3, i]
            H[1, i] += late * H[4, i]
            H[2, i] -= late * H[5, i]
        if at[TIME] >= 0:
            g = at[TIME]
            H[0, g], H[1, g], H[2, g] = -vn, -ve, vd
            H[3, g], H[4, g], H[5, g] = -acceleration[0], -acceleration[1], -acceleration[2]
    elif kind == BODY:
        lx, ly, lz = nominal[3], nominal[4], nominal[5]
        mp, my = nominal[6], nominal[7]
        scale = 1.0
        if at[AXLE] >= 0:
            g = at[AXLE]
            lx, ly, lz = lx + parameter[g], ly + parameter[g + 1], lz + parameter[g + 2]
        if at[MOUNTING] >= 0:
            g = at[MOUNTING]
            mp, my = mp + parameter[g], my + parameter[g + 1]
        if at[ODOMETER] >= 0:
            scale += parameter[at[ODOMETER]]
        vn, ve, vd = state[3], state[4], state[5]
        ux = C[0, 0] * vn + C[1, 0] * ve + C[2, 0] * vd + wy * lz - wz * ly
        uy = C[0, 1] * vn + C[1, 1] * ve + C[2, 1] * vd + wz * lx - wx * lz
        uz = C[0, 2] * vn + C[1, 2] * ve + C[2, 2] * vd + wx * ly - wy * lx
        e0, e1, e2, e3 = exponential(0.0, mp, my)  # body axes into the vehicle's
        ux, uy, uz = rotate(e0, e1, e2, e3, ux, uy, uz)
        z[0], z[1], z[2] = scale * ux - data[0], uy, uz
        # columns of M C^T and of M
        for a in range(3):
            x0, x1, x2 = rotate(e0, e1, e2, e3, C[a, 0], C[a, 1], C[a, 2])
            H[0, vel + a], H[1, vel + a], H[2, vel + a] = x0, x1, x2
        for r in range(3):  # -M C^T [v x]
            b0, b1, b2 = H[r, vel], H[r, vel + 1], H[r, vel + 2]
            H[r, att] = -(b1 * vd - b2 * ve)
            H[r, att + 1] = -(b2 * vn - b0 * vd)
            H[r, att + 2] = -(b0 * ve - b1 * vn)
        for j in range(3):
            m0, m1, m2 = rotate(e0, e1, e2, e3, 1.0 if j == 0 else 0.0, 1.0 if j == 1 else 0.0, 1.0 if j == 2 else 0.0)
            for r in range(3):
                m = m0 if r == 0 else (m1 if r == 1 else m2)
                # -M [l x] for the gyro bias, -M [w x] for the arm, column by column
                if j == 0:
                    H[r, bg + 1] -= m * (-lz)
                    H[r, bg + 2] -= m * ly
                elif j == 1:
                    H[r, bg] -= m * lz
                    H[r, bg + 2] -= m * (-lx)
                else:
                    H[r, bg] -= m * (-ly)
                    H[r, bg + 1] -= m * lx
                if at[AXLE] >= 0:
                    g = at[AXLE]
                    if j == 0:
                        H[r, g + 1] -= m * (-wz)
                        H[r, g + 2] -= m * wy
                    elif j == 1:
                        H[r, g] -= m * wz
                        H[r, g + 2] -= m * (-wx)
                    else:
                        H[r, g] -= m * (-wy)
                        H[r, g + 1] -= m * wx
        if scale != 1.0:
            for i in range(H.shape[1]):
                H[0, i] *= scale
        if at[MOUNTING] >= 0:  # [u x] for turns about y and z
            g = at[MOUNTING]
            H[0, g], H[0, g + 1] = -uz * scale, uy * scale
            H[1, g + 1] = -ux
            H[2, g] = ux
        if at[ODOMETER] >= 0:
            H[0, at[ODOMETER]] = -ux
    elif kind == REST:
        for a in range(3):
            z[a] = state[3 + a]
            H[a, vel + a] = 1.0
        # mean rate as measured less its bias is the Earth's
        en, ed = field[10] * math.cos(state[0]), -field[10] * math.sin(state[0])
        for a in range(3):
            z[3 + a] = data[a] - parameter[bg + a] - (C[0, a] * en + C[2, a] * ed)
            H[3 + a, bg + a] = 1.0
            # C^T w by the attitude: -C^T [w x]; z holds its negative
            H[3 + a, att] = C[1, a] * ed
            H[3 + a, att + 1] = C[2, a] * en - C[0, a] * ed
            H[3 + a, att + 2] = -C[1, a] * en
    else:  # a pseudorange and its rate; data: position and velocity of the satellite, range, rate
        sl, cl = math.sin(state[0]), math.cos(state[0])
        so, co = math.sin(state[1]), math.cos(state[1])
        meridian, across = radii(sl, field)
        e2 = field[1]
        lx, ly, lz = nominal[0], nominal[1], nominal[2]
        ln = C[0, 0] * lx + C[0, 1] * ly + C[0, 2] * lz
        le = C[1, 0] * lx + C[1, 1] * ly + C[1, 2] * lz
        ld = C[2, 0] * lx + C[2, 1] * ly + C[2, 2] * lz
        sx, sy, sz = wy * lz - wz * ly, wz * lx - wx * lz, wx * ly - wy * lx
        sn = C[0, 0] * sx + C[0, 1] * sy + C[0, 2] * sz
        se = C[1, 0] * sx + C[1, 1] * sy + C[1, 2] * sz
        sd = C[2, 0] * sx + C[2, 1] * sy + C[2, 2] * sz
        vn, ve, vd = state[3] + sn, state[4] + se, state[5] + sd
        # antenna in Earth axes at the instant of the measurement; rows of C_en: north, east, down
        ln, le, ld = ln - vn * age, le - ve * age, ld - vd * age
        x = (across + state[2]) * cl * co - sl * co * ln - so * le - cl * co * ld
        y = (across + state[2]) * cl * so - sl * so * ln + co * le - cl * so * ld
        w = (across * (1.0 - e2) + state[2]) * sl + cl * ln - sl * ld
        dx, dy, dz = x - data[0], y - data[1], w - data[2]
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        dx, dy, dz = dx / distance, dy / distance, dz / distance
        un = -sl * co * dx - sl * so * dy + cl * dz
        ue = -so * dx + co * dy
        ud = -cl * co * dx - cl * so * dy - sl * dz
        g = at[CLOCK]
        z[0] = distance + parameter[g + 1] - data[6]
        z[1] = un * vn + ue * ve + ud * vd - (dx * data[3] + dy * data[4] + dz * data[5]) + parameter[g] - data[7]
        H[0, pos], H[0, pos + 1] = un * (meridian + state[2]), ue * (across + state[2]) * cl
        H[0, pos + 2] = -ud
        H[0, att], H[0, att + 1], H[0, att + 2] = ue * ld - ud * le, ud * ln - un * ld, un * le - ue * ln
        H[0, g + 1] = -1.0
        H[1, vel], H[1, vel + 1], H[1, vel + 2] = un, ue, ud
        H[1, att], H[1, att + 1], H[1, att + 2] = ue * sd - ud * se, ud * sn - un * sd, un * se - ue * sn
        for a in range(3):
            u = un if a == 0 else (ue if a == 1 else ud)
            H[1, bg] += u * (C[a, 2] * ly - C[a, 1] * lz)
            H[1, bg + 1] += u * (C[a, 0] * lz - C[a, 2] * lx)
            H[1, bg + 2] += u * (C[a, 1] * lx - C[a, 0] * ly)
        H[1, g] = -1.0


@njit(cache=True, error_model="numpy")
def aided_kernel(
    dtheta,
    dv,
    interval,
    field,
    at,
    U,
    decay_rate,
    driven,
    spread,
    nominal,
    kind,
    row,
    age,
    data,
    variance,
    gate,
    closed,
    out,
    parameter,
    sigma,
    slant,
    nis,
    used,
    node,
    node_state,
    node_parameter,
    node_U,
    node_Phi,
    node_Q,
    node_x,
):
    # (n, 3) rad, (n, 3) m/s, (n,) s, (11,), (10,), (N, N), (N - 9,) 1/s, (q,) columns, (q,) densities, (8,);
    # measurements (m,) kind, sample after which, age s, (m, 8), (m, 8); out (n + 1, 10), (n + 1, N - 9), (n + 1, N), covariance of
    # latitude and longitude (n + 1,), (m, 6), (m, 6);
    # nodes: (K,) samples to keep or (0,), (K + 1, ...) each: state, parameters, U filtered, Phi^T and root of Q since the last, correction
    """Strapdown with a square-root error filter of any measurements; n, or the sample near a pole where it stopped."""
    N = U.shape[0]
    nine = N - 9
    q = driven.shape[0]
    state, value = out[0].copy(), parameter[0].copy()
    shown, shown_value = np.empty(10), np.empty(nine)
    memory = np.zeros(13)
    B = np.zeros((N + q, N))
    B[:N] = U
    Phi15, Phi_t, C = np.empty((15, 15)), np.zeros((N, 9)), np.empty((3, 3))
    x, f, t, cross, y = np.zeros(N), np.empty(N), np.empty(N), np.empty(N), np.empty(9)
    decay = np.ones(nine)
    z, H = np.empty(6), np.empty((6, N))
    places = np.empty(N, np.int64)
    turn, push, force_n, acceleration = np.empty(3), np.empty(3), np.empty(3), np.zeros(3)
    bg, ba, sg, sa, clock = at[GYRO_BIAS], at[FORCE_BIAS], at[GYRO_SCALE], at[FORCE_SCALE], at[CLOCK]
    feed = bg
    if sa >= 0:
        feed = sa
    if sg >= 0:
        feed = sg
    keep = node.shape[0] > 0
    A, D, xx = np.eye(N), np.zeros((N + q, N)), np.zeros((1, N))
    if keep:
        node_state[0], node_parameter[0], node_U[0] = state, value, U
    next_node, following, last = 0, 0, -1.0
    for k in range(interval.shape[0]):
        h = interval[k]
        for i in range(3):
            turn[i] = dtheta[k, i] - value[bg + i] * h
            push[i] = dv[k, i] - value[ba + i] * h
            if sg >= 0:
                turn[i] /= 1.0 + value[sg + i]
            if sa >= 0:
                push[i] /= 1.0 + value[sa + i]
        q0, q1, q2, q3 = state[6], state[7], state[8], state[9]
        force_n[0], force_n[1], force_n[2] = rotate(q0, q1, q2, q3, push[0] / h, push[1] / h, push[2] / h)
        error_transition_kernel(state, force_n, h, field, 1.0, 1.0, Phi15)
        matrix(state, C)
        fill_transition(Phi15, at, nine, turn, push, C, h, Phi_t)
        if h != last:
            last = h
            for i in range(nine):
                decay[i] = 1.0 - h * decay_rate[i]
        predict_root(B, Phi_t, decay, clock, feed, h, driven, spread, t, y)
        if keep:
            carry_columns(A, N, Phi_t, decay, clock, feed, h, False, y)
            predict_root(D, Phi_t, decay, clock, feed, h, driven, spread, t, y)
        if not closed:
            xx[0] = x
            carry_columns(xx, 1, Phi_t, decay, clock, feed, h, False, y)
            x[:] = xx[0]
        vn, ve, vd = state[3], state[4], state[5]
        coning_step(state, memory, turn, push, h, field)
        weight = h / (ACCELERATION_TIME + h)
        acceleration[0] += weight * ((state[3] - vn) / h - acceleration[0])
        acceleration[1] += weight * ((state[4] - ve) / h - acceleration[1])
        acceleration[2] += weight * ((state[5] - vd) / h - acceleration[2])
        for i in range(nine):
            value[i] *= decay[i]
        if clock >= 0:
            value[clock + 1] += h * value[clock]
        if not abs(state[0]) < POLAR_LATITUDE:
            return k
        touched = False
        while following < row.shape[0] and row[following] == k:
            m = following
            following += 1
            touched = True
            innovations(
                kind[m],
                data[m],
                age[m],
                state,
                value,
                at,
                nine,
                nominal,
                turn,
                h,
                acceleration,
                field,
                C,
                z,
                H,
            )
            for r in range(6):
                if not variance[m, r] > 0.0:
                    continue
                count = 0
                innovation = z[r]
                for i in range(N):
                    if H[r, i] != 0.0:
                        places[count] = i
                        count += 1
                        innovation -= H[r, i] * x[i]
                s = row_variance(B, H[r], places, count, variance[m, r], f)
                nis[m, r] = innovation * innovation / s
                used[m, r] = nis[m, r] <= gate[kind[m]]
                if used[m, r]:
                    let_in(B, x, f, innovation, variance[m, r], cross)
        if touched and closed:
            corrected(state, value, x, nine, shown, shown_value)
            state[:] = shown
            value[:] = shown_value
        if closed:
            out[k + 1], parameter[k + 1] = state, value
        else:
            corrected(state, value, x, nine, shown, shown_value)
            out[k + 1], parameter[k + 1] = shown, shown_value
        if keep and next_node < node.shape[0] and node[next_node] == k:
            next_node += 1
            node_state[next_node], node_parameter[next_node] = state, value
            for i in range(N):
                node_x[next_node, i] = x[i] if touched else 0.0
                for j in range(N):
                    node_U[next_node, i, j] = B[i, j]
                    node_Phi[next_node, i, j] = A[i, j]
                    node_Q[next_node, i, j] = D[i, j]
                    A[i, j] = 1.0 if i == j else 0.0
                    D[i, j] = 0.0
        if closed and touched:
            for i in range(N):
                x[i] = 0.0
        for i in range(N):
            f[i] = 0.0
        for j in range(N):
            for i in range(j, N):
                f[i] += B[j, i] * B[j, i]
        for i in range(N):
            sigma[k + 1, i] = math.sqrt(f[i])
        both = 0.0
        for j in range(N - 1):
            both += B[j, N - 3] * B[j, N - 2]
        slant[k + 1] = both
    U[:] = B[:N]
    return interval.shape[0]


@njit(cache=True)
def smooth_nodes_kernel(node_U, node_Phi, node_Q, node_x, error, P_sqrt):
    # (K + 1, N, N) each, transposed roots and transitions; (K + 1, N); out: error (K + 1, N) of the filtered estimate, (K + 1, N, N)
    """Rauch-Tung-Striebel in square roots over the nodes of the error filter."""
    last = node_U.shape[0] - 1
    N = node_U.shape[1]
    gain = np.empty((N, N))
    zero = np.zeros(N)
    P_sqrt[last] = node_U[last].T
    error[last] = 0.0
    for k in range(last - 1, -1, -1):
        P_sqrt[k] = node_U[k].T
        error[k] = 0.0
        F = np.ascontiguousarray(node_Phi[k + 1].T)
        Q = np.ascontiguousarray(node_Q[k + 1].T)
        smooth_kernel(error[k], P_sqrt[k], F, Q, zero, node_x[k + 1] + error[k + 1], P_sqrt[k + 1], gain)
