"""Settings in the labels of filters, in words: "SIR [100]" and "SIR [400]" if only the particles differ."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress

from pfbench.results.job_labels import parse_label


def name_settings(labels: Sequence[str]) -> dict[str, str]:
    """Write the settings of labels in words.

    Args:
        labels: Labels such as "sir" or "sir[particles=100]".

    Returns:
        Text by label, for labels with settings. It has the values alone if all labels have one common
        setting with several numbers or texts. Else it is like "max ratio = 1000, stages = 2".
    """
    settings = {label: _split(label) for label in labels if "[" in label}
    if _find_common_name(settings.values()):
        return {label: pairs[0][1] for label, pairs in settings.items()}
    return {
        label: ", ".join(f"{name} = {value}" for name, value in pairs)
        for label, pairs in settings.items()
    }


def describe_settings(labels: Sequence[str]) -> str:
    """Say what the values in brackets are where names show values alone; else empty.

    Args:
        labels: Labels of all filters.
    """
    name = _find_common_name([_split(label) for label in labels if "[" in label])
    return f"In brackets: {name}." if name else ""


def describe_data_settings(names: Iterable[str]) -> str:
    """Say in which settings of their data scenarios or noise regimes differ; else empty.

    Args:
        names: Keys of scenarios and noise regimes.
    """
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
