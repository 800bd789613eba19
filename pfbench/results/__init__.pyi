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
from pfbench.stats.comparison import (
    MIN_RUNS as MIN_RUNS,
    Effect as Effect,
    Verdict as Verdict,
    compare as compare,
    decide as decide,
    find_largest_p as find_largest_p,
)
from pfbench.stats.pair_states import (
    LookSchedule as LookSchedule,
    decide_at_looks as decide_at_looks,
    describe_end as describe_end,
    format_look as format_look,
)
from pfbench.stats.rank_tests import holm as holm, wilcoxon_signed_rank as wilcoxon_signed_rank
from pfbench.stats.sentences import format_with_interval as format_with_interval
from pfbench.stats.study_runs import (
    StudyRuns as StudyRuns,
    arrange_runs as arrange_runs,
    compare_filters as compare_filters,
    compute_losses as compute_losses,
)
from pfbench.stats.study_size import (
    count_needed_runs as count_needed_runs,
    detectable_effects as detectable_effects,
)
