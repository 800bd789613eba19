"""Errors of robust and adaptive filters in each world and noise regime: `python experiments/analyses/robustness.py`.

It writes the blocks of docs/robustness.md from the published reports of the studies `robust_*` and from the stored
limits of ceiling.json. A test fails if a block differs from them.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from ceiling import STORE, largest_limit, root_mean
from recorded_wins import KALMAN, KINDS, Condition, recorded_table
from scipy import stats
from second_seed import (
    compare_better,
    compare_rankings,
    rank_filters,
    read_runs,
    seed_table,
    select_common,
)
from terrain_wins import STUDIES as TERRAIN_STUDIES, describe_answer, terrain_table
from tuned_worlds import tuned_table

from pfbench.files import markdown_head, markdown_row
from pfbench.report import StudyFacts, read_stored_study
from pfbench.results import (
    Verdict,
    arrange_runs,
    compare_filters,
    compute_losses,
    decide,
)

TOP = Path(__file__).parents[2]
PAGE = TOP / "docs" / "robustness.md"
STUDIES = ("robust_flight", "robust_simulated", "robust_quad", "robust_car", "robust_canyon")
RECORDED = ("robust_quad", "recorded_quad", "robust_car", "recorded_car", "robust_canyon")
CONTROL, NOMINAL, OUTLIERS = "ekf_scaled_tuned", "nominal", "outliers"
SAMPLED_HYPOTHESES = "rbpf_discrete"  # particles of noise hypotheses, a Kalman filter for each
LEVEL = 0.95
_BLOCK = re.compile(r"<!-- numbers:(\w+) -->\n.*?<!-- numbers:end -->", re.DOTALL)

Row = dict[Any, Any]


class Study(NamedTuple):
    """A published study: all runs, rows of the RMSE per condition, names and options."""

    runs: pd.DataFrame
    rows: pd.DataFrame
    facts: StudyFacts

    def list_rows(self, world: str = "") -> list[Row]:
        """List the rows of a scenario or of all, the best filter first.

        Args:
            world: Scenario, empty for all.
        """
        records = self.rows.sort_values(["world", "regime", "rank"]).to_dict("records")
        order = list(self.facts.regimes)
        selected = [row for row in records if world in ("", row["world"])]
        return sorted(selected, key=lambda row: order.index(row["regime"]))


def order_statistic_interval(d: np.ndarray, level: float) -> tuple[float, float]:
    """Compute the interval of a median between two order statistics, exact for any distribution.

    Args:
        d: Sample, [n].
        level: Least coverage.

    Returns:
        Its ends, infinite if n is too small.
    """
    ordered, n = np.sort(d), d.size
    k = int(stats.binom.ppf((1 - level) / 2, n, 0.5)) if n else -1
    if n and stats.binom.cdf(k, n, 0.5) > (1 - level) / 2:
        k -= 1
    if k < 0:
        return -np.inf, np.inf
    return float(ordered[k]), float(ordered[n - 1 - k])


@cache
def read_study(name: str) -> Study:
    """Read the stored files of a study.

    Args:
        name: Name of the study.
    """
    folder = TOP / "reports" / name
    pack, table = read_stored_study(folder)
    rows = pd.DataFrame([
        {"world": key.world, "regime": key.regime, **row}
        for key, view in pack["views"].items()
        for row in view["rows"]
        if key.metric == "rmse" and "all" not in (key.world, key.regime) and row["verdict"] != "missing"
    ])  # fmt: skip
    rows = rows.drop_duplicates(["world", "regime", "filter"])
    rows = rows.astype(dict.fromkeys(("rank", "track", "coverage"), float))
    return Study(table, rows, StudyFacts.from_pack(pack))


def _percent(share: float) -> str:
    """Return a share in percent, a dash where the world states no limit."""
    return "–" if np.isnan(share) else f"{100 * share:.0f}"


def _digits(value: float) -> str:
    """Format a number with three significant digits and no exponent."""
    return f"{float(f'{value:.3g}'):.15g}" if np.isfinite(value) else "–"


def format_median(errors: np.ndarray) -> str:
    """Format the median of the errors of runs with its interval. A run without an error counts as the largest.

    Args:
        errors: Error of each run, NaN for a lost run, [R].
    """
    values = np.where(np.isnan(errors), np.inf, errors)
    low, high = order_statistic_interval(values, LEVEL)
    ordered = np.sort(values)
    median = (ordered[(values.size - 1) // 2] + ordered[values.size // 2]) / 2
    return f"{_digits(median)} [{_digits(low)}, {_digits(high)}]"


def _world_table(study: Study, world: str) -> str:
    """Table of one scenario: filters by regimes, with the limit of its nominal noise."""
    rows = {(r["regime"], r["filter"]): r for r in study.list_rows(world)}
    runs = study.runs[study.runs["scenario"] == world]
    errors = {key: part["rmse"].to_numpy() for key, part in runs.groupby(["regime", "filter"])}
    regimes = list(dict.fromkeys(regime for regime, _ in rows))
    lines = markdown_head("filter", *(f"{r} [{runs['unit'].iloc[0]}]" for r in regimes))
    ranks: dict[str, list[float]] = {}
    for row in rows.values():
        place = len(rows) if np.isnan(row["rank"]) else row["rank"]  # after all that keep track
        ranks.setdefault(row["filter"], []).append(place)
    missing = "failed" if study.facts.failures else "not run"
    order = {label: (len(regimes) - len(r), float(np.mean(r))) for label, r in ranks.items()}
    for label in sorted(order, key=lambda label: order[label]):
        present = [(regime, label) for regime in regimes if (regime, label) in errors]
        cells = {
            key: f"{format_median(errors[key])}, {_percent(rows[key]['track'])} / {_percent(rows[key]['coverage'])} %"
            for key in present
        }
        words = (cells.get((regime, label), missing) for regime in regimes)
        tier = " (B)" if study.facts.looks[label].tuning else ""
        lines.append(markdown_row(f"`{label}`{tier}", *words))
    return "\n".join([*lines, "", _describe_limit(world)])


def _describe_limit(world: str) -> str:
    """State the limit of the error in a scenario in nominal noise, or why there is none."""
    stored: Row = json.loads(STORE.read_text())[world]
    unit, smoother = stored["unit"], _digits(root_mean(stored["smoother"]))
    reached = f"The iterated smoother has an error of {smoother} {unit} in nominal noise."
    if (limit := largest_limit(stored)) is not None:
        error = root_mean(limit) if isinstance(limit, list) else limit
        return f"Limit of every causal filter in nominal noise: {_digits(error)} {unit}. {reached}"
    return f"No limit holds: {stored['reason'].removeprefix('no bound: ').rstrip('.')}. {reached}"


def compare_with_control(
    runs: pd.DataFrame, facts: StudyFacts, world: str, regime: str
) -> list[Verdict]:
    """Compare all filters of a scenario with the control in one regime.

    Args:
        runs: Runs of the study.
        facts: Other inputs of its decisions.
        world: Scenario.
        regime: Noise regime.
    """
    table = runs[(runs["scenario"] == world) & (runs["regime"] == regime)]
    labels = [label for label in facts.looks if label in set(table["filter"])]
    if CONTROL not in labels:
        return []
    arranged = arrange_runs(table, labels)
    pairs = [(label, CONTROL) for label in labels if label != CONTROL]
    return decide(compare_filters(arranged, compute_losses(arranged, "rmse"), pairs))


def format_verdict(verdict: Verdict) -> str:
    """Format the ratio of a verdict with its simultaneous interval."""
    return f"{verdict.ratio:.2f} [{verdict.low:.2f}, {verdict.high:.2f}]"


def against_control() -> str:
    """Table of the filters that are better than the control in outliers, with both intervals."""
    lines = markdown_head("world", "filter", "outliers", "nominal", "verdict in nominal noise")
    for study in map(read_study, STUDIES):
        for world in study.facts.worlds:
            nominal, outliers = (
                {v.a: v for v in compare_with_control(study.runs, study.facts, world, regime)}
                for regime in (NOMINAL, OUTLIERS)
            )
            better = sorted(
                (v for v in outliers.values() if v.word == "better"), key=lambda v: v.ratio
            )
            lines += [
                markdown_row(
                    f"`{world}`", f"`{v.a}`", format_verdict(v),
                    format_verdict(nominal[v.a]) if v.a in nominal else "–",
                    nominal[v.a].word if v.a in nominal else "–",
                )
                for v in better
            ]  # fmt: skip
            if outliers and not better:
                lines.append(markdown_row(f"`{world}`", "none", "–", "–", "–"))
    return "\n".join(lines)


def _kind(family: str, label: str) -> str:
    """Return the kind of a filter: KALMAN or one of `KINDS`."""
    if label == SAMPLED_HYPOTHESES:
        return KINDS[1]
    return KALMAN if family == KALMAN else KINDS[0]


def seeds() -> str:
    """Compare the best filters, and those that are better than the control, with those of another seed."""
    studies = {name: read_study(name) for name in STUDIES if len(read_runs(name))}
    tables = {name: select_common(study.runs, read_runs(name)) for name, study in studies.items()}
    cells = {}
    for name, pair in tables.items():
        first, second = (rank_filters(runs, studies[name].facts) for runs in pair)
        cells |= {key: compare_rankings(first[key], second[key]) for key in first}

    def decide_better(name: str, runs: pd.DataFrame, world: str) -> list[str]:
        verdicts = compare_with_control(runs, studies[name].facts, world, OUTLIERS)
        return [v.a for v in verdicts if v.word == "better"]

    verdicts = compare_better(tables, decide_better, OUTLIERS)
    lacking = [describe_lacking(name, pair) for name, pair in tables.items()]
    lacking += [f"- `{name}`" for name in STUDIES if name not in studies]
    for name in TERRAIN_STUDIES:
        runs = read_runs(name)
        pair = select_common(read_study(name).runs, runs)
        lacking.append(describe_lacking(name, pair) if len(runs) else f"- `{name}`")
    rows = "\n".join(filter(None, lacking))
    end = f"\n\nNot repeated with the second seed:\n\n{rows}"
    return f"{seed_table(cells)}\n\n{verdicts}{end if rows else ''}"


def describe_lacking(name: str, pair: tuple[pd.DataFrame, pd.DataFrame]) -> str:
    """Name the scenarios, filters and regimes of a study that a second seed lacks; empty if it lacks none.

    Args:
        name: Name of the study.
        pair: Runs of both seeds, of common filters and conditions.
    """
    runs = read_study(name).runs
    words = []
    for column in ("scenario", "filter", "regime"):
        values = sorted(set(runs[column]) - set(pair[1][column]))
        listed = ", ".join(f"`{value}`" for value in values)
        words += [f"the {column}{'s' if len(values) > 1 else ''} {listed}"] if values else []
    return f"- in `{name}` {' and '.join(words)}" if words else ""


def tuned() -> str:
    """Table of the knobs of tier B by world."""
    worlds = {
        world: study.facts.looks[CONTROL].tuning
        for study in map(read_study, STUDIES)
        for world in study.facts.worlds
    }
    return tuned_table(worlds)


def recorded() -> str:
    """Compare particle filters with all Kalman filters in each condition of recorded data."""
    conditions = [c for name in RECORDED for c in list_conditions(name, read_study(name).runs)]
    second = [c for name in STUDIES for c in list_conditions(name, read_runs(name))]
    return recorded_table(conditions, {f"{c.study} {c.regime}": c for c in second})


def list_conditions(name: str, runs: pd.DataFrame) -> list[Condition]:
    """List the conditions of a study with the errors of their filters.

    Args:
        name: Name of the study.
        runs: Its runs.
    """
    study = read_study(name)
    kinds = {label: _kind(look.family, label) for label, look in study.facts.looks.items()}
    coverage = {(r["world"], r["regime"], r["filter"]): r["coverage"] for r in study.list_rows()}
    conditions = []
    for (world, regime), part in runs.groupby(["scenario", "regime"], sort=False):
        errors = part.pivot_table(index="run", columns="filter", values="rmse", dropna=False)
        shares = {label: coverage[world, regime, label] for label in errors}
        conditions.append(Condition(name, str(regime), errors, kinds, shares))
    return conditions


def _study_tables(name: str) -> str:
    """Tables of all scenarios of a study."""
    study = read_study(name)
    return "\n\n".join(
        f"`{world}`: {look.words}.\n\n{_world_table(study, world)}"
        for world, look in study.facts.worlds.items()
    )


def _terrain(name: str) -> str:
    """Table and sentences of a study of terrain navigation."""
    study = read_study(name)
    families = {label: look.family for label, look in study.facts.looks.items()}
    return terrain_table(name, study.runs, families, format_median)


def answer() -> str:
    """State which observation makes a particle filter better than Kalman filters."""
    studies = {name: read_study(name) for name in TERRAIN_STUDIES}
    families = {a: look.family for a, look in studies["terrain_start"].facts.looks.items()}
    return describe_answer({name: study.runs for name, study in studies.items()}, families)


BLOCKS: dict[str, Callable[[], str]] = {
    "tuned": tuned,
    "against_control": against_control,
    "seeds": seeds,
    "recorded": recorded,
    "answer": answer,
    **{name: partial(_terrain, name) for name in TERRAIN_STUDIES},
}


def fill_page(text: str) -> str:
    """Replace the content of all number blocks of a page.

    Args:
        text: Content of docs/robustness.md.
    """

    def replace(match: re.Match[str]) -> str:
        name = match[1]
        content = BLOCKS[name]() if name in BLOCKS else _study_tables(name)
        return f"<!-- numbers:{name} -->\n{content}\n<!-- numbers:end -->"

    return _BLOCK.sub(replace, text)


if __name__ == "__main__":
    PAGE.write_text(fill_page(PAGE.read_text()))
