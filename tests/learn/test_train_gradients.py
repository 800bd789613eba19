"""Gradients of a filter's evidence through each kind of resampling, against Kalman's by automatic differentiation."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import pytest
import torch
from particle_cases import CASES
from torch import Tensor
from torch.distributions import Distribution

from pfbench.core import PhiloxStream, Record
from pfbench.core.density import independent_normal, normal_batch
from pfbench.filter import (
    EssResampler,
    Multinomial,
    ParticleBelief,
    ParticleFilter,
    Resampler,
    SoftResampler,
    StopGradientResampler,
    Systematic,
    run_filter,
)
from pfbench.model.base import StateSpaceModel
from pfbench.testing import check_evidence, filter_record

Y = torch.tensor([[0.8], [1.9], [-0.4], [2.5], [1.0], [-1.5]], dtype=torch.float64)
THETA = torch.tensor([0.8, math.log(0.9)], dtype=torch.float64)  # a, log q


class Walker(StateSpaceModel):
    """x' = a x + q w, y = x + v, with a and log q of each run its own, so that one backward pass gives each run's gradient."""

    linear = True

    def __init__(self, theta: Tensor) -> None:
        super().__init__()
        self.register_buffer("one", torch.ones(1, dtype=torch.float64))
        self.theta = theta  # [R, 2]
        self.names, self.units, self.groups, self.noise_dim = ("x",), ("",), {"state": (0,)}, 1

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.one)

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return self.theta[:, :1, None] * x + self.theta[:, 1:, None].exp() * w

    def observation(self, x: Tensor, u: Any) -> Distribution:
        return independent_normal(x, 0.7 * self.one)


def kalman(theta: Tensor) -> Tensor:
    """log p(y) of this model, by the textbook."""
    a, q2 = theta[0], (2.0 * theta[1]).exp()
    m, p, total = torch.zeros(()).double(), torch.ones(()).double(), torch.zeros(()).double()
    for y in Y[:, 0]:
        m, p = a * m, a * a * p + q2
        s = p + 0.49
        total = total - 0.5 * ((y - m) ** 2 / s + torch.log(2.0 * math.pi * s))
        m, p = m + p / s * (y - m), p - p * p / s
    return total


def exact() -> Tensor:
    theta = THETA.clone().requires_grad_()
    return torch.autograd.grad(kalman(theta), theta)[0]


class Found(NamedTuple):
    """Mean of weight times gradient of log Z_hat over runs, less Kalman's, and standard errors, by parameter [2]."""

    bias: Tensor
    error: Tensor


def bias(resampler: Resampler, particles: int, runs: int, of_z: bool) -> Found:
    """Of grad Z_hat / Z (`of_z`), or of grad log Z_hat."""
    theta = THETA.expand(runs, -1).clone().requires_grad_()
    method = ParticleFilter(particles, resampler)
    estimate = run_filter(
        method, Walker(theta), Record(Y.expand(runs, -1, -1)), PhiloxStream(4, torch.arange(runs))
    )
    gradient = torch.autograd.grad(estimate.log_evidence.sum(), theta)[0]
    if of_z:
        gradient = gradient * (estimate.log_evidence.detach() - kalman(THETA)).exp()[:, None]
    return Found(gradient.mean(0) - exact(), gradient.std(0) / math.sqrt(runs))


DROPPED = EssResampler(Systematic(), 1.0)
UNBIASED: dict[str, Resampler] = {
    "score": StopGradientResampler(),
    "score, multinomial": StopGradientResampler(EssResampler(Multinomial(), 1.0)),
    "score, adaptive": StopGradientResampler(EssResampler(Systematic(), 0.6)),
    "score, soft": SoftResampler(0.5, StopGradientResampler()),
}


@pytest.mark.parametrize("name", UNBIASED)
def test_with_the_score_the_gradient_of_the_evidence_is_unbiased(name: str) -> None:
    """E[grad Z_hat] = grad Z with six particles, as exactly as E[Z_hat] = Z."""
    found = bias(UNBIASED[name], 6, 6000, of_z=True)
    assert (found.bias.abs() < 4.5 * found.error).all(), found
    assert (found.error < 0.2 * exact().abs()).all(), "too few runs to tell anything"


@dataclass(frozen=True)
class Slotted:
    """Soft or score weights with the mistake that is often made: of the slot, not of the ancestor."""

    soft: bool
    is_exact = True

    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, log_a: Tensor, n: Tensor, draws: Any
    ) -> tuple[ParticleBelief, Tensor]:
        wanted = torch.logaddexp(
            log_a + math.log(0.5), torch.full_like(log_a, math.log(0.5 / log_a.shape[1]))
        )
        used = wanted if self.soft else log_a
        fresh, hit = DROPPED(model, belief._replace(log_w=used), used, n, draws)
        correction = log_a - wanted if self.soft else log_a - log_a.detach()
        return fresh._replace(log_w=fresh.log_w + correction), hit


@pytest.mark.parametrize(
    "resampler",
    [DROPPED, SoftResampler(0.5), Slotted(False)],
    ids=["dropped", "soft", "wrong score"],
)
def test_without_it_there_is_a_bias_and_the_test_sees_it(resampler: Resampler) -> None:
    found = bias(resampler, 6, 6000, of_z=True)
    assert (found.bias.abs() > 6.0 * found.error).any(), found


@pytest.mark.slow
def test_the_bias_that_many_particles_leave() -> None:
    """Of grad log Z_hat: the score's goes, the dropped one stays, and soft weights mend part of it."""
    cases: dict[str, tuple[Resampler, int]] = {
        "dropped": (DROPPED, 400), "soft": (SoftResampler(0.3), 400), "score": (StopGradientResampler(), 2000)
    }  # fmt: skip
    found = {
        name: bias(resampler, 100, runs, of_z=False) for name, (resampler, runs) in cases.items()
    }
    share = {
        name: (value.bias / exact()).norm().item() for name, value in found.items()
    }  # of the gradient itself
    noise = {name: (value.error / exact()).norm().item() for name, value in found.items()}
    assert max(noise.values()) < 0.07
    assert share["dropped"] > 0.5
    assert 0.2 < share["soft"] < 0.9 * share["dropped"]
    assert share["score"] < 0.1


def test_the_score_changes_no_number() -> None:
    model, y, _ = CASES["growth"]()
    one, other = (
        filter_record(ParticleFilter(30, resampler), model, y, runs=3)
        for resampler in (DROPPED, StopGradientResampler())
    )
    assert torch.equal(one.mean, other.mean)
    assert torch.equal(one.log_evidence, other.log_evidence)


@pytest.mark.parametrize("alpha", [0.2, 0.7, 1.0])
def test_soft_resampling_targets_what_it_should(alpha: float) -> None:
    model, y, answer = CASES["growth"]()
    method = ParticleFilter(60, SoftResampler(alpha))
    assert method.is_exact
    check_evidence(method, model, y, answer, runs=700)


def test_soft_weights_of_the_slot_are_seen() -> None:
    model, y, answer = CASES["growth"]()
    with pytest.raises(AssertionError):
        check_evidence(ParticleFilter(60, Slotted(True)), model, y, answer, runs=700)


# transport


def cloud_of(n: int, d: int, runs: int = 3) -> ParticleBelief:
    draws = PhiloxStream(7, torch.arange(runs))
    log_w = torch.log_softmax(1.5 * draws.normal("w", n, 1)[..., 0], 1)
    return ParticleBelief(draws.normal("x", n, d), log_w, torch.zeros(runs, dtype=torch.float64))


def test_resampling_with_gradients_refuses_what_it_cannot_do() -> None:
    for alpha in (0.0, 1.5):
        with pytest.raises(ValueError, match=r"resampler\.\w+ must be"):
            SoftResampler(alpha)
