"""Data of a report page in a compact form: views as columns, numbers as codes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np

from pfbench.report.study_page.number_codes import compress_pack, encode_decimals, encode_levels

_DECIMALS = ("value", "low", "high", "ratio", "ratio_low", "ratio_high")  # columns of a view
_MANY_RUNS = 30_000  # of all filters and conditions, from which a run has one byte


def encode_pack(pack: Mapping[str, Any], limit: int) -> str:
    """Encode the pack of a page.

    The tracks of single runs are the largest part. If the text exceeds the limit, the page carries
    fewer runs of each condition, in the order of the pack.

    Args:
        pack: Data of the page, as `pfbench.report.board` makes it.
        limit: Greatest number of characters.

    Returns:
        Text of `compress_pack`.
    """
    base = {
        **pack,
        "opening": list(next(iter(pack["views"]))),
        "views": encode_views(pack["views"], [look["key"] for look in pack["filters"]]),
        "curves": _nest({key: _encode_curves(cell) for key, cell in pack["curves"].items()}),
        "calibration": _nest(pack["calibration"]),
        "runs": _nest(
            {key: _encode_runs(cell, len(pack["runs"])) for key, cell in pack["runs"].items()}
        ),
    }
    counts = [len(cell["numbers"]) for cell in pack["tracks"].values()]
    carried = max(counts, default=0)
    while True:
        tracks = {k: _encode_tracks(cell, carried) for k, cell in pack["tracks"].items()}
        text = compress_pack({**base, "tracks": _nest(tracks) if carried else {}})
        if len(text) <= limit or carried == 0:
            return text
        carried = carried - 1 if carried <= 4 else int(carried * max(0.5, limit / len(text)))


def _nest(values: Mapping[tuple[str, ...], Any]) -> dict[str, Any]:
    """Nest values by the parts of their keys."""
    nested: dict[str, Any] = {}
    for key, value in values.items():
        level = nested
        for name in key[:-1]:
            level = level.setdefault(name, {})
        level[key[-1]] = value
    return nested


def encode_views(views: Mapping[tuple[str, ...], Any], filters: Sequence[str]) -> dict[str, Any]:
    """Encode views as columns, which compress better side by side than view by view.

    Args:
        views: Views by key. Each has a row of each filter.
        filters: Labels of the filters.

    Returns:
        Keys of the scopes, baselines, texts by scope and baseline, and columns by name. A place is a
        scenario with a regime. `fixed` columns, by place and filter, are the same for all metrics
        and baselines. `shared` ones, by scope and row, are the same for all baselines. All
        others are `separate`, by view and row.
    """
    scopes: dict[tuple[str, ...], dict[str, Any]] = {}
    for key, view in views.items():
        scopes.setdefault(tuple(key[:-1]), {})[key[-1]] = view
    first = next(iter(views.values()))["rows"]
    columns: dict[str, dict[str, Any]] = {"fixed": {}, "shared": {}, "separate": {}}
    for name in first[0] if first else ():
        kind, values = _arrange_column(name, scopes, filters)
        columns[kind][name] = (
            encode_decimals(list(chain.from_iterable(values))) if name in _DECIMALS else values
        )
    return {
        "keys": [list(key) for key in scopes],
        "baselines": list(next(iter(scopes.values()))),
        "texts": [[_drop_rows(view) for view in scope.values()] for scope in scopes.values()],
        **columns,
    }


def _arrange_column(
    name: str, scopes: Mapping[tuple[str, ...], Mapping[str, Any]], filters: Sequence[str]
) -> tuple[str, list[Any]]:
    """Return the kind of a column and its values: by place and filter, scope and row, or view and row."""
    places: dict[tuple[str, ...], dict[str, Any]] = {}
    is_fixed = name not in ("filter", *_DECIMALS)
    separate = []
    for key, scope in scopes.items():
        separate.append([[row[name] for row in view["rows"]] for view in scope.values()])
        for row in (row for view in scope.values() for row in view["rows"]):
            by_filter = places.setdefault(key[1:], {})
            is_fixed = is_fixed and by_filter.setdefault(row["filter"], row[name]) == row[name]
    if is_fixed:
        return "fixed", [[by_filter[label] for label in filters] for by_filter in places.values()]
    if all(column == scope[0] for scope in separate for column in scope):
        return "shared", [scope[0] for scope in separate]
    return "separate", [column for scope in separate for column in scope]


def _drop_rows(view: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in view.items() if name != "rows"}


def _encode_curves(cell: Mapping[str, Any]) -> dict[str, Any]:
    """Encode the quantiles of all filters in one condition."""
    names = ("median", "q10", "q90")
    filters = {
        key: encode_levels([curve[name] for name in names], is_smooth=True)
        for key, curve in cell["filters"].items()
    }
    return {**cell, "filters": filters}


def _encode_runs(cell: Mapping[str, Any], cells: int) -> dict[str, Any]:
    """Encode the numbers of all runs in one condition."""
    count = len(cell["numbers"]) * len(cell["values"])
    bits = 12 if count * cells <= _MANY_RUNS else 8
    values = {key: encode_levels(runs, bits=bits) for key, runs in cell["values"].items()}
    return {**cell, "values": values}


def _encode_tracks(cell: Mapping[str, Any], carried: int) -> dict[str, Any]:
    """Encode the first runs of one condition: positions, errors and traces over time."""
    numbers = cell["numbers"][:carried]
    keys = [str(number) for number in numbers]

    def encode(runs: Mapping[str, Any], **kind: bool) -> dict[str, Any]:
        return {key: encode_levels(runs[key], **kind) for key in keys if key in runs}

    encoded = {**cell, "numbers": numbers}
    if "truth" in cell:
        encoded["truth"] = {
            k: [[x, y] if np.isfinite(x + y) else None for x, y in np.round(track, 1).tolist()]
            for k, track in cell["truth"].items()
            if k in (*keys, "all")
        }
        encoded["plane"] = {f: encode(r, is_signed=True) for f, r in cell["plane"].items()}
    encoded["error"] = {f: encode(r, is_smooth=True) for f, r in cell["error"].items()}
    encoded["traces"] = [
        {**trace, "filters": {f: encode(r, is_smooth=True) for f, r in trace["filters"].items()}}
        for trace in cell.get("traces", [])
    ]
    return encoded
