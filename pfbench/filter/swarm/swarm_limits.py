"""Velocity and position limits, and the stopping rule of a particle swarm."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import torch
from scipy.special import chdtri
from torch import Tensor

from pfbench.core.record import Record
from pfbench.model.base import StateSpaceModel


@dataclass(frozen=True)
class SwarmLimits:
    """Limits of velocity and position, in scales of each coordinate [ours].

    The paper only names v_max. The scales do not come from the moving swarm, since its contraction
    and expansion would feed back.

    Attributes:
        scale_by_prior: The scale is the standard deviation of the initial particles, the paper's
            recorded interval. False takes the predicted particles.
        max_velocity_sd: v_max over six scales.
        max_distance_sd: Largest distance from the predicted mean in standard deviations of the
            predicted particles. None sets no limit.

    Raises:
        ValueError: If a limit is not positive.
    """

    scale_by_prior: bool = False
    max_velocity_sd: float = 0.5
    max_distance_sd: float | None = 3.0

    def __post_init__(self) -> None:
        if not self.max_velocity_sd > 0.0 or (
            self.max_distance_sd is not None and not self.max_distance_sd > 0.0
        ):
            raise ValueError(
                "proposal.limits must be positive, got "
                f"max_velocity_sd={self.max_velocity_sd}, max_distance_sd={self.max_distance_sd}. "
                "Use max_distance_sd=null for no limit of position."
            )

    def clamp_velocity(self, v: Tensor, scale: Tensor) -> Tensor:
        """Clamp velocities to their limits.

        Args:
            v: Velocities, [R, N, k].
            scale: Scale of each coordinate, [R, 1, k].

        Returns:
            Velocities, [R, N, k].
        """
        limit = 6.0 * self.max_velocity_sd * scale
        return torch.clamp(v, -limit, limit)

    def clamp_position(self, q: Tensor, sd: Tensor) -> Tensor:
        """Clamp positions to their limits.

        Args:
            q: Positions, [R, N, k].
            sd: Standard deviations of the predicted particles, [R, 1, k].

        Returns:
            Positions, [R, N, k].
        """
        if self.max_distance_sd is None:
            return q
        limit = self.max_distance_sd * sd
        return torch.clamp(q, -limit, limit)


@dataclass(frozen=True)
class ChiSquareStopping:
    """Stop a run when its best particle fits the measurement well enough [ours].

    The distance -2 ln p(y | x) + 2 ln p(y_hat | x) must be at most this chi-square quantile. The
    degrees of freedom are the observed components: 5.35 for six and the median. The paper does not
    specify its epsilon.

    Attributes:
        quantile: Probability in (0, 1).

    Raises:
        ValueError: If the quantile is outside (0, 1).
    """

    quantile: float = 0.5

    def __post_init__(self) -> None:
        if not 0.0 < self.quantile < 1.0:
            raise ValueError(
                f"proposal.stopping.quantile must be in (0, 1), got {self.quantile}. "
                "Use 0.5 for the median."
            )

    def __call__(self, model: StateSpaceModel, best: Tensor, record: Record) -> Tensor:
        """Compute the mask of the runs that stop.

        Args:
            model: State-space model of the step.
            best: Best state of each run, [R, 1, D].
            record: Record of the step.

        Returns:
            Mask, [R].
        """
        y_hat: Tensor = model.observation(best, record.u).mean[:, 0]
        observed_mask = ~torch.isnan(record.y)
        nearest = model.log_likelihood(torch.where(observed_mask, y_hat, torch.nan), best, record.u)
        distance = 2.0 * (nearest - model.log_likelihood(record.y, best, record.u))[:, 0]
        limits = distance.new_tensor(_quantiles(self.quantile, observed_mask.shape[-1]))
        return distance <= limits[observed_mask.sum(-1)]


@cache
def _quantiles(p: float, maximum: int) -> list[float]:
    """Return chi-square quantiles for 0 to `maximum` degrees of freedom."""
    return [0.0, *(float(chdtri(k, 1.0 - p)) for k in range(1, maximum + 1))]
