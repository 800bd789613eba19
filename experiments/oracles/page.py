"""The page of the oracle book: `python experiments/oracles/page.py [--stored]` computes all rows and writes docs/oracles.md.

Rows that are stored in results/oracles are not computed again. `--stored` makes the page from values.json alone.
"""

from __future__ import annotations

import json
import sys
from itertools import groupby
from pathlib import Path
from typing import Any

from pfbench.experiments.oracles.book import HERE, WIDTH, run_book

from pfbench.files import markdown_head, markdown_row
from pfbench.job import list_groups

VALUES = HERE / "values.json"
PAGE = HERE.parents[1] / "docs" / "oracles.md"
SHARED = "registry_nile"  # one printed number for many filters

PICTURE = PAGE.with_suffix(".svg")
WIDE, ROW, LEFT, EDGE = 480, 22, 190, 4.0  # units of the picture, and z at its edges

HEAD = """\
# The oracle book

**pfbench meets {hits} of {count} numbers that other projects printed.** They are from {sources} sources: Kalman filters and smoothers, particle
filters, ensembles, the Earth, satellites, the atmosphere and the Allan deviation. No printed value is by pfbench. All rows take
{minutes:.1f} minutes on one core.

![Difference of each number in standard deviations, by source](oracles.svg)

A point is a number: its difference from the printed value in standard deviations, rounding included. Crosses at an edge are farther away.

{misses}
"""

RULE = """\
## How to read the tables

A printed value is met if ours differs by at most a tolerance plus {width:.0f} standard errors. The tolerance is the rounding of the printed value, or
that of the test that prints it. For `broadcast_orbit` it is 0.3 m, which we chose. z is the difference in standard deviations, with a variance for the rounding. A value that is one draw of a
particle filter has the spread of our runs as its error. Of rows with such errors, one in 370 misses by chance. Such a row is
weak where the spread is wide. Those of `ukfm_localisation` would not tell one filter from another.

The data are in the test that prints a value, or are drawn again by R's generator, which `experiments/oracles/r_numbers.py` has in Python. Each source has its
licence. Settings, data and values are copied, no code.

```python
from pathlib import Path

from pfbench.experiments.oracles import book

rows = book.run_book("allan_9", Path("results/oracles"))
assert all(row["hit"] for row in rows)
```

`pfbench check oracles` computes all rows, and 25 filters of the registry on one printed likelihood, cheapest first, and `pfbench check oracles NAME` one recipe or one row. Finished rows are kept. A row
is computed again if a source file of pfbench, a recipe or its data change. A file of `experiments/oracles` whose name ends in `_rows` adds
recipes. `python experiments/oracles/page.py` writes this page.
"""

REGISTRY = """\
## Each filter of the registry

{held} of {total} filters compute a printed number. One of these numbers is for many: the log likelihood of the Nile, {printed}. Filters that are exact on
a linear model reach it, and filters whose evidence is unbiased reach it within three standard errors: {nile} of {nile_count}.

Filters without an oracle are held by [laws of the tests](write_a_model_or_stage.md). Robust and adaptive filters and printed forms of papers change the
model, so that a public number of the model is not theirs.
"""


def format_number(value: float, error: float) -> str:
    """Format a value with its standard error."""
    return f"{value:.10g}" + (f" ± {error:.2g}" if error else "")


def format_misses(rows: list[dict[str, Any]]) -> str:
    """List the rows that miss, with what is known of the reason."""
    lines = [
        f"- `{row['id']}`: {row['setting']}. Printed {row['printed']:.10g}, ours {row['ours']:.10g}. {row['note'] or 'The reason is not clear.'}"
        for row in rows
        if not row["hit"]
    ]
    return "\n".join(["It misses:", "", *lines]) if lines else "It misses none."


def format_source(name: str, rows: list[dict[str, Any]]) -> list[str]:
    """Format the rows of a source: who printed them, and a table."""
    files = dict.fromkeys((row["source"]["file"], row["source"]["origin"]) for row in rows)
    lines = [f"### {name}", "", f"Licence: {rows[0]['source']['licence']}.", ""]
    lines += [*(f"- {file}: {origin}" for file, origin in files), ""]
    lines += markdown_head("row", "setting", "printed", "ours", "z", "")
    for row in rows:
        cells = format_number(row["printed"], row["printed_error"]), format_number(row["ours"], row["our_error"])  # fmt: skip
        lines.append(markdown_row(f"`{row['id']}`", row["setting"], *cells, f"{row['z']:+.2f}", "met" if row["hit"] else "**missed**"))  # fmt: skip
    notes = dict.fromkeys(row["note"] for row in rows if row["note"] and row["hit"])
    return [*lines, "", *(f"{note}\n" for note in notes)]


def format_registry(rows: list[dict[str, Any]]) -> list[str]:
    """Format a row for each filter of the registry: the rows that it computes."""
    lines = markdown_head("filter", "oracle")
    for name in list_groups()["filter"]:
        holding = [f"`{row['id']}`" for row in rows if name in row["filters"]]
        lines.append(markdown_row(f"`{name}`", ", ".join(holding) or "none"))
    return lines


def list_numbers(values: dict[str, Any]) -> list[dict[str, Any]]:
    """List the rows of the book by source, without those of the shared number."""
    rows = (row for row in values["rows"] if not row["id"].startswith(SHARED))
    return sorted(rows, key=lambda row: row["source"]["project"].casefold())


def draw_picture(rows: list[dict[str, Any]]) -> str:
    """Draw the differences in standard deviations as SVG, a line for each source."""
    groups = [(name, list(group)) for name, group in groupby(rows, key=lambda row: row["source"]["project"])]  # fmt: skip
    height = ROW * (len(groups) + 1) + 8

    def place(z: float) -> float:
        return LEFT + (z / EDGE + 1.0) * (WIDE - LEFT - 10) / 2.0

    parts = [
        f'<line x1="{place(z):.1f}" x2="{place(z):.1f}" y1="4" y2="{height - ROW}" stroke="#999" stroke-width="{2 if z == 0 else 0.6}"/>'
        f'<text x="{place(z):.1f}" y="{height - 6}" text-anchor="middle">{f"{z:+.0f} sd" if z else "0"}</text>'
        for z in (-WIDTH, 0.0, WIDTH)
    ]
    for k, (name, group) in enumerate(groups):
        y = ROW * (k + 0.7)
        parts.append(f'<text x="{LEFT - 16}" y="{y + 4:.1f}" text-anchor="end">{name.partition(",")[0].partition(" by ")[0]}</text>')  # fmt: skip
        for row in group:
            x = place(max(-EDGE, min(EDGE, row["z"])))
            is_near = abs(row["z"]) < EDGE
            parts.append(
                f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="#338ddf" fill-opacity="0.6"/>' if is_near
                else f'<path d="M{x - 4:.1f} {y - 4:.1f}l8 8m0 -8l-8 8" stroke="#c0392b" stroke-width="2"/>'
            )  # fmt: skip
    style = "text{font:12px sans-serif;fill:#555}"
    inner = "\n".join(parts)
    return f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDE} {height}" width="{WIDE}" height="{height}">\n<style>{style}</style>\n{inner}\n</svg>\n'


def format_page(values: dict[str, Any]) -> str:
    """Return the page of stored rows."""
    every, rows = values["rows"], list_numbers(values)
    nile = [row for row in every if row["id"].startswith(SHARED)]
    names = list_groups()["filter"]
    held = {name for row in every for name in row["filters"]}
    tables = [
        line
        for name, group in groupby(rows, key=lambda row: row["source"]["project"])
        for line in format_source(name, list(group))
    ]
    head = HEAD.format(
        hits=sum(row["hit"] for row in rows), count=len(rows), sources=len({row["source"]["project"] for row in rows}), minutes=values["minutes"],
        misses=format_misses(every),
    )  # fmt: skip
    registry = REGISTRY.format(
        held=len(held), total=len(names), nile=sum(row["hit"] for row in nile), nile_count=len(nile), printed=nile[0]["printed"],
    )  # fmt: skip
    parts = [head, RULE.format(width=WIDTH), "## Printed numbers\n", *tables, registry, *format_registry(every)]  # fmt: skip
    return "\n".join(parts) + "\n"


def main() -> None:
    """Compute the rows, store them, and write the page."""
    if "--stored" not in sys.argv[1:]:
        rows = run_book("", Path("results") / "oracles")
        times = {row["id"].partition(".")[0]: row.pop("seconds") for row in rows}
        values = {"minutes": round(sum(times.values()) / 60.0, 1), "rows": rows}
        VALUES.write_text(json.dumps(values, indent=1) + "\n")
    values = json.loads(VALUES.read_text())
    PAGE.write_text(format_page(values))
    PICTURE.write_text(draw_picture(list_numbers(values)))


if __name__ == "__main__":
    main()
