"""Candidates of one filter side by side: each has its own runs of one batch, which one pass filters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.filter.belief import GaussianBelief
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.gaussian.innovation import Innovation, NoiseAdaptation
from pfbench.filter.gaussian.linearisation_rules import AffineApproximation
from pfbench.filter.robust.robust_update import RobustUpdate
from pfbench.filter.robust.scaled_noise import ScaledNoise, scale_process_noise

_CHANGED = ("r", "observed_mask", "m", "omega", "noise")  # fields that an adaptation of R replaces


@dataclass(frozen=True, eq=False)
class JointAdaptation(NoiseAdaptation):
    """The noise adaptations of several candidates, each for its own runs.

    A linearisation costs the same for all of them, so that 16 candidates take the time of a few.

    Attributes:
        r_factor: Factor on R of each run, [R].
        q_factor: Factor on Q of each run, [R].
        updates: Distinct robust updates, each with the places of its runs.
    """

    r_factor: Tensor
    q_factor: Tensor
    updates: tuple[tuple[NoiseAdaptation, Tensor], ...]

    @override
    def predict_scale(
        self, predicted: AffineApproximation, belief: GaussianBelief
    ) -> AffineApproximation:
        scaled = scale_process_noise(predicted, self.q_factor.to(predicted.noise))
        if all(isinstance(update, RobustUpdate) for update, _ in self.updates):
            return scaled  # which they do not change
        parts = [
            update.predict_scale(_select(scaled, places), _select(belief, places))
            for update, places in self.updates
        ]
        return AffineApproximation(*(self._join(fields) for fields in zip(*parts, strict=True)))

    @override
    def noise_adapt(
        self, innovation: Innovation, belief: GaussianBelief
    ) -> tuple[Innovation, dict[str, Tensor]]:
        scaled = innovation.with_noise(
            innovation.noise * self.r_factor.to(innovation.noise)[:, None, None]
        )
        if not self.updates:
            return scaled, {}
        innovations, memories = zip(
            *(
                update.noise_adapt(_select(scaled, places), _select(belief, places))
                for update, places in self.updates
            ),
            strict=True,
        )
        r, observed_mask, m, omega, noise = (
            self._join([getattr(several, name) for several in innovations]) for name in _CHANGED
        )
        memory = {name: self._join([several[name] for several in memories]) for name in memories[0]}
        adapted = scaled._replace(r=r, observed_mask=observed_mask, m=m, omega=omega, noise=noise)
        return adapted, memory

    def _join(self, parts: Sequence[Tensor]) -> Tensor:
        """Join the values of the runs of all updates in the order of the runs."""
        return torch.cat(list(parts))[torch.cat([places for _, places in self.updates]).argsort()]


def join_candidates(filters: Sequence[GaussianFilter], runs: int) -> GaussianFilter:
    """Return the filter in which each candidate has its own runs.

    Args:
        filters: Filters that differ in their noise adaptations: a factor on R and Q, then at most one update.
        runs: Number of runs of each.
    """
    chains = [list(method.noise_adaptations) for method in filters]
    factors = [[getattr(chain[0], name) for chain in chains] for name in ("r_factor", "q_factor")]
    assert all(isinstance(chain[0], ScaledNoise) for chain in chains)
    r_factor, q_factor = (
        torch.tensor(values, dtype=torch.float64).repeat_interleave(runs) for values in factors
    )
    places: dict[NoiseAdaptation, list[Tensor]] = {}
    for k, chain in enumerate(chains):
        for update in chain[1:]:
            places.setdefault(update, []).append(torch.arange(k * runs, (k + 1) * runs))
    updates = tuple((update, torch.cat(several)) for update, several in places.items())
    return replace(filters[0], noise_adaptations=(JointAdaptation(r_factor, q_factor, updates),))


def _select(parts: Any, places: Tensor) -> Any:
    """Return an innovation or a belief of some runs; values that all runs share stay."""
    runs = len(parts[0])

    def select(value: Any) -> Any:
        if isinstance(value, dict):
            return {name: select(entry) for name, entry in value.items()}
        if isinstance(value, tuple):
            return tuple(map(select, value))
        return value[places] if value.dim() and len(value) == runs else value

    return type(parts)(*map(select, parts))
