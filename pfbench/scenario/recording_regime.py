"""Noise regime that remembers the measurement channels of a scenario, for a model with oracle noise."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from pfbench.core.random_stream import RandomStream
from pfbench.core.record import MeasurementChannels
from pfbench.model.base import StateSpaceModel
from pfbench.noise.base import NoiseRegime
from pfbench.noise.distributions import ErrorDistribution
from pfbench.scenario.oracle_noise import OracleNoiseModel


@dataclass(eq=False)
class RecordingRegime:
    """Noise regime that records the measurement channels of the scenario.

    All calls go to the inner regime. `OracleNoiseModel` needs the channels.

    Attributes:
        regime: Inner regime.
        channels: Latest measurement channels. None before the first draw.
    """

    regime: NoiseRegime
    channels: MeasurementChannels | None = None

    def draw_errors(
        self, draws: RandomStream, channels: MeasurementChannels, time: Tensor
    ) -> Tensor:
        """Draw errors from the inner regime and record the channels.

        Args:
            draws: Random stream.
            channels: Measurement components.
            time: Times, s, [T].

        Returns:
            Errors, [R, T, Dy].
        """
        self.channels = channels
        return self.regime.draw_errors(draws, channels, time)

    def process_factors(self, time: Tensor) -> Tensor:
        """Return the factors on the process noise variance at times [T], s."""
        return self.regime.process_factors(time)

    def error_distribution(self, channels: MeasurementChannels, time: Tensor) -> ErrorDistribution:
        """Return family, shift and scale of the errors at each step.

        Args:
            channels: Measurement components.
            time: Times, s, [T].
        """
        return self.regime.error_distribution(channels, time)

    def to_oracle_model(self, model: StateSpaceModel, time: Tensor) -> OracleNoiseModel:
        """Build the model with the true noise of the latest episode.

        Args:
            model: Model without oracle noise.
            time: Times of the steps, s, [T].

        Returns:
            The model with oracle noise.

        Raises:
            ValueError: If the scenario drew no errors; see `OracleNoiseModel`.
        """
        if self.channels is None:
            raise ValueError(
                "oracle_noise must be false for a scenario without errors from a noise regime, "
                "got true. Set oracle_noise=false."
            )
        return OracleNoiseModel(model, self.regime, self.channels, time)


def regime_name(noise: NoiseRegime) -> str:
    """Return the class name of a noise regime, for messages. A job wraps it in a `RecordingRegime`."""
    return type(noise.regime if isinstance(noise, RecordingRegime) else noise).__name__
