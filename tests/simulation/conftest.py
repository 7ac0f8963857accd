"""The bundled line, laid out once."""

from __future__ import annotations

import pytest

from railnav.simulation import demo_line
from railnav.track import TrackModel


@pytest.fixture(scope="session")
def line() -> TrackModel:
    return demo_line()
