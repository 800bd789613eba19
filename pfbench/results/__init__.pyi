"""Public names of `pfbench.results` and the modules that define them."""

from pfbench.results.decisions.options import DecisionOptions as DecisionOptions
from pfbench.results.decisions.planned_pairs import decide_planned_pairs as decide_planned_pairs
from pfbench.results.decisions.sentences import describe_pair as describe_pair
from pfbench.results.decisions.tidy_table import tidy_runs as tidy_runs
from pfbench.results.metric_values import (
    ByComponent as ByComponent,
    MetricInput as MetricInput,
)
from pfbench.results.metrics import (
    GROUP_UNIT as GROUP_UNIT,
    METRICS as METRICS,
    Metric as Metric,
)
from pfbench.results.state_groups import main_component_group as main_component_group
from pfbench.results.statistics.intervals import (
    crossed_mean_interval as crossed_mean_interval,
    order_statistic_interval as order_statistic_interval,
)
from pfbench.results.statistics.signed_rank import (
    holm as holm,
    wilcoxon_signed_rank as wilcoxon_signed_rank,
)
from pfbench.results.statistics.study_size import detectable_effects as detectable_effects
from pfbench.results.status import is_diverged as is_diverged
from pfbench.results.store import read_metadata as read_metadata
from pfbench.results.until_decided.look_lines import (
    describe_end as describe_end,
    format_look as format_look,
)
from pfbench.results.until_decided.look_schedule import LookSchedule as LookSchedule
from pfbench.results.until_decided.pair_states import decide_pairs as decide_pairs
