"""The budget of a comparison: what a job may state is what a report knows, and the usual one changes no job's name."""

import pytest
from omegaconf import OmegaConf

from pfbench import cli, job, store

CONFIG = OmegaConf.load(cli.conf_dir() / "config.yaml")


def test_a_job_states_what_a_report_knows():
    assert job.USUAL == {"budget": store.SAME_N}
    assert CONFIG.budget == store.SAME_N
    assert set(job.USUAL) <= set(CONFIG)


def test_the_usual_budget_is_no_part_of_a_jobs_name():
    config = {"filter": {"particles": 10}, "seed": 1, "results": "here"}
    before = store.key(config, job.PLACES)  # of jobs that ran when there was no such key
    assert job.name_of(config) == job.name_of({**config, "budget": store.SAME_N}) == before
    others = {job.name_of({**config, "budget": kind}) for kind in store.BUDGETS}
    assert len(others) == 3
    assert job.name_of({**config, "seed": 2}) not in others


def test_an_unknown_budget_is_refused_before_anything_runs():
    config = OmegaConf.create({**OmegaConf.to_container(CONFIG, resolve=False), "budget": "fair"})
    with pytest.raises(ValueError, match="budget=fair: give one of same N, same time per step, same likelihood evaluations"):
        job.settings(config)
