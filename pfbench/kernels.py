"""Inner loops that a compiler may fuse.

A kernel is a plain function of tensors. Eagerly each of its operations passes over all particles; fused, the whole function
does so once. Compiling costs some seconds, so kernels run eagerly until a job that is large enough asks otherwise:

    with kernels.fused():
        run_filter(...)

Only pieces are compiled, not the step: over a whole step the compiler computes the noise again for each state component.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache, wraps
from typing import Any, TypeVar, cast

import torch

F = TypeVar("F", bound=Callable[..., Any])

_fused: ContextVar[bool] = ContextVar("fused", default=False)


@contextmanager
def fused(wanted: bool = True) -> Iterator[None]:
    """Within it kernels run compiled (or, `wanted` being False, eagerly); results agree to rounding."""
    token = _fused.set(wanted)
    try:
        yield
    finally:
        _fused.reset(token)


def kernel(function: F, eager: F | None = None) -> F:
    """A function of tensors as one to be fused.

    Args:
        function: what is compiled.
        eager: computes the same where nothing is fused, if separate operations have a faster way to do it.
    """
    separate = eager or function

    @cache
    def compiled() -> Callable[..., Any]:
        return torch.compile(function, dynamic=True)

    @wraps(function)
    def call(*args: Any) -> Any:
        return (compiled() if _fused.get() else separate)(*args)

    return cast(F, call)
