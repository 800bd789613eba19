"""Protection of stored verdicts: a page without results must not replace one with results."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pfbench.claims.schema import NOT_RUN


def check_stored_verdicts(path: Path, records: Sequence[dict[str, Any]]) -> None:
    """Check that no stored verdict is replaced by one with fewer results.

    Args:
        path: Stored verdicts.json, which need not exist.
        records: New records, as in the file.

    Raises:
        ValueError: If results of a stored verdict are missing. The message names the file, the number of
            claims and the remedy.
    """
    if not path.is_file():
        return
    stored = {
        record["id"]: _count_missing(record) for record in json.loads(path.read_text("utf-8"))
    }
    lost = [r["id"] for r in records if _count_missing(r) > stored.get(r["id"], float("inf"))]
    if lost:
        raise ValueError(
            f"results_dir must hold the results of the verdicts in {path}, got none for {len(lost)} of "
            f"{len(records)} claims, which would become '{NOT_RUN}'. Nothing was written. Run their "
            f"studies first, write the page elsewhere with reports_dir=DIR, or remove {path}."
        )


def _count_missing(record: dict[str, Any]) -> int:
    """Count the tests of a claim that were not run."""
    reasons = [test["reason"] for tests in record["findings"].values() for test in tests]
    return [record["reason"], *reasons].count(NOT_RUN)
