"""Worlds drawn from a model itself: for toys and training. A filter with the same model commits the inverse crime."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.distributions import Independent, Normal

from pfbench.draws import MonteCarlo
from pfbench.model.base import AtRest, StateSpaceModel
from pfbench.noise.regimes import Regime, step_process
from pfbench.record import Channels, Episode, Record


@dataclass(frozen=True)
class ModelWorld:
    """`steps` steps of `model`.

    A regime's factor on the process noise multiplies the variance of the noise that drives a step, averaged over the interval
    that ends with it.

    Args:
        model: draws states and measurements.
        steps: measurements per run.
        interval: seconds between them, for the report's time axis.

    Raises:
        ValueError: no steps; or, when drawing, a regime on a model whose measurement noise is not normal.
    """

    model: StateSpaceModel
    steps: int
    interval: float = 1.0

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise ValueError(f"scenario.steps={self.steps}: give at least 1 step")

    def draw(self, noise: Regime, runs: Tensor, seed: int) -> Episode:
        """States and measurements of these runs."""
        model, draws = self.model, MonteCarlo(seed, runs)
        time = self.interval * torch.arange(1, self.steps + 1, dtype=torch.float64)
        law = model.initial(len(runs))
        x = model.chart.add(model.origin.expand(1, 1, -1), _sample(law, draws.normal("world.state", 1, model.chart.dimension)))
        blank = Record(torch.full((len(runs), self.steps, 1), torch.nan, dtype=torch.float64))
        inputs, swell = model.prepare(blank), step_process(noise, time).sqrt()
        states, means, sds = [], [], []
        for t in range(self.steps):
            w = model.noise.mean + swell[t] * model.noise.stddev * draws.at(t + 1).normal("world.state", 1, model.noise_dim)
            stage = AtRest(model) if t == 0 and model.observes_initial else model
            u = inputs.at(t).u
            x = stage.propagate(x, u, w)
            seen = model.observation(x, u)
            if not (isinstance(seen, Independent) and isinstance(seen.base_dist, Normal)):
                raise ValueError(f"{type(model).__name__}: worlds are drawn for independent normal measurement noise only")
            states.append(x[:, 0])
            means.append(seen.mean[:, 0])
            sds.append(seen.stddev[:, 0])
        mean, sd = torch.stack(means, 1), torch.stack(sds, 1)
        unit = torch.ones(mean.shape[-1], dtype=torch.float64)
        y = mean + sd * noise.errors(draws, Channels.alike(unit), time)
        x_all = torch.stack(states, 1)
        truth = {name: x_all[..., list(parts)] for name, parts in model.groups.items()}
        return Episode(Record(y), time, truth)


def _sample(law: torch.distributions.Distribution, z: Tensor) -> Tensor:
    if isinstance(law, torch.distributions.MultivariateNormal):
        return law.mean.unsqueeze(1) + z @ law.scale_tril.mT
    return law.mean.unsqueeze(1) + law.stddev.unsqueeze(1) * z
