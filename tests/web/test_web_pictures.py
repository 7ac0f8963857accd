"""Static pictures: drawn without global state, written whole."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from railnav.errors import RailnavError
from railnav.navigation.solution import Solution
from railnav.track.model import TrackModel
from railnav.truth import Truth
from railnav.web.pictures import save, track_plan

Journey = Callable[[int], tuple[Solution, Truth]]


@pytest.mark.parametrize("what", ["model", "solution", "both"])
@pytest.mark.parametrize("ending", ["png", "svg", "pdf"])
def test_pictures(line: TrackModel, journey: Journey, tmp_path: Path, what: str, ending: str) -> None:
    solution, _ = journey(400)
    figure = track_plan(None if what == "solution" else line, None if what == "model" else solution, title="A line")
    path = tmp_path / f"line.{ending}"
    save(figure, path)
    assert path.read_bytes()[:4] in (b"\x89PNG", b"<?xm", b"%PDF")
    assert path.stat().st_size > 8_000
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    assert "matplotlib.pyplot" not in sys.modules


def test_the_plan_is_to_scale_and_shows_the_line(line: TrackModel) -> None:
    above, below = track_plan(line).axes
    assert above.get_aspect() == 1.0
    drawn = np.concatenate([np.asarray(curve.get_xdata()) for curve in above.lines])
    assert np.isclose(np.ptp(drawn), np.ptp(line.easting) / 1e3, atol=1e-3)
    assert below.get_ylabel() == "height, m"


def test_nothing_to_draw() -> None:
    with pytest.raises(RailnavError, match="nothing to draw"):
        track_plan(None)


def test_without_matplotlib_the_remedy_is_named(line: TrackModel, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(RailnavError, match=r"railnav\[report\]"):
        track_plan(line)
