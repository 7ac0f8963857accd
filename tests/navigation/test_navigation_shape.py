"""What a model's shape is wrong by: a design's, a built model's, and whether a train that is held to it stays honest."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from railnav.evaluation import evaluate, pooled, truth_on
from railnav.matching.network import pack_network
from railnav.navigation import navigate
from railnav.navigation.shape import LEAST_BENT, LEAST_SHIFT, SLOPE, shape_of
from railnav.simulation import SERVICE, Leg, simulate
from railnav.survey import build

LEG = Leg(("77R-03",), start=100.0, finish=9800.0)


@pytest.fixture(scope="module")
def built(line):
    """Three service runs with coloured GNSS errors of 1.5 m over ten kilometres: off by half a metre across."""
    return build([simulate(line, LEG, seed=40 + s, outfit=SERVICE, tunnels=False, run_id=f"r{s}")[0] for s in range(3)])


def in_truth(model, line):
    """Knots of a built model a while from its ends, with the true geometry at their foot points."""
    knots = np.arange(300, len(model.offset) - 300, 7)
    found = [line.locate(float(model.easting[k]), float(model.northing[k]), within=12.0) for k in knots]
    feet = [min((f for f in some if f.track == "77R-03"), key=lambda f: f.distance) for some in found]
    return knots, line.at("77R-03", np.array([f.offset for f in feet]))


def test_a_design_is_exact_in_shape(line):
    network = pack_network(line)
    shape = shape_of(line, network)
    assert np.array_equal(shape.curvature, line.curvature)
    assert (shape.sigma_curvature == LEAST_BENT).all()
    assert (shape.slope, shape.force_noise, shape.shift) == (0.0, 0.0, LEAST_SHIFT)
    assert shape.canted


def test_a_model_that_states_nothing_is_unknown(curve):
    shape = shape_of(curve, pack_network(curve))
    assert np.isnan(shape.sigma_curvature).all()
    assert math.isnan(shape.shift)
    assert not shape_of(
        replace(curve, cant=0.0 * curve.cant), pack_network(replace(curve, cant=0.0 * curve.cant))
    ).canted


def test_the_curvature_of_a_built_line_is_averaged_and_its_sigma_holds(built, line):
    knots, true = in_truth(built, line)
    shape = shape_of(built, pack_network(built))
    raw = built.curvature[knots] - true.curvature
    error = shape.curvature[knots] - true.curvature
    assert np.sqrt(np.mean(error**2)) < min(1e-4, np.sqrt(np.mean(raw**2)))  # a build leaves little noise to average
    z = error / shape.sigma_curvature[knots]
    assert 0.1 < np.mean(z**2) < 1.5
    assert np.mean(np.abs(z) < 3.0) > 0.98
    calm = np.abs(np.gradient(true.curvature)) < 1e-9
    assert np.sqrt(np.mean(np.gradient(shape.curvature)[knots][calm] ** 2)) < 2.0 * SLOPE
    assert not shape.canted
    assert shape.force_noise > 0.01


def test_a_train_held_to_a_built_model_knows_how_wrong_it_is(built, line):
    """Half a metre off across means that curvature, bearing, gradient and cant mislead; believed, they moved the train by 6 m."""
    parts, wrong = [], 0
    for seed in range(90, 96):
        run, truth = simulate(line, LEG, seed=seed, outfit=SERVICE)
        e = evaluate(navigate(run, built), truth_on(built, truth))
        parts.append(e.consistency)
        wrong += e.selection.overconfident
        assert (np.abs(e.along) <= e.protection_level).mean() > 0.999
        assert np.sqrt(np.mean(e.along**2)) < 3.0
    together = pooled(parts)
    assert wrong == 0
    assert together.nees < together.upper
    assert together.coverage[1] > 0.9
