"""Options of a report, and the selection of highlighted filters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from pfbench.files.recorded_folder import RecordedFolder
from pfbench.report.plots.plotting import LineStyle, mute_others
from pfbench.results.conditions import Condition, natural_sort_key
from pfbench.results.study_decisions.main_metrics import check_main_metric

_PLENTY = 50  # filters times conditions above which a report is brief [ours]
_NAMED = 7  # coloured filters at most; with more than eight filters the others are grey [ours]
_FORMATS = ("svg", "png")


@dataclass(frozen=True)
class ReportOptions:
    """Options of a report.

    Attributes:
        groups: Component groups that are shown, None for all.
        alpha: Level of the tests after Holm's correction, and probability outside intervals.
        start_time_s: Start time of all measures, s. Curves over time show all times.
        figure_formats: Formats of the figures, svg or png. The page embeds the smaller file.
        allow_mixed_versions: Whether results of several versions, seeds, runs or lengths are accepted.
        convergence_threshold: Error limit by group, in the displayed unit, for the convergence time, which
            counts from the start of the record.
        equivalence_margin: Relative difference of RMSE up to which filters are equivalent.
        target_effect: Relative difference of RMSE for which the required runs are computed.
        paper_figures: Names of `paper_figures.FIGURES`, None for the paper of the study's name.
        highlight_filters: Coloured filters if there are more than eight, None for the best filters.
        show_all: Whether to show all figures and comparisons. None shows all if filters times
            conditions are at most 50.
        planned: Number of jobs of the experiment, if known.
        metric: Metric of the main group that decides, one of `main_metrics.MAIN_METRICS`. The others are
            in the second family.

    Raises:
        ValueError: If a value is out of range.
    """

    groups: tuple[str, ...] | None = None
    alpha: float = 0.05
    start_time_s: float = 0.0
    figure_formats: tuple[str, ...] = ("svg", "png")
    allow_mixed_versions: bool = False
    convergence_threshold: Mapping[str, float] = field(default_factory=dict)
    equivalence_margin: float = 0.05
    target_effect: float = 0.1
    paper_figures: tuple[str, ...] | None = None
    highlight_filters: tuple[str, ...] | None = None
    show_all: bool | None = None
    planned: int | None = None
    metric: str = "rmse"

    def __post_init__(self) -> None:
        check_main_metric(self.metric)
        if not 0 < self.alpha < 1:
            raise ValueError(f"report.alpha must be between 0 and 1, got {self.alpha}. Use 0.05.")
        for name in ("equivalence_margin", "target_effect"):
            if not getattr(self, name) > 0:
                raise ValueError(
                    f"report.{name} must be positive, got {getattr(self, name)}. Use 0.05 for 5 %."
                )
        if not self.figure_formats or set(self.figure_formats) - set(_FORMATS):
            options = ", ".join(_FORMATS)
            raise ValueError(
                f"report.figure_formats must be a subset of {options}, got {list(self.figure_formats)}. Use svg."
            )


class ReportContext(NamedTuple):
    """Context of all parts of a report.

    Attributes:
        groups: Component groups that are shown.
        style: Line styles by label.
        folder: Folder of the report.
        options: Options of the report.
        brief: Whether the study is too large to show all figures and comparisons.
    """

    groups: Sequence[str]
    style: Mapping[str, LineStyle]
    folder: RecordedFolder
    options: ReportOptions
    brief: bool


def order_by_highlight(labels: Sequence[str], highlight: Sequence[str] | None) -> list[str]:
    """Order labels with the highlighted filters first, because later line styles repeat.

    Args:
        labels: Labels of all filters.
        highlight: Labels of the highlighted filters.

    Raises:
        ValueError: If results of a highlighted filter are missing.
    """
    unknown = sorted(set(highlight or ()) - set(labels))
    if unknown:
        names = ", ".join(labels)
        raise ValueError(
            f"report.highlight_filters must be filters with results, got {', '.join(unknown)}. Choose from {names}."
        )
    return list(dict.fromkeys([*(highlight or ()), *labels]))


def is_brief(conditions: Sequence[Condition], options: ReportOptions) -> bool:
    """Return whether the report is brief.

    Args:
        conditions: Conditions of the study.
        options: Options of the report.
    """
    most = max(len(cell.jobs) for cell in conditions) * len(conditions)
    return not options.show_all if options.show_all is not None else most > _PLENTY


def select_line_styles(
    view: ReportContext, labels: Sequence[str], best: Sequence[str], by: str
) -> tuple[Mapping[str, LineStyle], str]:
    """Return the line styles of a figure with a line per filter, and a caption about grey filters.

    Args:
        view: Context of the report.
        labels: Labels of the filters in the figure.
        best: Labels ordered from best to worst.
        by: Criterion of that order, as text.
    """
    if len(labels) <= _NAMED + 1:
        return view.style, ""
    selected = [label for label in view.options.highlight_filters or () if label in labels]
    if selected:
        others = len(labels) - len(selected)
        return mute_others(
            view.style, selected
        ), f" Coloured: {', '.join(selected)}. Grey: the other {others}."
    top = sorted(best[:_NAMED], key=natural_sort_key)
    text = f" Coloured: the {_NAMED} filters with {by}. Grey: the other {len(labels) - len(top)}."
    return mute_others(view.style, top), text
