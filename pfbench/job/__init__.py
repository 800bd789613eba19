"""Jobs: one filter in one condition with all its Monte Carlo runs.

    from pfbench import job

    outcome = job.run(job.compose(["scenario=linear_walk", "filter=sir", "runs=20"]))

Names are imported on first use, so that composing a configuration does not import torch.
"""

from pfbench.core.lazy_import import lazy_attributes

__getattr__, __dir__, __all__ = lazy_attributes(__name__, __file__)
