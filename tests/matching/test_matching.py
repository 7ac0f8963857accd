"""Candidates and the packed network: permitted movements by track end, each place once."""

from __future__ import annotations

import numpy as np
import pytest

from railnav.matching import _kernels as paths
from railnav.matching import pack_network, starting_candidates
from railnav.simulation import demo_line


@pytest.fixture(scope="module")
def line():
    return demo_line()


@pytest.fixture(scope="module")
def network(line):
    return pack_network(line)


def test_every_permitted_movement_stands_once_each_way(line, network):
    packed = set()
    for end in range(2 * len(line.track_id)):
        targets = network.move_to[network.move_start[end] : network.move_start[end + 1]].tolist()
        assert len(targets) == len(set(targets))
        packed |= {(end, target) for target in targets}
    wanted = {(2 * a + i, 2 * b + j) for a, i, b, j in line.movements.tolist()}
    assert packed == wanted | {(b, a) for a, b in wanted}


def test_tangents_are_the_derivative_of_position(line, network):
    point, other = np.empty(paths.POINT_SIZE), np.empty(paths.POINT_SIZE)
    for track in (0, 2, 20, 33):
        for s in np.linspace(1.0, network.length[track] - 1.0, 7):
            paths.track_point(network, track, 1, s - 0.25, other)
            paths.track_point(network, track, 1, s + 0.25, point)
            east = (point[paths.P_EAST] - other[paths.P_EAST]) / 0.5
            north = (point[paths.P_NORTH] - other[paths.P_NORTH]) / 0.5
            paths.track_point(network, track, 1, float(s), point)
            assert (east, north) == pytest.approx((point[paths.P_D_EAST], point[paths.P_D_NORTH]), abs=5e-5)


def test_beyond_its_end_a_track_goes_straight_on(network):
    end, beyond = np.empty(paths.POINT_SIZE), np.empty(paths.POINT_SIZE)
    length = float(network.length[2])
    for way, s, far in ((1, length, length + 30.0), (-1, length, length + 30.0), (1, 0.0, -30.0)):
        paths.track_point(network, 2, way, s, end)
        paths.track_point(network, 2, way, far, beyond)
        run = far - s
        assert beyond[paths.P_EAST] == pytest.approx(end[paths.P_EAST] + run * end[paths.P_D_EAST], abs=1e-6)
        assert beyond[paths.P_NORTH] == pytest.approx(end[paths.P_NORTH] + run * end[paths.P_D_NORTH], abs=1e-6)
        assert beyond[paths.P_CURVATURE] == 0.0


def test_both_tracks_of_a_double_line_are_candidates(line, network):
    here = line.at("77R-03", 5000.0)
    found = starting_candidates(line, network, float(here.easting), float(here.northing), within=30.0)
    assert [line.track_id[c.track] for c in found] == ["77R-03", "77L-03"]
    assert found[0].distance == pytest.approx(0.0, abs=1e-3)
    assert found[0].offset == pytest.approx(5000.0, abs=1e-3)
    assert 3.5 < found[1].distance < 5.0


def test_a_joint_is_one_place(line, network):
    """At a node where tracks follow each other a train stands once, not once on each of them."""
    end = line.at("77R-11", line.length("77R-11"))
    found = starting_candidates(line, network, float(end.easting), float(end.northing), within=2.0)
    # the turnout's node: 77R-12 and a crossover leave it, 77R-11 ends there
    (one,) = found
    assert line.track_id[one.track] in {"77R-11", "77R-12"}
    node = line.end_node[line.track_id.index("77R-11")]
    meeting = np.count_nonzero(line.start_node == node) + np.count_nonzero(line.end_node == node)
    assert meeting == 3  # three tracks could have stood in the answer


def test_beyond_the_end_of_the_model_nobody_stands(line, network):
    end = line.at("77R-13", line.length("77R-13"))
    east, north = np.sin(end.grid_bearing), np.cos(end.grid_bearing)

    def names(along):
        found = starting_candidates(
            line,
            network,
            float(end.easting + along * east),
            float(end.northing + along * north),
            within=50.0,
            overhang=10.0,
        )
        return {line.track_id[c.track] for c in found}

    assert "77R-13" in names(5.0)
    assert "77R-13" not in names(20.0)
    assert names(500.0) == set()


def test_at_most_so_many(line, network):
    here = line.at("77S-1", 600.0)
    found = starting_candidates(line, network, float(here.easting), float(here.northing), within=200.0)
    assert len(found) >= 4
    assert [c.distance for c in found] == sorted(c.distance for c in found)
    few = starting_candidates(line, network, float(here.easting), float(here.northing), within=200.0, at_most=2)
    assert few == found[:2]
