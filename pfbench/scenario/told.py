"""A model that is told the noise regime of its world: the filter with it knows the law of every step, as an oracle would."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, MultivariateNormal, Normal

from pfbench.draws import Draws
from pfbench.model.base import StateSpaceModel, Wrapped, dense_normal, independent_normal
from pfbench.noise import laws
from pfbench.noise.laws import Law, Mixture
from pfbench.noise.regimes import Regime, step_process
from pfbench.record import Channels, Record
from pfbench.scenario.closed_loop import CorrectedFlight


@dataclass(eq=False)
class Witness:
    """A regime that passes everything on and keeps what the scenario said of its measurement, which Told needs."""

    regime: Regime
    channels: Channels | None = None

    def errors(self, draws: Draws, channels: Channels, time: Tensor) -> Tensor:
        self.channels = channels
        return self.regime.errors(draws, channels, time)

    def process(self, time: Tensor) -> Tensor:
        return self.regime.process(time)

    def law(self, channels: Channels, time: Tensor) -> Law:
        return self.regime.law(channels, time)

    def tell(self, model: StateSpaceModel, time: Tensor) -> Told:
        """The model that knows the regime of the world just drawn, whose steps are at `time` [T].

        Raises:
            ValueError: a scenario that asked for no errors; see Told.
        """
        if self.channels is None:
            raise ValueError("told=true: the scenario drew no errors from the noise regime; give told=false")
        return Told(model, self.regime, self.channels, time)


class Known(NamedTuple):
    """Inputs of a model that is told the regime.

    Attributes:
        inner: of the model inside.
        root: of the factor on its process noise [1, T].
        shift, scale: of its measurement's errors, in their standard deviations [1, T, Dy].
    """

    inner: Any
    root: Tensor
    shift: Tensor
    scale: Tensor


class Told(Wrapped):
    """`model`, knowing the regime: at each step the factor on Q and the law of the errors.

    The noise w is scaled about its mean by the root of the factor; the measurement's law is the regime's family, shifted and
    scaled from the deviations of the model's own normal law. What the model inside is, this one is too, except that it is
    linear only under normal errors.

    Args:
        model: what the filter believes otherwise; its measurement noise is normal.
        regime: of the world.
        channels: of the world's measurement.
        time: s, of the record's steps [T].

    Raises:
        ValueError: a regime without a law step by step; on use, a record of another length, or measurement noise that is not
            normal (not independent, under a regime that is not normal).
    """

    def __init__(self, model: StateSpaceModel, regime: Regime, channels: Channels, time: Tensor) -> None:
        super().__init__(model)
        self.observes_initial = model.observes_initial
        self.family, shift, scale = regime.law(channels, time)
        process = step_process(regime, time)
        self.swollen, self.moved = bool((process != 1.0).any()), bool((shift != 0.0).any() or (scale != 1.0).any())
        self.linear = model.linear and self.family is laws.normal
        self.linear_given = model.linear_given if self.family is laws.normal else ()
        told = "the filter's model is told the noise regime: at each step the factor on Q and the law of the errors"
        self.choices = (*model.choices, told)
        for name, value in (("root", process.sqrt()), ("shift", shift), ("scale", scale)):
            self.register_buffer(f"told_{name}", value.unsqueeze(0))

    def prepare(self, record: Record) -> Record:
        if isinstance(record.u, Known):
            return record
        record = self.model.prepare(record)
        own = [self.get_buffer(f"told_{name}") for name in ("root", "shift", "scale")]
        if isinstance(record.loop, CorrectedFlight):  # a step of a world that answers says which one it is
            own = [a[:, record.loop.t].unsqueeze(1) for a in own]
        if record.y.shape[1] != own[0].shape[1]:
            raise ValueError(f"the record has {record.y.shape[1]} steps, the filter was told of {own[0].shape[1]}")
        return record._replace(u=Known(record.u, *own))

    def propagate(self, x: Tensor, u: Known, w: Tensor) -> Tensor:
        if self.swollen:
            centre = self.model.noise.mean
            w = centre + u.root[:, None, None] * (w - centre)
        return self.model.propagate(x, u.inner, w)

    def noise_gain(self, u: Known) -> Tensor | None:
        gain = self.model.noise_gain(u.inner)
        return u.root[:, None, None] * gain if self.swollen and gain is not None else gain

    def transition(self, x: Tensor, u: Known) -> Distribution | None:
        """The model's, its deviations scaled where the noise enters additively; None where it has none."""
        law = self.model.transition(x, u.inner)
        if law is None or not self.swollen:
            return law
        if self.model.noise_gain(u.inner) is None:
            return None
        root = u.root[:, None, None]
        if isinstance(law, Independent) and isinstance(law.base_dist, Normal):
            return independent_normal(law.base_dist.loc, root * law.base_dist.scale)
        if isinstance(law, MultivariateNormal):
            return dense_normal(law.mean, root.unsqueeze(-1) * law.scale_tril)
        return None

    def observation(self, x: Tensor, u: Known) -> Distribution:
        law = self.model.observation(x, u.inner)
        if self.family is laws.normal and not self.moved:
            return law
        shift, scale = (a.unsqueeze(1) for a in (u.shift, u.scale))
        if isinstance(law, Independent) and isinstance(law.base_dist, Normal):
            centre, sd = law.base_dist.loc, law.base_dist.scale
            return self.family(centre + shift * sd, scale * sd)
        if isinstance(law, MultivariateNormal) and self.family is laws.normal:
            return dense_normal(law.mean + shift * law.stddev, scale.unsqueeze(-1) * law.scale_tril)
        raise ValueError(f"told=true: {type(self.model).__name__} has no independent normal measurement noise; give told=false")

    def assemble(self, truth: dict[str, Tensor]) -> Tensor:
        return self.model.assemble(truth)

    def error(self, mean: Tensor, truth: Tensor) -> Tensor:
        return self.model.error(mean, truth)

    def log_likelihood(self, y: Tensor, x: Tensor, u: Known) -> Tensor:
        if self.family is laws.normal and not self.moved:
            return self.model.log_likelihood(y, x, u.inner)
        law = self.observation(x, u)
        if isinstance(law, Mixture):
            return law.combine([self._density(part, y) for part in law.parts])
        return self._density(law, y) if isinstance(law, Independent) else super().log_likelihood(y, x, u)

    def _density(self, law: Any, y: Tensor) -> Tensor:
        """Log density of independent components over those that were seen: y [R, Dy] -> [R, N]."""
        seen, centre = ~torch.isnan(y).unsqueeze(1), law.mean
        r = torch.where(seen, self.residual(y.unsqueeze(1), centre), 0.0)
        density: Tensor = (law.base_dist.log_prob(centre + r) * seen).sum(-1)
        return density
