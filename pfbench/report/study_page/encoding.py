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
        "views": _encode_views(pack["views"]),
        "curves": {key: _encode_curves(cell) for key, cell in pack["curves"].items()},
        "runs": {key: _encode_runs(cell) for key, cell in pack["runs"].items()},
    }
    counts = [len(cell["numbers"]) for cell in pack["tracks"].values()]
    carried = max(counts, default=0)
    while True:
        tracks = {k: _encode_tracks(cell, carried) for k, cell in pack["tracks"].items()}
        text = _compress({**base, "tracks": tracks if carried else {}})
        if len(text) <= limit or carried == 0:
            return text
        carried = carried - 1 if carried <= 4 else int(carried * max(0.5, limit / len(text)))


def _compress(pack: Mapping[str, Any]) -> str:
    """Return the pack as JSON, gzip and base64, with the same bytes for equal content."""
    text = json.dumps(pack, separators=(",", ":"), allow_nan=False, ensure_ascii=False)
    return base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode("ascii")


def _encode_views(views: Mapping[str, Any]) -> dict[str, Any]:
    """Encode views as columns, once for all baselines of a scope where they agree."""
    scopes: dict[str, dict[str, Any]] = {}
    for key, view in views.items():
        scope, _, baseline = key.rpartition("/")
        rows = view["rows"]
        columns = {name: [row[name] for row in rows] for name in rows[0]} if rows else {}
        texts = {name: value for name, value in view.items() if name != "rows"}
        scopes.setdefault(scope, {})[baseline] = {**texts, "columns": columns}
    for scope, parts in scopes.items():
        first, *others = parts.values()
        shared = {
            name: column
            for name, column in first["columns"].items()
            if all(view["columns"].get(name) == column for view in others)
        }
        separate = {
            baseline: {
                **view,
                "columns": {k: v for k, v in view["columns"].items() if k not in shared},
            }
            for baseline, view in parts.items()
        }
        scopes[scope] = {"shared": shared, "baselines": separate}
    return scopes


def _encode_curves(cell: Mapping[str, Any]) -> dict[str, Any]:
    """Encode the quantiles of all filters in one condition."""
    names = ("median", "q10", "q90")
    filters = {
        key: encode_levels([curve[name] for name in names], is_smooth=True)
        for key, curve in cell["filters"].items()
    }
    return {**cell, "filters": filters}


def _encode_runs(cell: Mapping[str, Any]) -> dict[str, Any]:
    """Encode the numbers of all runs in one condition."""
    values = {key: encode_levels(runs, bits=12) for key, runs in cell["values"].items()}
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
            k: np.round(track, 1).tolist()
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
