"""Numbers learned as the measurements come in: iterated batch importance sampling, with particle filters SMC^2.

Every parameter particle has a filter of its own, which is a run of one batch. The time loop is here and not `run_filter`'s, since
numbers move between its steps and beliefs move with them.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pfbench.draws import Draws, MonteCarlo
from pfbench.filter.belief import Filter
from pfbench.filter.derived_draws import named
from pfbench.filter.resamplers import Systematic
from pfbench.model.base import AtRest, StateSpaceModel
from pfbench.ppl.pmmh import tiled
from pfbench.ppl.program import Unknown, Values
from pfbench.record import Record


class Online(NamedTuple):
    """What was known of the numbers after each measurement.

    Attributes:
        values: the parameter particles at the end {name: [M]}.
        weights: theirs [M].
        mean, sd: {name: [T]}.
        log_evidence: log p(y_1:t), the numbers integrated out [T].
        ess: of the parameter particles' weights [T].
        moved: share of moves that were accepted at each instant, NaN where none was made [T].
    """

    values: Values
    weights: Tensor
    mean: Values
    sd: Values
    log_evidence: Tensor
    ess: Tensor
    moved: Tensor


def online(
    unknown: Unknown, method: Filter, record: Record, particles: int, seed: int = 0, moves: int = 2, threshold: float = 0.5
) -> Online:
    """Sequential inference of the numbers, with the exact posterior at every instant as the parameter particles grow in number.

    With a Gaussian filter this is IBIS on its likelihood [Chopin 2002], with a particle filter SMC^2 [Chopin, Jacob and
    Papaspiliopoulos 2013]: weights grow by each step's evidence; where their effective number falls below the threshold,
    parameter particles are resampled together with their filters, and moved by Metropolis-Hastings steps that run a new filter
    from the start: a normal walk on the whole real line, 2.38 / sqrt(P) times the particles' own spread.

    Args:
        unknown: the model and the prior of its numbers.
        method: any filter.
        record: measurements [R, T, Dy]; all runs have the same numbers.
        particles: M, of the numbers.
        seed: of everything random.
        moves: Metropolis-Hastings steps after each resampling.
        threshold: of the effective number, as a share of M.

    Raises:
        ValueError: too few particles; a threshold outside [0, 1]; an instant at which every filter is lost.
    """
    if particles < 2 or moves < 0:
        raise ValueError(f"online: particles={particles}, moves={moves}; give at least 2 particles and no negative moves")
    if not 0.0 <= threshold <= 1.0:
        raise ValueError(f"online: threshold={threshold}; give a share of the particles, from 0 to 1")
    with torch.no_grad():
        return _Crowd(unknown, method, record, particles, seed).through(moves, threshold)


class _Crowd:
    """Parameter particles z [M, P] with weights and filters, on their way through a record."""

    def __init__(self, unknown: Unknown, method: Filter, record: Record, particles: int, seed: int) -> None:
        self.unknown, self.method, self.seed, self.size, self.each = unknown, method, seed, particles, len(record.y)
        self.record = tiled(record, particles)
        self.z = unknown.unconstrained(unknown.draw(particles, seed))
        self.log_w = torch.full((particles,), -math.log(particles), dtype=torch.float64)

    def through(self, moves: int, threshold: float) -> Online:
        log_z, rows, resampled = torch.zeros((), dtype=torch.float64), [], 0
        model, inputs, belief = self._begun(self.z, self._source(""))
        for t in range(self.record.y.shape[1]):
            before = self._evidence(belief)
            belief = self._step(model, inputs, belief, t, self._source(""))
            log_w = self.log_w + (self._evidence(belief) - before).nan_to_num(nan=-torch.inf, neginf=-torch.inf)
            gained = log_w.logsumexp(0)
            if not bool(torch.isfinite(gained)):
                raise ValueError(f"online: at step {t} every filter is lost; widen the prior, or take more particles")
            self.log_w, log_z, share = log_w - gained, log_z + gained, torch.tensor(torch.nan, dtype=torch.float64)
            ess = 1.0 / self.log_w.exp().square().sum()
            mean, sd = self._moments()  # before resampling, which only adds to their scatter
            if float(ess) < threshold * self.size:
                resampled += 1
                belief, share = self._rejuvenated(belief, t, moves, resampled)
                model = self._models(self.z)
            rows.append((mean, sd, log_z, ess, share))
        means, sds, evidence, sizes, shares = zip(*rows, strict=True)
        told = [{name: torch.stack([row[name] for row in part]) for name in self.unknown.names} for part in (means, sds)]
        stacked = (torch.stack(part) for part in (evidence, sizes, shares))
        return Online(self.unknown.constrained(self.z)[0], self.log_w.exp(), told[0], told[1], *stacked)

    def _moments(self) -> tuple[Values, Values]:
        values, w = self.unknown.constrained(self.z)[0], self.log_w.exp()
        mean = {name: (w * a).sum() for name, a in values.items()}
        return mean, {name: (w * (a - mean[name]).square()).sum().sqrt() for name, a in values.items()}

    def _rejuvenated(self, belief: Any, t: int, moves: int, count: int) -> tuple[Any, Tensor]:
        """Resampled and moved; the beliefs of what moved come from new filters that have seen y_1:t."""
        own = MonteCarlo(self.seed, torch.arange(1)).at(t + 1)
        root = self._root()
        slots = torch.full((1, 1), self.size)
        chosen = Systematic()(self.log_w.exp().unsqueeze(0), slots, named(own, f"online_{count}."))[0]
        self.z, belief = self.z[chosen], _rows(belief, self._members(chosen))
        self.log_w = torch.full_like(self.log_w, -math.log(self.size))
        log_prior = self.unknown.constrained(self.z)[1]
        log_p, hits = log_prior + self._evidence(belief), torch.zeros_like(self.log_w)
        for j in range(moves):
            e = own.normal(f"online.walk_{count}_{j}", self.size, self.z.shape[-1])[0]
            new = self.z + e @ root.mT
            fresh, log_new = self._anew(new, t, self._source(f"online_{count}_{j}."))
            u = own.uniform(f"online.accept_{count}_{j}", self.size, 1)[0, :, 0]
            hit = u.log() < log_new - log_p
            belief = _chosen(hit.repeat_interleave(self.each), fresh, belief)
            self.z, log_p = torch.where(hit.unsqueeze(-1), new, self.z), torch.where(hit, log_new, log_p)
            hits += hit
        return belief, hits.mean() / max(moves, 1)

    def _anew(self, z: Tensor, t: int, draws: Draws) -> tuple[Any, Tensor]:
        """Filters of these numbers through y_1:t, and log p(z) + log p(y_1:t | z) [M]."""
        values, log_prior = self.unknown.constrained(z)
        possible = self.unknown.possible(values) & torch.isfinite(log_prior)
        z = torch.where(possible.unsqueeze(-1), z, self.z)  # refused all the same
        model, inputs, belief = self._begun(z, draws)
        for s in range(t + 1):
            belief = self._step(model, inputs, belief, s, draws)
        log_z = self._evidence(belief)
        return belief, torch.where(possible & torch.isfinite(log_z), log_prior + log_z, -torch.inf)

    def _begun(self, z: Tensor, draws: Draws) -> tuple[StateSpaceModel, Record, Any]:
        model = self._models(z)
        begun = self.record.to(model.anchor)
        inputs = model.prepare(begun).to(model.anchor)._replace(start=begun.start, spread=begun.spread)
        return model, inputs, self.method.init(model, len(begun.y), draws.at(0), begun.start, begun.spread)

    def _step(self, model: StateSpaceModel, inputs: Record, belief: Any, t: int, draws: Draws) -> Any:
        stage = AtRest(model) if t == 0 and model.observes_initial else model
        return self.method.step(stage, belief, inputs.at(t), draws.at(t + 1))[0]

    def _models(self, z: Tensor) -> StateSpaceModel:
        return self.unknown.apiece(self.unknown.constrained(z)[0], self.each)

    def _evidence(self, belief: Any) -> Tensor:
        """log p(y so far | z) [M]."""
        total: Tensor = belief.log_z.view(self.size, self.each).sum(1)
        return total

    def _source(self, name: str) -> Draws:
        return named(MonteCarlo(self.seed, torch.arange(self.size * self.each)), name)

    def _members(self, chosen: Tensor) -> Tensor:
        return (chosen.unsqueeze(-1) * self.each + torch.arange(self.each)).flatten()

    def _root(self) -> Tensor:
        """Of the walk's covariance, by the weighted particles."""
        w = self.log_w.exp().unsqueeze(-1)
        d = self.z - (w * self.z).sum(0)
        p = d.shape[-1]
        return 2.38 / p**0.5 * torch.linalg.cholesky((w * d).mT @ d + 1e-8 * torch.eye(p, dtype=d.dtype))


def _rows(belief: Any, rows: Tensor) -> Any:
    """Some runs of a belief, in this order."""
    return _each_part(lambda a: a[rows], belief)


def _chosen(hit: Tensor, new: Any, old: Any) -> Any:
    """Run by run the new belief where hit [R], else the old."""

    def one(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(hit.view(-1, *[1] * (a.dim() - 1)), a, b)

    return _each_part(one, new, old)


def _each_part(f: Any, *beliefs: Any) -> Any:
    """A belief made of others' tensors, those in its dicts too; what is neither (the record of past steps) stays."""
    parts = []
    for values in zip(*beliefs, strict=True):
        if isinstance(values[0], Tensor):
            parts.append(f(*values))
        elif isinstance(values[0], dict):
            parts.append({name: f(*(value[name] for value in values)) for name in values[0]})
        else:
            parts.append(values[0])
    return type(beliefs[0])(*parts)
