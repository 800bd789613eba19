"""What proposals shaped by a Gaussian filter, the guide, have in common.

All of them draw whitened coordinates xi = m + U z of a normal prior N(0, I), z ~ N(0, I), so that the ratio log N(xi; 0, I) -
log N(xi; m, U U') = (|z|^2 - |xi|^2) / 2 + log |det U| holds in any chart and where covariances are singular.
"""

from __future__ import annotations

import math

from torch import Tensor
from torch.distributions import Distribution

from pfbench.filter.belief import Gaussian
from pfbench.filter.gaussian import Advance
from pfbench.filter.linearisation import base
from pfbench.filter.whitening import half_square
from pfbench.model.base import Standard

MEAN, COVARIANCE, _CARRIED = "guide.mean", "guide.covariance", "guide.carries."


def remember(new: Advance, shape: tuple[int, int]) -> dict[str, Tensor]:
    """What the guide carries from step to step, as memory of a cloud; its axis of runs is unfolded to `shape`."""
    kept = {COVARIANCE: new.root @ new.root.mT} | {_CARRIED + name: value for name, value in new.memory.items()}
    return {name: value.unflatten(0, shape) for name, value in kept.items()}


def recall(memory: dict[str, Tensor], mean: Tensor, covariance: Tensor) -> Gaussian:
    """The same back, about means [R, N or 1, D]."""
    carried = {k.removeprefix(_CARRIED): v.flatten(0, 1) for k, v in memory.items() if k.startswith(_CARRIED)}
    flat = mean.flatten(0, 1)
    return Gaussian(flat, covariance.flatten(0, 1), flat.new_zeros(len(flat)), carried)


def log_ratio_of(xi: Tensor, z: Tensor, log_det: Tensor, widen: float) -> Tensor:
    """log N(xi; 0, I) - log q(xi) [R, N] for xi = m + sqrt(widen) U z."""
    return half_square(z) - half_square(xi) + log_det + 0.5 * z.shape[-1] * math.log(widen)


def standard(law: Distribution) -> bool:
    return isinstance(base(law), Standard)


def check_widen(widen: float) -> None:
    if not widen > 0.0:
        raise ValueError(f"proposal.widen={widen}: give a positive factor on the covariance; 1 leaves it")
