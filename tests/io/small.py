"""A small model with everything in it: heights and none, covariance and none, a turnout, mile posts, awkward names."""

from __future__ import annotations

from functools import cache

import numpy as np

from railnav.geodesy.grid import choose_frame
from railnav.track.model import MilePosts, NodeKind, Nodes, TrackModel


@cache
def frame_of(latitude_deg, longitude_deg):
    return choose_frame(np.radians(latitude_deg), np.radians(longitude_deg))


def make_model(knots=(12, 7, 5), *, seed=3):
    random = np.random.default_rng(seed)
    start = np.concatenate([[0], np.cumsum(knots)])
    total = int(start[-1])
    offset = np.concatenate([np.arange(count) * 1.000001 for count in knots])
    height = np.concatenate([np.full(knots[0], np.nan), random.normal(120, 1, total - knots[0])])
    covariance = random.uniform(1e-4, 1e-3, (total, 6))
    covariance[start[1] : start[2]] = np.nan
    easting, northing = 4_500_000 + random.uniform(0, 30, total), 5_260_000 + random.uniform(0, 30, total)
    ends = np.array([0, start[1] - 1, start[2] - 1, start[3] - 1])
    return TrackModel(
        frame=frame_of(47.5, 21.0),
        track_id=("80R-01", "Gleis 3, 'süd'", '"Ж" -- 駅'),
        line=("80", "80", ""),
        name=("", "loop\nwest", "Füzesabony"),
        start_node=np.array([0, 1, 1]),
        end_node=np.array([1, 2, 3]),
        knot_start=start,
        offset=offset,
        easting=easting,
        northing=northing,
        height=height,
        grid_bearing=random.uniform(-7, 7, total),
        curvature=random.normal(0, 1e-3, total),
        gradient=random.normal(0, 1e-2, total),
        cant=np.zeros(total),
        scale=1 + random.normal(0, 1e-6, total),
        covariance_g=covariance,
        nodes=Nodes(
            ("A", "turnout 'W1'", "B", "C"),
            np.array([NodeKind.END_OF_MODEL, NodeKind.TURNOUT, NodeKind.BUFFER_STOP, NodeKind.END_OF_MODEL]),
            easting[ends],
            northing[ends],
            np.array([np.nan, 120.5, 121.25, 0.1]),
        ),
        movements=np.array([[0, 1, 1, 0], [0, 1, 2, 0]]),
        mileposts=MilePosts(
            np.array([0, 0, 2]), np.array([0.0, 7.3, 1 / 3]), np.array([117_000.125, 117_007.0, -153.1])
        ),
        provenance={"runs": ["a", "ü"], "build": {"rejected": 3, "sigma": 0.1 + 0.2}, "none": None},
    )
