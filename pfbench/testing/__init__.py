"""Statistical tests that a user runs on a new stage or filter, each in one line.

    from pfbench.testing import check_filter, check_resampling
    check_resampling(MyScheme())
    check_filter(ParticleFilter(100, EssResampler(MyScheme())))

Each check simulates, compares with an independent reference and returns a `LawCheck`. It raises an
AssertionError with the statistic, its standard error and the limit if the statement does not hold.
"""

from pfbench.core.lazy_import import lazy_attributes

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
    "check_jacobians",
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

__getattr__, __dir__ = lazy_attributes(
    __name__,
    {
        "filters": (
            "check_causality",
            "check_convergence",
            "check_evidence",
            "check_filter",
            "check_independence",
            "filter_record",
        ),
        "jacobians": ("check_jacobians",),
        "moves": (
            "PathPosterior",
            "check_move",
            "simulate_path_posterior",
        ),
        "proposals": ("check_proposal",),
        "reference": (
            "FilterMoments",
            "KalmanResult",
            "kalman_filter",
            "reference_moments",
            "rts_smoother",
            "run_kalman_filter",
        ),
        "resampling": ("check_resampling",),
        "results": ("LawCheck",),
    },
)
