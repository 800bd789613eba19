"""Figures of the papers from our results, with bands over runs.

Names contain the number of the paper and of the figure: "000-2" is figure 2 of paper 000. A study named after a paper shows
the figures of the paper for which data exist. `report.paper_figures` selects other figures, or none.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path

from pfbench.report.papers.specs import (
    PaperFigure,
    PaperFigureData,
    PaperFigureInput,
    make_error_figures,
    make_escape_figure,
    make_ess_figure,
    make_flight_figures,
    make_flight_velocity_figures,
    make_maximum_figures,
    make_parameter_figures,
    make_relative_error_figures,
    make_time_figure,
    make_trace_figures,
)
from pfbench.results import store
from pfbench.results.conditions import Condition
from pfbench.results.plotting import FigureSpec, LineStyle


def paper_figures(
    study: str,
    conditions: Sequence[Condition],
    style: Mapping[str, LineStyle],
    selection: Sequence[str] | None = None,
    start_time_s: float = 0.0,
) -> list[FigureSpec]:
    """List the paper figures of a study."""
    if unknown := sorted(set(selection or ()) - set(FIGURES)):
        raise ValueError(
            f"report.paper_figures must be paper figures, got {', '.join(unknown)}. "
            f"Choose from {', '.join(FIGURES)}."
        )
    paper = re.match(r"paper_(\d{3})", study)
    default = [name for name in FIGURES if paper and name.startswith(paper[1])]
    figures: list[FigureSpec] = []
    read = cache(store.read_result)
    for name in default if selection is None else selection:
        figure = FIGURES[name]
        data = list(_read_conditions(figure, conditions, read, start_time_s))
        drawings = figure.draw(PaperFigureInput(figure, data, style))
        if selection is not None and not drawings:
            noise = f" with noise={figure.noise}" if figure.noise else ""
            raise ValueError(
                f"report.paper_figures must have data, got {name} ({figure.title}). "
                f"It requires results of {', '.join(figure.filters)}{noise}."
            )
        figures += [d._replace(name=f"{name}_{d.name}".rstrip("_")) for d in drawings]
    return figures


def _read_conditions(
    figure: PaperFigure,
    conditions: Sequence[Condition],
    read: Callable[[Path], store.JobResult],
    start_time_s: float,
) -> Iterator[PaperFigureData]:
    """Read the results of a figure's filters that have valid runs, by condition."""
    for condition in conditions:
        if figure.noise in ("", condition.noise):
            paths = {job.label: job.path for job in condition.jobs}
            results = {label: read(paths[label]) for label in figure.filters if label in paths}
            valid = {label: r for label, r in results.items() if not r.data["lost"].all()}
            if valid:
                yield PaperFigureData(condition, valid, start_time_s)


# --------------------------------------------------------------------------------------------------
# Catalogue of the paper figures: filters, quantity and printed values of each.

_BEFORE = partial(make_error_figures, before=True)


_YAN, _PU, _COFM, _DMC, _TIAN = (
    "Yan et al. 2016", "Pu and Qin", "COFM-AMSSRCPF 2024", "The DMC particle filter", "Tian et al."
)  # fmt: skip


_MODIFIED = ("sir", "rpf_printed", "mcmc_rpf", "mcmc_rpf_printed")
_PASSIVE = ("sir", "gpf", "qmc_gpf", "qmc_polymerised_printed", "qmc_polymerised")
_RULES = ("ckf", "hckf", "mssrckf")
_CUBATURE = ("cpf", "fmcpf", "cofm_amssrcpf_printed", "cofm_amssrcpf")


_BOUNDS = tuple(f"cofm_mssrckf[gain_adaptations.1.max_ratio={v}]" for v in ("1.0", "1000000000.0"))
_FADINGS = tuple(
    f"fm_mssrckf[noise_adaptations.0.fading_factor={v}]" for v in ("1.002", "1.01", "1.05")
)
_ALPHA = (
    "The copy of the paper lacks the definition and the values of its parameter alpha: these values are ours. "
    "No study varies the forgetting factor of the noise adaptation, the third reading."
)


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
    "000-1": PaperFigure(f"{_YAN}, figure 1", _MODIFIED, make_flight_figures),
    "000-2": PaperFigure(f"{_YAN}, figure 2", _MODIFIED, make_error_figures, groups=("attitude",)),
    "000-3": PaperFigure(f"{_YAN}, figure 3", _MODIFIED, make_error_figures, groups=("position",)),
    "001-2": PaperFigure(f"{_PU}, figure 2", _PASSIVE, make_relative_error_figures),
    "001-3": PaperFigure(f"{_PU}, figure 3", _PASSIVE, make_time_figure),
    "001-4": PaperFigure(f"{_PU}, figure 4", _PASSIVE, make_ess_figure),
    "001-position": PaperFigure(f"{_PU}, position behind figure 2", _PASSIVE, make_error_figures, groups=("position",)),
    "002-3-bound": PaperFigure(
        f"{_COFM}, figure 3, read as the ratio bound", _BOUNDS, partial(make_parameter_figures, "ratio bound", _ALPHA), groups=("position",)
    ),
    "002-3-fading": PaperFigure(
        f"{_COFM}, figure 3, read as the fading factor", _FADINGS, partial(make_parameter_figures, "fading factor", _ALPHA), groups=("position",)
    ),
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
    "003-1": PaperFigure(f"{_DMC}, figure 1", _CORRECTED, make_flight_figures),
    "003-2": PaperFigure(f"{_DMC}, figure 2", _CORRECTED, make_flight_velocity_figures),
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
