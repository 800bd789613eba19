"""Inner loops that a compiler may fuse.

A fusible function takes and gives tensors only. Eagerly each of its operations passes over all particles; fused, the whole of it
does so once. Compiling costs some seconds, so they run eagerly until a job that is large enough asks otherwise:

    with fusion.fused():
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
    """Within it fusible functions run compiled (or, `wanted` being False, eagerly); results agree to rounding."""
    token = _fused.set(wanted)
    try:
        yield
    finally:
        _fused.reset(token)


def fusible(function: F, eager: F | None = None) -> F:
    """Makes a function of tensors one that can be fused.

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
