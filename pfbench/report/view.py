"""What a report shows, and which filters are in colour."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from pfbench.report.canvas import Look, dimmed, looks
from pfbench.report.frame import Cell, natural

_PLENTY = 50  # filters times cells; of more, a page shows the figures of one group per cell, and comparisons with the best [ours]
_NAMED = 7  # filters of which each has a colour of its own; of more than eight the others are grey [ours]
_FORMATS = ("svg", "png")


@dataclass(frozen=True)
class Options:
    """What a report shows.

    Attributes:
        groups: groups of the state, None for all.
        alpha: level of the tests after Holm's correction, and probability outside the bands.
        from_time: leave out of all figures of merit what came before, seconds; curves over time show all.
        formats: of the figures: svg, png; the page carries of each figure the smaller one.
        mixed: accept results of several versions, seeds, runs or lengths side by side.
        converged: bounds by group, in the unit shown, for the time to converge, which counts from the start of the record.
        margin: share by which RMSE may differ between filters that count as equal.
        wanted: share by which RMSE differs in the effect for which the needed number of runs is computed.
        figures: names of `paper_figures.FIGURES` to draw; None for those of the paper that the study is named after.
        highlight: filters in colour where there are more than eight, the others being grey; None for the best of each cell.
        full: show all figures and comparisons; None for all where filters times cells are at most 50.
        planned: how many jobs the study's experiment asks for, where one does.

    Raises:
        ValueError: a value out of range.
    """

    groups: tuple[str, ...] | None = None
    alpha: float = 0.05
    from_time: float = 0.0
    formats: tuple[str, ...] = ("svg", "png")
    mixed: bool = False
    converged: Mapping[str, float] = field(default_factory=dict)
    margin: float = 0.05
    wanted: float = 0.1
    figures: tuple[str, ...] | None = None
    highlight: tuple[str, ...] | None = None
    full: bool | None = None
    planned: int | None = None

    def __post_init__(self) -> None:
        if not 0 < self.alpha < 1:
            raise ValueError(f"alpha={self.alpha} is no probability; 0.05 is usual")
        for name in ("margin", "wanted"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}={getattr(self, name)} is no share by which errors differ; 0.05 is five per cent")
        if not self.formats or set(self.formats) - set(_FORMATS):
            raise ValueError(f"formats={list(self.formats)}: choose from {', '.join(_FORMATS)}")


class View(NamedTuple):
    """What all parts of a page are made with.

    Attributes:
        groups: of the state, shown.
        style: looks of the filters.
        folder: of the report.
        options: as given.
        brief: the study is too large to show all.
    """

    groups: Sequence[str]
    style: Mapping[str, Look]
    folder: Path
    options: Options
    brief: bool


def colours_first(labels: Sequence[str], highlight: Sequence[str] | None) -> list[str]:
    """Labels with those in colour before the others, whose looks repeat.

    Raises:
        ValueError: a filter that did not run.
    """
    unknown = sorted(set(highlight or ()) - set(labels))
    if unknown:
        raise ValueError(f"report.highlight: no result is of {', '.join(unknown)}; there are {', '.join(labels)}")
    return list(dict.fromkeys([*(highlight or ()), *labels]))


def is_brief(found: Sequence[Cell], options: Options) -> bool:
    most = max(len(cell.jobs) for cell in found) * len(found)
    return not options.full if options.full is not None else most > _PLENTY


def looks_of(view: View, labels: Sequence[str], best: Sequence[str], by: str) -> tuple[Mapping[str, Look], str]:
    """Looks for a figure with a line per filter, and who is grey, for its caption; all are named where they are few.

    Args:
        view: of the page.
        labels: of the filters shown.
        best: the same, best first.
        by: what makes them best.
    """
    if len(labels) <= _NAMED + 1:
        return view.style, ""
    chosen = [label for label in view.options.highlight or () if label in labels]
    if chosen:
        others = len(labels) - len(chosen)
        return dimmed(view.style, chosen), f" In colour: {', '.join(chosen)}; grey: the other {others}."
    kept = sorted(best[:_NAMED], key=natural)
    said = f" In colour: the {_NAMED} with {by}, in colours of these figures' own; grey: the other {len(labels) - len(kept)}."
    quiet = dimmed(view.style, kept)
    return {**quiet, **{label: look._replace(instants=quiet[label].instants) for label, look in looks(kept).items()}}, said
