"""Blocks of RINEX 4 navigation files as records of RINEX 3, and the ionosphere that a navigation file states."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

_READ = ("LNAV", "INAV", "FNAV")  # messages with the records of RINEX 3


def unfold_blocks(lines: Sequence[str], body: int) -> tuple[list[str], tuple[str, ...]]:
    """Return a RINEX 4 file with the records of RINEX 3 alone, other lines blank, and a note on messages left out."""
    records, skipped = [*lines[:body], *[""] * (len(lines) - body)], set()
    for begin, block in _blocks(lines, body):
        kind, satellite, message = (*lines[begin][1:].split(), "", "", "")[:3]
        if kind == "EPH" and (satellite[:1] not in ("G", "E") or message in _READ):
            records[begin + 1 : begin + 1 + len(block)] = block
        elif kind == "EPH":
            skipped.add(message)
    note = f"messages {', '.join(sorted(skipped))} of GPS and Galileo: LNAV, INAV and FNAV are read"
    return records, (note,) if skipped else ()


def find_ionosphere(lines: Sequence[str], body: int) -> tuple[float, ...]:
    """Return the eight coefficients of the broadcast ionosphere of GPS, none without them."""
    for begin, block in _blocks(lines, body):
        if lines[begin][2:7] == "ION G" and "LNAV" in lines[begin]:
            numbers = [
                *_fields(block[0], 23, 19)[:3],
                *_fields(block[1], 4, 19)[:4],
                *_fields(block[2], 4, 19)[:1],
            ]
            return tuple(numbers) if len(numbers) == 8 else ()
    fields = {}
    for line in lines[:body]:
        label = line[60:].strip()
        if label in ("ION ALPHA", "ION BETA"):
            fields[label[4]] = _fields(line[:60], 2, 12)[:4]
        elif label == "IONOSPHERIC CORR" and line[:4] in ("GPSA", "GPSB"):
            fields[line[3]] = _fields(line[:60], 5, 12)[:4]
    numbers = [*fields.get("A", ()), *fields.get("B", ())]
    return tuple(numbers) if len(numbers) == 8 else ()


def _blocks(lines: Sequence[str], body: int) -> Iterator[tuple[int, Sequence[str]]]:
    """Yield the first line of each block of RINEX 4 and the lines after it."""
    heads = [i for i in range(body, len(lines)) if lines[i][:1] == ">"]
    for begin, end in pairwise([*heads, len(lines)]):
        yield begin, lines[begin + 1 : end]


def _fields(line: str, first: int, width: int) -> list[float]:
    """Return the numbers of fields of a width up to the first blank one."""
    texts = [line[k : k + width].strip() for k in range(first, len(line), width)]
    return [float(text.upper().replace("D", "E")) for text in texts if text]
