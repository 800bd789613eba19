"""The 88 claims of the papers, word for word: read from claims_2.yaml, with their kinds and factors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import yaml

from pfbench.core.parameter_checks import require

_DATA = Path(__file__).with_name("claims_2.yaml")

#: ratio of a to b below which a claim of a kind is true, and above which it is false. "same" is symmetric in logs. The
#: direction of a number is "better", its size is within a factor of two of the printed one in logs
KINDS = {
    "better": (1.0, 0.99),
    "much better": (0.8, 0.8),
    "same": (1.1, 1.1),
    "number": (1.0, 0.99),
}
_MARKS = ("circular", "vacuous", "lost")
_REQUIRED = {"id", "words", "section", "kind", "figure", "a", "factors"}


@dataclass(frozen=True)
class PrintedClaim:
    """Claim of a paper, to be decided in each of its readings.

    Attributes:
        id: Identifier, as "C000-1".
        words: Sentence of the paper, word for word.
        section: Section, table or figure.
        kind: One of `KINDS`.
        figure: What is measured.
        a: Method or filter that the claim describes.
        factors: Factors of the readings that can touch it.
        b: Filters that a is compared with, or words for another setting of a.
        window: Part of the record, empty for all of it.
        printed: Printed numbers, empty without any.
        proof: Proof that decides it, alone or in one scope, empty for none.
        mark: "circular", "vacuous" or "lost" and why, empty for none.
    """

    id: str
    words: str
    section: str
    kind: str
    figure: str
    a: str
    factors: Sequence[str]
    b: Sequence[str] = ()
    window: str = ""
    printed: str = ""
    proof: str = ""
    mark: str = ""

    @property
    def paper(self) -> str:
        """Number of the paper."""
        return self.id.removeprefix("C")[:3]


def read_printed_claims(path: Path = _DATA) -> list[PrintedClaim]:
    """Read and check the 88 claims.

    Args:
        path: Data file.

    Returns:
        The claims, in the order of the file.

    Raises:
        ValueError: If a claim is wrong. The message names it, the fault and the options.
    """
    claims = [_parse(path, row) for row in yaml.safe_load(path.read_text(encoding="utf-8"))]
    ids = [claim.id for claim in claims]
    if twice := sorted({name for name in ids if ids.count(name) > 1}):
        raise ValueError(f"{path.name}: id must be unique, got {', '.join(twice)} more than once.")
    return claims


def _parse(path: Path, row: Mapping[str, Any]) -> PrintedClaim:
    """Parse and check one claim."""
    name, keys = row.get("id", "a claim without id"), {item.name for item in fields(PrintedClaim)}
    if not _REQUIRED <= set(row) <= keys:
        wrong = sorted((set(row) - keys) | (_REQUIRED - set(row)))
        raise ValueError(
            f"{path.name}: {name} must have other keys, got or missing {wrong}. Correct them."
        )
    require(
        row["kind"] in KINDS,
        f"{path.name}: {name}.kind",
        f"be one of {', '.join(KINDS)}",
        f"{row['kind']!r}",
        "Choose one.",
    )
    if row.get("mark", _MARKS[0]).split(":")[0] not in _MARKS:
        raise ValueError(
            f"{path.name}: {name}.mark must begin with {', '.join(_MARKS)}, got {row['mark']!r}. Choose one."
        )
    return PrintedClaim(**row)


def find_tipping_bound(kind: str, low: float, high: float) -> float:
    """Find the bound of a kind at which a decision by the interval of a ratio turns.

    The claim is true with every larger bound. For "same" it is the smallest factor that holds the interval.

    Args:
        kind: One of `KINDS`.
        low: Lower end of the interval of the ratio of a to b.
        high: Upper end.
    """
    return math.exp(max(abs(math.log(low)), abs(math.log(high)))) if kind == "same" else high
