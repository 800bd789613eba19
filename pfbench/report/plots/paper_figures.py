"""Figures of the papers from our results, with bands over runs.

Names contain the number of the paper and of the figure: "000-2" is figure 2 of paper 000. A study named after a paper shows
the figures of the paper for which data exist. `report.paper_figures` selects other figures, or none.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pfbench.report.plots import paper_plots as plots
from pfbench.report.plots.condition_figures import FigureSpec
from pfbench.report.plots.plotting import LineStyle, format_slug
from pfbench.results import store
from pfbench.results.conditions import Condition
from pfbench.results.state_groups import ComponentGroup, component_groups

_BAND = "median and 5 to 95 %"
_FIRST = (
    " Dashed black: 5 to 95 % before correction, at the first step. The error there equals the bias, because the filter has "
    "processed no measurement."
)


class PaperFigureData(NamedTuple):
    """Data of a paper figure in one condition.

    Attributes:
        cell: Condition.
        results: Results by label, with all times.
        since: Start time of the measures, s.
    """

    cell: Condition
    results: dict[str, store.JobResult]
    since: float

    @property
    def prefix(self) -> str:
        """Prefix of the file names."""
        return format_slug(f"{self.cell.scenario}_{self.cell.noise}_{self.cell.model}")


class PaperFigure(NamedTuple):
    """Figure of a paper.

    Attributes:
        said: Paper and figure, as text.
        filters: Labels of the filters; those without results are left out.
        draw: Function that returns the figures of conditions, none without data.
        noise: Noise regime of the conditions, empty for any.
        groups: Component groups, for figures of errors.
        printed: Values of the paper by label, in the displayed unit.
    """

    said: str
    filters: tuple[str, ...]
    draw: Callable[
        [PaperFigure, Sequence[PaperFigureData], Mapping[str, LineStyle]], list[FigureSpec]
    ]
    noise: str = ""
    groups: tuple[str, ...] = ()
    printed: Mapping[str, tuple[float, ...]] = {}


def paper_figures(
    study: str,
    conditions: Sequence[Condition],
    style: Mapping[str, LineStyle],
    wanted: Sequence[str] | None = None,
    start_time_s: float = 0.0,
) -> list[FigureSpec]:
    """List the paper figures of a study.

    Args:
        study: Name of the study; "paper_000_linear" belongs to paper 000.
        found: Conditions of the study.
        style: Line styles by label.
        wanted: Names of figures, None for the figures of the study's paper.
        start_time_s: Start time of measures, s. Curves over time show all times.

    Raises:
        ValueError: If a figure does not exist, or a requested figure has no data.
    """
    unknown = sorted(set(wanted or ()) - set(FIGURES))
    if unknown:
        options = ", ".join(FIGURES)
        raise ValueError(
            f"report.paper_figures must be paper figures, got {', '.join(unknown)}. Choose from {options}."
        )
    paper = re.match(r"paper_(\d{3})", study)
    names = (
        [name for name in FIGURES if paper and name.startswith(paper[1])]
        if wanted is None
        else wanted
    )
    figures: list[FigureSpec] = []
    read = cache(store.read_result)
    for name in names:
        figure = FIGURES[name]
        own = figure.draw(figure, _sources(figure, conditions, read, start_time_s), style)
        if wanted is not None and not own:
            raise ValueError(
                f"report.paper_figures must have data, got {name} ({figure.said}). It requires results of {', '.join(figure.filters)}"
                f"{f' with noise={figure.noise}' if figure.noise else ''}."
            )
        figures += [drawing._replace(name=f"{name}_{drawing.name}".rstrip("_")) for drawing in own]
    return figures


def _sources(
    figure: PaperFigure,
    found: Sequence[Condition],
    read: Callable[[Path], store.JobResult],
    since: float,
) -> list[PaperFigureData]:
    """Read the results of a figure's filters, by condition."""
    sources = []
    for cell in found:
        if figure.noise in ("", cell.noise):
            own = {job.label: job for job in cell.jobs}
            results = {label: read(own[label].path) for label in figure.filters if label in own}
            valid = {
                label: result
                for label, result in results.items()
                if not result.arrays["lost"].all()
            }
            if valid:
                sources.append(PaperFigureData(cell, valid, since))
    return sources


def make_error_figures(
    figure: PaperFigure,
    sources: Sequence[PaperFigureData],
    style: Mapping[str, LineStyle],
    before: bool = False,
) -> list[FigureSpec]:
    """Return figures of the error over time, one per condition and group."""
    figures = []
    for source, group in product(sources, figure.groups):
        own = {
            label: (result, block)
            for label, result in source.results.items()
            if (block := _block(result, group))
        }
        if own:
            text = f"{_head(figure, source)}: error of {group} over time, {_BAND} {_of(source)}."
            text += _FIRST if before else ""
            make = partial(plots.plot_errors, own, style, before)
            figures.append(
                FigureSpec(f"{source.prefix}_{format_slug(group)}", text + plots.SYMLOG, make)
            )
    return figures


def make_trace_figures(
    name: str,
    words: str,
    unit: str,
    figure: PaperFigure,
    sources: Sequence[PaperFigureData],
    style: Mapping[str, LineStyle],
) -> list[FigureSpec]:
    """Return figures of a trace over time, one per condition."""
    figures = []
    for source in sources:
        own = {label: result for label, result in source.results.items() if name in result.arrays}
        if own:
            low, high = figure.printed.get("", (np.nan, np.nan))
            text = f"{_head(figure, source)}: {words} over time, {_BAND} {_of(source)}."
            text += f" Grey: {low:g} to {high:g}, as printed." if np.isfinite(low) else ""
            make = partial(plots.plot_paper_trace, own, name, unit, style, (low, high))
            figures.append(FigureSpec(f"{source.prefix}_{name}", text, make))
    return figures


def make_escape_figure(
    figure: PaperFigure, sources: Sequence[PaperFigureData], style: Mapping[str, LineStyle]
) -> list[FigureSpec]:
    """Return the figure of the escape factor over the iterations of a step."""
    own: dict[str, tuple[float, int]] = {}
    for label, result in (item for source in sources for item in source.results.items()):
        proposal = result.meta["config"].get("filter", {}).get("proposal") or {}
        if escape := (proposal.get("velocity") or {}).get("escape"):
            own[label] = float(escape), int(proposal["iterations"])
    if not own:
        return []
    text = f"{figure.said}: escape factor c3 = c4 over the iterations of a step, as repaired and as used by the filters."
    text += " Dotted: eq. 35 as printed."
    return [FigureSpec("", text, partial(plots.plot_escape, own, style))]


def make_relative_error_figures(
    figure: PaperFigure, sources: Sequence[PaperFigureData], style: Mapping[str, LineStyle]
) -> list[FigureSpec]:
    """Return figures of Err by experiment, over time and its mean."""
    own = {
        s.cell.scenario: s.results
        for s in sources
        if all("range" in r.arrays for r in s.results.values())
    }
    if not own:
        return []
    quantity = "Err, the horizontal error in % of the horizontal range [eq. 20 as repaired]"
    over = f"{figure.said}: {quantity}, over time in each experiment, {_BAND} {_of(*sources)}."
    mean = f"{figure.said}: {quantity}, mean over time, by experiment: {_BAND} {_of(*sources)}."
    values = {
        name: {label: plots.relative_axes(result) for label, result in results.items()}
        for name, results in own.items()
    }
    return [
        FigureSpec("", mean, partial(plots.plot_against, values, style, "mean Err [%]")),
        FigureSpec("over_time", over, partial(plots.plot_relative_errors, own, style)),
    ]


def make_ess_figure(
    figure: PaperFigure, sources: Sequence[PaperFigureData], style: Mapping[str, LineStyle]
) -> list[FigureSpec]:
    """Return the figure of the mean effective number of particles by experiment."""
    values = {
        s.cell.scenario: {
            label: plots.mean_trace_per_run(r, "ess")
            for label, r in s.results.items()
            if "ess" in r.arrays
        }
        for s in sources
    }
    values = {name: own for name, own in values.items() if own}
    if not values:
        return []
    text = f"{figure.said}: effective number of particles, mean over time [eq. 21], {_BAND} {_of(*sources)}."
    return [FigureSpec("", text, partial(plots.plot_against, values, style, "mean Neff"))]


def make_time_figure(
    figure: PaperFigure, sources: Sequence[PaperFigureData], style: Mapping[str, LineStyle]
) -> list[FigureSpec]:
    """Return the figure of the time per step by experiment."""
    values = {
        s.cell.scenario: {
            label: 1e3 * np.array([r.meta["seconds"]["per_step"]]) for label, r in s.results.items()
        }
        for s in sources
    }
    if not values:
        return []
    runs = sorted({r.meta["runs"] for s in sources for r in s.results.values()})
    text = (
        f"{figure.said}: time per step of all {' or '.join(map(str, runs))} runs together. Each value is one measurement on one "
        "machine, without an interval."
    )
    return [FigureSpec("", text, partial(plots.plot_against, values, style, "time per step [ms]"))]


def make_maximum_figures(
    figure: PaperFigure, sources: Sequence[PaperFigureData], style: Mapping[str, LineStyle]
) -> list[FigureSpec]:
    """Return figures of maximum error and RMSE, with the values of the paper."""
    figures = []
    for source, group in product(sources, figure.groups):
        own = {
            label: (result, block)
            for label, result in source.results.items()
            if (block := _block(result, group))
        }
        if own:
            since = f" after {source.since:g} s" if source.since else ""
            quantity = f"maximum error of {group}{since} (filled) and RMSE (open)"
            text = f"{_head(figure, source)}: {quantity}, {_BAND} {_of(source)}."
            text += " Crosses: maximum errors as printed." if set(figure.printed) & set(own) else ""
            make = partial(plots.plot_maxima, own, style, source.since, figure.printed)
            figures.append(FigureSpec(f"{source.prefix}_{format_slug(group)}", text, make))
    return figures


def _block(result: store.JobResult, group: str) -> ComponentGroup | None:
    """Return the component group of that name, or None."""
    return next(
        (block for block in component_groups(result.meta["state"]) if block.group == group), None
    )


def _head(figure: PaperFigure, source: PaperFigureData) -> str:
    """Format the start of a caption."""
    return f"{figure.said}, here {source.cell.scenario} / {source.cell.noise}"


def _of(*sources: PaperFigureData) -> str:
    """Format the number of runs and of lost runs for a caption."""
    results = [(s, label, r) for s in sources for label, r in s.results.items()]
    runs = sorted({int(r.meta["runs"]) for _, _, r in results})
    lost = [
        f"{label} {n}{f' in {s.cell.scenario}' if len(sources) > 1 else ''}"
        for s, label, r in results if (n := int(r.arrays["lost"].sum()))
    ]  # fmt: skip
    return f"of {' or '.join(map(str, runs))} runs" + (
        f" (lost runs excluded: {', '.join(lost)})" if lost else ""
    )


_BEFORE = partial(make_error_figures, before=True)
_YAN, _PU, _COFM, _DMC, _TIAN = (
    "Yan et al. 2016", "Pu and Qin", "COFM-AMSSRCPF 2024", "The DMC particle filter", "Tian et al."
)  # fmt: skip
_MODIFIED = ("sir", "rpf_printed", "mcmc_rpf", "mcmc_rpf_printed")
_PASSIVE = ("sir", "gpf", "qmc_gpf", "qmc_polymerised_printed", "qmc_polymerised")
_RULES = ("ckf", "hckf", "mssrckf")
_CUBATURE = ("cpf", "fmcpf", "cofm_amssrcpf_printed", "cofm_amssrcpf")
_CORRECTED = (
    "ukf", "ukf[model.process_noise_factor=5.0]", "dmc_reconstructed_printed", "dmc_reconstructed_printed[model.process_noise_factor=5.0]",
    "dmc_reconstructed", "dmc_reconstructed[model.process_noise_factor=5.0]",
)  # fmt: skip
_SWARMS = ("sir", "cpso_pf", "cpso_escape_printed", "cpso_escape")
_PRINTED_MAXIMA = {  # North, East, Up
    "cpf": (8.9, 7.4, 16.4), "fmcpf": (6.8, 5.75, 10.5), "cofm_amssrcpf_printed": (4.02, 4.4, 5.2),
    "cofm_amssrcpf": (4.02, 4.4, 5.2),
}  # fmt: skip
_SIZE = partial(make_trace_figures, "particles", "number of particles", "particles")
_NEFF = partial(make_trace_figures, "ess", "effective number of particles", "Neff")
_FLOWN = partial(make_trace_figures, "iterations", "iterations until the swarm stops", "iterations")
FIGURES: Mapping[str, PaperFigure] = {
    "000-2": PaperFigure(f"{_YAN}, figure 2", _MODIFIED, make_error_figures, groups=("attitude",)),
    "000-3": PaperFigure(f"{_YAN}, figure 3", _MODIFIED, make_error_figures, groups=("position",)),
    "001-2": PaperFigure(f"{_PU}, figure 2", _PASSIVE, make_relative_error_figures),
    "001-3": PaperFigure(f"{_PU}, figure 3", _PASSIVE, make_time_figure),
    "001-4": PaperFigure(f"{_PU}, figure 4", _PASSIVE, make_ess_figure),
    "001-position": PaperFigure(f"{_PU}, position behind figure 2", _PASSIVE, make_error_figures, groups=("position",)),
    "002-6": PaperFigure(
        f"{_COFM}, figures 6 to 9", ("mssrckf",), _BEFORE, "nominal", ("gyro_bias", "accelerometer_bias")
    ),
    "002-10": PaperFigure(f"{_COFM}, figures 10 and 11", _RULES, make_error_figures, "nominal", ("position",)),
    "002-12": PaperFigure(f"{_COFM}, figures 12 to 14", _CUBATURE, make_error_figures, "paper_bursts", ("position",)),
    "002-velocity": PaperFigure(f"{_COFM}, velocity behind figures 12 to 14", _CUBATURE, make_error_figures, "paper_bursts", ("velocity",)),
    "002-maxima": PaperFigure(
        f"{_COFM}, section on simulation 2", _CUBATURE, make_maximum_figures, "paper_bursts", ("position",), _PRINTED_MAXIMA
    ),
    "002-number": PaperFigure(f"{_COFM}, section on simulation 2", _CUBATURE, _SIZE, "paper_bursts"),
    "002-neff": PaperFigure(
        f"{_COFM}, section on simulation 2", _CUBATURE, _NEFF, "paper_bursts", printed={"": (110.0, 180.0)}
    ),
    "003-3": PaperFigure(f"{_DMC}, figure 3", _CORRECTED, make_error_figures, groups=("attitude",)),
    "003-4": PaperFigure(f"{_DMC}, figure 4", _CORRECTED, make_error_figures, groups=("velocity",)),
    "003-5": PaperFigure(f"{_DMC}, figure 5", _CORRECTED, make_error_figures, groups=("position",)),
    "004-1": PaperFigure(f"{_TIAN}, figure 1", ("cpso_escape_printed", "cpso_escape_stopped", "cpso_escape"), make_escape_figure),
    "004-3": PaperFigure(
        f"{_TIAN}, figure 3", ("ekf", "cpso_escape_printed", "cpso_escape"), _BEFORE, "nominal",
        ("gyro_constant", "gyro_bias", "accelerometer_bias"),
    ),
    "004-4": PaperFigure(f"{_TIAN}, figure 4", _SWARMS, make_error_figures, "nominal", ("position",)),
    "004-5": PaperFigure(f"{_TIAN}, figure 5", _SWARMS, make_error_figures, "nominal", ("velocity",)),
    "004-iterations": PaperFigure(
        f"{_TIAN}, sections 4 and 5", ("pso_pf", "cpso_pf", "cpso_escape_printed", "cpso_escape_stopped", "cpso_escape"),
        _FLOWN, "nominal",
    ),
    "004-before": PaperFigure(
        f"{_TIAN}, figures 2, 4 and 5 before correction", ("ekf",), make_error_figures, "outage", ("position", "velocity")
    ),
}  # fmt: skip
