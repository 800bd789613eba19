"""Page of a judgement: report.md, index.html, decisions.json, tables and figures."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pfbench.files.recorded_folder import RecordedFolder
from pfbench.judge.block_decisions import describe_blocks
from pfbench.judge.judge_notes import describe_notes
from pfbench.judge.judge_options import JudgeOptions
from pfbench.judge.judge_tables import blocks_table, error_figures, files_table, tabulate_accuracy
from pfbench.judge.judgement import Judgement
from pfbench.report import writers
from pfbench.results.decisions.decision import Decision
from pfbench.results.decisions.sentences import describe_pair, describe_ranking, describe_total
from pfbench.results.metrics import metric_definitions
from pfbench.results.statistics.paired_effects import MIN_RUNS


def write_judgement(
    judgement: Judgement,
    out: str | Path,
    name: str,
    options: JudgeOptions,
    formats: tuple[str, ...] = ("svg", "png"),
) -> Path:
    """Write `<out>/<name>/`. Equal files give equal bytes.

    Args:
        judgement: Judgement.
        out: Folder of all reports.
        name: Name of the report, a folder.
        options: Options of the comparison.
        formats: File formats of the figures.

    Returns:
        Path of index.html.
    """
    tables = {
        "accuracy": tabulate_accuracy(judgement.sequences),
        "along_runs": blocks_table(judgement.along_runs),
        "files": files_table(judgement.sequences),
    }
    context: dict[str, Any] = {
        "name": name,
        "head": describe_material(judgement),
        "summary": list(describe_judgement(judgement)),
        "notes": list(describe_notes(judgement, options)),
        "limits": list(_describe_limits(judgement)),
        "definitions": [d for d in metric_definitions() if d.startswith(("CRPS", "coverage"))],
        "sensors": "CRPS [m]" in tables["accuracy"],
        **tables,
    }
    text = json.dumps(decisions_as_json(judgement, options), indent=1, allow_nan=False)
    with RecordedFolder(Path(out) / name) as folder:
        folder.write("decisions.json", text + "\n")
        for table, content in tables.items():
            if len(content):
                writers.write_table(folder, table, content)
        figures = error_figures(judgement.sequences)
        context["drawings"] = writers.render_figures(figures, "judge", folder, formats)
        return writers.render_template("judge", folder, context, Path(__file__).parent)


def decisions_as_json(judgement: Judgement, options: JudgeOptions) -> dict[str, Any]:
    """Return all decisions in JSON types.

    Args:
        judgement: Judgement.
        options: Options of the comparison.

    Returns:
        Keys options, decisions, along_runs and ranking.
    """
    return {
        "options": writers.to_json_types(asdict(options)),
        "decisions": [decision.to_dict() for decision in judgement.decisions],
        "along_runs": [result.to_dict() for result in judgement.along_runs],
        "ranking": [
            {"question": r.question, "top_group": list(r.top_group), "ranks": r.ranks}
            for r in judgement.rankings
        ],
    }


def describe_material(judgement: Judgement) -> str:
    """Describe programs, sequences, runs and scored time."""
    programs = list(dict.fromkeys(run.program for s in judgement.sequences for run in s.runs))
    runs = sum(len(s.runs) for s in judgement.sequences)
    seconds = sum(float(s.epochs.time[-1] - s.epochs.time[0]) for s in judgement.sequences)
    epochs = sum(len(s.epochs.time) for s in judgement.sequences)
    return (
        f"Programs: {', '.join(programs)}. Sequences: {len(judgement.sequences)}. Trajectories: {runs}. "
        f"Scored: {epochs} common epochs in {seconds:.6g} s."
    )


def describe_judgement(judgement: Judgement) -> Iterator[str]:
    """Yield the sentences of all decisions."""
    decisions = judgement.decisions
    for question in ("a", "b") if decisions else ():
        for track, error in _pairs_of(decisions, question):
            if question == "b" or error.runs >= MIN_RUNS:
                yield describe_pair(track, error)
    if decisions:
        yield describe_total(list(decisions))
    if judgement.rankings:
        first = judgement.rankings[0].top_group[0]
        yield describe_ranking(judgement.rankings[0], judgement.rankings[1], first)
    for result in judgement.along_runs:
        yield describe_blocks(result)
    if not judgement.pairs:
        yield "One program: nothing is compared. The tables state its errors."


def _pairs_of(
    decisions: tuple[Decision, ...], question: str
) -> Iterator[tuple[Decision, Decision]]:
    of_question = [d for d in decisions if d.question == question]
    yield from zip(of_question[::2], of_question[1::2], strict=True)


def _describe_limits(judgement: Judgement) -> Iterator[str]:
    """Yield the reach of the conclusions."""
    count = len(judgement.sequences)
    if count == 1:
        yield (
            "One sequence: the decisions hold for this recording. Blocks of time measure how errors vary "
            "along it, and do not show how they vary between recordings."
        )
    else:
        yield (
            f"A sequence is one world: the decision for a new world has {count} samples, one per sequence. "
            "Epochs and blocks are no samples for it."
        )
    yield (
        "Blocks of time: neighbouring errors depend on each other, so that epochs are no samples. The "
        "stationary bootstrap resamples blocks of random length with the stated mean. Fewer than 6 blocks "
        "give an effect without a test."
    )
    yield (
        "Position errors are estimate minus reference at the epochs of the programs. The reference is "
        "interpolated, the estimates are not. Errors of the reference count as errors of all programs."
    )
    yield (
        "RMSE: root mean square over the scored epochs. With several runs, RMSE, quantile and maximum are "
        "means over the valid runs. Epochs in holes are scored, so more epochs than rows can be scored."
    )
