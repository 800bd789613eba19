"""Table of the decisions of a study by earlier rules and by the rules of today, for its planned pairs.

The earlier ones are those of report.md at a commit, by default the first one of all_seven. The others are those of
decisions.json, which `pfbench report` writes.

    python docs/compare_decisions.py reports/all_seven/decisions.json [COMMIT]
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pfbench.files import markdown_head, markdown_row

_FIRST_FAMILY, _TRACK = "planned pairs, track and error", "keeps track"  # words of decisions.json

TOP = Path(__file__).parents[1]
FIRST = "f32489b"  # the oldest commit that has reports/all_seven/report.md
OPPOSITE = {"better": "worse", "worse": "better"}


def read_early_words(page: str) -> dict[tuple[str, str], str]:
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


def select_words(decisions: Sequence[Mapping[str, Any]], a: str, b: str) -> dict[str, str]:
    """Return the word of a pair by question, from the records of its error in the first family.

    Args:
        decisions: Records of decisions.json.
        a: Method.
        b: Baseline.
    """
    words = {}
    for d in decisions:
        is_first = d["family"] == _FIRST_FAMILY and d["metric"] != _TRACK
        if is_first and {d["a"], d["b"]} == {a, b}:
            word = str(d["pair_word"])
            words[str(d["question"])] = word if d["a"] == a else OPPOSITE.get(word, word)
    return words


def compare(early: Mapping[tuple[str, str], str], decisions: Sequence[Mapping[str, Any]]) -> str:
    """Format the table of both. A decision is changed if the word in these worlds is another one.

    Args:
        early: Words of `read_early_words`.
        decisions: Records of decisions.json.
    """
    heads = ("method", "baseline", "earlier rules", "in these worlds", "in a new world", "changed")
    lines, changes, missing = markdown_head(*heads), 0, 0
    for (a, b), old in early.items():
        words = select_words(decisions, a, b)
        new = [words.get(question, "missing") for question in ("a", "b")]
        is_changed = new[0] not in (old, "missing")
        missing += new[0] == "missing"
        changes += is_changed
        lines.append(markdown_row(f"`{a}`", f"`{b}`", old, *new, "yes" if is_changed else ""))
    end = f"{changes} of {len(early)} decisions changed, {missing} are missing."
    return "\n".join([*lines, "", end])


def main(words: Sequence[str]) -> None:
    """Print the table."""
    path, commit = words[0], (words[1] if len(words) > 1 else FIRST)
    command = ["git", "-C", str(TOP), "show", f"{commit}:reports/all_seven/report.md"]
    page = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    print(compare(read_early_words(page), json.loads(Path(path).read_text())))


if __name__ == "__main__":
    main(sys.argv[1:])
