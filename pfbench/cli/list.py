"""Command `pfbench list`: the files of each configuration group."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

from pfbench.cli.compose import given_keys, read_description
from pfbench.cli.current_folder import list_own_files
from pfbench.cli.messages import suggest_similar
from pfbench.job.config import FILTER_SETS, list_groups

HELP = """\
pfbench list [GROUP] [key=value ...]

List the configuration groups with their files, or the files of a group with their descriptions.

  pfbench list
  pfbench list filter
  pfbench list model scenario=sar_flight     the models that fit a scenario
  pfbench list scenario model=ins_gnss       the scenarios that fit a model"""

_OTHER = {"model": "scenario", "scenario": "model"}


def list_options(words: Sequence[str]) -> None:
    """Print the configuration groups, or the files of one group."""
    groups = list_groups()
    if not words:
        for group, files in groups.items():
            print(f"{group:12} {', '.join(sorted(path.stem for path in files))}")
        print("\nNext: pfbench list GROUP")
        return
    _check_group(words[0], list(groups))
    files = list_files(words[0])
    if len(words) > 1:
        names = _list_fitting(words[0], words[1:])
        files = [path for path in files if path.stem in names]
    for path in files:
        print(f"{path.stem:24} {read_description(path)}")
    if not files:
        print(f"No shipped {words[0]} fits.")


def list_files(group: str) -> list[Path]:
    """List the files of a group, those of the current folder included."""
    return sorted([*list_groups()[group], *list_own_files(group)])


def describe_choices(group: str | None) -> dict[str, str]:
    """Return the descriptions of the files of a group by name, or the groups with their numbers of files."""
    groups = list_groups()
    if group is None:
        return {name: f"{len(list_files(name))} names" for name in groups}
    _check_group(group, list(groups))
    sets = {name: ", ".join(names) for name, names in FILTER_SETS.items()}
    texts = {path.stem: read_description(path) for path in list_files(group)}
    return {**texts, **(sets if group == "filter" else {})}


def _check_group(group: str, groups: Sequence[str]) -> None:
    """Check the name of a group."""
    if group not in groups:
        similar = suggest_similar(group, groups)
        raise ValueError(
            f"group must be one of {', '.join(groups)}, got {group or 'an empty word'}.{similar}"
        )


def _list_fitting(group: str, words: Sequence[str]) -> Collection[str]:
    """List the models or scenarios that fit overrides, which name the other one."""
    from pfbench.job.config import compose_tree
    from pfbench.job.model_fit import list_fitting_models, list_fitting_scenarios

    needed = _OTHER.get(group)
    if needed is None or needed not in given_keys(words):
        example = f"pfbench list {group} {needed}=NAME" if needed else f"pfbench list {group}"
        raise ValueError(f"words must be {example}, got {' '.join(words)}. See pfbench list --help")
    if group == "scenario":
        return list_fitting_scenarios(words)
    tree = compose_tree(words)
    return list_fitting_models(tree, scenario=tree.hydra.runtime.choices["scenario"])
