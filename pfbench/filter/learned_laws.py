"""Networks that end in a law: what a learned proposal or kernel is told [R, N, F] -> a distribution, batch [R, N], event [W].

Each is made with the number of features and the dimension of the noise, so that a yaml need not know them. The diagonal one
begins as the standard normal law itself: an untrained proposal then is the one it corrects. The others begin near it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, cast

import torch
from pyro.distributions import (
    Independent,
    LowRankMultivariateNormal,
    MixtureSameFamily,
    Normal,
    TransformedDistribution,
    transforms,
)
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution

_WIDEST = 4.0  # log of the largest factor on a standard deviation


class Dense(nn.Module):
    """Hidden layers of tanh beside a straight way through; both end in zeros, so that a new network says 0 to everything."""

    def __init__(self, inputs: int, outputs: int, hidden: Sequence[int] = (32, 32)) -> None:
        super().__init__()
        sizes = [inputs, *hidden]
        layers = [layer for a, b in pairwise(sizes) for layer in (nn.Linear(a, b), nn.Tanh())]
        last, self.straight = nn.Linear(sizes[-1], outputs), nn.Linear(inputs, outputs)
        self.bent = nn.Sequential(*layers, last)
        for end in (last, self.straight):
            nn.init.zeros_(end.weight)
            nn.init.zeros_(end.bias)

    def forward(self, told: Tensor) -> Tensor:
        both: Tensor = self.bent(told) + self.straight(told)
        return both


def bounded(log_scale: Tensor) -> Tensor:
    """A scale from e^-4 to e^4 that is 1 at 0 and smooth."""
    return torch.exp(_WIDEST * torch.tanh(log_scale / _WIDEST))


def independent(mean: Tensor, sd: Tensor) -> Distribution:
    return Independent(Normal(mean, sd, validate_args=False), 1, validate_args=False)


class Diagonal(nn.Module):
    """N(m, diag(s^2)). Begins as N(0, I)."""

    def __init__(self, features: int, noise: int, hidden: Sequence[int] = (32, 32)) -> None:
        super().__init__()
        self.net = Dense(features, 2 * noise, hidden)

    def forward(self, told: Tensor) -> Distribution:
        mean, log_scale = self.net(told).chunk(2, -1)
        return independent(mean, bounded(log_scale))


class LowRank(nn.Module):
    """N(m, diag(s^2) + F F'), F of `rank` columns. Begins near N(0, I): with F = 0 no gradient would ever reach F."""

    def __init__(self, features: int, noise: int, hidden: Sequence[int] = (32, 32), rank: int = 2) -> None:
        super().__init__()
        self.rank = min(rank, noise)
        self.net = Dense(features, (2 + self.rank) * noise, hidden)
        nn.init.normal_(self.net.straight.bias[2 * noise :], std=0.1)

    def forward(self, told: Tensor) -> Distribution:
        mean, log_scale, *columns = self.net(told).chunk(2 + self.rank, -1)
        return LowRankMultivariateNormal(mean, torch.stack(columns, -1), bounded(log_scale).square(), validate_args=False)


class Mixture(nn.Module):
    """A mixture of diagonal normal laws. Their first means differ, since equal components would stay equal."""

    def __init__(self, features: int, noise: int, hidden: Sequence[int] = (32, 32), components: int = 3) -> None:
        super().__init__()
        self.components, self.noise = components, noise
        self.net = Dense(features, components * (1 + 2 * noise), hidden)
        nn.init.normal_(self.net.straight.bias[components : components * (1 + noise)], std=0.5)

    def forward(self, told: Tensor) -> Distribution:
        k, w = self.components, self.noise
        logits, mean, log_scale = self.net(told).split([k, k * w, k * w], -1)
        each = independent(mean.unflatten(-1, (k, w)), bounded(log_scale).unflatten(-1, (k, w)))
        return MixtureSameFamily(Categorical(logits=logits, validate_args=False), each, validate_args=False)


class Flow(nn.Module):
    """A conditional normalising flow: rational splines of each component [Durkan et al. 2019], then a shift and a scale.

    With more than one component, affine couplings come first, which pass the components through each other
    [Dinh, Sohl-Dickstein, Bengio 2017]. The transforms are Pyro's.
    """

    def __init__(self, features: int, noise: int, hidden: Sequence[int] = (32, 32), bins: int = 6, bound: float = 4.0) -> None:
        super().__init__()
        widths = list(hidden)
        self.net = Dense(features, 2 * noise, hidden)
        couplings = [transforms.conditional_affine_coupling(noise, features, widths) for _ in range(2 if noise > 1 else 0)]
        self.couplings = nn.ModuleList(couplings)
        self.spline: Any = transforms.conditional_spline(noise, features, widths, count_bins=bins, bound=bound)

    def forward(self, told: Tensor) -> Distribution:
        mean, log_scale = self.net(told).chunk(2, -1)
        turned = transforms.Permute(torch.arange(mean.shape[-1] - 1, -1, -1, device=told.device))
        steps = [step for coupling in self.couplings for step in (cast(Any, coupling).condition(told), turned)]
        steps += [self.spline.condition(told), transforms.AffineTransform(mean, bounded(log_scale), event_dim=1)]
        return TransformedDistribution(independent(torch.zeros_like(mean), torch.ones_like(mean)), steps, validate_args=False)


class Zuko(nn.Module):
    """A conditional flow of the library zuko (the extra `zuko`), then a shift and a scale: NSF, MAF, NICE, NAF and others.

    Args:
        features, noise: as of all networks here.
        flow: makes it, one whose base is the standard normal law: `zuko.flows.NSF`, `MAF` or `NICE`, which are inverted in
            closed form; others are by bisection, and their ratio is right to six digits.
        hidden: sizes of hidden layers, those of the flow's own networks too.
    """

    def __init__(self, features: int, noise: int, flow: Callable[..., nn.Module], hidden: Sequence[int] = (32, 32)) -> None:
        super().__init__()
        self.net = Dense(features, 2 * noise, hidden)
        self.flow = flow(noise, context=features, hidden_features=list(hidden))

    def forward(self, told: Tensor) -> Distribution:
        mean, log_scale = self.net(told).chunk(2, -1)
        # zuko's leads from the data to the base, and its draws come from one stream for all runs: only the map is taken
        steps = [self.flow(told).transform.inv, transforms.AffineTransform(mean, bounded(log_scale), event_dim=1)]
        return TransformedDistribution(independent(torch.zeros_like(mean), torch.ones_like(mean)), steps, validate_args=False)


def log_standard(z: Tensor) -> Tensor:
    """log N(z; 0, I) of z [..., W] -> [...]."""
    return -0.5 * (z * z).sum(-1) - 0.5 * z.shape[-1] * math.log(2.0 * math.pi)
