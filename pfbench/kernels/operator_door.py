"""Doors of the operators: the checks of the manifest around functions in Python."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar, cast

from pfbench.kernels.manifest import check_arguments

F = TypeVar("F", bound=Callable[..., Any])


def check_first(kernel: F) -> F:
    """Check the arguments before a kernel runs.

    Args:
        kernel: Function with the name of its operator after an underscore.

    Returns:
        The function with the checks. It raises ValueError for a wrong argument.
    """
    name = kernel.__name__.removeprefix("_")

    @wraps(kernel)
    def call(*args: Any) -> Any:
        check_arguments(name, args)
        return kernel(*args)

    return cast(F, call)


def explain_errors(function: F) -> F:
    """Raise the error of the manifest where the check in C++ refused a call.

    The check is done once, in C++. Only a refused call is checked again, so that its message is that of
    eager mode.

    Args:
        function: Function that calls the operator of its name.

    Returns:
        The function. It raises ValueError for a wrong argument.
    """
    name = function.__name__

    @wraps(function)
    def call(*args: Any) -> Any:
        try:
            return function(*args)
        except (RuntimeError, TypeError, AttributeError, IndexError):
            check_arguments(name, args)
            raise

    return cast(F, call)
