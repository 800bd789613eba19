"""Paths of a model as vectors of standard normal numbers: initial state and driving noise.

A singular model does not have a transition density of its states. Its paths have a density in these
numbers: a standard normal one times the likelihood of all measurements.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.distributions import Independent, MultivariateNormal, Normal

from pfbench.core.covariance import distribution_covariance, factor
from pfbench.core.record import Record, iterate_steps
from pfbench.filter.loop import prepare_record
from pfbench.filter.smoothing.gaussian_smoother import check_no_feedback
from pfbench.model.base import StateSpaceModel, initial_law


class NoiseSpace:
    """Map from standard normal numbers to paths of a model, for one record.

    A vector theta [d + T W] holds the whitened initial state and then the whitened noise of each
    step. M is the number of paths of a run.

    Args:
        model: State-space model with normal initial state and noise.
        record: Measurements [R, T, Dy] and inputs.

    Attributes:
        model: The model.
        steps: Model and record of each step.
        runs: Number of runs R.
        size: Size of a vector.

    Raises:
        ValueError: If the initial state or the noise is not normal, or the record has feedback.
    """

    def __init__(self, model: StateSpaceModel, record: Record) -> None:
        check_no_feedback(record)
        inputs = prepare_record(model, record)
        self.model, self.runs = model, len(record.y)
        self.steps = [(step_model, step) for _, step_model, step in iterate_steps(model, inputs)]
        initial: Any = initial_law(model, self.runs, inputs.spread)
        for name, distribution in (("initial", initial), ("noise", model.noise)):
            _check_normal(type(model).__name__, name, distribution)
        noise: Any = model.noise
        self._noise_mean, self._noise_sd = noise.mean, noise.stddev
        origin = model.origin.expand(self.runs, -1) if inputs.start is None else inputs.start
        self._origin = origin.unsqueeze(1)
        self._mean = initial.mean.expand(self.runs, -1).unsqueeze(1)
        root, _ = factor(distribution_covariance(initial).expand(self.runs, -1, -1))
        self._root = root
        self.size = model.chart.dimension + len(self.steps) * model.noise_dim

    def start(self, xi: Tensor) -> Tensor:
        """Return initial states [R, M, D] of whitened vectors [R, M, d]."""
        return self.model.chart.add(self._origin, self._mean + xi @ self._root.mT)

    def noise(self, theta: Tensor, t: int) -> Tensor:
        """Return the whitened noise of a step.

        Args:
            theta: Vectors, [R, M, size].
            t: Step from 0.

        Returns:
            Noise, [R, M, W].
        """
        begin = self.model.chart.dimension + t * self.model.noise_dim
        return theta[..., begin : begin + self.model.noise_dim]

    def advance(self, t: int, x: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
        """Take a step.

        Args:
            t: Step from 0.
            x: States before the step, [R, M, D].
            w: Whitened noise, [R, M, W].

        Returns:
            States after the step [R, M, D] and their log likelihoods [R, M].
        """
        model, record = self.steps[t]
        x = model.propagate(x, record.u, self._noise_mean + self._noise_sd * w)
        return x, model.log_likelihood(record.y, x, record.u)

    def roll_out(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Return the paths of vectors and their log likelihoods.

        Args:
            theta: Vectors, [R, M, size].

        Returns:
            States x_1 to x_T, [R, M, T, D], and log p(y_1:T | path), [R, M].
        """
        x = self.start(theta[..., : self.model.chart.dimension])
        states, total = [], torch.zeros_like(x[..., 0])
        for t, _ in enumerate(self.steps):
            x, log_likelihood = self.advance(t, x, self.noise(theta, t))
            states.append(x)
            total = total + log_likelihood
        return torch.stack(states, 2), total

    def residuals(self, theta: Tensor) -> Tensor:
        """Return the whitened residuals of the measurements of paths.

        Args:
            theta: Vectors, [R, M, size].

        Returns:
            L^-1 (y - y_hat) with L L' the covariance of the measurement, [R, M, T Dy]; 0 for
            missing components.
        """
        states, _ = self.roll_out(theta)
        rows = []
        for t, (model, record) in enumerate(self.steps):
            distribution: Any = model.observation(states[:, :, t], record.u)
            y = record.y.unsqueeze(1)
            observed_mask = ~torch.isnan(y)
            r = torch.where(observed_mask, model.residual(y, distribution.mean), 0.0)
            covariance = distribution_covariance(distribution)
            pairs = observed_mask.unsqueeze(-1) & observed_mask.unsqueeze(-2)
            eye = torch.eye(r.shape[-1], dtype=r.dtype, device=r.device)
            root, _ = factor(torch.where(pairs, covariance, eye))
            row = torch.linalg.solve_triangular(root, r.unsqueeze(-1), upper=False)
            rows.append(row.squeeze(-1))
        return torch.cat(rows, -1)


def _check_normal(model: str, name: str, distribution: Any) -> None:
    """Raise an error if a distribution is not normal."""
    base = distribution.base_dist if isinstance(distribution, Independent) else distribution
    if not isinstance(base, Normal | MultivariateNormal):
        raise ValueError(
            f"{model}.{name} must be normal for smoothing in noise space, got "
            f"{type(base).__name__}. Use sample_trajectories."
        )
