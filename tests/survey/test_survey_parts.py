"""Frame offsets, error models, nominal curves and grouping, each on its own."""

from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from railnav.run import Run
from railnav.survey import _kernels
from railnav.survey.axis import ErrorModel
from railnav.survey.fixes import Fixes
from railnav.survey.grouping import tracks_of_line
from railnav.survey.noise import Sample, error_models, run_models
from railnav.survey.nominal import curve, lines, smooth_course
from railnav.survey.offsets import Knowledge, differences, settle
from railnav.survey.profiles import Profiles, traverse
from railnav.survey.surveyed import know, white_variances


def bends(N=600):
    angle = 0.9 * np.sin(np.arange(N) / 60.0)
    return np.column_stack([np.cos(angle), -np.sin(angle)])


# ------------------------------------------------------------------------------------------------------------ offsets


def test_offsets_of_runs_and_receivers_are_recovered_up_to_the_datum():
    rng = np.random.default_rng(1)
    design, kind = bends(), np.array([0, 0, 0, 1, 1, 1])
    true = np.array([[0.5, -0.2], [-0.4, 0.1], [0.1, 0.2], [4.2, -9.7], [3.9, -10.1], [4.0, -9.9]])
    track = rng.normal(0.0, 5.0, len(design))
    value = track + true @ design.T + rng.normal(0.0, 0.1, (6, len(design)))
    found = settle([differences(value, design, range(6))], kind, np.array([0.5, 0.5]), 2)
    assert np.allclose(found.run - found.run.mean(0), true - true.mean(0), atol=0.05)
    assert np.allclose(found.receiver[1] - found.receiver[0], true[3:].mean(0) - true[:3].mean(0), atol=0.6)
    assert np.allclose(found.weight @ found.receiver, 0.0, atol=1e-5)
    assert found.datum_sigma() == pytest.approx(np.abs(found.receiver[0]), rel=1e-3)


def test_a_poor_receiver_hardly_moves_the_datum_of_good_ones():
    rng = np.random.default_rng(11)
    design, kind = bends(), np.array([0] * 8 + [1])
    value = rng.normal(0.0, 0.3, (9, len(design)))
    value[8] += 4.0 * design[:, 0]
    alone = settle([differences(value[:8], design, range(8))], kind[:8], np.array([0.2]), 2)
    both = settle([differences(value, design, range(9))], kind, np.array([0.2, 3.0]), 2)
    assert both.receiver[1, 0] - both.receiver[0, 0] == pytest.approx(4.0, abs=0.3)
    assert both.weight[0] > 0.5
    assert np.abs(both.run[:8] - both.receiver[0] - alone.run).max() < 0.05


def test_a_straight_line_shows_one_component_only():
    N = 400
    design = np.tile([0.0, -1.0], (N, 1))  # due east
    rng = np.random.default_rng(2)
    value = rng.normal(0, 0.1, (2, N)) + np.array([[0.0], [3.0]])
    found = settle([differences(value, design, (0, 1))], np.array([0, 1]), np.array([0.5, 0.5]), 2)
    assert found.receiver[0, 1] - found.receiver[1, 1] == pytest.approx(3.0, abs=0.1)
    sigma = np.sqrt(np.diag(found.receiver_covariance)).reshape(2, 2)
    assert sigma[0, 0] > 5.0 > 1.0 > sigma[0, 1]


def test_a_stretch_apart_does_not_pull_the_offset():
    rng = np.random.default_rng(3)
    design = bends()
    value = rng.normal(0.0, 0.02, (2, len(design)))
    value[1, 200:330] += 4.5
    found = settle([differences(value, design, (0, 1))], np.array([0, 0]), np.array([0.1]), 2)
    assert np.abs(found.run).max() < 0.01


def test_a_common_shift_is_left_to_the_datum():
    class Track:
        runs = (0, 1, 2)

    class Swept:
        border = np.random.default_rng(4).normal(size=(9, 6))
        border_value = np.arange(9.0)

    known = know(Track, Swept)
    common = np.tile(np.eye(2), (3, 1))
    assert np.abs(known.rows.T @ (known.rows @ common)).max() < 1e-9
    assert np.abs(known.rows @ common).max() < 1e-9


def test_the_scatter_of_runs_is_found():
    rng = np.random.default_rng(5)
    kind = np.zeros(40, np.int64)
    true = rng.normal(0.0, 1.5, 40)
    known = Knowledge(tuple(range(40)), np.eye(40) - 1 / 40, (true - true.mean()) * 1.0)
    found = settle([Knowledge(known.runs, 100.0 * known.rows, 100.0 * known.value)], kind, np.array([0.3]), 1)
    assert found.scatter[0] == pytest.approx(true.std(), rel=0.15)


# -------------------------------------------------------------------------------------------------------------- noise


def wandering(rng, shape, sigma, memory, white, dt):
    phi = np.exp(-dt / memory)
    out = np.empty(shape)
    out[:, 0] = sigma * rng.standard_normal(shape[0])
    for i in range(1, shape[1]):
        out[:, i] = phi * out[:, i - 1] + sigma * np.sqrt(1 - phi**2) * rng.standard_normal(shape[0])
    return out + white * rng.standard_normal(shape)


def sample_of(value, dt, receiver):
    K, N = value.shape
    return Sample(value, np.tile(np.arange(N) * dt, (K, 1)), np.ones(K), np.full(K, 1.0 / dt), receiver)


def test_white_and_correlated_parts_are_told_apart_whatever_the_track():
    rng = np.random.default_rng(6)
    track = np.cumsum(rng.normal(0.0, 3.0, 6000))  # cancels
    value = track + wandering(rng, (4, 6000), 2.0, 50.0, 0.7, 1.0)
    models, assumed = error_models([sample_of(value, 1.0, ("a",) * 4)], {"a": np.nan})
    assert not assumed
    assert models["a"].white == pytest.approx(0.7, rel=0.25)
    assert models["a"].correlated == pytest.approx(2.0, rel=0.15)
    assert 30.0 <= models["a"].memory <= 80.0
    assert models["a"].total == pytest.approx(np.hypot(2.0, 0.7), rel=0.15)


def test_what_decays_in_seconds_counts_as_white_of_its_density():
    rng = np.random.default_rng(7)
    value = wandering(rng, (4, 20000), 1.0, 4.0, 1e-3, 1.0)
    models, _ = error_models([sample_of(value, 1.0, ("a",) * 4)], {"a": np.nan})
    assert models["a"].white == pytest.approx(np.sqrt(2 * 4.0), rel=0.25)
    assert models["a"].correlated < 0.3
    assert models["a"].total == pytest.approx(1.0, rel=0.1)


def test_a_receiver_without_a_partner_of_its_kind():
    rng = np.random.default_rng(8)
    value = np.vstack([wandering(rng, (2, 6000), 1.0, 50.0, 0.2, 1.0), wandering(rng, (1, 6000), 3.0, 50.0, 0.2, 1.0)])
    models, assumed = error_models([sample_of(value, 1.0, ("a", "a", "b"))], {"a": np.nan, "b": np.nan})
    assert not assumed
    assert models["b"].correlated == pytest.approx(3.0, rel=0.25)
    alone, assumed = error_models([sample_of(value[:1], 1.0, ("a",))], {"a": 0.5})
    assert assumed == {"a"}
    assert alone["a"].correlated == pytest.approx(0.5)


def test_one_bad_run_among_good_ones():
    rng = np.random.default_rng(9)
    value = wandering(rng, (4, 4000), 1.0, 30.0, 0.1, 1.0)
    value[2] *= 3.0
    sample = sample_of(value, 1.0, ("a",) * 4)
    models, _ = error_models([sample], {"a": np.nan})
    totals = [m.total for m in run_models(sample, models)]
    assert totals[2] > 2.0 * max(totals[0], totals[1], totals[3])


# -------------------------------------------------------------------------------------------------------------- curves


def arc(radius=400.0, length=900.0, n=180):
    angle = np.linspace(0.0, length / radius, n)
    return np.column_stack([radius * (1 - np.cos(angle)), radius * np.sin(angle)]), angle


def test_a_curve_to_the_right_has_positive_curvature_and_the_right_length():
    points, _ = arc()
    nominal = curve(points[:, 0], points[:, 1], 10.0)
    assert nominal.curvature[3:-3] == pytest.approx(1 / 400.0, rel=1e-3)
    assert nominal.step * (len(nominal) - 1) == pytest.approx(900.0, rel=1e-6)
    assert nominal.reversed().curvature == pytest.approx(-nominal.curvature[::-1])


@settings(max_examples=50, deadline=None)
@given(s=st.floats(20.0, 880.0), d=st.floats(-30.0, 30.0))
def test_walking_along_a_curve_finds_offset_and_distance_to_the_right(s, d):
    points, _ = arc()
    nominal = curve(points[:, 0], points[:, 1], 10.0)
    r = 400.0 - d  # the centre lies to the right
    x, y = np.array([400.0 - r * np.cos(s / 400.0)]), np.array([r * np.sin(s / 400.0)])
    at, right = np.empty(1), np.empty(1)
    _kernels.walk(
        nominal.easting, nominal.northing, nominal.tangent_e, nominal.tangent_n, nominal.step, x, y, 60.0, at, right
    )
    assert at[0] == pytest.approx(s, abs=2e-3)
    assert right[0] == pytest.approx(d, abs=2e-3)


def test_a_walk_stays_on_its_branch_where_a_line_crosses_itself():
    t = np.linspace(0.3 * np.pi, 2.2 * np.pi, 1500)
    eight = np.column_stack([1500.0 * np.sin(t), 1500.0 * np.sin(t) * np.cos(t)])
    nominal = curve(eight[:, 0], eight[:, 1], 10.0)
    along = np.gradient(eight, axis=0)
    along /= np.hypot(*along.T)[:, None]
    beside = eight + 25.0 * np.column_stack(
        [along[:, 1], -along[:, 0]]
    )  # nearer to the other branch, about the crossing
    s, d = np.empty(len(eight)), np.empty(len(eight))
    _kernels.walk(
        nominal.easting, nominal.northing, nominal.tangent_e, nominal.tangent_n, nominal.step,
        np.ascontiguousarray(beside[:, 0]), np.ascontiguousarray(beside[:, 1]), 60.0, s, d,
    )  # fmt: skip
    assert (np.diff(s) > 0).all()
    assert np.abs(d - 25.0).max() < 0.05


@pytest.mark.parametrize("sense", [1, -1])
def test_the_antenna_is_brought_to_the_reference_point(sense):
    points, _ = arc()
    nominal = curve(points[:, 0], points[:, 1], 10.0)
    s = np.linspace(100.0, 800.0, 60)[::sense]
    antenna, radius = s + sense * 5.0, 400.0 - sense * 1.2  # 5 m ahead and 1.2 m to the vehicle's right
    fixes = Fixes(
        run=Run(id="a", start=datetime(2026, 5, 4, tzinfo=UTC)),
        receiver="r",
        time=np.arange(60.0),
        easting=400.0 - radius * np.cos(antenna / 400.0),
        northing=radius * np.sin(antenna / 400.0),
        height=np.zeros(60),
        sigma=np.ones(60),
        reason=np.zeros(60, np.int64),
        size=np.zeros(60),
        forward=5.0,
        right=np.full(60, 1.2),
    )
    laid = traverse(nominal, fixes, 60.0)
    assert laid.sense == sense
    assert laid.offset == pytest.approx(s, abs=0.01)
    assert laid.right == pytest.approx(np.zeros(60), abs=0.01)


def test_doubtful_values_lose_weight_and_others_do_not():
    N = 200
    profile = Profiles(
        *(np.ones((1, N)) for _ in range(5)), time=np.arange(N, dtype=float)[None], sigma=np.full((1, N), 0.5)
    )
    profile.sigma[0, 50] = 2.0
    residual = np.full((1, N), 1.0)
    residual[0, 100] = 4.0
    residual[0, 150] = np.nan
    (variance,) = white_variances(profile, residual, [ErrorModel(0.2, 1.0, 30.0, 1.02)], 0.0)
    usual = np.delete(variance, [50, 100, 150])
    assert usual == pytest.approx(0.04)
    assert variance[100] > 60 * 0.5 * 1.02**2  # as much as a correlated error of that size, over its whole memory
    assert variance[50] > 60 * 0.5 * 1.02**2
    assert np.isnan(variance[150])


def test_lines_join_what_continues_and_keep_apart_what_parts():
    def straight(a, b, turn=0.0):
        along = np.arange(a, b, 30.0)
        return np.column_stack([along, np.maximum(along - 3000.0, 0.0) * turn])

    first, ahead, back = straight(0, 9000), straight(8800, 12000), straight(8900, 12000)[::-1]
    branch = straight(2500, 7000, 0.4)
    far = straight(0, 4000) + np.array([0.0, 5000.0])
    found = lines([first, ahead, back, branch, far])
    assert sorted(line.members for line in found) == [[0, 1, 2], [3], [4]]
    longest = next(line for line in found if 0 in line.members)
    assert np.ptp(longest.course[:, 0]) > 11900


def test_a_gap_of_one_run_is_filled_by_another():
    angle = np.linspace(0.0, 3.0, 300)
    whole = np.column_stack([1000.0 * (1 - np.cos(angle)), 1000.0 * np.sin(angle)])
    broken = whole[(angle < 1.0) | (angle > 1.8)]
    longer = np.vstack([[-1.0, -300.0], broken])  # longest comes first
    found = lines([longer, whole])
    assert len(found) == 1
    nominal = smooth_course(found[0].course, 20.0, 20.0)
    distance = np.abs(np.hypot(nominal.easting - 1000.0, nominal.northing) - 1000.0)
    assert distance[nominal.northing > 100.0].max() < 5.0


# ------------------------------------------------------------------------------------------------------------ grouping


def four_runs(apart, scatter, seed=1, common=0.0):
    rng = np.random.default_rng(seed)
    design = bends()
    side = np.array([0.0, 0.0, apart, apart])[:, None]
    frames = np.array([[0.0, 0.0], [common, -common], [0.0, 0.0], [common, -common]])
    return side + frames @ design.T + rng.normal(0, scatter, (4, len(design))), design


@pytest.mark.parametrize(
    ("apart", "scatter", "labels", "senses", "expected"),
    [
        (4.0, 0.05, ["", "", "", ""], [1, 1, -1, -1], 2),
        (0.0, 0.05, ["", "", "", ""], [1, 1, -1, -1], 1),
        (4.0, 0.05, ["u"] * 4, [1] * 4, 2),
        (0.0, 0.05, ["u", "u", "d", "d"], [1, 1, -1, -1], 1),
        (4.0, 3.0, ["u", "u", "d", "d"], [1, 1, -1, -1], 2),
        (4.0, 3.0, ["u"] * 4, [1] * 4, 1),
        (0.0, 3.0, ["", "", "", ""], [1, 1, -1, -1], 1),
        (9.0, 3.0, ["", "", "", ""], [1, 1, -1, -1], 2),
    ],
)
def test_which_runs_share_a_track(apart, scatter, labels, senses, expected):
    value, design = four_runs(apart, scatter)
    groups, _ = tracks_of_line(value, design, labels, senses, list("abcd"))
    assert len(groups) == expected
    assert groups == ([[0, 1, 2, 3]] if expected == 1 else [[0, 1], [2, 3]])


def test_a_difference_of_frames_is_not_a_second_track():
    value, design = four_runs(0.0, 0.05, common=6.0)
    groups, _ = tracks_of_line(value, design, [""] * 4, [1] * 4, list("abcd"))
    assert groups == [[0, 1, 2, 3]]


def test_a_gap_is_filled_without_a_fold_where_the_nearest_point_lies_a_step_before_it():
    # as on a real line: both runs are blind between 3,000 and 3,800 m; one begins again a little earlier than the other
    longer = np.concatenate([np.arange(0.0, 3020.0, 30.0), [3030.0], np.arange(3884.0, 6000.0, 30.0)])
    other = np.concatenate([np.arange(8.0, 2999.0, 30.0), [3014.0], np.arange(3800.0, 5900.0, 30.0)])
    (line,) = lines([np.column_stack([x, np.zeros(len(x))]) for x in (longer, other)])
    assert line.members == [0, 1]
    assert len(line.course) > len(longer)
    assert (np.diff(line.course[:, 0]) > 0.0).all()
