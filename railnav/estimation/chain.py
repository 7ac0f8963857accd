"""Block-bidiagonal Gauss-Markov chains, reduced by rotations to a triangular band: a filter forward, a smoother back.

The unknowns x_0 ... x_(N-1), n numbers each, meet whitened rows only (unit noise): a prior R0 x_0 = b0, observations
H_k x_k = z_k, and couplings M_k x_k + L_k x_(k+1) = u_k. Dynamics x+ = F x + g + w, w ~ N(0, Q) is L = W, M = -W F, u = W g with
W^T W = Q^-1; increments, odometer differences and observations between two nodes are couplings as well. The estimate minimises
the sum of squares of all rows. No normal equations are formed, and what has gone by is kept only as one n x (2n + 1) record an
epoch, or not at all.

**Coordinates are corrections to nominal ones.** Raw coordinates of 10^6 m cost nine digits that no algorithm gives back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.estimation import _chain_kernels, _row_kernels
from railnav.estimation.chain_solution import ChainSolution, packed_size
from railnav.estimation.gross_error import chi_square_limit

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

#: State sizes whose sweep is compiled with loops of constant length: two to three times faster, a few seconds once.
SPECIALISED_SIZES = (3, 6, 9)


#: Epochs of a page where records are not kept: those of one page stay in the processor's cache.
PAGE = 2048


@dataclass(frozen=True, slots=True, eq=False, init=False)
class Chain:
    """Whitened rows of a block-bidiagonal Gauss-Markov model.

    An array that is the same at every epoch may be given once: without its first axis, or with a first axis of one. A row
    whose coefficients are all zero is absent.

    Parameters
    ----------
    H : (N, m, n) array
        Observation rows, whitened: (state units)^-1.
    z : (N, m) array
        Their right-hand sides, whitened, unit noise.
    M, L : (N - 1, q, n) array
        Coupling rows M_k x_k + L_k x_(k+1) = u_k, whitened; not needed for N = 1.
    u : (N - 1, q) array
        Their right-hand sides, whitened.
    counts : (N,) integer array, optional
        Only the first ``counts[k]`` observation rows of epoch k are used (0: no fix); the rest may be anything.
    coupling_counts : (N - 1,) integer array, optional
        The same for the couplings.
    prior : ((r, n) array, (r,) array), optional
        Whitened rows R0 x_0 = b0; none by default, and none is needed.
    lead : {0, 1}
        1: a stretch that continues a chain; coupling 0 leads to its first epoch, and there are N of them.

    Raises
    ------
    EstimationError
        Shapes do not fit each other, or there is no epoch.

    Notes
    -----
    Arrays that are float64 and contiguous are kept as they are, not copied, and never written.

    Examples
    --------
    >>> chain = Chain(np.ones((1, 1)), [[0.0], [1.1], [1.9]], [[-1.0]], [[1.0]], [[1.0], [1.0]])
    >>> solve_chain(chain).state.ravel()
    array([0.0125, 1.025 , 1.9625])
    """

    H: FloatArray
    z: FloatArray
    M: FloatArray
    L: FloatArray
    u: FloatArray
    counts: IntArray
    coupling_counts: IntArray
    prior: tuple[FloatArray, FloatArray] | None
    lead: int

    def __init__(
        self,
        H: ArrayLike,
        z: ArrayLike,
        M: ArrayLike | None = None,
        L: ArrayLike | None = None,
        u: ArrayLike | None = None,
        *,
        counts: ArrayLike | None = None,
        coupling_counts: ArrayLike | None = None,
        prior: tuple[ArrayLike, ArrayLike] | None = None,
        lead: int = 0,
    ) -> None:
        rhs = as_floats("z", z)
        if rhs.ndim != 2 or len(rhs) == 0:
            raise EstimationError(f"z has shape {rhs.shape}; a chain needs (N, m) with at least one epoch")
        epochs, m = rhs.shape
        links = epochs - 1 + lead
        rows = _stack("H", H, epochs, m, None)
        n = rows.shape[2]
        if n == 0:
            raise EstimationError("a state of no numbers cannot be estimated")
        before = after = np.zeros((0, 0, n))
        step = np.zeros((0, 0))
        if M is not None and L is not None and u is not None:
            step = as_floats("u", u)
            step = step[np.newaxis] if step.ndim == 1 else step
            if step.ndim != 2 or len(step) not in (1, links):
                raise EstimationError(f"u has shape {step.shape}; {links} couplings need ({links}, q)")
            before, after = _stack("M", M, links, step.shape[1], n), _stack("L", L, links, step.shape[1], n)
        elif links:
            raise EstimationError(f"{epochs} epochs need coupling rows M, L and u ({links} of them)")
        used = _counts("counts", counts, epochs, m)
        coupled = _counts("coupling_counts", coupling_counts, links, step.shape[1])
        for name, value in (
            ("H", rows),
            ("z", rhs),
            ("M", before),
            ("L", after),
            ("u", step),
            ("counts", used),
            ("coupling_counts", coupled),
            ("prior", None if prior is None else prior_rows(prior, n)),
            ("lead", lead),
        ):
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.z)

    @property
    def n(self) -> int:
        """Numbers in one state."""
        return int(self.H.shape[2])

    def blame(self) -> str:
        """Say which input is not finite."""
        for name, array, counts, what in (
            ("H", self.H, self.counts, "epoch"),
            ("z", self.z, self.counts, "epoch"),
            ("M", self.M, self.coupling_counts, "coupling"),
            ("L", self.L, self.coupling_counts, "coupling"),
            ("u", self.u, self.coupling_counts, "coupling"),
        ):
            used = np.arange(array.shape[1]) < (counts[:, None] if len(array) > 1 else counts.max(initial=0))
            values = array if array.ndim == 2 else array.sum(axis=2)
            for k, row in np.argwhere(~np.isfinite(values) & used)[:1]:
                return f"{name} is not finite at {what} {k}, row {row}; leave that row out by its count"
        return "the right-hand sides overflow; estimate corrections to nominal values"


def solve_chain(
    chain: Chain,
    *,
    covariance: bool = True,
    filtered: bool = False,
    evidence: bool = False,
    gate: float | None = None,
    allow_breaks: bool = False,
    records: bool = True,
) -> ChainSolution:
    """Estimate all states of a chain: rotations forward, substitution back.

    Forward, [R_k 0 | b_k] over [M_k L_k | u_k] is rotated to [R_kk R_kn | d_k] over [0 R | b] of the next epoch, whose observation
    rows are rotated in after it; what they leave is NIS. Backwards, x_k = R_kk^-1 (d_k - R_kn x_(k+1)),
    P_k = R_kk^-1 R_kk^-T + G_k P_(k+1) G_k^T with G_k = -R_kk^-1 R_kn.

    Parameters
    ----------
    chain : Chain
        Whitened rows.
    covariance : bool
        Give `covariance` and `lag_one`.
    filtered : bool
        Give the forward estimates too.
    evidence : bool
        Give `log_evidence`.
    gate : float, optional
        Leave out an epoch's observations if their NIS is less likely than this, e.g. 1e-4 (rail 17); none by default.
    allow_breaks : bool
        Accept a link that couples nothing, as long as each part is determined by its own rows.
    records : bool
        Keep `records`. Without them the store is that of the states alone, a fifth, and the sweep is made twice: page by page
        backwards from triangles kept on the way. Goes with ``covariance=False``.

    Returns
    -------
    ChainSolution
        States, covariances, NIS; frozen.

    Raises
    ------
    EstimationError
        A link is broken, a state is not determined by the rows, or a row is not finite; the message names the epoch.

    Notes
    -----
    Time and store are linear in N; a singular start needs no care: rows that meet an empty pivot fill it (necessary rows). A
    pivot below 1e-12 of its row counts as empty. Cost, 100,000 epochs on one core: docs/performance.md.

    References
    ----------
    Specification rail 5 and 15.1-15.4, equations (16), (22), (23).

    Examples
    --------
    >>> chain = Chain(np.ones((1, 1)), [[0.0], [1.1], [1.9]], [[-1.0]], [[1.0]], [[1.0], [1.0]])
    >>> solution = solve_chain(chain)
    >>> solution.state.ravel(), solution.covariance.ravel(), round(solution.sum_of_squares, 6)
    (array([0.0125, 1.025 , 1.9625]), array([0.625, 0.5  , 0.625]), 0.01375)
    """
    if chain.lead:
        raise EstimationError("a stretch that continues a chain (lead = 1) is for ChainFilter.sweep")
    if not records and covariance:
        raise EstimationError("covariances need the records; solve_chain(..., covariance=False, records=False)")
    N, n = len(chain), chain.n
    triangle = start_triangle(chain.prior, n)
    state = np.empty((N, n))
    if records:
        sweep = sweep_chain(chain, triangle, store=True, filtered=filtered, gate=gate, evidence=evidence)
    else:
        sweep, starts = _sweep_pages(chain, triangle, filtered=filtered, gate=gate, evidence=evidence)
    if sweep.broken >= 0 and not allow_breaks:
        raise EstimationError(
            f"the link between epochs {sweep.broken} and {sweep.broken + 1} couples nothing; "
            "solve the two parts as chains of their own, or allow_breaks=True"
        )
    substitute = _chain_kernels.smooth_chain_kernel(compiled_size(n))
    empty = (
        substitute(sweep.records, triangle, state)
        if records
        else _substitute_pages(chain, starts, triangle, state, gate)
    )
    # extremes: NaN and infinity show in them, and no array of truth values is made
    if empty >= 0 or not np.isfinite([state.min(), state.max()]).all():
        if empty < 0 or not np.isfinite(triangle).all():
            raise EstimationError(chain.blame())
        raise EstimationError(_undetermined(chain, *divmod(empty, n)))
    P = C = None
    if covariance:
        P, C = np.empty((N, n, n)), np.empty((N - 1, n, n))
        _chain_kernels.covariance_chain_kernel(compiled_size(n))(sweep.records, triangle, P, C)
    return ChainSolution(
        state=state,
        covariance=P,
        lag_one=C,
        filtered=sweep.filtered if filtered else None,
        nis=sweep.nis,
        dof=sweep.dof,
        log_evidence=sweep.log_evidence if evidence else None,
        rejected=sweep.rejected,
        coupling_nis=sweep.coupling_nis,
        coupling_dof=sweep.coupling_dof,
        packed=sweep.records,
        triangle=triangle,
    )


@dataclass(slots=True)
class Sweep:
    """What one forward sweep leaves, its records packed; inside this room only."""

    records: FloatArray
    nis: FloatArray
    dof: IntArray
    rejected: BoolArray
    coupling_nis: FloatArray
    coupling_dof: IntArray
    filtered: FloatArray
    log_evidence: FloatArray
    broken: int


def sweep_chain(
    chain: Chain, triangle: FloatArray, *, store: bool, filtered: bool, gate: float | None, evidence: bool = False
) -> Sweep:
    """Run the forward kernel over a chain or a stretch of one; `triangle` is overwritten. Inside this room only."""
    N, n, links, m = len(chain), chain.n, len(chain.coupling_counts), chain.z.shape[1]
    limits = np.empty(0) if gate is None else np.array([np.inf, *(chi_square_limit(i + 1, gate) for i in range(m))])
    out = Sweep(
        records=np.empty((links if store else 0, packed_size(n))),
        nis=np.empty(N),
        dof=np.empty(N, np.int64),
        rejected=np.empty(N, np.bool_),
        coupling_nis=np.empty(0),
        coupling_dof=np.empty(0, np.int64),
        filtered=np.empty((N if filtered else 0, n)),
        log_evidence=np.empty(N if evidence else 0),
        broken=-1,
    )
    forward = _chain_kernels.forward_kernel(compiled_size(n))
    start = triangle.copy()
    # n rows or fewer a link nearly always carry the state on and leave no residuals: no room is taken for these before there are any
    for room in (0, links) if chain.u.shape[1] <= n and links > n else (links,):
        triangle[:] = start
        out.coupling_nis, out.coupling_dof = np.empty(room), np.empty(room, np.int64)
        out.broken = forward(
            chain.H, chain.z, chain.counts, chain.M, chain.L, chain.u, chain.coupling_counts, chain.lead, triangle, limits,
            out.records, out.nis, out.dof, out.rejected, out.coupling_nis, out.coupling_dof, out.filtered, out.log_evidence,
        )  # fmt: skip
        if out.broken != -2:
            break
    if len(out.coupling_nis) < links:
        out.coupling_nis = np.broadcast_to(np.zeros(1), links)
        out.coupling_dof = np.broadcast_to(np.zeros(1, np.int64), links)
    if evidence:
        out.log_evidence -= 0.5 * (out.nis + out.dof * np.log(2 * np.pi))
    return out


def stretch(chain: Chain, first: int, end: int) -> Chain:
    """Epochs `first` to `end` - 1 with the link that leads to them; its counts may be written. Inside this room only."""
    lead = 1 if first > 0 else 0
    links = slice(first - lead, end - 1)
    M, L, u = (a if len(a) == 1 and len(chain) > 2 else a[links] for a in (chain.M, chain.L, chain.u))
    return Chain(
        chain.H if len(chain.H) == 1 else chain.H[first:end],
        chain.z[first:end],
        M,
        L,
        u,
        counts=chain.counts[first:end].copy(),
        coupling_counts=chain.coupling_counts[links],
        lead=lead,
    )


def _sweep_pages(
    chain: Chain, triangle: FloatArray, *, filtered: bool, gate: float | None, evidence: bool
) -> tuple[Sweep, FloatArray]:
    """Sweep page by page without keeping records; also the triangles from which each page started."""
    N, n, links = len(chain), chain.n, len(chain.coupling_counts)
    starts = np.empty((-(-N // PAGE), n, n + 1))
    out = Sweep(
        records=np.empty((0, packed_size(n))), nis=np.empty(N), dof=np.empty(N, np.int64), rejected=np.empty(N, np.bool_),
        coupling_nis=np.zeros(links), coupling_dof=np.zeros(links, np.int64), filtered=np.empty((N if filtered else 0, n)),
        log_evidence=np.empty(N if evidence else 0), broken=-1,
    )  # fmt: skip
    for page, first in enumerate(range(0, N, PAGE)):
        starts[page] = triangle
        end = min(first + PAGE, N)
        part = stretch(chain, first, end)
        found = sweep_chain(part, triangle, store=False, filtered=filtered, gate=gate, evidence=evidence)
        here, before = slice(first, end), slice(first - part.lead, end - 1)
        out.nis[here], out.dof[here], out.rejected[here] = found.nis, found.dof, found.rejected
        out.coupling_nis[before], out.coupling_dof[before] = found.coupling_nis, found.coupling_dof
        if filtered:
            out.filtered[here] = found.filtered
        if evidence:
            out.log_evidence[here] = found.log_evidence
        if found.broken >= 0 and out.broken < 0:
            out.broken = first - part.lead + found.broken
    return out, starts


def _substitute_pages(chain: Chain, starts: FloatArray, last: FloatArray, state: FloatArray, gate: float | None) -> int:
    """Make the records of one page after the other again, from the last to the first, and substitute through them."""
    N, n = len(chain), chain.n
    substitute = _chain_kernels.smooth_chain_kernel(compiled_size(n))
    for page in range(len(starts) - 1, -1, -1):
        first, end = page * PAGE, min((page + 1) * PAGE, N)
        part = stretch(chain, first, end)
        records = sweep_chain(part, starts[page], store=True, filtered=False, gate=gate).records
        here = slice(first - part.lead, end)
        empty = int(substitute(records, last, state[here]))
        if empty >= 0:
            return (first - part.lead) * n + empty
        last = np.column_stack(
            [np.eye(n), state[first - part.lead]]
        )  # what is known of the state that the next page ends with
    return -1


def _undetermined(chain: Chain, epoch: int, component: int) -> str:
    fixes = np.flatnonzero(chain.counts > 0)
    seen = (
        f"the first of {len(fixes)} epochs with observations is {fixes[0]}" if len(fixes) else "there is no observation"
    )
    return (
        f"epoch {epoch}: component {component} of the state is not determined by the rows ({seen}); "
        "add observations, couplings or a prior"
    )


def compiled_size(n: int) -> int:
    """Size to compile loops for, 0 for loops of any length; inside this room only."""
    return n if n in SPECIALISED_SIZES else 0


def start_triangle(prior: tuple[ArrayLike, ArrayLike] | None, n: int) -> FloatArray:
    """Triangle [R | b] of the prior rows, empty without; inside this room only."""
    triangle = np.zeros((n, n + 1))
    if prior is not None:
        R0, b0 = np.asarray(prior[0], np.float64), np.asarray(prior[1], np.float64)
        _row_kernels.insert_rows_kernel(triangle, np.ascontiguousarray(np.column_stack([R0, b0])), len(R0))
    return triangle


def prior_rows(prior: tuple[ArrayLike, ArrayLike], n: int) -> tuple[FloatArray, FloatArray]:
    """Prior rows, checked; inside this room only."""
    R0, b0 = as_floats("prior", prior[0]), as_floats("prior", prior[1])
    if R0.ndim != 2 or R0.shape[1] != n or b0.shape != (len(R0),):
        raise EstimationError(f"prior has shapes {R0.shape} and {b0.shape}; (r, {n}) and (r,) fit")
    if not np.isfinite(R0).all() or not np.isfinite(b0).all():
        raise EstimationError("prior is not finite; leave out what is not known")
    return R0, b0


def as_floats(name: str, value: ArrayLike) -> FloatArray:
    """Contiguous float64 array of an argument, or an error that names it; inside this room only."""
    try:
        return np.ascontiguousarray(value, dtype=np.float64) if np.ndim(value) else np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise EstimationError(f"{name} is not an array of numbers: {error}") from None


def _stack(name: str, value: ArrayLike, length: int, rows: int, n: int | None) -> FloatArray:
    out = as_floats(name, value)
    if out.ndim == 2:
        out = out[np.newaxis]
    if out.ndim != 3 or out.shape[1] != rows or len(out) not in (1, length) or n not in (None, out.shape[2]):
        shape = f"({length}, {rows}, {'n' if n is None else n})"
        raise EstimationError(f"{name} has shape {np.shape(value)}; {shape} fits the right-hand sides")
    return out


def _counts(name: str, value: ArrayLike | None, length: int, most: int) -> IntArray:
    if value is None:
        return np.full(length, most, np.int64)
    out = np.asarray(value)
    if out.shape != (length,) or (out.size and not np.issubdtype(out.dtype, np.integer)):
        raise EstimationError(f"{name} has shape {out.shape} and type {out.dtype}; ({length},) integers fit")
    if out.size and (out.min() < 0 or out.max() > most):
        raise EstimationError(f"{name} runs from {out.min()} to {out.max()}; there are 0 to {most} rows")
    return np.ascontiguousarray(out, np.int64)
