"""Kalman update in whitened coordinates by triangular factorisation, and the results of a step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor

from pfbench.core.chart import Chart
from pfbench.core.linear_algebra import factor, jacobian
from pfbench.core.parameter_checks import require
from pfbench.filter.gaussian.innovation import Innovation, ObservationReader
from pfbench.filter.gaussian.linearisation_rules import AffineApproximation
from pfbench.filter.whitening import LOG_2PI
from pfbench.kernels import dispatch
from pfbench.kernels.dispatch import compilable

Fit = TypeVar("Fit", Innovation, AffineApproximation)


class GaussianStep(NamedTuple):
    """All results of one step, for stages that use a Gaussian filter.

    Attributes:
        prior: Predicted mean, [R, D].
        prior_root: Square root of the predicted covariance after adaptation, [R, d, d].
        mean: Updated mean, [R, D].
        root: Square root of the updated covariance, [R, d, d], not triangular.
        innovation: Innovation after adaptation; `noise` is the measurement noise in use.
        log_likelihood: Log evidence of the step, [R]; -inf where a covariance does not have a root.
        memory: Values that adaptations use in the next step.
        trace: Diagnostics by name, [R].
    """

    prior: Tensor
    prior_root: Tensor
    mean: Tensor
    root: Tensor
    innovation: Innovation
    log_likelihood: Tensor
    memory: dict[str, Tensor]
    trace: dict[str, Tensor]


def kalman_gain_update(innovation: Innovation) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the whitened posterior.

    Returns mean [R, d], square root [R, d, d] and log evidence of the step [R], NaN without a root.
    """
    r, observed_mask, m, omega, *_ = innovation
    shift, root, distance, scales, ok = _updated(m, r, omega)
    count = observed_mask.sum(-1, dtype=r.dtype)  # int64 times a float would be float32
    log_like = -0.5 * distance - scales.abs().log().sum(-1) - 0.5 * LOG_2PI * count
    return shift, root, torch.where(ok, log_like, torch.nan)


def _separate_update(
    m: Tensor, r: Tensor, omega: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Compute the results of the operator `kalman_update` by separate operations."""
    root, ok = factor(omega)
    columns = torch.cat([m, r.unsqueeze(-1)], -1)
    white = torch.linalg.solve_triangular(root, columns, upper=False)  # Omega^-1/2 [M r]
    d = m.shape[-1]
    eye = torch.eye(d, dtype=m.dtype, device=m.device).expand(m.shape[0], -1, -1)
    information, score, distance = _least_squares(white, eye)
    back = torch.linalg.solve_triangular(information, torch.cat([score, eye], -1), upper=True)
    scales = torch.cat([a.diagonal(dim1=-2, dim2=-1) for a in (root, information)], -1)
    return back[..., 0], back[..., 1:], distance, scales, ok


_updated = compilable(_separate_update, operator=dispatch.kalman_update, use_torch_compiler=False)


def _least_squares(white: Tensor, eye: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Minimise |A x - b|^2 + |x|^2, [A b] = `white`: R of I + A' A, R'^-1 A' b, the minimum [R].

    By QR: I + A' A would lose the 1 if the prior is 1e8 times as wide as the measurement noise.
    """
    d = eye.shape[-1]
    if not (white.requires_grad and torch.is_grad_enabled()):
        upper, least = _triangle(white)
        return upper[..., :d], upper[..., d:], least
    # a gradient needs Q, and a triangle without zeros on its diagonal, where y may equal y_hat
    a, b = white[..., :d], white[..., d:]
    q, information = torch.linalg.qr(torch.cat([a, eye], -2))
    score = q[:, : a.shape[-2]].mT @ b
    diagonal = information.diagonal(dim1=-2, dim2=-1)
    sign = torch.where(diagonal < 0, -1, 1).to(information).unsqueeze(-1)
    information, score = sign * information, sign * score
    x = torch.linalg.solve_triangular(information, score, upper=True)
    return information, score, (a @ x - b).square().sum((1, 2)) + x.square().sum((1, 2))


def _triangle(white: Tensor) -> tuple[Tensor, Tensor]:
    """Reduce [A b] [R, K, D + 1] over [I 0] to a triangle [R, D, D + 1], and the rest of b^2."""
    d = white.shape[-1] - 1
    eye = torch.eye(d, d + 1, dtype=white.dtype, device=white.device)
    rows = torch.cat([white, eye.expand(white.shape[0], -1, -1)], -2)
    triangle = torch.linalg.qr(rows, mode="r")[1]
    # QR leaves row signs to rounding: draws by such a root would depend on the batch
    diagonal = triangle.diagonal(dim1=-2, dim2=-1)[:, :d]
    sign = torch.where(diagonal < 0, -1, 1).to(triangle).unsqueeze(-1)
    return sign * triangle[:, :d], triangle[:, d, d].square()


def repair_fit(fit: Fit, addend: Tensor, is_active: bool) -> tuple[Fit, Tensor]:
    """Return a fit whose Omega + addend has a root.

    Returns the fit, and the runs that were changed, bool [R]. Shapes: addend [R, k, k].
    """
    if not is_active:
        return fit, fit.omega.new_zeros(len(fit.omega), dtype=torch.bool)
    omega, repaired = remove_negative_eigenvalues(fit.omega, fit.noise, addend)
    return fit._replace(omega=omega), repaired


def remove_negative_eigenvalues(
    omega: Tensor, noise: Tensor, addend: Tensor
) -> tuple[Tensor, Tensor]:
    """Remove negative eigenvalues from Omega - noise where Omega + addend is not positive.

    Returns omega, [R, k, k], and the runs that were changed, bool [R]. Shapes: omega [R, k, k],
    noise [R, k, k], addend [R, k, k].
    """
    bad = ~factor(addend + omega)[1]
    if not bad.is_cuda and not bool(bad.any()):  # the check costs next to nothing on the CPU
        return omega, bad
    variance = omega.diagonal(dim1=-2, dim2=-1).abs() + addend.diagonal(dim1=-2, dim2=-1)
    size = torch.sqrt(variance.clamp(min=1e-300))
    scale = size.unsqueeze(-1) * size.unsqueeze(-2)
    excess = (omega - noise) / scale
    # eigh raises for all runs if the numbers of one run are not finite
    finite_mask = torch.isfinite(excess).all(-1).all(-1)[:, None, None]
    values, vectors = torch.linalg.eigh(torch.where(finite_mask, excess, 0.0))
    excess = (vectors * values.clamp(min=0.0).unsqueeze(-2)) @ vectors.mT
    return torch.where(bad[:, None, None] & finite_mask, noise + excess * scale, omega), bad


def move_root(chart: Chart, prior: Tensor, correction: Tensor, root: Tensor) -> Tensor:
    """Move the root of a covariance from the predicted to the updated mean, to first order.

    The update is linear in differences d from the predicted mean. With the correction s, the
    difference from the updated mean is ((m (+) (s + e)) (-) (m (+) s)) = J e + O(e^2) for d = s + e. On a
    group J is the right or left Jacobian of its exponential at s.

    Returns root of the covariance about the updated mean, [R, d, d]. Shapes: prior [R, D],
    correction [R, d], root [R, d, d].

    References:
        M. Mueller, M. Hehn and R. D'Andrea (2017), Covariance correction step for Kalman filtering
        with an attitude.
    """
    if chart.flat:
        return root
    centre, s = prior.unsqueeze(1), correction.unsqueeze(1)
    mean = chart.add(centre, s)
    return jacobian(lambda e: chart.add(centre, s + e), mean, s.shape[-1], chart.subtract) @ root


# --------------------------------------------------------------------------------------------------
# The measurement update of a Gaussian filter: the Kalman update, or one for other distributions.


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
        """Compute the whitened posterior."""


def check_measurement_update(update: object, adaptations: Sequence[object]) -> None:
    """Check that an update has the calls of one, and that no adaptation comes with it."""
    if update is None:
        return
    is_update = all(hasattr(update, a) for a in ("observe", "read_parameters"))
    require(
        is_update and not isinstance(update, type),
        "filter.measurement_update",
        "be an update for an observation distribution",
        update.__name__ if isinstance(update, type) else type(update).__name__,
        "Use StudentObservationUpdate() or MixtureObservationUpdate().",
    )
    require(
        not adaptations,
        "filter.noise_adaptations and filter.gain_adaptations",
        "be empty with measurement_update",
        " and ".join(type(adaptation).__name__ for adaptation in adaptations),
        "Remove them: the measurement would count twice.",
    )


def measurement_posterior(
    update: MeasurementUpdate | None, innovation: Innovation
) -> WhitenedPosterior:
    """Compute the whitened posterior."""
    if update is not None:
        return update(innovation)
    return WhitenedPosterior(*kalman_gain_update(innovation), innovation, {})
