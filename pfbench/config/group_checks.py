"""Checks of the groups of a configuration that hold for all classes: a class, finite numbers, no circles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pfbench.results.config_key import list_not_finite

if TYPE_CHECKING:
    from omegaconf import DictConfig

_CIRCLES = ("Recursive interpolation", "Interpolation to parent node")  # messages of OmegaConf


def resolve_values(tree: DictConfig | Mapping[str, Any]) -> dict[str, Any]:
    """Resolve all interpolations of a configuration.

    Args:
        tree: Configuration.

    Returns:
        Nested plain dictionary.

    Raises:
        ValueError: If a value refers to itself.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import InterpolationResolutionError

    try:
        values = OmegaConf.to_container(tree, resolve=True)
    except InterpolationResolutionError as error:
        text, key = str(error), error.full_key
        if not key or not text.startswith(_CIRCLES):
            raise
        parent: Any = OmegaConf.to_container(error.parent_node, resolve=False)
        value = parent[error.key]
        raise ValueError(
            f"{key} must not refer to itself, got {value}, which leads back to {key}. "
            f"Set {key} to a value."
        ) from error
    assert isinstance(values, dict)
    return {str(key): value for key, value in values.items()}


def check_groups(values: Mapping[str, Any], groups: Sequence[str]) -> None:
    """Check that each group names a class and has finite numbers only.

    Args:
        values: Resolved configuration.
        groups: Groups to check. One that is missing is skipped.

    Raises:
        ValueError: If a group is not a dictionary with `_target_`, or a number is not finite.
    """
    for group in groups:
        node = values.get(group, {"_target_": None})
        if not isinstance(node, Mapping) or "_target_" not in node:
            is_text = isinstance(node, Mapping) and set(node.values()) == {None}  # Hydra's reading
            content = ", ".join(map(str, node)) if is_text else repr(node)
            raise ValueError(
                f"{group} must be keys and values with the key _target_, got {content:.80}. Write "
                f"_target_: CLASS into its file, or choose another one: pfbench list {group}"
            )
        for key, value in list_not_finite(node, group):
            raise ValueError(f"{key} must be finite, got {value}. Set {key} to a number.")
