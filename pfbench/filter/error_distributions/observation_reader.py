"""Protocol for the use of an observation distribution that is not normal in a Gaussian filter."""

from __future__ import annotations

from typing import Any, Protocol

from torch import Tensor

from pfbench.model.base import StateSpaceModel


class ObservationReader(Protocol):
    """Use of an observation distribution that is not normal."""

    def observe(self, model: StateSpaceModel, distribution: Any) -> tuple[Tensor, Tensor]:
        """Return location [R, P, k] and covariance [R or 1, P or 1, k, k] for the linearisation.

        Args:
            model: State-space model.
            distribution: Observation distribution at P points, batch [R, P].
        """

    def read_parameters(self, model: StateSpaceModel, distribution: Any) -> tuple[Tensor, ...]:
        """Return other values of the distribution at the mean, [R, ...].

        Args:
            model: State-space model.
            distribution: Observation distribution at the mean of the state, batch [R, 1].
        """
