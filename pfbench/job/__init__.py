"""Jobs: one filter in one condition with all its Monte Carlo runs.

    from pfbench import job

    outcome = job.run(job.compose(["scenario=linear_walk", "filter=sir", "runs=20"]))

Names are imported on first use, so that composing a configuration does not import torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pfbench.job.configuration import JobConfig as JobConfig
    from pfbench.job.configuration import compose as compose
    from pfbench.job.configuration import conf_dir as conf_dir
    from pfbench.job.configuration import experiments_dir as experiments_dir
    from pfbench.job.configuration import list_groups as list_groups
    from pfbench.job.configuration import register_experiments as register_experiments
    from pfbench.job.configuration import resolve_config as resolve_config
    from pfbench.job.datasheet_data import build_datasheet as build_datasheet
    from pfbench.job.metadata import read_versions as read_versions
    from pfbench.job.pcrb_cache import compute_pcrb as compute_pcrb
    from pfbench.job.plan import IGNORED_IN_KEY as IGNORED_IN_KEY
    from pfbench.job.plan import JobPlan as JobPlan
    from pfbench.job.plan import apply_global_settings as apply_global_settings
    from pfbench.job.plan import build_plan as build_plan
    from pfbench.job.plan import instantiate as instantiate
    from pfbench.job.plan import job_key as job_key
    from pfbench.job.resumable import ResumableResults as ResumableResults
    from pfbench.job.run_job import JobOutcome as JobOutcome
    from pfbench.job.run_job import compute_job as compute_job
    from pfbench.job.run_job import run as run
    from pfbench.job.scoring import ProperScores as ProperScores
    from pfbench.job.scoring import ScoreRecorder as ScoreRecorder

_MODULES = {
    "JobConfig": "configuration",
    "compose": "configuration",
    "conf_dir": "configuration",
    "experiments_dir": "configuration",
    "list_groups": "configuration",
    "register_experiments": "configuration",
    "resolve_config": "configuration",
    "build_datasheet": "datasheet_data",
    "read_versions": "metadata",
    "compute_pcrb": "pcrb_cache",
    "IGNORED_IN_KEY": "plan",
    "JobPlan": "plan",
    "apply_global_settings": "plan",
    "build_plan": "plan",
    "instantiate": "plan",
    "job_key": "plan",
    "ResumableResults": "resumable",
    "JobOutcome": "run_job",
    "compute_job": "run_job",
    "run": "run_job",
    "ProperScores": "scoring",
    "ScoreRecorder": "scoring",
}
__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} does not define {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
