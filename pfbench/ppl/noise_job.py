"""Noise numbers of a log from a configuration: fitted to the first half and scored on the second, then fitted to all fixes."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from pfbench.core.parameter_checks import require, require_range
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode
from pfbench.files.command_start import start_work
from pfbench.filter.health import RELIABLE_K
from pfbench.nav.strapdown import PreintegratedImu
from pfbench.ppl.fix_filter import DENSITIES, FixFilter
from pfbench.ppl.noise_posterior import (
    NoiseFit,
    choose_values,
    fit_noise,
    make_noise_priors,
    plot_noise,
    score_settings,
    summarise_noise,
)

_FEWEST = 40  # fixes: half of them for the scores
_MICRO_G = 9.80665e-6
_UNITS = {"gyro_density": ("gyro_deg_s", math.pi / 180.0), "accelerometer_density": ("accelerometer_ug", _MICRO_G)}  # fmt: skip


def infer_noise(
    values: Mapping[str, Any], choices: Mapping[str, str], build: Callable[..., Any]
) -> tuple[dict[str, Tensor], Tensor, dict[str, Any], Figure]:
    """Infer the noise numbers of a configuration.

    Returns draws by name, their weights, what else is stored, and the picture. `build` makes the object of a node.
    """
    start, settings = time.process_time(), values["infer"]
    for key in ("draws", "rounds"):
        require_range(f"infer.{key}", settings[key], "whole [1, inf)" if key == "rounds" else "whole [100, inf)")  # fmt: skip
    passes, truth = _make_passes(values, choices, build)
    sheet = _read_sheet(settings["sheet"])
    priors = make_noise_priors(passes.numbers, sheet, settings["parameters"])
    start_work()
    steps = passes.fix_steps
    half = len(steps) // 2
    first = FixFilter(passes.record.select_steps(slice(0, steps[half])), passes.tuning)
    draws = PhiloxStream(int(values["seed"]), torch.arange(1))

    def fit(fixes: FixFilter, step: int) -> NoiseFit:
        return fit_noise(fixes, priors, draws.at_step(step), settings["draws"], settings["rounds"])

    first_fit, final_fit = fit(first, 0), fit(passes, 1)
    compared = {"scenario": {}, **_list_sheet(sheet), "inferred": choose_values(first_fit)}
    k = max(fit.draws.pareto_k for fit in (first_fit, final_fit))
    extra = {
        "rows": summarise_noise(final_fit),
        "scores": score_settings(passes, compared, half, truth),
        "fixes": len(steps),
        "pareto_k": k,
        "converged": k < RELIABLE_K,
        "ess": final_fit.draws.ess,
        "log_evidence": final_fit.draws.log_evidence,
        "cpu_seconds": time.process_time() - start,
    }
    return final_fit.values, final_fit.draws.weights, extra, plot_noise(final_fit)


def _make_passes(
    values: Mapping[str, Any], choices: Mapping[str, str], build: Callable[..., Any]
) -> tuple[FixFilter, Tensor | None]:
    """Read the log with a step for each fix, and return its filter, and the positions of the reference at the fixes."""
    node, kind = values["scenario"], str(values["model"]["_target_"]).rpartition(".")[2]
    remedy = "Use method=pmmh or another with parameters={KEY:[LOW,HIGH]}: pfbench list infer."
    require(kind == "StrapdownTotal", "model", "be strapdown_total for method=noise", choices["model"], remedy)  # fmt: skip
    require(choices["filter"] == "ekf", "filter", "be ekf for method=noise, whose likelihood is in closed form", choices["filter"], remedy)  # fmt: skip
    longest = max(node["filter_step_s"], node["receiver"]["fix_interval_s"])
    cleared = {key: None for key in node if key == "holdout"}
    scenario = build({**node, **cleared, "filter_step_s": longest})
    numbers = torch.arange(values["first_run"], values["first_run"] + values["runs"])
    episode: Episode = scenario.draw(build(values["noise"]), numbers, int(values["seed"]))
    u = episode.record.u
    assert isinstance(u, PreintegratedImu)
    require(len(u.duration) == values["runs"], "runs", "be 1 for a log, whose runs have the motion and the IMU in common", values["runs"])  # fmt: skip
    passes = FixFilter(episode.record, scenario.tuning)
    steps = passes.fix_steps
    require(len(steps) >= _FEWEST, "the log", f"have at least {_FEWEST} fixes, half of them to check the numbers", len(steps), "Use a longer part: scenario.start_s and scenario.end_s.")  # fmt: skip
    truth = episode.truth.get("position")
    return passes, None if truth is None else truth[:, steps].double()


def _read_sheet(sheet: Mapping[str, Any]) -> dict[str, float | None]:
    """Return the densities of the data sheet in SI units; None for one that is not given."""
    stated = {}
    for name, (key, factor) in _UNITS.items():
        require_range(f"infer.sheet.{key}", sheet[key], "null or (0, inf)")
        stated[name] = None if sheet[key] is None else factor * float(sheet[key])
    return stated


def _list_sheet(sheet: Mapping[str, float | None]) -> dict[str, dict[str, float]]:
    """Return the setting of the data sheet if both densities are given, with walks of a thirtieth."""
    densities = {name: value for name, value in sheet.items() if value is not None}
    if len(densities) < len(sheet):
        return {}
    walks = {name: densities[name.replace("bias_walk", "density")] / 30.0 for name in DENSITIES[2:]}
    return {"data sheet": densities | walks}
