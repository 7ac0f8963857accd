"""What the navigator's kernels agree on: columns of their tables by name, and the arrays that travel together."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from railnav.matching._kernels import ENTRIES
from railnav.navigation.solution import Mode
from railnav.navigation.state import SETTING, State

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

FRAME_EAST, FRAME_NORTH, GNSS_EAST, GNSS_NORTH = (
    int(State.FRAME_EAST),
    int(State.FRAME_NORTH),
    int(State.GNSS_EAST),
    int(State.GNSS_NORTH),
)
MAP_CROSS = int(State.MAP_CROSS)
TIME_TAG, SPEED_LATENCY, SPEED_ERROR = int(State.TIME_TAG), int(State.SPEED_LATENCY), int(State.SPEED_ERROR)
ODOMETER_SCALE, GYRO_BIAS, GYRO_TILT, SIDE_BIAS, ACCELEROMETER_BIAS = (
    int(State.ODOMETER_SCALE),
    int(State.GYRO_BIAS),
    int(State.GYRO_TILT),
    int(State.SIDE_BIAS),
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
K_MAP_LENGTH = SETTING["model_length"]
K_FRAME_MOST = SETTING["frame_sigma_most"]
K_SCALE_START = SETTING["scale_start"]
K_SCALE_PRIOR = SETTING["scale_prior"]
K_SCALE_LEAST = SETTING["scale_least"]
K_SCALE_MOST = SETTING["scale_most"]
K_GATE = SETTING["gate"]
K_STEP_FIXES = SETTING["step_fixes"]
K_LOST_AFTER = SETTING["lost_after"]
K_TAG_SIGMA = SETTING["time_tag_sigma"]
K_TAG_WALK = SETTING["time_tag_walk"]
K_TAG_MOST = SETTING["time_tag_most"]
K_SPEED_SIGMA = SETTING["speed_sigma"]
K_SPEED_LATENCY = SETTING["speed_latency"]
K_SPEED_SHARE = SETTING["speed_error_share"]
K_SPEED_TIME = SETTING["speed_error_time"]
K_COURSE_SIGMA = SETTING["course_sigma"]
K_ACC_SIGMA = SETTING["acceleration_sigma"]
K_ACC_TIME = SETTING["acceleration_time"]
K_FORCE_NOISE = SETTING["accelerometer_noise"]
K_FORCE_WALK = SETTING["accelerometer_walk"]
K_GYRO_BIAS = SETTING["gyro_bias"]
K_GYRO_WALK = SETTING["gyro_walk"]
K_GYRO_FLOOR = SETTING["gyro_floor"]
K_GYRO_SCALE = SETTING["gyro_scale"]
K_SIDE_WALK = SETTING["side_walk"]
K_SIDE_NOISE = SETTING["side_noise"]
K_SIDE_TIME = SETTING["side_time"]
K_SIDE_SCALE = SETTING["side_scale"]
K_BALISE_SIGMA = SETTING["balise_sigma"]
K_GNSS_FAULT = SETTING["gnss_fault"]
K_FRAME_FAULT = SETTING["frame_fault"]
K_ASTRAY_RATE = SETTING["astray_rate"]
K_FRAME_FAULT_SIGMA = SETTING["frame_fault_sigma"]
K_MISSING = SETTING["track_missing"]
K_OFFSET_WALK = SETTING["frame_walk"]
K_ASTRAY_WALK = SETTING["astray_walk"]
K_ASTRAY_TIME = SETTING["astray_time"]
K_BALISE_MISSED = SETTING["balise_missed"]
K_CURVATURE_SIGMA = SETTING["curvature_sigma"]
K_CURVATURE_SHIFT = SETTING["curvature_shift"]
K_CURVATURE_LENGTH = SETTING["curvature_length"]
K_CURVATURE_DOUBT = SETTING["curvature_doubt"]
K_COURSE_DOUBT = SETTING["course_doubt"]
K_ODOMETER_SCALE = SETTING["odometer_scale"]
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
K_POSITION_DOUBT = SETTING["position_doubt"]
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
    SIDE,  # specific force to the right, mean since the epoch before
    BALISE_TRACK,  # index of the track of the balise that is read
    BALISE_OFFSET,  # from that track's start, m
    SIGMA_BALISE,
    SIGMA_FORCE,  # of the means of specific force
) = range(20)
EPOCH_SIZE = 20

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
    C_FORCE_REST,  # specific force of the train at rest, slowly averaged
    C_START_TIME,
    C_RIVAL_TIME,  # when tracks nearby were last given a rival hypothesis
    C_UNSEEN,  # probability that the train is on a track that begins farther on
    C_OUT_MODE,
    C_TOLD_TRACK,  # as in the row before, -1 where there was none
    C_BALISE_TIME,  # latest reading
    C_BALISES,
    C_STRANGE_BALISES,
    C_LAST_EAST,  # latest fix, to tell one that is repeated
    C_LAST_NORTH,
    C_FROZEN,  # fixes that repeat the one before while the train moves
    C_LAST_FORCE,
    C_LAST_SIDE,
    C_LAST_YAW,
    C_REPEATED,  # inertial means that repeat the ones before
    C_YAW_MISFIT,  # share of yaw rates lately that fit no hypothesis
    C_YAW_DISTRUST,  # until when the yaw gyro is not believed
    C_GYRO_FAULTS,
    C_ACCELEROMETER_FAULTS,
    C_ODOMETER_FAULTS,
    C_BLAMED,  # when wheel and receiver agreed against the accelerometer
    C_ALONG,  # how far ahead of the heaviest hypothesis the latest fix lay, m, with its sigma, and when
    C_ALONG_SIGMA,
    C_ALONG_TIME,
    C_BLAMED_WAY,  # how far it may have carried the train astray by then, m
    C_RESCALED,  # when the receiver confirmed the speed against the wheel for long
    C_MISFIT,  # squared normalised innovation of fixes a degree of freedom, of late
    C_SLOW_TIME,  # when the slow states last took their noise
) = range(62)
COMMON_SIZE = 62
#: Errors of sensors take their noise at fixes, where they tell, and after so long without one, s.
SLOW_STEP = 0.95
#: Innovations of fixes are judged over so many; their sigmas are too small where the mean square exceeds this.
MISFIT_FIXES, MISFIT_USUAL = 20.0, 1.4
#: How often tracks nearby that no hypothesis holds are given a rival, s.
RIVAL_INTERVAL = 60.0
#: Odometer readings remembered: time, distance.
RING = 32
#: Wheel speed is the mean over this long, s.
WHEEL_SPAN = 0.5
#: Standard deviations that forget the wheel distance (m) and shake the speed (m/s).
FORGET_WHEEL, SHAKE_SPEED = 10.0, 0.1
#: How long a receiver that said "at rest" while its positions moved is not believed, s.
DISTRUST = 300.0
#: Posterior at which the direction of the nose is told (a train without an IMU is presumed to run nose first, at 0.98).
DIRECTION_CONFIDENCE = 0.95
#: A start that later fixes contradict within this time was made on a wrong fix, s.
START_PROBATION = 20.0
#: Squared normalised innovation at which the evidence of a first fix saturates: it may itself be the wrong one.
START_GATE = 9.0
#: Change of the specific force by which a train at rest is seen to leave, m/s^2.
LEAVING = 0.08
#: Acceleration of a departing train, m/s^2.
KICK = 0.7
#: Random walk of the speed while an accelerometer that should be there is silent, m/s^2/sqrt(Hz).
SILENT_NOISE = 0.4
#: How long a jump of the stamps is remembered where nothing but the fixes tells the time, s: loggers that lose a stamp find it again.
TAG_MEMORY = 300.0
#: Squared normalised innovation at which a single sensor row is held; its evidence saturates there.
ROW_GATE = 16.0
#: ln p of a balise that a hypothesis has no explanation for: read in error, or its place in the model is wrong.
STRANGE_BALISE = -14.0
#: How far a hypothesis may be from a balise that is read, beyond four sigmas, m.
BALISE_REACH = 10.0
#: A stretch of the model this many times as poor as it usually is has been bridged by smoothness.
BRIDGED = 3.0
#: Mean error across of such a bridge, of its largest.
HELD = 0.6
#: Beyond this sigma along the track, m, a receiver alone that gives fixes has not yet told where on the track the train is.
APART = 25.0
#: Sigmas past a toe at which a turnout's leg may be declared.
GUARD = 3.0
#: A track that the model lacks lies this far from one that it has, m; and sigma of an error across that may be anything, m.
BESIDE_LEAST, BESIDE_MOST, ANYWHERE = 3.5, 15.0, 30.0
#: How likely a track that the model lacks still is once a turnout's curved leg has been run through, with a yaw gyro and without ...
TURN_FELT, TURN_SEEN = 1e-3, 0.03
#: ... a leg that bends by so much more than its sister, 1/m, so far past the points, m.
LEG_BEND, LEG_PLACE = 1e-3, 20.0
#: Squared normalised innovation at which a fix moves the error across no farther.
CROSS_GATE = 9.0
#: Posterior below which a hypothesis that may not have reached a toe does not keep the others from being declared past it.
NEGLIGIBLE = 1e-3
#: A jump of the position beyond this is no step of a GNSS error but a fault, m: the train coasts until fixes fit again ...
STEP_MOST = 25.0
#: ... for so many seconds, where the train has wheels or inertial sensors to coast on and its place was known for long before.
COAST_LONGEST = 300.0
ESTABLISHED = 60.0
#: Yaw rates are no longer believed when this share of those of some seconds fits no hypothesis; and for how long then, s.
YAW_MISFIT, YAW_SPAN, YAW_DISTRUST = 0.5, 2.0, 60.0
#: A wheel contradicts the receiver from this difference of their speeds on: m/s, and a share of the speed; and a second of acceleration.
CONTRADICTS, CONTRADICTS_SHARE = 0.5, 0.02
#: A wheel whose scale seems to be off by more than this many sigmas is slipping, slowly.
SCALE_GATE = 3.5
#: A receiver's speed that the wheel confirms is against the filter's from this difference on, m/s: the former may be half a second old, but
#: then a slipping wheel errs the other way.
AGAINST = 0.4
#: By how much an accelerometer's bias or a wheel's scale may have stepped when the other speeds agree against it.
FORCE_STEP, SCALE_STEP = 0.3, 0.05
#: A wheel that turns at less than this share of the speed for long is dead.
DEAD_WHEEL = 0.2
#: Inertial means repeat each other when they differ by less (rad/s, m/s^2): the means are differences of sums, with their rounding.
REPEATED = 1e-9
#: How much wider the law of a misled estimate's distance from the fixes is than that of a sound one's.
FAULT_SPREAD = 10.0
#: Odds that a jump of fixes along the track, which late stamps would explain, is a slip of the wheel that went unseen.
UNSEEN_SLIP = 0.1
#: How often dead reckoning by the wheel begins anew, s.
CHECK_INTERVAL = 60.0
#: Way over which inertial rows count once as evidence of a track, m.
EVIDENCE_STEP = 1.0
#: How much weaker the evidence of positions is when model or receiver are off by more than they say: sigmas five times as large.
DOUBTED = 25.0
#: What one course must tell between hypotheses to be that of a turnout's leg, nat, and the most that it can: receiver and model may both be
#: wrong about a bearing.
COURSE_TELLS, COURSE_MOST = 1.0, 4.0
#: Length over which the error of a model's bearing is the same, m.
BEARING_LENGTH = 20.0
#: A slope of the curvature this many times its error counts.
SLOPES = 3.0
#: Change of curvature a metre that the linearised course allows for, 1/m^2.
BEND_CHANGE = 1e-5

#: Where a model's axis is off by d, its curvature is off by about d over this squared, and for as long, m.
BLIND_LENGTH = 200.0

#: Columns of a record's numbers, kept for the smoother.
R_EPOCH, R_PARENT, R_VERSION, R_LOGW, R_PULL, R_SLIP, R_SHAKE, R_STEP, R_TAG, R_SIGN, R_TRAVEL, R_STRETCH, R_SLOW = (
    range(13)
)
RECORD_SIZE = 13
#: Those of them that the filter fills as it goes: from R_PULL on.
PULLS = 9

#: Rows of `Work.vector`.
W_NEW, W_H, W_F, W_KEEP, W_MOVE, W_COLUMN, W_BEFORE = range(7)
#: Columns of `Work.slot`: what the filter did to a hypothesis (PULLS numbers as in a record), NIS and ln p of the fix, track's posterior.
(
    S_PULL,
    S_SLIP,
    S_SHAKE,
    S_STEP,
    S_TAG,
    S_SIGN,
    S_TRAVEL,
    S_STRETCH,
    S_SLOW,
    S_NIS,
    S_SAID,
    S_MASS,
    S_YAW,
    S_ASTRAY,
    S_FRAMED,
    S_COURSE,
    S_KNOWN,
) = range(17)
SLOT_SIZE = 17
#: Noise columns at most.
NOISES = 16

#: Why the loop stopped.
DONE, NEEDS_START, NEEDS_ROOM, NEEDS_RIVALS, NEEDS_BALISE = range(5)

#: Columns of a line in the journal; the ledger of evidence follows, then the row is full.
J_EPOCH, J_DECISION, J_TRACK, J_WAY, J_OFFSET, J_WEIGHT, J_SIGMA, J_SPEED = range(8)
JOURNAL_SIZE = 8 + ENTRIES
#: Candidates below this posterior are not written down.
J_LEAST = 1e-4

GAUSS_HERMITE_NODES = np.array([-2.8569700138728056, -1.355626179974266, 0.0, 1.355626179974266, 2.8569700138728056])
GAUSS_HERMITE_WEIGHTS = np.array(
    [0.011257411327720689, 0.2220759220056126, 0.5333333333333333, 0.2220759220056126, 0.011257411327720689]
)


class Filter(NamedTuple):
    """What stays the same over a run."""

    at: IntArray  # (17,) index of each state, -1 absent
    settings: FloatArray  # Settings.packed()
    lever: FloatArray  # (3,) reference point to antenna: forward, right, down, m
    risk: FloatArray  # (3,) integrity risk, two-sided normal quantile, quantile at that risk over the probability of a GNSS fault
    signed: int  # 1: the odometer counts backwards when backing up
    map_sigma: float = 0.0  # usual error of the model across its tracks, m
    reads_balises: int = 0  # 1: the train has a reader: a balise passed in silence is evidence
    slope: float = 0.0  # error of d(curvature)/ds: a slope no larger than that is no landmark, 1/m^2
    turned: float = 1.0 / BLIND_LENGTH  # error of the model's bearing over that across, rad/m
    canted: int = 1  # 0: the model does not know cant


class Shared(NamedTuple):
    """What all hypotheses share and every epoch changes."""

    common: FloatArray  # (COMMON_SIZE,)
    ring: FloatArray  # (RING, 2)
    weight: FloatArray  # (slots,)


class Work(NamedTuple):
    """Room to work in, made once."""

    F: FloatArray  # (n, n)
    Q: FloatArray  # (NOISES, n) one noise column a row
    lead: IntArray  # (NOISES,) first row of each noise column
    vector: FloatArray  # (7, n): W_...
    point: FloatArray  # (slots, POINT_SIZE + 1): geometry at each hypothesis' predicted position, and that position
    probe: FloatArray  # (POINT_SIZE + 1,)
    place: FloatArray  # (4,): antenna and its derivative
    rows: FloatArray  # (slots, 4, n): rows of the fix E, N, and their projections on each hypothesis' root
    fix: FloatArray  # (slots, 7): innovation E, N; white variance E, N; innovation covariance EE, NN, EN
    slot: FloatArray  # (slots, SLOT_SIZE): S_...
    mix: FloatArray  # (3, slots): weight, mean, sigma along the track


class Journal(NamedTuple):
    """Candidates by epoch: lines of alternatives and of decisions. Empty when neither is kept."""

    lines: FloatArray  # (lines, JOURNAL_SIZE)
    used: IntArray  # (2,) lines, what is kept: 0 nothing, 1 decisions, 2 alternatives, 3 both


class Records(NamedTuple):
    """What the smoother needs: one record a hypothesis and epoch; windows by version. Empty arrays when nothing is kept."""

    x: FloatArray  # (records, n)
    P_sqrt: FloatArray  # (records, n, n)
    numbers: FloatArray  # (records, RECORD_SIZE)
    track: IntArray  # (versions, window)
    way: IntArray  # (versions, window)
    begin: FloatArray  # (versions, window)
    tracks: IntArray  # (versions,) how many tracks of the window count
    used: IntArray  # (4,) records, versions, whether records are kept, joins
    joins: FloatArray  # (joins, 3) record, the last one of a past merged into it, that one's share of it
