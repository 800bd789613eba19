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
    "available_memory",
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
        "system_memory": ("available_memory",),
        ".config.composition": (
            "JobConfig",
            "compose",
            "list_groups",
            "register_experiments",
            "resolve_config",
        ),
        ".config.folders": ("conf_dir", "experiments_dir"),
        "datasheet_data": ("build_datasheet",),
        "metadata": ("read_versions",),
        "pcrb_cache": ("compute_pcrb",),
        "plan": (
            "IGNORED_IN_KEY",
            "JobPlan",
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
        "settings": ("apply_global_settings",),
        "scoring": (
            "ProperScores",
            "ScoreRecorder",
        ),
    },
)
