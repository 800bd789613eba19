"""Choice between torch operations and operators for the inner loops over particles.

A compilable function takes tensors, the first argument among them, and integers. It returns
tensors. Each of its torch operations is a pass over all particles. The C++ operators make one pass. They
are the default on the CPU. On other devices they are compiled on request, which takes some seconds:

    with compilation.use_compiled():
        run_filter(...)

In a compiled step (`pfbench.filter.particle.compiled_filter`) the hand-written kernels stay whole as operators.
torch's compiler would compute the noise again for each state component.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache, partial, wraps
from typing import Any, TypeVar, cast

import torch
from torch.autograd import forward_ad

from pfbench.kernels import cuda
from pfbench.kernels.cpp_library import is_library_loaded
from pfbench.kernels.operator_checks import check_arguments
from pfbench.kernels.private_folder import use_private_cache

F = TypeVar("F", bound=Callable[..., Any])

# None: operators on the CPU, where they cost nothing, and torch operations on other devices
_fused: ContextVar[bool | None] = ContextVar("fused", default=None)
_graph: ContextVar[bool] = ContextVar("graph", default=False)
_peek_transform = (
    torch._C._functorch.peek_interpreter_stack
)  # None outside of torch.vmap and its like


@contextmanager
def use_compiled(enabled: bool = True) -> Iterator[None]:
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
    """Make a function of tensors compilable.

    Args:
        function: Function to compile.
        eager: Function for eager mode, if separate operations have a faster method.
        operator: Hand-written kernel. It replaces the function on the CPU, where it runs in one
            thread, and on a CUDA device if a kernel of its name exists. It is not used with
            gradients.
        keep_in_graph: Whether (or for which tensors) a compiled step on the CPU uses the kernel as
            one operator. False if torch's compiler does it as well.
        use_torch_compiler: Whether torch's compiler is used on a CUDA device without a kernel.
            Linear algebra does not gain from it, and the generator takes minutes to compile.

    Returns:
        The compilable function.
    """
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
        if _on_cuda(args):
            return (_find_cuda_kernel(operator, args) or function)(*args)
        _check(operator, args)
        # tangents do not pass an operator: a derivative through it would be zero
        return (in_graph if in_graph and _plain(args) and fits_graph(*args) else function)(*args)

    return cast(F, call)


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
    use_private_cache()
    with kept_validation():
        return torch.compile(function, dynamic=True)
