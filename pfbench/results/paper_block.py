"""The node `paper` of configuration files, the folders in which they lie, and the pairs that it plans."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from functools import cache
from itertools import combinations
from pathlib import Path
from textwrap import dedent
from typing import Any

import yaml

import pfbench
from pfbench.core.parameter_checks import require

# A scenario, a noise regime or a filter may have the node `paper`. It is not passed to the class of the part
# and does not enter the key of a job. It belongs to its own file: a part that another part contains
# does not have it.

PARTS = ("scenario", "noise", "filter")
PAPER = "paper"

FAMILIES = ("kalman", "particle", "gaussian", "guided", "swarm", "learned")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "<", ">", "p", "h")  # of matplotlib
# form of a method: to the letter of its paper, as printed with named completions, repaired, another, or with tuned knobs
METHOD_FORMS = ("literal", "printed", "repaired", "variant", "tuned")
_COLOUR = re.compile(r"#[0-9a-f]{6}")
# entries of `cites`, keys that the paper states, and of `completions`, keys that it does not state or that are read
# otherwise than `printed`: each with keys of the filter and a text
_ENTRIES = {"cites": ({"keys", "place"}, set()), "completions": ({"keys", "why"}, {"printed"})}

# keys of the node by part, each with its requirement
_TEXTS = ("name", "long_name", "summary", "words", "cite", "family", "tuning", "form_of")
_KEYS = {
    "scenario": ("name", "words", "family", "divergence_threshold"),
    "noise": ("name", "words", "family"),
    "filter": (
        "name", "long_name", "summary", "family", "proposed", "form", "form_of", "colour", "marker", "cite",
        "baselines", "knob", "tuning", "cites", "completions",
    ),
}  # fmt: skip


def check_paper_blocks(values: Mapping[str, Any]) -> None:
    """Check the nodes `paper` of a configuration."""
    for group in PARTS:
        node = values.get(group)
        block = node.get(PAPER) if isinstance(node, Mapping) else None
        if block is None:
            continue
        require(
            isinstance(block, Mapping),
            f"{group}.paper",
            "be a dictionary",
            f"{block!r}",
            "Remove it.",
        )
        for key, value in block.items():
            require(
                key in _KEYS[group],
                f"{group}.paper",
                f"have keys of {', '.join(_KEYS[group])}",
                f"{key!r}",
                "Remove or rename it.",
            )
            requirement = _requirement(group, key, value)
            require(not requirement, f"{group}.paper.{key}", f"be {requirement}", f"{value!r}", "Change it.")  # fmt: skip


def remove_nested_blocks(values: Mapping[str, Any]) -> dict[str, Any]:
    """Remove the nodes `paper` of parts that other parts contain, such as a guide filter.

    Returns configuration with the nodes of scenario, noise and filter themselves only.
    """
    return {
        key: {k: v if k == PAPER else remove_all_blocks(v) for k, v in node.items()}
        if key in PARTS and isinstance(node, Mapping)
        else node
        for key, node in values.items()
    }


def remove_all_blocks(node: Any) -> Any:
    """Remove all nodes `paper` from a part, those of parts inside it included.

    Returns the part without these nodes.
    """
    if isinstance(node, list):
        return [remove_all_blocks(item) for item in node]
    if not isinstance(node, Mapping):
        return node
    return {key: remove_all_blocks(value) for key, value in node.items() if key != PAPER}


def _requirement(group: str, key: str, value: Any) -> str:
    """Return the requirement that a value does not meet, empty if it does."""
    if value is None:
        return ""
    is_text = isinstance(value, str)
    required, optional = _ENTRIES.get(key, (set(), set()))
    entries = ", ".join(sorted(required)) + "".join(f", perhaps {name}" for name in optional)
    is_list = key not in _ENTRIES or _is_list_of_entries(value, required, optional)
    faults = (
        (key == "divergence_threshold" and not _is_positive(value), "finite and positive, or null for a scenario without this limit"),
        (key in _TEXTS and not is_text, "a text"),
        (key in ("name", "family") and is_text and not value.strip(), "a name"),
        (group == "filter" and key == "family" and value not in FAMILIES, f"one of {', '.join(FAMILIES)}"),
        (key == "proposed" and not isinstance(value, bool), "true or false"),
        (key == "marker" and value not in MARKERS, f"one of {' '.join(MARKERS)}"),
        (key == "colour" and not _is_colour_pair(value), "two colours such as '#0b4f8a', for white and for dark ground"),
        (key == "form" and value not in METHOD_FORMS, f"one of {', '.join(METHOD_FORMS)}"),
        (not is_list, f"a list of entries with {entries}: keys a list of names, all others texts"),
        (key == "knob" and not (isinstance(value, Mapping) and set(value) == {"key", "values"}), "the key of a parameter, and the values to try"),
        (key == "baselines" and not _is_list_of_names(value), "a list of filters"),
    )  # fmt: skip
    return next((requirement for is_fault, requirement in faults if is_fault), "")


def _is_colour_pair(value: Any) -> bool:
    """Return whether a value is a list of two colours."""
    return _is_list_of_names(value) and len(value) == 2 and all(map(_COLOUR.fullmatch, value))


def _is_list_of_entries(value: Any, required: set[str], optional: set[str]) -> bool:
    """Return whether a value is a list of dictionaries with lists of keys and texts."""
    return isinstance(value, list | tuple) and all(
        isinstance(entry, Mapping)
        and required <= set(entry) <= required | optional
        and bool(entry["keys"])
        and _is_list_of_names(entry["keys"])
        and all(isinstance(entry[name], str) for name in entry if name != "keys")
        for entry in value
    )


def _is_list_of_names(value: Any) -> bool:
    """Return whether a value is a list of texts."""
    return isinstance(value, list | tuple) and all(isinstance(item, str) for item in value)


def _is_positive(value: Any) -> bool:
    """Return whether a value is a finite positive number."""
    return type(value) in (int, float) and math.isfinite(value) and value > 0.0


# --------------------------------------------------------------------------------------------------
# Words for the world in which a filter was tuned: in its name, and in the data that a result stores.

OWN_WORLD = "the world of each job"  # data of a tuned filter before a job chooses them
_DATA = re.compile(r"(?:^|\), )(\w+) \(model (\w+)[,)]")  # as `describe_world` writes it
_MARK = re.compile(r" \(tuned(?: on ([^()]*))?\)")


def add_world(name: str, world: str) -> str:
    """Return the name of a tuned filter with the world of its tuning."""
    settings = _MARK.search(name)
    tail = name[settings.end() :] if settings else ""
    head = name[: settings.start()] if settings else name
    return f"{head} (tuned on {world}){tail}"


def read_world(name: str) -> str:
    """Return the words for the world in the name of a filter, empty for one without."""
    stated = _MARK.search(name)
    return (stated[1] or "") if stated else ""


def list_tuned_worlds(data: str) -> dict[str, str]:
    """List the worlds that the data of a tuning state: models by scenario."""
    return dict(_DATA.findall(data))


def find_foreign_world(data: str, scenario: str, model: str = "") -> str:
    """Return the words for the world of a tuning, empty if it is that of the job or not stated."""
    stated = list_tuned_worlds(data)
    if not stated or (scenario in stated and model in ("", stated[scenario])):
        return ""
    name = scenario if scenario in stated else min(stated)
    return name_world({"scenario": name, "model": stated[name]}, {"scenario": scenario})


def name_world(world: Mapping[str, Any], choices: Mapping[str, str]) -> str:
    """Name the world of a tuning; its model only where the scenario is the same."""
    scenario, model = world.get("scenario", ""), world.get("model", "another model")
    return f"{scenario} with {model}" if scenario == choices.get("scenario") else f"{scenario}"


def describe_foreign(values: Mapping[str, Any]) -> str:
    """Return " (tuned on WORLD)" for a filter with the knobs of another world; empty for another filter."""
    words = _MARK.search((values["filter"].get(PAPER) or {}).get("name", ""))
    return f" (tuned on {words[1]})" if words and words[1] else ""


# --------------------------------------------------------------------------------------------------
# Nodes `paper` as the installed configuration files state them, without composition.

_TUNED_DATA = "${tuned.data}"  # of a filter whose knobs are those of the group `tuned`
_NODE = re.compile(rf"^{PAPER}:.*\n(?:[ \t]+.*\n?|[ \t]*\n)*", re.MULTILINE)


@cache
def read_paper_block(group: str, name: str) -> Mapping[str, Any]:
    """Read the node `paper` of an installed file; a variant does not inherit that of its parent."""
    node = _NODE.search(read_part(group, name))
    block = (yaml.safe_load(node.group())[PAPER] or {}) if node else {}
    is_open = block.get("tuning") == _TUNED_DATA
    return {**block, "tuning": OWN_WORLD} if is_open else block


def read_stored_block(meta: Mapping[str, Any], group: str) -> Mapping[str, Any]:
    """Return the node `paper` that the metadata of a result store; empty without one."""
    node = meta.get("config", {}).get(group)
    block = node.get(PAPER) if isinstance(node, Mapping) else None
    return block if isinstance(block, Mapping) else {}


def plan_installed_pairs(labels: Collection[str]) -> list[tuple[str, str]]:
    """List the planned pairs of filters by the baselines that installed files state."""
    methods = {parse_label(label)[0] for label in labels}
    blocks = {method: read_paper_block("filter", method) for method in methods}
    tuned = sorted(m for m, b in blocks.items() if b.get("tuning") and not b["proposed"])
    return list_planned_pairs(
        labels, {method: block.get("baselines", ()) for method, block in blocks.items()}, tuned
    )


# --------------------------------------------------------------------------------------------------
# Installed configuration files: their folders, and their texts by group and name. A file in the folder `families` of a group has several names as
# keys, each with its description, as if each were a file. They are in Hydra's store (`pfbench.job.config`).

FAMILY_FOLDER = "families"
_ENTRY = re.compile(r"^(\w+):  # (.*)\n((?:  .*\n)*)", re.MULTILINE)


@cache
def read_families(group: str) -> Mapping[str, str]:
    """Read the texts in the families of a group by name, each as that of a file of its own."""
    files = [
        path.read_text("utf-8") for path in (conf_dir() / group / FAMILY_FOLDER).glob("*.yaml")
    ]
    return {
        name: f"# {about}\n{dedent(body)}"
        for text in files
        for name, about, body in _ENTRY.findall(text)
    }


def list_named_parts(group: str) -> list[str]:
    """List the names of a group: those of its installed files and of its families."""
    return sorted(
        {*(path.stem for path in _group_dir(group).glob("*.yaml")), *read_families(group)}
    )


def read_part(group: str, name: str) -> str:
    """Read the text of an installed file, empty if there is none."""
    path = _group_dir(group) / f"{name}.yaml"
    if re.fullmatch(r"\w+", name) and path.is_file():
        return path.read_text(encoding="utf-8")
    return read_families(group).get(name, "")


def _group_dir(group: str) -> Path:
    """Return the folder of a group."""
    return experiments_dir() if group == "experiment" else conf_dir() / group


def conf_dir() -> Path:
    """Return the folder of configurations, of the installed package or of the checkout."""
    return _find_folder("conf", "config.yaml")


def experiments_dir() -> Path:
    """Return the folder of experiments, of the installed package or of the checkout."""
    return _find_folder("experiments", "quickstart.yaml")


def name_run_command(study: str) -> str:
    """Return the command that runs the jobs of a study: its experiment, or words to complete."""
    if (experiments_dir() / f"{study}.yaml").is_file():
        return f"pfbench run -m +experiment={study}"
    return f"pfbench run study={study} scenario=NAME noise=NAME filter=NAME"


def _find_folder(name: str, marker: str) -> Path:
    """Return the folder inside or next to the package that contains the marker file."""
    package = Path(pfbench.__file__).resolve().parent
    for folder in (package / name, package.parent / name):
        if (folder / marker).exists():
            return folder
    raise FileNotFoundError(
        f"{name}/{marker} must be inside or next to {package}, got neither. Reinstall pfbench."
    )


def parse_label(label: str) -> tuple[str, dict[str, str]]:
    """Split a label into its name and its settings.

    Returns name, and values as text by setting.
    """
    name, _, text = label.partition("[")
    pairs = re.split(r",(?=[\w.]+=)", text.removesuffix("]")) if text else []
    return name, {key: value for key, _, value in (pair.partition("=") for pair in pairs)}


# --------------------------------------------------------------------------------------------------
# Planned pairs of a study: proposed methods against the baselines of their papers and tuned ones.

_FEW = 5  # filters up to which all pairs are planned if no proposed method is compared
# filters that measure the others, the first that a study has: the tuned control, EKF, SIR
REFERENCES = ("ekf_scaled_tuned", "ekf", "sir")


def list_planned_pairs(
    labels: Collection[str], baselines: Mapping[str, Sequence[str]], tuned: Collection[str] = ()
) -> list[tuple[str, str]]:
    """List the planned pairs of a study.

    Where a study varies a setting, the filters of a pair have the same value of it. A filter without
    the setting is compared with each value.
    """
    from pfbench.stats.study_runs import (
        natural_sort_key,
    )  # on use: numpy, without which the command line starts

    if len(set(labels)) < 2:
        return []
    labels = sorted(set(labels), key=natural_sort_key)
    methods = {label: parse_label(label)[0] for label in labels}
    against = {m: (*baselines[m], *tuned) for m in methods.values() if baselines.get(m)}
    pairs = [
        (label, baseline)
        for label in labels
        for method in dict.fromkeys(against.get(methods[label], ()))
        for baseline in _same_settings(label, method, labels)
    ]
    if pairs:
        return pairs
    if len(labels) <= _FEW:
        return list(combinations(labels, 2))
    reference = next((name for name in REFERENCES if name in methods.values()), "")
    return [
        (label, baseline)
        for label in labels
        if methods[label] != reference
        for baseline in _same_settings(label, reference, labels)
    ]


def _same_settings(label: str, method: str, labels: Sequence[str]) -> list[str]:
    """List the labels of a method that do not differ in a setting that a label has too."""
    settings = parse_label(label)[1]
    candidates = {candidate: parse_label(candidate) for candidate in labels}
    return [
        candidate
        for candidate, (name, values) in candidates.items()
        if name == method
        and all(settings.get(key, value) == value for key, value in values.items())
    ]
