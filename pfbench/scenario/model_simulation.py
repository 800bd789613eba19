"""Episodes simulated from a model: for textbook models and training.

A filter that uses the same model is without model error. Its results are better than in an
application ("inverse crime").
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode, MeasurementChannels, Record
from pfbench.core.simulate import (
    draw_initial_state,
    draw_measurements,
    is_independent_normal,
    simulate_steps,
)
from pfbench.model.base import StateSpaceModel, named_inputs
from pfbench.noise.base import NoiseRegime, process_variance_factors
from pfbench.noise.white import NominalNoise
from pfbench.scenario.base import Scenario
from pfbench.scenario.recording_regime import regime_name


@dataclass(frozen=True)
class ModelSimulation(Scenario):
    """A scenario that simulates `steps` steps of `model`.

    Initial state, driving noise and measurements have the model's own distributions. A noise
    regime scales normal measurement errors. Its factor on the process noise multiplies the variance
    of the noise that drives a step, averaged over the interval that ends with the step.

    Attributes:
        model: State-space model that draws states and measurements.
        steps: Measurements per run.
        interval_s: Time between measurements, s, for the time axis of the report.

    Raises:
        ValueError: If steps is below 1, or the interval or the threshold is not positive. `draw` raises it if a
            regime changes measurement errors that are not independent normal.
    """

    model: StateSpaceModel
    steps: int
    interval_s: float = 1.0
    input_type = tuple  # no inputs

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Measured channels: those of the model."""
        return self.model.channel_names

    def __post_init__(self) -> None:
        if not isinstance(self.steps, int) or self.steps < 1:
            raise ValueError(
                f"scenario.steps must be a whole number of at least 1, got {self.steps}. "
                "Change scenario.steps."
            )
        if not self.interval_s > 0.0:
            raise ValueError(
                f"scenario.interval_s must be positive, got {self.interval_s}. Give it in seconds."
            )

    @override
    def draw(self, noise: NoiseRegime, runs: Tensor, seed: int) -> Episode:
        model, stream = self.model, PhiloxStream(seed, runs)
        time = self.interval_s * torch.arange(1, self.steps + 1, dtype=torch.float64)
        blank = torch.full((len(runs), self.steps, 1), torch.nan, dtype=torch.float64)
        x = draw_initial_state(model, model.initial(len(runs)), stream, "world.state")
        with named_inputs(model):
            inputs = model.prepare(Record(blank))
            scale = process_variance_factors(noise, time).sqrt()
            steps = list(simulate_steps(model, inputs, stream, x, "world.state", scale))
        y = _measurements(self.model, [step.distribution for step in steps], noise, stream, time)
        states = torch.cat([step.x for step in steps], 1)
        truth = {name: states[..., list(indices)] for name, indices in model.groups.items()}
        return Episode(Record(y), time, truth)


def _measurements(
    model: StateSpaceModel,
    distributions: list[Distribution],
    noise: NoiseRegime,
    stream: PhiloxStream,
    time: Tensor,
) -> Tensor:
    """Draw measurements under a noise regime [R, T, Dy]."""
    unit = torch.ones(distributions[0].event_shape, dtype=torch.float64)
    channels = MeasurementChannels.of_one_kind(unit)
    errors = noise.draw_errors(stream, channels, time)
    if all(is_independent_normal(distribution) for distribution in distributions):
        return draw_measurements(distributions, stream, "world.receiver", errors)
    missing_mask = torch.isnan(errors)
    nominal = NominalNoise().draw_errors(stream, channels, time)
    if not torch.equal(torch.where(missing_mask, nominal, errors), nominal):
        raise ValueError(
            f"noise must be nominal for {type(model).__name__}, whose measurement errors are not "
            f"independent normal, got {regime_name(noise)}. Choose noise=nominal."
        )
    y = draw_measurements(distributions, stream, "world.receiver")
    return torch.where(missing_mask, torch.nan, y)
