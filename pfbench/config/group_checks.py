"""Checks of the groups of a configuration that hold for all classes: a class, finite numbers, no circles."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import TYPE_CHECKING, Any

from pfbench.config.folders import conf_dir
from pfbench.config.trust import UntrustedConfigError
from pfbench.files import limits
from pfbench.results.config_key import list_not_finite

if TYPE_CHECKING:
    from omegaconf import DictConfig

_resolved: ContextVar[list[int] | None] = ContextVar("resolved", default=None)
_CIRCLES = ("Recursive interpolation", "Interpolation to parent node")  # messages of OmegaConf


def resolve_values(tree: DictConfig | Mapping[str, Any]) -> dict[str, Any]:
    """Resolve all interpolations of a configuration.

    Args:
        tree: Configuration.

    Returns:
        Nested plain dictionary.

    Raises:
        ValueError: If a value refers to itself.
        UntrustedConfigError: If values that refer to others become too many or too long.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import InterpolationResolutionError

    try:
        with _bounded_resolution():
            values = OmegaConf.to_container(tree, resolve=True)
    except InterpolationResolutionError as error:
        cause: BaseException | None = error
        while cause is not None and not isinstance(cause, UntrustedConfigError):
            cause = cause.__cause__ or cause.__context__
        if cause is not None:
            raise cause from None
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


@contextmanager
def _bounded_resolution() -> Iterator[None]:
    """Limit what OmegaConf resolves: it resolves a value again each time that another one refers to it."""
    _count_resolved_values()
    token = _resolved.set([0, 0, 0])
    try:
        yield
    finally:
        _resolved.reset(token)


@cache
def _count_resolved_values() -> None:
    """Let OmegaConf count the values and characters that it resolves."""
    from omegaconf.base import Container

    by_omegaconf = Container.resolve_parse_tree

    def resolve(self: Container, *args: Any, **options: Any) -> Any:
        counts = _resolved.get()
        if counts is None:
            return by_omegaconf(self, *args, **options)
        counts[0] += 1
        value = by_omegaconf(self, *args, **options)
        _add_size(getattr(value, "_content", value), counts)
        return value

    Container.resolve_parse_tree = resolve  # type: ignore[method-assign]


def _add_size(value: Any, counts: list[int]) -> None:
    """Add the size of a value to the counts of references, values and characters."""
    counts[1] += 1
    counts[2] += len(value) if isinstance(value, str) else 0
    most = (limits.RESOLVED_REFERENCES, limits.RESOLVED_VALUES, limits.RESOLVED_TEXT)
    if any(count > limit for count, limit in zip(counts, most, strict=True)):
        raise UntrustedConfigError(
            "values that refer to others must have at most {} references, {} values and {} characters "
            "in all, got more. Write fewer references.".format(*most)
        )
    children = (
        value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    )
    for child in children:
        _add_size(getattr(child, "_content", None) or getattr(child, "_val", None), counts)


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
            is_text = isinstance(node, Mapping) and all(
                value is None for value in node.values()
            )  # Hydra's reading
            content = ", ".join(map(str, node)) if is_text else repr(node)
            raise ValueError(
                f"{group} must be keys and values with the key _target_, got {content:.80}. Write "
                f"_target_: CLASS into its file, or choose another one: pfbench list {group}"
            )
        for key, value in list_not_finite(node, group):
            raise ValueError(f"{key} must be finite, got {value}. Set {key} to a number.")


def check_simulated_model(values: Mapping[str, Any], choices: Mapping[str, str]) -> None:
    """Check that a shipped world that is simulated from its model has this model, since it is named by it.

    Args:
        values: Resolved configuration.
        choices: Names of the chosen files by group.

    Raises:
        ValueError: If another model is chosen. The world would be another one under the same name.
    """
    scenario, model = choices.get("scenario", ""), choices.get("model", "")
    if is_simulated_from(values.get("scenario"), scenario) and model != scenario:
        raise ValueError(
            f"model must be {scenario} for scenario={scenario}, which is simulated from it, got {model}. "
            f"Choose scenario={model} if it exists (pfbench list scenario), or write a scenario of your own with "
            "_target_: pfbench.scenario.ModelSimulation."
        )


def is_simulated_from(scenario: Any, name: str) -> bool:
    """Return whether a scenario is a shipped one that is simulated from the model of the same name.

    Args:
        scenario: Node of the scenario.
        name: Name of its file.
    """
    target = scenario.get("_target_") if isinstance(scenario, Mapping) else None
    is_shipped = (conf_dir() / "scenario" / f"{name}.yaml").is_file()
    return target == "pfbench.scenario.ModelSimulation" and is_shipped
