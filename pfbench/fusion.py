"""Inner loops that a compiler may fuse.

A fusible function takes tensors, the first argument among them, and whole numbers; it gives tensors only. Eagerly each of its
operations passes over all particles; fused, the whole of it does so once. Compiling costs some seconds, so they run eagerly until
a job that is large enough asks otherwise:

    with fusion.fused():
        run_filter(...)

Where a whole step becomes a graph (pfbench.filter.compiled), the loops that are written by hand stay whole in it, as operators of
their own: torch's compiler would compute the noise again for each state component.
"""

from __future__ import annotations

import logging
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache, wraps
from typing import Any, TypeVar, cast

import torch
from torch.autograd import forward_ad
from torch.utils import _pytree as pytree

from pfbench import cuda

F = TypeVar("F", bound=Callable[..., Any])

log = logging.getLogger("pfbench")
_failed: set[Callable[..., Any]] = set()  # what a compiler has refused once

_fused: ContextVar[bool] = ContextVar("fused", default=False)
_graph: ContextVar[bool] = ContextVar("graph", default=False)


@contextmanager
def fused(wanted: bool = True) -> Iterator[None]:
    """Within it fusible functions run compiled (or, `wanted` being False, eagerly); results agree to rounding."""
    token = _fused.set(wanted)
    try:
        yield
    finally:
        _fused.reset(token)


@contextmanager
def graph() -> Iterator[None]:
    """Within it a step is being recorded, to be compiled: nothing may look at numbers."""
    token = _graph.set(True)
    try:
        yield
    finally:
        _graph.reset(token)


def recording() -> bool:
    """Is a step being recorded?"""
    return _graph.get()


def _plain(args: tuple[Any, ...]) -> bool:
    """Numbers of which no gradient is wanted."""
    tensors = [a for a in args if isinstance(a, torch.Tensor)]
    return not any(
        (a.requires_grad and torch.is_grad_enabled()) or forward_ad.unpack_dual(a).tangent is not None for a in tensors
    )


def _on_cuda(args: tuple[Any, ...]) -> bool:
    return cuda.available() and any(isinstance(a, torch.Tensor) and a.is_cuda for a in args)


def fusible(
    function: F, eager: F | None = None, by_hand: F | None = None, whole: bool | Callable[..., bool] = True, compiles: bool = True
) -> F:
    """Makes a function of tensors one that can be fused.

    Args:
        function: what is compiled.
        eager: computes the same where nothing is fused, if separate operations have a faster way to do it.
        by_hand: is taken for what would be compiled on the CPU and one thread, or on a CUDA device by a kernel of its name if
            there is one, where it works and no gradient is wanted.
        whole: in a graph of the CPU, too, as one operator, or for which tensors; not what the compiler does well itself.
        compiles: by torch's compiler, too, where it cannot be taken by hand; linear algebra gains nothing from it.
    """
    separate = eager or function
    in_graph = by_hand if by_hand is not None and whole else None
    if in_graph is not None:
        _shaped(in_graph, function)
    taken = whole if callable(whole) else lambda *_: True

    @cache
    def compiled() -> Callable[..., Any]:
        return torch.compile(function, dynamic=True)

    def kernel(args: tuple[Any, ...]) -> Callable[..., Any] | None:
        return cuda.kernel(by_hand.__name__, args) if by_hand is not None and _plain(args) else None

    def as_one(*args: Any) -> Any:
        if _on_cuda(args):
            return (kernel(args) or (compiled() if compiles else separate))(*args)
        if by_hand is not None and by_hand not in _failed and torch.get_num_threads() == 1 and _plain(args):
            try:
                return by_hand(*args)
            except (OSError, subprocess.CalledProcessError) as error:
                what = "torch compiles it instead" if compiles else "it runs eagerly instead"
                log.warning("%s does not compile here (%s); %s", by_hand.__name__, type(error).__name__, what)
                _failed.add(by_hand)
        return (compiled() if compiles else separate)(*args)

    @wraps(function)
    def call(*args: Any) -> Any:
        if _graph.get():
            if _on_cuda(args):
                return (kernel(args) or function)(*args)
            return (function if in_graph is None or not taken(*args) else in_graph)(*args)
        return (as_one if _fused.get() else separate)(*args)

    return cast(F, call)


def _shaped(by_hand: Callable[..., Any], like: Callable[..., Any]) -> None:
    """Tells torch's compiler what comes out of an operator: contiguous results, with the shapes of `like`'s."""

    def shapes(*args: Any) -> Any:
        return pytree.tree_map(lambda a: a.new_empty(a.shape), like(*args))

    torch.library.register_fake(f"pfbench::{by_hand.__name__}", shapes)
