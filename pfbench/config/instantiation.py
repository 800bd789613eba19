"""Objects of a configuration, and which models fit a scenario.

This module imports Hydra and torch only on use.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

from pfbench.config.paper_block import PAPER, remove_all_blocks
from pfbench.config.trust import UntrustedConfigError, check_configuration, trusted_packages


def instantiate(node: Any, trusted: Sequence[str] = ()) -> Any:
    """Build the object that a node names by `_target_`. Lists and dicts become plain ones.

    Args:
        node: Node of a configuration.
        trusted: Packages that it may name besides pfbench and those of PFBENCH_TRUST.

    Returns:
        The object.

    Raises:
        ValueError: If a name in the node is not public or not trusted.
    """
    import hydra
    from omegaconf import OmegaConf, open_dict

    if OmegaConf.is_dict(node) and PAPER in node:
        node = copy.deepcopy(node)  # which keeps the full key for errors
        with open_dict(node):  # of a composed configuration, whose keys are fixed
            node.pop(PAPER)
    is_config = OmegaConf.is_config(node)
    values = OmegaConf.to_container(node, resolve=True) if is_config else node
    bare = remove_all_blocks(values)
    if bare != values:
        node, values, is_config = bare, bare, False
    check_configuration(values, (*trusted, *trusted_packages()))
    if is_config and OmegaConf.to_container(node, resolve=False) != values:
        node = values  # what was checked: a resolver may give another value next time
    return hydra.utils.instantiate(node, _convert_="all")


def instantiate_parts(
    values: Mapping[str, Any], names: Sequence[str], trusted: Sequence[str] = ()
) -> tuple[Any, ...]:
    """Build several parts of a configuration, and check that model and scenario fit.

    Args:
        values: Resolved configuration. Errors name the full key of a part in it.
        names: Top-level keys of the parts, in the order of their construction.
        trusted: Packages that the parts may name besides pfbench.

    Returns:
        The objects.

    Raises:
        ValueError: If a value is invalid, or the model does not fit the scenario.
    """
    from omegaconf import OmegaConf

    from pfbench.config.model_fit import check_fit, explain_error

    tree = OmegaConf.create({name: values[name] for name in names})
    parts = {}
    for name in names:
        try:
            parts[name] = instantiate(tree[name], trusted)
        except Exception as error:
            if name != "model" or isinstance(error, UntrustedConfigError):
                raise
            explained = explain_error(error, values, trusted)
            if explained is error:
                raise
            raise explained from error
    if {"model", "scenario"} <= parts.keys():
        check_fit(parts["model"], parts["scenario"], values, trusted)
    return tuple(parts.values())
