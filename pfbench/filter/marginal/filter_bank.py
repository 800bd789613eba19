"""Bank of Gaussian filters that start from the components of a Gaussian sum of the initial distribution.

References:
    D. L. Alspach, H. W. Sorenson 1972, "Nonlinear Bayesian estimation using Gaussian sum
        approximations".
    L. D. Hostetler, R. D. Andreas 1983, "Nonlinear Kalman filtering techniques for terrain-aided
        navigation" (parallel filters).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.covariance import factor
from pfbench.core.parameter_checks import check_whole_number
from pfbench.core.random_stream import RandomStream
from pfbench.filter.belief import GaussianBelief
from pfbench.filter.robust.hypotheses import Branches
from pfbench.filter.robust.hypothesis_filter import OFFSET, HypothesisFilter, branch_memory
from pfbench.model.base import StateSpaceModel

SPACING = 1.0  # largest distance of two components, standard deviations


@dataclass(frozen=True)
class FilterBank(HypothesisFilter):
    """Gaussian filters from a grid of initial means, weighed by their evidence.

    The initial normal distribution is split in a group of states into a mixture with the same mean
    and covariance. The components are equally spaced along each axis of the Cholesky factor. Of n
    components the outermost ones are at sqrt(n) standard deviations, or nearer if n is below 6. A
    denser bank thus has narrower components, and is closer to the normal distribution. Each is the
    start of a filter under the first hypothesis on the noise. The estimate is the mean of the
    mixture.

    Attributes:
        branches: Largest number K of filters. Each of k axes has the largest whole number of components
            that is not above K^(1/k).
        group: Component group that is split. None for the position, or the first group of a model
            without one.
        overlap: Standard deviation of a component before the variance is matched, in distances of
            two components.

    Raises:
        ValueError: If the number of filters is below 1, or the overlap is outside (0, 1). `init` raises it for an unknown group.
    """

    branches: int = 81
    group: str | None = None
    overlap: float = 0.6

    def __post_init__(self) -> None:
        if not 0.0 < self.overlap < 1.0:
            raise ValueError(
                f"filter.overlap must be above 0 and below 1, got {self.overlap}. Use 0.6."
            )
        check_whole_number("filter.branches", self.branches, 1, "Use 81.")

    @override
    def init(
        self,
        model: StateSpaceModel,
        runs: int,
        draws: RandomStream,
        start: Tensor | None = None,
        spread: Tensor | None = None,
    ) -> GaussianBelief:
        belief = super().init(model, runs, draws, start, spread)
        axes = list(model.groups[self._find_group(model)])
        points = round(self.branches ** (1.0 / len(axes)))
        points -= points ** len(axes) > self.branches
        count = points ** len(axes)
        node, log_w, sd = split_normal(points, belief.covariance, self.overlap)
        grid = torch.cartesian_prod(*[node] * len(axes)).reshape(count, len(axes))
        weights = torch.cartesian_prod(*[log_w] * len(axes)).reshape(count, len(axes)).sum(-1)
        root, is_valid = factor(belief.covariance)  # a run without a root is lost
        root = torch.where(is_valid[:, None, None], root, torch.nan)
        scale = root.new_ones(root.shape[-1])
        scale[axes] = sd
        offset = root[..., axes] @ grid.mT  # [R, d, K]
        component = (root * scale).unsqueeze(1) @ (root * scale).unsqueeze(1).mT
        return belief._replace(
            memory=branch_memory(
                offset.mT.contiguous(),
                component.repeat(1, count, 1, 1),
                weights.repeat(runs, 1),
                weights.new_zeros(runs, count, 1),
            )
        )

    def _find_group(self, model: StateSpaceModel) -> str:
        """Return the name of the group that is split."""
        if self.group is None:
            return "position" if "position" in model.groups else next(iter(model.groups))
        if self.group not in model.groups:
            raise ValueError(
                f"filter.group must be of {', '.join(model.groups)}, got {self.group}. "
                "Choose a component group of the model."
            )
        return self.group

    @override
    def _start(self, log_law: Tensor) -> tuple[Tensor, Tensor]:
        return log_law[:1] * 0.0, log_law[:1, None] * 0.0  # replaced by `init`

    @override
    def _predict_branches(
        self, model: StateSpaceModel, belief: GaussianBelief
    ) -> tuple[Branches, Tensor, Tensor]:
        memory = belief.memory
        mean = model.chart.add(belief.mean.unsqueeze(1), memory[OFFSET])
        log_w = memory["branch_log_weight"]
        number = torch.zeros(log_w.shape[1], dtype=torch.int64, device=log_w.device)
        return Branches(mean, memory["branch_covariance"]), number, log_w

    @override
    def _keep(
        self,
        log_w: Tensor,
        offset: Tensor,
        covariance: Tensor,
        number: Tensor,
        draws: RandomStream,
    ) -> dict[str, Tensor]:
        return branch_memory(offset, covariance, log_w, torch.zeros_like(log_w).unsqueeze(-1))


def split_normal(
    points: int, template: Tensor, overlap: float = 0.6
) -> tuple[Tensor, Tensor, Tensor]:
    """Split the standard normal distribution into equally spaced components.

    Weights are those of the density at the means with the variance that the components leave. The
    variance of the components is then set so that the mixture has variance 1.

    Args:
        points: Number n of components.
        template: Tensor of the dtype and device.
        overlap: Standard deviation of a component at first, in distances of two.

    Returns:
        Means [n], log weights [n], and the standard deviation of every component.
    """
    if points == 1:
        return template.new_zeros(1), template.new_zeros(1), template.new_ones(())
    # with the root of n both the tails left out and the width of the components shrink
    reach = min(math.sqrt(points), 0.5 * SPACING * (points - 1))
    node = torch.linspace(-reach, reach, points, dtype=torch.float64)
    first = overlap * 2.0 * reach / (points - 1)
    log_w = (-0.5 * node.square() / (1.0 - first**2)).log_softmax(0)
    variance = 1.0 - (log_w.exp() * node.square()).sum()
    return node.to(template), log_w.to(template), variance.sqrt().to(template)
