"""Operators of the manifest as functions: C++ on the CPU in one thread, CUDA kernels on a device.

Each computes the results of a torch function. It raises ValueError for wrong arguments, and OSError or
CalledProcessError if no library came with the package and none can be compiled. Gradients do not pass
through operators.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any, cast

import torch
from torch import Tensor

from pfbench.kernels import cuda
from pfbench.kernels.cpp_library import load_library
from pfbench.kernels.manifest import Operator, read_operators
from pfbench.kernels.operator_checks import check_arguments

_operators = torch.library.Library("pfbench", "DEF")


def _define(operator: Operator) -> None:
    """Define an operator for torch, with its results for torch's compiler."""
    _operators.define(operator.name + operator.schema)
    function: Callable[..., Any] = partial(make_empty_results, operator.name)
    torch.library.register_fake(f"pfbench::{operator.name}", function)


def make_empty_results(name: str, *arguments: Any) -> Any:
    """Make results of an operator with the right types and shapes, contiguous, without values.

    Args:
        name: Name of the operator.
        arguments: Its valid arguments, in order, with its batch as one axis.

    Returns:
        A tensor, or a tuple of several.
    """
    operator, sizes = read_operators()[name], cast(dict[str, Any], {"1": 1})
    template, real = next(a for a in arguments if isinstance(a, Tensor)), None
    for argument, value in zip(operator.arguments, arguments, strict=True):
        if argument.kind == "int":
            sizes[argument.name] = value
            continue
        if argument.kind == "real" and real is None:
            real = value.dtype
        if value.dim():
            template = value
        for axis, size in zip(argument.axes, value.shape, strict=True):
            if axis.isupper():
                sizes[axis] = size
            else:  # R or 1
                sizes.setdefault(axis.upper(), size)
    results = []
    for kind, axes in operator.results:
        shape = [sum(factor * sizes[axis] for factor, axis in terms) for terms in axes]
        dtype = real if kind == "real" else getattr(torch, kind)
        results.append(template.new_empty(shape, dtype=dtype))
    return results[0] if len(results) == 1 else tuple(results)


def _make_function(name: str) -> Callable[..., Any]:
    """Return the function of an operator.

    The arguments are checked once, in C++ or by the CUDA kernel. Only a refused call is checked again in
    Python, so that its message is that of eager mode.
    """
    operator = read_operators()[name]

    @cache
    def find() -> Callable[..., Any]:
        if operator.is_on_cpu:
            load_library()
        overload = getattr(torch.ops.pfbench, name).default
        has_batch = any(argument.has_batch for argument in operator.arguments)
        return partial(_call_in_batches, operator, overload) if has_batch else overload

    def call(*args: Any) -> Any:
        function = find()
        try:
            return function(*args)
        except (RuntimeError, TypeError, AttributeError, IndexError, ValueError):
            check_arguments(name, args)
            raise

    call.__name__ = call.__qualname__ = name
    lines = "\n".join(f"    {text}" for text in operator.text)
    call.__doc__ = f"{operator.summary}\n\nArguments, then results:\n{lines}"
    return call


def _call_in_batches(operator: Operator, overload: Callable[..., Any], *args: Any) -> Any:
    """Call an operator with the batch axes of its arguments as one axis."""
    first = operator.arguments[0]
    batch = args[0].shape[: args[0].dim() - len(first.axes) + 1]
    flat = []
    for argument, value in zip(operator.arguments, args, strict=True):
        rest = value.shape[value.dim() - len(argument.axes) + 1 :]
        flat.append(value.expand(*batch, *rest).reshape(batch.numel(), *rest))
    results = overload(*flat)
    if isinstance(results, Tensor):
        return results.view((*batch, *results.shape[1:]))
    return tuple(a.view((*batch, *a.shape[1:])) for a in results)


for _operator in read_operators().values():
    _define(_operator)
cuda.register(_operators)

philox_normals = _make_function("philox_normals")
philox_normals_float64 = _make_function("philox_normals_float64")
philox_uniforms = _make_function("philox_uniforms")
resample_systematic = _make_function("resample_systematic")
gather_particles = _make_function("gather_particles")
log_normal = _make_function("log_normal")
propagate_affine = _make_function("propagate_affine")
gather_propagate = _make_function("gather_propagate")
count_unique = _make_function("count_unique")
sum_and_squares = _make_function("sum_and_squares")
sum_log_weights = _make_function("sum_log_weights")
normalise_weights = _make_function("normalise_weights")
weighted_moments = _make_function("weighted_moments")
cholesky_factor = _make_function("cholesky_factor")
kalman_update = _make_function("kalman_update")
fit_affine = _make_function("fit_affine")
group_covariance = _make_function("group_covariance")
squared_mahalanobis = _make_function("squared_mahalanobis")
marginal_scores = _make_function("marginal_scores")
energy_score = _make_function("energy_score")
