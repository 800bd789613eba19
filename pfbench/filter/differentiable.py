"""Resampling through which gradients pass, or do not: for training, each with what is known of its bias.

`resamplers.Resample` itself is the first of them: it copies particles and forgets that which ones it copied depends on the
parameters. That term is dropped in variational SMC, FIVO and AESMC [Naesseth et al. 2018; Maddison et al. 2017; Le et al. 2018]:
of low variance, and biased.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from pfbench.draws import Draws
from pfbench.filter import belief
from pfbench.filter.belief import Cloud
from pfbench.filter.resamplers import Resample, Resampler, Systematic
from pfbench.model.base import StateSpaceModel


def _always() -> Resample:
    return Resample(Systematic(), 1.0)


@dataclass(frozen=True)
class StopGradient:
    """Copies by `inner`, and the copies' weights are 1/N w / stop(w): 1/N in number, with the gradient of the score.

    For any unbiased scheme the gradient of the estimated evidence, not of its logarithm, is unbiased for any number of
    particles: E[grad Z_hat] = grad Z [Scibior and Wood 2021, "Differentiable particle filtering without modifying the forward
    pass"]. Its variance is that of a score: it wants many particles.
    """

    inner: Resample = field(default_factory=_always)
    exact = True

    def __call__(
        self, model: StateSpaceModel, cloud: Cloud, log_a: Tensor, n: Tensor, draws: Draws
    ) -> tuple[Cloud, Tensor]:
        # Resample corrects its copies' weights by log w - log a: with a held fixed, that is what has the gradient wanted here
        return self.inner(model, cloud, log_a.detach(), n, draws)


@dataclass(frozen=True)
class Soft:
    """Ancestors by a' = alpha a + (1 - alpha) / N, their weights w / (N a'), taken at the ancestor [Karkus, Hsu, Lee 2018].

    The weights depend on the parameters, and so some of the gradient passes; that which ancestors were drawn depends on them
    too is forgotten, as without it, the less the smaller alpha. The cloud targets what it did for any alpha.

    Args:
        alpha: 1 is plain resampling, towards 0 particles are kept whatever they weigh.
        inner: how the ancestors are drawn; StopGradient here removes what bias is left.

    Raises:
        ValueError: alpha outside (0, 1].
    """

    alpha: float = 0.5
    inner: Resampler = field(default_factory=_always)
    exact = True

    def __post_init__(self) -> None:
        if not 0.0 < self.alpha <= 1.0:
            raise ValueError(f"resampler.alpha={self.alpha}: give a number in (0, 1]; 1 is resampling by the weights alone")

    def __call__(
        self, model: StateSpaceModel, cloud: Cloud, log_a: Tensor, n: Tensor, draws: Draws
    ) -> tuple[Cloud, Tensor]:
        living = cloud.log_w > -torch.inf
        even = torch.where(living, -torch.log(living.sum(1, keepdim=True).to(log_a)), -torch.inf)
        if self.alpha < 1.0:
            log_a = torch.where(
                living, torch.logaddexp(log_a + math.log(self.alpha), even + math.log1p(-self.alpha)), -torch.inf
            )
        return self.inner(model, cloud, log_a, n, draws)


@dataclass(frozen=True)
class Transport:
    """Moves particles by optimal transport to N equal weights, x_j' = N sum_i P_ij x_i [Reich 2013; Corenflos et al. 2021].

    P is the plan between the weighted and the even cloud of least cost |x_i - x_j|^2 less epsilon times its entropy, by
    Sinkhorn's iterations on logarithms, all runs at once; distances are in standard deviations of the particles, whatever they
    weigh, over the root of their number. The last half of an iteration is on the rows, and what the columns then lack of 1/N
    becomes the particles' new weights [ours], so that the mean is kept however few the iterations. All of it is differentiable.
    The spread shrinks, the more the larger epsilon: the cloud targets p(x | y) only as N grows and epsilon falls. In a curved
    chart it works in coordinates about the mean [ours].

    Args:
        epsilon: of the entropy.
        iterations: of Sinkhorn.
        threshold: as in Resample.

    Raises:
        ValueError: an epsilon that is not positive, no iterations, a threshold outside [0, 1]; on use, particles with memory.
    """

    epsilon: float = 0.1
    iterations: int = 15
    threshold: float = 1.0
    exact = False

    def __post_init__(self) -> None:
        if not self.epsilon > 0.0 or self.iterations < 1:
            given = f"resampler.epsilon={self.epsilon}, iterations={self.iterations}"
            raise ValueError(f"{given}: give a positive epsilon and at least 1 iteration")
        if not 0.0 <= self.threshold <= 1.0:
            raise ValueError(f"resampler.threshold={self.threshold}: give a ratio of ESS to N between 0 (never) and 1 (always)")

    def __call__(
        self, model: StateSpaceModel, cloud: Cloud, log_a: Tensor, n: Tensor, draws: Draws
    ) -> tuple[Cloud, Tensor]:
        if any(value.shape[1] > 1 for value in (*cloud.memory.values(), *cloud.window.values())):
            raise ValueError("resampler: Transport makes new particles, which have no past; choose Soft or StopGradient")
        a = belief.weights(cloud.log_w)  # whatever else is preferred: what is moved needs no correction by weights
        hit = 1.0 / a.square().sum(-1) <= self.threshold * n.squeeze(1)
        mean = model.chart.mean(cloud.x, a).unsqueeze(1)
        apart = model.chart.subtract(cloud.x, mean)
        # of all particles alike: where one has all the weight, the weighted spread is none, and distances would be endless
        living = (cloud.log_w > -torch.inf).to(a).unsqueeze(-1)
        sd = torch.sqrt((living * apart.square()).sum(1, keepdim=True) / living.sum(1, keepdim=True)).detach()
        near = apart / torch.where(sd > 0.0, sd, 1.0) / math.sqrt(apart.shape[-1])
        plan = transport_plan(near, torch.log_softmax(cloud.log_w, 1), self.epsilon, self.iterations)
        left = plan.sum(1)
        fresh = cloud._replace(x=model.chart.add(mean, plan.mT @ apart / left.unsqueeze(-1)), log_w=torch.log(left))
        return belief.where(hit, fresh, cloud), hit


def transport_plan(x: Tensor, log_a: Tensor, epsilon: float, iterations: int) -> Tensor:
    """P [R, N, N] with rows summing to a exactly, columns to 1/N nearly, for points x [R, N, d] and log weights [R, N]."""
    cost = -(x.unsqueeze(2) - x.unsqueeze(1)).square().sum(-1) / epsilon
    log_b = torch.full_like(log_a, -math.log(log_a.shape[1]))
    f = torch.zeros_like(log_a)
    for _ in range(iterations):
        g = log_b - (cost + f.unsqueeze(2)).logsumexp(1)
        f = log_a - (cost + g.unsqueeze(1)).logsumexp(2)
    return torch.exp(cost + f.unsqueeze(2) + g.unsqueeze(1))
