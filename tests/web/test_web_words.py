"""Figures in words: laws and edges."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from railnav.web import words


@given(st.floats(1e-6, 1e9))
def test_figures_keep_three_digits(value: float) -> None:
    text = words.figures(value).replace(",", "")
    assert math.isclose(float(text), value, rel_tol=6e-3)


@given(st.floats(1e-4, 1e7))
def test_length_keeps_its_size(value: float) -> None:
    number, unit = words.length(value).split()
    size = float(number.replace(",", "")) * {"mm": 1e-3, "m": 1.0, "km": 1e3}[unit]
    assert math.isclose(size, value, rel_tol=6e-3)


@given(st.floats(0, 1, exclude_min=True, exclude_max=True))
def test_share_is_never_all_or_nothing_unless_it_is(value: float) -> None:
    text = words.share(value)
    assert text not in ("100 %", "0 %")
    assert not text.startswith("100.")
    assert float(text.split()[0]) > 0


@pytest.mark.parametrize(
    "word", [words.figures, words.length, words.exact_length, words.duration, words.share, words.speed]
)
@pytest.mark.parametrize("nothing", [None, math.nan, math.inf])
def test_what_is_missing_is_a_dash(word, nothing) -> None:  # type: ignore[no-untyped-def]
    assert word(nothing) == words.NOTHING


def test_edges() -> None:
    assert words.length(0.0) == "0 m"
    assert words.length(-0.5) == "-0.500 m"
    assert words.figures(0.999999) == "1.00"
    assert words.duration(59.99) == "60.0 s"
    assert words.duration(3599.7) == "1 h 00 min"
    assert words.speed(-10.0) == "-36 km/h"
    assert words.count(0, "run") == "0 runs"
