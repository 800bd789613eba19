"""Recorded data by three units, each with its own question: starts and random numbers, blocks of time, and drives.

Runs of one recorded drive share its motion, its sensors and its surroundings. Their spread says whether other random
numbers would change the order of two filters. It does not say whether another stretch of the road, or another drive,
would: these are other units, with p-values of their own.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pfbench.report.board.curves import scale_errors
from pfbench.report.board.entries import round_values
from pfbench.report.journal.study_pack import name_of
from pfbench.report.methods_text import is_recorded
from pfbench.results.looks import PartName
from pfbench.results.store import JobResult
from pfbench.stats.comparison import NO_DECISION, SAME_RUNS, Effect, Verdict, compare, decide
from pfbench.stats.court import Court
from pfbench.stats.error_measures import Array, Flags
from pfbench.stats.sentences import format_count, format_digits
from pfbench.stats.study_runs import StudyRuns, compute_losses, locate_groups
from pfbench.stats.time_blocks import (
    block_losses,
    compare_blocks,
    count_blocks,
    remove_drift,
    withhold,
)

# what each p-value answers
QUESTIONS = {
    "starts": "Starts and random numbers: would the order stay with other starts, particles and simulated errors, on the same record?",
    "blocks": "Blocks of time: would the order hold on other stretches like those of this record?",
    "drives": "Drives: would the order hold on another drive of the kind of these?",
}  # fmt: skip
_ADDED = (
    "position_sd",
    "velocity_sd",
    "range_sd",
    "rate_sd",
)  # of errors added to recorded measurements
_NO_CAP = 1e300
RecordedCondition = Mapping[str, Any]


def collect_record(
    origin: tuple[str, str, str], results: Mapping[str, JobResult]
) -> RecordedCondition | None:
    """Collect the losses of all filters in the blocks of time of a recorded condition.

    Args:
        origin: Scenario, regime and noise of the condition.
        results: Results by label, of the same runs.

    Returns:
        Plain values; None for simulated data.
    """
    first = next(iter(results.values()))
    if not is_recorded(first.meta):
        return None
    config, drives = first.meta["config"], count_drives(first.meta)
    errors = {label: scale_errors(result) for label, result in results.items()}
    numbers = np.arange(len(first.data["lost"])) + int(first.meta.get("first_run", 0))
    world, regime, noise = origin
    return {
        "world": world, "regime": regime, "noise": noise, "added": _describe_added(config["scenario"]),
        "simulated": _describe_regime(config["noise"]), "drives": len(np.unique(numbers % drives)), "recorded": drives,
        "runs": len(numbers), **_list_losses(errors, np.asarray(first.data["time"], float), numbers % drives),
    }  # fmt: skip


def count_drives(meta: Mapping[str, Any]) -> int:
    """Return the number of drives of a recorded scenario; run r uses drive r modulo this number."""
    return len(meta["config"]["scenario"].get("flights") or (1,))


def _describe_added(scenario: Mapping[str, Any]) -> str:
    """Name the standard deviations of added errors that are not 0."""
    receiver = (scenario.get("flight") or scenario).get("receiver") or {}
    sds = {name: np.atleast_1d(receiver[name]) for name in _ADDED if receiver.get(name)}
    return "; ".join(
        f"{name} {', '.join(f'{v:g}' for v in sd)}" for name, sd in sds.items() if sd.any()
    )


def _describe_regime(noise: Mapping[str, Any]) -> str:
    """Name the numbers of a noise regime that are not 0."""
    values = {name: value for name, value in noise.items() if name != "paper" and not name.startswith("_") and value}  # fmt: skip
    return "; ".join(
        f"{name} {', '.join(f'{v:g}' for v in np.ravel(value))}"
        for name, value in values.items()
        if np.issubdtype(np.asarray(value).dtype, np.number)
    )


def _list_losses(errors: Mapping[str, Array], time: Array, drive: np.ndarray) -> dict[str, Any]:
    """List seconds, and the losses by blocks of each filter: of its errors, and without mean and drift of each run.

    Shapes: errors [R, T, K] by label, time [T], drive [R].
    """
    steps = []
    for number in np.unique(drive):
        finite = [np.isfinite(e[drive == number]).all(-1).any(0) for e in errors.values()]
        where = np.flatnonzero(np.logical_or.reduce(finite))
        steps += [(drive == number, where)] * (len(where) > 1)
    seconds = [float(time[where[-1]] - time[where[0]]) for _, where in steps]
    counts = count_blocks(seconds) if sum(seconds) > 0.0 else []

    def losses(error: Array) -> list[float]:
        parts = [
            block_losses(_mean_size(error[runs][:, where]), count, _NO_CAP)
            for (runs, where), count in zip(steps, counts, strict=True)
        ]
        return [float(f"{v:.7g}") for v in np.concatenate([*parts, np.empty(0)])]

    return {
        "seconds": round(sum(seconds), 3),
        "filters": {
            label: {"blocks": losses(error), "steady": losses(_without_drift(error))}
            for label, error in errors.items()
        },
    }


def _mean_size(error: Array) -> Array:
    """Return the root mean square error over the runs that have one, [1, T, 1]; of the largest where none has one.

    Shapes: error [R, T, K].
    """
    square = (error**2).sum(-1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # steps without a run
        mean = np.nanmean(square, axis=0)
    largest = float(np.nanmax(mean)) if np.isfinite(mean).any() else 0.0
    return np.sqrt(np.where(np.isfinite(mean), mean, largest))[None, :, None]


def _without_drift(error: Array) -> Array:
    """Remove mean and drift of each run over its steps with truth. Shapes: error [R, T, K]."""
    steady = error.copy()
    for run in steady:
        finite = np.isfinite(run).all(-1)
        if finite.any():
            run[finite] = remove_drift(run[finite])
    return steady


def decide_records(
    records: Sequence[RecordedCondition], court: Court, baselines: Sequence[str]
) -> list[dict[str, Any]]:
    """Decide each filter of recorded conditions against the baseline, by each unit.

    Args:
        records: Conditions of `collect_record`.
        court: Court that decides the pairs of the study, in runs.
        baselines: Labels of the baselines, the first that a condition has counts.

    Returns:
        The conditions with a row per filter: verdict, ratio, interval and p-value by unit.
    """
    decided, conditions = [], court.runs.conditions
    for record in records:
        labels = [label for label in record["filters"] if label in court.runs.filters]
        base = next((label for label in (*baselines, *labels) if label in labels), "")
        pairs = [(label, base) for label in labels if label != base]
        mask = ((conditions["scenario"] == record["world"]) & (conditions["regime"] == record["regime"])).to_numpy()  # fmt: skip
        if mask.any():
            verdicts = _decide_units(record, court, mask, pairs)
            decided.append({
                **{key: record[key] for key in ("world", "regime", "noise", "added", "simulated", "seconds", "drives", "runs")},
                "baseline": base,
                "rows": [{"filter": label, **{unit: v[k] for unit, v in verdicts.items()}} for k, (label, _) in enumerate(pairs)],
            })  # fmt: skip
    return decided


def _decide_units(
    record: RecordedCondition, court: Court, mask: Flags, pairs: Sequence[tuple[str, str]]
) -> dict[str, list[dict[str, Any]]]:
    """Decide the pairs of one condition by each unit; the words on starts are those of the study."""
    cell, levels = court.runs.select(mask), (court.margin, court.alpha)
    units = {
        "starts": [_to_entry(court.find("rmse", mask, *pair)) for pair in pairs],
        "blocks": _decide_blocks(record, cell, pairs, levels),
    }
    if record["drives"] > 1:
        losses = compute_losses(cell, "rmse")
        effects = [_compare_drives(record["recorded"], cell, losses, pair) for pair in pairs]
        units["drives"] = [_to_entry(v) for v in decide(effects, *levels)]
    return units


def _decide_blocks(
    record: RecordedCondition,
    cell: StudyRuns,
    pairs: Sequence[tuple[str, str]],
    levels: tuple[float, float],
) -> list[dict[str, Any]]:
    """Decide the pairs by blocks of time; a lost run is one event, whatever its blocks."""

    def compare_by(kind: str) -> list[Any]:
        sides = {label: (label, np.array(v[kind])) for label, v in record["filters"].items()}
        return [compare_blocks(sides[a], sides[b]) for a, b in pairs]

    full, steady = compare_by("blocks"), compare_by("steady")
    verdicts = [decide([e.effect for e in effects], *levels) for effects in (full, steady)]
    entries = []
    for k, pair in enumerate(pairs):
        effective = min(full[k].effective, steady[k].effective)
        verdict = withhold(verdicts[0][k], verdicts[1][k], effective)
        if lost := _count_lost(cell, pair):
            verdict = verdict._replace(word=NO_DECISION, reason=lost)
        entries.append({**_to_entry(verdict), "effective": float(f"{effective:.3g}")})
    return entries


def _count_lost(cell: StudyRuns, pair: tuple[str, str]) -> str:
    """Count the runs of a pair that do not keep track; empty if all do."""
    lost = {
        name: cell.present[i] & ~cell.keeps[i] for name in pair for i in [cell.filters.index(name)]
    }
    return " and ".join(
        f"{name} loses track in {int(flags.sum())} of {format_count(int(cell.present[0].sum()), 'run')}"
        for name, flags in lost.items()
        if flags.any()
    )


def _compare_drives(drives: int, cell: StudyRuns, losses: Array, pair: tuple[str, str]) -> Effect:
    """Compare the log ratios of the drives in the runs that both filters have."""
    i, j = (cell.filters.index(name) for name in pair)
    common: Flags = (cell.present[i] & cell.present[j])[0]
    first, second = losses[i, 0, common], losses[j, 0, common]
    drive = cell.values["run"][i, 0, common].astype(int) % drives
    groups = [(first[drive == number], second[drive == number]) for number in np.unique(drive)]
    return compare(*locate_groups(pair, groups), "drive")


def _to_entry(verdict: Verdict) -> dict[str, Any]:
    """Return the plain values of a verdict."""
    names = ("word", "ratio", "low", "high", "p", "n", "reason")
    return {**round_values({name: getattr(verdict, name) for name in names}, 8), "reason": verdict.reason}  # fmt: skip


def describe_reach(
    decided: Sequence[Mapping[str, Any]], scope: tuple[str, str], worlds: Mapping[str, PartName]
) -> str:
    """Say of what the runs of recorded conditions in a scope are a sample; empty without any.

    Args:
        decided: Conditions of `decide_records`.
        scope: Scenario and regime of a view, or "all".
        worlds: Names of the scenarios by key.
    """
    sentences = []
    for world in dict.fromkeys(str(record["world"]) for record in decided):
        records = [
            r for r in decided
            if r["world"] == world and all(s in ("all", r[k]) for s, k in zip(scope, ("world", "regime"), strict=True))
        ]  # fmt: skip
        if not records:
            continue
        drives, kind = records[0]["drives"], _count_recorded(records[0]["drives"])
        unit, by = ("blocks", "blocks of time") if drives == 1 else ("drives", "drives")
        words = Counter(row[unit]["word"] for record in records for row in record["rows"])
        texts = ", ".join(f"{n} {word}" for word, n in words.items())
        name = worlds[world].name if world in worlds else world
        where = f"On {kind}" if len(worlds) == 1 else f"{name}, {kind}"
        sentences.append(f"{where}; by {by} {texts}." if texts else f"{where}.")
    return " ".join(sentences)


def describe_drives(name: str, drives: int) -> str:
    """Say of what the runs of recorded drives are a sample."""
    on = "it" if drives == 1 else "them"
    return f"{name} is {_count_recorded(drives)}: these words are about other starts and random numbers on {on}"


def _count_recorded(drives: int) -> str:
    """Count recorded drives in words."""
    return "one recorded drive" if drives == 1 else f"{drives} recorded drives"


def describe_records(pack: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the recorded conditions of a page as texts: source, questions, and a row per filter."""
    names = {look["key"]: look["name"] for look in pack["filters"]}
    regimes = {entry["key"]: entry for entry in pack["regimes"]}
    return [
        {
            "title": f"{name_of(pack, 'worlds', record['world'])}, {regimes[record['regime']]['name']}",
            "source": _describe_source(record, str(regimes[record["regime"]]["words"])),
            "baseline": names[record["baseline"]],
            "rows": [
                {
                    "name": names[row["filter"]],
                    **{unit: _describe_verdict(row.get(unit), unit) for unit in QUESTIONS},
                }
                for row in record["rows"]
            ],
        }
        for record in pack.get("recorded", ())
    ]


def _describe_source(record: Mapping[str, Any], words: str) -> str:
    """Say what is recorded and what is simulated."""
    is_noisy = record["noise"] != "nominal"
    parts = [(words, record["simulated"])] * is_noisy + [("white errors", record["added"])] * bool(record["added"])  # fmt: skip
    texts = [f"{name} ({numbers})" if numbers else name for name, numbers in parts]
    source = f"Measurements: recorded, plus simulated {' and '.join(texts)}" if texts else "Measurements as recorded"  # fmt: skip
    drives = "One drive" if record["drives"] == 1 else f"{record['drives']} drives"
    return f"{source}. {drives} of {format_digits(record['seconds'])} s, {format_count(record['runs'], 'run')}."


def _describe_verdict(entry: Mapping[str, Any] | None, unit: str) -> str:
    """Format the verdict of a unit with its p-value and its sample."""
    if entry is None:
        return "not asked: one drive"
    count = format_count(entry["n"], {"starts": "run", "blocks": "block", "drives": "drive"}[unit])
    if unit == "blocks":
        count += f", as {format_digits(entry['effective'], 2)} independent"
    parts = []
    if entry["word"] != SAME_RUNS and entry["ratio"] is not None:
        bounds = [entry["low"], entry["high"]]
        ends = "" if None in bounds else f" [{', '.join(map(format_digits, bounds))}]"
        p = [] if entry["p"] is None else [f"p = {format_digits(entry['p'], 2)}"]
        parts = [*p, f"ratio {format_digits(entry['ratio'])}{ends}"]
    text = f"{entry['word']} ({', '.join([*parts, count])})"
    return ": ".join(filter(None, (text, entry["reason"])))


def list_questions(pack: Mapping[str, Any]) -> list[str]:
    """List what the p-values of recorded conditions answer; nothing without any."""
    note = (
        "Each column is a family of its own. Blocks depend on their neighbours: the number of independent ones with the "
        "same variance of the mean is stated. A mean error or a drift of the whole record is one draw, which no "
        "number of blocks shows."
    )
    return [*QUESTIONS.values(), note] if pack.get("recorded") else []
