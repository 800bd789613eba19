"""One model for each run: one class with other numbers, so that chains and parameter particles go through a filter at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import FunctionType
from typing import Any

import torch
from pyro.distributions import Independent
from torch import Tensor, nn
from torch.distributions import Distribution, MultivariateNormal, Normal
from torch.func import functional_call

from pfbench.model.base import Standard, StateSpaceModel, Wrapped, dense_normal, independent_normal
from pfbench.record import Record, map_inputs


class Apiece(Wrapped):
    """Run r is of models[r // each]. What a model computes is mapped over the runs with the buffers in which models differ.

    Works for every model whose numbers are buffers, and needs nothing from it. Gradients reach the buffers.

    Args:
        models: of one class, alike but for their buffers.
        each: consecutive runs that have a model in common.

    Raises:
        ValueError: models that differ in something that is no buffer, in their origin, or by their noise.
    """

    def __init__(self, models: Sequence[StateSpaceModel], each: int = 1) -> None:
        first = models[0]
        super().__init__(first)
        self.linear, self.linear_given, self.observes_initial = first.linear, first.linear_given, first.observes_initial
        self.choices, self.models, self.each = first.choices, tuple(models), each
        self.size = len(models) * each
        self._call = _Call(first)
        self._own = {f"model.{name}": value.repeat_interleave(each, 0) for name, value in _differing(models).items()}

    def prepare(self, record: Record) -> Record:
        """The record as its models like it: of each run by its own model, where they do not agree."""
        first = self.model.prepare(record)
        if all(_same(first.u, other.prepare(record).u) for other in self.models[1:]):
            return first
        parts = [self.models[r // self.each].prepare(record.of(slice(r, r + 1))) for r in range(self.size)]
        return parts[0]._replace(y=torch.cat([part.y for part in parts]), u=_joined([part.u for part in parts]))

    def initial(self, runs: int) -> Distribution:
        return self._law(lambda model: model.initial(1))

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return self._mapped(lambda model, x, u, w: model.propagate(x, u, w), x, u, w)[:, 0]

    def noise_gain(self, u: Any) -> Tensor | None:
        if self.model.noise_gain(u) is None:
            return None
        return self._mapped(lambda model, u: model.noise_gain(u), u)[:, 0]

    def observation(self, x: Tensor, u: Any) -> Distribution:
        return self._law(lambda model, x, u: model.observation(x, u), x, u)

    def transition(self, x: Tensor, u: Any) -> Distribution | None:
        if self.model.transition(x, u) is None:
            return None
        return self._law(lambda model, x, u: model.transition(x, u), x, u)

    def log_likelihood(self, y: Tensor, x: Tensor, u: Any) -> Tensor:
        if type(self.model).log_likelihood is StateSpaceModel.log_likelihood:
            return super().log_likelihood(y, x, u)
        return self._mapped(lambda model, y, x, u: model.log_likelihood(y, x, u), y, x, u)[:, 0]

    def _mapped(self, f: Callable[..., Any], *args: Any) -> Any:
        """f(model, ...) of every run as of a batch of one, stacked [R, 1, ...]."""

        def one(own: dict[str, Tensor], *parts: Any) -> Any:
            return functional_call(self._call, own, (f, *(_each_leaf(lambda a: a.unsqueeze(0), part) for part in parts)))

        spread = [_each_leaf(lambda a: a.expand(self.size, *a.shape[1:]), part) for part in args]
        return torch.vmap(one)(self._own, *spread)

    def _law(self, f: Callable[..., Any], *args: Any) -> Distribution:
        """The law that f(model, ...) is, of all runs: taken apart into its numbers and put together again."""
        kinds: list[Any] = []

        def numbers(model: StateSpaceModel, *parts: Any) -> dict[str, Tensor]:
            law: Any = f(model, *parts)
            base = law.base_dist if isinstance(law, torch.distributions.Independent) else law
            kinds.append((type(law), type(base)))
            if isinstance(base, MultivariateNormal):
                return {"loc": base.loc, "scale_tril": base.scale_tril}
            batch = len(law.batch_shape) + len(law.event_shape)
            named = {name: getattr(base, name) for name in base.arg_constraints}
            return {name: a.reshape(*[1] * (batch - a.dim()), *a.shape) for name, a in named.items()}

        parts = {name: a[:, 0] for name, a in self._mapped(numbers, *args).items()}
        whole, base = kinds[0]
        if issubclass(base, MultivariateNormal):
            return dense_normal(parts["loc"], parts["scale_tril"])
        if not issubclass(whole, torch.distributions.Independent):
            raise TypeError(f"{type(self.model).__name__}: a law is {whole.__name__}; return Independent or MultivariateNormal")
        if issubclass(base, Normal):
            return independent_normal(parts["loc"], parts["scale"])
        return Independent(base(**parts), 1)


class _Call(nn.Module):
    def __init__(self, model: StateSpaceModel) -> None:
        super().__init__()
        self.model = model

    def forward(self, f: Callable[..., Any], *args: Any) -> Any:
        return f(self.model, *args)


def _differing(models: Sequence[StateSpaceModel]) -> dict[str, Tensor]:
    """Buffers that are not the same in all models [len(models), ...].

    Raises:
        ValueError: what else is not the same.
    """
    first, kind = models[0], type(models[0]).__name__
    for other in models[1:]:
        changed = outside_buffers(first, other)
        if changed:
            raise ValueError(
                f"{kind} keeps {changed[0]} as a plain number: models of one batch may differ in buffers alone; let the class "
                "register it by register_buffer"
            )
        if not torch.equal(first.origin, other.origin):
            raise ValueError(f"{kind}: models of one batch need one origin; let the law `initial` carry what differs")
        if not isinstance(other.noise, torch.distributions.Independent) or not isinstance(other.noise.base_dist, Standard):
            raise ValueError(f"{kind}: its driving noise is not standard normal; scale it inside the model")
    stacked = {name: [dict(model.named_buffers())[name] for model in models] for name, _ in first.named_buffers()}
    found = {name: torch.stack(values) for name, values in stacked.items() if not _all_same(values)}
    if found:
        return found
    name, values = next(iter(stacked.items()))
    return {name: torch.stack(values)}  # alike in all: mapped over one of them for its size


def outside_buffers(a: StateSpaceModel, b: StateSpaceModel) -> list[str]:
    """Attributes, of modules within it too, that are not the same in two models of one class and are no buffers."""
    changed = []
    for (place, one), (_, other) in zip(a.named_modules(), b.named_modules(), strict=True):
        for name, value in vars(one).items():
            if not name.startswith("_") and not _equal(value, vars(other).get(name)):
                changed.append(f"{place}.{name}".lstrip("."))
    return changed


def _equal(a: Any, b: Any) -> bool:
    if isinstance(a, Tensor) or isinstance(b, Tensor):
        return torch.equal(torch.as_tensor(a), torch.as_tensor(b))
    return isinstance(a, FunctionType) or bool(a == b)


def _all_same(values: Sequence[Tensor]) -> bool:
    return not any(a.requires_grad for a in values) and all(torch.equal(values[0], a) for a in values[1:])


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, Tensor):
        return a is b or torch.equal(a, b)
    return all(_same(one, other) for one, other in zip(a, b, strict=True))


def _joined(inputs: Sequence[Any]) -> Any:
    first = inputs[0]
    if isinstance(first, Tensor):
        return torch.cat(list(inputs))
    return type(first)(*(_joined(parts) for parts in zip(*inputs, strict=True))) if first else first


def _each_leaf(f: Callable[[Tensor], Tensor], part: Any) -> Any:
    return f(part) if isinstance(part, Tensor) else map_inputs(f, part)
