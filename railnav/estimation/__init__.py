"""Square-root estimation: chains, filters and smoothers, gross-error tests, consistency. Pure linear algebra.

This room knows nothing of the Earth, of track or of trains. It takes whitened rows (unit noise) or roots of covariances, and
rotates; no normal equations, no difference of covariances.

- **Chain.** `Chain` holds the rows of a block-bidiagonal Gauss-Markov model, `solve_chain` gives all states with their
  covariances, NIS and residual statistics, `ChainFilter` takes the same rows live in constant memory. `increment_chain`,
  `survey_chain` (drifts, correlated errors) and `constant_velocity_chain` make the rows of the usual states,
  `fit_planar_curve` estimates a curve through its curvature.
- **Constants and few noises.** `solve_bordered_chain`: rows that also hold constants (scale, lever arm, run bias);
  `solve_driven_chain`: process noise of a rank below n.
- **Merging.** `ChainRecords` is what a chain knows; `merge_chain` puts it beside the rows of a new run, `change_test` says before
  where something moved, `aged` and `forgotten` let go; `observe_between` takes fixes between nodes, `reverse_chain` the other
  direction.
- **Groups.** `group_least_squares` finds unknowns group by group, by projections kept as orthonormal bases.
- **Networks.** `adjust_network` holds vectors between points (GNSS baselines) to known points; `network_loops` closes their loops.
- **Covariance roots.** `predict`, `update`, `smooth` on P_sqrt (lower triangular, positive diagonal, P = P_sqrt P_sqrt^T);
  `inverse_root` whitens, `lower_root` takes roots, `repair_covariance` mends rounding. Compiled loops elsewhere call
  `predict_kernel`, `innovation_variance_kernel`, `update_scalar_kernel`, `update_kernel` and `smooth_kernel` of
  `railnav.estimation._kernels` directly.
- **Tests.** `block_test`, `component_test`, `geometric_test`: is a measurement wrong? `nees`, `consistency`, `coverage`: does the
  estimator know how wrong it is?
- **Screening.** `screen_chain` finds gross errors and attributes each to the fix or to the link by what comes after.
- **Oracle.** `railnav.estimation.oracle`: the same answers by dense least squares, banded normal equations, plain numpy
  rotations and the textbook Kalman filter, for tests and benchmarks.

Conventions: innovation = measured - predicted; whitened numbers have unit variance; states are corrections to nominal values;
epoch k couples to epoch k + 1 by M_k x_k + L_k x_(k+1) = u_k.
"""

from railnav.estimation.bordered import BorderedSolution, solve_bordered_chain
from railnav.estimation.chain import Chain, solve_chain
from railnav.estimation.chain_filter import BlockResult, ChainFilter, FilterEstimate, SweepResult
from railnav.estimation.chain_solution import ChainSolution, fixed_lag
from railnav.estimation.change import ChangeTest, change_test
from railnav.estimation.consistency import Consistency, Coverage, consistency, coverage, nees
from railnav.estimation.driven import DrivenSolution, solve_driven_chain
from railnav.estimation.gross_error import (
    BlockTest,
    GeometricTest,
    block_test,
    chi_square_limit,
    component_test,
    geometric_test,
    geometric_tolerance,
)
from railnav.estimation.groups import GroupSolution, group_least_squares
from railnav.estimation.menus import (
    CorrelatedError,
    IncrementDrift,
    PlanarCurve,
    constant_velocity_chain,
    fit_planar_curve,
    increment_chain,
    survey_chain,
)
from railnav.estimation.merging import (
    ChainRecords,
    merge_chain,
    observe_between,
    reverse_chain,
)
from railnav.estimation.network import Loop, NetworkSolution, adjust_network, network_loops
from railnav.estimation.screening import Screening, Verdict, screen_chain
from railnav.estimation.square_root import (
    RepairedCovariance,
    Smoothed,
    Update,
    inverse_root,
    lower_root,
    predict,
    repair_covariance,
    smooth,
    update,
)

__all__ = [
    "BlockResult",
    "BlockTest",
    "BorderedSolution",
    "Chain",
    "ChainFilter",
    "ChainRecords",
    "ChainSolution",
    "ChangeTest",
    "Consistency",
    "CorrelatedError",
    "Coverage",
    "DrivenSolution",
    "FilterEstimate",
    "GeometricTest",
    "GroupSolution",
    "IncrementDrift",
    "Loop",
    "NetworkSolution",
    "PlanarCurve",
    "RepairedCovariance",
    "Screening",
    "Smoothed",
    "SweepResult",
    "Update",
    "Verdict",
    "adjust_network",
    "block_test",
    "change_test",
    "chi_square_limit",
    "component_test",
    "consistency",
    "constant_velocity_chain",
    "coverage",
    "fit_planar_curve",
    "fixed_lag",
    "geometric_test",
    "geometric_tolerance",
    "group_least_squares",
    "increment_chain",
    "inverse_root",
    "lower_root",
    "merge_chain",
    "nees",
    "network_loops",
    "observe_between",
    "predict",
    "repair_covariance",
    "reverse_chain",
    "screen_chain",
    "smooth",
    "solve_bordered_chain",
    "solve_chain",
    "solve_driven_chain",
    "survey_chain",
    "update",
]
