"""Where the aided filter keeps what: groups of parameters and kinds of measurement, by number."""

from __future__ import annotations

#: Groups of parameters in the order of their columns; all true - estimated.
ANTENNA, AXLE, MOUNTING, TIME, ODOMETER, CLOCK, GYRO_SCALE, FORCE_SCALE, GYRO_BIAS, FORCE_BIAS = range(10)
#: Kinds of measurement.
FIX, BODY, REST, RANGE = range(4)
#: Name and columns of each group.
GROUPS = (
    ("antenna_arm", 3),
    ("axle_arm", 3),
    ("mounting", 2),
    ("time_offset", 1),
    ("odometer_scale", 1),
    ("clock", 2),
    ("gyro_scale", 3),
    ("accelerometer_scale", 3),
    ("gyro_bias", 3),
    ("accelerometer_bias", 3),
)
#: Name of each kind.
KINDS = ("fixes", "vehicle", "rests", "ranges")
