"""Public names of `pfbench.results` and the modules that define them."""

from pfbench.results.conditions import main_component_group as main_component_group
from pfbench.results.metrics import (
    GROUP_UNIT as GROUP_UNIT,
    METRICS as METRICS,
    ByComponent as ByComponent,
    Metric as Metric,
    MetricInput as MetricInput,
)
from pfbench.results.status import is_diverged as is_diverged
from pfbench.results.store import read_metadata as read_metadata
from pfbench.stats.decision import DecisionOptions as DecisionOptions
from pfbench.stats.intervals import (
    crossed_mean_interval as crossed_mean_interval,
    order_statistic_interval as order_statistic_interval,
)
from pfbench.stats.pair_states import (
    LookSchedule as LookSchedule,
    decide_pairs as decide_pairs,
    describe_end as describe_end,
    format_look as format_look,
)
from pfbench.stats.planned_pairs import decide_planned_pairs as decide_planned_pairs
from pfbench.stats.rank_tests import holm as holm, wilcoxon_signed_rank as wilcoxon_signed_rank
from pfbench.stats.sentences import describe_pair as describe_pair
from pfbench.stats.study_runs import tidy_runs as tidy_runs
from pfbench.stats.study_size import detectable_effects as detectable_effects
