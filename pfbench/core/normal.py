"""Normal distributions with independent or correlated components."""

from __future__ import annotations

import torch
from pyro.distributions import Independent, MultivariateNormal, Normal
from torch import Tensor
from torch.distributions import Distribution


class StandardNormal(Normal):
    """Standard normal distribution; code that recognises the type skips scale and shift."""


def independent_normal(mean: Tensor, sd: Tensor) -> Independent:
    """Build a normal distribution with independent components.

    Args:
        mean: Means, [..., k].
        sd: Standard deviations, broadcast against the mean.

    Returns:
        Distribution with event [k].
    """
    normal = Normal.__new__(Normal)  # the constructor takes four times as long at each step
    normal.loc, normal.scale = mean, sd.expand_as(mean)
    Distribution.__init__(normal, mean.shape, validate_args=False)
    return normal.to_event(1)


def normal_batch(runs: int, sd: Tensor, mean: Tensor | None = None) -> Independent:
    """Build the same independent normal distribution for each run.

    Args:
        runs: Number of runs R.
        sd: Standard deviations, [d].
        mean: Means, [d]; None is zero.

    Returns:
        Distribution with batch [R], event [d].
    """
    centre = torch.zeros_like(sd) if mean is None else mean
    return independent_normal(centre.expand(runs, -1), sd)


def dense_normal(mean: Tensor, factor: Tensor) -> MultivariateNormal:
    """Build a normal distribution from its mean and Cholesky factor, without checks.

    As `MultivariateNormal(mean, scale_tril=factor)`, whose constructor imports SymPy for the shape.

    Returns distribution with event [d]. Shapes: mean [..., d], factor [..., d, d].
    """
    batch = torch.broadcast_tensors(mean[..., 0], factor[..., 0, 0])[0].shape
    normal = MultivariateNormal.__new__(MultivariateNormal)
    normal.loc, normal.scale_tril = mean.expand(*batch, -1), factor.expand(*batch, -1, -1)
    normal._unbroadcasted_scale_tril = factor
    Distribution.__init__(normal, batch, mean.shape[-1:], validate_args=False)
    return normal
