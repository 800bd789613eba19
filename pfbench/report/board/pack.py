"""Data of the page and of the paper of a study: one dictionary, all numbers decided here from one reading."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any, NamedTuple

import pandas as pd

from pfbench.core.parameter_checks import require
from pfbench.report import provenance
from pfbench.report.board.curves import (
    count_carried_runs,
    list_calibration,
    list_runs,
    list_sweeps,
    make_curves,
    make_tracks,
)
from pfbench.report.board.entries import (
    CellKey,
    StudyFacts,
    ViewKey,
    budget_entries,
    cell_entries,
    describe_uncommitted,
    job_rows,
    join_rows,
    metric_entries,
    name_regimes,
    regime_entries,
    round_values,
)
from pfbench.report.board.recorded_units import (
    RecordedCondition,
    collect_record,
    decide_records,
    describe_reach,
)
from pfbench.report.board.view import (
    build_views,
    select_common,
    select_everywhere,
    shorten_view,
    word_verdict,
)
from pfbench.report.journal.study_pack import ALL
from pfbench.report.methods_text import collect_methods_facts
from pfbench.report.options import ReportOptions
from pfbench.report.overview.tables import plan_world_pairs
from pfbench.report.provenance import format_bibliography
from pfbench.results.conditions import Condition, differing_settings, parse_label
from pfbench.results.frame import drop_before, to_long_rows
from pfbench.results.looks import (
    MethodLook,
    PartName,
    plan_look_pairs,
    study_looks,
    study_part_names,
)
from pfbench.results.metrics import page_metrics
from pfbench.results.paper_block import REFERENCES
from pfbench.results.status import count_statuses
from pfbench.results.step_times import StepTimes
from pfbench.results.store import JobResult, list_failures
from pfbench.stats.comparison import MIN_RUNS, NO_DECISION, Verdict, decide
from pfbench.stats.court import Court, fix_pairs
from pfbench.stats.error_measures import Flags
from pfbench.stats.pair_states import find_level
from pfbench.stats.run_dependence import RUN, assess_runs, drop_runs
from pfbench.stats.study_runs import (
    arrange_runs,
    compare_filters,
    compute_losses,
    share_conditions,
)


def build_pack(
    study: str,
    conditions: Sequence[Condition],
    options: ReportOptions,
    data: StudyData | None = None,
) -> dict[str, Any]:
    """Build all data of the page of a study but its files.

    Returns dictionary of plain values. Views have the key `ViewKey`, and data of cells (world,
    regime). None is a value that does not exist.
    """
    data = data or read_study(conditions, options)
    folder = conditions[0].jobs[0].path.parent
    level, looks = find_level(folder, options.alpha)
    options = replace(options, alpha=level)
    table, metadata = data.table, [job.meta for c in conditions for job in c.jobs]
    regimes = study_part_names(conditions, "noise")
    differing = [
        f"Jobs of {condition.name} differ in {', '.join(settings)}: "
        "their runs share random numbers, but not the data."
        for condition in conditions
        if (settings := differing_settings(condition.jobs))
    ]
    facts = StudyFacts(
        study_looks(conditions),
        study_part_names(conditions, "scenario"),
        regimes,
        options,
        data.times,
        list_failures(folder),
        " ".join(filter(None, (conditions[0].older, looks, data.warning))),
        " ".join(filter(None, (describe_uncommitted(metadata), *differing))),
        data.records,
    )
    decided = decide_parts(table, facts)
    cells = cell_entries(table)
    model = " model={model}" if any(cell["model"] for cell in cells) else ""
    pack = {
        "study": study,
        "title": options.title or study,
        "generated": {  # the build of uncommitted code is not its commit
            "commit": ", ".join(provenance.list_builds(metadata)),
            "date": max(str(meta.get("created", ""))[:10] for meta in metadata),
            "version": str(metadata[0].get("versions", {}).get("pfbench", "")),
        },
        **decided,
        "regimes": regime_entries(table, regimes),
        "cells": cells,
        "budgets": budget_entries(metadata),
        "curves": data.curves,
        "tracks": data.tracks,
        "replay": f"pfbench replay study={study} scenario={{world}} noise={{noise}}"
        f"{model} filter={{filter}} run={{run}}",
        "methods": collect_methods_facts(
            conditions,
            alpha=options.alpha,
            margin=options.equivalence_margin,
            metric=page_metrics()[options.metric].page_name,
        ),
        "filter_notes": join_notes(data.notes),
        "choices": list_modelling_choices(data.notes, facts.looks),
        "provenance": [list(row) for row in provenance.list_shared_settings(conditions)],
        "facts": facts.to_entries(),
    }
    return pack | {"bibtex": format_bibliography(pack, conditions)}


# --------------------------------------------------------------------------------------------------
# All data of the results of a study that its page needs, from one reading of each file.


class StudyData(NamedTuple):
    """Data of a study.

    Attributes:
        table: One row per filter, condition and run, see `build_run_table`.
        metrics: All metrics in long rows, see `frame.load_frame`; empty unless requested.
        curves: Quantiles of the error over time by condition.
        tracks: Single runs by condition.
        notes: Notes on the jobs, see `note_job`.
        times: Times in rounds by label, of each condition; without filters that were not measured.
        warning: Sentences on a truth that is measured, and on runs that are not independent; empty for none.
        records: Recorded conditions with the losses of their blocks of time.
    """

    table: pd.DataFrame
    metrics: pd.DataFrame
    curves: dict[CellKey, dict[str, Any]]
    tracks: dict[CellKey, dict[str, Any]]
    notes: Sequence[dict[str, Any]]
    times: dict[CellKey, dict[str, StepTimes]]
    warning: str = ""
    records: Sequence[RecordedCondition] = ()


def read_study(
    conditions: Sequence[Condition], options: ReportOptions, *, has_metrics: bool = False
) -> StudyData:
    """Read the results of a study, one condition at a time."""
    rows, metrics, records, notes = [], [], [], list[dict[str, Any]]()
    data = StudyData(pd.DataFrame(), pd.DataFrame(), {}, {}, notes, {})
    start, converged = options.start_time_s, options.convergence_threshold
    most = count_carried_runs(max(len(c.jobs) for c in conditions), len(conditions))
    for condition, regime in zip(conditions, name_regimes(conditions), strict=True):
        results = {job.label: job.load() for job in condition.jobs}
        late = {label: drop_before(result, start) for label, result in results.items()}
        records.append(collect_record((condition.scenario, regime, condition.noise), late))
        parts = [
            job_rows((condition, regime, label), result, options.metric)
            for label, result in late.items()
        ]  # fmt: skip
        rows += parts
        for job in condition.jobs:
            notes.append(note_job(job.label, results[job.label]))
            if has_metrics:
                metrics.append(to_long_rows(condition, job, results[job.label], start, converged))
        key = condition.scenario, regime
        times = {job.label: StepTimes.from_metadata(job.meta) for job in condition.jobs}
        data.times[key] = {label: rounds for label, rounds in times.items() if rounds}
        data.curves[key] = make_curves(results, len(conditions))
        errors = pd.concat(parts).pivot_table("rmse", "filter", "run", dropna=False)
        if errors.shape == (len(results), len(parts[0])):  # all filters have the same runs
            values = errors.loc[list(results)].to_numpy()
            data.tracks[key] = make_tracks(
                results, values, [int(run) for run in errors.columns.to_numpy()], most
            )
    long_rows = pd.concat(metrics, ignore_index=True) if metrics else data.metrics
    return _leave_out_copies(
        data._replace(
            table=join_rows(rows, options.metric),
            metrics=long_rows,
            warning=describe_truth(notes),
            records=[record for record in records if record],
        )
    )


def _leave_out_copies(data: StudyData) -> StudyData:
    """Leave out copies of runs, and state runs that are not independent."""
    copies, sentence = assess_runs(data.table, "rmse", RUN)
    return data._replace(
        table=drop_runs(data.table, copies, RUN),
        metrics=drop_runs(data.metrics, copies, RUN),
        warning=" ".join(filter(None, (data.warning, sentence))),
    )


# --------------------------------------------------------------------------------------------------
# Decided parts of a page: all that follows from the runs of a study, and its other inputs.
#
# A published study keeps its runs and these facts, so that its page is decided again without results.

_BASELINES = (*REFERENCES, "ukf", "ckf")  # offered first if they are in the study
_MOST_BASELINES, _FEW_BASELINES = 3, 2
_MANY = 300  # filters times conditions, from which a page offers few baselines
# names of a look on a page
_LOOKS = {
    "key": "key", "name": "name", "long": "long_name", "family": "family", "proposed": "proposed", "colour": "colour",
    "dark": "dark_colour", "marker": "marker", "cite": "cite",
}  # fmt: skip


def decide_parts(table: pd.DataFrame, facts: StudyFacts) -> dict[str, Any]:
    """Decide all parts of a page that follow from the runs.

    Args:
        table: Table of `build_run_table`.
        facts: Inputs of decisions other than the runs.
    """
    looks, worlds, options = facts.looks, facts.worlds, facts.options
    court = open_court(table, looks, options)
    conditions = len(court.runs.conditions)
    most = _MOST_BASELINES if len(looks) * conditions <= _MANY else _FEW_BASELINES
    baselines = select_baselines(looks, options.baseline)[:most]
    groups = table.groupby(["scenario", "regime"])[["unit", "group"]].first()
    views, failed = build_views(court, groups, facts, baselines), len(facts.failures)
    missing = (
        f"{failed} {'job has' if failed == 1 else 'jobs have'} no valid result and "
        f"{'is' if failed == 1 else 'are'} missing from all tables."
    )
    recorded = decide_records(facts.records, court, baselines)
    for key, view in views.items():
        view["sentence"] = shorten_view(
            f"{view['sentence']} {describe_reach(recorded, (key.world, key.regime), worlds)}".rstrip()
        )
        view["small_print"] = " ".join(filter(None, (view["small_print"], facts.differing)))
    first = next(iter(views.values()))["rows"]
    return {
        "alpha": options.alpha,
        "margin": options.equivalence_margin,
        "filters": [
            {name: getattr(looks[row["filter"]], field) for name, field in _LOOKS.items()}
            for row in first
        ],
        "worlds": [asdict(name) for name in worlds.values()],
        "metrics": metric_entries(table, options.metric),
        "baselines": baselines,
        "views": views,
        "planned": planned_entries(court, facts),
        "decisions": list_decisions(court, options.metric),
        "recorded": recorded,
        "world_orders": order_worlds(court, views, facts),
        "warnings": [text for text in (missing * bool(failed), facts.warning) if text],
        "calibration": list_calibration(table),
        "runs": list_runs(table),
        "sweeps": list_sweeps(views, looks, options.metric),
        # what failed, without a traceback, which has paths of the machine and is in the note of the job
        "failures": [
            {name: f[name] for name in ("key", "choices", "message")} for f in facts.failures
        ],
    }


def open_court(
    table: pd.DataFrame, looks: Mapping[str, MethodLook], options: ReportOptions
) -> Court:
    """Open the court of a study: the pairs that are fixed before its results, and all others.

    Args:
        table: Table of `build_run_table`.
        looks: Looks by label.
        options: Options of the report.
    """
    baseline = select_baselines(looks, options.baseline)[0]
    fixed = fix_pairs(list(looks), plan_look_pairs(looks), baseline)
    margin = math.log1p(options.equivalence_margin)
    runs, in_worlds = arrange_runs(table, tuple(looks)), plan_world_pairs(table, looks)
    return Court(runs, fixed, margin, options.alpha, in_worlds)


def select_baselines(looks: Mapping[str, MethodLook], baseline: str = "") -> list[str]:
    """Select the baselines that a reader may choose, the one of the opening view first."""
    require(
        not baseline or baseline in looks,
        "report.baseline",
        "be a filter of the study",
        baseline,
        f"Choose from {', '.join(looks)}.",
    )
    names = [*_BASELINES, *(name for look in looks.values() for name in look.baselines)]
    available = [label for label in (baseline, *names) if label in looks]
    available += [label for name in names for label in looks if parse_label(label)[0] == name]
    available += [label for label, look in looks.items() if not look.proposed][:1]
    return list(dict.fromkeys(available)) or list(looks)[:1]


def planned_entries(court: Court, facts: StudyFacts) -> list[dict[str, Any]]:
    """List the entries of the pairs that were compared in advance, in ratios, with each scenario and a new world."""
    looks, options = facts.looks, facts.options
    mask = select_everywhere(court.runs)
    runs = court.runs.select(mask)
    pairs = [pair for pair in plan_look_pairs(looks) if share_conditions(runs, *pair)]
    planned = [court.find(options.metric, mask, *pair) for pair in pairs]
    losses = compute_losses(runs, options.metric)
    new = decide(compare_filters(runs, losses, pairs, "world"), court.margin, court.alpha)
    return [
        {
            "a": v.a, "b": v.b, "kind": _find_kind(looks[v.a], looks[v.b]), "word": v.word, "reason": v.reason or None,
            "words": word_verdict(v, court.margin), **show_ratio(v), "p": round_values(v.p),
            "loses": v.lost.word, "cells": _list_cells(court, options.metric, (v.a, v.b), facts.worlds),
            "new_world": {**show_ratio(w), "word": w.word, "worlds": w.n} if w.n >= MIN_RUNS else None,
        }
        for v, w in zip(planned, new, strict=True)
    ]  # fmt: skip


_NO_VERDICT = Verdict("", "", NO_DECISION, math.nan, math.nan, math.nan, math.nan, 0)
DECISION_COLUMNS = ("world", "family", *_NO_VERDICT.to_row())  #: of the table of all pairs


def list_decisions(court: Court, metric: str) -> list[dict[str, Any]]:
    """List the verdicts on all pairs with their families: over all conditions, and in each of a few scenarios.

    Of a scenario with pairs of its own that are fixed in advance, these pairs are listed.
    """
    worlds = select_each_world(court)
    is_few = 1 < len(worlds) <= MOST_WORLDS  # whose page has the order of each world
    scopes = {ALL: select_everywhere(court.runs)} | (worlds if is_few or court.fixed_in else {})
    return [
        {"world": world, "family": family, **verdict.to_row()}
        for world, mask in scopes.items()
        for family, verdict in court.list_verdicts(metric, mask, world == ALL or is_few)
    ]


def select_each_world(court: Court) -> dict[str, Flags]:
    """Select the conditions of the view of each scenario, [C]."""
    scenarios = court.runs.conditions["scenario"]
    return {
        str(name): select_common(court.runs, (scenarios == name).to_numpy())
        for name in scenarios.unique()
    }


def _find_kind(method: MethodLook, baseline: MethodLook) -> str:
    """Return whether a baseline is of the paper or a tuned one; empty for neither."""
    if parse_label(baseline.key)[0] in method.baselines:
        return "paper"
    return "tuned" if method.baselines and baseline.tuning else ""


def _list_cells(
    court: Court, metric: str, pair: tuple[str, str], worlds: Mapping[str, PartName]
) -> list[dict[str, Any]]:
    """List the ratio of a pair in each scenario, of its view; none for one scenario."""
    verdicts = {world: court.find(metric, mask, *pair) for world, mask in select_each_world(court).items()}  # fmt: skip
    return [
        {"world": world, "regime": ALL, "name": worlds[world].name, **show_ratio(verdict)}
        for world, verdict in verdicts.items()
        if verdict.n and len(verdicts) > 1
    ]


def round_ratio(log_ratio: float) -> float | None:
    """Return a ratio with eight digits, for pages that print three; None without a number."""
    if not math.isfinite(log_ratio):
        return None
    # the distance from 1 has the digits of a ratio near 1
    distance = float(f"{math.expm1(min(log_ratio, 700.0)):.8g}")
    return round(1 + distance, 12) if abs(distance) < 1 else float(f"{1 + distance:.8g}")


def show_ratio(verdict: Verdict) -> dict[str, float | None]:
    """Return the ratio of a verdict and its interval."""
    ends = {"estimate": verdict.ratio, "low": verdict.low, "high": verdict.high}
    rounded = {name: round_ratio(math.log(v) if v > 0 else -math.inf) for name, v in ends.items()}
    return rounded | ({"high": math.inf} if verdict.high == math.inf and verdict.low > 0 else {})


MOST_WORLDS = 3  # more worlds have a page of their own, or an average


def order_worlds(
    court: Court, views: Mapping[ViewKey, Mapping[str, Any]], facts: StudyFacts
) -> list[dict[str, Any]]:
    """Describe the order of each world: its sentence, its first filter, and the filters that do as well.

    Empty unless the study has two or three worlds, each one scenario, in one noise regime.
    """
    conditions, worlds = court.runs.conditions, select_each_world(court)
    is_few = 1 < len(worlds) <= MOST_WORLDS and conditions["family"].nunique() == len(worlds)
    if not is_few or conditions["regime"].nunique() > 1:
        return []
    (metric, *_, baseline), orders = next(iter(views)), []
    for world, mask in worlds.items():
        view = views[ViewKey(metric, world, ALL, baseline)]
        first, *others = [row["filter"] for row in view["rows"] if row["rank"] is not None]
        ties = [v for v in others if court.find(metric, mask, v, first).word != "worse"]
        is_said = not ties and first == baseline  # by the sentence of the view
        text = "" if is_said else _describe_ties(first, ties, len(others), facts.looks)
        orders.append({"world": world, "sentence": f"{view['sentence']} {text}".rstrip()})
    return orders


def _describe_ties(
    best: str, ties: Sequence[str], others: int, looks: Mapping[str, MethodLook]
) -> str:
    """Say which filters are not shown to be worse than the first one of a world."""
    first = f"[[{looks[best].name}]]"
    if not ties:
        return f"All others are worse than {first}." if others else ""
    names = ", ".join(f"[[{looks[label].name}]]" for label in ties)
    verb = "is" if len(ties) == 1 else "are"
    end = "" if len(ties) == others else " All others are."
    return f"{names} {verb} not shown to be worse than {first}, the first of this world.{end}"


# --------------------------------------------------------------------------------------------------
# Notes on each filter: particles, exactness, failures and modelling choices.

_COUNTS = ("runs", "lost", "diverged", "collapsed", "severely_overconfident")


def note_job(label: str, result: JobResult) -> dict[str, Any]:
    """Note what a job states: its failures, particles, exactness, truth and modelling choices."""
    meta, status = result.meta, count_statuses(result.data, result.meta)._asdict()
    return {
        "filter": label, **{name: int(status[name] or 0) for name in _COUNTS}, "has_limit": status["diverged"] is not None,
        "particles": meta.get("particles"),
        "is_exact": bool(meta.get("is_exact")), "has_bounded_weights": meta.get("has_bounded_weights"),
        "truth": meta.get("measured_truth"), "choices": [str(text) for text in meta.get("modelling_choices", ())],
    }  # fmt: skip


def describe_truth(notes: Sequence[Mapping[str, Any]]) -> str:
    """State what the errors are distances to, if that is measured; empty if it is not."""
    names = " and ".join(dict.fromkeys(str(note["truth"]) for note in notes if note["truth"] is not None))  # fmt: skip
    return f"Errors are distances to {names}, which have errors of their own." if names else ""


def join_notes(notes: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Join the notes on the jobs of each filter."""
    by_filter: dict[str, list[Mapping[str, Any]]] = {}
    for note in notes:
        by_filter.setdefault(note["filter"], []).append(note)
    entries = []
    for label, jobs in by_filter.items():
        counts = {name: sum(job[name] for job in jobs) for name in _COUNTS}
        bounded = {job["has_bounded_weights"] for job in jobs}
        particles = dict.fromkeys(str(job["particles"]) for job in jobs if job["particles"] is not None)  # fmt: skip
        entries.append({
            "filter": label, "particles": " or ".join(particles), "is_exact": all(job["is_exact"] for job in jobs),
            "has_bounded_weights": None if None in bounded else all(bounded),
            **counts,
            "diverged": counts["diverged"] if any(job["has_limit"] and job["runs"] for job in jobs) else None,
        })  # fmt: skip
    return entries


def list_modelling_choices(
    notes: Sequence[Mapping[str, Any]], looks: Mapping[str, MethodLook]
) -> list[dict[str, str]]:
    """List the modelling choices, with the names of the filters that make them, "all filters" if none is missing."""
    pairs = {(text, note["filter"]) for note in notes for text in note["choices"]}
    labels = {text: [v for v in looks if (text, v) in pairs] for text, _ in sorted(pairs)}
    return [
        {"text": text, "filters": "all filters" if len(some) == len(looks) else ", ".join(looks[v].name for v in some)}
        for text, some in labels.items()
    ]  # fmt: skip
