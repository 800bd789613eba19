"""Names and looks of methods, scenarios and regimes, and words for their settings and tuning."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from pfbench.results.conditions import Condition, main_component_group, parse_label
from pfbench.results.paper_block import (
    MARKERS,
    add_world,
    find_foreign_world,
    list_named_parts,
    list_planned_pairs,
    read_paper_block,
    read_stored_block,
    read_world,
)

# Looks come from the node `paper` of the configuration files. Hue shows the family, shade and marker
# for the method. Marks of proposed methods are filled and their lines solid. Marks of other methods
# are hollow and their lines dashed.

# Colours on white and on dark ground of methods that state none, by family.
_GREY = ("#5f6b76", "#a9b4be")
FAMILY_COLOURS: Mapping[str, tuple[str, str]] = {
    "kalman": ("#44617c", "#9fb8d0"),
    "particle": ("#7c5a44", "#d0b09f"),
    "gaussian": ("#4b6b58", "#a5c4b1"),
    "guided": ("#66578a", "#bcb0d8"),
    "swarm": ("#8a4f70", "#d8aac4"),
    "learned": ("#6b6a3c", "#c2c093"),
}


@dataclass(frozen=True)
class MethodLook:
    """Name and look of a method.

    Attributes:
        key: Label of the filter in results.
        name: Name in tables and figures.
        long_name: Name in full.
        family: Family of the method; empty if it is not stated.
        proposed: Whether a paper of the study proposes the method: filled marks, solid lines.
        colour: Colour on white ground.
        dark_colour: Colour on dark ground.
        marker: Marker of matplotlib.
        cite: Key of the reference, empty without one.
        baselines: Labels of the methods with which its paper compares it.
        tuning: Data on which its parameters were chosen, empty if they were not tuned.
        tuned_on: Words for another world than that of its jobs on which they were chosen, else empty.
    """

    key: str
    name: str
    long_name: str
    family: str = ""
    proposed: bool = False
    colour: str = _GREY[0]
    dark_colour: str = _GREY[1]
    marker: str = MARKERS[0]
    cite: str = ""
    baselines: tuple[str, ...] = ()
    tuning: str = ""
    tuned_on: str = ""


@dataclass(frozen=True)
class PartName:
    """Name of a scenario or a noise regime.

    Attributes:
        key: Key in results.
        name: Name in tables and figures.
        words: Description for a sentence.
        unit: Displayed unit of the main group.
        limit: Error above which a run has lost the track, in SI units; None without a limit.
        family: Scenarios of one trajectory have the same family.
    """

    key: str
    name: str
    words: str
    unit: str = ""
    limit: float | None = None
    family: str = ""


def find_looks(
    labels: Sequence[str], blocks: Mapping[str, Mapping[str, Any]] | None = None
) -> dict[str, MethodLook]:
    """Return the looks of filters.

    Labels of one method with different settings share colour and differ in marker. A label without
    a node `paper` has its label as name, the grey of its family, and the next free marker.
    """
    looks = {}
    settings = name_settings(labels)
    for label in dict.fromkeys(labels):
        method = parse_label(label)[0]
        block = read_paper_block("filter", method) or _own_block(label, blocks or {})
        name = str(block.get("name", method))
        look = _parse_look(label, block)
        text = settings.get(label)
        looks[label] = replace(look, name=_add_text(name, text)) if text else look
    return _separate_markers(looks)


def study_looks(conditions: Sequence[Condition]) -> dict[str, MethodLook]:
    """Return the looks of all filters of a study, also of a user's own filters."""
    blocks: dict[str, Mapping[str, Any]] = {}
    worlds: dict[
        str, dict[str, str]
    ] = {}  # data and other world of tunings, in the order of the conditions
    for condition in conditions:
        for job in condition.jobs:
            blocks[job.label] = block = read_stored_block(job.meta, "filter")
            data, model = (
                str(block.get("tuning") or ""),
                str(job.meta.get("choices", {}).get("model", "")),
            )
            foreign = find_foreign_world(data, parse_label(condition.scenario)[0], model)
            worlds.setdefault(job.label, {})[data] = read_world(str(block.get("name"))) or foreign
    looks = find_looks(sorted(blocks), blocks)
    return {
        label: add_tuning(look, *(", ".join(filter(None, dict.fromkeys(texts))) for texts in (worlds[label], worlds[label].values())))
        for label, look in looks.items()
    }  # fmt: skip


def find_stored_world(look: Mapping[str, Any], scenarios: Collection[str]) -> str:
    """Return the words for another world on which a filter of a stored page was tuned, else empty."""
    worlds = (find_foreign_world(look["tuning"], parse_label(key)[0]) for key in scenarios)
    return str(look.get("tuned_on", next(filter(None, worlds), "")))


def add_tuning(look: MethodLook, data: str, foreign: str) -> MethodLook:
    """Return the look of a tuned filter with the data of its tuning and the name of another world."""
    look = replace(look, tuning=data or look.tuning, tuned_on=foreign)
    if not foreign:
        return look
    name, long_name = (add_world(text, foreign) for text in (look.name, look.long_name))
    return replace(look, name=name, long_name=long_name)


def study_part_names(conditions: Sequence[Condition], group: str) -> dict[str, PartName]:
    """Return the names of the scenarios or regimes of a study."""
    names = {}
    keys = [c.scenario if group == "scenario" else c.noise for c in conditions]
    settings = name_settings(keys)
    for key, condition in zip(keys, conditions, strict=True):
        plain, _ = parse_label(key)
        stored = read_stored_block(condition.jobs[0].meta, group)  # limits that the jobs had
        block, limit = read_paper_block(group, plain) or stored, stored.get("divergence_threshold")
        names[key] = PartName(
            key,
            _add_text(str(block.get("name", plain)), settings.get(key)),
            _add_text(str(block.get("words", plain)), settings.get(key)),
            main_component_group(condition.jobs[0].meta["state"]).unit,
            None if limit is None else float(limit),
            str(stored.get("family") or plain),
        )
    return names


def _add_text(name: str, text: str | None) -> str:
    """Return a name with its settings in brackets."""
    return f"{name} [{text}]" if text else name


def plan_look_pairs(looks: Mapping[str, MethodLook]) -> list[tuple[str, str]]:
    """List the planned pairs of a study."""
    methods = {parse_label(key)[0]: look for key, look in looks.items()}
    tuned = sorted(key for key, look in methods.items() if look.tuning and not look.proposed)
    return list_planned_pairs(looks, {key: look.baselines for key, look in methods.items()}, tuned)


def _parse_look(label: str, block: Mapping[str, Any]) -> MethodLook:
    """Build the look of a label from its node."""
    family = str(block.get("family", ""))
    colours = block.get("colour") or FAMILY_COLOURS.get(family, _GREY)
    return MethodLook(
        key=label,
        name=str(block.get("name", label)),
        long_name=str(block.get("long_name", block.get("name", label))),
        family=family,
        proposed=bool(block.get("proposed", False)),
        colour=str(colours[0]),
        dark_colour=str(colours[1]),
        marker=str(block.get("marker", "")),
        cite=str(block.get("cite", "")),
        baselines=tuple(map(str, block.get("baselines", ()))),
        tuning=str(block.get("tuning", "")),
    )


def _own_block(label: str, blocks: Mapping[str, Mapping[str, Any]]) -> Mapping[str, Any]:
    """Return the stored node of a label, empty if it has the name of another method.

    A file without a node inherits that of the file on which it builds.
    """
    block = blocks.get(label, {})
    method = parse_label(label)[0]
    nodes = [
        *(node for key, node in blocks.items() if parse_label(key)[0] != method),
        *(read_paper_block("filter", key) for key in list_named_parts("filter")),
    ]
    is_inherited = str(block.get("name", "")) in {str(node.get("name")) for node in nodes}
    return {} if is_inherited else block


def _separate_markers(looks: Mapping[str, MethodLook]) -> dict[str, MethodLook]:
    """Give a free marker to looks without one, or with colour and marker of an earlier look."""
    used: set[tuple[str, str]] = set()
    separated = {}
    first = [look for look in looks.values() if look.marker]
    for look in [*first, *(look for look in looks.values() if not look.marker)]:
        free = [m for m in MARKERS if (look.colour, m) not in used]
        is_free = look.marker in free
        marker = look.marker if is_free else (free or list(MARKERS))[0]
        used.add((look.colour, marker))
        separated[look.key] = replace(look, marker=marker)
    return {key: separated[key] for key in looks}


# --------------------------------------------------------------------------------------------------
# Settings in the labels of filters, in words: "SIR [100]" and "SIR [400]" if only the particles differ.


def name_settings(labels: Sequence[str]) -> dict[str, str]:
    """Write the settings of labels in words.

    Returns text by label, for labels with settings. It has the values alone if all labels have one
    common setting with several numbers or texts. Else it is like "max ratio = 1000, stages = 2".
    """
    settings = {label: _split(label) for label in labels if "[" in label}
    if _find_common_name(settings.values()):
        return {label: pairs[0][1] for label, pairs in settings.items()}
    return {
        label: ", ".join(f"{name} = {value}" for name, value in pairs)
        for label, pairs in settings.items()
    }


def describe_settings(labels: Sequence[str]) -> str:
    """Say what the values in brackets are where names show values alone; else empty."""
    name = _find_common_name([_split(label) for label in labels if "[" in label])
    return f"In brackets: {name}." if name else ""


def describe_data_settings(names: Iterable[str]) -> str:
    """Say in which settings of their data scenarios or noise regimes differ; else empty."""
    settings = dict.fromkeys(key for name in names for key, _ in _split(name))
    if not settings:
        return ""
    return (
        f"Conditions in brackets differ in {', '.join(settings)}. Their data differ: "
        "filters are compared within each of them."
    )


def _split(label: str) -> list[tuple[str, str]]:
    """Return the names and values of the settings of a label."""
    pairs = []
    for key, value in parse_label(label)[1].items():
        with suppress(ValueError):  # a text is not a number
            value = f"{float(value):g}"
        pairs.append((key.rpartition(".")[2].replace("_", " "), value))
    return pairs


def _find_common_name(settings: Iterable[list[tuple[str, str]]]) -> str:
    """Return the name of the only setting of all labels; empty for several, one value, or a switch."""
    pairs = {pair for item in settings for pair in item}
    names, values = {name for name, _ in pairs}, {value for _, value in pairs}
    is_clear = len(names) == 1 and len(values) > 1 and not values & {"True", "False", ""}
    return names.pop() if is_clear else ""


# --------------------------------------------------------------------------------------------------
# Filters with tuned parameters: their numbers, and the sentences that state them.

NOT_TUNED_HERE = "Not tuned here:"  # start of the line on knobs of another world


def count_tuned(looks: Mapping[str, MethodLook]) -> dict[str, int]:
    """Count the filters with tuned parameters, by the data on which they were tuned.

    Args:
        looks: Looks of all filters of a study.
    """
    return dict(sorted(Counter(look.tuning for look in looks.values() if look.tuning).items()))


def describe_tuning(tuned: Mapping[str, int], filters: int) -> str:
    """Say how many filters have tuned parameters, and on which data; empty if none has."""
    return " ".join(
        f"Parameters of {number} of {filters} filters were tuned on {data}."
        for data, number in tuned.items()
    )


def describe_foreign_knobs(worlds: Collection[str]) -> str:
    """Say that tuned filters of a page were tuned on other worlds; empty if none was."""
    names = sorted({world for world in worlds if world})
    number = sum(bool(world) for world in worlds)
    return (
        f"{NOT_TUNED_HERE} {number} {'filter has' if number == 1 else 'filters have'} the knobs of another world, "
        f"{', '.join(names)}. What is said of them holds for these knobs, until the study has run again with its own."
        if names else ""
    )  # fmt: skip
