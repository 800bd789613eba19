"""Page of the diagnosis of an own log: findings with a picture each, facts, and settings that run as they are."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import yaml
from matplotlib.figure import Figure

from pfbench.files.recorded_folder import RecordedFolder
from pfbench.logs.doctor.finding import Finding, LogDiagnosis
from pfbench.report import writers
from pfbench.report.page_kit import Block, write_page
from pfbench.results.plotting import FigureSpec, format_slug, stacked_axes

_FEW_POINTS = 100  # of a curve whose points are marked
_ABOUT = {
    "refuse": "A run refuses the log until it is mended.",
    "warn": "A run continues, and its result is probably wrong.",
    "tell": "A run continues.",
}


def write_log_page(
    diagnosis: LogDiagnosis,
    source: Mapping[str, Any],
    out: str | Path,
    formats: tuple[str, ...] = ("svg", "png"),
) -> Path:
    """Write `<out>/inspect_<name>/` with the page and `scenario/suggested.yaml`. Equal logs give equal bytes.

    Args:
        diagnosis: Findings, facts and settings.
        source: Name, folder and root of the log, and the words that read it, such as files.
        out: Folder of all reports.
        formats: Formats of the pictures.

    Returns:
        Path of index.html.
    """
    name = format_slug(f"inspect_{source['name']}")
    content = {
        "defaults": [source.get("scenario", "user_log"), "_self_"], "folder": source["folder"], **source["words"], **diagnosis.settings,
    }  # fmt: skip
    text = yaml.safe_dump(json.loads(json.dumps(content)), sort_keys=False, default_flow_style=None, width=100)  # fmt: skip
    suggested = f"# Written by pfbench inspect: settings that mend what it named.\n{text}"
    with RecordedFolder(Path(out) / name) as folder:
        folder.write("scenario/suggested.yaml", suggested)
        findings = [
            _describe(number, finding, folder, formats)
            for number, finding in enumerate(diagnosis.findings, 1)
        ]
        mends = (
            "The file scenario/suggested.yaml mends what has a remedy by keys."
            if diagnosis.settings
            else "No finding has a remedy by keys."
        )
        remaining = ", ".join(dict.fromkeys(diagnosis.remaining))
        blocks = [
            Block("title", f"Log {source['name']}"),
            Block("text", f"{len(findings)} findings. Each states its statistic, threshold, evidence and remedy."),
            Block("heading", "Findings"),
            Block("text", "" if findings else "No check speaks."),
            *itertools.chain.from_iterable(findings),
            Block("heading", "Suggested settings"),
            Block("text", mends + (f" Left with these settings: {remaining}." if remaining else "")),
            Block("code", suggested),
            Block("code", describe_run(folder.path, source["root"])),
            Block("heading", "Facts"),
            Block("terms", [
                (key, f"{value:.4g}" if isinstance(value, float) else json.dumps(value)) for key, value in sorted(diagnosis.facts.items())
            ]),
        ]  # fmt: skip
        return write_page(folder, f"Log {source['name']}: findings", blocks)


def describe_run(folder: Path, root: Path) -> str:
    """Return the command that runs a filter with the suggested settings.

    Args:
        folder: Folder of the page.
        root: Folder of the log's folder.

    Returns:
        The command.
    """
    path = f"'hydra.searchpath=[own://{folder.resolve()}]'"
    return f"pfbench run data.root={root} {path} scenario=suggested filter=ekf runs=5"


def _describe(number: int, finding: Finding, folder: RecordedFolder, formats: Sequence[str]) -> list[Block]:  # fmt: skip
    """Return the blocks of a finding."""
    drawings: list[dict[str, Any]] = []
    if finding.picture is not None:
        caption = f"{finding.check}: {finding.evidence}."
        figure = FigureSpec(f"{number:02d}_{format_slug(finding.check)}", caption, partial(draw_labelled_curves, *finding.picture))  # fmt: skip
        drawings = writers.write_figures([figure], "finding", folder, formats)
    mending = yaml.safe_dump(
        json.loads(json.dumps({"scenario": finding.settings})), default_flow_style=None, width=100
    ).rstrip()
    return [
        Block("part", f"{number}. {finding.check} ({finding.level})"),
        Block("alarm" if finding.level == "refuse" else "text", f"{finding.evidence}."),
        Block("text", f"Statistic: {finding.statistic:.4g} {finding.unit}, threshold {finding.threshold:g}. {_ABOUT[finding.level]}"),
        Block("list", [f"It can be: {text}" for text in finding.explanations]),
        Block("text", finding.remedy and f"{finding.remedy}."),
        Block("code", mending if finding.settings else ""),
        Block("figures", drawings),
    ]  # fmt: skip


def draw_labelled_curves(
    xlabel: str, ylabel: str, curves: Sequence[tuple[Any, ...]], marks: Sequence[float] = (), *, is_map: bool = False
) -> Figure:  # fmt: skip
    """Draw curves, each with a label, horizontal and vertical values and perhaps a style, and marks; a map has equal scales."""
    figure, (axis,) = stacked_axes(1, 3.2 if is_map else 2.2)
    for label, x, y, *style in curves:
        axis.plot(x, y, *(style or [".-" if len(x) < _FEW_POINTS else "-"]), linewidth=0.8, label=label)  # fmt: skip
    for mark in marks:
        axis.axvline(mark, color="0.5", linewidth=0.8, linestyle=":")
    axis.set(xlabel=xlabel, ylabel=ylabel)
    axis.set_aspect("equal" if is_map else "auto", adjustable="datalim")
    axis.legend(fontsize="small")
    return figure
