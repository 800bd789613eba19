"""Whether the verdicts of the studies `robust_*` hold for another seed: the block `seeds` of docs/robustness.md.

`python experiments/analyses/second_seed.py FOLDER` stores the runs of the second seed in second_seed.parquet. FOLDER has
a report of each study, written by `pfbench report reports_dir=FOLDER` from the jobs of the same experiment with another
seed.
Both seeds are decided by the same rules, each for the filters and the conditions that both have.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import stats

from pfbench.files import markdown_head, markdown_row
from pfbench.report import StudyFacts
from pfbench.results import arrange_runs, compare_filters, compute_losses, decide

RUNS = Path(__file__).parent / "second_seed.parquet"
CONDITION = ["scenario", "regime"]
_WORSE = ("worse",)
SAME, OPEN, CHANGED = "same", "not decided", "changes"

Ranking = list[tuple[str, str]]  # filters with their verdicts, the best first


class BestFilter(NamedTuple):
    """Best filter of a condition with two seeds.

    Attributes:
        first: Best filter of the first seed.
        second: Best filter of the second seed.
        outcome: SAME; OPEN if neither is shown to be worse in the other seed; CHANGED.
        agreement: Kendall's rank correlation of the orders of all filters.
    """

    first: str
    second: str
    outcome: str
    agreement: float


def store_runs(folder: Path, studies: Sequence[str]) -> None:
    """Store the runs of the second seed of all studies in one file. Studies without a new report are kept.

    Args:
        folder: Folder of the reports of the second seed.
        studies: Names of the studies.
    """
    paths = {study: folder / study / "runs.parquet" for study in studies}
    new = {s: pd.read_parquet(p).assign(study=s) for s, p in paths.items() if p.is_file()}
    stored = pd.read_parquet(RUNS) if RUNS.is_file() else pd.DataFrame({"study": []})
    kept = stored[~stored["study"].isin(list(new))]
    pd.concat([kept, *new.values()], ignore_index=True).to_parquet(
        RUNS, index=False, compression="zstd"
    )


@cache
def read_runs(study: str) -> pd.DataFrame:
    """Read the runs of the second seed of a study.

    Args:
        study: Name of the study.
    """
    table = pd.read_parquet(RUNS)
    return table[table["study"] == study].drop(columns="study").reset_index(drop=True)


def select_common(first: pd.DataFrame, second: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Select the filters and the conditions that both seeds have.

    Args:
        first: Runs of the first seed.
        second: Runs of the second seed.
    """
    keys = [*CONDITION, "filter"]
    common = first[keys].drop_duplicates().merge(second[keys].drop_duplicates(), on=keys)
    return first.merge(common, on=keys), second.merge(common, on=keys)


def rank_filters(runs: pd.DataFrame, facts: StudyFacts) -> dict[tuple[str, str], Ranking]:
    """Rank the filters of each condition, with the verdict on each against the best of them.

    Args:
        runs: Runs of a study.
        facts: Other inputs of its decisions.
    """
    labels = [label for label in facts.looks if label in set(runs["filter"])]
    arranged = arrange_runs(runs, labels)
    losses = compute_losses(arranged, "rmse")
    rankings: dict[tuple[str, str], Ranking] = {}
    for k, row in arranged.conditions.iterrows():
        level = np.nanmedian(losses[:, k], axis=1)
        order = [labels[i] for i in np.argsort(level, kind="stable") if not np.isnan(level[i])]
        condition = arranged.select(arranged.conditions.index == k)
        pairs = [(label, order[0]) for label in order[1:]]
        verdicts = decide(compare_filters(condition, losses[:, [k]], pairs))
        rankings[row["scenario"], row["regime"]] = [
            (order[0], "best"), *((v.a, v.word) for v in verdicts)
        ]  # fmt: skip
    return rankings


def compare_rankings(first: Ranking, second: Ranking) -> BestFilter:
    """Compare the order of the filters of a condition with two seeds.

    Args:
        first: Ranking of the first seed.
        second: Ranking of the second seed, of the same filters.
    """
    best, other = first[0][0], second[0][0]
    is_worse = dict(second)[best] in _WORSE or dict(first)[other] in _WORSE
    outcome = SAME if best == other else CHANGED if is_worse else OPEN
    places = {label: k for k, (label, _) in enumerate(second)}
    order = [places[label] for label, _ in first]
    agreement = float(stats.kendalltau(range(len(order)), order).statistic)
    return BestFilter(best, other, outcome, agreement)


def seed_table(cells: Mapping[tuple[str, str], BestFilter]) -> str:
    """Table and sentence on the best filter of each condition.

    Args:
        cells: Comparisons by scenario and regime.
    """
    lines = markdown_head("world", "regime", "best, seed 1", "best, seed 2", "best filter", "rank correlation")  # fmt: skip
    for (world, regime), cell in cells.items():
        words = (f"`{world}`", regime, f"`{cell.first}`", f"`{cell.second}`")
        lines.append(markdown_row(*words, cell.outcome, f"{cell.agreement:.2f}"))
    counts = {o: sum(c.outcome == o for c in cells.values()) for o in (SAME, OPEN, CHANGED)}
    return "\n".join([
        *lines, "",
        f"The best filter is the same in {counts[SAME]} of {len(cells)} conditions. In {counts[OPEN]} others the best filter of "
        f"one seed is not decided to be worse in the other. In {counts[CHANGED]} it is.",
    ])  # fmt: skip


def compare_better(
    studies: Mapping[str, tuple[pd.DataFrame, pd.DataFrame]],
    decide_better: Callable[[str, pd.DataFrame, str], Sequence[str]],
    regime: str,
) -> str:
    """Table and sentence on the filters that are better than the control in a regime, with two seeds.

    Args:
        studies: Runs of both seeds by study, of common filters and conditions.
        decide_better: Returns the filters of a study that are better in a scenario, by its runs.
        regime: Regime that is compared.
    """
    lines = markdown_head("world", "better with both seeds", "seed 1 only", "seed 2 only")
    number = both = one = 0
    for study, tables in studies.items():
        for world, runs in tables[0].groupby("scenario", sort=False):
            if regime not in set(runs["regime"]):
                continue
            sets = [set(decide_better(study, t, str(world))) for t in tables]
            groups = (sets[0] & sets[1], sets[0] - sets[1], sets[1] - sets[0])
            number += runs["filter"].nunique() - 1
            both += len(groups[0])
            one += len(groups[1]) + len(groups[2])
            cells = (", ".join(f"`{name}`" for name in sorted(group)) or "–" for group in groups)
            lines.append(markdown_row(f"`{world}`", *cells))
    return "\n".join([
        *lines, "",
        f"Of {number} pairs of a filter and a world, {both} are better than the control with both seeds, {one} with one of them "
        f"and {number - both - one} with none.",
    ])  # fmt: skip


if __name__ == "__main__":
    from robustness import STUDIES
    from terrain_wins import STUDIES as TERRAIN_STUDIES

    store_runs(Path(sys.argv[1]), (*STUDIES, *TERRAIN_STUDIES))
