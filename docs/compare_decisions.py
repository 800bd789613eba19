"""Decisions of all_seven by the earlier rules and by the present ones: `python docs/compare_decisions.py`.

It writes the table of docs/statistics.md for the planned pairs of the first published page. Its words are in
early_decisions.csv, since a fresh clone may lack the history; `--history` reads them again from git. The earlier
rule is also applied to the runs of today, so that a change by the rule differs from a change by the data.
"""

from __future__ import annotations

import csv
import gzip
import json
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import wilcoxon

from pfbench.files import markdown_head, markdown_row
from pfbench.results import holm

TOP = Path(__file__).parents[1]
STUDY = TOP / "reports" / "all_seven"
PAGE, EARLY = TOP / "docs" / "statistics.md", TOP / "docs" / "early_decisions.csv"
FIRST = "f32489b"  # the oldest commit that has reports/all_seven/report.md
OPPOSITE = {"better": "worse", "worse": "better"}
_BLOCK = re.compile(r"<!-- numbers:early_decisions -->\n.*?<!-- numbers:end -->", re.DOTALL)
_HEADS = (
    "method", "baseline", "first page", "earlier rule, present runs", "in these worlds",
    "error ratio, or runs won", "in a new world", "changed by the rule",
)  # fmt: skip
Words = dict[tuple[str, str], str]


def read_early_words(page: str) -> Words:
    """Read the words of the planned pairs of an early page.

    Args:
        page: Text of report.md. The last column of its table names the better filter of a pair, if any.

    Returns:
        better, worse or inconclusive by method and baseline.
    """
    table = page.partition("| method | baseline | cells |")[2]
    words = {}
    for line in table.splitlines()[2:]:
        cells = [cell.strip(" *`") for cell in line.strip().strip("|").split("|")]
        if not line.startswith("|"):
            break
        method, baseline, winner = cells[0], cells[1], cells[-1]
        word = {method: "better", baseline: "worse"}
        words[method, baseline] = word.get(winner, "inconclusive")
    return words


def read_history() -> Words:
    """Read the words of the first published page from git.

    Raises:
        subprocess.CalledProcessError: if the clone lacks the commit.
    """
    command = ["git", "-C", str(TOP), "show", f"{FIRST}:reports/all_seven/report.md"]
    return read_early_words(
        subprocess.run(command, capture_output=True, text=True, check=True).stdout
    )


def read_stored_words() -> Words:
    """Read the words of early_decisions.csv."""
    with EARLY.open(newline="") as file:
        return {(row["method"], row["baseline"]): row["word"] for row in csv.DictReader(file)}


def apply_early_rule(
    runs: pd.DataFrame, pairs: Sequence[tuple[str, str]], alpha: float = 0.05
) -> Words:
    """Decide pairs as the first page did: Wilcoxon's test over conditions of median log errors, with Holm.

    Conditions of one world were taken for independent, and diverged runs kept their error.

    Args:
        runs: Runs of a report.
        pairs: Methods and baselines.
        alpha: Error of all pairs together.

    Returns:
        better, worse or inconclusive by pair.
    """
    log_error = np.log(runs["rmse"].fillna(np.inf))
    median = log_error.groupby([runs["scenario"], runs["regime"], runs["filter"]]).median()
    table = median.unstack("filter")
    differences = [(table[a] - table[b]).dropna() for a, b in pairs]
    corrected = holm([float(wilcoxon(d).pvalue) for d in differences])
    return {
        pair: "inconclusive" if p > alpha else "better" if d.median() < 0 else "worse"
        for pair, d, p in zip(pairs, differences, corrected, strict=True)
    }


def select_decision(planned: Sequence[Mapping[str, Any]], a: str, b: str) -> tuple[str, str, str]:
    """Return the words of a pair in these worlds and in a new one, with the error ratio or the runs won.

    Args:
        planned: Planned pairs of the data of a page, in either direction.
        a: Method.
        b: Baseline.
    """
    for entry in planned:
        if {entry["a"], entry["b"]} == {a, b}:
            new = (entry["new_world"] or {"word": "not tested"})["word"]
            words = [entry["word"], new]
            if entry["a"] != a:
                return (
                    OPPOSITE.get(words[0], words[0]),
                    f"of `{b}`: {_describe(entry)}",
                    OPPOSITE.get(new, new),
                )
            return words[0], _describe(entry), words[1]
    return "missing", "", "missing"


def _describe(entry: Mapping[str, Any]) -> str:
    """Format the ratio of a planned pair with its interval, or the runs won."""
    if entry["estimate"] is None:
        return str(entry["reason"] or "").partition(";")[0]
    low, high = (
        f"{entry[name]:.3g}" if entry[name] is not None else "-" for name in ("low", "high")
    )
    return f"{entry['estimate']:.3g} ({low} to {high})"


def compare(early: Words, rule: Words, planned: Sequence[Mapping[str, Any]]) -> str:
    """Format the table of all three. The rule changes a decision if its word on the same runs is another one.

    Args:
        early: Words of the first page.
        rule: Words of the earlier rule with the present runs.
        planned: Planned pairs of the data of the present page.
    """
    lines, by_rule, by_runs, missing = markdown_head(*_HEADS), 0, 0, 0
    for (a, b), old in early.items():
        here, effect, new = select_decision(planned, a, b)
        is_changed = here not in (rule[a, b], "missing")
        by_rule, by_runs, missing = (
            by_rule + is_changed,
            by_runs + (rule[a, b] != old),
            missing + (here == "missing"),
        )
        cells = f"`{a}`", f"`{b}`", old, rule[a, b], here, effect, new
        lines.append(markdown_row(*cells, "yes" if is_changed else ""))
    counts = [_count_decided(planned, early, place) for place in (0, 2)]
    end = (
        f"The present rule changes {by_rule} of {len(early)} decisions, and the present runs change {by_runs}. "
        f"The earlier rule decides {sum(word in OPPOSITE for word in rule.values())}, the present one {counts[0]} in these "
        f"worlds and {counts[1]} in a new world. {missing} pairs are missing."
    )
    return "\n".join([*lines, "", end])


def _count_decided(planned: Sequence[Mapping[str, Any]], early: Words, place: int) -> int:
    """Count the pairs whose word is better or worse."""
    return sum(select_decision(planned, *pair)[place] in OPPOSITE for pair in early)


def fill_page(text: str) -> str:
    """Replace the table of a page by that of the stored files.

    Args:
        text: Content of docs/statistics.md.
    """
    early = read_stored_words()
    planned = json.loads(gzip.decompress((STUDY / "page.json.gz").read_bytes()))["planned"]
    rule = apply_early_rule(pd.read_parquet(STUDY / "runs.parquet"), list(early))
    table = (
        f"<!-- numbers:early_decisions -->\n{compare(early, rule, planned)}\n<!-- numbers:end -->"
    )
    return _BLOCK.sub(lambda _: table, text)


def main(words: Sequence[str]) -> None:
    """Write the table, and early_decisions.csv if the history is requested."""
    if "--history" in words:
        with EARLY.open("w", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(("method", "baseline", "word"))
            writer.writerows((*pair, word) for pair, word in read_history().items())
    PAGE.write_text(fill_page(PAGE.read_text()))


if __name__ == "__main__":
    main(sys.argv[1:])
