"""Models that fit a scenario: the keys, measured channels and inputs that they read exist.

This module imports torch only where objects are built.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pfbench.job.config import compose_tree, is_simulated_from, list_groups
from pfbench.job.trust import UntrustedConfigError, check_configuration, trusted_packages
from pfbench.results.paper_block import PAPER, remove_all_blocks

_PARTS = ("model", "scenario")


def check_fit(model: Any, scenario: Any, tree: Mapping[str, Any], trusted: Sequence[str]) -> None:
    """Check that a model reads what a scenario provides."""
    from pfbench.core.record import describe_misfit

    if difference := describe_misfit(model, scenario):
        if not type(model).__module__.startswith("pfbench."):
            raise ValueError(
                f"model must fit the scenario: {difference}. Give both classes the same channel_names and input_type."
            )
        raise _refusal(difference, list_fitting_models(tree, trusted))


def explain_error(
    error: Exception,
    tree: Mapping[str, Any],
    trusted: Sequence[str],
    scenario: str = "",
    model: str = "",
) -> Exception:
    """Explain an error of a shipped model that has another scenario than it is made for.

    Returns a refusal with the shipped models that fit. The error itself if there is none, or if the
    model fits this scenario, so that one of its values is wrong. A model without a name is judged by its class.
    """
    target = str(tree["model"].get("_target_"))
    if target.startswith("pfbench.") and not str(tree["scenario"]["_target_"]).startswith(
        "pfbench."
    ):
        return ValueError(
            "model must be given with a scenario of your own, got that of flights. "
            + (
                "Use pfbench.run(scenario, filters, model=...)."
                if str(tree["scenario"]["_target_"]).startswith("own_")
                else "Add model=NAME, or `override /model@_global_.model: NAME` to the defaults of the scenario."
            )
        )
    fitting = list_fitting_models(tree, trusted, scenario)
    is_shipped = model in list_groups()["model"]
    fits = model in fitting if is_shipped else target in fitting.values()
    if not fitting or fits or not target.startswith("pfbench."):
        return error
    cause = error.__cause__ if type(error).__name__ == "InstantiationException" else error
    text = " ".join(f"{cause}".split())
    if missing := re.search(r"Interpolation key '(\S+)' not found full_key: (\S+)", text):
        text = f"{missing[2]} is read from {missing[1]}, which this scenario does not have"
    return _refusal(text.partition(". ")[0], fitting)


def list_fitting_models(
    tree: Mapping[str, Any], trusted: Sequence[str] = (), scenario: str = ""
) -> dict[str, str]:
    """List the models that fit the scenario of a configuration: the shipped ones and those of its search path.

    Returns class of each model by the name of its file.
    """
    names, search_path = _list_names("model", tree)
    # one composition for all: each costs as much as a hundred files
    nodes = compose_tree([search_path, *(f"+model@shipped.{name}={name}" for name in names)])[
        "shipped"
    ]
    plain, models = _plain_values(tree), _plain_values(nodes)
    if is_simulated_from(plain["scenario"], scenario):
        names = [scenario]
    fitting = [name for name in names if is_fitting({**plain, "model": models[name]}, trusted)]
    return {name: str(models[name]["_target_"]) for name in fitting}


def list_fitting_scenarios(words: Sequence[str]) -> list[str]:
    """List the scenarios that fit a model: the shipped ones and those of a search path among the words.

    Returns names of their files.
    """
    fitting = []
    for name in _list_names("scenario", compose_tree(words))[0]:
        tree = compose_tree([f"scenario={name}", *words])
        is_own = tree.hydra.runtime.choices.get("model") == name
        if (is_own or not is_simulated_from(tree["scenario"], name)) and is_fitting(tree):
            fitting.append(name)
    return fitting


def _list_names(group: str, tree: Mapping[str, Any]) -> tuple[list[str], str]:
    """Return the names of a group, those of the search path included, and the word for this path."""
    settings = tree.get("hydra") or {"searchpath": [], "runtime": {"config_sources": []}}
    folders = (Path(source["path"], group) for source in settings["runtime"]["config_sources"])
    names = {path.stem for folder in folders for path in folder.glob("*.yaml")}
    return sorted(
        {*list_groups()[group], *names}
    ), f"hydra.searchpath=[{','.join(settings['searchpath'])}]"


def is_fitting(tree: Mapping[str, Any], trusted: Sequence[str] = ()) -> bool:
    """Return whether model and scenario of a configuration can be built and fit."""
    from omegaconf import OmegaConf

    from pfbench.core.record import describe_misfit

    nodes = OmegaConf.create(_plain_values(tree))
    try:
        resolved = (OmegaConf.to_container(nodes[key], resolve=True) for key in _PARTS)
        model, scenario = (instantiate(_without_data(node), trusted) for node in resolved)
    except UntrustedConfigError:
        raise
    except Exception:  # a key that the scenario does not have, or values of another sensor
        return False
    return not describe_misfit(model, scenario)


def _plain_values(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Return a configuration as plain dictionaries, not resolved, without the settings of Hydra."""
    from omegaconf import OmegaConf

    values: Any = OmegaConf.to_container(tree) if OmegaConf.is_config(tree) else tree
    return {key: node for key, node in values.items() if key != "hydra"}


def _without_data(node: Any) -> Any:
    """Replace what needs recorded data and decides nothing here: a recorded trajectory, a missing folder."""
    if isinstance(node, dict):
        is_recorded = node.get("_target_") == "pfbench.scenario.RecordedTrajectory"
        return None if is_recorded else {key: _without_data(a) for key, a in node.items()}
    return "missing" if node == "???" else node


def _refusal(difference: str, fitting: Mapping[str, str]) -> ValueError:
    """Return the error of a model that does not fit."""
    advice = (
        f"Models that fit: {', '.join(fitting)}. Scenarios of a model: pfbench list scenario model=NAME"
        if fitting
        else "No shipped model fits. Give both the same sensors, for instance velocity_sd."
    )
    return ValueError(f"model must fit the scenario: {difference}. {advice}")


# This module imports Hydra and torch only on use.


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
    values: Mapping[str, Any], names: Sequence[str], trusted: Sequence[str] = (), model: str = ""
) -> tuple[Any, ...]:
    """Build several parts of a configuration, and check that model and scenario fit.

    Returns the objects. The name of the model's file, if it is known, decides whether the model or its values are wrong.
    """
    from omegaconf import OmegaConf

    tree = OmegaConf.create({name: values[name] for name in names})
    parts = {}
    for name in names:
        try:
            parts[name] = instantiate(tree[name], trusted)
        except Exception as error:
            if name != "model" or isinstance(error, UntrustedConfigError):
                raise
            explained = explain_error(error, values, trusted, model=model)
            if explained is error:
                raise
            raise explained from error
    if {"model", "scenario"} <= parts.keys():
        check_fit(parts["model"], parts["scenario"], values, trusted)
    return tuple(parts.values())
