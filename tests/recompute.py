"""Decisions of stored studies against an independent computation by scipy alone.

It reads the files of a report (runs.parquet, verdicts.csv, decisions.csv) without code of pfbench. `pfbench report
study=NAME` writes them, in a fresh clone from runs.parquet.

Run: make recompute STUDY=all_seven, or python tests/recompute.py [STUDY ...]; without a name all published studies.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from row_oracle import compare_pairs, compare_rows

REPORTS = Path(__file__).parents[1] / "reports"


def main(studies: Sequence[str]) -> int:
    """Compare the decisions of studies; all published ones without a name."""
    studies = studies or sorted(path.parent.name for path in REPORTS.glob("*/runs.parquet"))
    total, problems = 0, []
    for study in studies:
        folder = REPORTS / study
        if not (folder / "verdicts.csv").is_file():
            print(
                f"reports/{study} must have verdicts.csv, got none. Run: pfbench report study={study}"
            )
            return 2
        rows, different = compare_rows(folder, "rmse")
        pairs, others = compare_pairs(folder, 10**6)
        problems += different + others
        total += rows + pairs
        print(f"{study}: {rows} rows, {pairs} pairs, {len(different) + len(others)} differ", flush=True)  # fmt: skip
    print("\n".join(problems))
    print(f"{total} decisions of {len(studies)} studies computed again, {len(problems)} differ")
    return int(bool(problems))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
