"""Dose and response: errors of filters over a setting that a study varies."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from pfbench.report.board.entries import ViewKey
from pfbench.report.journal.study_pack import ALL
from pfbench.results.conditions import parse_label
from pfbench.results.looks import MethodLook

_MIN_VALUES = 2  # of a setting


class LabelSetting(NamedTuple):
    """A setting in the label of a filter, such as "particles" of "sir[particles=100]".

    Attributes:
        label: Label of the filter.
        line: Method with its other settings.
        name: Name of the setting.
        value: Value as text.
    """

    label: str
    line: str
    name: str
    value: str


def list_sweeps(
    views: Mapping[ViewKey, Mapping[str, Any]], looks: Mapping[str, MethodLook], metric: str
) -> list[dict[str, Any]]:
    """List the settings that a study varies, with the errors of the filters in each condition.

    Filters without the setting are constant lines.
    """
    settings = [item for label in looks for item in read_settings(label)]
    sweeps = []
    cells = {key[1:3]: view for key, view in views.items() if key.metric == metric}
    for name in dict.fromkeys(item.name for item in settings):
        members = [item for item in settings if item.name == name]
        values = list(dict.fromkeys(item.value for item in members))
        if len(values) < _MIN_VALUES:
            continue
        numbers = [number for value in values if (number := _to_number(value)) is not None]
        is_number = len(numbers) == len(values)
        x = {value: numbers[k] if is_number else float(k) for k, value in enumerate(values)}
        for (world, regime), view in cells.items():
            rows = {row["filter"]: row for row in view["rows"] if row["value"] is not None}
            lines = _list_lines(members, rows, x, looks)
            if ALL not in (world, regime) and lines:
                sweeps.append({
                    "name": name, "world": world, "regime": regime, "unit": "",
                    "ticks": None if is_number else values, "value_unit": _find_unit(rows),
                    "lines": lines, "caption": f"Error of a run against {name}.",
                })  # fmt: skip
    return sweeps


def read_settings(label: str) -> list[LabelSetting]:
    """Read the settings of a label."""
    method, values = parse_label(label)
    settings = []
    for name, value in values.items():
        others = ",".join(f"{key}={text}" for key, text in values.items() if key != name)
        line = f"{method}[{others}]" if others else method
        settings.append(LabelSetting(label, line, name, value))
    return settings


def _list_lines(
    members: list[LabelSetting],
    rows: Mapping[str, Mapping[str, Any]],
    x: Mapping[str, float],
    looks: Mapping[str, MethodLook],
) -> list[dict[str, Any]]:
    """List the points of each method in one condition; none if no method has several values."""
    lines: dict[str, list[LabelSetting]] = {}
    for item in members:
        if item.label in rows:
            lines.setdefault(item.line, []).append(item)
    if max(map(len, lines.values()), default=0) < _MIN_VALUES:
        return []
    entries: list[dict[str, Any]] = [
        {
            "filter": items[0].label,
            "name": _name_line(line, looks[items[0].label]),
            "points": [_point(x[item.value], rows[item.label]) for item in sorted(items, key=lambda item: x[item.value])],
        }
        for line, items in lines.items()
    ]  # fmt: skip
    swept = {item.label for item in members}
    ends = min(x.values()), max(x.values())
    for label, row in rows.items():
        if label not in swept:
            points = [_point(end, row) for end in ends]
            entries.append({"filter": label, "name": looks[label].name, "points": points})
    return entries


def _name_line(line: str, look: MethodLook) -> str:
    """Return the name of a method with its other settings."""
    _, _, others = line.partition("[")
    name = look.name.partition(" [")[0]
    return f"{name} [{others}" if others else name


def _point(x: float, row: Mapping[str, Any]) -> dict[str, Any]:
    return {"x": x, **{name: row[name] for name in ("value", "low", "high")}}


def _find_unit(rows: Mapping[str, Mapping[str, Any]]) -> str:
    return next((str(row["unit"]) for row in rows.values() if row["unit"]), "")


def _to_number(text: str) -> float | None:
    """Return the number of a text, or None."""
    try:
        return float(text)
    except ValueError:
        return None
