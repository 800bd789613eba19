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

    assert (
        provenance.format_budget([job(100), job(None)])
        == "Budget: particles (N = 100 in each particle filter)."
    )
    assert "not met (N = 100, 400)" in provenance.format_budget([job(100), job(400)])
    used = [{"least": low, "mean": mean, "most": 200} for low, mean in ((100, 120.0), (110, 140.0))]
    changing = [{**job(200), "label": "grows", "particles_used": one} for one in used]
    said = provenance.format_budget([job(100), job(100), *changing, job(100)])
    assert "N = 100, 200 of grows, grows used 100 to 200, 130 on average" in said
    kind = "time"
    alike = [job(100, budget=kind), job(100, 1.05e-3, budget=kind), job(9, 1.1e-3, budget=kind)]
    said = provenance.format_budget(
        [*alike, job(None, 1e-5, budget=kind)]
    )  # a filter without particles has no number to keep it by
    assert said == f"Budget: {kind} (1 to 1.1 ms per step, particle filters only, N = 100, 9)."
    dear = job(9, 5e-3, budget=kind) | {"label": "dear"}
    assert f"{kind} not met by dear (4.7 times the target) (1 to 5 ms" in provenance.format_budget(
        [*alike, dear]
    )
    priced = [{**one, "budget_allocation": {"price": 1e-3}} for one in alike]
    slow = [
        {**job(9, k * 1e-2, budget=kind), "budget_allocation": {"price": 1e-2}} for k in (1, 1.1)
    ]  # a cell where SIR takes longer
    assert "not met" not in provenance.format_budget([*priced, *slow])
    twice = [{**dear, "budget_allocation": {"price": price}} for price in (1e-3, 2e-3)]
    assert "not met by dear (2.5 to 5 times the target)" in provenance.format_budget(
        [*priced, *twice]
    )
    counted = [
        {**job(n, budget=store.BUDGETS[2]), "likelihoods_per_step": n * k}
        for n, k in ((100, 1.0), (10, 11.0))
    ]
    said = "(100 to 110 per step, particle filters only, N = 10, 100)."
    assert provenance.format_budget(counted) == f"Budget: likelihoods {said}"
    assert "do not count them" in provenance.format_budget(
        [*counted, job(1, budget=store.BUDGETS[2])]
    )
    assert "differs between jobs" in provenance.format_budget([job(100), job(100, budget=kind)])
    with pytest.raises(ValueError, match=r"budget must be one of .* got fair"):
        provenance.format_budget([job(1, budget="fair")])
