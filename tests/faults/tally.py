"""Counts of the outcomes of one class of faults."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

FINE = "fine"
BAD = ("lost", "false", "crash", "code run", "unclear")  # columns of the table
MOST_EXAMPLES = 12  # of each outcome


@dataclass
class Tally:
    """Trials of one class by outcome.

    Attributes:
        name: Class of faults.
        counts: Trials by outcome: `fine` or one of `BAD`.
        remarks: Trials by the way in which they ended, for the notes of the table.
        examples: Descriptions of the first trials of each bad outcome.
        skipped: Reason why the class was not run, or an empty text.
    """

    name: str
    counts: Counter[str] = field(default_factory=Counter)
    remarks: Counter[str] = field(default_factory=Counter)
    examples: dict[str, list[str]] = field(default_factory=dict)
    skipped: str = ""

    @property
    def trials(self) -> int:
        return self.counts.total()

    @property
    def bad(self) -> dict[str, int]:
        return {name: self.counts[name] for name in BAD if self.counts[name]}

    def add(self, outcome: str, remark: str, example: str = "") -> None:
        """Count one trial."""
        if outcome != FINE and outcome not in BAD:
            raise ValueError(f"outcome must be {FINE} or one of {BAD}, got {outcome}. Change it.")
        self.counts[outcome] += 1
        self.remarks[remark] += 1
        if outcome != FINE:
            examples = self.examples.setdefault(outcome, [])
            examples[MOST_EXAMPLES:] = []
            examples.append(f"{remark}: {example}"[:600])

    def merge(self, other: Tally) -> None:
        """Add the trials of another tally of the same class."""
        self.counts += other.counts
        self.remarks += other.remarks
        for outcome, examples in other.examples.items():
            joint = self.examples.setdefault(outcome, []) + examples
            self.examples[outcome] = joint[:MOST_EXAMPLES]
        self.skipped = self.skipped or other.skipped

    def to_dict(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "counts": dict(self.counts),
            "remarks": dict(self.remarks),
            "examples": self.examples,
            "skipped": self.skipped,
        }

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> Tally:
        counts, remarks = Counter(content["counts"]), Counter(content["remarks"])
        return cls(content["name"], counts, remarks, dict(content["examples"]), content["skipped"])
