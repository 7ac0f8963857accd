"""Was it the fix or the link? Gross errors in a chain, attributed by what comes after them.

A block that does not fit says only that the fix or the link before it is wrong. Two clones of the filter go on for a few epochs: one
drops the fix, the other keeps it and does not believe the link. Evidence decides: a bad fix is normal again at the next epoch, a
slip leaves an offset.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railnav.errors import EstimationError
from railnav.estimation.chain import Chain, as_floats, start_triangle, stretch, sweep_chain
from railnav.estimation.gross_error import chi_square_limit

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Epochs that are swept at once between alarms.
PAGE = 512


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """One block that did not fit, and what was found to be wrong.

    Attributes
    ----------
    epoch : int
        Where it showed; the link is the one that leads there.
    wrong : {"fix", "link"}
        What is not believed any more.
    nis, dof, limit : float, int, float
        Sum of squared residuals of the block, its degrees of freedom, and what it might have been.
    log_odds : float
        ln evidence of this verdict over the other; near zero where too little came after. NaN if there was nothing to weigh: no
        link before, or a state that was not determined.
    residual : (m,) array
        Whitened measured - predicted of the fix, before either was dropped; NaN if the state was not determined.
    """

    epoch: int
    wrong: Literal["fix", "link"]
    nis: float
    dof: int
    limit: float
    log_odds: float
    residual: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Screening:
    """A chain freed of gross errors.

    Attributes
    ----------
    chain : Chain
        The chain without bad fixes, its bad links weakened.
    verdicts : tuple of Verdict
        Every rejection, in order.
    """

    chain: Chain
    verdicts: tuple[Verdict, ...]


def screen_chain(
    chain: Chain,
    *,
    outlier_range: ArrayLike,
    significance: float = 1e-4,
    look_ahead: int = 5,
    inflation: float = 1e4,
    link_rows: slice | ArrayLike = slice(None),
) -> Screening:
    """Find blocks that do not fit their past, attribute each to the fix or to the link, and leave out what is wrong.

    A block with sum f^2 beyond chi-square(dof, 1 - significance) starts two clones. (G) drops the fix: it came from a flat
    density over `outlier_range` in each row. (I) keeps it and inflates the covariance of the link. The sum of log-evidence of
    this block and the `look_ahead` after it decides.

    Parameters
    ----------
    chain : Chain
        Whitened rows.
    outlier_range : float or (N,) array
        How far a bad observation may lie, in each of its rows, whitened: 1 m at a sigma of 1 cm is 100.
    significance : float
        Probability of an alarm for a good block.
    look_ahead : int
        Epochs to wait before a decision; none gives the decision of the block itself.
    inflation : float
        Factor on the covariance of a link that is not believed.
    link_rows : slice or integer array
        Coupling rows that a slip concerns; all by default. For states with drifts: the rows of the increments.

    Returns
    -------
    Screening
        Cleaned chain and verdicts.

    Raises
    ------
    EstimationError
        A parameter makes no sense, a row is not finite, or a link is broken.

    Notes
    -----
    Sigma of fixes 1 cm, of increments 2 mm: blunders of 5, 8, 12 cm are detected in 56, 99.8, 100 % of the cases and attributed
    rightly in all of 2,047. Errors that stay for longer than `look_ahead` (a fix displaced for many epochs) look like a slip.
    Links are weakened, not cut, so that the chain stays whole.

    References
    ----------
    Specification rail 17, with the evidence of 15.4 and rule 26.13: clones are compared on the same data.

    Examples
    --------
    >>> z = np.zeros((20, 1))
    >>> z[9] = 30.0
    >>> chain = Chain([[1.0]], z, [[-5.0]], [[5.0]], np.zeros((19, 1)))
    >>> [(v.epoch, v.wrong) for v in screen_chain(chain, outlier_range=100.0).verdicts]
    [(9, 'fix')]
    """
    N, n = len(chain), chain.n
    if chain.lead:
        raise EstimationError("a stretch that continues a chain (lead = 1) cannot be screened by itself")
    reach = as_floats("outlier_range", outlier_range)
    if reach.shape not in ((), (N,)) or not (reach > 0).all() or not np.isfinite(reach).all():
        raise EstimationError(
            f"outlier_range has shape {reach.shape}; one positive number or one for each of {N} epochs fits"
        )
    if look_ahead < 0 or not inflation > 1:
        raise EstimationError(f"look_ahead {look_ahead} and inflation {inflation} make no sense; >= 0 and > 1 do")
    log_range = np.broadcast_to(np.log(reach), (N,))
    if not isinstance(link_rows, slice):
        link_rows = np.asarray(link_rows, np.int64)
    links = max(N - 1, 0)
    q = chain.u.shape[1]
    M, L = (np.array(np.broadcast_to(a, (links, q, n))) for a in (chain.M, chain.L))
    u, counts = np.array(np.broadcast_to(chain.u, (links, q))), chain.counts.copy()
    clean = Chain(chain.H, chain.z, M, L, u, counts=counts, coupling_counts=chain.coupling_counts, prior=chain.prior)
    weak = 1.0 / np.sqrt(inflation)
    verdicts: list[Verdict] = []
    triangle = start_triangle(chain.prior, n)
    k = 0
    while k < N:
        end = min(k + PAGE, N)
        page, after = stretch(clean, k, end), triangle.copy()
        sweep = sweep_chain(page, after, store=False, filtered=False, gate=significance)
        alarm = int(np.argmax(sweep.rejected)) if sweep.rejected.any() else -1
        if not np.isfinite(after).all():
            raise EstimationError(chain.blame())
        if sweep.broken >= 0 and (alarm < 0 or sweep.broken - page.lead < alarm):
            broken = k + sweep.broken - page.lead
            raise EstimationError(
                f"the link between epochs {broken} and {broken + 1} couples nothing; screen the two parts"
            )
        if alarm < 0:
            triangle, k = after, end
            continue
        nis, dof = float(sweep.nis[alarm]), int(sweep.dof[alarm])
        if alarm > 0:  # up to the epoch before
            sweep_chain(stretch(clean, k, k + alarm), triangle, store=False, filtered=False, gate=None)
        k += alarm
        tail = min(k + look_ahead + 1, N)
        without = stretch(clean, k, tail)
        residual = _innovation(without, triangle)
        without.counts[0] = 0
        wrong: Literal["fix", "link"] = "fix"
        odds = np.nan
        if k > 0:
            inflated = stretch(clean, k, tail)
            M_weak, L_weak, u_weak = inflated.M.copy(), inflated.L.copy(), inflated.u.copy()
            M_weak[0, link_rows] *= weak
            L_weak[0, link_rows] *= weak
            u_weak[0, link_rows] *= weak
            inflated = Chain(
                inflated.H,
                inflated.z,
                M_weak,
                L_weak,
                u_weak,
                counts=inflated.counts,
                coupling_counts=inflated.coupling_counts,
                lead=1,
            )
            drop = _evidence(without, triangle) - int(counts[k]) * float(log_range[k])
            keep = _evidence(inflated, triangle)
            odds = drop - keep
            if keep > drop:
                wrong, odds = "link", -odds
        if wrong == "fix":
            counts[k] = clean.counts[k] = 0
        else:
            clean.M[k - 1, link_rows] *= weak
            clean.L[k - 1, link_rows] *= weak
            clean.u[k - 1, link_rows] *= weak
        verdicts.append(Verdict(k, wrong, nis, dof, chi_square_limit(dof, significance), float(odds), residual))
        sweep_chain(stretch(clean, k, k + 1), triangle, store=False, filtered=False, gate=None)
        k += 1
    return Screening(clean, tuple(verdicts))


def _evidence(part: Chain, triangle: FloatArray) -> float:
    """Log-evidence of all observations of a stretch."""
    sweep = sweep_chain(part, triangle.copy(), store=False, filtered=False, gate=None, evidence=True)
    return float(sweep.log_evidence.sum())


def _innovation(part: Chain, triangle: FloatArray) -> FloatArray:
    """Measured - predicted of a stretch's first fix, whitened."""
    n, c = part.n, int(part.counts[0])
    ahead = triangle.copy()
    if part.lead:
        none = np.zeros((0, n))
        link = Chain(
            none,
            np.zeros((1, 0)),
            part.M[:1],
            part.L[:1],
            part.u[:1],
            coupling_counts=part.coupling_counts[:1],
            lead=1,
        )
        sweep_chain(link, ahead, store=False, filtered=False, gate=None)
    if (np.diagonal(ahead) == 0).any():
        return np.full(c, np.nan)
    x = np.linalg.solve(ahead[:, :n], ahead[:, n])
    return np.asarray(part.z[0, :c] - part.H[0, :c] @ x)
