"""Inner loop of the navigator: all hypotheses, one epoch after the other. Float64 arrays, SI, radians, no validation.

Kernels of `railnav.matching`, `.dynamics`, `.measurements` and `.integrity` are compiled in. Numba's cache watches this file only; a
checksum of the others, which the loop carries as a constant, makes it compile anew when one of them has changed.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from railnav import units
from railnav.matching import _kernels as paths
from railnav.matching._kernels import (
    BELIEVED,
    BY_COURSE,
    BY_ODOMETER,
    BY_PATH,
    BY_POSITION,
    COUNT,
    CURRENT,
    FRAMED,
    INTO,
    MOVED,
    P_CURVATURE,
    P_D_EAST,
    P_D_NORTH,
    P_EAST,
    P_GRADIENT,
    P_NORTH,
    P_SIGMA_CROSS,
    POINT_SIZE,
    RECORD,
    TRAVELLED,
    VERSION,
    clone,
    credit,
    drop,
    drop_all,
    entering_end,
    follow,
    inlined,
    leaving_end,
    merge_all,
    normalise,
    part,
    path_index,
    path_point,
    path_shape,
    source_stamp,
)
from railnav.navigation import columns, state
from railnav.navigation.columns import (
    ACCELEROMETER_BIAS,
    BALISE_OFFSET,
    BALISE_REACH,
    BALISE_TRACK,
    BLIND_LENGTH,
    BRIDGED,
    C_ALONG,
    C_ALONG_SIGMA,
    C_ALONG_TIME,
    C_BALISE_TIME,
    C_BALISES,
    C_DISTRUST,
    C_FIX_TIME,
    C_FIXES,
    C_FRAME_SIGMA,
    C_FRAME_TIME,
    C_FRESH,
    C_FROZEN,
    C_GNSS_SPEED,
    C_GNSS_SPEED_TIME,
    C_GYRO_FAULTS,
    C_JUMPS,
    C_LAST_EAST,
    C_LAST_NORTH,
    C_NOTHING_NEAR,
    C_OUT_MODE,
    C_RING,
    C_RIVAL_TIME,
    C_SCALE,
    C_SCALE_SUM,
    C_SCALE_WEIGHT,
    C_SIGMA_EAST,
    C_SIGMA_NORTH,
    C_SLOW_TIME,
    C_START_TIME,
    C_STEPS,
    C_STOOD,
    C_STRANGE_BALISES,
    C_SUSPECT_FIXES,
    C_SUSPECT_SINCE,
    C_SUSPECTS,
    C_TIME,
    C_TRY,
    C_YAW_DISTRUST,
    C_YAW_MISFIT,
    COAST_LONGEST,
    CONTRADICTS,
    CONTRADICTS_SHARE,
    COURSE_MOST,
    COURSE_TELLS,
    DISTANCE,
    DISTRUST,
    DONE,
    DOUBTED,
    EAST,
    ESTABLISHED,
    FORCE,
    GNSS_EAST,
    GNSS_SPEED,
    GYRO_BIAS,
    HELD,
    K_CORRELATED,
    K_FRAME,
    K_FRAME_LEAST,
    K_FRAME_MOST,
    K_GATE,
    K_GNSS_TIME,
    K_GRAVITY,
    K_GYRO_BIAS,
    K_LOST_AFTER,
    K_LOST_SIGMA,
    K_MAP_LENGTH,
    K_MERGE,
    K_MODEL,
    K_MOST,
    K_ODOMETER_SIGMA,
    K_POSITION_DOUBT,
    K_PRUNE,
    K_REVERSE,
    K_SCALE_LEAST,
    K_SCALE_MOST,
    K_SCALE_PRIOR,
    K_SCALE_START,
    K_STEP_FIXES,
    K_TAG_MOST,
    K_USABLE,
    NEEDS_BALISE,
    NEEDS_RIVALS,
    NEEDS_ROOM,
    NEEDS_START,
    NORTH,
    ODOMETER_SCALE,
    OUT_MODE,
    POSITION,
    PULLS,
    R_EPOCH,
    R_LOGW,
    R_PARENT,
    R_PULL,
    R_VERSION,
    RING,
    RIVAL_INTERVAL,
    ROW_GATE,
    S_COURSE,
    S_NIS,
    S_PULL,
    S_SAID,
    S_SHAKE,
    S_SIGN,
    S_SLIP,
    S_SLOW,
    S_STEP,
    S_STRETCH,
    S_TAG,
    S_TRAVEL,
    S_YAW,
    SIGMA_EAST,
    SIGMA_FORCE,
    SIGMA_NORTH,
    SLOW_STEP,
    SPEED,
    SPEED_LATENCY,
    START_GATE,
    START_PROBATION,
    STEP_MOST,
    TIME,
    TIME_TAG,
    UNSEEN_SLIP,
    W_BEFORE,
    W_COLUMN,
    W_F,
    W_H,
    W_KEEP,
    W_MOVE,
    W_NEW,
    WHEEL_DISTANCE,
    YAW_DISTRUST,
    YAW_MISFIT,
    YAW_SPAN,
)
from railnav.navigation.decision import _kernels as decision
from railnav.navigation.decision._kernels import keep_journal, put_out
from railnav.navigation.dynamics import _kernels as dynamics
from railnav.navigation.dynamics._kernels import (
    absorb,
    first_moving,
    predict,
    project,
    reweigh_frame,
    robust_row,
    stamps,
    take_back,
    timed,
    transition,
    variance_of,
    widen,
)
from railnav.navigation.integrity import _kernels as integrity
from railnav.navigation.integrity._kernels import keep_check, note_turn, stray, watch_misfit, weigh_positions
from railnav.navigation.measurements import _kernels as measurements
from railnav.navigation.measurements._kernels import (
    balise_place,
    direction,
    gravity_pull,
    motion_rows,
    position_row,
    wheel_row,
)
from railnav.navigation.shape import EXACT
from railnav.navigation.standing import _kernels as standing
from railnav.navigation.standing._kernels import depart, heaviest, hold_repeated, kick, remember, stands, watch

# ---------------------------------------------------------------- what all hypotheses share


@inlined
def adapt(fil, shared, bank, work, time, dt):
    """Learn the scale of the receiver's sigmas, and let the constant part's prior follow what is seen of it.

    The estimate follows it; the evidence of positions rests on what was known beforehand.
    """
    k = fil.settings
    common = shared.common
    i_g = fil.at[GNSS_EAST]
    square = 0.0
    frame = 0.0
    for i in range(bank.live[0]):
        h = bank.live[1 + i]
        x, L = bank.x[h], bank.P_sqrt[h]
        te, tn = work.point[h, P_D_EAST], work.point[h, P_D_NORTH]
        # expected square of the error across the track, in units of its prior: the first four rows of the root hold it
        value = (tn * x[i_g] - te * x[i_g + 1]) ** 2
        for j in range(i_g + 2):
            value += (tn * L[i_g, j] - te * L[i_g + 1, j]) ** 2
        square += shared.weight[h] * min(value / (te * te + tn * tn), 9.0)
        frame += shared.weight[h] * (x[0] * x[0] + x[1] * x[1] + variance_of(L, 0) + variance_of(L, 1))
    fade = math.exp(-dt / 3600.0)
    part = min(0.5 * dt / k[K_GNSS_TIME], 1.0)
    common[C_SCALE_SUM] = fade * common[C_SCALE_SUM] + part * square * common[C_SCALE] ** 2
    common[C_SCALE_WEIGHT] = fade * common[C_SCALE_WEIGHT] + part
    prior = k[K_SCALE_PRIOR]
    scale = math.sqrt((prior * k[K_SCALE_START] ** 2 + common[C_SCALE_SUM]) / (prior + common[C_SCALE_WEIGHT]))
    common[C_SCALE] = min(max(scale, k[K_SCALE_LEAST] * k[K_SCALE_START]), k[K_SCALE_MOST])
    if time - common[C_FRAME_TIME] < 60.0:
        return
    # once a minute: sigma of the constant part by expectation-maximisation
    common[C_FRAME_TIME] = time
    old = common[C_FRAME_SIGMA]
    stated = math.hypot(0.5 * k[K_FRAME] * (common[C_SIGMA_EAST] + common[C_SIGMA_NORTH]), k[K_MODEL])
    least = min(max(stated, k[K_FRAME_LEAST]), k[K_FRAME_MOST])
    new = min(max(math.sqrt(0.5 * frame), old / 1.5, least), 1.5 * old, k[K_FRAME_MOST])
    if abs(new / old - 1.0) > 0.2:
        for i in range(bank.live[0]):
            h = bank.live[1 + i]
            reweigh_frame(
                bank.x[h],
                bank.P_sqrt[h],
                old,
                new,
                work.vector[W_F],
                work.vector[W_COLUMN],
                work.vector[W_KEEP],
                work.vector[W_MOVE],
            )
        common[C_FRAME_SIGMA] = new


# ---------------------------------------------------------------- the steps of one epoch


@inlined
def stretch_variance(fil, point, travel):
    """Variance of what the model's length is wrong by over some metres.

    An axis that is off by y across in curvature kappa is longer by kappa y a metre; where it is known by smoothness alone its bearing
    is wrong, too, which makes it longer by half the square of that. Both last over the length that the error across lasts. A bridge is
    held at its ends: along it the error is well below its largest on average.
    """
    sigma = point[P_SIGMA_CROSS]
    if sigma <= 0.0:
        return 0.0
    tilt = 0.5 * sigma / BLIND_LENGTH
    rate = HELD * abs(point[P_CURVATURE]) * sigma + 0.5 * tilt * tilt
    length = BLIND_LENGTH if sigma > BRIDGED * fil.map_sigma else fil.settings[K_MAP_LENGTH]
    return 2.0 * length * rate * rate * travel


@inlined
def predict_all(fil, net, bank, work, row, dt, slow):
    """Carry every hypothesis to this epoch; note what the smoother must know of the step."""
    k = fil.settings
    i_s, i_v = fil.at[POSITION], fil.at[SPEED]
    moving = first_moving(fil)
    for i in range(bank.live[0]):
        h = bank.live[1 + i]
        x = bank.x[h]
        slot = work.slot[h]
        for j in range(PULLS):
            slot[j] = 0.0
        if dt <= 0.0:
            continue
        path_shape(net, bank, h, x[i_s] + 0.5 * dt * x[i_v], work.probe)
        slot[S_PULL] = gravity_pull(k[K_GRAVITY], work.probe[P_GRADIENT])
        slot[S_SIGN] = direction(fil, bank, h)
        slot[S_TRAVEL] = abs(dt * x[i_v])
        slot[S_STRETCH] = stretch_variance(fil, work.probe, slot[S_TRAVEL])
        slot[S_SLOW] = slow
        poor = work.probe[P_SIGMA_CROSS] / fil.map_sigma if fil.map_sigma > 0.0 else 0.0
        if poor > 1.0:  # what the model is wrong by where it is poor does not outlast that
            slot[S_TRAVEL] *= poor * poor
        bank.info[h, TRAVELLED] += slot[S_TRAVEL]
        slot[S_TRAVEL] = 0.0
        if slow > 0.0:
            slot[S_TRAVEL] = bank.info[h, TRAVELLED]
            bank.info[h, TRAVELLED] = 0.0
        columns = transition(
            fil,
            x,
            dt,
            slot[S_SIGN],
            row[FORCE],
            row[SIGMA_FORCE],
            slot[S_PULL],
            0.0,
            0.0,
            0.0,
            0.0,
            slot[S_TRAVEL],
            slot[S_STRETCH],
            slow,
            work.F,
            work.Q,
            work.lead,
            work.vector[W_NEW],
        )
        begin = 0 if slow > 0.0 else moving
        predict(x, bank.P_sqrt[h], work.F, work.Q, work.lead, columns, work.vector[W_NEW], begin)


@inlined
def frozen(fil, shared, bank, row):
    """Whether a fix repeats the one before to the last digit while the train moves: no news, whatever its sigma says."""
    common = shared.common
    same = row[EAST] == common[C_LAST_EAST] and row[NORTH] == common[C_LAST_NORTH]
    common[C_LAST_EAST] = row[EAST]
    common[C_LAST_NORTH] = row[NORTH]
    if not same:
        return False
    best = heaviest(bank)
    i_v = fil.at[SPEED]
    if abs(bank.x[best, i_v]) < 1.0 + 4.0 * math.sqrt(variance_of(bank.P_sqrt[best], i_v)):
        return False
    common[C_FROZEN] += 1.0
    return True


@part
def explained(fil, net, bank, row):
    """Whether any hypothesis is near the balise that is read."""
    i_s = fil.at[POSITION]
    for i in range(bank.live[0]):
        h = bank.live[1 + i]
        s = bank.x[h, i_s]
        at = balise_place(net, bank, h, int(row[BALISE_TRACK]), row[BALISE_OFFSET], s)
        if abs(at - s) <= 4.0 * math.sqrt(variance_of(bank.P_sqrt[h], i_s)) + 5.0 * BALISE_REACH:
            return True
    return False


@inlined
def follow_all(fil, net, shared, bank, work):
    """Keep every path ahead of its train: clones at facing turnouts, buffer stops, the end of the model, lost positions."""
    i_s, i_v = fil.at[POSITION], fil.at[SPEED]
    i = 0
    while i < bank.live[0]:
        h = bank.live[1 + i]
        x, P_sqrt = bank.x[h], bank.P_sqrt[h]
        sd = math.sqrt(variance_of(P_sqrt, i_s))
        bank.tags[h, CURRENT] = path_index(bank, h, x[i_s], bank.tags[h, CURRENT])
        before = bank.live[0]
        ends = follow(net, bank, h, x[i_s], x[i_v], 4.0 * sd + 2.0 + abs(fil.lever[0]))
        for m in range(before, bank.live[0]):
            for j in range(PULLS):
                work.slot[bank.live[1 + m], j] = work.slot[h, j]
        bank.tags[h, CURRENT] = path_index(bank, h, x[i_s], bank.tags[h, CURRENT])
        note_turn(fil, net, shared, bank, h, work.probe)
        gone = sd > fil.settings[K_LOST_SIGMA]
        if ends != 0:
            c = bank.tags[h, COUNT] - 1 if ends > 0 else 0
            track, way = bank.track[h, c], bank.way[h, c]
            far = bank.begin[h, c] + (net.length[track] if ends > 0 else 0.0)
            end = leaving_end(track, way) if ends > 0 else entering_end(track, way)
            if net.stop[end] == 1:  # a buffer stop holds the train
                h_row = work.vector[W_H]
                for j in range(x.shape[0]):
                    h_row[j] = 0.0
                h_row[i_s] = 1.0
                held = robust_row(
                    x, P_sqrt, h_row, far - x[i_s], 1.0, work.vector[W_F], work.vector[W_KEEP], work.vector[W_MOVE]
                )
                credit(bank, h, BY_PATH, held)
            elif abs(x[i_s] - far) > 3.0 * sd + 5.0:
                gone = True
                shared.common[C_NOTHING_NEAR] = 1.0
        if gone:
            drop(bank, i)
        else:
            i += 1


@inlined
def sense_all(fil, net, shared, bank, work, row, dt):
    """Let odometer, standstill, gyro, GNSS speed and course into every hypothesis."""
    at = fil.at
    common = shared.common
    i_s, i_v, i_d = at[POSITION], at[SPEED], at[WHEEL_DISTANCE]
    still = stands(fil, shared, bank, row)
    if still:
        common[C_STOOD] = 1.0
    elif common[C_STOOD] == 1.0:
        common[C_STOOD] = 0.0
        if at[ACCELEROMETER_BIAS] < 0:
            if fil.signed == 0:
                depart(fil, bank, work)
            kick(fil, bank, work, row)
    wheel = i_d >= 0 and row[DISTANCE] == row[DISTANCE]
    if wheel and not shared.ring[(int(common[C_RING]) - 1) % RING, 0] > -np.inf:
        wheel = False
        for i in range(bank.live[0]):  # the first reading
            h = bank.live[1 + i]
            bank.x[h, i_d] = row[DISTANCE]
            for j in range(i_d):
                bank.P_sqrt[h, i_d, j] = 0.0
            bank.P_sqrt[h, i_d, i_d] = fil.settings[K_ODOMETER_SIGMA]
    if wheel:
        leader = heaviest(bank)
        for i in range(-1, bank.live[0]):
            h = leader if i < 0 else bank.live[1 + i]
            if i >= 0 and h == leader:
                continue
            evidence, slip, shake = wheel_row(fil, shared, bank, work, h, row, leader)
            credit(bank, h, BY_ODOMETER, evidence)
            keep_check(fil, bank, h, row[TIME], slip > 0.0 or shake > 0.0)
            work.slot[h, S_SLIP] = slip
            work.slot[h, S_SHAKE] += shake
    worst = np.inf  # of the yaw rate's squared normalised innovations the least
    for i in range(bank.live[0]):
        h = bank.live[1 + i]
        x = bank.x[h]
        work.slot[h, S_YAW] = np.inf
        work.slot[h, S_COURSE] = 0.0
        path_point(net, bank, h, x[i_s], work.point[h])
        work.point[h, POINT_SIZE] = x[i_s]
        motion_rows(fil, net, shared, bank, work, h, row, dt, still)
        worst = min(worst, work.slot[h, S_YAW])
        if bank.tags[h, MOVED] == 0 and abs(x[i_v]) > max(0.5, 3.0 * math.sqrt(variance_of(bank.P_sqrt[h], i_v))):
            bank.tags[h, MOVED] = 1
            reverse = fil.settings[K_REVERSE]
            credit(bank, h, BY_PATH, math.log(reverse if x[i_v] < 0.0 else 1.0 - reverse))
    weigh_courses(bank, work)
    if worst < np.inf:
        judge_gyro(fil, shared, bank, work, row[TIME], dt, worst)


@inlined
def weigh_courses(bank, work):
    """Evidence of courses counts with that of positions, but what tells a turnout's leg from another does not fade: it is history.

    That holds on models that state bearings to be known. On one that is decimetres off, or does not say, every bend of its error would
    tell tracks side by side apart, again and again, and for good.
    """
    top = -np.inf
    known = True
    for i in range(bank.live[0]):
        h = bank.live[1 + i]
        top = max(top, work.slot[h, S_COURSE])
        known = known and 0.0 < work.point[h, P_SIGMA_CROSS] <= EXACT
    for i in range(bank.live[0]):
        h = bank.live[1 + i]
        said = work.slot[h, S_COURSE] - top
        if known and said < -COURSE_TELLS:
            credit(bank, h, BY_COURSE, max(said, -COURSE_MOST))
        else:  # what a model's bearings may be wrong by fades as what fixes say does
            bank.info[h, FRAMED] += said
            bank.info[h, BY_COURSE] += said  # the fix, let in next, credits both together
            bank.info[h, BY_POSITION] -= said


@inlined
def judge_gyro(fil, shared, bank, work, time, dt, worst):
    """Stop believing a yaw gyro whose rates fit no hypothesis; its bias may have stepped."""
    common = shared.common
    share = min(dt / YAW_SPAN, 1.0)
    common[C_YAW_MISFIT] += share * ((1.0 if worst > ROW_GATE else 0.0) - common[C_YAW_MISFIT])
    if common[C_YAW_MISFIT] > YAW_MISFIT and time >= common[C_YAW_DISTRUST]:
        common[C_YAW_DISTRUST] = time + YAW_DISTRUST * 2.0 ** min(common[C_GYRO_FAULTS], 8.0)
        common[C_YAW_MISFIT] = 0.0
        common[C_GYRO_FAULTS] += 1.0
        for i in range(bank.live[0]):
            widen(bank.P_sqrt[bank.live[1 + i]], fil.at[GYRO_BIAS], fil.settings[K_GYRO_BIAS], work.vector[W_COLUMN])


@part
def wheel_alone(fil):
    """Whether a wheel carries the place between fixes with no accelerometer to tell when it slips."""
    return fil.at[ODOMETER_SCALE] >= 0 and fil.at[ACCELEROMETER_BIAS] < 0


@part
def jump(fil, shared, bank, work):
    """What stepped when fixes have left every hypothesis: variances for the GNSS error (in its own units) and for the time stamps.

    A jump along the track that the speed turns into less than `time_tag_most` seconds is one of the stamps.
    """
    k = fil.settings
    best = bank.live[1]
    for i in range(1, bank.live[0]):
        if work.slot[bank.live[1 + i], S_NIS] < work.slot[best, S_NIS]:
            best = bank.live[1 + i]
    fix = work.fix[best]
    te, tn = work.point[best, P_D_EAST], work.point[best, P_D_NORTH]
    size = math.hypot(te, tn)
    along = (fix[0] * te + fix[1] * tn) / size
    cross = (fix[0] * tn - fix[1] * te) / size
    across = (fix[4] * tn * tn - 2.0 * fix[6] * te * tn + fix[5] * te * te) / (size * size)
    v = bank.x[best, fil.at[SPEED]]
    # a receiver whose speed is another than the wheel's has no clock to blame
    fresh = shared.common[C_GNSS_SPEED_TIME] > shared.common[C_TIME] - 1.5
    apart = abs(shared.common[C_GNSS_SPEED] - abs(v)) > CONTRADICTS + CONTRADICTS_SHARE * abs(v)
    slips = fresh and apart and wheel_alone(fil)
    if abs(v) > 3.0 and not slips and abs(along / v) <= k[K_TAG_MOST] and cross * cross < k[K_GATE] * across:
        return 0.0, (along / v) ** 2
    sigma = shared.common[C_SCALE] * k[K_CORRELATED] * shared.common[C_SIGMA_EAST]
    return max((fix[0] ** 2 + fix[1] ** 2) / (sigma * sigma), 1.0), 0.0


@part
def doubt_places(fil, bank, work, odds):
    """Give every hypothesis a twin that stands where the fix shows it: not the receiver stepped, the place was wrong (17, attribution).

    Later fixes tell: an error that stepped fades, stamps that jumped show in proportion to the speed, a place that is wrong stays so.
    The twins, worth `odds`, stand last among the living.
    """
    count = bank.live[0]
    if 2 * count > bank.used.shape[0]:
        return
    for i in range(count):
        h = bank.live[1 + i]
        g = clone(bank, h)
        for j in range(work.slot.shape[1]):
            work.slot[g, j] = work.slot[h, j]
        for j in range(work.point.shape[1]):
            work.point[g, j] = work.point[h, j]
        fix = work.fix[h]
        te, tn = work.point[h, P_D_EAST], work.point[h, P_D_NORTH]
        size = te * te + tn * tn
        along = (fix[0] * te + fix[1] * tn) / size
        variance = (fix[4] * te * te + 2.0 * fix[6] * te * tn + fix[5] * tn * tn) / (size * size)
        if odds < 1.0:
            credit(bank, g, BY_PATH, math.log(odds))
        bank.x[g, fil.at[POSITION]] += along
        widen(bank.P_sqrt[g], fil.at[POSITION], math.sqrt(variance), work.vector[W_COLUMN])
        work.slot[g, S_STRETCH] += along * along + variance


@inlined
def note_along(shared, bank, work, time):
    """Note how far ahead of the heaviest hypothesis a fix lies: a witness of wheels that slip."""
    h = heaviest(bank)
    fix = work.fix[h]
    te, tn = work.point[h, P_D_EAST], work.point[h, P_D_NORTH]
    size = math.hypot(te, tn)
    shared.common[C_ALONG] = (fix[0] * te + fix[1] * tn) / size
    shared.common[C_ALONG_SIGMA] = math.sqrt(fix[4] * te * te + 2.0 * fix[6] * te * tn + fix[5] * tn * tn) / size
    shared.common[C_ALONG_TIME] = time


@inlined
def fix_all(fil, net, shared, bank, work, row):
    """Let a GNSS position into every hypothesis, or hold it as suspect when it fits none; gives whether it was let in."""
    k = fil.settings
    at = fil.at
    common = shared.common
    time = row[TIME]
    fresh = common[C_FRESH] == 1.0
    least = np.inf
    for i in range(bank.live[0]):
        h = bank.live[1 + i]
        nis, logdet = position_row(fil, net, shared, bank, work, h, row)
        work.slot[h, S_NIS] = nis
        work.slot[h, S_SAID] = logdet
        least = min(least, nis)
    note_along(shared, bank, work, time)
    step = 0.0
    tag = 0.0
    if least > k[K_GATE] and not fresh:
        common[C_SUSPECT_FIXES] += 1.0
        if common[C_SUSPECTS] == 0.0:
            common[C_SUSPECT_SINCE] = time
        common[C_SUSPECTS] += 1.0
        if common[C_SUSPECTS] < k[K_STEP_FIXES] or time - common[C_SUSPECT_SINCE] < 1.0:
            return False
        if time - common[C_START_TIME] < START_PROBATION:
            common[C_JUMPS] = np.inf  # start anew
            common[C_TRY] = -np.inf
            return False
        step, tag = jump(fil, shared, bank, work)
        sigma = common[C_SCALE] * k[K_CORRELATED] * common[C_SIGMA_EAST]
        far = step * sigma * sigma > STEP_MOST * STEP_MOST or common[C_JUMPS] > 2.0
        if far and at[ODOMETER_SCALE] >= 0 and time - common[C_START_TIME] > ESTABLISHED:
            return False
        common[C_STEPS] += 1.0
        if common[C_GNSS_SPEED] < 0.5 and at[SPEED_LATENCY] >= 0:
            common[C_DISTRUST] = time + DISTRUST
            kick(fil, bank, work, row)
    common[C_SUSPECTS] = 0.0
    watch_misfit(common, least)
    common[C_FIXES] += 1.0
    held = START_GATE if fresh else k[K_GATE] + 10.0  # evidence against a hypothesis saturates: a fix may be wrong, too
    most = -np.inf
    i_g = at[GNSS_EAST]
    keep, move, before = work.vector[W_KEEP], work.vector[W_MOVE], work.vector[W_BEFORE]
    count = bank.live[0]
    if step > 0.0 and (wheel_alone(fil) or not timed(fil)):
        doubt_places(fil, bank, work, 1.0)
    elif tag > 0.0 and wheel_alone(fil):
        doubt_places(fil, bank, work, UNSEEN_SLIP)
    for i in range(count):
        h = bank.live[1 + i]
        x, P_sqrt = bank.x[h], bank.P_sqrt[h]
        if step > 0.0:
            widen(P_sqrt, i_g, math.sqrt(step), work.vector[W_COLUMN])
            widen(P_sqrt, i_g + 1, math.sqrt(step), work.vector[W_COLUMN])
            work.slot[h, S_STEP] = step
        if tag > 0.0:
            widen(P_sqrt, at[TIME_TAG], math.sqrt(tag), work.vector[W_COLUMN])
            work.slot[h, S_TAG] = tag
        nis, logdet = work.slot[h, S_NIS], work.slot[h, S_SAID]
        if step > 0.0 or tag > 0.0:
            nis, logdet = position_row(fil, net, shared, bank, work, h, row)
        stray(fil, bank, work, h, max(time - common[C_FIX_TIME], 0.0), nis, held)
        said = -0.5 * (min(nis, held) + logdet)
        work.slot[h, S_SAID] = said
        most = max(most, said)
        n = x.shape[0]
        for j in range(n):
            before[j] = x[j]
        fix, h_north, f_north = work.fix[h], work.rows[h, 1], work.rows[h, 3]
        told = stamps(fil, x, P_sqrt)
        absorb(x, P_sqrt, work.rows[h, 2], fix[0], fix[2], keep, move)
        innovation = fix[1]
        for j in range(n):
            innovation -= h_north[j] * (x[j] - before[j])
        project(P_sqrt, h_north, f_north)
        absorb(x, P_sqrt, f_north, innovation, fix[3], keep, move)
        if tag == 0.0 and not timed(fil):
            take_back(fil, x, P_sqrt, told, 1, work.vector[W_COLUMN])
    for i in range(count, bank.live[0]):  # a place that is wrong is as probable as a receiver that steps
        work.slot[bank.live[1 + i], S_SAID] = work.slot[bank.live[1 + i - count], S_SAID]
    # the evidence of positions fades: errors longer than any correlation time must not add up to certainty
    since = time - common[C_FIX_TIME]
    top = -np.inf
    for i in range(bank.live[0]):
        h = bank.live[1 + i]
        slot = work.slot[h]
        slot[S_SAID] = weigh_positions(fil, bank, slot, h, slot[S_SAID] - most, since)
        top = max(top, slot[S_SAID])
    # and it is never beyond doubt: now and then model and receiver are both farther off than they say (a contaminated normal law)
    doubt = k[K_POSITION_DOUBT]
    for i in range(bank.live[0]):
        h = bank.live[1 + i]
        said = work.slot[h, S_SAID] - top
        said = math.log((1.0 - doubt) * math.exp(said) + doubt * math.exp(said / DOUBTED))
        credit(bank, h, BY_POSITION, said - bank.info[h, BELIEVED])
        bank.info[h, BELIEVED] = said
    common[C_JUMPS] *= math.exp(-since / 30.0)
    if step > 0.0:
        common[C_JUMPS] += 1.0
    return True


@inlined
def settle(fil, bank, shared, work):
    """Merge what has become one, and bring every hypothesis' place up to its state; gives how many there were before."""
    # work.mix for the records: slot, log-weight before, share of the hypothesis that it has been merged into (0: it lives)
    i_s = fil.at[POSITION]
    before = bank.live[0]
    if before > 1:
        for i in range(bank.live[0]):
            h = bank.live[1 + i]
            bank.tags[h, CURRENT] = path_index(bank, h, bank.x[h, i_s], bank.tags[h, CURRENT])
            work.mix[0, i] = h
            work.mix[1, i] = bank.logw[h]
        merge_all(bank, i_s, fil.at[SPEED], fil.settings[K_MERGE], work.vector[W_COLUMN])
        for i in range(before):
            h = int(work.mix[0, i])
            into = h
            while bank.used[into] == 0:
                into = bank.tags[into, INTO]
            bank.tags[h, INTO] = into
            work.mix[2, i] = math.exp(work.mix[1, i] - bank.logw[into]) if into != h else 0.0
        normalise(bank, shared.weight, fil.settings[K_PRUNE], int(fil.settings[K_MOST]))
    for i in range(bank.live[0]):
        h = bank.live[1 + i]
        bank.tags[h, CURRENT] = path_index(bank, h, bank.x[h, i_s], bank.tags[h, CURRENT])
        step = bank.x[h, i_s] - work.point[h, POINT_SIZE]
        work.point[h, P_EAST] += step * work.point[h, P_D_EAST]
        work.point[h, P_NORTH] += step * work.point[h, P_D_NORTH]
    return before


@part
def keep_records(bank, work, records, epoch, before):
    """Append one record a living hypothesis, its window when that has changed, and whose pasts have been merged into it."""
    used = records.used
    for i in range(before if before > bank.live[0] else 0):
        h = int(work.mix[0, i])
        into = bank.tags[h, INTO]
        own = bank.tags[h, RECORD]
        if into != h and bank.used[into] == 1 and own >= 0 and own != bank.tags[into, RECORD]:
            for j in range(bank.live[0]):
                if bank.live[1 + j] == into:
                    join = records.joins[used[3]]
                    join[0], join[1], join[2] = used[0] + j, own, work.mix[2, i]
                    used[3] += 1
    n = bank.x.shape[1]
    for i in range(bank.live[0]):
        h = bank.live[1 + i]
        if bank.tags[h, VERSION] < 0:
            v = used[1]
            for j in range(bank.track.shape[1]):
                records.track[v, j] = bank.track[h, j]
                records.way[v, j] = bank.way[h, j]
                records.begin[v, j] = bank.begin[h, j]
            records.tracks[v] = bank.tags[h, COUNT]
            bank.tags[h, VERSION] = v
            used[1] = v + 1
        r = used[0]
        for a in range(n):
            records.x[r, a] = bank.x[h, a]
            for b in range(n):
                records.P_sqrt[r, a, b] = bank.P_sqrt[h, a, b]
        numbers = records.numbers[r]
        numbers[R_EPOCH] = epoch
        numbers[R_PARENT] = bank.tags[h, RECORD]
        numbers[R_VERSION] = bank.tags[h, VERSION]
        numbers[R_LOGW] = bank.logw[h]
        for j in range(PULLS):
            numbers[R_PULL + j] = work.slot[h, j]
        bank.tags[h, RECORD] = r
        used[0] = r + 1


# ---------------------------------------------------------------- the loop


@inlined
def advance(fil, net, shared, bank, work, records, row, epoch):
    """Take one epoch into the living hypotheses."""
    k = fil.settings
    common = shared.common
    time = row[TIME]
    fresh = common[C_FRESH] == 1.0
    dt = 0.0 if fresh else time - common[C_TIME]
    common[C_TIME] = time
    if bank.live[0] == 0:
        return
    slow = time - common[C_SLOW_TIME] if not fresh else 0.0
    if slow < SLOW_STEP and row[EAST] != row[EAST] and row[GNSS_SPEED] != row[GNSS_SPEED]:
        slow = 0.0
    if fresh or slow > 0.0:
        common[C_SLOW_TIME] = time
    predict_all(fil, net, bank, work, row, dt, slow)
    follow_all(fil, net, shared, bank, work)
    if bank.live[0] == 0:
        return
    sense_all(fil, net, shared, bank, work, row, dt)
    most = int(k[K_MOST])
    if (
        row[EAST] == row[EAST]
        and row[SIGMA_EAST] <= k[K_USABLE]
        and row[SIGMA_NORTH] <= k[K_USABLE]
        and not frozen(fil, shared, bank, row)
    ):
        since = time - common[C_FIX_TIME]
        accepted = fix_all(fil, net, shared, bank, work, row)
        normalise(bank, shared.weight, k[K_PRUNE], most)
        if accepted:
            common[C_FIX_TIME] = time
            if not fresh:
                adapt(fil, shared, bank, work, time, min(since, 10.0))
                normalise(bank, shared.weight, k[K_PRUNE], most)
        longest = k[K_LOST_AFTER]
        if common[C_SUSPECT_SINCE] - common[C_START_TIME] > ESTABLISHED and fil.at[ODOMETER_SCALE] >= 0:
            longest = COAST_LONGEST
        if (common[C_JUMPS] > 4.0 and longest < COAST_LONGEST) or (
            not accepted and time - common[C_SUSPECT_SINCE] > longest
        ):
            common[C_JUMPS] = 0.0
            common[C_SUSPECTS] = 0.0
            drop_all(bank)
    else:
        normalise(bank, shared.weight, k[K_PRUNE], most)
    common[C_FRESH] = 0.0
    before = settle(fil, bank, shared, work)
    if records.used[2] == 1:
        keep_records(bank, work, records, epoch, before)


def _compiled(stamp: int) -> Any:
    """The loop, bound to the checksum of the sources that it is made of."""

    @njit(cache=True, _nrt=False)
    def run(fil, net, shared, bank, work, records, journal, epochs, first, out):
        """Work through the epochs from `first`; gives where it stopped and why."""
        # epochs (m, EPOCH_SIZE), out (m, OUTPUT_SIZE)
        if stamp < 0:  # never: it makes the checksum part of the cache's key
            return first, DONE
        slots = bank.x.shape[0]
        usable = fil.settings[K_USABLE]
        for e in range(first, epochs.shape[0]):
            row = epochs[e]
            if records.used[2] == 1 and (
                records.used[0] + slots > records.x.shape[0]
                or records.used[1] + slots > records.track.shape[0]
                or records.used[3] + slots > records.joins.shape[0]
            ):
                return e, NEEDS_ROOM
            if journal.used[1] > 0 and journal.used[0] + slots > journal.lines.shape[0]:
                return e, NEEDS_ROOM
            seen = row[EAST] == row[EAST] and row[SIGMA_EAST] <= usable and row[SIGMA_NORTH] <= usable
            if bank.live[0] == 0 and seen and not row[TIME] - shared.common[C_TRY] < 1.0:
                return e, NEEDS_START
            if bank.live[0] > 0 and seen and row[TIME] - shared.common[C_RIVAL_TIME] >= RIVAL_INTERVAL:
                return e, NEEDS_RIVALS
            if row[BALISE_TRACK] >= 0.0 and shared.common[C_BALISE_TIME] < row[TIME]:
                shared.common[C_BALISE_TIME] = row[TIME]
                shared.common[C_BALISES] += 1.0
                if not explained(fil, net, bank, row):
                    shared.common[C_STRANGE_BALISES] += 1.0
                    return e, NEEDS_BALISE
            watch(fil, shared, row)
            hold_repeated(fil, shared, bank, row)
            advance(fil, net, shared, bank, work, records, row, e)
            remember(shared, row)
            put_out(fil, net, shared, bank, work, row, out[e])
            if journal.used[1] > 0:
                keep_journal(fil, net, shared, bank, journal, e, out[e])
            shared.common[C_OUT_MODE] = out[e, OUT_MODE]
        return epochs.shape[0], DONE

    return run


run = _compiled(source_stamp(paths, columns, state, units, dynamics, integrity, measurements, standing, decision))
