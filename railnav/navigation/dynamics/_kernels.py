"""Square-root steps of the arc-length filter (specification 15, 19.2): prediction, scalar rows, a prior changed after the fact.

The transition is lower triangular in the order of `State`, so that a covariance root stays triangular under it and only the noise
columns are rotated in. Float64 arrays, SI, no validation.
"""

from __future__ import annotations

import math

from railnav.matching._kernels import add_column, inlined, part
from railnav.navigation.columns import (
    ACCELERATION,
    ACCELEROMETER_BIAS,
    GNSS_EAST,
    GYRO_BIAS,
    K_ACC_SIGMA,
    K_ACC_TIME,
    K_FORCE_NOISE,
    K_FORCE_WALK,
    K_GNSS_TIME,
    K_GYRO_WALK,
    K_MAP_LENGTH,
    K_ODOMETER_SLIP,
    K_ODOMETER_WALK,
    K_SIDE_WALK,
    K_SPEED_LATENCY,
    K_SPEED_TIME,
    K_TAG_WALK,
    KICK,
    MAP_CROSS,
    ODOMETER_SCALE,
    POSITION,
    ROW_GATE,
    SIDE_BIAS,
    SILENT_NOISE,
    SPEED,
    SPEED_ERROR,
    SPEED_LATENCY,
    TAG_MEMORY,
    TIME_TAG,
    WHEEL_DISTANCE,
)


@inlined
def timed(fil):
    """Whether a wheel or an accelerometer tells when fixes were taken: positions and their own speeds fit any shift of their stamps."""
    return fil.at[ACCELERATION] < 0 or fil.at[ODOMETER_SCALE] >= 0


@inlined
def first_moving(fil):
    """Index of the first state that changes at every step; those before it are errors of sensors and model."""
    return fil.at[ACCELERATION] if fil.at[ACCELERATION] >= 0 else fil.at[SPEED]


@inlined
def drift(fil, x, dt, step, tag, travel, F, Q, lead, new):
    """Fill in how errors of sensors and model change over some seconds: Gauss-Markov parts fade, biases walk. Gives the noise columns."""
    at = fil.at
    k = fil.settings
    n = x.shape[0]
    i_ge = at[GNSS_EAST]
    phi = math.exp(-dt / k[K_GNSS_TIME])
    F[i_ge, i_ge] = phi
    F[i_ge + 1, i_ge + 1] = phi
    new[i_ge] = phi * x[i_ge]
    new[i_ge + 1] = phi * x[i_ge + 1]
    i_m = at[MAP_CROSS]
    keep = 1.0
    if i_m >= 0:
        keep = math.exp(-travel / k[K_MAP_LENGTH])
        F[i_m, i_m] = keep
        new[i_m] = keep * x[i_m]
    i_e = at[SPEED_ERROR]
    fade = 1.0
    if i_e >= 0:
        fade = math.exp(-dt / k[K_SPEED_TIME])
        F[i_e, i_e] = fade
        new[i_e] = fade * x[i_e]
    c = 0
    i_t = at[TIME_TAG]
    if not timed(fil):  # nothing but the fixes tells the time: what the stamps jumped by is forgotten
        back = math.exp(-dt / TAG_MEMORY)
        F[i_t, i_t] = back
        new[i_t] = back * x[i_t]
        i_l = at[SPEED_LATENCY]
        if i_l >= 0:
            F[i_l, i_l] = back
            new[i_l] = back * x[i_l]
            for j in range(n):
                Q[c, j] = 0.0
            Q[c, i_l] = k[K_SPEED_LATENCY] * math.sqrt(1.0 - back * back)
            lead[c] = i_l
            c += 1
    for i in range(2):
        for j in range(n):
            Q[c, j] = 0.0
        Q[c, i_ge + i] = math.sqrt(1.0 - phi * phi + step)
        lead[c] = i_ge + i
        c += 1
    if i_m >= 0:
        for j in range(n):
            Q[c, j] = 0.0
        Q[c, i_m] = math.sqrt(1.0 - keep * keep)
        lead[c] = i_m
        c += 1
    for j in range(n):
        Q[c, j] = 0.0
    Q[c, i_t] = math.sqrt(k[K_TAG_WALK] ** 2 * dt + tag)
    lead[c] = i_t
    c += 1
    if i_e >= 0:
        for j in range(n):
            Q[c, j] = 0.0
        Q[c, i_e] = math.sqrt(1.0 - fade * fade)
        lead[c] = i_e
        c += 1
    root = math.sqrt(dt)
    for which in (ODOMETER_SCALE, GYRO_BIAS, SIDE_BIAS, ACCELEROMETER_BIAS):
        i = at[which]
        if i >= 0:
            if which == ODOMETER_SCALE:
                walk = k[K_ODOMETER_WALK]
            elif which == GYRO_BIAS:
                walk = k[K_GYRO_WALK]
            elif which == SIDE_BIAS:
                walk = k[K_SIDE_WALK]
            else:
                walk = k[K_FORCE_WALK]
            for j in range(n):
                Q[c, j] = 0.0
            Q[c, i] = walk * root
            lead[c] = i
            c += 1
    return c


@inlined
def transition(fil, x, dt, sign, force, rough, pull, slip, shake, step, tag, travel, stretch, slow, F, Q, lead, new):
    """Fill the transition matrix F (lower triangular), the noise columns Q with their first rows and the predicted state (19.2).

    `sign` is the direction in which an unsigned odometer counts, `pull` is g sin(grade), `rough` the
    sigma of the force; the variances slip, shake, step and tag
    forget the wheel distance, shake the speed, and let the GNSS error and its time stamps jump; over `travel` metres the model's error
    across changes, and `stretch` is the variance of what the model's length is wrong by there. Errors of sensors and model, which
    change slowly, do so for `slow` seconds in this step, 0 in most: place and speed do not depend on them between two fixes. F must be
    zero beside what is set here. Gives the number of noise columns.
    """
    # x (n,), F (n, n), Q (NOISES, n) one noise column a row, lead (NOISES,), new (n,)
    at = fil.at
    k = fil.settings
    n = x.shape[0]
    i_v, i_s = at[SPEED], at[POSITION]
    moving = first_moving(fil)
    for i in range(n):
        new[i] = x[i]
        if slow > 0.0 or i >= moving:
            for j in range(n):
                F[i, j] = 0.0
        F[i, i] = 1.0
    c = 0
    if slow > 0.0:
        c = drift(fil, x, slow, step, tag, travel, F, Q, lead, new)
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
    root = math.sqrt(dt)
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
        if accelerometer and rough == rough:
            q = math.sqrt(q * q + (rough * dt) ** 2)
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
    if stretch > 0.0:
        for j in range(n):
            Q[c, j] = 0.0
        Q[c, i_s] = math.sqrt(stretch)
        lead[c] = i_s
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


@inlined
def predict(x, P_sqrt, F, Q, lead, columns, new, begin):
    """Carry a state and its lower-triangular covariance root over one step: F is lower triangular, noise columns are rotated in.

    Before the state `begin` F is the unit matrix.
    """
    n = x.shape[0]
    for i in range(n - 1, begin - 1, -1):
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


@part
def widen(P_sqrt, index, sigma, column):  # (n, n), state index, its unit, (n,) scratch
    """Add to the variance of one state."""
    for j in range(column.shape[0]):
        column[j] = 0.0
    column[index] = sigma
    add_column(P_sqrt, column, index)


@inlined
def variance_of(P_sqrt, index):
    """Variance of one state."""
    p = 0.0
    for j in range(index + 1):
        p += P_sqrt[index, j] * P_sqrt[index, j]
    return p


@part
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


@inlined
def known_without(
    P_sqrt, f, index, h
):  # f = P_sqrt^T of a row, its entry h at `index` -> the square without that entry
    """What h P h^T would be if a row did not depend on one state."""
    s = 0.0
    for j in range(f.shape[0]):
        d = f[j] - h * P_sqrt[index, j] if j <= index else f[j]
        s += d * d
    return s


@part
def absorb(x, P_sqrt, f, innovation, variance, keep, move):
    """Let one scalar row in, given its projection f (Carlson's rotations, lower-triangular form)."""
    n = x.shape[0]
    s = variance
    for j in range(n - 1, -1, -1):
        if f[j] == 0.0:
            keep[j] = 1.0
            move[j] = 0.0
            continue
        grown = s + f[j] * f[j]
        inverse = 1.0 / math.sqrt(s * grown)
        keep[j] = s * inverse
        move[j] = f[j] * inverse
        s = grown
    gain = innovation / s
    for i in range(n):
        cross = 0.0
        for j in range(i, -1, -1):
            t = P_sqrt[i, j]
            P_sqrt[i, j] = keep[j] * t - move[j] * cross
            cross += t * f[j]
        x[i] += cross * gain


@part
def robust_row(x, P_sqrt, h, innovation, variance, f, keep, move):
    """Let one scalar row in; beyond the gate its variance grows until it fits, and its evidence saturates. Gives ln p."""
    return absorb_robustly(x, P_sqrt, f, project(P_sqrt, h, f), innovation, variance, keep, move)


@part
def absorb_robustly(x, P_sqrt, f, known, innovation, variance, keep, move):
    """As `robust_row`, the projection f and its square `known` given."""
    s = known + variance
    nis = innovation * innovation / s
    evidence = -0.5 * (min(nis, ROW_GATE) + math.log(s))
    if nis > ROW_GATE:
        variance += innovation * innovation / ROW_GATE - s
    absorb(x, P_sqrt, f, innovation, variance, keep, move)
    return evidence


@inlined
def stamps(fil, x, P_sqrt):  # -> shift of the stamps, its variance, age of the speed, its variance
    """What rows must not tell where nothing but the fixes tells the time."""
    i_t, i_l = fil.at[TIME_TAG], fil.at[SPEED_LATENCY]
    if i_l < 0:
        return x[i_t], variance_of(P_sqrt, i_t), 0.0, 0.0
    return x[i_t], variance_of(P_sqrt, i_t), x[i_l], variance_of(P_sqrt, i_l)


@part
def take_back(
    fil, x, P_sqrt, before, states, column
):  # before: from `stamps`; 1: the stamps, 2: the latency too; (n,) scratch
    """Take back what rows have told of stamps and latency, and keep what they told of the rest (consider states, Schmidt).

    With gain K, P+ = P - K S K^T; a state that is only considered has no gain of its own: its covariances with the others shrink as they
    would, its variance does not. That is the optimal update with K_i^2 S added to P_ii, and x_i as before. Estimated, both follow the
    noise of the very speeds and accelerations that they are multiplied by.
    """
    for m in range(states):
        i = fil.at[TIME_TAG] if m == 0 else fil.at[SPEED_LATENCY]
        if i >= 0:
            lost = before[2 * m + 1] - variance_of(P_sqrt, i)
            x[i] = before[2 * m]
            if lost > 0.0:
                widen(P_sqrt, i, math.sqrt(lost), column)


@part
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
