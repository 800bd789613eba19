"""Batch of models, so that chains or parameter particles share a filter pass."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import FunctionType
from typing import Any

import torch
from pyro.distributions import Independent
from torch import Tensor, nn
from torch.distributions import Distribution, MixtureSameFamily, MultivariateNormal, Normal
from torch.func import functional_call
from torch.utils._pytree import tree_leaves, tree_map
from typing_extensions import override

from pfbench.core.density import dense_normal, independent_normal
from pfbench.core.parameter_checks import require
from pfbench.core.record import Record
from pfbench.model.base import ModelWrapper, StateSpaceModel


class ModelBatch(ModelWrapper):
    """A batch of models: run r has models[r // runs_per_model].

    Each method is mapped over the runs with the buffers in which the models differ. Models that
    differ in other attributes too are evaluated one by one, which takes more time. Gradients reach
    the buffers.
    """

    def __init__(self, models: Sequence[StateSpaceModel], runs_per_model: int = 1) -> None:
        first = models[0]
        super().__init__(first)
        self.linear, self.linear_given = first.linear, first.linear_given
        self.observes_initial, self.choices = first.observes_initial, first.choices
        self.models, self.runs_per_model = tuple(models), runs_per_model
        self.size = len(models) * runs_per_model
        self._call = _Call(first)
        self._is_mapped = not any(list_non_buffers(first, model) for model in models[1:])
        self._buffers_by_run = {
            f"model.{name}": value.repeat_interleave(runs_per_model, 0)
            for name, value in _differing(models).items()
        }

    @override
    def prepare(self, record: Record) -> Record:
        first = self.model.prepare(record)
        others = (model.prepare(record).u for model in self.models[1:])
        if all(all(map(_equal, tree_leaves(first.u), tree_leaves(u))) for u in others):
            return first
        records = [
            self.models[r // self.runs_per_model].prepare(record.select_runs(slice(r, r + 1)))
            for r in range(self.size)
        ]
        y, u = tree_map(lambda *a: torch.cat(a), *((run.y, run.u) for run in records))
        return records[0]._replace(y=y, u=u)

    @override
    def initial(self, runs: int) -> Distribution:
        return self._map_distribution(lambda model: model.initial(1))

    @override
    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return self._mapped(lambda model, x, u, w: model.propagate(x, u, w), x, u, w)[:, 0]

    @property
    @override
    def has_noise_gain(self) -> bool:
        return self.model.has_noise_gain

    @override
    def noise_gain(self, u: Any) -> Tensor | None:
        if self.model.noise_gain(u) is None:
            return None
        return self._mapped(lambda model, u: model.noise_gain(u), u)[:, 0]

    @override
    def observation(self, x: Tensor, u: Any) -> Distribution:
        return self._map_distribution(lambda model, x, u: model.observation(x, u), x, u)

    @override
    def transition(self, x: Tensor, u: Any) -> Distribution | None:
        if not self.model.chart.flat or self.model.transition(x, u) is None:
            return None  # a distribution in a chart is not built of tensors alone
        return self._map_distribution(lambda model, x, u: model.transition(x, u), x, u)

    @override
    def log_likelihood(self, y: Tensor, x: Tensor, u: Any) -> Tensor:
        if type(self.model).log_likelihood is StateSpaceModel.log_likelihood:
            return super().log_likelihood(y, x, u)
        return self._mapped(lambda model, y, x, u: model.log_likelihood(y, x, u), y, x, u)[:, 0]

    def _mapped(self, f: Callable[..., Any], *args: Any) -> Any:
        """Evaluate f(model, ...) of every run as a batch of one, stacked [R, 1, ...]."""

        def call_run(buffers: dict[str, Tensor], *run_args: Any) -> Any:
            batched = tree_map(lambda a: a.unsqueeze(0), run_args)
            return functional_call(self._call, buffers, (f, *batched))

        expanded = tree_map(lambda a: a.expand(self.size, *a.shape[1:]), args)
        if self._is_mapped:
            return torch.vmap(call_run)(self._buffers_by_run, *expanded)

        def call_alone(r: int) -> Any:
            run_args = tree_map(lambda a: a[r : r + 1], expanded)
            return f(self.models[r // self.runs_per_model], *run_args)

        return tree_map(lambda *a: torch.stack(a), *map(call_alone, range(self.size)))

    def _map_distribution(self, f: Callable[..., Any], *args: Any) -> Distribution:
        """Map the parameters of a distribution over the runs and build it again."""
        kinds: list[Any] = []

        def parameters(model: StateSpaceModel, *run_args: Any) -> dict[str, Tensor]:
            distribution: Any = f(model, *run_args)
            is_independent = isinstance(distribution, torch.distributions.Independent)
            base = distribution.base_dist if is_independent else distribution
            kinds.append((type(distribution), type(base)))
            if isinstance(base, MultivariateNormal):
                return {"loc": base.loc, "scale_tril": base.scale_tril}
            batch = len(distribution.batch_shape) + len(distribution.event_shape)
            values = {name: getattr(base, name) for name in base.arg_constraints}
            return {
                name: a.reshape(*[1] * (batch - a.dim()), *a.shape) for name, a in values.items()
            }

        mapped = {name: a[:, 0] for name, a in self._mapped(parameters, *args).items()}
        outer, base = kinds[0]
        if issubclass(base, MultivariateNormal):
            return dense_normal(mapped["loc"], mapped["scale_tril"])
        if not issubclass(outer, torch.distributions.Independent):
            raise TypeError(
                f"{type(self.model).__name__} must use Independent or MultivariateNormal "
                f"distributions in a batch of models, got {outer.__name__}. Run its models one by "
                "one."
            )
        if issubclass(base, Normal):
            return independent_normal(mapped["loc"], mapped["scale"])
        if {"probs", "logits"} <= set(mapped):  # two names of one parameter
            del mapped["probs"]
        return Independent(base(**mapped), 1)


class _Call(nn.Module):
    def __init__(self, model: StateSpaceModel) -> None:
        super().__init__()
        self.model = model

    def forward(self, f: Callable[..., Any], *args: Any) -> Any:
        return f(self.model, *args)


def _same_distribution(a: Any, b: Any) -> bool:
    """Return whether two distributions have the same class and parameters."""
    if type(a) is not type(b):
        return False
    if isinstance(a, torch.distributions.Independent):
        return _same_distribution(a.base_dist, b.base_dist)
    if isinstance(a, MixtureSameFamily):
        same = torch.equal(a.mixture_distribution.logits, b.mixture_distribution.logits)
        return same and _same_distribution(a.component_distribution, b.component_distribution)
    return all(_equal(getattr(a, name), getattr(b, name)) for name in a.arg_constraints)


def _differing(models: Sequence[StateSpaceModel]) -> dict[str, Tensor]:
    """Return buffers that differ between models, stacked [len(models), ...]."""
    first, kind = models[0], type(models[0]).__name__
    for model in models[1:]:
        require(
            torch.equal(first.origin, model.origin),
            kind,
            "have one origin in a batch of models",
            "different ones",
            "Put the difference into the initial distribution.",
        )
        require(
            _same_distribution(first.noise, model.noise),
            kind,
            "have one noise distribution in a batch of models",
            "different ones",
            "Scale the noise inside `propagate`.",
        )
    rows = [dict(model.named_buffers()) for model in models]
    names = [
        name
        for name, a in rows[0].items()
        if any(row[name].requires_grad or not torch.equal(row[name], a) for row in rows)
    ]
    # if all models are equal, vmap still needs the number of runs
    names = names or list(rows[0])[:1]
    return {name: torch.stack([row[name] for row in rows]) for name in names}


def list_differences(a: StateSpaceModel, b: StateSpaceModel) -> list[str]:
    """List what differs between two models of one class: buffers, or else other attributes."""
    pairs = zip(a.named_buffers(), b.buffers(), strict=True)
    return [name for (name, x), y in pairs if not torch.equal(x, y)] or list_non_buffers(a, b)


def list_non_buffers(a: StateSpaceModel, b: StateSpaceModel) -> list[str]:
    """List attributes that differ between two models and are not buffers.

    Returns dotted names, attributes of submodules included.
    """
    changed = []
    for (path, module), (_, second) in zip(a.named_modules(), b.named_modules(), strict=True):
        for name, value in vars(module).items():
            if not name.startswith("_") and not _equal(value, vars(second).get(name)):
                changed.append(f"{path}.{name}".lstrip("."))
    return changed


def _equal(a: Any, b: Any) -> bool:
    if isinstance(a, Tensor) or isinstance(b, Tensor):
        return a is b or torch.equal(torch.as_tensor(a), torch.as_tensor(b))
    return isinstance(a, FunctionType) or bool(a == b)
