"""Equal time on the page: which filters are offered from several numbers of particles."""

from __future__ import annotations

from typing import Any

import pytest
from omegaconf import OmegaConf

from pfbench import job
from pfbench.job.settings import DEFAULTS_NOT_IN_KEY
from pfbench.report.study_page.page_writer import offer_budgets, select_equal_time
from pfbench.results import store
from pfbench.results.store import compute_config_key

TIMES = {
    "sir[particles=100]": (100, 1.0), "sir[particles=400]": (400, 2.0), "sir[particles=1600]": (1600, 7.0),
    "apf[particles=100,resampler=x]": (100, 3.0), "apf[particles=400,resampler=x]": (400, 9.0),
    "apf[resampler=y]": (100, 2.5), "pso": (100, 4.0), "ekf": (0, 0.5),
}  # fmt: skip


def make_pack(times: dict[str, tuple[int, float]] = TIMES) -> dict[str, Any]:
    rows = [{"filter": key, "ms": ms} for key, (_, ms) in times.items()]
    missing = "The study has no jobs with budget=time."
    return {
        "views": {("rmse", "all", "all", "ekf"): {"rows": rows}},
        "filter_notes": [
            {"filter": key, "particles": str(n or "")} for key, (n, _) in times.items()
        ],
        "budgets": [
            {"key": "particles", "name": "Equal N", "reason_missing": None},
            {"key": "time", "name": "Equal time", "reason_missing": missing},
        ],
    }


def test_each_filter_has_the_most_particles_below_the_limit() -> None:
    """The limit is apf with its fewest particles: 3 ms. pso, with one number, exceeds it."""
    limit, filters = select_equal_time(make_pack())
    assert limit == 3.0
    assert filters == [
        "sir[particles=400]", "apf[particles=100,resampler=x]", "apf[resampler=y]", "ekf",
    ]  # fmt: skip
    equal_n, equal_time = offer_budgets(make_pack())
    assert "filters" not in equal_n
    assert equal_time["reason_missing"] is None
    assert equal_time["filters"] == filters
    assert "up to 3.00 ms per step" in equal_time["words"]


def test_one_filter_with_several_numbers_gives_no_choice() -> None:
    times = {key: value for key, value in TIMES.items() if "apf" not in key}
    assert offer_budgets(make_pack(times)) == make_pack(times)["budgets"]
    assert select_equal_time(make_pack(times)) == (0.0, [])


def test_filters_without_a_time_are_left_out() -> None:
    pack = make_pack()
    next(iter(pack["views"].values()))["rows"][1]["ms"] = None
    assert select_equal_time(pack)[1][0] == "sir[particles=100]"


# the budget of a comparison: what a job may state is what a report knows, and the usual one changes no job's name

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
