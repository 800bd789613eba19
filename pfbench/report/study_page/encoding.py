"""Data of a report page in a compact form: views as columns, numbers as codes."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

_DECIMALS = ("value", "low", "high", "ratio", "ratio_low", "ratio_high")  # columns of a view
_MANY_RUNS = 30_000  # of all filters and conditions, from which a run has one byte


def encode_pack(pack: Mapping[str, Any], limit: int) -> str:
    """Encode the pack of a page.

    The tracks of single runs are the largest part. If the text exceeds the limit, the page carries
    fewer runs of each condition, in the order of the pack.

    Returns text of `compress_pack`.
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
    """Encode views as columns, which compress better side by side than view by view."""
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


# --------------------------------------------------------------------------------------------------
# Codes of the numbers of a report page: levels of equal ratio, decimals, and their compression.
#
# A page of 33 filters, 28 conditions and 100 runs has millions of numbers. A figure of 400 pixels needs
# 256 levels of each, on the logarithmic scale that it has. Numbers of tables are exact.

Levels = NDArray[np.int64]
CODE = "code"  # key of the bytes of a code, and of their length in the page
_ZERO = 512  # stored exponent 0; 0 is a missing value and 1 is the number 0
_SAFE = bytes.maketrans(b"<&", b",.")  # HTML has a meaning for both


def encode_levels(
    values: Sequence[Any], bits: int = 8, *, is_signed: bool = False, is_smooth: bool = False
) -> dict[str, Any]:
    """Encode numbers as levels of equal ratio. Level 0 is a missing value.

    Returns range of the absolute values, number of bits, flags and the bytes of the levels.
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
    code: dict[str, Any] = {"l": low, "h": high, CODE: _pack_levels(levels, bits, is_smooth)}
    code |= {"w": bits} if bits > 8 else {}
    code |= {"s": 1} if is_signed else {}
    return code | ({"d": 1} if is_smooth else {})


def _pack_levels(levels: Levels, bits: int, is_smooth: bool) -> bytes:
    """Return levels as bytes; of two bytes, all upper ones first."""
    if is_smooth:
        levels = np.diff(levels, prepend=0) % 2**bits
    return levels.astype(np.uint8).tobytes() if bits == 8 else _split_bytes(levels)


def encode_decimals(values: Sequence[Any]) -> dict[str, Any]:
    """Encode positive numbers of at most four digits exactly: mantissa and exponent. None is a missing value.

    Returns number of values, and their bytes.
    """
    numbers = np.array(values, dtype=float).ravel()
    usable = np.isfinite(numbers) & (numbers != 0)
    texts = [f"{value:.3e}".split("e") for value in np.where(usable, numbers, 1.0).tolist()]
    mantissa = np.array([int(text[0].replace(".", "")) for text in texts])
    exponent = np.array([int(text[1]) for text in texts])
    exact = [float(f"{m}e{e - 3}") for m, e in zip(mantissa, exponent, strict=True)]
    if np.any(usable & (np.array(exact) != numbers)) or (numbers < 0).any():
        raise ValueError(
            "Numbers of a page must be positive and have at most four digits, got "
            f"{numbers[usable][:3].tolist()}. Round them."
        )
    mantissa = np.where(usable, mantissa, 0)
    shift = np.where(usable, exponent + _ZERO, np.where(numbers == 0, 1, 0))
    return {"c": len(numbers), CODE: _split_bytes(mantissa) + _split_bytes(shift)}


def _split_bytes(numbers: Levels) -> bytes:
    """Return numbers of two bytes, all upper ones first."""
    return (numbers >> 8).astype(np.uint8).tobytes() + (numbers & 255).astype(np.uint8).tobytes()


def compress_pack(pack: Mapping[str, Any]) -> str:
    """Compress a pack and all its codes, with the same text for equal content.

    Returns length of the JSON, JSON and bytes of all codes, as gzip in base 85.
    """
    codes: list[bytes] = []
    text = json.dumps(
        _move_codes(pack, codes), separators=(",", ":"), allow_nan=False, ensure_ascii=False
    ).encode()
    content = len(text).to_bytes(4, "big") + text + b"".join(codes)
    packed = base64.b85encode(gzip.compress(content, 9, mtime=0))
    return packed.translate(_SAFE).decode("ascii")


def _move_codes(value: Any, codes: list[bytes]) -> Any:
    """Return a value with lengths in place of bytes, which go to a list in the order of a browser."""
    if isinstance(value, Mapping):
        if isinstance(value.get(CODE), bytes):
            codes.append(value[CODE])
            return {**value, CODE: len(value[CODE])}
        keys = sorted(value, key=_browser_order)
        lengths = {key: _move_codes(value[key], codes) for key in keys}
        return {key: lengths[key] for key in value}
    if isinstance(value, list | tuple):
        return [_move_codes(item, codes) for item in value]
    return value


def _browser_order(key: str) -> int:
    """Return the place of a key: JavaScript has whole numbers first, in their order, then all others."""
    is_index = key.isascii() and key.isdecimal() and str(int(key)) == key and int(key) < 2**32 - 1
    return int(key) if is_index else 2**32
