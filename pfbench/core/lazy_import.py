"""Lazy import of the public names of a package."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any


def lazy_attributes(
    package: str, modules: Mapping[str, Sequence[str]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Make the module functions `__getattr__` and `__dir__` of a package that imports on first use.

    A package door would otherwise import every module, torch included, for a single name.

    Args:
        package: Name of the package.
        modules: Public names by module, relative to the package: `base`, or `.core.normal` for a
            module of the parent package.

    Returns:
        `__getattr__` and `__dir__` (PEP 562).
    """
    homes = {name: module for module, names in modules.items() for name in names}

    def get_attribute(name: str) -> Any:
        if name not in homes:
            raise AttributeError(
                f"{package} does not define {name!r}. Choose a name of dir({package})."
            )
        return getattr(importlib.import_module(f".{homes[name]}", package), name)

    def list_names() -> list[str]:
        return sorted(homes)

    return get_attribute, list_names
