"""Functions shared by the proposals that use a Gaussian guide filter.

These proposals draw whitened coordinates xi = m + U z of a normal prior N(0, I), z ~ N(0, I).
The ratio log N(xi; 0, I) - log N(xi; m, U U') = (|z|^2 - |xi|^2) / 2 + log |det U| holds in
any chart and for singular covariances.
"""

from __future__ import annotations

import math

from torch import Tensor
from torch.distributions import Distribution

from pfbench.core.normal import StandardNormal
from pfbench.filter.belief import GaussianBelief
from pfbench.filter.gaussian.kalman_update import GaussianStep
from pfbench.filter.linearisation import unwrap_independent
from pfbench.filter.whitening import compute_half_square

MEAN, COVARIANCE, _CARRIED = "guide.mean", "guide.covariance", "guide.carries."


def pack_guide_belief(new: GaussianStep, shape: tuple[int, int]) -> dict[str, Tensor]:
    """Pack the state of the guide filter into the memory of a particle belief.

    Args:
        new: Step of the guide filter, its runs axis flattened over `shape`.
        shape: Runs and guides per run.

    Returns:
        Memory tensors, [*shape, ...].
    """
    memory = {COVARIANCE: new.root @ new.root.mT} | {
        _CARRIED + name: value for name, value in new.memory.items()
    }
    return {name: value.unflatten(0, shape) for name, value in memory.items()}


def unpack_guide_belief(
    memory: dict[str, Tensor], mean: Tensor, covariance: Tensor
) -> GaussianBelief:
    """Unpack the Gaussian belief of the guide filter from memory.

    Args:
        memory: Memory of a particle belief.
        mean: Means, [R, N or 1, D].
        covariance: Covariances, [R, N or 1, d, d].

    Returns:
        Gaussian belief with R N or R runs.
    """
    carried = {
        k.removeprefix(_CARRIED): v.flatten(0, 1)
        for k, v in memory.items()
        if k.startswith(_CARRIED)
    }
    flat = mean.flatten(0, 1)
    return GaussianBelief(flat, covariance.flatten(0, 1), flat.new_zeros(len(flat)), carried)


def compute_log_ratio(xi: Tensor, z: Tensor, log_det: Tensor, widen: float) -> Tensor:
    """Compute log N(xi; 0, I) - log q(xi) for xi = m + sqrt(widen) U z.

    Args:
        xi: Whitened coordinates, [R, N, d].
        z: Standard normal numbers, [R, N, d].
        log_det: log |det U|, [R, N or 1].
        widen: Factor on the proposal covariance.

    Returns:
        Log ratio, [R, N].
    """
    return (
        compute_half_square(z)
        - compute_half_square(xi)
        + log_det
        + 0.5 * z.shape[-1] * math.log(widen)
    )


def standardise_noise(distribution: Distribution) -> bool:
    """Return whether the distribution is the standard normal one."""
    return isinstance(unwrap_independent(distribution), StandardNormal)


def check_covariance_factor(widen: float) -> None:
    """Check that the covariance factor is positive.

    Raises:
        ValueError: If it is not positive.
    """
    if not widen > 0.0:
        raise ValueError(
            f"proposal.covariance_factor must be positive, got {widen}. Use 1 for no change."
        )


def check_normal_guide(guide_filter: object) -> None:
    """Check that a guide filter takes the measurement errors as normal.

    Args:
        guide_filter: Gaussian filter of the proposal.

    Raises:
        ValueError: If it has an update for another distribution.
    """
    update = getattr(guide_filter, "measurement_update", None)
    if update is not None:
        raise ValueError(
            "proposal.guide_filter.measurement_update must be null in a proposal, got "
            f"{type(update).__name__}. Remove it: the weights contain the distribution."
        )
