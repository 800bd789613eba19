"""Page of the diagnosis of an own log: findings with a picture each, facts, and settings that run as they are."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import yaml
from matplotlib.figure import Figure

from pfbench.files.recorded_folder import RecordedFolder
from pfbench.logs.doctor.finding import Finding, LogDiagnosis, Picture
from pfbench.report import writers
from pfbench.results.plotting import FigureSpec, format_slug, stacked_axes

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
    suggested = format_settings(diagnosis.settings, source)
    with RecordedFolder(Path(out) / name) as folder:
        folder.write("scenario/suggested.yaml", suggested)
        findings = [
            _describe(number, finding, folder, formats)
            for number, finding in enumerate(diagnosis.findings, 1)
        ]
        context = {
            "name": source["name"],
            "findings": findings,
            "facts": [
                {"name": key, "value": f"{value:.4g}" if isinstance(value, float) else json.dumps(value)}
                for key, value in sorted(diagnosis.facts.items())
            ],
            "settings": suggested,
            "mends": bool(diagnosis.settings),
            "remaining": ", ".join(dict.fromkeys(diagnosis.remaining)),
            "command": describe_run(folder.path, source["root"]),
        }  # fmt: skip
        return writers.render_template("log_page", folder, context, Path(__file__).parent)


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


def format_settings(settings: Mapping[str, Any], source: Mapping[str, Any]) -> str:
    """Return the text of suggested.yaml: the scenario user_log with the settings.

    Args:
        settings: Keys below `scenario`.
        source: Folder and the words that read the log.

    Returns:
        YAML.
    """
    content: dict[str, Any] = {
        "defaults": [source.get("scenario", "user_log"), "_self_"],
        "folder": source["folder"],
        **source["words"],
        **settings,
    }
    head = "# Written by pfbench inspect: settings that mend what it named.\n"
    return head + yaml.safe_dump(_plain(content), sort_keys=False, default_flow_style=None, width=100)  # fmt: skip


def _plain(value: Any) -> Any:
    """Convert mappings, sequences and numbers to those of YAML."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return float(value) if isinstance(value, float) else value


def _describe(number: int, finding: Finding, folder: RecordedFolder, formats: Sequence[str]) -> dict[str, Any]:  # fmt: skip
    """Return what a template shows of a finding."""
    settings = finding.settings
    drawing = None
    if finding.picture is not None:
        caption = f"{finding.check}: {finding.evidence}."
        figure = FigureSpec(f"{number:02d}_{format_slug(finding.check)}", caption, partial(_draw, finding.picture))  # fmt: skip
        (drawing,) = writers.write_figures([figure], "finding", folder, formats)
    return {
        "check": finding.check,
        "level": finding.level,
        "about": _ABOUT[finding.level],
        "numbers": f"{finding.statistic:.4g} {finding.unit}, threshold {finding.threshold:g}",
        "evidence": finding.evidence,
        "remedy": finding.remedy,
        "explanations": list(finding.explanations),
        "settings": yaml.safe_dump(_plain({"scenario": settings}), default_flow_style=None, width=100).rstrip()
        if settings
        else "",
        "drawing": drawing,
    }  # fmt: skip


def _draw(picture: Picture) -> Figure:
    """Draw the curves of a finding, and its marks."""
    figure, (axis,) = stacked_axes(1, 2.2)
    for label, x, y in picture.curves:
        marker = "." if len(x) < 100 else ""
        axis.plot(x, y, marker=marker, linewidth=0.8, label=label)
    for mark in picture.marks:
        axis.axvline(mark, color="0.5", linewidth=0.8, linestyle=":")
    axis.set(xlabel=picture.xlabel, ylabel=picture.ylabel)
    axis.legend()
    return figure
