"""Oracle noise: a model that receives the true noise regime of the episode."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, MultivariateNormal, Normal
from typing_extensions import override

from pfbench.core.density import dense_normal, independent_normal
from pfbench.core.record import MeasurementChannels, Record
from pfbench.model.base import ModelWrapper, StateSpaceModel
from pfbench.noise.base import (
    MixtureDistribution,
    NoiseRegime,
    make_normal,
    process_variance_factors,
)
from pfbench.scenario.closed_loop import ClosedLoopRun


class OracleNoiseInputs(NamedTuple):
    """Inputs of a model with oracle noise.

    Attributes:
        inputs: Inputs of the inner model.
        root: Square root of the factor on the process noise variance, [1, T].
        shift: Shift of the measurement errors, in standard deviations, [1, T, Dy].
        scale: Scale of the measurement errors, in standard deviations, [1, T, Dy].
    """

    inputs: Any
    root: Tensor
    shift: Tensor
    scale: Tensor


class OracleNoiseModel(ModelWrapper):
    """A model with the true noise of each step.

    The true noise consists of the factor on Q and the distribution of the errors. The process noise w
    is scaled about its mean by the root of the factor. The measurement distribution is of the
    regime's family, with shift and scale relative to the normal distribution of the inner model. All
    other properties are those of the inner model. It is linear only with normal errors.

    Shapes: time [T].
    """

    def __init__(
        self,
        model: StateSpaceModel,
        regime: NoiseRegime,
        channels: MeasurementChannels,
        time: Tensor,
    ) -> None:
        super().__init__(model)
        self.observes_initial = model.observes_initial
        self.family, shift, scale = regime.error_distribution(channels, time)
        process = process_variance_factors(regime, time)
        self.scales_process = bool((process != 1.0).any())
        self.has_normal_errors = self.family is make_normal
        changes_errors = bool((shift != 0.0).any() or (scale != 1.0).any())
        self.has_nominal_errors = self.has_normal_errors and not changes_errors
        self.linear = model.linear and self.has_normal_errors
        self.linear_given = model.linear_given if self.has_normal_errors else ()
        choice = (
            "the filter model receives the true noise: at each step the factor on Q "
            "and the distribution of the errors"
        )
        self.choices = (*model.choices, choice)
        for name, value in (("root", process.sqrt()), ("shift", shift), ("scale", scale)):
            self.register_buffer(f"oracle_{name}", value.unsqueeze(0))

    @override
    def prepare(self, record: Record) -> Record:
        if isinstance(record.u, OracleNoiseInputs):
            return record
        record = self.model.prepare(record)
        noise = [self.get_buffer(f"oracle_{name}") for name in ("root", "shift", "scale")]
        if isinstance(record.feedback, ClosedLoopRun):
            # the record of a closed-loop run has one step
            noise = [a[:, record.feedback.t].unsqueeze(1) for a in noise]
        if record.y.shape[1] != noise[0].shape[1]:
            raise ValueError(
                f"The record must have {noise[0].shape[1]} steps, as the oracle noise, "
                f"got {record.y.shape[1]}. Use the record of the same episode."
            )
        return record._replace(u=OracleNoiseInputs(record.u, *noise))

    @override
    def propagate(self, x: Tensor, u: OracleNoiseInputs, w: Tensor) -> Tensor:
        if self.scales_process:
            centre = self.model.noise.mean
            w = centre + u.root[:, None, None] * (w - centre)
        return self.model.propagate(x, u.inputs, w)

    @property
    @override
    def has_noise_gain(self) -> bool:
        return self.model.has_noise_gain

    @override
    def noise_gain(self, u: OracleNoiseInputs) -> Tensor | None:
        gain = self.model.noise_gain(u.inputs)
        return u.root[:, None, None] * gain if self.scales_process and gain is not None else gain

    @override
    def transition(self, x: Tensor, u: OracleNoiseInputs) -> Distribution | None:
        """Return the transition distribution with scaled process noise.

        Returns distribution with batch [R, N]. None if the inner model does not define it, or if
        scaled noise is not additive. Shapes: x [R, N, D].
        """
        distribution = self.model.transition(x, u.inputs)
        if distribution is None or not self.scales_process:
            return distribution
        if self.model.noise_gain(u.inputs) is None:
            return None
        root = u.root[:, None, None]
        if isinstance(distribution, Independent) and isinstance(distribution.base_dist, Normal):
            base = distribution.base_dist
            return independent_normal(base.loc, root * base.scale)
        if isinstance(distribution, MultivariateNormal):
            return dense_normal(distribution.mean, root.unsqueeze(-1) * distribution.scale_tril)
        return None

    @override
    def observation(self, x: Tensor, u: OracleNoiseInputs) -> Distribution:
        distribution = self.model.observation(x, u.inputs)
        if self.has_nominal_errors:
            return distribution
        shift, scale = (a.unsqueeze(1) for a in (u.shift, u.scale))
        if isinstance(distribution, Independent) and isinstance(distribution.base_dist, Normal):
            centre, sd = distribution.base_dist.loc, distribution.base_dist.scale
            return self.family(centre + shift * sd, scale * sd)
        if isinstance(distribution, MultivariateNormal) and self.has_normal_errors:
            return dense_normal(
                distribution.mean + shift * distribution.stddev,
                scale.unsqueeze(-1) * distribution.scale_tril,
            )
        raise ValueError(
            "oracle_noise must be false for a model without independent normal measurement noise, "
            f"got true with {type(self.model).__name__}. Set oracle_noise=false."
        )

    @override
    def assemble(self, truth: dict[str, Tensor]) -> Tensor:
        return self.model.assemble(truth)

    @override
    def error(self, mean: Tensor, truth: Tensor) -> Tensor:
        return self.model.error(mean, truth)

    @override
    def log_likelihood(self, y: Tensor, x: Tensor, u: OracleNoiseInputs) -> Tensor:
        if self.has_nominal_errors:
            return self.model.log_likelihood(y, x, u.inputs)
        distribution = self.observation(x, u)
        if isinstance(distribution, MixtureDistribution):
            densities = [self._log_density(component, y) for component in distribution.components]
            return distribution.combine_log_densities(densities)
        if isinstance(distribution, Independent):
            return self._log_density(distribution, y)
        return super().log_likelihood(y, x, u)

    def _log_density(self, distribution: Any, y: Tensor) -> Tensor:
        """Compute the log density [R, N] of the observed components of y [R, Dy]."""
        observed_mask, centre = ~torch.isnan(y).unsqueeze(1), distribution.mean
        r = torch.where(observed_mask, self.residual(y.unsqueeze(1), centre), 0.0)
        density: Tensor = (distribution.base_dist.log_prob(centre + r) * observed_mask).sum(-1)
        return density
