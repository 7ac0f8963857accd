"""Alignment fitting: elements, their sigmas, and what the points do not tell."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

from railnav.errors import RailnavError, TrackError
from railnav.monitoring.design import Design, design_of_elements
from railnav.monitoring.fitting import Axis, Fitted, axis_of_points, fit_design
from railnav.monitoring.fitting.laws import DECIDED
from railnav.monitoring.fitting.profile import circular
from railnav.monitoring.fitting.rounding import LENGTH_STEPS, round_value
from railnav.monitoring.fitting.segmentation import Noise
from railnav.monitoring.fitting.waves import Waves
from railnav.track.elements import BLOSS, CLOTHOID, Cant, Gradients

FloatArray = NDArray[np.float64]
CURVE = design_of_elements(
    "1",
    ["straight", "clothoid", "arc", "clothoid", "straight"],
    [150.0, 80.0, 250.0, 80.0, 150.0],
    [0, 600.0, 600.0, 0, 0],
)


def fitted(
    design: Design, sigma: float, seed: int, *, spacing: float = 1.0, waves: float = 0.0, **more: object
) -> Fitted:
    station = np.arange(design.start, design.start + design.length, spacing)
    here = design.at(station)
    rng = np.random.default_rng(seed)

    def noise() -> FloatArray:
        if not waves:
            return rng.normal(0.0, sigma, len(station))
        keep = np.exp(-spacing / waves)
        drive = rng.normal(0.0, sigma * np.sqrt(1 - keep**2), len(station))
        drive[0] = rng.normal(0.0, sigma)
        return np.asarray(lfilter([1.0], [1.0, -keep], drive))

    return fit_design(axis_of_points("1", here.easting + noise(), here.northing + noise()), **more)  # type: ignore[arg-type]


def test_the_curve_of_the_specification_over_seeds() -> None:
    # R = 600 m, L = 80 m, 10 mm at 1 m: radius within 0.1 m, transition within 0.4 m, axis within 1.5 mm RMS
    station = np.arange(0.0, CURVE.length)
    here = CURVE.at(station)
    radius, length, axis, z = [], [], [], []
    for seed in range(5):
        one = fitted(CURVE, 0.010, seed)
        assert one.design.kinds == CURVE.kinds
        radius.append(1.0 / one.design.plan.curvature_start[2] - 600.0)
        length.append(one.design.plan.length[1] - 80.0)
        z += [radius[-1] / one.radius_sigma[2], length[-1] / one.length_sigma[1]]
        axis.append(np.sqrt(np.mean(one.design.project(here.easting, here.northing, near=station).cross ** 2)))
    assert np.sqrt(np.mean(np.square(radius))) < 0.1
    assert np.sqrt(np.mean(np.square(length))) < 0.4
    assert np.sqrt(np.mean(np.square(axis))) < 1.5e-3
    assert 0.4 < np.sqrt(np.mean(np.square(z))) < 1.75  # 10 of them: chi-square 99.9 %


def test_waves_of_the_noise_become_no_elements_and_widen_sigmas() -> None:
    plain = fitted(CURVE, 0.010, 3)
    wavy = fitted(CURVE, 0.010, 3, waves=10.0)
    assert wavy.design.kinds == CURVE.kinds
    assert wavy.noise.correlated > 0.004
    assert wavy.radius_sigma[2] > 2.0 * plain.radius_sigma[2]
    assert abs(1.0 / wavy.design.plan.curvature_start[2] - 600.0) < 4.0 * wavy.radius_sigma[2]


def test_joints_are_tangent_and_elements_close() -> None:
    one = fitted(CURVE, 0.010, 0)
    assert np.abs(one.design.gap).max() < 1e-6
    plan = one.design.plan
    assert plan.curvature_end[1] == plan.curvature_start[2] == plan.curvature_end[2]
    assert plan.curvature_start[1] == 0.0


def test_a_turned_and_mirrored_axis_gives_the_same_elements() -> None:
    station = np.arange(0.0, CURVE.length)
    here = CURVE.at(station)
    rng = np.random.default_rng(1)
    east, north = here.easting + rng.normal(0, 0.01, 710), here.northing + rng.normal(0, 0.01, 710)
    first = fit_design(axis_of_points("1", east, north)).design
    turned = fit_design(axis_of_points("1", 4e6 + 0.6 * east + 0.8 * north, 5e6 - 0.8 * east + 0.6 * north)).design
    mirrored = fit_design(axis_of_points("1", -east, north)).design
    assert np.allclose(first.plan.length, turned.plan.length, atol=2e-3)
    assert np.allclose(first.plan.curvature_start, -mirrored.plan.curvature_start, atol=1e-8)


def test_running_the_other_way_reverses_elements() -> None:
    station = np.arange(0.0, CURVE.length)
    here = CURVE.at(station)
    rng = np.random.default_rng(2)
    east, north = here.easting + rng.normal(0, 0.005, 710), here.northing + rng.normal(0, 0.005, 710)
    first, back = (fit_design(axis_of_points("1", e, n)).design for e, n in ((east, north), (east[::-1], north[::-1])))
    assert np.allclose(first.plan.length[1:4], back.plan.length[1:4][::-1], atol=2e-2)
    assert first.plan.curvature_start[2] == pytest.approx(-back.plan.curvature_start[2], rel=1e-5)


def test_curvature_that_jumps_is_no_transition() -> None:
    tram = design_of_elements(
        "1", ["straight", "arc", "straight", "arc", "straight"], [60.0, 40.0, 30.0, 25.0, 60.0], [0, 50.0, 0, -80.0, 0]
    )
    one = fitted(tram, 0.003, 0)
    assert one.design.kinds == tram.kinds
    assert np.abs(one.design.stations[1:-1] - tram.stations[1:-1]).max() < 0.3


def test_a_curve_and_its_opposite_meet_where_it_is_straight() -> None:
    turning = design_of_elements(
        "1",
        ["straight", "clothoid", "arc", "clothoid", "clothoid", "arc", "clothoid", "straight"],
        [100.0, 60.0, 120.0, 60.0, 60.0, 120.0, 60.0, 100.0],
        [0, 400.0, 400.0, 0, -400.0, -400.0, 0, 0],
    )
    one = fitted(turning, 0.004, 0)
    assert one.design.kinds == turning.kinds
    assert (one.design.plan.curvature_start * one.design.plan.curvature_end >= 0.0).all()
    assert np.abs(one.design.stations[1:-1] - turning.stations[1:-1]).max() < 1.0


def test_gross_errors_weigh_little() -> None:
    station = np.arange(0.0, CURVE.length)
    here = CURVE.at(station)
    rng = np.random.default_rng(4)
    east, north = here.easting + rng.normal(0, 0.01, 710), here.northing + rng.normal(0, 0.01, 710)
    for row in (60, 200, 333, 480, 650):
        east[row] += 0.3
    found = fit_design(axis_of_points("1", east, north))
    assert found.design.kinds == CURVE.kinds
    assert abs(1.0 / found.design.plan.curvature_start[2] - 600.0) < 0.5


def test_profile_and_cant_are_recovered() -> None:
    profile = Gradients(
        *(
            np.array(v, float)
            for v in (
                [-np.inf, 300.0, 400.0],
                [0.0, 300.0, 400.0],
                [100.0, 101.5, 101.75],
                [0.005, 0.005, 0.0],
                [0, -2.5e-5, 0],
                [0, 0, 0],
            )
        )
    )
    cant = Cant(
        np.array([0.0, 150.0, 230.0, 480.0, 560.0, 710.0]),
        np.array([0, 0, 0.08, 0.08, 0.0]),
        np.array([0, 0.08, 0.08, 0.0, 0]),
        np.full(5, CLOTHOID),
    )
    station = np.arange(0.0, CURVE.length)
    here = CURVE.at(station)
    rng = np.random.default_rng(5)
    found = fit_design(
        axis_of_points(
            "1",
            here.easting + rng.normal(0, 0.005, 710),
            here.northing + rng.normal(0, 0.005, 710),
            profile(station) + rng.normal(0, 0.004, 710),
            cant=cant.at(station) + rng.normal(0, 0.0005, 710),
        )
    )
    again = found.design.at(np.minimum(station, found.design.length))
    assert found.design.profile is not None
    assert found.design.cant is not None
    assert len(found.design.profile.begin) == 3
    assert np.abs(found.design.profile.begin[1:] - [300.0, 400.0]).max() < 6.0
    assert np.sqrt(np.mean((again.height - profile(station)) ** 2)) < 1e-3
    assert len(found.design.cant.start) == 5
    assert np.abs(found.design.cant.edges[1:-1] - [150.0, 230.0, 480.0, 560.0]).max() < 0.5
    assert found.profile is not None
    assert np.isfinite(found.profile.sigma[1:, :2]).all()


def test_values_are_rounded_only_as_far_as_they_are_known() -> None:
    one = fitted(CURVE, 0.010, 2, rounded=True)
    assert 1.0 / one.design.plan.curvature_start[2] == pytest.approx(600.0, abs=1e-6)
    assert one.design.plan.length[[1, 3]] == pytest.approx([80.0, 80.0], abs=1e-9)
    assert round_value(80.2, 9.0, LENGTH_STEPS) is None


def test_a_radius_on_the_ground_is_rounded_there() -> None:
    station = np.arange(0.0, CURVE.length)
    here = CURVE.at(station)
    rng = np.random.default_rng(6)
    scale = 1.0006
    axis = axis_of_points(
        "1",
        scale * here.easting + rng.normal(0, 0.005, 710),
        scale * here.northing + rng.normal(0, 0.005, 710),
        scale=scale,
    )
    found = fit_design(axis, rounded=True, on_ground=True)
    assert 1.0 / found.design.plan.curvature_start[2] == pytest.approx(600.0 * scale, abs=1e-6)


def test_a_circle_that_closes() -> None:
    ring = design_of_elements("1", ["arc"], [2.0 * np.pi * 150.0 - 1.0], [150.0])
    one = fitted(ring, 0.005, 0)
    assert one.design.kinds == ("arc",)
    assert 1.0 / one.design.plan.curvature_start[0] == pytest.approx(150.0, abs=0.01)


def test_a_straight_is_one_straight() -> None:
    one = fitted(design_of_elements("1", ["straight"], [2000.0], [0.0], grid_bearing=0.7), 0.010, 0)
    assert one.design.kinds == ("straight",)


def test_metre_noise_is_said_and_shows_long_curves_only() -> None:
    one = fitted(CURVE, 0.5, 0, spacing=10.0)
    assert len(one.design.kinds) <= 5
    assert any("shows curves longer than about" in line for line in one.warnings)
    assert one.shortest > 50.0


def test_bad_axes_are_refused() -> None:
    s = np.arange(0.0, 100.0)
    with pytest.raises(TrackError, match="too short to find elements in"):
        axis_of_points("1", s[:5], s[:5])
    with pytest.raises(TrackError, match="point 4 of the northings is not finite"):
        axis_of_points("1", s, np.where(s == 3, np.nan, s))
    with pytest.raises(TrackError, match="99 northings for 100 points"):
        axis_of_points("1", s, s[:-1])
    rng = np.random.default_rng(0)
    with pytest.raises(TrackError, match="turns back"):
        axis_of_points("1", s + rng.normal(0, 5.0, 100), s + rng.normal(0, 5.0, 100))
    with pytest.raises(RailnavError, match="give metres"):
        fit_design(axis_of_points("1", 0 * s, s), sigma=-1.0)


def test_inputs_are_left_alone() -> None:
    station = np.arange(0.0, CURVE.length)
    here = CURVE.at(station)
    for array in (here.easting, here.northing):
        array.flags.writeable = False
    axis = axis_of_points("1", here.easting, here.northing)
    assert fit_design(axis).design.kinds == CURVE.kinds


def smoothed(design: Design, seed: int, *, size: float = 0.006, length: float = 80.0) -> Axis:
    """An axis whose points err as those of a built model do: by smooth waves that they state."""
    station = np.arange(0.0, design.length, 1.0)
    here = design.at(station)
    rng = np.random.default_rng(seed)
    noise = Noise(0.0, size, length, True)
    distance = station[:, None] - station
    root = np.linalg.cholesky(noise.correlation(distance) + 1e-9 * np.eye(len(station)))
    off = size * (root @ rng.normal(size=len(station)))
    east = here.easting + off * np.cos(here.grid_bearing)
    north = here.northing - off * np.sin(here.grid_bearing)
    return axis_of_points("1", east, north, stated=np.full((len(station), 2), size))


def test_straights_of_a_smoothed_model_are_straights() -> None:
    line = design_of_elements(
        "1",
        ["straight", "clothoid", "arc", "clothoid", "straight"],
        [500.0, 120.0, 300.0, 120.0, 500.0],
        [0, 700.0, 700.0, 0, 0],
    )
    one = fit_design(smoothed(line, 1))
    assert one.noise.smooth
    assert one.settled
    assert one.design.kinds == line.kinds
    assert abs(1.0 / one.design.plan.curvature_start[2] - 700.0) < 4.0 * one.radius_sigma[2]
    assert (np.abs(one.design.stations[1:-1] - line.stations[1:-1]) < 4.0 * one.station_sigma[1:]).all()
    assert not one.law.told  # smoothed points without cant
    assert "undecided" in one.law.said


@pytest.mark.parametrize("smooth", [False, True])
def test_waves_as_unknowns_are_the_whole_covariance(smooth: bool) -> None:
    along = np.cumsum(np.random.default_rng(0).uniform(0.5, 1.5, 60))
    noise = Noise(0.01, 0.03, 7.0, smooth)
    waves = Waves(along, noise)
    off = np.random.default_rng(1).normal(size=60)
    wave = waves.likeliest(off, np.full(60, 1e4))
    square = np.sum(((off - waves.at(wave)) / 0.01) ** 2) + waves.squares(wave).sum()
    whole = 1e-4 * np.eye(60) + 9e-4 * noise.correlation(along[:, None] - along)
    assert square == pytest.approx(off @ np.linalg.solve(whole, off), rel=1e-7)


def test_the_law_of_transitions_has_a_probability() -> None:
    bloss = design_of_elements(
        "1",
        ["straight", "bloss", "arc", "bloss", "straight"],
        [150.0, 100.0, 250.0, 100.0, 150.0],
        [0, 600.0, 600.0, 0, 0],
    )
    sharp = fitted(bloss, 0.002, 0)
    assert sum(sharp.law.probability.values()) == pytest.approx(1.0)
    assert sharp.law.probability[BLOSS] > sharp.law.probability[CLOTHOID]
    assert abs(sharp.design.plan.length[1] - 100.0) < 3.0 * sharp.length_sigma[1]
    blunt = fitted(bloss, 0.030, 0)
    assert blunt.law.probability[CLOTHOID] < DECIDED
    assert "undecided" in blunt.law.said
    assert abs(blunt.design.plan.length[1] - 100.0) < 3.0 * blunt.length_sigma[1]  # the sigma knows that the law is not


def test_cant_follows_the_transitions_and_their_law() -> None:
    bloss = design_of_elements(
        "1",
        ["straight", "bloss", "arc", "bloss", "straight"],
        [150.0, 100.0, 250.0, 100.0, 150.0],
        [0, 600.0, 600.0, 0, 0],
    )
    station = np.arange(0.0, bloss.length)
    here = bloss.at(station)
    rng = np.random.default_rng(3)
    cant = Cant(
        np.array([0.0, 150.0, 250.0, 500.0, 600.0, 750.0]),
        np.array([0, 0, 0.1, 0.1, 0.0]),
        np.array([0, 0.1, 0.1, 0.0, 0]),
        np.full(5, BLOSS),
    )
    count = len(station)
    found = fit_design(
        axis_of_points(
            "1",
            here.easting + rng.normal(0, 0.002, count),
            here.northing + rng.normal(0, 0.002, count),
            cant=cant.at(station) + rng.normal(0, 0.0005, count),
        ),
        laws=(BLOSS,),
    )
    assert found.design.kinds == bloss.kinds
    assert found.cant is not None
    assert found.design.cant is not None
    assert found.cant.of_plan == found.cant.ramps == 2
    assert found.design.cant.kind[[1, 3]].tolist() == [BLOSS, BLOSS]
    assert found.design.cant.edges == pytest.approx(found.design.plan.edges, abs=2.0)
    assert np.abs(found.design.cant.edges[1:-1] - found.design.plan.edges[1:-1]).max() < 1e-9
    assert np.sqrt(np.mean((found.design.at(found.station).cant - cant.at(found.station)) ** 2)) < 5e-4


def test_vertical_circles_on_request() -> None:
    parabola = Gradients(
        np.array([-np.inf, 300.0, 400.0]),
        np.array([0.0, 300.0, 400.0]),
        np.array([100.0, 101.5, 101.75]),
        np.array([0.005, 0.005, 0.0]),
        np.array([0, -2.5e-5, 0]),
        np.zeros(3),
    )
    circle = circular(parabola, 700.0)
    assert circle.radius[1] == pytest.approx(-20_000.0, rel=1e-4)
    at = np.linspace(0.0, 700.0, 141)
    assert np.abs(circle(at) - parabola(at)).max() < 1e-5
    assert np.abs(circle(at, 1) - parabola(at, 1)).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("waves", [0.0, 10.0])
def test_sigmas_are_honest_over_seeds(waves: float) -> None:
    z = []
    for seed in range(20):
        one = fitted(CURVE, 0.010, 100 + seed, waves=waves, laws=())
        if one.design.kinds == CURVE.kinds:
            z.append(
                [
                    (1.0 / one.design.plan.curvature_start[2] - 600.0) / one.radius_sigma[2],
                    (one.design.plan.length[1] - 80.0) / one.length_sigma[1],
                    (one.design.plan.length[3] - 80.0) / one.length_sigma[3],
                ]
            )
    square = float(np.mean(np.square(z)))
    assert len(z) >= 18
    assert 0.45 < square < 1.75  # about 60 values, half of them correlated: 99.9 % of chi-square
