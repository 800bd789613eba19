"""Orders of the filters in each world of a study of few worlds, whose average over worlds is the answer of none of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from pfbench.report.board.entries import ViewKey
from pfbench.report.journal.study_pack import ALL
from pfbench.report.options import ReportOptions
from pfbench.results.looks import MethodLook
from pfbench.stats.comparison import decide
from pfbench.stats.study_runs import StudyRuns, compare_filters, compute_losses

MOST_WORLDS = 3  # more worlds have a page of their own, or an average


def order_worlds(
    runs: StudyRuns,
    views: Mapping[ViewKey, Mapping[str, Any]],
    looks: Mapping[str, MethodLook],
    options: ReportOptions,
) -> list[dict[str, Any]]:
    """Describe the order of each world: its sentence, its first filter, and the filters that do as well.

    Empty unless the study has two or three worlds, each one scenario, in one noise regime.
    """
    conditions = runs.conditions
    worlds = list(conditions["scenario"].unique())
    is_few = 1 < len(worlds) <= MOST_WORLDS and conditions["family"].nunique() == len(worlds)
    if not is_few or conditions["regime"].nunique() > 1:
        return []
    losses, baseline, orders = compute_losses(runs, options.metric), next(iter(views)).baseline, []
    for world in worlds:
        view = views[ViewKey(options.metric, world, ALL, baseline)]
        labels = [row["filter"] for row in view["rows"] if row["rank"] is not None]
        mask = (conditions["scenario"] == world).to_numpy()
        pairs = [(label, labels[0]) for label in labels[1:]]
        effects = compare_filters(runs.select(mask), losses[:, mask], pairs)
        verdicts = decide(effects, math.log1p(options.equivalence_margin), options.alpha)
        ties = [v.a for v in verdicts if v.word != "worse"]
        is_said = not ties and labels[0] == baseline  # by the sentence of the view
        text = "" if is_said else _describe_ties(labels[0], ties, len(verdicts), looks)
        orders.append({"world": world, "sentence": f"{view['sentence']} {text}".rstrip()})
    return orders


def _describe_ties(
    best: str, ties: Sequence[str], others: int, looks: Mapping[str, MethodLook]
) -> str:
    """Say which filters are not shown to be worse than the first one of a world."""
    first = f"[[{looks[best].name}]]"
    if not ties:
        return f"All others are worse than {first}."
    names = ", ".join(f"[[{looks[label].name}]]" for label in ties)
    verb = "is" if len(ties) == 1 else "are"
    end = "" if len(ties) == others else " All others are."
    return f"{names} {verb} not shown to be worse than {first}, the first of this world.{end}"
