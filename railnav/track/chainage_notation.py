"""Chainage as railways write it: German, Russian, Swiss and British notations, parsed and printed."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Literal

from railnav.errors import TrackError
from railnav.track.chainage import CHAIN, MILE, ChainageAddress

Notation = Literal["german", "russian", "swiss", "british"]

_NUMBER = r"\d+(?:[.,]\d+)?"
_SIGN = r"(?P<sign>[-\u2212\u2013]?)"
_PATTERNS: dict[str, re.Pattern[str]] = {
    # 12,3+45  53+1054  -0,4+12  km 12,345
    "german": re.compile(
        rf"^(?:km\s*)?{_SIGN}\s*(?P<km>\d+)(?:,(?P<part>\d{{1,6}}))?(?:\s*\+\s*(?P<metre>{_NUMBER}))?\s*$", re.I
    ),
    # 1254 km PK 7 +32, also in Cyrillic letters
    "russian": re.compile(
        rf"^{_SIGN}\s*(?P<km>\d+)\s*(?:km|\u043a\u043c)\.?\s*(?:(?:pk|\u043f\u043a)\.?\s*(?P<picket>\d+)"
        rf"(?:\s*\+\s*(?P<metre>{_NUMBER}))?)?\s*$",
        re.I,
    ),
    # km 12.345
    "swiss": re.compile(
        rf"^(?:km\s*)?{_SIGN}\s*(?P<km>\d+)(?:\.(?P<part>\d{{1,6}}))?(?:\s*\+\s*(?P<metre>{_NUMBER}))?\s*$", re.I
    ),
    # 12 m 34 ch, 12m 34.5ch, 12 miles 567 yards
    "british": re.compile(
        rf"^{_SIGN}\s*(?P<km>\d+)\s*(?:m|miles?)\.?\s*(?:(?P<chains>{_NUMBER})\s*(?:ch|chains?|c)\.?)?"
        rf"\s*(?:(?P<yards>{_NUMBER})\s*(?:y|yds?|yards?)\.?)?\s*$",
        re.I,
    ),
}
#: An example of each, for messages.
EXAMPLES = {"german": "12,3+45", "russian": "1254 km PK 7 +32", "swiss": "12.345", "british": "12 m 34 ch"}
_YARD = CHAIN / 22.0


def _float(text: str | None) -> float:
    return float(text.replace(",", ".")) if text else 0.0


def parse_chainage(text: str, notation: Notation | None = None) -> ChainageAddress:
    """Read a published address.

    Parameters
    ----------
    text : str
        "12,3+45", "53+1054", "-0,4" (German); "1254 km PK 7 +32" (Russian: picket 7 is the seventh hundred metres); "12.345"
        (Swiss, and plain decimal kilometres); "12 m 34 ch", "12 m 567 y" (British).
    notation : {"german", "russian", "swiss", "british"}, optional
        Without it the one that the text is written in; the four do not overlap but for whole kilometres, which mean the same.

    Returns
    -------
    ChainageAddress
        A negative kilometre counts upwards like all others: -0,4 is metre 600 of kilometre -1.

    Raises
    ------
    TrackError
        The text is no address.

    Examples
    --------
    >>> parse_chainage("12,3+45"), parse_chainage("1254 km PK 7 +32")
    (ChainageAddress(label=12, metre=345.0), ChainageAddress(label=1254, metre=632.0))
    """
    plain = " ".join(text.split())
    for name in (notation,) if notation else ("german", "swiss", "russian", "british"):
        match = _PATTERNS[name].match(plain)
        if match is None:
            continue
        return _READERS[name](match)
    ways = f"as in {EXAMPLES[notation]!r}" if notation else f"as in {', '.join(map(repr, EXAMPLES.values()))}"
    raise TrackError(f"{text[:40]!r} is no chainage; write it {ways}")


def _read_decimal(match: re.Match[str]) -> ChainageAddress:
    km, part = int(match["km"]), match["part"] or ""
    inside = int(part) * 1000.0 / 10 ** len(part) if part else 0.0
    if not match["sign"]:
        return ChainageAddress(km, inside + _float(match["metre"]))
    value = -(km * 1000.0 + inside) + _float(match["metre"])  # -0,4+12 lies 12 m beyond -0,4
    label = math.floor(value / 1000.0)
    return ChainageAddress(label, value - label * 1000.0)


def _read_russian(match: re.Match[str]) -> ChainageAddress:
    picket = int(match["picket"]) if match["picket"] else 1
    if picket < 1:
        raise TrackError(f"picket {picket} is none; the first hundred metres of a kilometre are picket 1")
    label = -int(match["km"]) if match["sign"] else int(match["km"])
    return ChainageAddress(label, (picket - 1) * 100.0 + _float(match["metre"]))


def _read_british(match: re.Match[str]) -> ChainageAddress:
    metre = round(_float(match["chains"]) * CHAIN + _float(match["yards"]) * _YARD, 9)
    if not match["sign"]:
        return ChainageAddress(int(match["km"]), metre)
    value = -(int(match["km"]) * MILE + metre)
    label = math.floor(value / MILE)
    return ChainageAddress(label, value - label * MILE)


_READERS: dict[str, Callable[[re.Match[str]], ChainageAddress]] = {
    "german": _read_decimal,
    "swiss": _read_decimal,
    "russian": _read_russian,
    "british": _read_british,
}


def format_chainage(address: ChainageAddress, notation: Notation = "german", *, decimals: int = 0) -> str:
    """Write a published address.

    Parameters
    ----------
    address : ChainageAddress
        What to write.
    notation : {"german", "russian", "swiss", "british"}
        How.
    decimals : int
        Of the metre (of the chain for British).

    Returns
    -------
    str
        What `parse_chainage` reads back to the same address, to half of the last decimal.

    Raises
    ------
    TrackError
        An address that is not finite, or before its kilometre in a notation that cannot say so.

    Examples
    --------
    >>> format_chainage(ChainageAddress(53, 1054.0)), format_chainage(ChainageAddress(1254, 632.0), "russian")
    ('53+1054', '1254 km PK 7 +32')
    >>> format_chainage(ChainageAddress(12, 345.0), "swiss"), format_chainage(ChainageAddress(12, 34 * 20.1168), "british")
    ('12.345', '12 m 34 ch')
    """
    if notation not in EXAMPLES:
        raise TrackError(f"no notation {notation!r}; there are {', '.join(EXAMPLES)}")
    label, metre = address.label, address.metre
    if not math.isfinite(metre) or metre < 0.0:
        raise TrackError(f"kilometre {label}, metre {metre:g} lies before its kilometre and has no published form")
    if notation == "british":
        return _british(label, metre, decimals)
    metre = round(metre, decimals)
    if notation == "russian":
        picket = int(metre // 100.0) + 1
        rest = round(metre - (picket - 1) * 100.0, decimals)
        return f"{label} km PK {picket} +{rest:.{decimals}f}"
    if metre >= 1000.0:
        return f"{label}+{metre:.{decimals}f}"
    if label < 0:
        return _negative(label, metre, notation, decimals)
    if notation == "swiss":
        return (
            f"{label}.{metre:0{4 + decimals if decimals else 3}.{decimals}f}".replace(".", "\0", 1)
            .replace(".", "")
            .replace("\0", ".")
        )
    hundred = int(metre // 100.0)
    rest = round(metre - hundred * 100.0, decimals)
    return f"{label},{hundred}+{rest:0{3 + decimals if decimals else 2}.{decimals}f}"


def _negative(label: int, metre: float, notation: Notation, decimals: int) -> str:
    """Below zero: the hectometre before it, and metres counted on from there."""
    value = label * 1000.0 + metre
    if notation == "swiss":
        km, rest = divmod(round(-value, decimals), 1000.0)
        digits = f"{rest:0{4 + decimals if decimals else 3}.{decimals}f}".replace(".", "")
        return f"-{int(km)}.{digits}"
    hundred = math.floor(round(value, decimals) / 100.0)
    rest = round(value - hundred * 100.0, decimals)
    km, tenth = divmod(-hundred, 10)
    return f"-{km},{tenth}+{rest:0{3 + decimals if decimals else 2}.{decimals}f}"


def _british(label: int, metre: float, decimals: int) -> str:
    if label < 0:
        value = round(-(label * MILE + metre) / CHAIN, decimals)
        miles, chains = divmod(value, 80.0)
        return f"-{int(miles)} m {chains:.{decimals}f} ch"
    return f"{label} m {metre / CHAIN:.{decimals}f} ch"
