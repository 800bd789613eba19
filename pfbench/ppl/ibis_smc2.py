"""Sequential inference of parameters: IBIS and SMC^2.

Each parameter particle has a filter of its own, which is a run of one batch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import islice
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pfbench.core.parameter_checks import require, require_range
from pfbench.core.random_stream import PhiloxStream, RandomStream, relabel
from pfbench.core.record import Record
from pfbench.filter.belief import Filter
from pfbench.filter.exactness import check_has_evidence
from pfbench.filter.loop import FilterPass, prepare_record
from pfbench.filter.particle.stages import Systematic
from pfbench.model.base import StateSpaceModel
from pfbench.ppl.likelihood import repeat_runs
from pfbench.ppl.parameterised_model import (
    ParameterisedModel,
    Values,
    check_counts,
    check_kinds,
)


class Smc2Result(NamedTuple):
    """Result of sequential parameter inference.

    Attributes:
        values: Parameter particles after the last step, {name: [M]}.
        weights: Their weights, [M].
        mean: Posterior mean after each step, {name: [T]}.
        sd: Posterior standard deviation after each step, {name: [T]}.
        log_evidence: log p(y_1:t) with the parameters integrated out, [T].
        ess: Effective sample size of the parameter particles, [T].
        acceptance: Acceptance rate of the moves, [T]. NaN for a step without moves.
    """

    values: Values
    weights: Tensor
    mean: Values
    sd: Values
    log_evidence: Tensor
    ess: Tensor
    acceptance: Tensor


def smc2(
    unknown: ParameterisedModel,
    method: Filter,
    record: Record,
    particles: int,
    seed: int = 0,
    moves: int = 2,
    threshold: float = 0.5,
    tick: Callable[[int], object] | None = None,
) -> Smc2Result:
    """Infer the parameters of a model after each measurement.

    With a Gaussian filter this is IBIS on its likelihood, with a particle filter SMC^2. It
    converges to the exact posterior of each step as the number of parameter particles grows.
    Weights are multiplied by the evidence of each step. If the effective sample size falls below
    the threshold, parameter particles are resampled with their filters. Metropolis-Hastings steps
    then move them, each with a new filter from the first step. The proposal is a Gaussian random
    walk on the unconstrained parameters, with 2.38 / sqrt(P) times the standard deviation of the
    particles.

    Args:
        unknown: Model and prior of its P parameters.
        method: Any filter.
        record: Measurements [R, T, Dy] and inputs. All runs share the parameters.
        particles: Number M of parameter particles.
        seed: Seed of all random numbers.
        moves: Number of Metropolis-Hastings steps after each resampling.
        threshold: Effective sample size below which particles are resampled, as a fraction of M.
        tick: Function that is called after each measurement with its number, for a progress bar.

    Returns:
        Parameter particles and moments of the posterior after each step.

    Raises:
        ValueError: If particles, moves or threshold are out of range, or if all filters are lost.

    References:
        N. Chopin (2002), A sequential particle filter method for static models.
        N. Chopin, P. Jacob and O. Papaspiliopoulos (2013), SMC^2.
    """
    check_kinds("smc2", {"unknown": (unknown, ParameterisedModel), "record": (record, Record)})
    check_kinds("smc2", {"method": (method, Filter)})
    check_counts("smc2", {"particles": (particles, 2), "moves": (moves, 0), "seed": (seed, 0)})
    require_range("smc2.threshold", threshold, "[0, 1]")
    with torch.no_grad():
        sampler = _ParameterSampler(unknown, method, record, particles, seed)
        return sampler.run(moves, threshold, tick)


class _ParameterSampler:
    """Parameter particles z [M, P] with weights and filters."""

    def __init__(
        self, unknown: ParameterisedModel, method: Filter, record: Record, particles: int, seed: int
    ) -> None:
        check_has_evidence(method, "smc2")
        self.unknown, self.method, self.seed = unknown, method, seed
        self.particles, self.runs = particles, len(record.y)
        self.record = repeat_runs(record, particles)
        self.z = unknown.unconstrained(unknown.sample(particles, seed))
        self.log_w = torch.full((particles,), -math.log(particles), dtype=torch.float64)

    def run(self, moves: int, threshold: float, tick: Callable[[int], object] | None) -> Smc2Result:
        """Process the record."""
        log_evidence, rows, resamplings = torch.zeros((), dtype=torch.float64), [], 0
        filters = self._start_filters(self._models(), self._stream(""))
        before = self._log_likelihood(filters.belief)
        for t, *_ in filters:
            gain = self._log_likelihood(filters.belief) - before
            log_w = self.log_w + gain.nan_to_num(nan=-torch.inf, neginf=-torch.inf)
            total = log_w.logsumexp(0)
            require(
                bool(torch.isfinite(total)),
                "smc2.method",
                f"be valid for one particle at step {t}",
                "none",
                "Use a wider prior or more particles.",
            )
            self.log_w, log_evidence = log_w - total, log_evidence + total
            ess = 1.0 / self.log_w.exp().square().sum()
            mean, sd = self._moments()  # before resampling, which increases their variance
            accepted = torch.tensor(torch.nan, dtype=torch.float64)
            if float(ess) < threshold * self.particles:
                resamplings += 1
                filters.belief, accepted = self._resample_move(
                    filters.belief, t, moves, resamplings
                )
                filters.model = self._models()
            before = self._log_likelihood(filters.belief)
            rows.append((mean, sd, log_evidence, ess, accepted))
            if tick:
                tick(t + 1)
        means, sds, *columns = zip(*rows, strict=True)
        mean, sd = (
            {name: torch.stack([row[name] for row in moment]) for name in self.unknown.names}
            for moment in (means, sds)
        )
        values = self.unknown.constrained(self.z)[0]
        stacked = [torch.stack(column) for column in columns]
        return Smc2Result(values, self.log_w.exp(), mean, sd, *stacked)

    def _moments(self) -> tuple[Values, Values]:
        """Return the weighted means and standard deviations of the parameters."""
        values, w = self.unknown.constrained(self.z)[0], self.log_w.exp()
        mean = {name: (w * a).sum() for name, a in values.items()}
        sd = {name: (w * (a - mean[name]).square()).sum().sqrt() for name, a in values.items()}
        return mean, sd

    def _resample_move(self, belief: Any, t: int, moves: int, count: int) -> tuple[Any, Tensor]:
        """Resample and move the parameters; moved particles get beliefs of new filters."""
        draws = PhiloxStream(self.seed, torch.arange(1)).at_step(t + 1)
        root = self._walk_factor()
        belief = self._resample(belief, relabel(draws, f"online_{count}."))
        log_p = self.unknown.constrained(self.z)[1] + self._log_likelihood(belief)
        accepted = torch.zeros_like(self.log_w)
        for j in range(moves):
            e = draws.normal(f"online.walk_{count}_{j}", self.particles, self.z.shape[-1])[0]
            z = self.z + e @ root.mT
            new_belief, new_log_p = self._run_filters(z, t, self._stream(f"online_{count}_{j}."))
            u = draws.uniform(f"online.accept_{count}_{j}", self.particles, 1)[0, :, 0]
            accept = u.log() < new_log_p - log_p
            belief = _select_by_run(accept.repeat_interleave(self.runs), new_belief, belief)
            self.z = torch.where(accept.unsqueeze(-1), z, self.z)
            log_p = torch.where(accept, new_log_p, log_p)
            accepted += accept
        return belief, accepted.mean() / max(moves, 1)

    def _resample(self, belief: Any, draws: RandomStream) -> Any:
        """Resample the parameters with their filters."""
        slots = torch.full((1, 1), self.particles)
        ancestors = Systematic()(self.log_w.exp().unsqueeze(0), slots, draws)[0]
        self.z = self.z[ancestors]
        self.log_w = torch.full_like(self.log_w, -math.log(self.particles))
        rows = (ancestors.unsqueeze(-1) * self.runs + torch.arange(self.runs)).flatten()
        return _map_belief(lambda a: a[rows], belief)

    def _run_filters(self, z: Tensor, t: int, draws: RandomStream) -> tuple[Any, Tensor]:
        """Return beliefs given y_1:t, and log p(z) + log p(y_1:t | z) [M]."""
        values, log_prior = self.unknown.constrained(z)
        model, valid = self.unknown.models_per_run(values, self.runs)
        filters = self._start_filters(model, draws)
        for _ in islice(filters, t + 1):
            pass
        log_likelihood = self._log_likelihood(filters.belief)
        valid = valid & torch.isfinite(log_prior) & torch.isfinite(log_likelihood)
        return filters.belief, torch.where(valid, log_prior + log_likelihood, -torch.inf)

    def _start_filters(self, model: StateSpaceModel, draws: RandomStream) -> FilterPass:
        """Start the filters of a batch of models."""
        return FilterPass(self.method, model, prepare_record(model, self.record), draws)

    def _models(self) -> StateSpaceModel:
        """Return a batch of models, one for each run of each parameter particle."""
        return self.unknown.models_per_run(self.unknown.constrained(self.z)[0], self.runs)[0]

    def _log_likelihood(self, belief: Any) -> Tensor:
        """Return log p(y_1:t | z) [M] from the evidence of all runs."""
        total: Tensor = belief.log_evidence.view(self.particles, self.runs).sum(1)
        return total

    def _stream(self, name: str) -> RandomStream:
        """Return the random stream of the filters under a name."""
        return relabel(PhiloxStream(self.seed, torch.arange(self.particles * self.runs)), name)

    def _walk_factor(self) -> Tensor:
        """Return the covariance factor of the random walk."""
        w = self.log_w.exp().unsqueeze(-1)
        d = self.z - (w * self.z).sum(0)
        p = d.shape[-1]
        eye = torch.eye(p, dtype=d.dtype)
        return 2.38 / p**0.5 * torch.linalg.cholesky((w * d).mT @ d + 1e-8 * eye)


def _select_by_run(mask: Tensor, new: Any, old: Any) -> Any:
    """Return the new belief for runs in the mask [R], else the old."""

    def select(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(mask.view(-1, *[1] * (a.dim() - 1)), a, b)

    return _map_belief(select, new, old)


def _map_belief(function: Callable[..., Tensor], *beliefs: Any) -> Any:
    """Apply a function to the tensors of beliefs, including those in dicts."""
    fields: list[Any] = []
    for values in zip(*beliefs, strict=True):
        if isinstance(values[0], Tensor):
            fields.append(function(*values))
        elif isinstance(values[0], dict):
            names = values[0]
            fields.append({name: function(*(value[name] for value in values)) for name in names})
        else:
            fields.append(values[0])
    return type(beliefs[0])(*fields)
