"""A line, a train on it, and its truth, made up directly: the pages show them, they need no navigator."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from railnav.navigation.solution import Mode, Solution
from railnav.simulation import demo_line
from railnav.track.model import TrackModel
from railnav.truth import Truth


@pytest.fixture(scope="session")
def line() -> TrackModel:
    return demo_line(spacing=10.0)


@pytest.fixture(scope="session")
def journey(line: TrackModel) -> Callable[[int], tuple[Solution, Truth]]:
    """Make a solution of so many epochs along the right main track, with a tunnel's coasting and an error of its own size."""

    def make(epochs: int) -> tuple[Solution, Truth]:
        generator = np.random.default_rng(5)
        tracks = np.array([k for k, name in enumerate(line.track_id) if name.startswith("77R")])
        begin = np.concatenate([[0.0], np.cumsum(line.lengths[tracks])])
        time = np.linspace(0.0, 1200.0, epochs)
        distance = np.linspace(20.0, begin[-1] - 20.0, epochs)
        piece = np.searchsorted(begin, distance, side="right") - 1
        track, offset = tracks[piece], distance - begin[piece]
        points = line.at(track, offset)
        latitude, longitude, height = line.frame.to_geodetic(points.easting, points.northing, points.height)
        speed = np.full(epochs, distance[-1] / 1200.0)
        mode = np.where((distance > 6300) & (distance < 7500), Mode.COASTING, Mode.TRACKING).astype(np.int64)
        mode[: max(epochs // 200, 1)] = Mode.INITIALISING
        sigma = np.where(mode == Mode.COASTING, 2.0, 0.5) * (1.0 + 0.1 * generator.random(epochs))
        solution = Solution(
            track_id=line.track_id,
            line=line.line,
            time=time,
            track=track,
            offset=np.clip(offset + 0.3 * sigma * np.sin(time / 20.0), 0.0, line.lengths[track]),
            chainage=points.chainage,
            easting=points.easting,
            northing=points.northing,
            height=points.height,
            latitude=latitude,
            longitude=longitude,
            ellipsoidal_height=height,
            heading=points.heading,
            speed=speed,
            acceleration=np.zeros(epochs),
            sigma_along=sigma,
            sigma_cross=np.full(epochs, 0.02),
            protection_level_along=4.0 * sigma,
            track_probability=np.ones(epochs),
            mode=mode,
            running_direction=np.ones(epochs, np.int64),
            run_id="<b>service & more</b>",
            start="2026-05-04T08:00:00Z",
            crs_wkt=line.frame.crs_wkt,
        )
        truth = Truth(
            line.track_id, time, track, offset, speed, latitude, longitude, height, points.heading, simulated=True
        )
        return solution, truth

    return make
