"""Judge: trajectories of other programs under the metrics and decisions of a study.

The public names of this folder are imported on first use.
"""

from pfbench.core.lazy_import import lazy_attributes

__getattr__, __dir__ = lazy_attributes(
    __name__,
    {
        "block_decisions": ("describe_blocks",),
        "judgement": ("judge_programs",),
    },
)

__all__ = __dir__()
