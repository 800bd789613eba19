"""Public names of `pfbench.testing` and the modules that define them."""

from pfbench.logs.sky.raw_log import write_raw_log as write_raw_log
from pfbench.testing.filters import (
    check_bounded_weights as check_bounded_weights,
    check_causality as check_causality,
    check_convergence as check_convergence,
    check_evidence as check_evidence,
    check_filter as check_filter,
    check_independence as check_independence,
    filter_record as filter_record,
)
from pfbench.testing.models import (
    check_jacobians as check_jacobians,
    check_proposal as check_proposal,
    check_regime as check_regime,
    check_scenario as check_scenario,
)
from pfbench.testing.moves import (
    PathPosterior as PathPosterior,
    check_move as check_move,
    simulate_path_posterior as simulate_path_posterior,
)
from pfbench.testing.reference import (
    FilterMoments as FilterMoments,
    KalmanResult as KalmanResult,
    kalman_filter as kalman_filter,
    reference_moments as reference_moments,
    rts_smoother as rts_smoother,
    run_kalman_filter as run_kalman_filter,
)
from pfbench.testing.resampling import check_resampling as check_resampling
from pfbench.testing.results import LawCheck as LawCheck
