"""Inner loops that a compiler may fuse.

A fusible function takes and gives tensors only. Eagerly each of its operations passes over all particles; fused, the whole of it
does so once. Compiling costs some seconds, so they run eagerly until a job that is large enough asks otherwise:

    with fusion.fused():
        run_filter(...)

Only pieces are compiled, not the step: over a whole step the compiler computes the noise again for each state component.
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

F = TypeVar("F", bound=Callable[..., Any])

log = logging.getLogger("pfbench")
_failed: set[Callable[..., Any]] = set()  # what a compiler has refused once

_fused: ContextVar[bool] = ContextVar("fused", default=False)


@contextmanager
def fused(wanted: bool = True) -> Iterator[None]:
    """Within it fusible functions run compiled (or, `wanted` being False, eagerly); results agree to rounding."""
    token = _fused.set(wanted)
    try:
        yield
    finally:
        _fused.reset(token)


def _plain(args: tuple[Any, ...]) -> bool:
    """Numbers on the CPU, to be worked on by one thread, and no gradient of them is wanted."""
    wanted = any((a.requires_grad and torch.is_grad_enabled()) or forward_ad.unpack_dual(a).tangent is not None for a in args)
    return torch.get_num_threads() == 1 and not args[0].is_cuda and not wanted


def fusible(function: F, eager: F | None = None, by_hand: F | None = None) -> F:
    """Makes a function of tensors one that can be fused.

    Args:
        function: what is compiled.
        eager: computes the same where nothing is fused, if separate operations have a faster way to do it.
        by_hand: is taken for what would be compiled on the CPU and one thread, where it works and no gradient is wanted.
    """
    separate = eager or function

    @cache
    def compiled() -> Callable[..., Any]:
        return torch.compile(function, dynamic=True)

    def whole(*args: Any) -> Any:
        if by_hand is not None and by_hand not in _failed and _plain(args):
            try:
                return by_hand(*args)
            except (OSError, subprocess.CalledProcessError) as error:
                log.warning("%s does not compile here (%s); torch compiles it instead", by_hand.__name__, type(error).__name__)
                _failed.add(by_hand)
        return compiled()(*args)

    @wraps(function)
    def call(*args: Any) -> Any:
        return (whole if _fused.get() else separate)(*args)

    return cast(F, call)
