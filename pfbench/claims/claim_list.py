"""The 88 claims of the papers, word for word: read from claims_2.yaml, with their kinds and factors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

_DATA = Path(__file__).with_name("claims_2.yaml")

#: ratio of a to b below which a claim of a kind is true, and above which it is false. "same" is symmetric in logs. The
#: direction of a number is "better", its size is within a factor of two of the printed one in logs
KINDS = {
    "better": (1.0, 0.99),
    "much better": (0.8, 0.8),
    "same": (1.1, 1.1),
    "number": (1.0, 0.99),
}


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


def read_printed_claims() -> list[PrintedClaim]:
    """Read the 88 claims.

    Returns:
        The claims, in the order of the file.
    """
    return [PrintedClaim(**row) for row in yaml.safe_load(_DATA.read_text(encoding="utf-8"))]
