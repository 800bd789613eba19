"""Options of a report."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from pfbench.core.parameter_checks import require
from pfbench.results.metrics import check_page_metric

_FORMATS = ("svg", "png")


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


def _are_texts(value: Any) -> bool:
    return isinstance(value, tuple | list) and all(isinstance(text, str) for text in value)


# kinds of options that a command line or a file sets: requirement and test
_KINDS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "alpha": ("a number between 0 and 1", lambda value: _is_number(value) and 0 < value < 1),
    "start_time_s": ("a number", _is_number),
    "equivalence_margin": ("a positive number", lambda value: _is_number(value) and value > 0),
    "figure_formats": (
        f"a list of names of {', '.join(_FORMATS)}",
        lambda value: _are_texts(value) and bool(value) and set(value) <= set(_FORMATS),
    ),
    "paper_figures": ("a list of names, or null", lambda value: value is None or _are_texts(value)),
    "allow_mixed_versions": ("true or false", lambda value: type(value) is bool),
    "convergence_threshold": (
        "numbers by group, such as {position: 10}",
        lambda value: isinstance(value, Mapping) and all(map(_is_number, value.values())),
    ),
    "metric": ("a name", lambda value: isinstance(value, str)),
    "baseline": ("the label of a filter", lambda value: isinstance(value, str)),
    "home": (
        "the name of a study",
        lambda value: isinstance(value, str) and bool(re.fullmatch(r"\w*", value)),
    ),
}


@dataclass(frozen=True)
class ReportOptions:
    """Options of a report.

    Attributes:
        alpha: Level of the tests after Holm's correction, and probability outside intervals.
        start_time_s: Start time of all measures, s. Curves over time show all times.
        figure_formats: Formats of the figures, svg or png. The page embeds the smaller file.
        allow_mixed_versions: Whether results of several versions, seeds, runs or lengths are accepted.
        convergence_threshold: Error limit by group, in the displayed unit, for the convergence time, which
            counts from the start of the record.
        equivalence_margin: Relative difference of RMSE up to which filters are equivalent.
        paper_figures: Names of `papers.figures.FIGURES`, None for the paper of the study's name.
        planned: Number of jobs of the experiment, if known.
        metric: Metric of the main group that decides, one of `metrics.page_metrics`.
        title: Title of the page; empty for the name of the study.
        baseline: Label of the filter with which the opening view compares the others; empty for the first of
            `REFERENCES` that the study has. Pairs compared in advance do not depend on it.
        home: Published study of the methods in the worlds of their papers, shown on a first page of several methods;
            empty for none.
    """

    alpha: float = 0.05
    start_time_s: float = 0.0
    figure_formats: tuple[str, ...] = ("svg", "png")
    allow_mixed_versions: bool = False
    convergence_threshold: Mapping[str, float] = field(default_factory=dict)
    equivalence_margin: float = 0.05
    paper_figures: tuple[str, ...] | None = None
    planned: int | None = None
    metric: str = "rmse"
    title: str = ""
    baseline: str = ""
    home: str = ""

    def __post_init__(self) -> None:
        for key, (requirement, is_valid) in _KINDS.items():
            require(
                is_valid(getattr(self, key)),
                f"report.{key}",
                f"be {requirement}",
                f"{getattr(self, key)!r}",
                "Leave it out for the default.",
            )
        check_page_metric(self.metric)
