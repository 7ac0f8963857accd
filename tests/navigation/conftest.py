"""Models and runs that the navigation tests share."""

from __future__ import annotations

import numpy as np
import pytest

from railnav.geodesy.grid import choose_frame
from railnav.simulation import demo_line
from railnav.track import TrackSection, assemble, fit_alignment


@pytest.fixture(scope="session")
def line():
    """The bundled line: double track, station, crossovers, branch, tunnels."""
    return demo_line()


@pytest.fixture(scope="session")
def frame():
    """A plane in the middle of Europe."""
    return choose_frame(np.radians([50.0]), np.radians([9.0]))


@pytest.fixture(scope="session")
def curve(frame):
    """One track of 6 km that winds, climbs and is canted: a sine of 400 m amplitude and 3 km length."""
    easting0, northing0, _ = frame.to_grid(np.radians(50.0), np.radians(9.0), 0.0)
    s = np.arange(0.0, 6000.0, 10.0)
    easting = easting0 + s
    northing = northing0 + 400.0 * np.sin(2 * np.pi * s / 3000.0)
    height = 200.0 + 6.0 * np.sin(2 * np.pi * s / 2000.0)
    cant = 0.1 * np.sin(2 * np.pi * s / 3000.0)
    return assemble(frame, [TrackSection("A", fit_alignment(frame, easting, northing, height, cant=cant))])
