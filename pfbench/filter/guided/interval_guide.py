"""Proposal of the noise of all steps between two measurements, given the later one.

Steps without a measurement are drawn from the model, so their estimates use no later measurement. At
the next measurement the noise of all these steps is moved by an affine map with a known determinant,
and the particles are propagated again from the last measurement. No step is delayed.

References:
    Doucet, Briers and Senecal 2006, Efficient block sampling strategies for sequential Monte Carlo
    methods. Reich 2013, A nonparametric ensemble transform method (maps in place of draws).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.linear_algebra import distribution_covariance, factor, jacobian
from pfbench.core.parameter_checks import require_ranges
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record, map_inputs
from pfbench.filter.belief import ParticleBelief, normalise_log_weights
from pfbench.filter.guided.guides import FACTOR_RULE, standardise_noise
from pfbench.filter.linearisation import (
    check_moments,
    find_propagation_jacobian,
    mask_covariance,
    mean_noise,
    measurement_jacobian,
)
from pfbench.filter.particle.stages import Proposal, ProposalSample, draw_noise, is_measured
from pfbench.filter.whitening import compute_half_square
from pfbench.model.base import StateSpaceModel, StaticModel

_UNSEEN = 1e-12  # squared singular value of a direction of the noise that is not measured


@dataclass(frozen=True)
class GuidedIntervalProposal(Proposal):
    """Move the noise of all steps between two measurements towards the later one.

    z are the whitened noises of an interval, drawn from the model, and M is the derivative of the
    whitened measurement in them, along the path of the weighted mean. With M = A S V' and the
    innovation r of a particle without noise,

        z' = z + V ((S A' r) / (1 + S^2) + ((1 + S^2)^-1/2 - 1) V' z).

    For normal noise and an affine model this is the distribution of the noise given the measurement. A
    fraction a of the particles keeps z. The ratio is p(z') / (a p(z') + (1 - a) q(z')), with q the
    density of the map's values. It is exact for any guide, and at most 1 / a [Hesterberg 1995].

    Attributes:
        steps: Largest number of steps that are moved. Those before keep their noise.
        prior_fraction: Probability a that a particle keeps its noise, in [0, 1).
        covariance_factor: Factor on the covariance in the measured directions. Values above 1 protect
            against an overconfident guide.

    Raises:
        ValueError: If a number is outside its range. On use, if a mean or variance of the measurement
            or the noise is not finite.
    """

    steps: int = 1000
    prior_fraction: float = 0.1
    covariance_factor: float = 1.0
    is_exact = True
    stores_path = True  # of each particle since the last measurement

    @property
    @override
    def has_bounded_weights(self) -> bool:
        return self.prior_fraction > 0.0

    def __post_init__(self) -> None:
        require_ranges(
            "proposal",
            self,
            steps="whole [1, inf) Use 1000 for the whole interval.",
            covariance_factor=FACTOR_RULE,
            prior_fraction="[0, 1) Use 0.1.",
        )

    @override
    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> ProposalSample:
        w = draw_noise(model, belief.x.shape[1], draws)
        x = model.propagate(belief.x, record.u, w)
        log_ratio = torch.zeros_like(belief.log_w)
        if isinstance(model, StaticModel):  # the initial state is measured: no noise to move
            return ProposalSample(x, log_ratio, belief.memory, w)
        check_moments(model, "noise", model.noise)
        interval = self._extended(model, belief, record, w)
        measured = is_measured(record)
        if bool(measured.any()):
            z, moved_ratio = self._move(model, belief, record, interval, draws)
            at_end = measured[:, None, None]
            x = torch.where(at_end, interval.propagate(model, z)[-1], x)
            log_ratio = torch.where(measured[:, None], moved_ratio, log_ratio)
            interval = interval._replace(length=torch.where(measured, 0, interval.length))
        return ProposalSample(x, log_ratio, pack_interval(belief.memory, interval))

    def _extended(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, w: Tensor
    ) -> NoiseInterval:
        """Return the interval with the present step, without its first one if it is too long."""
        interval = unpack_interval(belief, record)
        z = ((w - model.noise.mean) / model.noise.stddev).unsqueeze(2)
        fresh = (interval.length == 0)[:, None, None]
        start = torch.where(fresh, belief.x, interval.start)
        noise = torch.cat([interval.noise, z], 2) if interval.inputs else z
        interval = NoiseInterval(start, noise, interval.length + 1, [*interval.inputs, record.u])
        if noise.shape[2] <= self.steps:
            return interval
        first = interval.propagate(model, noise, 1)[-1]
        length = interval.length.clamp(max=self.steps)
        return NoiseInterval(first, noise[:, :, 1:], length, interval.inputs[1:])

    def _move(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        record: Record,
        interval: NoiseInterval,
        draws: RandomStream,
    ) -> tuple[Tensor, Tensor]:
        """Return moved noise [R, N, L, W] and the log ratio of prior and proposal [R, N]."""
        v, centre, scale = self._affine_map(*_linearised(model, belief, record, interval))
        z = interval.noise.flatten(2)
        before = z @ v.mT
        is_moved = draws.uniform("interval", z.shape[1], 1) >= self.prior_fraction
        after = torch.where(is_moved, centre + scale * before, before)
        preimage = (after - centre) / scale
        z = z + (after - before) @ v
        log_p = _log_prior(model, after, z)
        log_q = _log_prior(model, preimage, z + (preimage - after) @ v) - scale.log().sum(-1)
        log_q = log_q + math.log1p(-self.prior_fraction)
        if self.prior_fraction > 0.0:
            log_q = torch.logaddexp(log_p + math.log(self.prior_fraction), log_q)
        return z.view_as(interval.noise), log_p - log_q

    def _affine_map(
        self, r: Tensor, slope: Tensor, is_valid: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return directions V' [R, k, L W], and centre [R, N, k] and scale [R, 1, k] of the map in them."""
        squares, basis = torch.linalg.eigh(slope @ slope.mT)  # S^2 [R, k] and A [R, k, k]
        measured = (squares > _UNSEEN).unsqueeze(1) & is_valid
        s2 = torch.where(measured, squares.unsqueeze(1), 1.0)
        v = torch.where(measured.mT, basis.mT @ slope / s2.sqrt().mT, 0.0)
        scale = torch.where(measured, torch.sqrt(self.covariance_factor / (1.0 + s2)), 1.0)
        return v, torch.where(measured, s2.sqrt() / (1.0 + s2) * (r @ basis), 0.0), scale


def _log_prior(model: StateSpaceModel, measured: Tensor, z: Tensor) -> Tensor:
    """Return the log density of whitened noise [R, N, L W] up to a constant of the measured directions.

    Normal noise has a density of its coordinates [R, N, k] in these directions times that of the others.
    """
    if standardise_noise(model.noise):
        return -compute_half_square(measured)
    w = model.noise.mean + model.noise.stddev * z.unflatten(2, (-1, model.noise_dim))
    log_p: Tensor = model.noise.log_prob(w).sum(2)
    return log_p


def _linearised(
    model: StateSpaceModel, belief: ParticleBelief, record: Record, interval: NoiseInterval
) -> tuple[Tensor, Tensor, Tensor]:
    """Linearise the measurement in the noise of the interval, in units of the measurement noise.

    Returns innovations [R, N, k] of the particles without noise, slopes [R, k, L W] along the path of
    the mean, and whether a run is valid [R, 1, 1].
    """
    mean = model.chart.mean(interval.start, normalise_log_weights(belief.log_w)).unsqueeze(1)
    both = interval._replace(start=torch.cat([interval.start, mean], 1))
    states = both.propagate(model, torch.zeros_like(both.start[..., :1, None]))
    slope = _noise_slope(model, interval, [x[:, -1:] for x in states])
    end = states[-1]
    observation = model.observation(end, record.u)
    check_moments(model, "observation", observation)
    is_seen = ~torch.isnan(record.y)
    covariance = distribution_covariance(observation)[:, -1]
    root, ok = factor(mask_covariance(covariance, is_seen))
    h = measurement_jacobian(model, end[:, -1:], record)[:, 0] @ slope
    r = model.residual(record.y.nan_to_num().unsqueeze(1), observation.mean[:, :-1])
    r = torch.where(is_seen.unsqueeze(1), r, 0.0)
    solved = torch.linalg.solve_triangular(root, torch.cat([h, r.mT], -1), upper=False)
    ok = ok & solved.isfinite().all(-1).all(-1)
    solved = torch.where(ok[:, None, None], solved, 0.0)
    return solved[..., h.shape[-1] :].mT, solved[..., : h.shape[-1]], ok[:, None, None]


def _noise_slope(model: StateSpaceModel, interval: NoiseInterval, path: list[Tensor]) -> Tensor:
    """Return the derivative [R, d, L W] of the last state of a path [R, 1, D] in the whitened noise."""
    slope = path[0].new_zeros(1, model.chart.dimension, 0)
    for k, u in enumerate(interval.inputs):
        f, gain = _step_slopes(model, path[k], u)
        active = interval.is_active(k)
        before = torch.where(active, f @ slope, slope)
        driven = torch.where(active, gain * model.noise.stddev, 0.0)
        slope = torch.cat([before, driven], -1)
    return slope


def _step_slopes(model: StateSpaceModel, x: Tensor, u: Any) -> tuple[Tensor, Tensor]:
    """Return the derivatives of a step at states [R, 1, D] in the state [R, d, d] and the noise [R, d, W]."""
    chart, mean = model.chart, mean_noise(model, x)

    def change_state(d: Tensor) -> Tensor:
        return model.propagate(chart.add(x, d), u, mean.expand(-1, d.shape[1], -1))

    def drive(w: Tensor) -> Tensor:
        return model.propagate(x.expand(-1, w.shape[1], -1), u, mean + w)

    value, stated = model.propagate(x, u, mean), find_propagation_jacobian(model, x, u)
    gain = model.noise_gain(u)
    if gain is None:
        gain = jacobian(drive, value, model.noise_dim, chart.subtract)
    if stated is not None:
        return stated[:, 0], gain
    return jacobian(change_state, value, chart.dimension, chart.subtract), gain


# --------------------------------------------------------------------------------------------------
# Steps between two measurements: particles at the first one, and noise and inputs since.

_PREFIX = "interval."
_START, _NOISE, _LENGTH, _INPUT = (
    _PREFIX + name for name in ("start", "noise", "length", "input.")
)


class NoiseInterval(NamedTuple):
    """Steps since the latest measurement of each run. The intervals of a batch end at the same step.

    Attributes:
        start: Particles at that measurement, [R, N, D].
        noise: Whitened noise of L steps, the latest last, [R, N, L, W].
        length: Number of steps of each run, at most L, [R].
        inputs: Inputs of the L steps.
    """

    start: Tensor
    noise: Tensor
    length: Tensor
    inputs: list[Any]

    def is_active(self, k: int) -> Tensor:
        """Return the runs whose interval contains step k of L, [R, 1, 1]."""
        return (k >= len(self.inputs) - self.length)[:, None, None]

    def propagate(
        self, model: StateSpaceModel, z: Tensor, steps: int | None = None
    ) -> list[Tensor]:
        """Propagate the particles from the start.

        Returns states at the start and after each step, [R, N, D]. Those of a shorter interval are
        its start until it begins. Shapes: z [R, N, L, W].
        """
        noise, x = model.noise, self.start
        states = [x]
        for k, u in enumerate(self.inputs[:steps]):
            w = noise.mean + noise.stddev * z[:, :, min(k, z.shape[2] - 1)]
            w = w.expand(*x.shape[:2], model.noise_dim)
            x = torch.where(self.is_active(k), model.propagate(x, u, w), x)
            states.append(x)
        return states


def pack_interval(memory: dict[str, Tensor], interval: NoiseInterval) -> dict[str, Tensor]:
    """Store an interval in the memory of particles, as long as its longest run.

    Returns the memory. Without steps it holds the lengths alone.
    """
    rest = {name: a for name, a in memory.items() if not name.startswith(_PREFIX)}
    rest[_LENGTH] = interval.length.to(interval.start)[:, None]  # always: closed loops refuse it
    length = int(interval.length.max())
    if not length:
        return rest
    inputs: list[Tensor] = []
    for u in interval.inputs[-length:]:
        map_inputs(inputs.append, u)
    stored = {f"{_INPUT}{i}": a.unsqueeze(1) for i, a in enumerate(inputs)}
    stored[_START], stored[_NOISE] = interval.start, interval.noise[:, :, -length:]
    return rest | stored


def unpack_interval(belief: ParticleBelief, record: Record) -> NoiseInterval:
    """Return the interval in the memory of particles."""
    memory, x = belief.memory, belief.x
    if _START not in memory:
        length = torch.zeros(len(x), dtype=torch.long, device=x.device)
        return NoiseInterval(x, x.new_zeros(*x.shape[:2], 0, 1), length, [])
    noise, length = memory[_NOISE], memory[_LENGTH][:, 0].long()
    count = sum(name.startswith(_INPUT) for name in memory)
    rows = iter([memory[f"{_INPUT}{i}"][:, 0] for i in range(count)])
    inputs = [map_inputs(lambda _: next(rows), record.u) for _ in range(noise.shape[2])]
    return NoiseInterval(memory[_START], noise, length, inputs)
