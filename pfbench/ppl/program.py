"""Models as probabilistic programs: priors on what is not known of a model, and its marginal likelihood as one factor."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import pyro
import torch
from pyro.distributions import GaussianHMM, MultivariateNormal, Normal
from pyro.distributions.torch_distribution import TorchDistributionMixin
from torch import Tensor
from torch.distributions import biject_to

from pfbench.covariance import covariance_of
from pfbench.draws import MonteCarlo
from pfbench.filter.belief import Filter
from pfbench.filter.loop import run_filter
from pfbench.model.base import AtRest, StateSpaceModel, initial_law
from pfbench.ppl.apiece import Apiece, outside_buffers
from pfbench.record import Record

Values: TypeAlias = dict[str, Tensor]
Law: TypeAlias = Any  # one of pyro.distributions, whose stubs do not say what they have in common


class Likelihood(Protocol):
    """log p(y_1:T) of each run of a record under a model [R], with a gradient where the model has one."""

    def __call__(self, model: StateSpaceModel, record: Record) -> Tensor: ...


@dataclass(frozen=True)
class Filtered:
    """The marginal likelihood as a filter gives it: exact or approximate, as the filter is.

    Through a Gaussian filter it is differentiable from end to end. A particle filter's is an unbiased estimate with its draws
    held fixed, of which the gradient is not that of the likelihood: use it in `pmmh`, which needs none.

    Args:
        method: the filter.
        seed: of its draws, the same at every call.
    """

    method: Filter
    seed: int = 0

    def __call__(self, model: StateSpaceModel, record: Record) -> Tensor:
        return run_filter(self.method, model, record, MonteCarlo(self.seed, torch.arange(len(record.y)))).log_evidence


@dataclass(frozen=True)
class ExactHMM:
    """The marginal likelihood of a linear-Gaussian model by Pyro's GaussianHMM: exact, and parallel over time.

    On use it raises ValueError for a model that is not linear, whose noise is singular, which observes its initial state or
    needs inputs, and for a record with gaps.
    """

    def __call__(self, model: StateSpaceModel, record: Record) -> Tensor:
        return gaussian_hmm(model, record).log_prob(record.y.to(model.anchor))


@dataclass(frozen=True)
class Unknown:
    """A model of which some numbers are not known.

    Args:
        make: numbers by name -> the model: a model's class, or any function around it. It gets tensors without axes, and a
            gradient reaches them if it does no more than hand them on.
        prior: law of each number, by the same names: scalar laws of pyro.distributions.

    Raises:
        ValueError: no number; a law that is not scalar or not Pyro's; a number on which nothing in the model depends.
    """

    make: Callable[..., StateSpaceModel]
    prior: Mapping[str, Law]

    def __post_init__(self) -> None:
        if not self.prior:
            raise ValueError("prior: nothing is unknown; name at least one number and its law")
        for name, law in self.prior.items():
            if not isinstance(law, TorchDistributionMixin):
                raise ValueError(f"prior[{name}]={law}: take the law of that name from pyro.distributions")
            if law.batch_shape or law.event_shape:
                shape = tuple(law.batch_shape + law.event_shape)
                raise ValueError(f"prior[{name}]: a law of shape {shape}; give a scalar law, and several numbers several names")
        with torch.random.fork_rng():
            torch.manual_seed(0)
            one, two = ({name: law.sample() for name, law in self.prior.items()} for _ in range(2))
        first = self.model(one)
        for name in self.prior:
            other = self.model({**one, name: two[name]})
            if not outside_buffers(first, other) and all(map(torch.equal, first.buffers(), other.buffers())):
                raise ValueError(f"prior[{name}]: nothing in {type(first).__name__} changes with it; does `make` hand it on?")

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.prior)

    def model(self, values: Mapping[str, Tensor]) -> StateSpaceModel:
        """The model with these numbers []."""
        return self.make(**{name: values[name].double() for name in self.prior})

    def apiece(self, values: Mapping[str, Tensor], each: int = 1) -> StateSpaceModel:
        """A model for every one of the numbers [G], for G `each` runs: consecutive ones have a model in common.

        Raises:
            ValueError: a model that keeps a number outside its buffers.
        """
        rows = zip(*(values[name].unbind(0) for name in self.prior), strict=True)
        return Apiece([self.model(dict(zip(self.prior, row, strict=True))) for row in rows], each)

    def draw(self, count: int, seed: int) -> Values:
        """Numbers from the prior {name: [count]}."""
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            return {name: law.sample(torch.Size([count])).double() for name, law in self.prior.items()}

    def possible(self, values: Mapping[str, Tensor]) -> Tensor:
        """Which values are finite numbers within their support; a far step of a sampler may leave it by overflow."""
        inside = [torch.isfinite(values[name]) & law.support.check(values[name]) for name, law in self.prior.items()]
        return torch.stack(inside).all(0)

    def constrained(self, z: Tensor) -> tuple[Values, Tensor]:
        """Numbers from the whole real line [..., P] to their support {name: [...]}, and log prior density of z there [...]."""
        values, log_prior = {}, torch.zeros_like(z[..., 0])
        for (name, law), part in zip(self.prior.items(), z.unbind(-1), strict=True):
            to = biject_to(law.support)
            values[name] = to(part)
            log_prior = log_prior + law.log_prob(values[name]) + to.log_abs_det_jacobian(part, values[name])
        return values, log_prior

    def unconstrained(self, values: Mapping[str, Tensor]) -> Tensor:
        """The other way round, [..., P]."""
        return torch.stack([biject_to(law.support).inv(values[name]) for name, law in self.prior.items()], -1)


def program(unknown: Unknown, likelihood: Likelihood, apart: bool = False) -> Callable[[Record], Values]:
    """A Pyro program of one argument, the record: a sample site for every unknown number, and the factor `evidence`.

    Args:
        unknown: the model.
        likelihood: of its numbers; differentiable for NUTS and SVI.
        apart: every run of the record has numbers of its own, in the plate `runs`; else all have the same.
    """

    def together(record: Record) -> Values:
        values = {name: pyro.sample(name, law) for name, law in unknown.prior.items()}
        known = likelihood(unknown.model(values), record).sum() if bool(unknown.possible(values)) else torch.tensor(-torch.inf)
        pyro.factor("evidence", known)
        return values

    def each(record: Record) -> Values:
        with pyro.plate("runs", len(record.y)):
            values = {name: pyro.sample(name, law) for name, law in unknown.prior.items()}
            pyro.factor("evidence", likelihood(unknown.apiece(values), record))
        return values

    return each if apart else together


def latent_program(unknown: Unknown) -> Callable[[Record], Values]:
    """The same posterior with the path in it: standard normal sites `initial_state` [R, d] and `driving_noise` [R, T, W].

    No filter, and so no approximation, but R (d + T W) dimensions more: for short records. The path is a deterministic site
    `path` [R, T, D]; in the noise it has a density even where the model's transition is singular.

    Raises:
        ValueError: a number that has the name of a site.
    """
    taken = {"initial_state", "driving_noise", "path", "seen"} & set(unknown.prior)
    if taken:
        raise ValueError(f"latent_program: {sorted(taken)} name sites of the path; give these numbers other names")

    def run(record: Record) -> Values:
        values = {name: pyro.sample(name, law) for name, law in unknown.prior.items()}
        model = unknown.model(values)
        runs, steps = record.y.shape[:2]
        zero = model.anchor.new_zeros(())
        z = pyro.sample("initial_state", Normal(zero, 1.0).expand([runs, model.chart.dimension]).to_event(2))
        w = pyro.sample("driving_noise", Normal(zero, 1.0).expand([runs, steps, model.noise_dim]).to_event(3))
        states, log_like = unrolled(model, record, z, w)
        pyro.deterministic("path", states)
        pyro.factor("seen", log_like.sum())
        return values

    return run


def unrolled(model: StateSpaceModel, record: Record, z: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """States [R, T, D] by standard normals z [R, d] of the initial law and w [R, T, W], and log p(y_t | x_t) [R, T]."""
    start = record.to(model.anchor).start
    inputs, law = model.prepare(record.to(model.anchor)).to(model.anchor), model.noise
    x, path, log_like = begun(model, record, z), [], []
    for t in range(record.y.shape[1]):
        seen = inputs.at(t)._replace(start=start)
        stage = AtRest(model) if t == 0 and model.observes_initial else model
        x = stage.propagate(x, seen.u, law.mean + law.stddev * w[:, t].unsqueeze(1))
        path.append(x[:, 0])
        log_like.append(model.log_likelihood(seen.y, x, seen.u)[:, 0])
    return torch.stack(path, 1), torch.stack(log_like, 1)


def begun(model: StateSpaceModel, record: Record, z: Tensor) -> Tensor:
    """x_0 [R, 1, D] by standard normals z [R, d]."""
    record = record.to(model.anchor)
    law: Any = initial_law(model, len(z), record.spread)
    dense = isinstance(law, torch.distributions.MultivariateNormal)
    shift = law.mean + ((law.scale_tril @ z.unsqueeze(-1)).squeeze(-1) if dense else law.stddev * z)
    origin = model.origin.expand(len(z), -1) if record.start is None else record.start
    return model.chart.add(origin, shift).unsqueeze(1)


def simulate(model: StateSpaceModel, record: Record, seed: int) -> tuple[Record, Tensor]:
    """Measurements that the model itself would make of a record's runs and inputs, and the states behind them [R, T, D].

    Of the record it takes shape, inputs, start and spread, and what is NaN stays so: draws from the prior predictive law, if the
    model is one drawn from a prior.
    """
    draws = MonteCarlo(seed, torch.arange(len(record.y)))
    steps = record.y.shape[1]
    z = draws.normal("world.state", 1, model.chart.dimension)[:, 0]
    w = torch.cat([draws.at(t + 1).normal("world.state", 1, model.noise_dim) for t in range(steps)], 1)
    with torch.no_grad():
        states, _ = unrolled(model, record, z.to(model.anchor), w.to(model.anchor))
        inputs, values = model.prepare(record.to(model.anchor)), []
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            for t in range(steps):
                law = model.observation(states[:, t : t + 1], inputs.at(t).u)
                values.append(law.sample()[:, 0])
    y = torch.where(torch.isnan(record.y), torch.nan, torch.stack(values, 1).to(record.y))
    return record._replace(y=y), states


def gaussian_hmm(model: StateSpaceModel, record: Record) -> GaussianHMM:
    """The linear-Gaussian model, or those of `Apiece`, as one of Pyro's distributions over measurements [T, Dy].

    Raises:
        ValueError: see `ExactHMM`.
    """
    kind = type(model.model if isinstance(model, Apiece) else model).__name__
    gain = model.noise_gain(()) if model.linear else None
    if gain is None or model.noise_dim < model.chart.dimension or model.observes_initial or record.u or record.start is not None:
        raise ValueError(
            f"ExactHMM: {kind} is no linear model with full noise, no inputs and a step before the first measurement; take "
            "Filtered(GaussianFilter(Jacobian())), which is exact on any linear model"
        )
    if bool(torch.isnan(record.y).any()):
        raise ValueError("ExactHMM: the record has gaps (NaN), for which GaussianHMM has no place; take Filtered")
    runs, d = len(record.y), model.chart.dimension
    eye = torch.eye(d, dtype=gain.dtype, device=gain.device).expand(runs, -1, -1)
    first: Any = initial_law(model, runs)
    start = MultivariateNormal(first.mean, covariance_of(first))
    zero = torch.zeros_like(eye)
    carried = model.propagate(eye, (), zero)  # rows: where each state alone would go
    law: Any = model.observation(torch.cat([eye, zero[:, :1]], 1), ())
    seen, offset = law.mean[:, :-1], law.mean[:, -1]
    driven = MultivariateNormal(zero[:, 0].unsqueeze(1), (gain @ gain.mT).expand(runs, d, d).unsqueeze(1))
    errors = MultivariateNormal(offset.unsqueeze(1), covariance_of(law)[:, -1].unsqueeze(1))
    return GaussianHMM(
        start, carried.unsqueeze(1), driven, (seen - offset.unsqueeze(1)).unsqueeze(1), errors, duration=record.y.shape[1]
    )
