"""Published addresses as a column: told apart where one number of kilometres would name two places."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from railnav.io.addresses import addresses
from railnav.simulation import demo_line
from railnav.track.chainage import LineReference, LineReferences


def test_an_over_long_kilometre_has_addresses_of_its_own():
    model = demo_line(spacing=50.0)
    track = model.track_index("77R-03")
    reference = LineReference.of("77", 52, [1000.0, 1054.0, 1000.0])
    lines = LineReferences(
        (reference,), np.full(2, track), np.zeros(2, int), np.array([0.0, 3000.0]), np.array([0.0, 3000.0])
    )
    made = addresses(replace(model, references=lines), np.array([track, track, 0]), np.array([2040.0, 2060.0, 10.0]))
    assert made is not None
    assert made.each() == ["53+1040.0", "54,0+06.0", ""]
    assert addresses(model, np.array([track]), np.array([1.0])) is None
