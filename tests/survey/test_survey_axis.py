"""The bordered chain against dense least squares, against the estimation room, and against the density it is made of."""

from dataclasses import replace

import numpy as np
import pytest

from railnav.estimation.chain import Chain as GenericChain
from railnav.estimation.chain import solve_chain
from railnav.survey.axis import FIRST_NODE, Chain, ErrorModel, log_evidence, solve, sweep

K, N, STEP = 3, 14, 7.0


def small_chain(seed=1, *, gaps=True):
    rng = np.random.default_rng(seed)
    value = rng.normal(0.0, 0.3, (K, N))
    if gaps:
        value[rng.random((K, N)) < 0.3] = np.nan
        value[:, 6:8] = np.nan
    angle = np.linspace(0.3, 1.9, N)
    design = np.broadcast_to(np.column_stack([np.cos(angle), -np.sin(angle)]), (K, N, 2))
    return Chain(
        step=STEP,
        value=value,
        lead=rng.uniform(-3.0, 3.0, (K, N)),
        variance=rng.uniform(0.01, 0.2, (K, N)),
        time=np.cumsum(rng.uniform(0.2, 2.0, (K, N)), axis=1) * np.array([[1], [-1], [1]]),
        design=design,
        errors=[ErrorModel(0.1, 0.2, 30.0, 0.3), ErrorModel(0.1, 0.4, 60.0, 0.5), ErrorModel(0.1, 0.1, 15.0, 0.2)],
        bend=rng.normal(0.0, 1e-3, N),
        noise=rng.uniform(1e-4, 5e-4, N - 1),
    )


def process(chain, k):
    h = chain.step
    F = np.array([[1.0, h, 0.5 * h * h], [0.0, 1.0, h], [0.0, 0.0, 1.0]])
    Q = chain.noise[k] ** 2 * np.array(
        [[h**5 / 20, h**4 / 8, h**3 / 6], [h**4 / 8, h**3 / 3, h**2 / 2], [h**3 / 6, h**2 / 2, h]]
    )
    elapsed = np.abs(np.diff(chain.time, axis=1))[:, k]
    phi = np.exp(-elapsed / np.array([e.memory for e in chain.errors]))
    return F, Q, phi


def dense_rows(chain):
    """All whitened rows over [states of all nodes | borders], the errors of the runs before the axis in each state."""
    n = K + 3
    rows, values = [], []

    def row(entries, value):
        r = np.zeros(N * n + 2 * K)
        for at, coefficients in entries:
            r[at : at + len(coefficients)] = coefficients
        rows.append(r)
        values.append(value)

    for j, e in enumerate(chain.errors):
        row([(j, [1.0 / e.correlated])], 0.0)
    for j, (sigma, mean) in enumerate(zip(FIRST_NODE, (0.0, 0.0, -chain.bend[0]), strict=True)):
        row([(K + j, [1.0 / sigma])], mean / sigma)
    for k in range(N - 1):
        F, Q, phi = process(chain, k)
        for j, e in enumerate(chain.errors):
            w = 1.0 / (e.correlated * np.sqrt(1.0 - phi[j] ** 2))
            row([(k * n + j, [-w * phi[j]]), ((k + 1) * n + j, [w])], 0.0)
        W = np.linalg.inv(np.linalg.cholesky(Q))
        # the whole curvature walks, not its correction: integrals of the nominal one, linear from node to node
        h, fall = chain.step, chain.bend[k] - chain.bend[k + 1]
        drift = fall * np.array([h * h / 6.0, h / 2.0, 1.0])
        for i in range(3):
            row([(k * n + K, -(W @ F)[i]), ((k + 1) * n + K, W[i])], (W @ drift)[i])
    for k in range(N):
        for j in range(K):
            if np.isfinite(chain.value[j, k]):
                w, g = 1.0 / np.sqrt(chain.variance[j, k]), chain.lead[j, k]
                row(
                    [
                        (k * n + j, [w]),
                        (k * n + K, [w, w * g, 0.5 * w * g * g]),
                        (N * n + 2 * j, w * chain.design[j, k]),
                    ],
                    w * chain.value[j, k],
                )
    return np.array(rows), np.array(values)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_estimate_covariance_and_borders_equal_dense_least_squares(seed):
    chain = small_chain(seed)
    n = K + 3
    A, y = dense_rows(chain)
    prior = np.eye(2 * K) / 0.5
    full = np.vstack([A, np.hstack([np.zeros((2 * K, N * n)), prior])])
    x, *_ = np.linalg.lstsq(full, np.append(y, np.zeros(2 * K)), rcond=None)
    P = np.linalg.inv(full.T @ full)

    swept = sweep(chain)
    R = np.vstack([swept.border, prior])
    border, *_ = np.linalg.lstsq(R, np.append(swept.border_value, np.zeros(2 * K)), rcond=None)
    border_covariance = np.linalg.inv(R.T @ R)
    estimate = solve(chain, swept, border, border_covariance, sure=True)
    assert np.allclose(border, x[N * n :], rtol=1e-8, atol=1e-10)
    assert np.allclose(border_covariance, P[N * n :, N * n :], rtol=1e-7, atol=1e-10)
    state = x[: N * n].reshape(N, n)[:, K:]
    assert np.allclose(estimate.state, state, rtol=1e-7, atol=1e-9)
    for k in range(N):
        at = slice(k * n + K, k * n + n)
        assert np.allclose(estimate.covariance[k], P[at, at], rtol=1e-6, atol=1e-12)
    # the step of the whole curvature, squared, in expectation (borders fixed)
    inner = np.linalg.inv(A[:, : N * n].T @ A[:, : N * n])
    for k in range(N - 1):
        a, b = k * n + n - 1, (k + 1) * n + n - 1
        mean = state[k + 1, 2] + chain.bend[k + 1] - state[k, 2] - chain.bend[k]
        variance = inner[a, a] + inner[b, b] - 2 * inner[a, b]
        assert estimate.step_power[k] == pytest.approx(mean**2 + variance, rel=1e-6)


def test_without_borders_it_is_the_chain_of_the_estimation_room():
    chain = small_chain(4)
    n = K + 3
    A, y = dense_rows(chain)
    A = A[:, : N * n]
    # sort the dense rows into prior, observations and couplings of the generic chain
    touched = np.array([sorted({c // n for c in np.flatnonzero(r)}) for r in A], dtype=object)
    prior_rows = slice(0, n)
    H, z = np.zeros((N, K, n)), np.zeros((N, K))
    M, L, u = np.zeros((N - 1, n, n)), np.zeros((N - 1, n, n)), np.zeros((N - 1, n))
    counts, links = np.zeros(N, np.int64), np.zeros(N - 1, np.int64)
    for r, value, nodes in zip(A[n:], y[n:], touched[n:], strict=True):
        k = nodes[0]
        if len(nodes) == 2:
            M[k, links[k]], L[k, links[k]] = r[k * n : (k + 1) * n], r[(k + 1) * n : (k + 2) * n]
            u[k, links[k]] = value
            links[k] += 1
        else:
            H[k, counts[k]], z[k, counts[k]] = r[k * n : (k + 1) * n], value
            counts[k] += 1
    witness = solve_chain(GenericChain(H, z, M, L, u, counts=counts, prior=(A[prior_rows, :n], y[prior_rows])))
    swept = sweep(chain, borders=False)
    estimate = solve(chain, swept, np.zeros(0), np.zeros((0, 0)), sure=True)
    assert np.allclose(estimate.state, witness.state[:, K:], rtol=1e-8, atol=1e-10)
    assert np.allclose(estimate.covariance, witness.covariance[:, K:, K:], rtol=1e-7, atol=1e-12)
    assert swept.residual == pytest.approx(witness.sum_of_squares, rel=1e-8)


def test_log_evidence_is_that_of_the_gaussian_density():
    chain = small_chain(5)
    n = K + 3

    def log_density(c):
        A, y = dense_rows(c)
        seen = int(np.isfinite(c.value).sum())
        weight = 1.0 / np.sqrt(c.variance.T[np.isfinite(c.value.T)])
        model = np.linalg.inv(A[:-seen, : N * n])  # states = model (unit noise + constants)
        H = A[-seen:, : N * n] / weight[:, None]
        innovation = y[-seen:] / weight - H @ (model @ y[:-seen])
        root = np.linalg.cholesky((H @ model) @ (H @ model).T + np.diag(1.0 / weight**2))
        return -0.5 * np.sum(np.linalg.solve(root, innovation) ** 2) - np.log(np.diag(root)).sum()

    other = replace(chain, noise=3.0 * chain.noise)
    assert log_evidence(other) - log_evidence(chain) == pytest.approx(log_density(other) - log_density(chain), rel=1e-6)


def test_a_new_nominal_curve_changes_nothing():
    """The prior is on the whole curvature: a nominal curve that is off by a cubic gives the same axis."""
    chain = small_chain(6)
    s = np.arange(N) * STEP
    shift = 0.4 + 3e-3 * s - 2e-5 * s**2 + 4e-7 * s**3
    slope, bend = 3e-3 - 4e-5 * s + 1.2e-6 * s**2, -4e-5 + 2.4e-6 * s
    moved = replace(
        chain,
        value=chain.value - (shift + slope * chain.lead + 0.5 * bend * chain.lead**2),
        bend=chain.bend + bend,
    )
    one, two = (solve(c, sweep(c), np.zeros(2 * K), np.zeros((2 * K, 2 * K)), sure=True) for c in (chain, moved))
    # the first node's prior (1 km, 1 rad) is all that tells them apart
    assert np.allclose(one.state[:, 0], two.state[:, 0] + shift, atol=1e-5)
    assert np.allclose(one.state[:, 2] + chain.bend, two.state[:, 2] + moved.bend, atol=1e-6)
    assert np.allclose(one.covariance, two.covariance, rtol=1e-9)


def test_more_data_never_make_the_axis_less_sure():
    chain = small_chain(7)
    less = replace(chain, value=np.where(np.arange(K)[:, None] == 1, np.nan, chain.value))
    nothing = np.zeros(2 * K), np.zeros((2 * K, 2 * K))
    a, b = (solve(c, sweep(c), *nothing, sure=True).covariance[:, 0, 0] for c in (chain, less))
    assert (a <= b * (1 + 1e-9)).all()
