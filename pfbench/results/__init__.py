"""Stored results, metrics and statistics of studies. Needs neither torch nor hydra.

The public names of this folder are imported on first use.
"""

from pfbench.core.lazy_import import lazy_attributes

__getattr__, __dir__ = lazy_attributes(
    __name__,
    {
        "decisions.planned_pairs": ("decide_planned_pairs",),
        "decisions.sentences": ("describe_pair",),
        "decisions.tidy_table": ("tidy_runs",),
        "metric_values": (
            "ByComponent",
            "MetricInput",
        ),
        "metrics": (
            "GROUP_UNIT",
            "METRICS",
            "Metric",
        ),
        "state_groups": ("main_component_group",),
        "statistics.signed_rank": (
            "holm",
            "wilcoxon_signed_rank",
        ),
        "status": ("is_diverged",),
        "store": ("read_metadata",),
        "until_decided.look_lines": (
            "describe_end",
            "format_look",
        ),
        "until_decided.look_schedule": ("LookSchedule",),
        "until_decided.pair_states": ("decide_pairs",),
    },
)

__all__ = __dir__()
