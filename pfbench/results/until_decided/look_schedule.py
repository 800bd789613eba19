"""Runs at each look of a study that adds runs, and the record that keeps its plan.

A plan is fixed before the first look: levels of the looks that follow from another plan would not
hold the error.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pfbench.files.atomic_write import write_atomically
from pfbench.files.digest import DIGEST, has_valid_digest, hash_content

LookMode = Literal["looks", "e_values"]
MODES = ("looks", "e_values")
FIRST_LOOK = 20
RECORD = "looks.json"  # in the folder of the results


@dataclass(frozen=True)
class LookSchedule:
    """Runs per condition at the looks of a study.

    Attributes:
        mode: "looks" doubles the runs from look to look, with planned levels. "e_values" looks
            every 20 runs and holds at any number of runs.
        max_runs: Runs per condition at most.

    Raises:
        ValueError: if the mode is unknown or the runs do not reach the first look.
    """

    mode: LookMode = "looks"
    max_runs: int = 320

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise ValueError(
                f"until_decided.mode must be looks or e_values, got {self.mode}. Use looks."
            )
        if type(self.max_runs) is not int or self.max_runs < FIRST_LOOK:
            raise ValueError(
                f"until_decided.max_runs must be a whole number of at least {FIRST_LOOK}, got "
                f"{self.max_runs}. Use 320."
            )

    @property
    def runs(self) -> tuple[int, ...]:
        """Runs per condition at each look."""
        looks, following = [], FIRST_LOOK
        while following < self.max_runs:
            looks.append(following)
            following += following if self.mode == "looks" else FIRST_LOOK
        return (*looks, self.max_runs)

    def parts(self, number: int) -> list[tuple[int, int]]:
        """Return the first run and the number of runs of all parts until a look.

        Args:
            number: Number of the look, from 1.
        """
        ends = self.runs[:number]
        return [(first, end - first) for first, end in zip((0, *ends), ends, strict=False)]


class LookRecord:
    """Plan and looks of a study in one file.

    Args:
        path: File, whose folder is created.
        request: Plan of the study, values that JSON can represent.

    Attributes:
        path: File.
        request: Plan of the study.
        looks: Lines of the looks so far.
        state: Reason why the study has finished, or empty.

    Raises:
        ValueError: if the file is of another plan, or is damaged.
    """

    def __init__(self, path: Path, request: Mapping[str, Any]) -> None:
        self.path = path
        self.request: dict[str, Any] = json.loads(json.dumps(request))
        self.looks: list[str] = []
        self.state = ""
        if not path.exists():
            return
        stored = _read_record(path)
        for key, value in self.request.items():
            if stored["request"].get(key) != value:
                raise ValueError(
                    f"{key} must be {_shorten(stored['request'].get(key))}, as at the first look of "
                    f"this study, got {_shorten(value)}. Use another study=NAME, or delete the "
                    f"folder {path.parent}."
                )
        self.looks, self.state = list(stored["looks"]), str(stored["state"])

    def write(self, looks: Sequence[str], state: str = "") -> None:
        """Write the looks so far.

        Args:
            looks: Lines of the looks.
            state: Reason why the study has finished, empty while it has not.
        """
        self.looks, self.state = list(looks), state
        content = {"request": self.request, "looks": self.looks, "state": state}
        text = json.dumps({**content, DIGEST: hash_content(content)}, indent=1)
        write_atomically(self.path, lambda file: file.write(text.encode()))


def _read_record(path: Path) -> dict[str, Any]:
    """Read a record and check its digest."""
    try:
        stored = json.loads(path.read_text())
    except ValueError:
        stored = None
    if not isinstance(stored, dict) or not has_valid_digest(stored):
        raise ValueError(
            f"{path} must be the record of a study, got a damaged file. Delete it: the results are "
            "kept, and all looks are repeated from them."
        )
    return stored


def _shorten(value: Any) -> str:
    """Format a value in at most 60 characters."""
    text = f"{value}"
    return text if len(text) <= 60 else f"{text[:57]}..."
