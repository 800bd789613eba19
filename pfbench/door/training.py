"""Training of a filter with a network from Python, as `pfbench train` does it."""

from __future__ import annotations

from typing import Any

from pfbench.core.parameter_checks import require
from pfbench.door.parts import Part, add_changes, format_words, place_words, plain_errors
from pfbench.door.running import list_parts, preserved_process
from pfbench.job.trust import trusting


def train_filter(
    scenario: Any,
    method: Any,
    *,
    objective: str = "vsmc",
    noise: Any = "nominal",
    model: Any = None,
    study: str = "notebook",
    progress: bool = True,
    **settings: Any,
) -> Part:
    """Train the network of a filter, or load it if the same training is finished.

    Training runs have other numbers than those that `run` compares.

    Args:
        scenario: Name, part or class of your own.
        method: Filter with a network, such as `neural_sir`, or the class of a network of your own. It is a module of
            torch, made of a number of features and a dimension of the noise. See `pfbench.filter.LearnedProposal`.
        objective: What is trained for: a name of the group `train`.
        noise: Noise regime.
        model: Model of the filter. That of the scenario by default.
        study: Folder of the checkpoint.
        progress: Whether each epoch prints a line.
        **settings: Settings of the training by key, such as `epochs=20` or `training_runs=64`.

    Returns:
        The filter with its trained weights, for `run`.

    Raises:
        ValueError: If a name or a value is not valid, or the filter has nothing to train. Nothing was trained.
    """
    from pfbench.cli.train import fit_network

    values = {"scenario": scenario, "noise": noise, "model": model, "filter": method}
    parts = [_find_part(group, value) for group, value in values.items() if value is not None]
    words = [word for item in parts for word in item.words()]
    words += [f"train={objective}", *(f"train.{word}" for word in format_words(settings))]
    words += [*format_words({"study": study}), *place_words(parts)]
    packages = [name for item in parts for name in item.packages]
    with plain_errors(words), preserved_process(), trusting(packages):
        path = fit_network(words, print if progress else lambda line: None)
    return add_changes(parts[-1], format_words({"checkpoint": str(path.resolve())}))


def _find_part(group: str, value: Any) -> Part:
    """Return the part of a group that is trained with; several are refused."""
    parts = list_parts(group, value)
    require(
        not len(parts) > 1,
        group,
        f"be one {group}",
        len(parts),
        "Train with each in a call of its own.",
    )
    return parts[0]
