"""Elements of axes that a survey has smoothed: only what its accuracy supports, and sigmas that hold."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from railnav.monitoring.design import Design, design_of_elements
from railnav.monitoring.fitting import Fitted, fit_design
from railnav.monitoring.fitting.surveyed import noise_of_records, noise_of_smoothed
from railnav.track.records import AxisRecords
from tests.monitoring.smoothed_axes import surveyed_axis

FloatArray = NDArray[np.float64]


def line(seed: int, curves: int = 6) -> Design:
    rng = np.random.default_rng(seed)
    kinds, lengths, radii = ["straight"], [float(rng.uniform(800, 2000))], [0.0]
    for _ in range(curves):
        radius = float(rng.choice([400, 600, 800, 1000, 1500, 2500])) * float(rng.choice([-1, 1]))
        transition = float(rng.choice([60, 80, 100, 120]))
        kinds += ["clothoid", "arc", "clothoid", "straight"]
        lengths += [transition, float(rng.uniform(250, 800)), transition, float(rng.uniform(400, 2000))]
        radii += [radius, radius, 0.0, 0.0]
    return design_of_elements("1", kinds, lengths, radii)


def scores(true: Design, found: Fitted) -> list[float]:
    """Errors over sigmas of the radius of the arc found at the middle of each true one; 99 where there is none."""
    plan = found.design.plan
    at = true.project(plan.easting, plan.northing, near=found.design.stations[:-1]).station
    out = []
    for j, kind in enumerate(true.kinds):
        if kind == "arc":
            k = int(np.searchsorted(at, true.stations[j] + 0.5 * true.plan.length[j])) - 1
            arc = found.design.kinds[k] == "arc"
            radius = 1.0 / plan.curvature_start[k] if arc else 0.0
            out.append((radius - 1.0 / true.plan.curvature_start[j]) / found.radius_sigma[k] if arc else 99.0)
    return out


def test_metre_errors_show_arcs_and_straights_and_say_how_sure() -> None:
    z: list[float] = []
    for seed in (1, 2):
        true = line(seed)
        one = fit_design(surveyed_axis(true, seed))
        z += scores(true, one)
        assert one.settled
        assert one.design.plan.length.min() > 5.0  # no stubs
        straights = [k for k in one.design.kinds if k == "straight"]
        assert len(straights) >= 5
        assert len(one.design.kinds) < len(true.kinds)  # transitions that such points hide are not made up
    assert np.abs(z).max() < 4.0  # every arc found
    assert 0.3 < float(np.sqrt(np.mean(np.square(z)))) < 1.7  # 12 of them: 99.8 % of chi-square


def test_a_straight_survey_is_one_straight() -> None:
    true = design_of_elements("1", ["straight"], [8000.0], [0.0])
    assert fit_design(surveyed_axis(true, 5)).design.kinds == ("straight",)


def test_what_a_survey_errs_by_follows_from_its_variances() -> None:
    walk, r, s, length = 4e-5, 8.0, 1.2, 3000.0
    k = np.geomspace(1e-7, 3.0, 20_000)
    spectrum = r + 2.0 * s**2 / length / (k**2 + length**-2)
    left = spectrum / (1.0 + spectrum * k**6 / walk**2) / np.pi * k * np.log(k[1] / k[0])
    told = noise_of_smoothed(walk, *(float(np.sqrt(k**p @ left)) for p in (0, 2, 4)))
    assert told.density == pytest.approx(r, rel=0.15)
    assert told.correlated == pytest.approx(s, rel=0.05)
    assert told.smoothing == pytest.approx((r / walk**2) ** (1.0 / 6.0), rel=0.05)
    assert told.noise(50.0).sigma == pytest.approx(np.sqrt(told.density / 50.0))


def test_records_state_how_an_axis_errs() -> None:
    # fixes of 0.5 m at nodes 20 m apart: r = 5 m^2 m
    h, walk, n = 20.0, 4e-5, 200
    Q = np.array([[h**5 / 20, h**4 / 8, h**3 / 6], [h**4 / 8, h**3 / 3, h**2 / 2], [h**3 / 6, h**2 / 2, h]])
    F = np.array([[1.0, h, 0.5 * h * h], [0.0, 1.0, h], [0.0, 0.0, 1.0]])
    W = np.linalg.inv(np.linalg.cholesky(Q)) / walk
    rows = np.zeros((n, 15))
    upper = np.triu_indices(3)
    own = np.array([[1.0 / 0.5, 0.0, 0.0]])
    left = own.T @ own + np.diag([1e-6, 1e-2, 1e4])
    for j in range(n - 1):
        stacked = np.block([[np.linalg.cholesky(left).T, np.zeros((3, 3))], [-W @ F, W]])
        R = np.linalg.qr(stacked)[1]
        R = R * np.sign(np.diag(R))[:, None]
        rows[j, :6], rows[j, 6:] = R[:3, :3][upper], R[:3, 3:].ravel()
        left = R[3:, 3:].T @ R[3:, 3:] + own.T @ own
    rows[-1, :6] = np.linalg.cholesky(left).T[upper]
    told = noise_of_records(AxisRecords(rows, np.zeros((n, 3, 2)), np.full(n - 1, walk)))
    assert told is not None
    assert told.density == pytest.approx(5.0, rel=0.1)
    assert told.smoothing == pytest.approx((5.0 / walk**2) ** (1.0 / 6.0), rel=0.03)


@pytest.mark.slow
def test_radii_of_smoothed_axes_are_covered_over_seeds() -> None:
    z = np.concatenate(
        [scores(true := line(50 + seed), fit_design(surveyed_axis(true, 50 + seed))) for seed in range(12)]
    )
    assert np.mean(np.abs(z) < 1.96) > 0.84  # of 72: 0.1 % of binomial at 0.95
    assert float(np.sqrt(np.mean(z**2))) < 1.35
