"""Figures in words: one way to write a length, a time, a share or a speed, on pages, pictures and in the terminal.

A missing value (None or NaN) is written as an en dash.
"""

from __future__ import annotations

import math

NOTHING = "\N{EN DASH}"


def _missing(value: float | None) -> bool:
    return value is None or not math.isfinite(value)


def figures(value: float | None, digits: int = 3) -> str:
    """Write a number with so many significant digits, without an exponent where it is readable without.

    Examples
    --------
    >>> figures(0.012345), figures(1234.5), figures(None)
    ('0.0123', '1,234', '–')
    """
    if value is None or _missing(value):
        return NOTHING
    if value == 0:
        return "0"
    rounded = float(f"{value:.{digits - 1}e}")
    decimals = digits - 1 - math.floor(math.log10(abs(rounded)))
    if decimals > 7:
        return f"{value:.{digits - 1}g}"
    return f"{value:,.{max(decimals, 0)}f}"


def length(value: float | None, digits: int = 3) -> str:
    """Write a length given in metres, in the unit that reads best.

    Examples
    --------
    >>> length(0.0042), length(0.42), length(25312.4), length(float("nan"))
    ('4.20 mm', '0.420 m', '25.3 km', '–')
    """
    if value is None or _missing(value):
        return NOTHING
    size = abs(value)
    if 0 < size < 0.1:
        return f"{figures(value * 1e3, digits)} mm"
    if size >= 10_000:
        return f"{figures(value / 1e3, digits)} km"
    return f"{figures(value, digits)} m"


def exact_length(value: float | None) -> str:
    """Write a length given in metres to the millimetre.

    Examples
    --------
    >>> exact_length(25312.4006)
    '25,312.401 m'
    """
    return NOTHING if value is None or _missing(value) else f"{value:,.3f} m"


def duration(value: float | None) -> str:
    """Write a time given in seconds.

    Examples
    --------
    >>> duration(4.21), duration(754.2), duration(7512.0)
    ('4.2 s', '12 min 34 s', '2 h 05 min')
    """
    if value is None or _missing(value):
        return NOTHING
    if value < 60:
        return f"{value:.1f} s"
    minutes, seconds = divmod(round(value), 60)
    if minutes < 60:
        return f"{minutes} min {seconds:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def share(value: float | None) -> str:
    """Write a share of 1 as a percentage that says 100 % only when it is all.

    Examples
    --------
    >>> share(1.0), share(0.99999), share(0.2512), share(0.0)
    ('100 %', '99.99 %', '25.1 %', '0 %')
    """
    if value is None or _missing(value):
        return NOTHING
    percent = 100 * value
    if percent in (0.0, 100.0):
        return f"{percent:.0f} %"
    if 1 <= percent < 99:
        return f"{percent:.1f} %"
    percent = math.floor(percent * 100) / 100 if percent > 50 else math.ceil(percent * 100) / 100
    return f"{percent:.2f} %"


def speed(value: float | None) -> str:
    """Write a speed given in m/s, in km/h.

    Examples
    --------
    >>> speed(44.444)
    '160 km/h'
    """
    return NOTHING if value is None or _missing(value) else f"{value * 3.6:.0f} km/h"


def count(value: int, one: str, many: str = "") -> str:
    """Write a count with its noun.

    Examples
    --------
    >>> count(1, "run"), count(12345, "fix", "fixes")
    ('1 run', '12,345 fixes')
    """
    return f"{value:,} {one if value == 1 else many or one + 's'}"


def accuracy(value: float) -> str:
    """Write the accuracy of a transformation given in metres; 0 is a conversion without a change of datum.

    Examples
    --------
    >>> accuracy(0.0), accuracy(1.5)
    ('exact, no datum shift', 'accurate to 1.5 m')
    """
    return f"accurate to {length(value, 2)}" if value > 0 else "exact, no datum shift"


def channel(key: str) -> str:
    """Write the key of a channel of track geometry in words.

    Examples
    --------
    >>> channel("longitudinal_level_left_d1"), channel("twist_3m"), channel("gauge")
    ('Longitudinal level left D1', 'Twist 3m', 'Gauge')
    """
    name, _, end = key.replace("_", " ").rpartition(" ")
    if len(end) == 2 and end[0] == "d" and end[1].isdigit():
        end = end.upper()
    return f"{name} {end}".strip().capitalize() if not end[:1].isupper() else f"{name.capitalize()} {end}"
