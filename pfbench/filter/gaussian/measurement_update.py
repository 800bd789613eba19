"""The measurement update of a Gaussian filter: the Kalman update, or one for other distributions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from torch import Tensor

from pfbench.filter.error_distributions.observation_reader import ObservationReader
from pfbench.filter.gaussian.innovation import Innovation
from pfbench.filter.gaussian.kalman_update import kalman_gain_update


class WhitenedPosterior(NamedTuple):
    """Posterior of the whitened state after a measurement.

    Attributes:
        mean: [R, d].
        root: Upper triangular square root of the covariance, [R, d, d].
        log_likelihood: Log evidence of the step, [R]; NaN without a root.
        innovation: Innovation with the noise in use.
        trace: Diagnostics by name, [R].
    """

    mean: Tensor
    root: Tensor
    log_likelihood: Tensor
    innovation: Innovation
    trace: dict[str, Tensor]


class MeasurementUpdate(ObservationReader, Protocol):
    """An update for an observation distribution that is not normal.

    Attributes:
        has_evidence: True if the log evidence is a log density of the measurements.
    """

    has_evidence: bool = False

    def __call__(self, innovation: Innovation) -> WhitenedPosterior:
        """Compute the whitened posterior.

        Args:
            innovation: Innovation of the step. `parameters` contains the values of `read_parameters`.
        """


def check_measurement_update(update: object, adaptations: Sequence[object]) -> None:
    """Check that an update has the calls of one, and that no adaptation comes with it.

    Args:
        update: Update, None for normal errors.
        adaptations: Noise and gain adaptations of the filter.

    Raises:
        ValueError: If it lacks a call, or if there are adaptations.
    """
    if update is None:
        return
    if isinstance(update, type) or not all(
        hasattr(update, a) for a in ("observe", "read_parameters")
    ):
        kind = update.__name__ if isinstance(update, type) else type(update).__name__
        raise ValueError(
            "filter.measurement_update must be an update for an observation distribution, got "
            f"{kind}. Use StudentObservationUpdate() or MixtureObservationUpdate()."
        )
    if adaptations:
        names = " and ".join(type(adaptation).__name__ for adaptation in adaptations)
        raise ValueError(
            "filter.noise_adaptations and filter.gain_adaptations must be empty with "
            f"measurement_update, got {names}. Remove them: the measurement would count twice."
        )


def measurement_posterior(
    update: MeasurementUpdate | None, innovation: Innovation
) -> WhitenedPosterior:
    """Compute the whitened posterior.

    Args:
        update: Update, None for normal errors.
        innovation: Innovation of the step.

    Returns:
        The posterior.
    """
    if update is not None:
        return update(innovation)
    return WhitenedPosterior(*kalman_gain_update(innovation), innovation, {})
