"""What receiver and wheel show of a train at rest, and what follows when it leaves. Float64 arrays, SI, no validation."""

from __future__ import annotations

import math

import numpy as np

from railnav.matching._kernels import BY_PATH, MOVED, SIGN, SLIP_SINCE, clone, credit, inlined, part
from railnav.navigation.columns import (
    ACCELERATION,
    C_DISTRUST,
    C_FIX_TIME,
    C_FORCE_REST,
    C_GNSS_SPEED,
    C_GNSS_SPEED_TIME,
    C_GNSS_STILL,
    C_LAST_FORCE,
    C_LAST_SIDE,
    C_LAST_YAW,
    C_REPEATED,
    C_RING,
    C_SIGMA_EAST,
    C_SIGMA_NORTH,
    C_SPEED_STALE,
    C_SUSPECTS,
    C_WHEEL_MOVED,
    C_WHEEL_SEEN,
    DISTANCE,
    EAST,
    FORCE,
    GNSS_SPEED,
    K_REVERSE,
    K_STILL_TIME,
    K_USABLE,
    KICK,
    LEAVING,
    PULLS,
    REPEATED,
    RING,
    S_SHAKE,
    SIDE,
    SIGMA_EAST,
    SIGMA_NORTH,
    SIGMA_SPEED,
    SPEED,
    TIME,
    W_COLUMN,
    WHEEL_SPEED,
    YAW_RATE,
)
from railnav.navigation.dynamics._kernels import variance_of, widen


@inlined
def watch(fil, shared, row):
    """Watch the receiver and the wheel: smoothed sigmas, repeated speeds, since when each is at rest."""
    common = shared.common
    time = row[TIME]
    if row[EAST] == row[EAST] and row[SIGMA_EAST] <= fil.settings[K_USABLE]:
        share = 1.0
        if common[C_SIGMA_EAST] > 0.0:
            share = 1.0 - math.exp(-max(time - common[C_FIX_TIME], 0.0) / 5.0)
        common[C_SIGMA_EAST] += share * (row[SIGMA_EAST] - common[C_SIGMA_EAST])
        common[C_SIGMA_NORTH] += share * (row[SIGMA_NORTH] - common[C_SIGMA_NORTH])
    common[C_SPEED_STALE] = 0.0
    speed = row[GNSS_SPEED]
    if speed == speed:
        if speed == common[C_GNSS_SPEED] and (speed > 0.01 or time < common[C_DISTRUST]):
            common[C_SPEED_STALE] = 1.0
        common[C_GNSS_SPEED] = speed
        common[C_GNSS_SPEED_TIME] = time
        resting = 0.3
        if row[SIGMA_SPEED] > 0.1:
            resting = min(3.0 * row[SIGMA_SPEED], 0.6)
        if speed > resting:
            common[C_GNSS_STILL] = np.inf
        elif common[C_GNSS_STILL] == np.inf:
            common[C_GNSS_STILL] = time
    if row[DISTANCE] == row[DISTANCE]:
        if row[DISTANCE] != shared.ring[(int(common[C_RING]) - 1) % RING, 1]:
            common[C_WHEEL_MOVED] = time
        common[C_WHEEL_SEEN] = time
    elif row[WHEEL_SPEED] == row[WHEEL_SPEED]:
        if abs(row[WHEEL_SPEED]) > 0.05:
            common[C_WHEEL_MOVED] = time
        common[C_WHEEL_SEEN] = time


@inlined
def remember(shared, row):
    """Keep the latest odometer reading."""
    if row[DISTANCE] == row[DISTANCE]:
        r = int(shared.common[C_RING])
        shared.ring[r, 0] = row[TIME]
        shared.ring[r, 1] = row[DISTANCE]
        shared.common[C_RING] = (r + 1) % RING


@inlined
def heaviest(bank):
    """Slot of the hypothesis with the greatest weight."""
    best = bank.live[1]
    for i in range(1, bank.live[0]):
        if bank.logw[bank.live[1 + i]] > bank.logw[best]:
            best = bank.live[1 + i]
    return best


@inlined
def hold_repeated(fil, shared, bank, row):
    """Take out of a moving train's epoch the inertial means that repeat the ones before to the last digit: a frozen or saturated axis."""
    common = shared.common
    moving = bank.live[0] > 0 and abs(bank.x[heaviest(bank), fil.at[SPEED]]) > 1.0
    for column, last in ((FORCE, C_LAST_FORCE), (SIDE, C_LAST_SIDE), (YAW_RATE, C_LAST_YAW)):
        value = row[column]
        if value == value:
            if moving and abs(value - common[last]) < REPEATED:
                row[column] = np.nan
                common[C_REPEATED] += 1.0
            common[last] = value


@inlined
def stands(fil, shared, bank, row):
    """Whether the train is found to stand: wheels at rest and no GNSS speed against it; without wheels, GNSS speed at rest.

    A train at rest leaves when its specific force changes: a slow GNSS must not make an accelerometer bias of it.
    """
    time = row[TIME]
    rest = fil.settings[K_STILL_TIME]
    common = shared.common
    best = heaviest(bank)
    i_v = fil.at[SPEED]
    if abs(bank.x[best, i_v]) > 0.5 + 3.0 * math.sqrt(variance_of(bank.P_sqrt[best], i_v)):
        return False
    spoken = common[C_GNSS_SPEED_TIME] > time - 2.5
    rolls = bank.info[best, SLIP_SINCE] == -np.inf  # a wheel that slides, or is dead, rests while the train runs
    if rolls and common[C_WHEEL_SEEN] > time - 1.0:
        if spoken and common[C_GNSS_SPEED] > 1.0:
            return False
        return time - common[C_WHEEL_MOVED] >= rest
    if not (spoken and common[C_SUSPECTS] == 0.0 and time > common[C_DISTRUST]):
        return False
    force = row[FORCE]
    if time - common[C_GNSS_STILL] < 3.0 * rest:
        common[C_FORCE_REST] = force
        return False
    if force == force:
        if abs(force - common[C_FORCE_REST]) > LEAVING:
            common[C_GNSS_STILL] = time
            return False
        common[C_FORCE_REST] += 0.05 * (force - common[C_FORCE_REST])
    return True


@part
def depart(fil, bank, work):
    """A train that stood leaves, and nothing tells which way: a clone of each hypothesis that has moved before goes back."""
    reverse = fil.settings[K_REVERSE]
    for i in range(bank.live[0]):
        h = bank.live[1 + i]
        if bank.tags[h, MOVED] == 1 and bank.live[0] < bank.used.shape[0]:
            g = clone(bank, h)
            bank.tags[g, SIGN] = -bank.tags[h, SIGN]
            credit(bank, g, BY_PATH, math.log(reverse))
            credit(bank, h, BY_PATH, math.log(1.0 - reverse))
            for j in range(PULLS):
                work.slot[g, j] = work.slot[h, j]


@part
def kick(fil, bank, work, row):
    """A train that stood leaves: its acceleration is anything a train can do, and its speed what the receiver may already say."""
    i_v, i_a = fil.at[SPEED], fil.at[ACCELERATION]
    sigma = 0.3 + (row[GNSS_SPEED] if row[GNSS_SPEED] == row[GNSS_SPEED] else 0.0)
    for i in range(bank.live[0]):
        h = bank.live[1 + i]
        widen(bank.P_sqrt[h], i_v, sigma, work.vector[W_COLUMN])
        if i_a >= 0:
            widen(bank.P_sqrt[h], i_a, KICK, work.vector[W_COLUMN])
        work.slot[h, S_SHAKE] += sigma * sigma
