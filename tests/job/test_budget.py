"""Equal budgets: every particle filter has as many particles as cost what SIR's do, and a report says what jobs measured."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import pfbench

from pfbench.core.random_stream import PhiloxStream
from pfbench.filter import EssResampler, ParticleFilter, Systematic, run_filter
from pfbench.job import budget
from pfbench.job.scoring import LikelihoodCounter
from pfbench.model.linear_gaussian import linear_walk
from pfbench.noise.base import NominalNoise
from pfbench.results import store
from pfbench.scenario.simulated import ModelSimulation

WALK = (
    "scenario=linear_walk",
    "scenario.steps=12",
    "runs=4",
    "particles=200",
    "budget=likelihoods",
)


def metas(home: Path, *words: str) -> dict[str, dict[str, Any]]:
    """By filter, what jobs say of themselves."""
    assert (said := pfbench("run", *words, home=home)).code == 0, said.err
    files = (home / "results" / "adhoc").glob("*.npz")
    found = [json.loads(str(np.load(file, allow_pickle=False)["meta"])) for file in files]
    return {meta["label"]: meta for meta in found}


@pytest.mark.parametrize("first", [10, 125, 4000])
@pytest.mark.parametrize(
    ("cost", "price", "answer"),
    [
        (lambda n: 31.0 * n, 15500.0, 500),
        (lambda n: 2.0 + 1e-3 * n, 3.0, 1000),  # much of a step costs the same whatever the number
        (lambda n: 1e-6 * n**2, 0.25, 500),
        (lambda n: 1e-5 * n ** (2 / 3), 1e-3, 1000),
    ],
)
def test_the_number_is_found_that_costs_the_price(
    cost: Any, price: float, answer: int, first: int
) -> None:
    asked: list[int] = []
    n, paid = budget.solve_particle_count(lambda n: asked.append(n) or cost(n), price, first)  # type: ignore[func-returns-value]
    assert paid == cost(n)
    assert paid == pytest.approx(price, rel=0.03)
    assert n == pytest.approx(answer, rel=0.1)
    assert len(asked) == len(set(asked)) <= 8


def test_a_filter_that_costs_more_with_the_fewest_particles_gets_those() -> None:
    n, paid = budget.solve_particle_count(lambda n: 50.0 + n, 20.0, 100)
    assert (n, paid) == (budget.MIN_PARTICLES, 60.0)


def test_a_measurement_that_scatters_leaves_the_best_that_was_seen() -> None:
    rng = np.random.default_rng(3)
    ends = [
        budget.solve_particle_count(
            lambda n: (1.0 + 0.01 * n) * np.exp(0.05 * rng.standard_normal()), 6.0, 50
        )
        for _ in range(50)
    ]
    assert all(abs(np.log(paid / 6.0)) < 0.15 for _, paid in ends)
    assert np.median([n for n, _ in ends]) == pytest.approx(500, rel=0.1)


def test_a_trial_counts_what_a_filter_asks_of_the_likelihood() -> None:
    """Bootstrap weighs each particle once in each step; the model's own count in a whole run is the same."""
    model = linear_walk(1.0, 0.3, 1.0)
    episode = ModelSimulation(model, 300).draw(NominalNoise(), torch.arange(3), 1)
    tally = LikelihoodCounter(model)
    trial = budget.CostTrial(model, episode.record, lambda: 0.0, 1, tally, lambda method: 3)
    assert trial.likelihoods(ParticleFilter(70)) == 70.0
    before = tally.count
    run_filter(ParticleFilter(70), model, episode.record, PhiloxStream(1, torch.arange(3)))
    assert tally.count - before == 70 * 3 * 300
    assert trial.seconds(ParticleFilter(70)) == 0.0  # by its clock, which stands still


def test_time_is_that_of_a_step_by_the_quicker_of_two_passes() -> None:
    model = linear_walk(1.0, 0.3, 1.0)
    record = ModelSimulation(model, 20).draw(NominalNoise(), torch.arange(2), 1).record
    ticks = iter([0.0, 10.0, 20.0, 25.0])
    trial = budget.CostTrial(
        model, record, lambda: next(ticks), 1, LikelihoodCounter(model), lambda method: 2
    )
    assert trial.seconds(ParticleFilter(10)) == 5.0 / 20


def test_sir_itself_has_what_was_asked_for_and_a_variant_is_tried() -> None:
    model = linear_walk(1.0, 0.3, 1.0)
    record = ModelSimulation(model, 20).draw(NominalNoise(), torch.arange(2), 1).record
    trial = budget.CostTrial(
        model, record, lambda: 0.0, 1, LikelihoodCounter(model), lambda method: 2
    )
    own = budget.allocate_budget(store.SAME_LIKELIHOODS, ParticleFilter(333), 333, trial)
    assert own == budget.BudgetAllocation(333, 333.0, 333.0, 333)
    always = ParticleFilter(333, resampler=EssResampler(Systematic(), ess_threshold=1.0))
    assert budget.allocate_budget(
        store.SAME_LIKELIHOODS, always, 333, trial
    ).particles == pytest.approx(333, rel=0.03)


@pytest.mark.parametrize(("steps", "expected"), [(12, (34, 12)), (150, (3, 150)), (400, (2, 200))])
def test_likelihoods_of_a_short_record_are_counted_in_more_runs(steps: int, expected: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    """At least 400 steps of all runs together: only some of them are resampled, and moved."""
    model = linear_walk(1.0, 0.3, 1.0)
    record = ModelSimulation(model, steps).draw(NominalNoise(), torch.arange(50), 1).record
    shapes: list[tuple[int, int]] = []
    monkeypatch.setattr(budget.CostTrial, "_run", lambda self, method, part: shapes.append(tuple(part.y.shape[:2])))  # fmt: skip
    budget.CostTrial(model, record, lambda: 0.0, 1, LikelihoodCounter(model), lambda method: 2).likelihoods(None)  # fmt: skip
    assert shapes == [expected]


def test_filters_of_a_study_evaluate_the_likelihood_equally_often(tmp_path: Path) -> None:
    found = metas(
        tmp_path, "-m", *WALK, "particles=1000", "filter=sir,apf,pso_pf,mcmc_rpf,ekf,cofm_amssrcpf"
    )
    for name in ("sir", "apf", "pso_pf", "mcmc_rpf"):
        assert found[name]["likelihoods_per_step"] == pytest.approx(1000, rel=0.15), name
        assert found[name]["budget_allocation"]["price"] == 1000.0
        assert found[name]["budget_allocation"]["particles"] == found[name]["particles"]
    assert found["sir"]["particles"] == 1000
    assert found["pso_pf"]["particles"] < 100  # it looks again in each of its iterations
    assert found["ekf"]["particles"] is None  # nothing to buy
    assert (found["cofm_amssrcpf"]["particles"], found["cofm_amssrcpf"]["budget_allocation"]) == (
        200,
        None,
    )  # has a number of its own
    assert (
        said := pfbench("report", "study=adhoc", f"reports_dir={tmp_path}", home=tmp_path)
    ).code == 0, said.err


def test_a_number_that_was_given_to_a_filter_stays(tmp_path: Path) -> None:
    found = metas(tmp_path, *WALK, "filter=mcmc_rpf", "filter.particles=60")["mcmc_rpf"]
    assert (found["particles"], found["budget_allocation"]) == (60, None)


def test_the_same_number_buys_nothing_and_equal_time_finds_one(tmp_path: Path) -> None:
    walk = [word for word in WALK if not word.startswith("budget")]
    assert metas(tmp_path, *walk, "filter=mcmc_rpf")["mcmc_rpf"]["budget_allocation"] is None
    home = tmp_path / "time"
    found = metas(home, *walk, "filter=mcmc_rpf", "budget=time")["mcmc_rpf"]
    assert (
        budget.MIN_PARTICLES <= found["particles"] == found["budget_allocation"]["particles"] < 200
    )  # dearer than SIR, whatever the machine
    assert found["budget_allocation"]["request"] == 200


def test_a_step_compiled_as_a_whole_has_no_known_price(tmp_path: Path) -> None:
    said = pfbench("run", *WALK, "filter=apf", "engine=compiled", home=tmp_path)
    assert said.code == 1
    assert "with budget=likelihoods, got compiled" in said.err
    assert "Use engine=auto" in said.err
