"""The proposal over the interval between measurements: unbiased, causal, and equal to a Gaussian draw where the model is linear."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import oracles
import pytest
import torch
from filter_cases import method_of
from torch import Tensor
from torch.distributions import Cauchy, Distribution, Independent, Laplace, StudentT

from pfbench.core.density import independent_normal, normal_batch
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief
from pfbench.filter.guided.interval_guide import GuidedIntervalProposal
from pfbench.filter.loop import run_filter
from pfbench.filter.moves.metropolis import MetropolisHastings
from pfbench.filter.moves.path_kernels import NoiseFlowKernel
from pfbench.filter.particle.compiled_filter import CompiledParticleFilter
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.filter.particle.regularised_resampling import RegularisedResampler
from pfbench.filter.particle.resampling import Multinomial
from pfbench.filter.particle.stages import EssResampler, Systematic
from pfbench.model.base import StateSpaceModel
from pfbench.model.linear_gaussian import LinearGaussian
from pfbench.testing import (
    check_causality,
    check_convergence,
    check_evidence,
    check_independence,
    filter_record,
    run_kalman_filter,
)

GUIDE = GuidedIntervalProposal()
NAN = math.nan
# sharp measurements with gaps of one to three steps, one of them partial
GAPS = LinearGaussian(
    [[1.0, 1.0], [0.0, 1.0]],
    [[0.3, 0.0], [0.5, 0.2]],
    [[1.0, 0.0], [0.2, 1.0]],
    [0.1, 0.15],
    [0.0, 0.0],
    [1.0, 0.5],
)
Y = torch.tensor(
    [
        [NAN, NAN],
        [NAN, NAN],
        [3.1, NAN],
        [4.0, 1.1],
        [NAN, NAN],
        [NAN, NAN],
        [NAN, NAN],
        [9.2, NAN],
    ],
    dtype=torch.float64,
)


def particle_filter(n: int = 40, **options: Any) -> ParticleFilter:
    return ParticleFilter(n, proposal=GuidedIntervalProposal(**options))


# linear models


@pytest.mark.parametrize(
    "options",
    [{}, {"steps": 2}, {"covariance_factor": 1.7}, {"steps": 1}, {"prior_fraction": 0.0}],
    ids=str,
)
def test_the_evidence_is_unbiased(options: dict[str, Any]) -> None:
    check_evidence(particle_filter(**options), GAPS, Y, runs=1500)


@pytest.mark.parametrize("scheme", [Systematic(), Multinomial()], ids=["systematic", "multinomial"])
def test_resampling_within_an_interval_changes_nothing(scheme: Any) -> None:
    method = replace(particle_filter(), resampler=EssResampler(scheme, 1.0))
    check_evidence(method, GAPS, Y, runs=1500)


def test_errors_fall_with_the_root_of_the_number() -> None:
    check_convergence(lambda n: particle_filter(n))


@pytest.mark.parametrize("lacks", ["ratio", "determinant"])
def test_a_weight_without_a_factor_is_seen(lacks: str) -> None:
    class Careless(GuidedIntervalProposal):
        is_exact = False

        def _move(self, *arguments: Any) -> tuple[Tensor, Tensor]:
            z, log_ratio = super()._move(*arguments)
            if lacks == "ratio":
                return z, torch.zeros_like(log_ratio)
            before = arguments[3].noise
            return z, 0.5 * (before.square() - z.square()).sum((2, 3))

    with pytest.raises(AssertionError, match="evidence is unbiased"):
        check_evidence(ParticleFilter(40, proposal=Careless(prior_fraction=0.0)), GAPS, Y, runs=500)


def test_on_a_linear_model_all_paths_of_one_start_have_one_weight() -> None:
    """The moved noise has the distribution given the measurement: the weight is p(y | start), and moments are Kalman's."""
    known = LinearGaussian(GAPS.f, GAPS.g, GAPS.h, GAPS.r, [0.3, -0.2], [1e-12, 1e-12])
    y, n = Y[:3], 4000
    method, draws = particle_filter(n, prior_fraction=0.0), PhiloxStream(1, torch.arange(1))
    belief: Any = method.init(known, 1, draws.at_step(0))
    for t in range(3):
        belief, info = method.step(known, belief, Record(y[t][None]), draws.at_step(t + 1))
    assert float(belief.log_w.max() - belief.log_w.min()) < 1e-8
    kalman = run_kalman_filter(known, y)
    assert float(belief.log_evidence[0]) == pytest.approx(
        float(kalman.log_evidence.sum()), abs=1e-8
    )
    sd = np.sqrt(np.diagonal(kalman.covariance[-1]))
    assert np.abs((info.mean[0].numpy() - kalman.mean[-1]) / sd).max() < 4.5 / math.sqrt(n)
    ratio = info.covariance()[0].numpy() / np.outer(sd, sd) - kalman.covariance[-1] / np.outer(
        sd, sd
    )
    assert np.abs(ratio).max() < 4.5 * math.sqrt(2.0 / n)


def test_log_evidences_scatter_less_than_with_the_last_noise_alone() -> None:
    exact = float(run_kalman_filter(GAPS, Y).log_evidence.sum())

    def scatter(method: ParticleFilter) -> float:
        return float((filter_record(method, GAPS, Y, runs=300).log_evidence - exact).std())

    last = replace(method_of("ekf_pf"), particles=100)
    assert 2.5 * scatter(particle_filter(100)) < scatter(last)


# no future


def test_estimates_between_measurements_are_those_of_the_prediction() -> None:
    """With the same numbers, the steps without a measurement are those of SIR until the first measurement."""
    ours, sir = (filter_record(m, GAPS, Y, runs=3) for m in (particle_filter(), ParticleFilter(40)))
    torch.testing.assert_close(ours.mean[:, :2], sir.mean[:, :2])
    assert float((ours.mean[:, 2] - sir.mean[:, 2]).abs().min()) > 1e-3


def test_runs_with_their_own_gaps_are_causal_and_independent() -> None:
    y = Y.nan_to_num(0.4).repeat(3, 1, 1) + PhiloxStream(8, torch.arange(3)).normal("y", *Y.shape)
    y[0, :3], y[1, 2:6], y[2, ::2] = NAN, NAN, NAN
    check_causality(particle_filter(), GAPS, y)
    check_independence(particle_filter(), GAPS, y)


# models that are not linear


class Turning(StateSpaceModel):
    """An angle and a position that its sine moves; noise that is not additive or normal, by choice."""

    def __init__(self, noise: Distribution | None = None) -> None:
        super().__init__()
        self.register_buffer("sd", torch.tensor([0.8], dtype=torch.float64))
        self.names, self.units, self.groups = ("x",), ("m",), {"x": (0,)}
        self.noise_dim, self.law = 1, noise

    @property
    def noise(self) -> Distribution:
        return super().noise if self.law is None else self.law

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.sd)

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return x + 0.5 * torch.sin(x) + 0.5 * w

    def observation(self, x: Tensor, u: Any) -> Distribution:
        return independent_normal(x + 0.1 * x**2, 0.25 * self.sd)


SEEN = torch.tensor([[NAN], [NAN], [1.9], [NAN], [2.4]], dtype=torch.float64)


@pytest.mark.parametrize("family", ["normal", "Laplace", "Student"])
def test_a_nonlinear_model_is_unbiased_against_quadrature(family: str) -> None:
    zero, dof = torch.zeros(1).double(), torch.full((1,), 4.0).double()
    laws: dict[str, Any] = {
        "normal": None,
        "Laplace": Independent(Laplace(zero, zero + 0.7), 1),
        "Student": Independent(StudentT(dof), 1),
    }
    model, grid = Turning(laws[family]), np.linspace(-14.0, 14.0, 3501)
    step = grid[:, None] - grid[None] - 0.5 * np.sin(grid[None])
    density = model.noise.log_prob(torch.from_numpy(step / 0.5).unsqueeze(-1)).exp().numpy() / 0.5

    def log_likelihood(t: int) -> np.ndarray:
        if math.isnan(float(SEEN[t])):
            return np.zeros_like(grid)
        return np.log(oracles.normal_density(float(SEEN[t]), grid + 0.1 * grid**2, 0.2) + 1e-300)

    mean, _, log_z = oracles.grid_filter(
        grid, oracles.normal_density(grid, 0.0, 0.8), lambda t: density, log_likelihood, len(SEEN)
    )
    runs = 1500
    result = filter_record(particle_filter(30), model, SEEN, runs=runs)
    ratio = (result.log_evidence - log_z).exp().numpy()
    first = ratio * result.mean[:, -1, 0].numpy() / mean[-1]
    for values in (ratio, first):
        error = values.std() / math.sqrt(runs)
        assert error < 0.05
        assert abs(values.mean() - 1.0) < 4.5 * error, (values.mean(), error)


# memory


def test_the_memory_ends_with_the_interval_and_is_bounded() -> None:
    method, draws = particle_filter(steps=2), PhiloxStream(1, torch.arange(2))
    belief: Any = method.init(GAPS, 2, draws.at_step(0))
    lengths = []
    for t in range(len(Y)):
        record = Record(Y[t].expand(2, -1))
        belief, _ = method.step(GAPS, belief, record, draws.at_step(t + 1))
        assert isinstance(belief, ParticleBelief)
        kept = belief.memory.get("interval.noise")
        lengths.append(0 if kept is None else kept.shape[2])
    assert lengths == [1, 2, 0, 0, 1, 2, 2, 0]


def test_the_compiled_engine_gives_the_same_numbers() -> None:
    compiled = CompiledParticleFilter(particle_filter())
    record, draws = Record(Y.expand(2, -1, -1)), PhiloxStream(1, torch.arange(2))
    ours, theirs = (run_filter(m, GAPS, record, draws) for m in (compiled, particle_filter()))
    torch.testing.assert_close(ours.mean, theirs.mean)
    assert not compiled.is_active


def test_the_configured_filter_is_sir_with_this_proposal() -> None:
    assert method_of("interval_pf") == replace(method_of("sir"), proposal=GUIDE)
    assert method_of("interval_pf").is_exact


# refusals


def test_what_cannot_be_guided_says_why() -> None:
    for name, value in (
        ("steps", 0),
        ("steps", 1.5),
        ("covariance_factor", 0.0),
        ("prior_fraction", 1.0),
    ):
        with pytest.raises(ValueError, match=rf"proposal\.{name} must be .*got {value}\. Use"):
            GuidedIntervalProposal(**{name: value})
    with pytest.raises(
        ValueError, match=r"filter\.moves must be empty with a proposal that stores"
    ):
        ParticleFilter(10, proposal=GUIDE, moves=(MetropolisHastings(NoiseFlowKernel(3)),))
    with pytest.raises(ValueError, match=r"filter\.resampler must copy particles"):
        ParticleFilter(
            10, proposal=GUIDE, resampler=RegularisedResampler(EssResampler(Systematic()))
        )
    zero = torch.zeros(1).double()
    cauchy = Independent(Cauchy(zero, zero + 1.0), 1)
    with pytest.raises(ValueError, match=r"noise must have a finite mean and variance"):
        filter_record(particle_filter(), Turning(cauchy), SEEN, runs=2)
