"""The one abstract class of the house: a model is a map driven by explicit noise and a law of what is seen."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any

import torch
from pyro.distributions import Independent, MultivariateNormal, Normal
from torch import Tensor, nn
from torch.distributions import Distribution

from pfbench import native
from pfbench.chart import Chart, Euclidean
from pfbench.covariance import gaussian_log_density
from pfbench.fusion import fusible
from pfbench.record import Record

HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


class Standard(Normal):
    """Independent standard normal numbers, known by this type, so that nobody need multiply them by one and add zero."""


class StateSpaceModel(nn.Module, ABC):
    """x_t = propagate(x_{t-1}, u_t, w_t), y_t ~ observation(x_t, u_t).

    Axes everywhere: R runs, N particles (or sigma points, or tangents), D state. By convention the first measurement is of the
    state after the first propagation; a model that measures its initial state sets `observes_initial`, and the evidence
    changes with it.

    Attributes:
        names, units: of the d components of a difference of states, in which errors and spreads are told (SI, rad).
        groups: components of a difference that a report shows together, by name.
        noise_dim: W, the dimension of the driving noise.
        observes_initial: the first measurement is of x_0, nothing is propagated before it.
        linear: the map is linear and both laws are normal, so that every Gaussian filter is the Kalman filter and exact.
        linear_given: components of a difference in which, with the noise, map and measurement are linear given all others, and
            both laws normal: a Kalman filter of each particle can have them. A linear model need not say so.
        choices: readings of ours that a report must mention.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    groups: dict[str, tuple[int, ...]]
    noise_dim: int
    observes_initial: bool = False
    linear: bool = False
    linear_given: tuple[int, ...] = ()
    choices: tuple[str, ...] = ()

    @property
    def chart(self) -> Chart:
        """How states add, subtract and average; plain numbers unless the model says otherwise."""
        return Chart((Euclidean(len(self.names)),))

    @property
    def origin(self) -> Tensor:
        """The state [D] about which `initial` is laid out in the chart; zero unless the model says otherwise."""
        return self.anchor.new_zeros(self.chart.size)

    @property
    def anchor(self) -> Tensor:
        """Some tensor of the model: tells dtype and device."""
        return next(iter(self.buffers()))

    @property
    def noise(self) -> Distribution:
        """Law of w, event [W], components independent; standard normal unless the model says otherwise."""
        zero = self.anchor.new_zeros(self.noise_dim)
        return Standard(zero, torch.ones_like(zero), validate_args=False).to_event(1)

    @abstractmethod
    def initial(self, runs: int) -> Distribution:
        """Law of x_0 in the chart about `origin`: batch [R], event [d]."""

    @abstractmethod
    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        """One step, deterministic: [R, N, D], inputs of the step, [R, N, W] -> [R, N, D]."""

    @abstractmethod
    def observation(self, x: Tensor, u: Any) -> Distribution:
        """Law of y given x: batch [R, N], event [Dy]; Independent over components, or a MultivariateNormal."""

    def transition(self, x: Tensor, u: Any) -> Distribution | None:
        """Law of x_t given x_{t-1}, batch [R, N], event [D]; None where it is singular, and never faked."""
        return None

    def noise_gain(self, u: Any) -> Tensor | None:
        """L [R or 1, d, W] where the noise enters as x (+) L w in the chart; None where it enters otherwise."""
        return None

    def residual(self, y: Tensor, y_hat: Tensor) -> Tensor:
        """y - y_hat, the short way round where a measurement is an angle."""
        return y - y_hat

    def prepare(self, record: Record) -> Record:
        """What can be computed once for all steps and filters' stages: a record whose inputs the model likes better."""
        return record

    def assemble(self, truth: dict[str, Tensor]) -> Tensor:
        """The true state of an Episode's groups, NaN where a group has no truth: {group: [R, T, k]} -> [R, T, D].

        Here the groups are laid out as the components of a difference; a model whose states are not differences (a
        quaternion, say) lays them out itself.

        Raises:
            ValueError: no group of this model has a truth.
        """
        known = [name for name in self.groups if name in truth]
        if not known:
            raise ValueError(f"truth has {sorted(truth)}, the model's groups are {sorted(self.groups)}: none has a truth")
        some = truth[known[0]]
        state = some.new_full((*some.shape[:-1], self.chart.size), torch.nan)
        for name in known:
            state[..., list(self.groups[name])] = truth[name]
        return state

    def error(self, mean: Tensor, truth: Tensor) -> Tensor:
        """Error of an estimate as a report shows it, in the chart: [..., D], [..., D] -> [..., d]."""
        return self.chart.subtract(mean, truth)

    def log_likelihood(self, y: Tensor, x: Tensor, u: Any) -> Tensor:
        """log p(y | x) over the components that were seen: y [R, Dy], x [R, N, D] -> [R, N].

        Raises:
            TypeError: the observation law is neither Independent nor MultivariateNormal.
        """
        law = self.observation(x, u)
        seen = ~torch.isnan(y).unsqueeze(1)  # [R, 1, Dy]
        if isinstance(law, torch.distributions.Independent) and isinstance(law.base_dist, torch.distributions.Normal):
            sd = law.base_dist.scale
            if sd.stride(1) == 0:  # one scale for all particles, which torch has expanded
                sd = sd[:, :1] if sd.stride(0) else sd[:1, :1]
            y, y_hat = y.nan_to_num().unsqueeze(1), law.base_dist.loc
            if type(self).residual is not StateSpaceModel.residual:  # a plain difference is taken within the fused loop
                y, y_hat = torch.zeros_like(y), -self.residual(y, y_hat)
            return _log_normal(y, y_hat, sd, seen)
        y_hat = law.mean
        r = torch.where(seen, self.residual(y.unsqueeze(1), y_hat), 0.0)
        if isinstance(law, torch.distributions.Independent):
            return (law.base_dist.log_prob(y_hat + r) * seen).sum(-1)
        if isinstance(law, torch.distributions.MultivariateNormal):
            return gaussian_log_density(r, law.covariance_matrix, seen)
        name = f"{type(self).__name__}.observation"
        raise TypeError(f"{name} returned {type(law).__name__}: return Independent or MultivariateNormal")


class Wrapped(StateSpaceModel):
    """A model around another, of which a subclass changes what it is there for; it says itself what it is then."""

    def __init__(self, model: StateSpaceModel) -> None:
        super().__init__()
        self.model = model
        self.names, self.units, self.groups, self.noise_dim = model.names, model.units, model.groups, model.noise_dim

    @property
    def chart(self) -> Chart:
        return self.model.chart

    @property
    def origin(self) -> Tensor:
        return self.model.origin

    @property
    def anchor(self) -> Tensor:
        return self.model.anchor

    @property
    def noise(self) -> Distribution:
        return self.model.noise

    def initial(self, runs: int) -> Distribution:
        return self.model.initial(runs)

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return self.model.propagate(x, u, w)

    def observation(self, x: Tensor, u: Any) -> Distribution:
        return self.model.observation(x, u)

    def residual(self, y: Tensor, y_hat: Tensor) -> Tensor:
        return self.model.residual(y, y_hat)


class AtRest(Wrapped):
    """A model whose state does not move in this step: the first one of a model that observes its initial state."""

    def __init__(self, model: StateSpaceModel) -> None:
        super().__init__(model)
        self.linear, self.linear_given = model.linear, model.linear_given

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return x

    def log_likelihood(self, y: Tensor, x: Tensor, u: Any) -> Tensor:
        return self.model.log_likelihood(y, x, u)


def _log_normal(y: Tensor, mean: Tensor, sd: Tensor, seen: Tensor) -> Tensor:
    """Log density at y [R, 1, Dy] of independent normals about `mean` [R, N, Dy] over the components seen [R, 1, Dy] -> [R, N].

    Scales are of a run or, [R, N, Dy], of each particle. Does what torch's log_prob does in one pass over the particles
    instead of eight: half of a step was spent there.
    """
    scale, constant = seen / sd, ((torch.log(sd) + HALF_LOG_2PI) * seen).sum(-1)
    if scale.shape[1] == 1:
        return _quadratic(y[:, 0], mean, scale[:, 0], constant[:, 0])
    return _quadratic_of_each(y, mean, scale) - constant


def _run_quadratic(y: Tensor, mean: Tensor, scale: Tensor, constant: Tensor) -> Tensor:
    """-1/2 sum ((y - mean) scale)^2 - constant [R, N]; y, scale [R, K], mean [R, N, K], constant [R]."""
    z = (y[:, None] - mean) * scale[:, None]
    return -0.5 * (z * z).sum(-1) - constant[:, None]


@fusible
def _quadratic_of_each(y: Tensor, mean: Tensor, scale: Tensor) -> Tensor:
    z = (y - mean) * scale
    return -0.5 * (z * z).sum(-1)


_quadratic = fusible(_run_quadratic, by_hand=native.log_normal, whole=False)


def affine(phi: Tensor, x: Tensor, gain: Tensor, w: Tensor) -> Tensor:
    """phi x + gain w [R, N, D]; x [R, N, D], w [R, N, W], phi [R or 1, D, D], gain [R or 1, D, W].

    Compiled, it leaves out coefficients that are zero, as most are in error models of an INS.
    """
    return _affine(phi, x, gain, w).permute(1, 2, 0)


def _dense_affine(phi: Tensor, x: Tensor, gain: Tensor, w: Tensor) -> Tensor:
    runs = x.shape[0]
    if len(phi) == len(gain) == 1:  # the same for all runs: one product, components first in memory
        moved = (gain[0] @ w.permute(2, 0, 1).flatten(1)).addmm_(phi[0], x.permute(2, 0, 1).flatten(1))
        return moved.unflatten(1, x.shape[:2])
    return torch.baddbmm(gain.expand(runs, -1, -1) @ w.mT, phi.expand(runs, -1, -1), x.mT).transpose(0, 1)


_affine = fusible(_dense_affine, by_hand=native.affine)


def independent_normal(mean: Tensor, sd: Tensor) -> Independent:
    """Independent normal components, event in the last axis; sd broadcasts against mean."""
    return Normal(mean, sd.expand_as(mean), validate_args=False).to_event(1)


def normal_batch(runs: int, sd: Tensor, mean: Tensor | None = None) -> Independent:
    """The same independent normal law for each of `runs` runs: batch [R], event [d]."""
    centre = torch.zeros_like(sd) if mean is None else mean
    return independent_normal(centre.expand(runs, -1), sd)


def dense_normal(mean: Tensor, factor: Tensor) -> MultivariateNormal:
    """A normal law from its Cholesky factor, which is not checked again."""
    return MultivariateNormal(mean, scale_tril=factor, validate_args=False)


def initial_law(model: StateSpaceModel, runs: int, spread: Tensor | None = None) -> Distribution:
    """The law of x_0 in the chart, batch [R]: the model's, or the normal that a record brings by its factor [R, d, d]."""
    if spread is None:
        return model.initial(runs)
    return dense_normal(spread.new_zeros(spread.shape[:-1]), spread)


def numbers(values: Any) -> Tensor:
    """A float64 tensor; numbers that are tensors themselves, in lists of lists too, keep their gradient."""
    if _holds_tensors(values):
        return torch.stack([numbers(value) for value in values])
    return torch.as_tensor(values, dtype=torch.float64)


def _holds_tensors(values: Any) -> bool:
    return isinstance(values, list | tuple) and any(isinstance(v, Tensor) or _holds_tensors(v) for v in values)


def positive(name: str, values: Any) -> Tensor:
    """A float64 tensor of strictly positive numbers.

    Raises:
        ValueError: names the key, the value and the remedy.
    """
    tensor = numbers(values)
    if not bool(((tensor > 0) & torch.isfinite(tensor)).all()):
        raise ValueError(f"{name}={values}: give positive numbers (a standard deviation or variance cannot be 0 or negative)")
    return tensor
