"""A guide of a Pyro program as a proposal, against the exact answers of a linear model."""

import math
import re
from typing import Any

import numpy as np
import pyro
import pytest
import torch
from pyro.distributions import Gamma, Laplace, LogNormal, MultivariateNormal, Normal, Poisson
from smoothing_cases import SINGULAR, record_of
from torch import Tensor

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    GaussianFilter,
    ParticleBelief,
    ParticleFilter,
    TaylorLinearisation,
    TwistedParticleFilter,
)
from pfbench.model.linear_gaussian import local_level
from pfbench.ppl import (
    FilterLikelihood,
    GaussianHmmLikelihood,
    GuideProposal,
    ParameterisedModel,
    ParameterPosterior,
    PyroModel,
    pmmh,
    repeat_runs,
    simulate,
)

Q, S = 0.6, 1.0  # standard deviations of a step and of a measurement
MODEL, EKF = local_level(Q, S, 0.0, 2.0), GaussianFilter(TaylorLinearisation())


def optimal(model: Any, x: Tensor, record: Record) -> None:
    """The law of the noise given parent and measurement."""
    sd = S / math.hypot(Q, S)
    pyro.sample("noise", Normal(Q / (Q**2 + S**2) * (record.y.unsqueeze(1) - x), sd).to_event(1))


def wide(model: Any, x: Tensor, record: Record) -> None:
    """Another law, with heavier tails than the noise."""
    pyro.sample("noise", Laplace(0.2 * torch.ones_like(x), 1.2).to_event(1))


def tilted(model: Any, x: Tensor, record: Record) -> None:
    scale = 1.4 * torch.eye(1, dtype=x.dtype).expand(*x.shape[:2], 1, 1)
    pyro.sample("noise", MultivariateNormal(0.3 * torch.ones_like(x), scale_tril=scale))


def draw(guide: Any, runs: int = 3, n: int = 50, seed: int = 1) -> tuple[Any, Tensor, Record]:
    stream = PhiloxStream(seed, torch.arange(runs))
    x = 2.0 * stream.at_step(0).normal("x", n, 1)
    log_w = torch.full((runs, n), -math.log(n), dtype=torch.float64)
    belief = ParticleBelief(x, log_w, torch.zeros(runs, dtype=torch.float64))
    record = Record(torch.tensor([[0.4]] * runs, dtype=torch.float64))
    return GuideProposal(guide)(MODEL, belief, record, stream.at_step(1)), x, record


def test_the_weights_of_the_optimal_guide_depend_on_the_parent_alone() -> None:
    """p(w) p(y | x) / q(w) is the predictive density N(y; parent, Q^2 + S^2), whatever was drawn."""
    sample, parents, record = draw(optimal)
    log_weight = sample.log_ratio + MODEL.log_likelihood(record.y, sample.x, record.u)
    variance = Q**2 + S**2
    expected = -0.5 * (math.log(2 * math.pi * variance) + (0.4 - parents[..., 0]) ** 2 / variance)
    torch.testing.assert_close(log_weight, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("guide", [optimal, wide, tilted])
def test_the_likelihood_is_unbiased_for_any_guide(guide: Any) -> None:
    """Mean over runs of the estimate divided by the exact likelihood is 1, within four standard errors."""
    runs, steps = 400, 8
    y = torch.randn(1, steps, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    record = Record(y.expand(runs, steps, 1))
    log_exact = GaussianHmmLikelihood()(MODEL, Record(y))
    method = ParticleFilter(60, proposal=GuideProposal(guide))
    ratio = (FilterLikelihood(method, seed=5)(MODEL, record) - log_exact).exp().numpy()
    assert abs(ratio.mean() - 1) < 4 * ratio.std(ddof=1) / math.sqrt(runs)
    assert ratio.std() < 1.0


def test_the_numbers_are_those_of_the_stream_and_not_of_torch() -> None:
    torch.manual_seed(1)
    first = draw(wide)[0].w
    torch.manual_seed(2)
    state = torch.get_rng_state()
    assert torch.equal(draw(wide)[0].w, first)
    assert torch.equal(torch.get_rng_state(), state)
    assert not torch.equal(draw(wide, seed=2)[0].w, first)
    assert torch.equal(draw(wide, runs=2)[0].w, first[:2])


@pytest.mark.parametrize(
    ("guide", "sentence"),
    [
        (lambda model, x, record: None, "must sample the site 'noise' and no other one, got none"),
        (lambda model, x, record: pyro.sample("z", Normal(x, 1.0).to_event(1)), "and no other one, got ['z']"),
        (lambda model, x, record: pyro.sample("noise", Normal(x, 1.0)), "site 'noise' must have one event dimension, occur once, and not be observed, got []"),
        (lambda model, x, record: pyro.sample("noise", Gamma(x.abs() + 1, 1.0).to_event(1)), "got Gamma. Use Normal"),
    ],
)  # fmt: skip
def test_other_guides_are_refused_in_a_sentence(guide: Any, sentence: str) -> None:
    with pytest.raises(ValueError, match=re.escape(sentence)):
        draw(guide)


def test_draws_pass_to_arviz_with_chains_draws_and_runs() -> None:
    pytest.importorskip("arviz_base")
    shared, own = torch.randn(2, 5), torch.randn(2, 5, 3)
    posterior = ParameterPosterior({"a": shared, "b": own}, method="NUTS").to_arviz().posterior
    assert posterior["a"].dims == ("chain", "draw")
    assert posterior["b"].dims == ("chain", "draw", "run")
    np.testing.assert_array_equal(posterior["b"].values, own.double().numpy())


def test_arviz_gets_the_log_density_of_each_fix_and_finds_the_one_that_is_off() -> None:
    """Two runs with a gap: the terms of a draw sum to its likelihood, and only the outlier has a large Pareto k."""
    pytest.importorskip("arviz_base")
    record = Record(torch.linspace(-1.0, 1.0, 24, dtype=torch.float64).view(2, 12, 1).sin())
    record.y[0, 3], record.y[1, 5] = torch.nan, 9.0
    unknown = ParameterisedModel(
        lambda sd: local_level(0.5, sd, 0.0, 1.0), {"sd": LogNormal(0.0, 0.7)}
    )
    posterior = pmmh(unknown, EKF, record, 60, 20, chains=4, seed=1)
    data = posterior.to_arviz(unknown, EKF, record)
    terms = data.log_likelihood["y"]
    assert terms.shape == (4, 60, 23)
    model, _ = unknown.models_per_run({"sd": posterior.draws["sd"][:, -1]}, 2)
    exact = FilterLikelihood(EKF)(model, repeat_runs(record, 4)).view(4, 2).sum(1)
    np.testing.assert_allclose(terms.sum(terms.dims[-1])[:, -1], exact)
    assert {"lp", "acceptance_rate"} == set(data.sample_stats.data_vars)
    assert data.prior["sd"].shape == (4, 60)
    stats = pytest.importorskip("arviz_stats.loo")
    with pytest.warns(UserWarning, match="Pareto"):
        k = stats.loo(data, pointwise=True).pareto_k.values.ravel()
    assert k.argmax() == 11 + 5


def begin(q: Any = 0.0, r: Any = 0.0) -> None:
    pyro.sample("x", Normal(torch.zeros(1).double(), 2.0).to_event(1))


def walk(x: Tensor, u: Any, q: Any, r: Any) -> None:
    x = pyro.sample("x", Normal(x, q).to_event(1))
    pyro.sample("y", Normal(x, r).to_event(1))


def test_a_program_of_a_step_is_the_model_that_it_describes() -> None:
    """The same evidence by Kalman and particle filters with the same numbers, and the same gradient, of a batch of parameters."""
    record, _ = simulate(MODEL, Record(torch.zeros(2, 12, 1).double()), 1)
    values = {"q": torch.tensor([0.3, 0.9], requires_grad=True), "r": torch.tensor([1.0, 0.7])}
    prior = {name: LogNormal(0.0, 1.0) for name in values}
    program = ParameterisedModel(lambda q, r: PyroModel(begin, walk, q=q, r=r), prior)
    library = ParameterisedModel(lambda q, r: local_level(q, r, 0.0, 2.0), prior)
    for method in (EKF, ParticleFilter(50), TwistedParticleFilter(10)):
        found, expected = (
            FilterLikelihood(method)(u.models_per_run(values)[0], record)
            for u in (program, library)
        )
        torch.testing.assert_close(found, expected)
        if method is EKF:
            slopes = [torch.autograd.grad(a.sum(), values["q"])[0] for a in (found, expected)]
            torch.testing.assert_close(*slopes)
    x = torch.randn(2, 5, 1).double()
    torch.testing.assert_close(
        program.some_model().transition(x, ()).log_prob(x + 1.0),
        library.some_model().transition(x, ()).log_prob(x + 1.0),
    )


def test_a_program_may_have_fewer_noises_than_states() -> None:
    record, f, g = record_of(SINGULAR, 2, 9), SINGULAR.f, SINGULAR.g

    def step(x: Tensor, u: Any) -> None:
        w = pyro.sample("w", Normal(torch.zeros(1).double(), 1.0).to_event(1))
        x = pyro.deterministic("x", x @ f.mT + w @ g.mT)
        pyro.sample("y", Normal(x[..., :1], 0.8).to_event(1))

    start = Normal(SINGULAR.m0, SINGULAR.l0.diagonal()).to_event(1)
    model = PyroModel(lambda: pyro.sample("x", start), step)
    for method in (EKF, ParticleFilter(50)):
        found, expected = (FilterLikelihood(method)(m, record) for m in (model, SINGULAR))
        torch.testing.assert_close(found, expected)
    assert model.transition(torch.zeros(2, 1, 2).double(), ()) is None


def looks_back(x: Tensor, u: Any) -> None:
    pyro.sample("x", Normal(x, 1.0).to_event(1))
    pyro.sample("y", Normal(x, 1.0).to_event(1))


def branches(x: Tensor, u: Any) -> None:
    pyro.sample("x", Normal(x if x.sum() > 0 else -x, 1.0).to_event(1))
    pyro.sample("y" if x.mean() > 0 else "z", Normal(x, 1.0).to_event(1))


@pytest.mark.parametrize(
    ("step", "sentence"),
    [
        (looks_back, "site 'y' must depend on the new state 'x' alone"),
        (branches, "step must have the same sites at each state"),
        (lambda x, u: pyro.sample("x", Normal(x, 1.0 if x > 0 else 2.0)), "step must be a program of states [R, N, D] without branches"),
        (lambda x, u: pyro.sample("x", Poisson(x.exp()).to_event(1)), "got Poisson. Use Normal"),
        (lambda x, u: pyro.sample("x", Normal(x, 1.0)), "site 'x' must have one event dimension"),
        (lambda x, u: pyro.sample("x", Normal(x, 1.0).to_event(1)), "step must sample the site 'y', the measurement"),
        (lambda x, u: pyro.sample("y", Normal(x, 1.0).to_event(1)), "step must have the site 'x', a new state of 1 components"),
    ],
)  # fmt: skip
def test_programs_that_are_no_models_are_refused_in_a_sentence(step: Any, sentence: str) -> None:
    with pytest.raises(ValueError, match=re.escape(sentence)):
        PyroModel(begin, step)
