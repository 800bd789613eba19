"""Innovation of a Gaussian filter, the adaptations that change it, and its principal axes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from pfbench.core.linear_algebra import factor, shared_distribution_covariance, squared_length
from pfbench.core.parameter_checks import require
from pfbench.core.record import Record
from pfbench.filter.belief import GaussianBelief
from pfbench.filter.gaussian.linearisation_rules import (
    AffineApproximation,
    DifferenceSpace,
    LinearisationRule,
)
from pfbench.filter.linearisation import around_first, check_moments, find_observation_jacobian
from pfbench.model.base import StateSpaceModel

_SMALLEST_WEIGHT = 1e-12  # of a reweighted component: R times 1e12


class Innovation(NamedTuple):
    """Innovation r = M xi + e with unknown xi ~ N(0, I), Cov e = Omega.

    Attributes:
        r: y - y_hat, [R, k]; 0 for missing components.
        observed_mask: Observed components, bool [R, k].
        m: M, [R, k, d].
        omega: Omega, [R, k, k]: measurement noise in use and linearisation error.
        noise: Measurement noise in use, [R, k, k]; 1 for missing components.
        nominal: Measurement noise of the model, all components, [R, k, k].
        root: Root of the predicted covariance that whitens xi, [R, d, d].
        parameters: Values of an `ObservationReader`, [R, ...].
    """

    r: Tensor
    observed_mask: Tensor
    m: Tensor
    omega: Tensor
    noise: Tensor = torch.zeros(())
    nominal: Tensor = torch.zeros(())
    root: Tensor = torch.zeros(())
    parameters: tuple[Tensor, ...] = ()

    @property
    def predicted_covariance(self) -> Tensor:
        """Covariance of y_hat due to the predicted state, [R, k, k]."""
        return self.m @ self.m.mT + (self.omega - self.noise)

    def nis(self) -> tuple[Tensor, Tensor]:
        """Compute the normalised innovation squared and the number of observed components, [R]."""
        return squared_length(self.r, self.m @ self.m.mT + self.omega), self.observed_mask.sum(1)

    def with_noise(self, noise: Tensor) -> Innovation:
        """Replace the measurement noise [R, k, k]; missing components keep 1."""
        noise = torch.where(
            self.observed_mask.unsqueeze(-1) & self.observed_mask.unsqueeze(-2), noise, self.noise
        )
        return self._replace(omega=self.omega + (noise - self.noise), noise=noise)

    def reweight(self, weight: Tensor, group_mask: Tensor) -> Innovation:
        """Divide the measurement noise of groups of components by weights.

        R of a group is divided by its weight. The additional noise of a group is independent of the
        others, so that a large error of one group does not reach another [ours].

        Returns the innovation. A weight of 0 is the smallest that leaves R finite. Shapes: weight
        [R, k], group_mask [R, k, k].
        """
        factor = 1.0 / weight.clamp(min=_SMALLEST_WEIGHT)
        shared = factor.clamp(max=1.0).sqrt()
        cross = shared.unsqueeze(-1) * shared.unsqueeze(-2)
        return self.with_noise(self.noise * (cross + group_mask * (factor.unsqueeze(-1) - cross)))

    def reject(self, rejected_mask: Tensor) -> Innovation:
        """Turn components [R, k] into missing ones: exactly as if y were NaN there."""
        observed_mask = self.observed_mask & ~rejected_mask
        pair_mask = observed_mask.unsqueeze(-1) & observed_mask.unsqueeze(-2)
        eye = torch.eye(self.r.shape[-1], dtype=self.r.dtype, device=self.r.device)
        omega, noise = (torch.where(pair_mask, a, eye) for a in (self.omega, self.noise))
        return self._replace(
            r=torch.where(observed_mask, self.r, 0.0),
            observed_mask=observed_mask,
            m=torch.where(observed_mask.unsqueeze(-1), self.m, 0.0),
            omega=omega,
            noise=noise,
        )

    def inflate(self, factor: Tensor) -> Innovation:
        """Multiply the predicted covariance by `factor` [R]."""
        f = factor[:, None, None]
        omega = self.omega + (f - 1.0) * (self.omega - self.noise)
        return self._replace(m=self.m * f.sqrt(), omega=omega, root=self.root * f.sqrt())


class NoiseAdaptation(Protocol):
    """A change of the filter's noise covariances; both hooks may be the identity.

    Attributes:
        has_evidence: True if R and Q of a step do not depend on its measurement. Otherwise the
            evidence of the filter is not a density of the measurements.
    """

    has_evidence: bool = False

    def predict_scale(
        self, predicted: AffineApproximation, belief: GaussianBelief
    ) -> AffineApproximation:
        """Scale the linearised prediction.

        Args:
            predicted: Prediction. Its Omega contains the process noise `noise`. If the noise passed
                through the rule, the columns of M after the state's contain it.
            belief: Belief at t-1.

        Returns:
            The scaled prediction.
        """

    def noise_adapt(
        self, innovation: Innovation, belief: GaussianBelief
    ) -> tuple[Innovation, dict[str, Tensor]]:
        """Replace the noise covariance of the innovation.

        Args:
            innovation: Innovation of the step.
            belief: Belief at t-1, with the values that the adaptation returned in step t-1.

        Returns:
            The innovation with another noise covariance, and values for the next step by name,
            [R, ...].
        """


class GainAdaptation(Protocol):
    """A change of the gain: it maps the factor on the predicted covariance [R] to a new one.

    Attributes:
        has_evidence: True if the factor does not depend on the measurement of the step.
    """

    has_evidence: bool = False

    def __call__(self, innovation: Innovation, factor: Tensor) -> Tensor:
        """Return the new factor [R].

        Args:
            innovation: Innovation of the step.
            factor: Factor so far, [R].
        """


def compute_innovation(
    linearisation: LinearisationRule,
    model: StateSpaceModel,
    state_at: Callable[[Tensor], Tensor],
    template: Tensor,
    record: Record,
    root: Tensor | None = None,
    reader: ObservationReader | None = None,
) -> Innovation:
    """Compute the innovation by statistical linearisation.

    Shapes: state_at [R, P, d], template [R, ...], root [R, d, d].
    """

    def observe_points(xi: Tensor) -> tuple[Tensor, Tensor]:
        distribution: Any = model.observation(state_at(xi), record.u)
        if reader is not None:
            return reader.observe(model, distribution)
        check_moments(model, "observation", distribution)
        return distribution.mean, shared_distribution_covariance(distribution)

    zero = template.new_zeros(len(template), 1, model.chart.dimension)

    def slope() -> Tensor | None:
        if root is None:
            return None
        h = find_observation_jacobian(model, state_at(zero), record.u)
        return None if h is None else h[:, 0] @ root

    space = DifferenceSpace(model.residual, around_first(model.residual), slope)
    y_hat, m, omega, noise = linearisation(observe_points, template, model.chart.dimension, space)
    observed_mask = ~torch.isnan(record.y)
    r = torch.where(observed_mask, model.residual(record.y, y_hat), 0.0)
    pair_mask = observed_mask.unsqueeze(-1) & observed_mask.unsqueeze(-2)
    eye = torch.eye(r.shape[-1], dtype=r.dtype, device=r.device)
    m = torch.where(observed_mask.unsqueeze(-1), m, 0.0)
    omega, noise_in_use = (torch.where(pair_mask, a, eye) for a in (omega, noise))
    innovation = Innovation(r, observed_mask, m, omega, noise_in_use, noise)
    if reader is None:
        return innovation
    distribution = model.observation(state_at(zero), record.u)
    return innovation._replace(parameters=reader.read_parameters(model, distribution))


def linearise_about_posterior(
    linearisation: LinearisationRule,
    model: StateSpaceModel,
    mean: Tensor,
    root: Tensor,
    shift: Tensor,
    updated: Tensor,
    record: Record,
    reader: ObservationReader | None = None,
) -> Innovation:
    """Compute the innovation about the updated distribution, in the coordinates of the prior.

    Shapes: mean [R, D], root [R, d, d], shift [R, d], updated [R, d, d].
    """

    def state_at(xi: Tensor) -> Tensor:
        whitened = shift.unsqueeze(1) + xi @ updated.mT
        return model.chart.add(mean.unsqueeze(1), whitened @ root.mT)

    slope = root @ updated if model.chart.flat else None  # else the chart bends away from the mean
    new = compute_innovation(linearisation, model, state_at, mean, record, slope, reader)
    m = torch.linalg.solve_triangular(updated, new.m, upper=True, left=False)
    return new._replace(m=m, r=new.r + (m @ shift.unsqueeze(-1)).squeeze(-1), root=root)


# --------------------------------------------------------------------------------------------------
# Principal axes of innovations in units of the noise, by sensor group.


class PrincipalAxes(NamedTuple):
    """Principal axes of the predicted measurement covariance, in units of the noise.

    Attributes:
        ratio: Eigenvalues lambda of the predicted covariance, [R, k].
        w: Innovation along the axes, [R, k].
        observed_mask: Mask of axes whose components were observed, [R, k].
        fraction: Squared components of the axes, [R, k components, k axes]. An axis stays within
            its group.
        group_mask: 1 where an axis belongs to the group of a component, observed or not,
            [R, k components, k axes].
    """

    ratio: Tensor
    w: Tensor
    observed_mask: Tensor
    fraction: Tensor
    group_mask: Tensor

    def to_axes(self, value: Tensor) -> Tensor:
        """Map values that are equal within a group from components to axes, both [R, k]."""
        return (self.fraction.mT @ value.unsqueeze(-1)).squeeze(-1)


def principal_axes(innovation: Innovation, groups: Sequence[int] | None = None) -> PrincipalAxes:
    """Compute the eigenvalues of the predicted covariance against the noise, by group.

    One block matrix contains all groups. Its blocks are separated by multiples of more than its
    trace. No axis mixes two groups, even if both have the eigenvalue 0, and the observed
    components may differ between runs.
    """
    group_mask, joint_mask = axes_by_group(innovation, groups)
    root = compute_group_root(innovation.nominal, joint_mask)
    white = whitened_measurement(root, innovation.predicted_covariance, joint_mask)
    # index of the first component of the same group
    first = torch.where(
        innovation.observed_mask, joint_mask.to(torch.int8).argmax(-1), joint_mask.shape[-1]
    )
    block_offset = first * (1.0 + diagonal_axes(white).abs().sum(-1, keepdim=True))
    _, axes = torch.linalg.eigh(white + torch.diag_embed(block_offset))
    squared_components = axes.square()
    # subtracting the block offset from the eigenvalues would cancel digits
    ratio = (axes * (white @ axes)).sum(-2).clamp(min=0.0)
    w = (
        axes.mT @ torch.linalg.solve_triangular(root, innovation.r.unsqueeze(-1), upper=False)
    ).squeeze(-1)
    axis_mask = (
        innovation.observed_mask.to(squared_components).unsqueeze(-2) @ squared_components
    ).squeeze(-2) > 0.5
    return PrincipalAxes(
        ratio,
        w,
        axis_mask,
        squared_components,
        group_mask.to(squared_components) @ squared_components,
    )


def axes_by_group(innovation: Innovation, groups: Sequence[int] | None) -> tuple[Tensor, Tensor]:
    """Return masks of component pairs: of one group, and of one group and observed.

    Returns two masks, both [R, k, k].
    """
    observed_mask = innovation.observed_mask
    k = observed_mask.shape[-1]
    if groups is None:
        size = diagonal_axes(innovation.nominal)
        group_mask = (size.unsqueeze(-1) - size.unsqueeze(-2)).abs() <= 1e-6 * size.unsqueeze(-1)
    else:
        require(
            len(groups) == k,
            "groups",
            f"have {k} group numbers",
            list(groups),
            "Set one number for each measured component.",
        )
        group_index = torch.tensor(list(groups), device=observed_mask.device)
        group_mask = (group_index[:, None] == group_index).expand(*observed_mask.shape, k)
    return group_mask, group_mask & observed_mask.unsqueeze(-1) & observed_mask.unsqueeze(-2)


def compute_group_root(noise: Tensor, joint_mask: Tensor) -> Tensor:
    """Compute a lower triangular noise root without correlations between groups.

    Returns root [R, k, k], with 1 on the diagonal of unobserved components. Shapes: noise
    [R, k, k], joint_mask [R, k, k].
    """
    return factor(
        torch.where(
            joint_mask,
            noise,
            torch.eye(joint_mask.shape[-1], dtype=noise.dtype, device=noise.device),
        )
    )[0]


def whitened_measurement(root: Tensor, covariance: Tensor, joint_mask: Tensor) -> Tensor:
    """Compute R^-1/2 C R^-1/2 within groups.

    Returns whitened covariance [R, k, k], 0 for unobserved components. Shapes: root [R, k, k],
    covariance [R, k, k], joint_mask [R, k, k].
    """
    half = torch.linalg.solve_triangular(
        root, torch.where(joint_mask, covariance, 0.0), upper=False
    )
    white = torch.linalg.solve_triangular(root, half.mT, upper=False)
    return _finite(0.5 * (white + white.mT))


def _finite(a: Tensor) -> Tensor:
    """Set runs with a non-finite value to 0, since eigh raises for the whole batch."""
    return torch.where(torch.isfinite(a).all(-1).all(-1)[:, None, None], a, 0.0)


def measurement_precision(innovation: Innovation) -> Tensor:
    """Return diag(R)^-1 of the model's noise [R, k], 0 where unobserved."""
    return torch.where(innovation.observed_mask, 1.0 / diagonal_axes(innovation.nominal), 0.0)


def diagonal_axes(a: Tensor) -> Tensor:
    """Return the diagonal of matrices [..., k, k] as [..., k]."""
    return a.diagonal(dim1=-2, dim2=-1)


# --------------------------------------------------------------------------------------------------
# Protocol for the use of an observation distribution that is not normal in a Gaussian filter.


class ObservationReader(Protocol):
    """Use of an observation distribution that is not normal."""

    def observe(self, model: StateSpaceModel, distribution: Any) -> tuple[Tensor, Tensor]:
        """Return location [R, P, k] and covariance [R or 1, P or 1, k, k] for the linearisation.

        Shapes: distribution [R, P].
        """

    def read_parameters(self, model: StateSpaceModel, distribution: Any) -> tuple[Tensor, ...]:
        """Return other values of the distribution at the mean, [R, ...].

        Shapes: distribution [R, 1].
        """
