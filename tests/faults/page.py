"""The page of the harness: docs/reliability.md, whose table is generated from experiments/analyses/reliability.json."""

import json
import re
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from checkout import ROOT

from faults import readers
from faults.tally import BAD, Tally

DATA = ROOT / "experiments" / "analyses" / "reliability.json"
PAGE = ROOT / "docs" / "reliability.md"
_BLOCK = re.compile(r"<!-- numbers:reliability -->\n.*?<!-- numbers:end -->", re.DOTALL)


def is_in_history(commit: str) -> bool:
    """Return whether a commit, perhaps with `+` for local changes, is an ancestor of the checkout."""
    words = ["git", "-C", str(ROOT), "merge-base", "--is-ancestor", commit.rstrip("+"), "HEAD"]
    return subprocess.run(words, capture_output=True).returncode == 0


def format_row(row: dict[str, Any]) -> list[str]:
    """Return the cells of a class."""
    tally, bad = Tally.from_dict(row), ["–"] * len(BAD)
    if tally.trials:
        bad = [str(tally.counts[name]) for name in BAD]
        trials = str(tally.trials)
        if tally.trials < row["required"]:
            trials += f" of {row['required']}"
    else:
        trials = tally.skipped or "not run"
    commits = ", ".join(f"`{commit}`" for commit in row["commits"]) or "–"
    return [row["name"], trials, *bad, row["date"] or "–", commits]


def format_reasons(row: dict[str, Any]) -> list[str]:
    """Return a line for each way in which trials of a class were false, with its reason or an example."""
    lines = [
        f"- {row['name']}: {example}."
        for example in row["examples"].get("false", ())
        if row["name"].startswith("extreme")
    ]
    prefix = f"{readers.load_mutations().EVERY_ROW}: "
    for remark, trials in sorted(row["remarks"].items()):
        columns = remark.removeprefix(prefix)
        if remark != columns:
            reason = readers.REASONS.get((row["name"], columns), "The cause is not known.")
            lines.append(f"- {row['name']}, `{columns}` changed in all rows: {trials}. {reason}")
    return lines


def format_block(rows: Sequence[dict[str, Any]]) -> str:
    """Return the generated block of the page: the table, and reasons of false trials."""
    head = ["class", "trials", *BAD, "date", "commits"]
    lines = [head, ["---"] * len(head), *map(format_row, rows)]
    table = "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
    reasons = "".join(f"\n{line}" for row in rows for line in format_reasons(row))
    reasons = f"\n\nFalse trials:\n{reasons}" if reasons else ""
    return f"<!-- numbers:reliability -->\n{table}{reasons}\n<!-- numbers:end -->"


def fill_page(text: str, rows: Sequence[dict[str, Any]]) -> str:
    """Replace the block of a page."""
    return _BLOCK.sub(lambda _: format_block(rows), text)


def keep_published(rows: Sequence[dict[str, Any]], data: Path) -> list[dict[str, Any]]:
    """Replace rows without a trial by the published ones: another machine may have counted them."""
    published = json.loads(data.read_text()) if data.is_file() else []
    by_name = {row["name"]: row for row in published}
    return [row if Tally.from_dict(row).trials else by_name.get(row["name"], row) for row in rows]


def write_table(rows: Sequence[dict[str, Any]], page: Path = PAGE, data: Path = DATA) -> None:
    """Write the data of all classes and the table of the page.

    A commit that a rebase has replaced is not written: nobody else can look it up.
    """
    rows = [
        row | {"commits": list(filter(is_in_history, row["commits"]))}
        for row in keep_published(rows, data)
    ]
    data.write_text(json.dumps(rows, indent=1, sort_keys=True, ensure_ascii=False) + "\n")
    page.write_text(fill_page(page.read_text(), rows))
