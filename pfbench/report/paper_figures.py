"""The papers' own figures drawn anew, with bands over runs: the same quantities of the same filters, from our results.

Each has the number that it has in its paper, "000-2" is figure 2 of paper 000. A study that is named after a paper shows those of
the paper for which it has the data; any study can name others, or none, under `report.figures`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pfbench import store
from pfbench.report import paper_plots as plots
from pfbench.report.canvas import Look, slug
from pfbench.report.figures import Drawing
from pfbench.report.frame import Block, Cell, blocks

_BAND = "median and 5 to 95 %"
_FIRST = (
    " Dashed black: 5 to 95 % before correction, which is the error at the first instant: the filter has learned nothing yet, "
    "and its error is the bias itself."
)


class Source(NamedTuple):
    """One cell with the filters of a figure, whole, by label, and the instant from which measures count."""

    cell: Cell
    results: dict[str, store.Result]
    since: float

    @property
    def prefix(self) -> str:
        return slug(f"{self.cell.scenario}_{self.cell.noise}_{self.cell.model}")


class Redrawn(NamedTuple):
    """One figure of a paper, and what it takes to draw it.

    Attributes:
        said: the paper and its figure, in words.
        filters: labels that it shows, those of them that ran.
        draw: makes drawings of the cells; none where the data are not there.
        noise: regime of its cells; empty for any.
        groups: of the state, for figures of errors.
        printed: what the paper prints of a filter, by label, in the unit shown.
    """

    said: str
    filters: tuple[str, ...]
    draw: Callable[[Redrawn, Sequence[Source], Mapping[str, Look]], list[Drawing]]
    noise: str = ""
    groups: tuple[str, ...] = ()
    printed: Mapping[str, tuple[float, ...]] = {}


def drawings(
    study: str, found: Sequence[Cell], style: Mapping[str, Look], wanted: Sequence[str] | None = None, from_time: float = 0.0
) -> list[Drawing]:
    """All figures of papers that a study shows; names begin with the figure's, so that they are the same in any study.

    Args:
        study: its name; "paper_000_linear" is of paper 000.
        found: its cells; the files of the filters shown are read.
        style: from `looks`.
        wanted: names of figures; None for those of the study's own paper.
        from_time: measures leave out what came before, seconds; curves over time show all.

    Raises:
        ValueError: a figure that there is not, or one asked for that the study has no data for.
    """
    unknown = sorted(set(wanted or ()) - set(FIGURES))
    if unknown:
        raise ValueError(f"report.figures: there is no {', '.join(unknown)}; choose from {', '.join(FIGURES)}")
    paper = re.match(r"paper_(\d{3})", study)
    names = [name for name in FIGURES if paper and name.startswith(paper[1])] if wanted is None else wanted
    made: list[Drawing] = []
    read = cache(store.load)
    for name in names:
        figure = FIGURES[name]
        own = figure.draw(figure, _sources(figure, found, read, from_time), style)
        if wanted is not None and not own:
            raise ValueError(
                f"report.figures: {name} ({figure.said}) needs filters of {', '.join(figure.filters)}"
                f"{f' under {figure.noise}' if figure.noise else ''} with what it shows; this study has no such results"
            )
        made += [drawing._replace(name=f"{name}_{drawing.name}".rstrip("_")) for drawing in own]
    return made


def _sources(
    figure: Redrawn, found: Sequence[Cell], read: Callable[[Path], store.Result], since: float
) -> list[Source]:
    sources = []
    for cell in found:
        if figure.noise in ("", cell.noise):
            own = {job.label: job for job in cell.jobs}
            results = {label: read(own[label].path) for label in figure.filters if label in own}
            kept = {label: result for label, result in results.items() if not result.arrays["lost"].all()}
            if kept:
                sources.append(Source(cell, kept, since))
    return sources


def _errors(figure: Redrawn, sources: Sequence[Source], style: Mapping[str, Look], before: bool = False) -> list[Drawing]:
    """Errors of each group over time, one drawing per cell and group."""
    made = []
    for source, group in product(sources, figure.groups):
        own = {label: (result, block) for label, result in source.results.items() if (block := _block(result, group))}
        if own:
            text = f"{_head(figure, source)}: error of {group} over time, {_BAND} {_of(source)}."
            text += _FIRST if before else ""
            make = partial(plots.errors, own, style, before)
            made.append(Drawing(f"{source.prefix}_{slug(group)}", text + plots.SYMLOG, make))
    return made


def _trace(
    name: str, words: str, unit: str, figure: Redrawn, sources: Sequence[Source], style: Mapping[str, Look]
) -> list[Drawing]:
    """A trace of the filters over time, one drawing per cell that has it."""
    made = []
    for source in sources:
        own = {label: result for label, result in source.results.items() if name in result.arrays}
        if own:
            low, high = figure.printed.get("", (np.nan, np.nan))
            text = f"{_head(figure, source)}: {words} over time, {_BAND} {_of(source)}."
            text += f" Grey: {low:g} to {high:g}, as printed." if np.isfinite(low) else ""
            make = partial(plots.trace, own, name, unit, style, (low, high))
            made.append(Drawing(f"{source.prefix}_{name}", text, make))
    return made


def _escape(figure: Redrawn, sources: Sequence[Source], style: Mapping[str, Look]) -> list[Drawing]:
    """The factor by which a swarm flies from its worst places, over the iterations of a step, by the settings that ran."""
    own: dict[str, tuple[float, int]] = {}
    for label, result in (item for source in sources for item in source.results.items()):
        proposal = result.meta["config"].get("filter", {}).get("proposal") or {}
        if escape := (proposal.get("velocity") or {}).get("escape"):
            own[label] = float(escape), int(proposal["iterations"])
    if not own:
        return []
    text = f"{figure.said}: escape factor c3 = c4 over the iterations of a step, as it is meant and as our filters have it."
    text += " Dotted: eq. 35 as printed, which only ripples."
    return [Drawing("", text, partial(plots.escape, own, style))]


def _relative(figure: Redrawn, sources: Sequence[Source], style: Mapping[str, Look]) -> list[Drawing]:
    """Err of each experiment, over the observations and their mean."""
    own = {s.cell.scenario: s.results for s in sources if all("range" in r.arrays for r in s.results.values())}
    if not own:
        return []
    said = "Err, the horizontal error in % of the horizontal range [eq. 20 as meant]"
    over = f"{figure.said}: {said}, over time in each experiment, {_BAND} {_of(*sources)}."
    mean = f"{figure.said}: {said}, mean over time, against the experiment: {_BAND} {_of(*sources)}."
    values = {name: {label: plots.relative(result) for label, result in results.items()} for name, results in own.items()}
    return [
        Drawing("", mean, partial(plots.against, values, style, "mean Err in %")),
        Drawing("over_time", over, partial(plots.relatives, own, style)),
    ]


def _effective(figure: Redrawn, sources: Sequence[Source], style: Mapping[str, Look]) -> list[Drawing]:
    """Mean effective number of particles of each experiment."""
    values = {
        s.cell.scenario: {label: plots.run_means(r, "ess") for label, r in s.results.items() if "ess" in r.arrays}
        for s in sources
    }
    values = {name: own for name, own in values.items() if own}
    if not values:
        return []
    text = f"{figure.said}: effective number of particles, mean over time [eq. 21]: {_BAND} {_of(*sources)}."
    return [Drawing("", text, partial(plots.against, values, style, "mean Neff"))]


def _seconds(figure: Redrawn, sources: Sequence[Source], style: Mapping[str, Look]) -> list[Drawing]:
    """Time per step of each experiment."""
    values = {
        s.cell.scenario: {label: 1e3 * np.array([r.meta["seconds"]["per_step"]]) for label, r in s.results.items()}
        for s in sources
    }
    if not values:
        return []
    runs = sorted({r.meta["runs"] for s in sources for r in s.results.values()})
    text = (
        f"{figure.said}: time per step of all {' or '.join(map(str, runs))} runs together, measured once for each job on one "
        "machine; it has no band."
    )
    return [Drawing("", text, partial(plots.against, values, style, "time per step in ms"))]


def _maxima(figure: Redrawn, sources: Sequence[Source], style: Mapping[str, Look]) -> list[Drawing]:
    """Largest error and RMSE of each component of a group, beside what is printed."""
    made = []
    for source, group in product(sources, figure.groups):
        own = {label: (result, block) for label, result in source.results.items() if (block := _block(result, group))}
        if own:
            since = f" after {source.since:g} s" if source.since else ""
            what = f"largest error of {group}{since} (filled) and RMSE (open)"
            text = f"{_head(figure, source)}: {what}, {_BAND} {_of(source)}."
            text += " Crosses: largest errors as printed." if set(figure.printed) & set(own) else ""
            make = partial(plots.maxima, own, style, source.since, figure.printed)
            made.append(Drawing(f"{source.prefix}_{slug(group)}", text, make))
    return made


def _block(result: store.Result, group: str) -> Block | None:
    return next((block for block in blocks(result.meta["state"]) if block.group == group), None)


def _head(figure: Redrawn, source: Source) -> str:
    return f"{figure.said}, here {source.cell.scenario} / {source.cell.noise}"


def _of(*sources: Source) -> str:
    """How many runs, and who lost some, for a caption."""
    results = [(s, label, r) for s in sources for label, r in s.results.items()]
    runs = sorted({int(r.meta["runs"]) for _, _, r in results})
    lost = [
        f"{label} {n}{f' in {s.cell.scenario}' if len(sources) > 1 else ''}"
        for s, label, r in results if (n := int(r.arrays["lost"].sum()))
    ]  # fmt: skip
    return f"of {' or '.join(map(str, runs))} runs" + (f", of which lost and left out: {', '.join(lost)}" if lost else "")


_BEFORE = partial(_errors, before=True)
_YAN, _PU, _COFM, _DMC, _TIAN = (
    "Yan et al. 2016", "Pu and Qin", "COFM-AMSSRCPF 2024", "The DMC particle filter", "Tian et al."
)  # fmt: skip
_MODIFIED = ("sir", "rpf_printed", "mcmc_rpf", "mcmc_rpf_printed")
_PASSIVE = ("sir", "gpf", "qmc_gpf", "qmc_polymerised_printed", "qmc_polymerised")
_RULES = ("ckf", "hckf", "mssrckf")
_CUBATURE = ("cpf", "fmcpf", "cofm_amssrcpf_printed", "cofm_amssrcpf")
_CORRECTED = (
    "ukf", "ukf[model.q_inflation=5.0]", "dmc_reconstructed_printed", "dmc_reconstructed_printed[model.q_inflation=5.0]",
    "dmc_reconstructed", "dmc_reconstructed[model.q_inflation=5.0]",
)  # fmt: skip
_SWARMS = ("sir", "cpso_pf", "cpso_escape_printed", "cpso_escape")
_PRINTED_MAXIMA = {  # North, East, Up
    "cpf": (8.9, 7.4, 16.4), "fmcpf": (6.8, 5.75, 10.5), "cofm_amssrcpf_printed": (4.02, 4.4, 5.2),
    "cofm_amssrcpf": (4.02, 4.4, 5.2),
}  # fmt: skip
_SIZE = partial(_trace, "particles", "number of particles", "particles")
_NEFF = partial(_trace, "ess", "effective number of particles", "Neff")
_FLOWN = partial(_trace, "iterations", "iterations until the swarm stops", "iterations")
FIGURES: Mapping[str, Redrawn] = {
    "000-2": Redrawn(f"{_YAN}, figure 2", _MODIFIED, _errors, groups=("attitude",)),
    "000-3": Redrawn(f"{_YAN}, figure 3", _MODIFIED, _errors, groups=("position",)),
    "001-2": Redrawn(f"{_PU}, figure 2", _PASSIVE, _relative),
    "001-3": Redrawn(f"{_PU}, figure 3", _PASSIVE, _seconds),
    "001-4": Redrawn(f"{_PU}, figure 4", _PASSIVE, _effective),
    "001-position": Redrawn(f"{_PU}, position behind figure 2", _PASSIVE, _errors, groups=("position",)),
    "002-6": Redrawn(
        f"{_COFM}, figures 6 to 9", ("mssrckf",), _BEFORE, "nominal", ("gyro_bias", "accelerometer_bias")
    ),
    "002-10": Redrawn(f"{_COFM}, figures 10 and 11", _RULES, _errors, "nominal", ("position",)),
    "002-12": Redrawn(f"{_COFM}, figures 12 to 14", _CUBATURE, _errors, "paper_burst", ("position",)),
    "002-velocity": Redrawn(f"{_COFM}, velocity behind figures 12 to 14", _CUBATURE, _errors, "paper_burst", ("velocity",)),
    "002-maxima": Redrawn(
        f"{_COFM}, section on simulation 2", _CUBATURE, _maxima, "paper_burst", ("position",), _PRINTED_MAXIMA
    ),
    "002-number": Redrawn(f"{_COFM}, section on simulation 2", _CUBATURE, _SIZE, "paper_burst"),
    "002-neff": Redrawn(
        f"{_COFM}, section on simulation 2", _CUBATURE, _NEFF, "paper_burst", printed={"": (110.0, 180.0)}
    ),
    "003-3": Redrawn(f"{_DMC}, figure 3", _CORRECTED, _errors, groups=("attitude",)),
    "003-4": Redrawn(f"{_DMC}, figure 4", _CORRECTED, _errors, groups=("velocity",)),
    "003-5": Redrawn(f"{_DMC}, figure 5", _CORRECTED, _errors, groups=("position",)),
    "004-1": Redrawn(f"{_TIAN}, figure 1", ("cpso_escape_printed", "cpso_escape_stopped", "cpso_escape"), _escape),
    "004-3": Redrawn(
        f"{_TIAN}, figure 3", ("ekf", "cpso_escape_printed", "cpso_escape"), _BEFORE, "nominal",
        ("gyro_constant", "gyro_bias", "accelerometer_bias"),
    ),
    "004-4": Redrawn(f"{_TIAN}, figure 4", _SWARMS, _errors, "nominal", ("position",)),
    "004-5": Redrawn(f"{_TIAN}, figure 5", _SWARMS, _errors, "nominal", ("velocity",)),
    "004-iterations": Redrawn(
        f"{_TIAN}, sections 4 and 5", ("pso_pf", "cpso_pf", "cpso_escape_printed", "cpso_escape_stopped", "cpso_escape"),
        _FLOWN, "nominal",
    ),
    "004-before": Redrawn(
        f"{_TIAN}, figures 2, 4 and 5 before correction", ("ekf",), _errors, "outage", ("position", "velocity")
    ),
}  # fmt: skip
