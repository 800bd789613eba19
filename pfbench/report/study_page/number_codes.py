"""Codes of the numbers of a report page: levels of equal ratio, decimals, and their compression.

A page of 33 filters, 28 conditions and 100 runs has millions of numbers. A figure of 400 pixels needs
256 levels of each, on the logarithmic scale that it has. Numbers of tables are exact.
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
CODE = "code"  # key of the bytes of a code, and of their length in the page
_ZERO = 512  # stored exponent 0; 0 is a missing value and 1 is the number 0
_SAFE = bytes.maketrans(b"<&", b",.")  # HTML has a meaning for both


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
        Range of the absolute values, number of bits, flags and the bytes of the levels.
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

    Args:
        values: Numbers. Nested lists are flattened in the page.

    Returns:
        Number of values, and their bytes.

    Raises:
        ValueError: If a number is negative or has more digits.
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

    Args:
        pack: Plain values and codes.

    Returns:
        Length of the JSON, JSON and bytes of all codes, as gzip in base 85.
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
