"""Proofs on the papers, read from proofs.yaml: statements without runs, margins or choices of this project."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import yaml

_DATA = Path(__file__).with_name("proofs.yaml")


@dataclass(frozen=True)
class Proof:
    """Statement on a paper that a test shows in less than a second.

    Attributes:
        id: Identifier, as "P1".
        paper: Number of the paper.
        claims: Claims that it decides, alone or in one scope.
        equation: Equation or sentence of the paper.
        shows: Line for the page.
        test: Name of the test, in tests/claims/test_proofs.py.
    """

    id: str
    paper: str
    claims: Sequence[str]
    equation: str
    shows: str
    test: str


def read_proofs(path: Path = _DATA) -> list[Proof]:
    """Read the proofs.

    Args:
        path: Data file.

    Returns:
        The proofs, in the order of the file.

    Raises:
        ValueError: If an entry has other keys.
    """
    names = {item.name for item in fields(Proof)}
    rows = yaml.safe_load(path.read_text(encoding="utf-8"))
    for row in rows:
        if set(row) != names:
            raise ValueError(
                f"{path.name}: {row.get('id')} must have the keys {', '.join(sorted(names))}, got "
                f"{', '.join(sorted(row))}. Correct them."
            )
    return [Proof(**row) for row in rows]
