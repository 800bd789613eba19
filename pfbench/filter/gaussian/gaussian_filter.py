"""Gaussian filter: prediction and update of Kalman, extended, unscented and cubature filters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pfbench.core.chart import Chart
from pfbench.core.linear_algebra import distribution_covariance, factor
from pfbench.core.parameter_checks import require, require_range
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import GaussianBelief, StepInfo
from pfbench.filter.gaussian.innovation import (
    GainAdaptation,
    Innovation,
    NoiseAdaptation,
    compute_innovation,
    linearise_about_posterior,
)
from pfbench.filter.gaussian.kalman_update import (
    GaussianStep,
    MeasurementUpdate,
    WhitenedPosterior,
    check_measurement_update,
    measurement_posterior,
    move_root,
    repair_fit,
)
from pfbench.filter.gaussian.linearisation_rules import (
    AffineApproximation,
    DifferenceSpace,
    LinearisationRule,
    SigmaPointLinearisation,
    SigmaPoints,
    UnscentedPoints,
)
from pfbench.filter.linearisation import (
    check_moments,
    compute_additive_gain,
    find_propagation_jacobian,
)
from pfbench.model.base import StateSpaceModel, initial_law


@dataclass(frozen=True)
class GaussianFilter:
    """Kalman filter by statistical linearisation.

    The update is P+ = L (I + M' Omega^-1 M)^-1 L'. The eigenvalues of the middle factor are at
    least 1, so P+ is positive for any prior, however ill-conditioned. A covariance without a square
    root marks the run as lost.

    Distributions need finite means and variances. A model without `noise_gain` is probed for
    additive noise, see `compute_additive_gain`.

    Attributes:
        linearisation: TaylorLinearisation (EKF), or SigmaPointLinearisation (UKF and CKF).
        noise_adaptations: Noise adaptations in order: fading, constrained noise.
        gain_adaptations: Gain adaptations in order, applied last: adaptive factor, ratio bound.
        iterations: Number of updates, fixed for all runs [ours]. Each linearises about the updated
            distribution. With the Jacobian this is the iterated EKF [Bell and Cathey 1993], with
            points iterated posterior linearisation [Garcia-Fernandez et al. 2015].
        repair_covariance: Whether to remove negative eigenvalues from the linearisation error
            [ours], which negative weights can cause. The trace counts `repairs`. Otherwise the run
            is lost.
        reset_covariance: Whether to move the covariance to the updated mean, see `move_root`. It
            matters on curved charts for corrections of about a radian, as of a wrong heading.
        measurement_update: Update by a distribution that is not normal. None uses its moments.

    Raises:
        ValueError: If iterations is below 1, or above 1 with adaptations or gains, or if two parts
            use the innovation. On use, if a mean or variance is not finite.
    """

    linearisation: LinearisationRule
    noise_adaptations: Sequence[NoiseAdaptation] = ()
    gain_adaptations: Sequence[GainAdaptation] = ()
    iterations: int = 1
    repair_covariance: bool = False
    reset_covariance: bool = False
    measurement_update: MeasurementUpdate | None = None
    is_exact = False  # it is exact on linear-Gaussian models only

    @property
    def plain(self) -> bool:
        """True for the Kalman filter on linear models: no adaptation, gain or other update."""
        return not self._adaptations and self.measurement_update is None

    @property
    def _adaptations(self) -> tuple[NoiseAdaptation | GainAdaptation, ...]:
        return (*self.noise_adaptations, *self.gain_adaptations)

    def __post_init__(self) -> None:
        check_adaptations(self.noise_adaptations, self.gain_adaptations, self.iterations)
        check_measurement_update(self.measurement_update, self._adaptations)

    @property
    def has_evidence(self) -> bool:
        """True if the log evidence is a log density of the measurements."""
        update = () if self.measurement_update is None else (self.measurement_update,)
        return all(map(states_evidence, (*self._adaptations, *update)))

    def init(
        self,
        model: StateSpaceModel,
        runs: int,
        draws: RandomStream,
        start: Tensor | None = None,
        spread: Tensor | None = None,
    ) -> GaussianBelief:
        """Compute the belief at step 0, the moments of the initial distribution.

        Args:
            model: State-space model.
            runs: Number of runs R.
            draws: Random stream, not used.
            start: States about which the initial distribution is placed, [R, D].
            spread: Cholesky factors of the initial covariances, [R, d, d].

        Returns:
            The belief.

        Raises:
            ValueError: If a mean or variance is not finite, or if sigma points reach too far in angles.
        """
        initial: Any = initial_law(model, runs, spread)
        for name, distribution in (("initial", initial), ("noise", model.noise)):
            check_moments(model, name, distribution)
        origin = model.origin.expand(runs, -1) if start is None else start
        mean, covariance = model.chart.add(origin, initial.mean), distribution_covariance(initial)
        check_point_reach(self.linearisation, model.chart, covariance)
        log_z = torch.zeros(runs, dtype=torch.float64, device=mean.device)
        return GaussianBelief(mean, covariance, log_z)

    def step(
        self, model: StateSpaceModel, belief: GaussianBelief, record: Record, draws: RandomStream
    ) -> tuple[GaussianBelief, StepInfo]:
        """Compute the belief after a measurement.

        Args:
            model: State-space model of the step.
            belief: Belief at t-1.
            record: Measurement and inputs of step t.
            draws: Random stream, not used.

        Returns:
            Belief at t and diagnostics.
        """
        new = self.advance(model, belief, record)
        covariance = new.root @ new.root.mT
        variance = covariance.diagonal(dim1=-2, dim2=-1)
        info = StepInfo(new.mean, variance, lambda: covariance, new.trace, nis=new.innovation.nis)
        log_z = belief.log_evidence + new.log_likelihood
        return GaussianBelief(new.mean, covariance, log_z, new.memory), info

    def advance(
        self, model: StateSpaceModel, belief: GaussianBelief, record: Record
    ) -> GaussianStep:
        """Compute a step with all intermediate results.

        Args:
            model: State-space model of the step.
            belief: Belief at t-1.
            record: Measurement and inputs of step t.

        Returns:
            The results.
        """
        predicted, has_root = self.predict(model, belief, record.u)
        for adaptation in self.noise_adaptations:
            predicted = adaptation.predict_scale(predicted, belief)
        prior, covariance = predicted.y, predicted.m @ predicted.m.mT
        predicted, repaired = repair_fit(predicted, covariance, self.repair_covariance)
        root, is_positive = factor(covariance + predicted.omega)

        def state_at(xi: Tensor) -> Tensor:
            return model.chart.add(prior.unsqueeze(1), xi @ root.mT)

        innovation = compute_innovation(
            self.linearisation, model, state_at, prior, record, root, self.measurement_update
        )._replace(root=root)
        innovation, memory, trace = adapt_innovation(
            self.noise_adaptations, self.gain_adaptations, innovation, belief
        )
        posterior, repaired_update = self._update(model, prior, innovation, record)
        shift, updated, log_like, innovation, update_trace = posterior
        trace |= update_trace
        if self.repair_covariance:
            trace["repairs"] = repaired.to(root) + repaired_update.to(root)
        root = innovation.root
        correction, updated = (root @ shift.unsqueeze(-1)).squeeze(-1), root @ updated
        mean = model.chart.add(prior, correction)
        if self.reset_covariance:
            updated = move_root(model.chart, prior, correction, updated)
        log_like = torch.where(has_root & is_positive & log_like.isfinite(), log_like, -torch.inf)
        return GaussianStep(prior, root, mean, updated, innovation, log_like, memory, trace)

    def predict(
        self, model: StateSpaceModel, belief: GaussianBelief, u: Any
    ) -> tuple[AffineApproximation, Tensor]:
        """Linearise the propagation in coordinates whitened by the belief's root.

        Args:
            model: State-space model of the step.
            belief: Belief at t-1.
            u: Inputs of the step.

        Returns:
            Linearised prediction, and whether the covariance has a root, bool [R].
        """
        chart, d, noise = model.chart, model.chart.dimension, model.noise
        root, ok = factor(belief.covariance)
        gain = compute_additive_gain(model, belief.mean, root, u)
        inner = 0 if gain is not None else model.noise_dim

        def propagate_points(xi: Tensor) -> tuple[Tensor, Tensor]:
            x = chart.add(belief.mean.unsqueeze(1), xi[..., :d] @ root.mT)
            if gain is None:
                w = noise.mean + noise.stddev * xi[..., d:]
                return model.propagate(x, u, w), xi.new_zeros(1, 1, d, d)
            noise_root = gain * noise.stddev
            x = model.propagate(x, u, noise.mean.expand(*x.shape[:2], -1))
            return x, (noise_root @ noise_root.mT).unsqueeze(1)

        def slope() -> Tensor | None:
            if gain is None:
                return None
            f = find_propagation_jacobian(model, belief.mean.unsqueeze(1), u)
            return None if f is None else f[:, 0] @ root

        space = DifferenceSpace(chart.subtract, chart.mean, slope)
        return self.linearisation(propagate_points, belief.mean, d + inner, space), ok

    def _update(
        self, model: StateSpaceModel, mean: Tensor, innovation: Innovation, record: Record
    ) -> tuple[WhitenedPosterior, Tensor]:
        """Return the posterior of xi by the last of the updates, and the repaired runs [R]."""
        rule, update, root = self.linearisation, self.measurement_update, innovation.root
        zero, is_active = torch.zeros_like(innovation.omega), self.repair_covariance
        # Omega alone must be positive: the update takes its root, not that of M M' + Omega
        innovation, repaired = repair_fit(innovation, zero, is_active)
        posterior = measurement_posterior(update, innovation)
        for _ in range(self.iterations - 1):
            shift, updated, *_ = posterior
            new = linearise_about_posterior(rule, model, mean, root, shift, updated, record, update)
            innovation, repaired_again = repair_fit(new, zero, is_active)
            posterior = measurement_posterior(update, innovation)
            repaired = repaired | repaired_again
        return posterior, repaired


# --------------------------------------------------------------------------------------------------
# The adaptations of a Gaussian filter, applied in order.


def adapt_innovation(
    noise_adaptations: Sequence[NoiseAdaptation],
    gain_adaptations: Sequence[GainAdaptation],
    innovation: Innovation,
    belief: GaussianBelief,
) -> tuple[Innovation, dict[str, Tensor], dict[str, Tensor]]:
    """Apply all adaptations to an innovation.

    Returns the innovation, the values for the next step, and the diagnostics [R] of this step.
    """
    memory: dict[str, Tensor] = {}
    for adaptation in noise_adaptations:
        innovation, carried = adaptation.noise_adapt(innovation, belief)
        memory |= carried
    trace = {
        name: value if value.dim() == 1 else value.amax(1)
        for name, value in memory.items()
        if value.dim() <= 2
    }
    if gain_adaptations:
        widening = torch.ones_like(belief.mean[:, 0])
        for gain in gain_adaptations:
            widening = gain(innovation, widening)
        innovation, trace["widening"] = innovation.inflate(widening), widening
    return innovation, memory, trace


def states_evidence(adaptation: object) -> bool:
    """Return whether an adaptation states that it does not use the measurement of the step."""
    return bool(getattr(adaptation, "has_evidence", False))


def check_adaptations(
    noise_adaptations: Sequence[NoiseAdaptation],
    gain_adaptations: Sequence[GainAdaptation],
    iterations: int,
) -> None:
    """Check that adaptations do not judge one innovation twice."""
    require_range("filter.iterations", iterations, "whole [1, inf) Use 1 for a single update.")
    require(
        not iterations > 1 or (not noise_adaptations and (not gain_adaptations)),
        "filter.iterations",
        "be 1 with noise_adaptations or gain_adaptations",
        iterations,
        "Set filter.iterations=1.",
    )
    judges = [type(a).__name__ for a in noise_adaptations if not states_evidence(a)]
    require(
        len(judges) <= 1,
        "filter.noise_adaptations",
        "contain at most one that uses the measurement of the step",
        " and ".join(judges),
        "Remove all but one: the same innovation would count twice.",
    )


# --------------------------------------------------------------------------------------------------
# Check of sigma points whose angles are so large that a rule sees another distribution.


def check_point_reach(rule: LinearisationRule, chart: Chart, covariance: Tensor) -> None:
    """Check the largest angle between the mean and a point of the initial distribution.

    A point beyond half a turn has the shorter angle on the other side. Closer points fail too, because
    the first measurements move the mean: docs/methods/invariant.md.

    Shapes: covariance [R, d, d].
    """
    if not isinstance(rule, SigmaPointLinearisation) or rule.largest_angle is None or chart.flat:
        return
    limit = rule.largest_angle
    reach = _largest_angle(rule.points, chart, covariance)
    if reach > limit:
        unscented = rule.points if isinstance(rule.points, UnscentedPoints) else UnscentedPoints()
        spread = unscented.alpha * limit / _largest_angle(unscented, chart, covariance)
        raise ValueError(
            f"filter.linearisation.points must lie within {math.degrees(limit):.0f} degrees of the "
            f"mean in angles and rotations, got {math.degrees(reach):.0f} degrees for the initial "
            f"distribution. Use filter=ukf filter.linearisation.points.alpha={_round_down(spread)}. "
            "To compare rules at this uncertainty, add +filter.linearisation.largest_angle=null."
        )


def _largest_angle(points: SigmaPoints, chart: Chart, covariance: Tensor) -> float:
    """Return the largest angle of a point from the mean over all blocks and runs, rad."""
    xi = points(chart.dimension)[0].to(covariance)
    angles = chart.rotation_angles(xi @ factor(covariance)[0].mT)
    return float(angles.nan_to_num().amax()) if angles.numel() else 0.0


def _round_down(value: float) -> float:
    """Round down to one significant digit."""
    digit = 10.0 ** math.floor(math.log10(value))
    return float(f"{math.floor(value / digit) * digit:.1g}")
