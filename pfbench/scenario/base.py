"""Interface of scenarios, and the noise regime that a job gives them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from torch import Tensor

from pfbench.core.parameter_checks import require_range
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Episode, MeasurementChannels
from pfbench.model.base import StateSpaceModel
from pfbench.noise.base import ErrorDistribution, NoiseRegime

if TYPE_CHECKING:
    from pfbench.scenario.oracle_noise import OracleNoiseModel


class Scenario(Protocol):
    """Generator of episodes, independent of the filters.

    It may state what it provides, which is then compared with the model (`pfbench.core.record`):
    `channel_names`, the quantity, frame and unit of each component of y, and `input_type`, the NamedTuple
    of the inputs u. It may state `steps`, its measurements per run, and `samples`, those of its inertial sensors:
    a job that cannot fit into memory is then refused before they are drawn.
    """

    def draw(self, noise: NoiseRegime, runs: Tensor, seed: int) -> Episode:
        """Draw the episode of some runs.

        Args:
            noise: Noise regime.
            runs: Run numbers, int64, [R].
            seed: Seed. With the run number it fixes all random numbers of a run.

        Returns:
            Episode with R runs.
        """


def check_duration(name: str, value: float) -> None:
    """Check that a time is positive."""
    require_range(name, value, "(0, inf]")


def check_added_sd(name: str, sd: float) -> None:
    """Check the standard deviation of errors that are added to recorded measurements."""
    require_range(name, sd, "[0, inf] Use 0 for no added errors.")


@dataclass(eq=False)
class RecordingRegime:
    """Noise regime that records the measurement channels of the scenario.

    All calls go to the inner regime. `OracleNoiseModel` needs the channels.

    Attributes:
        regime: Inner regime.
        channels: Latest measurement channels. None before the first draw.
        time: Their times [T], s.
    """

    regime: NoiseRegime
    channels: MeasurementChannels | None = None
    time: Tensor | None = None

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
        self.channels, self.time = channels, time
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
        from pfbench.scenario.oracle_noise import OracleNoiseModel

        return OracleNoiseModel(model, self.regime, self.channels, time)


def regime_name(noise: NoiseRegime) -> str:
    """Return the class name of a noise regime, for messages. A job wraps it in a `RecordingRegime`."""
    return type(noise.regime if isinstance(noise, RecordingRegime) else noise).__name__
