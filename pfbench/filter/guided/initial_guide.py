"""Proposal of the initial state from the first measurements."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.linear_algebra import factor
from pfbench.core.parameter_checks import require, require_ranges
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.core.simulate import draw_values
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.guided.guides import FACTOR_RULE
from pfbench.filter.particle.stages import InitialProposal
from pfbench.filter.smoothing.gaussian_smoother import smooth_initial_state
from pfbench.filter.whitening import LOG_2PI
from pfbench.model.base import StateSpaceModel, initial_law


@dataclass(frozen=True)
class GuidedInitialProposal(InitialProposal):
    """Draw initial states from their approximate posterior, given the first measurements.

    A Gaussian filter and smoother compute N(m, C) of x_0 given y_1 to y_k. Most particles are drawn
    from N(m, c C) and the others from the initial distribution p. The ratio p / q of all of them is
    that to the mixture, which bounds it by 1 / `prior_fraction` [Hesterberg 1995; Owen and Zhou
    2000]. The evidence remains unbiased for any guide. Particles are not resampled before step k + 1,
    since their weights favour those from p until the k measurements are processed.

    With `steps` above 1 the particles of the first steps depend on later measurements: their
    estimates are then no longer causal. Score such a filter from step k on.

    Attributes:
        guide_filter: Gaussian filter whose rule linearises, without adaptations.
        steps: Number k of measurements that the guide uses.
        prior_fraction: Fraction of the particles from the initial distribution, in (0, 1).
        covariance_factor: Factor c on the covariance. Above 1 it protects against an
            overconfident guide.
        passes: Linearisations of the guide after that of its filter.

    Raises:
        ValueError: If steps or passes is not a count, the fraction is outside (0, 1), the factor is not positive,
            or the guide adapts noise or gain.
    """

    guide_filter: GaussianFilter
    steps: int = 1
    prior_fraction: float = 0.2
    covariance_factor: float = 1.5
    passes: int = 3
    is_exact = True
    has_bounded_weights = True

    def __post_init__(self) -> None:
        require_ranges(
            "initial_proposal",
            self,
            covariance_factor=FACTOR_RULE,
            steps="whole [1, inf) Use 1 for causal estimates.",
            passes="whole [0, inf) Use 3.",
            prior_fraction="(0, 1) Use 0.2.",
        )
        require(
            isinstance(self.guide_filter, GaussianFilter) and self.guide_filter.plain,
            "initial_proposal.guide_filter",
            "be a Gaussian filter without adaptations",
            type(self.guide_filter).__name__,
            "Choose ekf, ukf or ckf.",
        )

    @override
    def __call__(
        self, model: StateSpaceModel, record: Record, n: int, draws: RandomStream
    ) -> tuple[Tensor, Tensor]:
        runs, chart = len(record.y), model.chart
        initial: Any = initial_law(model, runs, record.spread)
        first = record.select_steps(slice(0, self.steps))
        with torch.no_grad():
            mean, covariance = smooth_initial_state(self.guide_filter, model, first, self.passes)
        origin = model.origin.expand(runs, -1) if record.start is None else record.start
        centre = chart.subtract(mean, origin)
        root, is_valid = factor(self.covariance_factor * covariance)
        is_valid = is_valid & centre.isfinite().all(-1) & root.isfinite().all(-1).all(-1)
        prior_count = min(n - 1, max(1, round(self.prior_fraction * n)))
        d = draw_values(initial, draws, "initial", n)
        z = draws.normal("initial guide", n, d.shape[-1]).to(d)
        guided = centre.unsqueeze(1) + z @ root.mT
        is_guided = (torch.arange(n, device=d.device) >= prior_count) & is_valid[:, None]
        d = torch.where(is_guided.unsqueeze(-1), guided, d)
        log_p = initial.expand([n, runs]).log_prob(d.transpose(0, 1)).mT
        log_q = _log_normal(d - centre.unsqueeze(1), root)
        fraction = prior_count / n
        log_mixture = torch.logaddexp(log_p + math.log(fraction), log_q + math.log1p(-fraction))
        log_ratio = torch.where(is_valid[:, None], log_p - log_mixture, 0.0)
        return chart.add(origin.unsqueeze(1), d), log_ratio


def _log_normal(deviation: Tensor, root: Tensor) -> Tensor:
    """Return the log density [R, N] of N(0, L L') at [R, N, d], L lower triangular."""
    z = torch.linalg.solve_triangular(root, deviation.mT, upper=False)
    log_det = root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return -0.5 * (z.square().sum(1) + root.shape[-1] * LOG_2PI) - log_det[:, None]
