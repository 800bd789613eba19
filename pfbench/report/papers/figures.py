"""Figures of the papers from our results: medians over runs with one band, and crosses at printed numbers.

Names contain the number of the paper and of the figure: "000-2" is figure 2 of paper 000. A figure of no paper has another name. Each entry of the catalogue names
the studies that show it. `report.paper_figures` selects other figures, or none.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from itertools import chain, groupby
from pathlib import Path
from typing import Any

from pfbench.report.papers.plots import CurveLook, PrintedValue
from pfbench.report.papers.specs import (
    PaperFigure,
    PaperFigureData,
    PaperFigureInput,
    make_error_figures,
    make_escape_figure,
    make_ess_figure,
    make_flight_figures,
    make_maximum_figures,
    make_parameter_figures,
    make_relative_error_figures,
    make_time_figure,
    make_trace_figures,
    plot_flight,
    plot_flight_velocity,
)
from pfbench.results import store
from pfbench.results.conditions import Condition, parse_label
from pfbench.results.looks import find_looks, study_looks, study_part_names
from pfbench.results.plotting import FigureSpec, format_slug, line_styles

_SENTENCE_END = re.compile(r"(?<!et al)\. ")


def paper_figures(
    study: str,
    conditions: Sequence[Condition],
    selection: Sequence[str] | None = None,
    start_time_s: float = 0.0,
) -> list[tuple[str, FigureSpec]]:
    """List the paper figures of a study with the names of their entries, in the order of the papers."""
    if unknown := sorted(set(selection or ()) - set(FIGURES)):
        raise ValueError(
            f"report.paper_figures must be paper figures, got {', '.join(unknown)}. "
            f"Choose from {', '.join(FIGURES)}."
        )
    default = [name for name, figure in FIGURES.items() if study in figure.studies]
    figures: list[tuple[str, FigureSpec]] = []
    jobs = {job.path: job for condition in conditions for job in condition.jobs}
    read = cache(lambda path: jobs[path].load())
    for name in default if selection is None else selection:
        figure = FIGURES[name]
        data = list(_read_conditions(figure, conditions, read, start_time_s))
        drawings = list(figure.draw(PaperFigureInput(figure, data, _list_looks(figure, conditions))))  # fmt: skip
        if selection is not None and not drawings:
            noise = f" with noise={figure.noise}" if figure.noise else ""
            raise ValueError(
                f"report.paper_figures must have data, got {name} ({figure.title}). "
                f"It requires results of {', '.join(figure.filters)}{noise}."
            )
        figures += [
            (name, drawing._replace(name=format_slug(f"{name}_{drawing.name}")))
            for drawing in drawings
        ]
    return figures


def list_page_figures(study: str, entries: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """List what the page of a study shows of its paper in the order of the paper: figures, and links to other studies.

    The page of the first study of a paper links to the figures whose data are in others.
    """
    by_name: dict[str, list[dict[str, Any]]] = {}
    for entry in entries:
        alt = _SENTENCE_END.split(entry["caption"], 1)[0]
        by_name.setdefault(entry.get("entry", ""), []).append({**entry, "alt": alt})
    figures: list[dict[str, Any]] = []
    for name, figure in FIGURES.items():
        is_elsewhere = study not in figure.studies and study == f"paper_{name[:3]}"
        link = [{"title": figure.title, "study": figure.studies[0]}] if is_elsewhere else []
        figures += by_name.pop(name, link)
    return [*figures, *chain.from_iterable(by_name.values())] if entries else []


def list_paper_pages(methods: Sequence[str]) -> list[dict[str, Any]]:
    """List the first study of the paper of each method, with the titles of the figures that its page shows or links to."""
    pages, names = [], {parse_label(method)[0] for method in methods}
    of_papers = filter(lambda entry: entry[0][:3].isdigit(), FIGURES.items())
    for paper, entries in groupby(of_papers, key=lambda entry: entry[0][:3]):
        members = [figure for _, figure in entries]
        filters = {parse_label(label)[0] for figure in members for label in figure.filters}
        titles = [figure.title.partition(", ") for figure in members]
        figures = "; ".join(dict.fromkeys(title for _, _, title in titles))
        if names & filters:
            pages.append({"study": f"paper_{paper}", "paper": titles[0][0], "figures": figures})
    return pages


def _list_looks(figure: PaperFigure, conditions: Sequence[Condition]) -> dict[str, CurveLook]:
    """Return the looks of the filters of a figure: those of the study, with the names of the methods."""
    methods = {label: parse_label(label)[0] for label in figure.filters}
    looks = {**find_looks(list(methods.values())), **study_looks(conditions)}
    styles = line_styles(list(methods), {n: looks[method] for n, method in methods.items()})
    return {
        n: CurveLook.of(looks[method].name, styles[n], method.endswith("_printed"))
        for n, method in methods.items()
    }


def _read_conditions(
    figure: PaperFigure,
    conditions: Sequence[Condition],
    read: Callable[[Path], store.JobResult],
    start_time_s: float,
) -> Iterator[PaperFigureData]:
    """Read the results of a figure's filters that have valid runs, by condition.

    A study that does not vary the setting of a label has results of its method.
    """
    worlds, regimes = (study_part_names(conditions, kind) for kind in ("scenario", "noise"))
    for condition in conditions:
        if figure.noise in ("", condition.noise):
            paths = {job.label: job.path for job in condition.jobs}
            files = {n: paths.get(n) or paths.get(parse_label(n)[0]) for n in figure.filters}
            results = {label: read(path) for label, path in files.items() if path}
            valid = {label: r for label, r in results.items() if not r.data["lost"].all()}
            where = f"{worlds[condition.scenario].name}, {regimes[condition.noise].name.lower()}"
            if valid:
                yield PaperFigureData(condition, valid, start_time_s, where)


# --------------------------------------------------------------------------------------------------
# Catalogue of the paper figures: filters, quantity and printed numbers of each. Filters of a column: the paper's
# baselines, the proposed method as printed, and as repaired, four at most.

_YAN, _PU, _COFM, _DMC, _TIAN = (
    "Yan et al. 2016", "Pu and Qin", "COFM-AMSSRCPF 2024", "The DMC particle filter", "Tian et al."
)  # fmt: skip


_MODIFIED = (("sir", "rpf_printed", "mcmc_rpf"),)
_NO_TRANSITION = (
    "The moves as printed need a transition density, which this model does not have. "
    "The numbers of the paper's results are lost in our copy."
)
_PASSIVE = (
    ("sir_printed", "gpf", "qmc_gpf"),  # that section 4 compares
    ("sir_printed", "gpf", "qmc_polymerised_printed", "qmc_polymerised"),
)
_NO_NUMBER = "The text prints no number."
_COMPARED = ("compared in section 4", "proposed")
_PASSIVE_STUDIES = ("paper_001", "paper_001_200")
_RULES = (("ckf", "hckf", "mssrckf"),)
_CUBATURE = (("cpf", "fmcpf", "cofm_amssrcpf_printed", "cofm_amssrcpf"),)
_BOUNDS = (
    tuple(f"cofm_mssrckf[gain_adaptations.1.max_ratio={v}]" for v in ("1.0", "1000000000.0")),
)
_FADINGS = (
    tuple(f"fm_mssrckf[noise_adaptations.0.fading_factor={v}]" for v in ("1.002", "1.01", "1.05")),
)
_ALPHA = (
    "The copy of the paper lacks the definition and the values of its parameter alpha: these values are ours. "
    "No study varies the forgetting factor of the noise adaptation, the third reading."
)
_SIMULATION_1 = (
    PrintedValue("mssrckf", "position_N", 550.0, 1.8), PrintedValue("ckf", "position_N", 550.0, 2.4),
    PrintedValue("mssrckf", "position_E", 350.0, 1.2), PrintedValue("ckf", "position_E", 550.0, 2.9),
)  # fmt: skip
_SURGES = tuple(
    PrintedValue("cpf", f"position_{axis}", time, value)
    for time, values in ((500.0, (8.6, 7.4, 16.4)), (900.0, (8.9, 6.6, 10.4)))
    for axis, value in zip("NEU", values, strict=True)
)
_MAXIMA = tuple(
    PrintedValue(label, f"position_{axis}", "maximum", value)
    for label, axis, values in (
        ("cpf", "N", (8.9,)), ("cpf", "E", (7.4,)), ("cpf", "U", (16.4,)),
        ("fmcpf", "N", (6.8,)), ("fmcpf", "E", (5.75, 6.8)), ("fmcpf", "U", (10.5,)),
        ("cofm_amssrcpf_printed", "N", (3.5, 4.02)), ("cofm_amssrcpf_printed", "E", (3.5, 4.4)),
        ("cofm_amssrcpf_printed", "U", (5.2,)),
    )
    for value in values
)  # fmt: skip
_FACTORS = {"noise ×1": "1.0", "noise ×30": "30.0"}
_NOISE = "Process noise of the filters: that of the sensors, and 30 times as much; the paper prints none."
_CORRECTED = tuple(
    tuple(
        f"{name}[model.process_noise_factor={factor}]"
        for name in ("ukf", "dmc_reconstructed_printed", "dmc_reconstructed")
    )
    for factor in _FACTORS.values()
)
_SPREADS = {
    "velocity": zip("ENU", (0.2259, 0.2293, 0.2250), strict=True),
    "position": zip("ENU", (1.8137, 2.1560, 2.0752), strict=True),
}
_TABLES = {
    group: tuple(
        PrintedValue(labels[1], f"{group}_{axis}", "RMSE", v)
        for axis, v in values
        for labels in _CORRECTED
    )
    for group, values in _SPREADS.items()
}
_SWARMS = (("sir", "cpso_pf", "cpso_escape_printed", "cpso_escape"),)
_STOPPED = (("pso_pf", "cpso_pf", "cpso_escape_printed", "cpso_escape_stopped"),)
_DEVIATIONS = {
    group: tuple(
        PrintedValue("cpso_escape_printed", f"{group}_{axis}", "RMSE", value)
        for axis, value in zip("NEU", values, strict=True)
    )
    for group, values in {"position": (6.87, 7.2, 4.83), "velocity": (0.20, 0.21, 0.14)}.items()
}
_LARGEST = tuple(
    PrintedValue("cpso_escape_printed", f"position_{axis}", "maximum", 34.0) for axis in "NEU"
)


_BEFORE = partial(make_error_figures, before=True)
_SIZE = partial(make_trace_figures, "particles", "number of particles", "particles")
_NEFF = partial(make_trace_figures, "ess", "effective number of particles", "Neff")
_FLOWN = partial(make_trace_figures, "iterations", "iterations until the swarm stops", "iterations")
_FLIGHT = partial(
    make_flight_figures, "true track of the first run from above, and its height. The dot is the start.", plot_flight
)  # fmt: skip
_SPEED = partial(
    make_flight_figures, "velocity of the first run, from differences of its true positions.", plot_flight_velocity
)  # fmt: skip
_SECOND = "section on simulation 2"


FIGURES: Mapping[str, PaperFigure] = {
    "000-1": PaperFigure(
        f"{_YAN}, figure 1", _MODIFIED, _FLIGHT, ("paper_000",),
        printed=(PrintedValue("", "Up", 480.0, 3875.0), PrintedValue("", "Up", 1000.0, 748.0)),
        source="Crosses: 3875 m at most and 748 m at the end above the start, from 2000, 5875 and 2748 m in the section on performance, "
        "which prints no time of the highest point.",
    ),
    "000-2": PaperFigure(
        f"{_YAN}, figure 2", _MODIFIED, make_error_figures, ("paper_000",), groups=("attitude",), source=_NO_TRANSITION,
    ),
    "000-3": PaperFigure(
        f"{_YAN}, figure 3", _MODIFIED, make_error_figures, ("paper_000",), groups=("position",), source=_NO_TRANSITION,
    ),
    "001-2": PaperFigure(f"{_PU}, figure 2", _PASSIVE, make_relative_error_figures, _PASSIVE_STUDIES, titles=_COMPARED, source=_NO_NUMBER),
    "001-3": PaperFigure(f"{_PU}, figure 3", _PASSIVE, make_time_figure, _PASSIVE_STUDIES, titles=_COMPARED),
    "001-4": PaperFigure(f"{_PU}, figure 4", _PASSIVE, make_ess_figure, _PASSIVE_STUDIES, titles=_COMPARED, source=_NO_NUMBER),
    "001-position": PaperFigure(
        f"{_PU}, position behind figure 2", _PASSIVE, make_error_figures, _PASSIVE_STUDIES, titles=_COMPARED, groups=("position",), source=_NO_NUMBER,
    ),
    "002-3-bound": PaperFigure(
        f"{_COFM}, figure 3, read as the ratio bound", _BOUNDS, partial(make_parameter_figures, "ratio bound"),
        ("paper_002_bound",), groups=("position",), source=_ALPHA,
    ),
    "002-3-fading": PaperFigure(
        f"{_COFM}, figure 3, read as the fading factor", _FADINGS, partial(make_parameter_figures, "fading factor"),
        ("paper_002_fading",), groups=("position",), source=_ALPHA,
    ),
    "002-6": PaperFigure(
        f"{_COFM}, figures 6 to 9", (("mssrckf",),), _BEFORE, ("paper_002_rules",), "nominal",
        ("gyro_bias", "accelerometer_bias"),
    ),
    "002-10": PaperFigure(
        f"{_COFM}, figures 10 and 11", _RULES, make_error_figures, ("paper_002_rules",), "nominal", ("position",), _SIMULATION_1,
        "Crosses: section on simulation 1, 1.8 and 2.4 m of latitude at 550 s, 1.2 m of longitude at 350 s and 2.9 m at 550 s.",
    ),
    "002-12": PaperFigure(
        f"{_COFM}, figures 12 to 14", _CUBATURE, make_error_figures, ("paper_002",), "paper_bursts", ("position",), _SURGES,
        f"Crosses: errors of the CPF at 500 and 900 s, {_SECOND}.",
    ),
    "002-velocity": PaperFigure(
        f"{_COFM}, velocity behind figures 12 to 14", _CUBATURE, make_error_figures, ("paper_002",), "paper_bursts", ("velocity",),
    ),
    "002-maxima": PaperFigure(
        f"{_COFM}, {_SECOND}", _CUBATURE, make_maximum_figures, ("paper_002",), "paper_bursts", ("position",), _MAXIMA,
        "Crosses: maximum errors as printed; the text prints two numbers for some.",
    ),
    "002-number": PaperFigure(f"{_COFM}, {_SECOND}", _CUBATURE, _SIZE, ("paper_002",), "paper_bursts"),
    "002-neff": PaperFigure(
        f"{_COFM}, {_SECOND}", _CUBATURE, _NEFF, ("paper_002",), "paper_bursts",
        printed=tuple(
            PrintedValue("cofm_amssrcpf_printed", "", time, value)
            for time in (200.0, 500.0, 800.0, 1100.0, 1400.0) for value in (110.0, 180.0)
        ),
        source=f"Crosses: maintained between 110 and 180, {_SECOND}.",
    ),
    "003-1": PaperFigure(f"{_DMC}, figure 1", _CORRECTED, _FLIGHT, ("paper_003",)),
    "003-2": PaperFigure(f"{_DMC}, figure 2", _CORRECTED, _SPEED, ("paper_003",)),
    "003-3": PaperFigure(
        f"{_DMC}, figure 3", _CORRECTED, make_error_figures, ("paper_003",), titles=tuple(_FACTORS), groups=("attitude",),
        printed=tuple(PrintedValue(labels[1], "attitude_E", 110.0, 22.0) for labels in _CORRECTED),
        source=f"Crosses: a pitch error of about 22 arcmin within 110 s, section 5; pitch is taken as the angle about East. {_NOISE}",
    ),
    "003-4": PaperFigure(
        f"{_DMC}, figure 4", _CORRECTED, make_error_figures, ("paper_003",), titles=tuple(_FACTORS), groups=("velocity",),
        printed=_TABLES["velocity"], source=f"Crosses: table 1. {_NOISE}",
    ),
    "003-5": PaperFigure(
        f"{_DMC}, figure 5", _CORRECTED, make_error_figures, ("paper_003",), titles=tuple(_FACTORS), groups=("position",),
        printed=_TABLES["position"], source=f"Crosses: table 2. {_NOISE}",
    ),
    "004-1": PaperFigure(
        f"{_TIAN}, figure 1", (("cpso_escape_printed", "cpso_escape_stopped", "cpso_escape"),), make_escape_figure, ("paper_004",),
        source="Eq. 35 as printed divides the cosine by the number of iterations, so that its curve stays close to 0.12.",
    ),
    "004-3": PaperFigure(
        f"{_TIAN}, figure 3", (("ekf", "cpso_escape_printed", "cpso_escape"),), _BEFORE, ("paper_004",), "nominal",
        ("gyro_constant", "gyro_markov", "accelerometer_bias"),
    ),
    "004-4": PaperFigure(
        f"{_TIAN}, figure 4", _SWARMS, make_error_figures, ("paper_004",), "nominal", ("position",),
        (*_DEVIATIONS["position"], *_LARGEST),
        "Crosses: deviations of 6.87, 7.2 and 4.83 m and errors within 34 m, section 6.",
    ),
    "004-5": PaperFigure(
        f"{_TIAN}, figure 5", _SWARMS, make_error_figures, ("paper_004",), "nominal", ("velocity",), _DEVIATIONS["velocity"],
        "Crosses: deviations of 0.20, 0.21 and 0.14 m/s, section 6.",
    ),
    "004-iterations": PaperFigure(
        f"{_TIAN}, sections 4 and 5", _STOPPED, _FLOWN, ("paper_004", "paper_004_iterations"), "nominal",
        source="The fixed numbers are the limit of the filters without a rule to stop. The text prints no number.",
    ),
    "004-before": PaperFigure(
        f"{_TIAN}, figures 2, 4 and 5 before correction", (("ekf",),), make_error_figures, ("paper_004_alone",), "outage",
        ("position", "velocity"),
    ),
}  # fmt: skip
