"""Principal axes of innovations in units of the noise, by sensor group."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.core.covariance import factor
from pfbench.filter.gaussian.innovation import Innovation


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

    Args:
        innovation: Innovation with predicted and nominal covariance.
        groups: Group number of each component. None groups components of equal nominal variance.

    Returns:
        The principal axes of all groups.
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

    Args:
        innovation: Innovation of the step.
        groups: Group number of each component. None groups components of equal nominal variance.

    Returns:
        Two masks, both [R, k, k].

    Raises:
        ValueError: If `groups` does not have one number for each component.
    """
    observed_mask = innovation.observed_mask
    k = observed_mask.shape[-1]
    if groups is None:
        size = diagonal_axes(innovation.nominal)
        group_mask = (size.unsqueeze(-1) - size.unsqueeze(-2)).abs() <= 1e-6 * size.unsqueeze(-1)
    else:
        if len(groups) != k:
            raise ValueError(
                f"groups must have {k} group numbers, got {list(groups)}. "
                "Set one number for each measured component."
            )
        group_index = torch.tensor(list(groups), device=observed_mask.device)
        group_mask = (group_index[:, None] == group_index).expand(*observed_mask.shape, k)
    return group_mask, group_mask & observed_mask.unsqueeze(-1) & observed_mask.unsqueeze(-2)


def compute_group_root(noise: Tensor, joint_mask: Tensor) -> Tensor:
    """Compute a lower triangular noise root without correlations between groups.

    Args:
        noise: Noise covariance, [R, k, k].
        joint_mask: Mask of observed component pairs of one group, [R, k, k].

    Returns:
        Root [R, k, k], with 1 on the diagonal of unobserved components.
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

    Args:
        root: Root of the noise from `compute_group_root`, [R, k, k].
        covariance: Covariance C, [R, k, k].
        joint_mask: Mask of observed component pairs of one group, [R, k, k].

    Returns:
        Whitened covariance [R, k, k], 0 for unobserved components.
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


def check_weight(name: str, value: float) -> None:
    """Check that a value lies in (0, 1].

    Args:
        name: Configuration key for the message.
        value: Value to check.

    Raises:
        ValueError: If the value is outside (0, 1].
    """
    if not 0.0 < value <= 1.0:
        raise ValueError(f"{name} must be in (0, 1], got {value}. Set a number in this range.")
