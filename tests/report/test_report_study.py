"""The budget that compared jobs had, as a report states it."""

import pytest

from pfbench.report import provenance
from pfbench.results import store


def test_a_budget_that_was_not_kept_is_not_claimed():
    def job(particles, per_step=1e-3, **config):
        return {
            "key": "k",
            "particles": particles,
            "seconds": {"per_step": per_step},
            "config": config,
        }

    def said(*jobs):
        return provenance.format_budget(jobs).removeprefix("Budget: ")

    assert said(job(100), job(None)) == "particles (100 particles in each particle filter)."
    more = job(400) | {"label": "more"}
    assert "not met by more (4 times the target) (100 to 400 part" in said(job(100), job(100), more)
    used = [{"least": low, "mean": mean, "most": 200} for low, mean in ((100, 120.0), (110, 140.0))]
    changing = [{**job(200), "label": "grows", "particles_used": one} for one in used]
    assert "grows (1.2 to 1.4 times the target)" in said(*[job(100)] * 3, *changing)
    kind = "time"
    alike = [job(100, budget=kind), job(100, 1.05e-3, budget=kind), job(9, 1.1e-3, budget=kind)]
    deterministic = job(None, 1e-5, budget=kind)  # no number of particles to keep it by
    assert said(*alike, deterministic) == f"{kind} (1 to 1.1 ms per step in each particle filter)."
    dear = job(9, 5e-3, budget=kind) | {"label": "dear"}
    assert f"{kind} not met by dear (4.7 times the target) (1 to 5 ms" in said(*alike, dear)
    priced = [{**one, "budget_allocation": {"price": 1e-3}} for one in alike]
    slow = [
        {**job(9, k * 1e-2, budget=kind), "budget_allocation": {"price": 1e-2}} for k in (1, 1.1)
    ]  # a cell where SIR takes longer
    assert "not met" not in said(*priced, *slow)
    twice = [{**dear, "budget_allocation": {"price": price}} for price in (1e-3, 2e-3)]
    assert "not met by dear (2.5 to 5 times the target)" in said(*priced, *twice)
    counted = [
        {**job(n, budget=store.BUDGETS[2]), "likelihoods_per_step": n * k}
        for n, k in ((100, 1.0), (10, 11.0))
    ]
    assert (
        said(*counted) == "likelihoods (100 to 110 likelihoods per step in each particle filter)."
    )
    assert "do not count them" in said(*counted, job(1, budget=store.BUDGETS[2]))
    assert "differs between jobs" in said(job(100), job(100, budget=kind))
    with pytest.raises(ValueError, match=r"must be one of .* got fair"):
        said(job(1, budget="fair"))
