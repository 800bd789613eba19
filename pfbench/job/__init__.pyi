"""Public names of `pfbench.job` and the modules that define them."""

from pfbench.job.computation import compute_job as compute_job
from pfbench.job.config import (
    JobConfig as JobConfig,
    compose as compose,
    list_groups as list_groups,
    register_experiments as register_experiments,
    resolve_config as resolve_config,
)
from pfbench.job.datasheet_data import build_datasheet as build_datasheet
from pfbench.job.memory import available_memory as available_memory
from pfbench.job.model_fit import instantiate as instantiate
from pfbench.job.pcrb import compute_pcrb as compute_pcrb
from pfbench.job.plan import (
    JobPlan as JobPlan,
    apply_global_settings as apply_global_settings,
    build_plan as build_plan,
    read_versions as read_versions,
)
from pfbench.job.run_job import (
    JobOutcome as JobOutcome,
    run as run,
)
from pfbench.job.scoring import (
    ProperScores as ProperScores,
    ScoreRecorder as ScoreRecorder,
)
from pfbench.job.settings import IGNORED_IN_KEY as IGNORED_IN_KEY, job_key as job_key
from pfbench.logs.track_estimate import (
    FilterAnswer as FilterAnswer,
    MotionEstimate as MotionEstimate,
    TrackEstimate as TrackEstimate,
    estimate_track as estimate_track,
)
from pfbench.results.paper_block import conf_dir as conf_dir, experiments_dir as experiments_dir
