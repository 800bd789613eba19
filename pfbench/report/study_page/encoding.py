"""Data of a page as text: JSON in gzip and base 64, which every browser reads."""

from __future__ import annotations

import base64
import gzip
import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

_DIGITS = 3  # of the numbers of figures; tables have four


def encode_pack(pack: Mapping[str, Any], limit: int) -> str:
    """Encode the pack of a page.

    The tracks of single runs are the largest part. If the text exceeds the limit, the page carries fewer runs of each
    condition, in the order of the pack.
    """
    base = {
        **pack,
        "opening": list(next(iter(pack["views"]))),
        "views": _encode_views(pack["views"]),
        "curves": _nest(pack["curves"]),
        "calibration": _nest(pack["calibration"]),
        "runs": _nest(pack["runs"]),
    }
    carried = max((len(cell["numbers"]) for cell in pack["tracks"].values()), default=0)
    while True:
        tracks = {key: _select_tracks(cell, carried) for key, cell in pack["tracks"].items()}
        text = compress_pack({**base, "tracks": _nest(tracks) if carried else {}})
        if len(text) <= limit or carried == 0:
            return text
        carried = carried - 1 if carried <= 4 else int(carried * max(0.5, limit / len(text)))


def compress_pack(pack: Mapping[str, Any]) -> str:
    """Compress a pack, with the same text for equal content."""
    text = json.dumps(pack, separators=(",", ":"), allow_nan=False, ensure_ascii=False)
    return base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode("ascii")


def _encode_views(views: Mapping[tuple[str, ...], Any]) -> dict[str, Any]:
    """Encode views: keys, texts, and rows as lists of values in the order of the columns."""
    rows = [row for view in views.values() for row in view["rows"]]
    columns = list(dict.fromkeys(name for row in rows for name in row))
    return {
        "keys": [list(key) for key in views],
        "columns": columns,
        "texts": [{k: v for k, v in view.items() if k != "rows"} for view in views.values()],
        "rows": [[[row.get(name) for name in columns] for row in view["rows"]] for view in views.values()],
    }  # fmt: skip


def _nest(values: Mapping[tuple[str, ...], Any]) -> dict[str, Any]:
    """Nest values by the parts of their keys."""
    nested: dict[str, Any] = {}
    for key, value in values.items():
        level = nested
        for name in key[:-1]:
            level = level.setdefault(name, {})
        level[key[-1]] = value
    return nested


def _select_tracks(cell: Mapping[str, Any], carried: int) -> dict[str, Any]:
    """Select the first runs of one condition: positions, errors and traces over time."""
    numbers = cell["numbers"][:carried]
    keys = [str(number) for number in numbers]

    def select(runs: Mapping[str, Any]) -> dict[str, Any]:
        return {key: _round_all(runs[key]) for key in keys if key in runs}

    selected = {**cell, "numbers": numbers}
    if "truth" in cell:
        selected["truth"] = {
            k: [[x, y] if np.isfinite(x + y) else None for x, y in np.round(track, 1).tolist()]
            for k, track in cell["truth"].items()
            if k in (*keys, "all")
        }
        selected["plane"] = {f: select(runs) for f, runs in cell["plane"].items()}
    selected["error"] = {f: select(runs) for f, runs in cell["error"].items()}
    selected["traces"] = [
        {**trace, "filters": {f: select(runs) for f, runs in trace["filters"].items()}}
        for trace in cell.get("traces", [])
    ]
    return selected


def _round_all(values: Any) -> list[float | None]:
    """Return numbers with three digits in one list; None where they are not finite."""
    flat = np.asarray(values, dtype=np.float64).ravel().tolist()
    return [float(f"{v:.{_DIGITS}g}") if math.isfinite(v) else None for v in flat]
