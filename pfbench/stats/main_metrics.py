"""Metrics that can decide a study.

References:
    T. Gneiting and A. E. Raftery (2007), Strictly proper scoring rules, prediction, and estimation.
    F. X. Diebold and R. S. Mariano (1995), Comparing predictive accuracy.
"""

from __future__ import annotations

MAIN_METRICS = ("rmse", "crps", "energy", "log_score", "max_error")


def check_main_metric(metric: str) -> None:
    """Check the name of the main metric."""
    if metric not in MAIN_METRICS:
        raise ValueError(
            f"report.metric must be one of {', '.join(MAIN_METRICS)}, got {metric}. "
            "Choose rmse for estimates, or crps for posterior distributions."
        )
