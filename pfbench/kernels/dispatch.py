"""Choice between torch operations and C++ or CUDA operators for the inner loops over particles."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache, partial, wraps
from typing import Any, TypeVar, cast

import torch
from torch import Tensor
from torch.autograd import forward_ad

from pfbench.kernels import cuda
from pfbench.kernels.cpp_library import is_library_loaded, load_library, use_private_cache
from pfbench.kernels.manifest import Operator, check_arguments, read_operators

# A compilable function takes tensors, the first argument among them, and integers. It returns
# tensors. Each of its torch operations is a pass over all particles. The C++ operators make one pass. They
# are the default on the CPU. On other devices they are compiled on request, which takes some seconds:
#
#     with dispatch.use_kernels():
#         run_filter(...)
#
# In a compiled step (`pfbench.filter.particle.compiled_filter`) the hand-written kernels stay whole as operators.
# torch's compiler would compute the noise again for each state component.

F = TypeVar("F", bound=Callable[..., Any])

# None: operators on the CPU, where they cost nothing, and torch operations on other devices
_fused: ContextVar[bool | None] = ContextVar("fused", default=None)
_graph: ContextVar[bool] = ContextVar("graph", default=False)
_marking: ContextVar[bool] = ContextVar("marking", default=False)
# What `sir_step` does after the particles have moved. In a graph these are torch operations, unless they are marked.
_MARKED = ("log_normal", "sum_log_weights", "normalise_weights")
_peek_transform = (
    torch._C._functorch.peek_interpreter_stack
)  # None outside of torch.vmap and its like


@contextmanager
def use_kernels(enabled: bool = True) -> Iterator[None]:
    """Run compilable functions by operators in this context, or in torch operations if `enabled` is False."""
    token = _fused.set(enabled)
    try:
        yield
    finally:
        _fused.reset(token)


@contextmanager
def capture_graph(enabled: bool = True) -> Iterator[None]:
    """Mark that a step is recorded in this context, unless `enabled` is False: code must not branch on numbers."""
    token = _graph.set(enabled)
    try:
        yield
    finally:
        _graph.reset(token)


@contextmanager
def mark_operators() -> Iterator[None]:
    """Record some operators that a CUDA device lacks as calls of their own, so that they can be fused with others."""
    token = _marking.set(True)
    try:
        yield
    finally:
        _marking.reset(token)


def is_capturing() -> bool:
    """Return whether a step is recorded."""
    return _graph.get()


def _plain(args: tuple[Any, ...]) -> bool:
    """Return whether no argument requires a gradient or is a batch of `torch.vmap`."""
    has_gradients, has_tangents = torch.is_grad_enabled(), forward_ad._current_level >= 0
    if not has_gradients and not has_tangents and _peek_transform() is None:
        return True
    for a in args:
        if isinstance(a, torch.Tensor) and (
            (has_gradients and a.requires_grad)
            or (has_tangents and forward_ad.unpack_dual(a).tangent is not None)
            or torch._C._functorch.is_functorch_wrapped_tensor(a)
        ):
            return False
    return True


def runs_operators(*args: Tensor) -> bool:
    """Return whether C++ operators take these tensors now, so that one may stand for several functions."""
    if _graph.get() or _fused.get() is False or not _plain(args) or _on_cuda(args):
        return False
    return is_library_loaded()


def _on_cuda(args: tuple[Any, ...]) -> bool:
    """Return whether an argument is on a CUDA device."""
    return cuda.is_cuda_available() and any(isinstance(a, torch.Tensor) and a.is_cuda for a in args)


def compilable(
    function: F,
    eager: F | None = None,
    operator: F | None = None,
    keep_in_graph: bool | Callable[..., bool] = True,
    use_torch_compiler: bool = True,
) -> F:
    """Make a function of tensors compilable."""
    run_eagerly = eager or function
    in_graph = operator if operator is not None and keep_in_graph else None
    fits_graph = keep_in_graph if callable(keep_in_graph) else lambda *_: True

    compiled = cache(partial(_compile_by_torch, function))

    def check_and_run(*args: Any) -> Any:
        _check(operator, args)
        return run_eagerly(*args)

    def run_compiled(*args: Any) -> Any:
        if not _plain(args):
            return check_and_run(*args)
        if _on_cuda(args):
            kernel = _find_cuda_kernel(operator, args)
            return (kernel or (compiled() if use_torch_compiler else run_eagerly))(*args)
        if operator is None or not is_library_loaded():
            return check_and_run(*args)
        return operator(*args)

    @wraps(function)
    def call(*args: Any) -> Any:
        if not _graph.get():
            enabled = not _on_cuda(args) if _fused.get() is None else _fused.get()
            return (run_compiled if enabled else check_and_run)(*args)
        if (mark := _find_mark(function, operator, args)) or _on_cuda(args):
            return (mark or _find_cuda_kernel(operator, args) or function)(*args)
        _check(operator, args)
        # tangents do not pass an operator: a derivative through it would be zero
        return (in_graph if in_graph and _plain(args) and fits_graph(*args) else function)(*args)

    return cast(F, call)


def _find_mark(
    function: Callable[..., Any], operator: Callable[..., Any] | None, args: tuple[Any, ...]
) -> Callable[..., Any] | None:
    """Return the operator to record in place of a function, None if its operations are to be recorded."""
    if operator is None or operator.__name__ not in _MARKED:
        return None
    return _make_mark(function, operator.__name__) if _marking.get() and _plain(args) else None


@cache
def _make_mark(function: Callable[..., Any], name: str) -> Callable[..., Any]:
    """Return an operator that runs a function on a CUDA device, because a step runs while it is recorded."""
    _operators.impl(name, function, "CUDA")
    return cast(Callable[..., Any], getattr(torch.ops.pfbench, name).default)


def _find_cuda_kernel(
    operator: Callable[..., Any] | None, args: tuple[Any, ...]
) -> Callable[..., Any] | None:
    """Return the CUDA kernel of an operator, None without one or with gradients.

    The kernel checks its arguments itself. Without one they are checked here.
    """
    kernel = None
    if operator is not None and _plain(args):
        kernel = cuda.find_kernel(operator.__name__, args)
    if kernel is None:
        _check(operator, args)
    return kernel


def _check(operator: Callable[..., Any] | None, args: tuple[Any, ...]) -> None:
    """Check arguments as the operator does. A recorded step has shapes and no values."""
    if operator is not None and not torch.compiler.is_compiling():
        check_arguments(operator.__name__, args, with_values=not _graph.get())


@contextmanager
def kept_validation() -> Iterator[None]:
    """Restore the validation of distributions, which torch's compiler turns off in the process.

    Without it a measurement outside the support has a density, and no error is raised.
    """
    is_validated = torch.distributions.Distribution._validate_args
    try:
        yield
    finally:
        torch.distributions.Distribution.set_default_validate_args(is_validated)


def _compile_by_torch(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function by torch's compiler."""
    prepare_compiler()
    with kept_validation():
        return torch.compile(function, dynamic=True)


# --------------------------------------------------------------------------------------------------
# Operators of the manifest as functions: C++ on the CPU in one thread, CUDA kernels on a device.
#
# Each computes the results of a torch function. It raises ValueError for wrong arguments, and OSError or
# CalledProcessError if no library came with the package and none can be compiled. Gradients do not pass
# through operators.

_operators = torch.library.Library("pfbench", "DEF")


def prepare_compiler() -> None:
    """Let torch's compiler use the private cache, before its imports choose a folder, and know the operators' results."""
    use_private_cache()
    _register_results()


@cache
def _register_results() -> None:
    """State the results of all operators. It takes a tenth of a second, since torch reads lines of sources."""
    for name in read_operators():
        function: Callable[..., Any] = partial(make_empty_results, name)
        torch.library.register_fake(f"pfbench::{name}", function)


def make_empty_results(name: str, *arguments: Any) -> Any:
    """Make results of an operator with the right types and shapes, contiguous, without values."""
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
    _operators.define(_operator.name + _operator.schema)
cuda.register(_operators)
_operators.define("run_tape(Tensor[] given) -> Tensor[]")
_operators.define("run_paths(Tensor[] given) -> Tensor[]")

philox_normals = _make_function("philox_normals")
philox_normals_float64 = _make_function("philox_normals_float64")
philox_uniforms = _make_function("philox_uniforms")
resample_systematic = _make_function("resample_systematic")
gather_particles = _make_function("gather_particles")
resample_particles = _make_function("resample_particles")
log_normal = _make_function("log_normal")
log_observed_normal = _make_function("log_observed_normal")
propagate_affine = _make_function("propagate_affine")
gather_propagate = _make_function("gather_propagate")
sir_step = _make_function("sir_step")
count_unique = _make_function("count_unique")
sum_and_squares = _make_function("sum_and_squares")
sum_log_weights = _make_function("sum_log_weights")
normalise_weights = _make_function("normalise_weights")
log_mixture = _make_function("log_mixture")
weighted_moments = _make_function("weighted_moments")
weigh_particles = _make_function("weigh_particles")
cholesky_factor = _make_function("cholesky_factor")
kalman_update = _make_function("kalman_update")
fit_affine = _make_function("fit_affine")
group_covariance = _make_function("group_covariance")
squared_mahalanobis = _make_function("squared_mahalanobis")
marginal_scores = _make_function("marginal_scores")
energy_score = _make_function("energy_score")


def run_tape(arguments: list[Tensor]) -> list[Tensor]:
    """Take steps of a bootstrap filter whose model is a tape.

    Returns means and variances [T, R, D], log evidences, effective sample sizes, masks of resampling and counts of ancestors [T, R].
    The others are of the kept steps: particles [K, D, R, N], log weights, weights and log weights before the measurement [K, R, N].
    The arguments are those of `run_tape` in src/tape.cpp.
    """
    load_library()
    results: list[Tensor] = torch.ops.pfbench.run_tape.default(arguments)
    return results


def run_paths(arguments: list[Tensor]) -> list[Tensor]:
    """Propagate paths from their starts under given noise, with the model as a tape.

    Returns states [K + 1, D, R, N] and log likelihoods [K + 1, R, N]. The arguments are those of `run_paths` in src/tape.cpp.
    """
    load_library()
    results: list[Tensor] = torch.ops.pfbench.run_paths.default(arguments)
    return results
