"""Choice of filters at equal time, from a study with several numbers of particles of the same filters."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from pfbench.report.study_page.opening import format_short

_PARTICLES = re.compile(r"(?<=[\[,])particles=\d+,?")
_LEAST = 2  # filters with several numbers of particles


def offer_budgets(pack: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the budgets of the page; equal time with its filters if the study has the data.

    The limit is the time per step, over all conditions, of the filter that is the slowest with its
    fewest particles. Each filter is shown with the most particles that do not exceed the limit. A filter
    without particles is shown if it does not exceed the limit.

    Args:
        pack: Data of the page.
    """
    budgets = [dict(budget) for budget in pack["budgets"]]
    limit, filters = select_equal_time(pack)
    for budget in budgets:
        if budget["key"] == "time" and budget["reason_missing"] and filters:
            budget |= {
                "reason_missing": None, "filters": filters,
                "words": f"with the most particles up to {format_short(limit)} ms per step; "
                "ranks and decisions are those of all filters",
            }  # fmt: skip
    return budgets


def select_equal_time(pack: Mapping[str, Any]) -> tuple[float, list[str]]:
    """Select the filters of `offer_budgets`.

    Args:
        pack: Data of the page.

    Returns:
        Limit in ms per step, and keys of filters. No keys if fewer than two filters have several numbers
        of particles with a time.
    """
    notes = {note["filter"]: str(note["particles"]) for note in pack["filter_notes"]}
    rows = next(iter(pack["views"].values()))["rows"]
    times = {row["filter"]: float(row["ms"]) for row in rows if row["ms"] is not None}
    variants: dict[str, list[tuple[int, str]]] = {}
    for key in times:
        name = _PARTICLES.sub("", key).replace(",]", "]").removesuffix("[]")
        number = notes.get(key, "")
        variants.setdefault(name, []).append((int(number) if number.isdigit() else 0, key))
    swept = [sorted(group) for group in variants.values() if len({n for n, _ in group}) > 1]
    if len(swept) < _LEAST:
        return 0.0, []
    limit = max(times[group[0][1]] for group in swept)
    fitting = ([v for v in group if times[v[1]] <= limit] for group in variants.values())
    return limit, [max(group)[1] for group in fitting if group]
