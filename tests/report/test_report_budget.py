"""The budget of a comparison: what a job may state is what a report knows, and the usual one changes no job's name."""

import pytest
from omegaconf import OmegaConf

from pfbench import job
from pfbench.job.plan import DEFAULTS_NOT_IN_KEY
from pfbench.results import store
from pfbench.results.store import compute_config_key

CONFIG = OmegaConf.load(job.conf_dir() / "config.yaml")


def test_a_job_states_what_a_report_knows():
    assert DEFAULTS_NOT_IN_KEY == {"budget": store.SAME_N}
    assert CONFIG.budget == store.SAME_N
    assert set(DEFAULTS_NOT_IN_KEY) <= set(CONFIG)


def test_the_usual_budget_is_no_part_of_a_jobs_name():
    config = {"filter": {"particles": 10}, "seed": 1, "results": "here"}
    before = compute_config_key(
        config, job.IGNORED_IN_KEY
    )  # of jobs that ran when there was no such key
    assert job.job_key(config) == job.job_key({**config, "budget": store.SAME_N}) == before
    others = {job.job_key({**config, "budget": kind}) for kind in store.BUDGETS}
    assert len(others) == 3
    assert job.job_key({**config, "seed": 2}) not in others


def test_an_unknown_budget_is_refused_before_anything_runs():
    config = OmegaConf.create({**OmegaConf.to_container(CONFIG, resolve=False), "budget": "fair"})
    with pytest.raises(
        ValueError, match="budget must be one of particles, time, likelihoods, got fair"
    ):
        job.apply_global_settings(config)
