"""Jobs: one filter in one condition with all its Monte Carlo runs.

    from pfbench import job

    outcome = job.run(job.compose(["scenario=linear_walk", "filter=sir", "runs=20"]))

Names are imported on first use, so that composing a configuration does not import torch.
"""

from pfbench.core.lazy_import import lazy_attributes

__all__ = [
    "IGNORED_IN_KEY",
    "JobConfig",
    "JobOutcome",
    "JobPlan",
    "ProperScores",
    "ResumableResults",
    "ScoreRecorder",
    "apply_global_settings",
    "build_datasheet",
    "build_plan",
    "compose",
    "compute_job",
    "compute_pcrb",
    "conf_dir",
    "experiments_dir",
    "instantiate",
    "job_key",
    "list_groups",
    "read_versions",
    "register_experiments",
    "resolve_config",
    "run",
]

__getattr__, __dir__ = lazy_attributes(
    __name__,
    {
        "configuration": (
            "JobConfig",
            "compose",
            "conf_dir",
            "experiments_dir",
            "list_groups",
            "register_experiments",
            "resolve_config",
        ),
        "datasheet_data": ("build_datasheet",),
        "metadata": ("read_versions",),
        "pcrb_cache": ("compute_pcrb",),
        "plan": (
            "IGNORED_IN_KEY",
            "JobPlan",
            "apply_global_settings",
            "build_plan",
            "instantiate",
            "job_key",
        ),
        "resumable": ("ResumableResults",),
        "run_job": (
            "JobOutcome",
            "compute_job",
            "run",
        ),
        "scoring": (
            "ProperScores",
            "ScoreRecorder",
        ),
    },
)
