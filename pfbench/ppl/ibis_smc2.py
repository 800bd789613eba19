"""Sequential inference of parameters: IBIS and SMC^2.

Each parameter particle has a filter of its own, which is a run of one batch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from itertools import islice
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._pytree import tree_map

from pfbench.core.parameter_checks import require, require_range
from pfbench.core.random_stream import PhiloxStream, relabel
from pfbench.core.record import Record
from pfbench.filter.belief import Filter
from pfbench.filter.exactness import check_has_evidence
from pfbench.filter.loop import FilterPass, prepare_record
from pfbench.filter.particle.stages import Systematic
from pfbench.ppl.likelihood import repeat_runs
from pfbench.ppl.mixture_sampling import choose_rows
from pfbench.ppl.parameterised_model import ParameterisedModel, Values, check_inference_call


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
    check_inference_call(
        "smc2", unknown=(unknown, ParameterisedModel), record=(record, Record), method=(method, Filter), particles=(particles, 2),
        moves=(moves, 0), seed=(seed, 0),
    )  # fmt: skip
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
        filters, _ = self._start_filters(self.z, "")
        before = self._log_likelihood(filters)
        for t, *_ in filters:
            gain = self._log_likelihood(filters) - before
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
            w = self.log_w.exp()
            ess, accepted = 1.0 / w.square().sum(), w.new_tensor(torch.nan)
            # moments before resampling, which increases their variance
            values = torch.stack(list(self.unknown.constrained(self.z)[0].values()), -1)
            mean = w @ values
            sd = (w @ (values - mean).square()).sqrt()
            if float(ess) < threshold * self.particles:
                resamplings += 1
                accepted = self._resample_move(filters, t, moves, resamplings)
            before = self._log_likelihood(filters)
            rows.append((mean, sd, log_evidence, ess, accepted))
            if tick:
                tick(t + 1)
        means, sds, *columns = (torch.stack(column) for column in zip(*rows, strict=True))
        mean_by_name, sd_by_name = (
            dict(zip(self.unknown.names, a.unbind(1), strict=True)) for a in (means, sds)
        )
        last, _ = self.unknown.constrained(self.z)
        return Smc2Result(last, self.log_w.exp(), mean_by_name, sd_by_name, *columns)

    def _resample_move(self, filters: FilterPass, t: int, moves: int, count: int) -> Tensor:
        """Resample the parameters with their filters and move them; moved ones get beliefs of new filters.

        Returns the acceptance rate.
        """
        draws = PhiloxStream(self.seed, torch.arange(1)).at_step(t + 1)
        root, slots = self._walk_factor(), torch.full((1, 1), self.particles)
        w = self.log_w.exp().unsqueeze(0)
        ancestors = Systematic()(w, slots, relabel(draws, f"online_{count}."))[0]
        rows = (ancestors.unsqueeze(-1) * self.runs + torch.arange(self.runs)).flatten()
        filters.belief = _map_belief(lambda a: a[rows], filters.belief)
        self.z, self.log_w = self.z[ancestors], self.log_w.new_full((self.particles,), -math.log(self.particles))  # fmt: skip
        log_p = self.unknown.constrained(self.z)[1] + self._log_likelihood(filters)
        accepted = torch.zeros_like(self.log_w)
        for j in range(moves):
            e = draws.normal(f"online.walk_{count}_{j}", *self.z.shape)[0]
            z = self.z + e @ root.mT
            trial, log_prior = self._start_filters(z, f"online_{count}_{j}.")
            for _ in islice(trial, t + 1):
                pass
            new_log_p = log_prior + self._log_likelihood(trial)
            u = draws.uniform(f"online.accept_{count}_{j}", self.particles, 1)[0, :, 0]
            accept = (u.log() < new_log_p - log_p) & torch.isfinite(new_log_p)
            choose = partial(choose_rows, accept.repeat_interleave(self.runs))
            filters.belief = _map_belief(choose, trial.belief, filters.belief)
            self.z = torch.where(accept.unsqueeze(-1), z, self.z)
            log_p = torch.where(accept, new_log_p, log_p)
            accepted += accept
        filters.model, _ = self.unknown.models_at(self.z, self.runs)
        return accepted.mean() / max(moves, 1)

    def _start_filters(self, z: Tensor, purpose: str) -> tuple[FilterPass, Tensor]:
        """Start the filters of parameters z with the random numbers of a purpose; return them and log p(z) [M]."""
        model, log_prior = self.unknown.models_at(z, self.runs)
        draws = relabel(PhiloxStream(self.seed, torch.arange(len(z) * self.runs)), purpose)
        return FilterPass(self.method, model, prepare_record(model, self.record), draws), log_prior

    def _log_likelihood(self, filters: FilterPass) -> Tensor:
        """Return log p(y_1:t | z) [M] from the evidence of all runs."""
        total: Tensor = filters.belief.log_evidence.view(self.particles, self.runs).sum(1)
        return total

    def _walk_factor(self) -> Tensor:
        """Return the covariance factor of the random walk."""
        w = self.log_w.exp().unsqueeze(-1)
        d = self.z - (w * self.z).sum(0)
        p = d.shape[-1]
        eye = torch.eye(p, dtype=d.dtype)
        return 2.38 / p**0.5 * torch.linalg.cholesky((w * d).mT @ d + 1e-8 * eye)


def _map_belief(function: Callable[..., Tensor], *beliefs: Any) -> Any:
    """Apply a function to the tensors of beliefs, including those in dicts."""
    fields = (
        tree_map(function, *values) if isinstance(values[0], Tensor | dict) else values[0]
        for values in zip(*beliefs, strict=True)
    )
    return type(beliefs[0])(*fields)
