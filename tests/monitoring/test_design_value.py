"""A design: evaluated, projected onto, refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from railnav.errors import TrackError
from railnav.monitoring.design import Design, design_of_elements
from railnav.track.elements import CUBIC, KIND_NAMES, Gradients, Plan, integrate, law, turn

TRANSITIONS = [name for name in KIND_NAMES if name not in ("straight", "arc")]


def spread(kind: str, *, easting: float = 0.0, northing: float = 0.0, grid_bearing: float = 0.0) -> Design:
    return design_of_elements(
        "1",
        ["straight", kind, "arc", kind, "straight"],
        [100.0, 80.0, 200.0, 60.0, 50.0],
        [0, -600.0, -600.0, 0, 0],
        easting=easting,
        northing=northing,
        grid_bearing=grid_bearing,
    )


@pytest.mark.parametrize("kind", ["clothoid", "bloss", "cosine", "sine", "helmert"])
def test_position_is_that_of_an_adaptive_quadrature(kind: str) -> None:
    number = KIND_NAMES.index(kind)

    def bearing(s: float) -> float:
        _, whole = law(np.array([number]), np.array([s / 80.0]))
        return float(-80.0 / 600.0 * whole[0])

    half = [40.0]  # where the law of Helmert breaks
    east = quad(lambda s: np.sin(bearing(s)), 0, 80, epsabs=1e-13, epsrel=1e-13, points=half)[0]
    north = quad(lambda s: np.cos(bearing(s)), 0, 80, epsabs=1e-13, epsrel=1e-13, points=half)[0]
    here = spread(kind).at(180.0)
    assert float(here.easting) == pytest.approx(east, abs=1e-9)
    assert float(here.northing) == pytest.approx(100.0 + north, abs=1e-9)


@pytest.mark.parametrize(
    ("kind", "offset"),
    [
        ("clothoid", 2.776),
        ("bloss", 2.499),
        ("cosine", 2.477),
        ("helmert", 2.429),
        ("sine", 2.354),
        ("viennese", 2.314),
    ],
)
def test_end_offsets_are_those_of_the_specification(kind: str, offset: float) -> None:
    # track_geometry.md 3.1: L = 100 m, R = 600 m; the Viennese bend without its term of cant
    here = design_of_elements("1", [kind, "arc"], [100.0, 10.0], [600.0, 600.0]).at(100.0)
    assert float(here.easting) == pytest.approx(offset, abs=6e-4)


def test_a_cubic_parabola_is_one_and_ends_with_its_radius() -> None:
    plan = Plan(*(np.array([v]) for v in (60.0, CUBIC, 0.0, 1.0 / 300.0, 0.0, 0.0, 0.0, 0.0)))
    plan = Plan(
        plan.length,
        plan.kind.astype(np.int64),
        *(
            getattr(plan, n)
            for n in ("curvature_start", "curvature_end", "easting", "northing", "grid_bearing", "sway")
        ),
    )
    points, bearing = integrate(plan, np.linspace(5.0, 60.0, 12))
    ratio = points[:, 0] / points[:, 1] ** 3
    assert np.ptp(ratio) / ratio[0] < 1e-12
    assert np.allclose(np.tan(bearing), 3.0 * ratio[0] * points[:, 1] ** 2, rtol=1e-12)
    step = 1e-4
    last = turn(plan, np.zeros(2, np.int64), np.array([60.0 - step, 60.0]))
    assert np.diff(last)[0] / step == pytest.approx(1.0 / 300.0, rel=1e-5)


def test_cubic_parabolas_refuse_what_they_cannot_be() -> None:
    with pytest.raises(TrackError, match="between two arcs"):
        design_of_elements("1", ["arc", "cubic-parabola", "arc"], [10.0, 60.0, 10.0], [300.0, 600.0, 600.0])
    with pytest.raises(TrackError, match="too long for its radius"):
        design_of_elements("1", ["cubic-parabola", "arc"], [60.0, 10.0], [50.0, 50.0])


@pytest.mark.parametrize("kind", TRANSITIONS)
@given(station=st.floats(0.0, 490.0), cross=st.floats(-20.0, 20.0), bearing=st.floats(-3.1, 3.1))
@settings(max_examples=15, deadline=None)
def test_feet_of_points_beside_a_design_are_found(kind: str, station: float, cross: float, bearing: float) -> None:
    design = spread(kind, easting=3_462_825.0, northing=5_481_774.0, grid_bearing=bearing)
    here = design.at(station)
    east = here.easting + cross * np.cos(here.grid_bearing)
    north = here.northing - cross * np.sin(here.grid_bearing)
    foot = design.project(east, north)
    assert foot.station[0] == pytest.approx(station, abs=2e-8)
    assert foot.cross[0] == pytest.approx(cross, abs=2e-8)


def test_reversing_a_design_reverses_its_curvature() -> None:
    forward = spread("bloss")
    end = forward.at(forward.length)
    back = design_of_elements(
        "1",
        ["straight", "bloss", "arc", "bloss", "straight"],
        [50.0, 60.0, 200.0, 80.0, 100.0],
        [0, 600.0, 600.0, 0, 0],
        easting=float(end.easting),
        northing=float(end.northing),
        grid_bearing=float(end.grid_bearing) + np.pi,
    )
    s = np.linspace(0.0, forward.length, 40)
    a, b = forward.at(s), back.at(forward.length - s)
    assert np.allclose(a.easting, b.easting, atol=1e-9)
    assert np.allclose(a.northing, b.northing, atol=1e-9)
    inside = (s > 1) & (s < 489)
    assert np.allclose(a.curvature[inside], -b.curvature[inside], atol=1e-12)


def test_near_stations_choose_among_the_strands_of_a_loop() -> None:
    circle = design_of_elements("1", ["arc"], [1.9 * 2 * np.pi * 200.0], [200.0])
    here = circle.at(300.0)
    second = circle.project(here.easting, here.northing, near=300.0 + 2 * np.pi * 200.0)
    assert second.station[0] == pytest.approx(300.0 + 2 * np.pi * 200.0, abs=1e-6)
    first = circle.project(here.easting, here.northing, near=310.0)
    assert first.station[0] == pytest.approx(300.0, abs=1e-6)


def test_a_profile_of_circles_and_parabolas() -> None:
    profile = Gradients(
        *(
            np.array(v, float)
            for v in (
                [-np.inf, 100.0, 200.0],
                [0, 100, 200],
                [10.0, 11.0, 11.0],
                [0.01, 0.01, 0.0],
                [0, 0, 0],
                [0, -10_000.0, 0],
            )
        )
    )
    at = np.array([50.0, 150.0])
    assert profile(at)[0] == pytest.approx(10.5)
    assert profile(at, 2)[1] == pytest.approx(-1e-4, rel=2e-4)
    step = 1e-3
    assert (profile(at + step) - profile(at - step)) / (2 * step) == pytest.approx(profile(at, 1), abs=1e-9)


@pytest.mark.parametrize("station", [-1.0, 491.0, np.nan])
def test_stations_outside_are_refused(station: float) -> None:
    with pytest.raises(TrackError, match=r"is not on the design of track '1', which runs from 0\.000 to 490\.000 m"):
        spread("clothoid").at(station)


def test_bad_designs_are_refused() -> None:
    with pytest.raises(TrackError, match="no known element"):
        design_of_elements("1", ["spline"], [1.0], [0.0])
    with pytest.raises(TrackError, match="has no length"):
        design_of_elements("1", ["straight", "arc"], [1.0, 0.0], [0.0, 5.0])
    with pytest.raises(TrackError, match="not finite"):
        design_of_elements("1", ["straight"], [1.0], [0.0], easting=np.nan)
    with pytest.raises(TrackError, match="point 2 is not finite"):
        spread("clothoid").project([0.0, np.inf], [0.0, 1.0])
