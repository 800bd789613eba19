"""Compression of the data of a report page: logarithmic codes of one or two bytes, gzip, base64.

A page of 33 filters, 28 conditions and 100 runs has millions of numbers. A figure of 400 pixels needs
256 levels of each, on the logarithmic scale that it has.
"""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Levels = NDArray[np.int64]
_MANY_RUNS = 30_000  # of all filters and conditions, from which a run has one byte


def encode_pack(pack: Mapping[str, Any], limit: int) -> str:
    """Encode the pack of a page.

    The tracks of single runs are the largest part. If the text exceeds the limit, the page carries
    fewer runs of each condition, in the order of the pack.

    Args:
        pack: Data of the page, as `pfbench.report.board` makes it.
        limit: Greatest number of characters.

    Returns:
        Text in base64.
    """
    base = {
        **pack,
        "opening": list(next(iter(pack["views"]))),
        "views": _encode_views(pack["views"]),
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
        text = _compress({**base, "tracks": _nest(tracks) if carried else {}})
        if len(text) <= limit or carried == 0:
            return text
        carried = carried - 1 if carried <= 4 else int(carried * max(0.5, limit / len(text)))


def _compress(pack: Mapping[str, Any]) -> str:
    """Return the pack as JSON, gzip and base64, with the same bytes for equal content."""
    text = json.dumps(pack, separators=(",", ":"), allow_nan=False, ensure_ascii=False)
    return base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode("ascii")


def _nest(values: Mapping[tuple[str, ...], Any]) -> dict[str, Any]:
    """Nest values by the parts of their keys."""
    nested: dict[str, Any] = {}
    for key, value in values.items():
        level = nested
        for name in key[:-1]:
            level = level.setdefault(name, {})
        level[key[-1]] = value
    return nested


def _encode_views(views: Mapping[tuple[str, ...], Any]) -> dict[str, Any]:
    """Encode views as columns, which compress better side by side than view by view.

    Returns:
        Keys of the scopes, baselines, texts by scope and baseline, and columns by scope: `shared` if
        they are the same for all baselines, else `separate`.
    """
    scopes: dict[tuple[str, ...], dict[str, Any]] = {}
    for key, view in views.items():
        scopes.setdefault(tuple(key[:-1]), {})[key[-1]] = view
    baselines = list(next(iter(scopes.values())))
    tables = [[view["rows"] for view in scope.values()] for scope in scopes.values()]
    columns: dict[str, dict[str, Any]] = {"shared": {}, "separate": {}}
    for name in tables[0][0][0] if tables[0][0] else ():
        values = [[[row[name] for row in rows] for rows in scope] for scope in tables]
        is_shared = all(column == scope[0] for scope in values for column in scope)
        kind = "shared" if is_shared else "separate"
        columns[kind][name] = [scope[0] for scope in values] if is_shared else values
    texts = [[_drop_rows(view) for view in scope.values()] for scope in scopes.values()]
    return {
        "keys": [list(key) for key in scopes],
        "baselines": baselines,
        "texts": texts,
        **columns,
    }


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


def encode_levels(
    values: Sequence[Any], bits: int = 8, *, is_signed: bool = False, is_smooth: bool = False
) -> dict[str, Any]:
    """Encode numbers as levels of equal ratio. Level 0 is a missing value.

    Args:
        values: Numbers, None or NaN where missing. Nested lists are flattened in the page.
        bits: 8, or up to 16 in two bytes.
        is_signed: Numbers of both signs: the upper half of the levels is positive, the middle is 0.
        is_smooth: Store differences of neighbouring levels, which compress better for curves.

    Returns:
        Range of the absolute values, number of bits, flags and levels in base64.
    """
    numbers = np.array(values, dtype=float).ravel()
    size = np.abs(numbers)
    usable = np.isfinite(size) & (size > 0)
    low, high = (
        (float(size[usable].min()), float(size[usable].max())) if usable.any() else (1.0, 1.0)
    )
    if is_signed:
        low = max(low, high / 1e4)
    low, high = float(f"{low:.4g}"), max(float(f"{high:.4g}"), float(f"{low:.4g}") * (1 + 1e-9))
    top = 2 ** (bits - 1) - 1 if is_signed else 2**bits - 1
    share = np.log(np.clip(size, low, high) / low) / np.log(high / low)
    levels = np.where(usable, 1 + np.rint(share * (top - 1)), 0).astype(np.int64)
    if is_signed:
        middle = 2 ** (bits - 1)
        levels = np.where(np.isfinite(size), middle + np.sign(numbers) * levels, 0).astype(np.int64)
    code: dict[str, Any] = {"l": low, "h": high, "b": _pack_levels(levels, bits, is_smooth)}
    code |= {"w": bits} if bits > 8 else {}
    code |= {"s": 1} if is_signed else {}
    return code | ({"d": 1} if is_smooth else {})


def _pack_levels(levels: Levels, bits: int, is_smooth: bool) -> str:
    """Return levels as bytes in base64; of two bytes, all upper ones first."""
    if is_smooth:
        levels = np.diff(levels, prepend=0) % 2**bits
    if bits == 8:
        packed = levels.astype(np.uint8).tobytes()
    else:
        packed = (levels >> 8).astype(np.uint8).tobytes() + (levels & 255).astype(
            np.uint8
        ).tobytes()
    return base64.b64encode(packed).decode("ascii")
