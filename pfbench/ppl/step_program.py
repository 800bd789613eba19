"""Pyro programs of a step: as a state-space model for all filters, and as a guide that proposes its noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import pyro
import torch
from pyro.poutine.messenger import Messenger
from torch import Tensor
from torch.distributions import Distribution, Independent, MultivariateNormal, Normal
from typing_extensions import override

from pfbench.core.parameter_checks import require
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief
from pfbench.filter.particle.stages import Proposal, ProposalSample
from pfbench.model.base import StateSpaceModel

STATE, MEASUREMENT, GUIDE_SITE = "x", "y", "noise"
Guide: TypeAlias = Callable[[StateSpaceModel, Tensor, Record], Any]


def value_at(name: str, distribution: Any, z: Tensor) -> Tensor:
    """Return the value of a distribution at standard normal numbers z, by its moments or its inverse distribution function."""
    base = distribution.base_dist if isinstance(distribution, Independent) else distribution
    if isinstance(base, Normal):
        return base.loc + base.scale * z
    if isinstance(base, MultivariateNormal):
        return base.loc + (base.scale_tril @ z.unsqueeze(-1)).squeeze(-1)
    try:
        value: Tensor = base.icdf(torch.special.ndtr(z.double()).clamp(1e-15, 1.0 - 1e-15))
    except NotImplementedError as error:
        raise ValueError(
            f"{name} must have a normal site or one with an inverse distribution function, got {type(base).__name__}. Use "
            "Normal, MultivariateNormal, Laplace or Cauchy."
        ) from error
    return value


class PyroModel(StateSpaceModel):
    """State-space model of two Pyro programs: the start, and a step of all particles.

    `start(**parameters)` samples the site `x`, the initial state. `step(x, u, **parameters)` takes states [R, N, D] and the inputs of a
    step. It samples the new state `x`, or computes it from other sites by `pyro.deterministic("x", ...)`, and then samples
    the measurement `y` given the new state alone. All sites have one event dimension: `.to_event(1)`. Other sites are noise. Any
    filter takes the model. It has a transition density if `x` is the only site of the noise.

    Args:
        start: Program of the initial state.
        step: Program of a step.
        inputs: Inputs u of a step as an example, if the step reads any.
        names: Components of the state; x0, x1 and so on by default.
        units: Their SI units.
        **parameters: Numbers that the programs take as keywords. They are buffers, so that each can be inferred.

    Raises:
        ValueError: If a site is missing, lacks a density or is discrete, if the sites depend on the state, or if the measurement depends on
            more than the new state.
    """

    def __init__(
        self,
        start: Callable[..., Any],
        step: Callable[..., Any],
        inputs: Any = (),
        names: tuple[str, ...] | None = None,
        units: tuple[str, ...] | None = None,
        **parameters: Any,
    ) -> None:
        super().__init__()
        for name, value in parameters.items():
            self.register_buffer(name, torch.as_tensor(value, dtype=torch.float64))
        self.register_buffer("zero", torch.zeros((), dtype=torch.float64))
        self.program_start, self.program_step, self.parameter_names = start, step, tuple(parameters)
        d = self.initial(1).event_shape[0]
        self.names = names or tuple(f"x{i}" for i in range(d))
        self.units, self.groups = units or ("",) * d, {"state": tuple(range(d))}
        some = torch.linspace(-1.0, 1.0, 6 * d, dtype=torch.float64).view(2, 3, d)
        try:
            first, second = (self._trace(x, inputs) for x in (some, -some - 1.0))
        except (RuntimeError, TypeError) as error:
            reason = str(error).partition("\n")[0].rstrip(".")
            raise ValueError(
                f"step must be a program of states [R, N, D] without branches, got an error ({reason}). Use torch.where in "
                "place of if."
            ) from error
        require(list(first.laws) == list(second.laws), "step", "have the same sites at each state", f"{list(first.laws)} and {list(second.laws)}", "Do not branch on a state.")  # fmt: skip
        require(first.state is not None and first.state.shape == some.shape, "step", f"have the site {STATE!r}, a new state of {d} components", "none or another size", f"Write pyro.sample({STATE!r}, ...) or pyro.deterministic({STATE!r}, ...).")  # fmt: skip
        require(MEASUREMENT in first.laws, "step", f"sample the site {MEASUREMENT!r}, the measurement", list(first.laws), f"Write pyro.sample({MEASUREMENT!r}, ...).")  # fmt: skip
        self.noise_dim, self.has_density = first.used, set(first.laws) == {STATE, MEASUREMENT}
        distribution: Any = self.observation(some, inputs)
        is_given = not bool(
            distribution.log_prob(torch.zeros_like(distribution.sample())).isnan().any()
        )
        require(is_given, f"step: site {MEASUREMENT!r}", f"depend on the new state {STATE!r} alone", "one that depends on the state before or on noise", f"Use the value of the site {STATE!r}.")  # fmt: skip

    def _call(self, program: Callable[..., Any], sites: _Sites, *args: Any) -> _Sites:
        """Run a program with its parameters and collect its sites."""
        with pyro.validation_enabled(False), sites:
            program(*args, **{name: getattr(self, name) for name in self.parameter_names})
        return sites

    def _trace(self, x: Tensor, u: Any, z: Tensor | None = None, new: Tensor | None = None) -> _Sites:  # fmt: skip
        """Run a step from states, with noise z (zero by default), or with given new states."""
        return self._call(self.program_step, _Sites(x.shape[:2], z, new), x, u)

    @override
    def initial(self, runs: int) -> Distribution:
        sites = self._call(self.program_start, _Sites(torch.Size([runs]), None, None))
        require(list(sites.laws) == [STATE], "start", f"sample the site {STATE!r} alone", list(sites.laws), f"Write pyro.sample({STATE!r}, ...).")  # fmt: skip
        return sites.laws[STATE]

    @override
    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        state = self._trace(x, u, w).state
        assert state is not None
        return state.expand_as(x)

    @override
    def observation(self, x: Tensor, u: Any) -> Distribution:
        nothing = torch.full_like(x, torch.nan)  # what must not be read
        return self._trace(nothing, u, nothing[..., :1], x).laws[MEASUREMENT]

    @override
    def transition(self, x: Tensor, u: Any) -> Distribution | None:
        return self._trace(x, u).laws[STATE] if self.has_density else None


@dataclass(frozen=True)
class GuideProposal(Proposal):
    """Draw the noise of a step by a guide: a program with one sample site, `noise`, of independent components or normal.

    The weights are corrected by the ratio p(w) / q(w), so that any guide that covers the noise of the model is exact. Parameters of
    the guide (`pyro.param`) are those of Pyro's store when the filter runs.

    Attributes:
        guide: Function of the model, the parents [R, N, D] and the record of the step. It samples `noise`, batch [R, N] and
            event [W]. The distribution is normal, or has an inverse distribution function.
    """

    guide: Guide
    is_exact = True

    @override
    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> ProposalSample:
        z = draws.normal("guide", belief.x.shape[1], model.noise_dim)
        with torch.no_grad(), _Sites(belief.x.shape[:2], z, None) as sites:
            self.guide(model, belief.x, record)
        remedy = f"Write pyro.sample({GUIDE_SITE!r}, ...). Other sites would have to be integrated out: make them parameters (pyro.param)."
        require(list(sites.laws) == [GUIDE_SITE], "proposal.guide", f"sample the site {GUIDE_SITE!r} and no other one", list(sites.laws) or "none", remedy)  # fmt: skip
        distribution, width = sites.laws[GUIDE_SITE], model.noise_dim
        require(distribution.event_shape == (width,), "proposal.guide", f"have a site of {width} noises (event [{width}])", list(distribution.event_shape))  # fmt: skip
        w = sites.values[GUIDE_SITE].to(belief.x.dtype)
        log_ratio = model.noise.log_prob(w) - distribution.log_prob(sites.values[GUIDE_SITE])
        return ProposalSample(model.propagate(belief.x, record.u, w), log_ratio, belief.memory, w)


class _Sites(Messenger):
    """Handler that gives the sites of a batch their values, and keeps these and their distributions in order."""

    def __init__(self, batch: torch.Size, z: Tensor | None, new: Tensor | None) -> None:
        super().__init__()
        self.batch, self.z, self.new = batch, z, new
        self.laws: dict[str, Any] = {}
        self.values: dict[str, Tensor] = {}
        self.used = 0

    @property
    def state(self) -> Tensor | None:
        """The new state."""
        return self.values.get(STATE)

    def _pyro_sample(self, message: Any) -> None:
        """Set the value of a site: of the given new state, or at the next numbers of the noise."""
        name, distribution = message["name"], message["fn"]
        is_computed = message["infer"].get("_deterministic")
        if not is_computed:
            event = tuple(distribution.event_shape)
            is_free = name not in self.laws and not message["is_observed"]
            require(len(event) == 1 and is_free, f"site {name!r}", "have one event dimension, occur once, and not be observed", list(event), "Use .to_event(1).")  # fmt: skip
            self.laws[name] = distribution = distribution.expand(self.batch)
        if name == STATE and self.new is not None:
            value = self.new
        else:
            value = message["value"] if is_computed else self._draw(name, distribution)
        self.values[name] = message["value"] = value
        message["done"], message["stop"] = True, True

    def _draw(self, name: str, distribution: Any) -> Tensor:
        """Return the value of a site at the next numbers of the noise; zeros for a measurement, which nothing may read."""
        (width,) = distribution.event_shape
        zero = torch.zeros(*self.batch, width, dtype=torch.float64)
        if name == MEASUREMENT:
            return zero
        z = zero if self.z is None else self.z[..., self.used : self.used + width]
        self.used += width
        enough = z.shape[-1] == width
        return value_at(f"site {name!r}", distribution, z if enough else zero * torch.nan)
