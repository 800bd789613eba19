"""Statistical tests that a user runs on an own stage or filter, each in one line.

    from pfbench.testing import check_filter, check_resampling
    check_resampling(MyScheme())
    check_filter(ParticleFilter(100, Resample(MyScheme())))

Each check simulates, compares with an independent reference and returns a `LawCheck`. It raises an
AssertionError with the statistic, its standard error and the limit when the law does not hold.
"""

from pfbench.testing.filters import (
    check_causality,
    check_convergence,
    check_evidence,
    check_filter,
    check_independence,
    filter_record,
)
from pfbench.testing.moves import PathPosterior, check_move, simulate_path_posterior
from pfbench.testing.proposals import check_proposal
from pfbench.testing.reference import (
    FilterMoments,
    KalmanResult,
    kalman_filter,
    reference_moments,
    rts_smoother,
    run_kalman_filter,
)
from pfbench.testing.resampling import check_resampling
from pfbench.testing.results import LawCheck

__all__ = [
    "FilterMoments",
    "KalmanResult",
    "LawCheck",
    "PathPosterior",
    "check_causality",
    "check_convergence",
    "check_evidence",
    "check_filter",
    "check_independence",
    "check_move",
    "check_proposal",
    "check_resampling",
    "filter_record",
    "kalman_filter",
    "reference_moments",
    "rts_smoother",
    "run_kalman_filter",
    "simulate_path_posterior",
]
