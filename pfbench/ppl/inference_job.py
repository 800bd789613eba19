"""Inference of the parameters of a model from a configuration: data of a scenario, priors by quantiles or names, a result as JSON."""

from __future__ import annotations

import json
import multiprocessing
import shutil
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pfbench.core.parameter_checks import require, require_range
from pfbench.core.record import Record
from pfbench.files.atomic_write import write_atomically
from pfbench.files.command_start import start_work
from pfbench.files.escapes import markdown_head, markdown_row
from pfbench.filter.belief import Filter
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.guided.twisted import TwistedParticleFilter
from pfbench.model.linear_gaussian import LinearGaussian
from pfbench.ppl.ibis_smc2 import smc2
from pfbench.ppl.likelihood import (
    FilterLikelihood,
    GaussianHmmLikelihood,
    MarginalLikelihood,
    repeat_runs,
)
from pfbench.ppl.mixture_sampling import pick_evenly
from pfbench.ppl.noise_job import infer_noise
from pfbench.ppl.nuts_svi import normal_guide, nuts, svi
from pfbench.ppl.parameter_posterior import ParameterPosterior, simulation_based_calibration
from pfbench.ppl.parameterised_model import ParameterisedModel, Prior
from pfbench.ppl.particle_mcmc import PmmhSettings, pmmh
from pfbench.ppl.priors import find_range, read_priors
from pfbench.ppl.pyro_program import program
from pfbench.results.plotting import FigureSpec, draw_figure
from pfbench.results.store import compute_config_key, extend_key
from pfbench.stats.likelihood_floor import likelihood_floor

_SETTINGS = {
    "nuts": ("draws", "warmup", "chains", "first_chain"),
    "svi": ("steps", "draws", "rate"),
    "pmmh": ("draws", "warmup", "chains"),
    "smc2": ("moves",),
}
_RULES = {
    "draws": "whole [1, inf)", "warmup": "whole [0, inf)", "chains": "whole [1, inf)", "values": "whole [2, inf)", "moves": "whole [0, inf)",
    "steps": "whole [1, inf)", "rate": "(0, inf)", "look_ahead": "null or whole [0, inf) Use 10, or 1 for a nearly linear model.",
}  # fmt: skip
_BINS = 5  # of ranks, so that 40 data sets suffice for a test
_SILENCE, _RECENT = 10.0, 200  # s between two lines of progress; steps of their acceptance rate
_KEYS = ("model", "scenario", "noise", "filter", "infer", "seed", "runs", "first_run")


class InferenceTask(NamedTuple):
    """Unknown parameters of a model, with the filter and the data of their inference."""

    unknown: ParameterisedModel
    method: Filter
    record: Record


def list_numbers(node: Any, path: str = "") -> dict[str, float]:
    """List the numbers of a configuration, nested ones and those of lists too, by name: `tuning.gyro_density`, `measurement_sd[0]`."""
    if type(node) in (int, float):
        return {path: node}
    if isinstance(node, Mapping):
        inner = [(f"{path}.{key}".lstrip("."), value) for key, value in node.items()]
    else:
        inner = [(f"{path}[{i}]", v) for i, v in enumerate(node if isinstance(node, list) else [])]
    return {name: v for key, value in inner for name, v in list_numbers(value, key).items()}


def make_priors(
    parameters: Any, node: Mapping[str, Any], build: Callable[..., Any]
) -> dict[str, Prior]:
    """Make priors of numbers of a model, by name or by quantiles on the range that the model accepts.

    `build` makes the object of a node, with other arguments as keywords. Raises ValueError for a parameter that the model has not.
    """
    numbers = list_numbers(node)
    choice = f"Choose from {', '.join(numbers) or 'none'}"
    remedy = f"{choice}: parameters={{{next(iter(numbers), 'KEY')}:[0.1,10]}}."
    ok = isinstance(parameters, Mapping) and parameters
    require(ok, "parameters", "name at least one unknown key of the model", parameters or "none", remedy)  # fmt: skip

    def is_accepted(name: str, value: float) -> bool:
        try:
            build(node, **{name: torch.tensor(value, dtype=torch.float64)})
        except ValueError:
            return False
        return True

    def find_ends(name: str) -> tuple[float, float]:
        ends = find_range(partial(is_accepted, name), float(numbers[name]))
        require(ends[0] < ends[1], f"parameters.{name}", "be a number that the model accepts near its value, too", numbers[name], "Choose another: it is a count or a seed.")  # fmt: skip
        return ends

    return read_priors(parameters, numbers, find_ends)


def infer(
    name: str,
    values: Mapping[str, Any],
    choices: Mapping[str, str],
    build: Callable[..., Any],
    about: Mapping[str, Any],
    truth: Mapping[str, float],
    cores: int = 1,
) -> tuple[Path, dict[str, Any]]:
    """Infer the parameters of a configuration by a method, unless the result exists; return its file and content.

    `build` makes the object of a node, with other arguments as keywords. `truth` has the true values, where they are known. Chains
    are divided among `cores` processes. What they have done is stored on the way, so that the same call continues after a kill.
    """
    settings = {key: values[key] for key in _KEYS} | {"method": name}
    ignored = ("scenario.root", "scenario.cache_dir")
    key = extend_key(compute_config_key(settings, ignored), about.get("inputs", {}))
    path = Path(values["results_dir"]) / values["study"] / "inference" / f"{name}_{key}.json"
    if path.is_file() and not values["overwrite"]:
        return path, json.loads(path.read_text())
    start = time.perf_counter()
    if name == "noise":
        draws, weights, extra, figure = infer_noise(values, choices, build)
        posterior = draw_equally(draws, weights, "importance sampling")
        drawing = FigureSpec(path.stem, "Prior and posterior of noise numbers.", lambda: figure)
        picture = draw_figure(drawing, ["svg"])["svg"]
        write_atomically(path.with_suffix(".svg"), lambda file: file.write(picture))
    else:
        folder = path.with_suffix(".parts")
        posterior, extra = _draw(name, values, choices, build, folder, cores)
    content = {
        "format": 1,
        "method": name,
        "choices": {group: choices[group] for group in ("model", "scenario", "noise", "filter")},
        "settings": settings,
        "table": posterior.table().to_dict(orient="index"),
        "truth": {key: truth[key] for key in posterior.draws if key in truth},
        "converged": posterior.has_converged,
        "seconds": time.perf_counter() - start,
        **extra,
        **about,
        "posterior": posterior.to_dict(),
    }
    text = json.dumps(content, default=str)
    write_atomically(path, lambda file: file.write(text.encode()))
    shutil.rmtree(path.with_suffix(".parts"), ignore_errors=True)
    return path, json.loads(text)


def _draw(
    name: str,
    values: Mapping[str, Any],
    choices: Mapping[str, str],
    build: Callable[..., Any],
    folder: Path,
    cores: int,
) -> tuple[ParameterPosterior, dict[str, Any]]:
    """Draw by a method from the posterior of the parameters that the configuration names, in parts that are stored in a folder."""
    _make_checked_task(name, values, choices, build)
    chains = values["infer"].get("chains", 1)
    start_work()
    size = 1 if name == "nuts" else -(-chains // cores)
    parts = [(first, min(size, chains - first)) for first in range(0, chains, size)]
    draw = partial(_draw_part, name, values, build, folder)
    if min(cores, len(parts)) == 1:
        results = list(map(draw, parts))
    else:
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(min(cores, len(parts)), context) as pool:
            results = list(pool.map(draw, parts))
    posteriors, extras = zip(*results, strict=True)
    posterior = ParameterPosterior.join([ParameterPosterior.from_dict(p) for p in posteriors])
    rate = posterior.accepted
    return posterior, extras[0] | ({} if rate is None else {"acceptance": float(rate.mean())})


def calibrate(
    name: str,
    values: Mapping[str, Any],
    choices: Mapping[str, str],
    build: Callable[..., Any],
    count: Any,
) -> str:
    """Return a table of the ranks of true parameters among draws of a method, see `simulation_based_calibration`.

    Parameters of `count` data sets are drawn from the prior. Measurements are drawn from the model, with the inputs, the steps and the
    gaps of the scenario, and each data set is inferred by itself.
    """
    require_range("calibrate", count, "whole [20, inf) Use calibrate=100.")
    require(name in _SETTINGS, "calibrate", "have a method with named parameters", f"method={name}", f"Use one of {', '.join(_SETTINGS)}.")  # fmt: skip
    require(values["runs"] == 1, "runs", "be 1 for calibrate, which simulates the data sets", values["runs"])  # fmt: skip
    task, seed = _make_checked_task(name, values, choices, build), int(values["seed"])
    start_work()
    settings = {**values["infer"], "first_chain": 0}

    def infer_each(record: Record) -> ParameterPosterior:
        fits = [
            _draw_by(
                name,
                task._replace(record=record.select_runs(slice(r, r + 1))),
                settings,
                seed + r,
                Steps(f"data set {r + 1} of {count}", None),
            )[0]
            for r in range(count)
        ]
        draws = {k: torch.stack([fit.pooled_draws(k) for fit in fits], -1) for k in fits[0].draws}
        return ParameterPosterior({k: a.unsqueeze(0) for k, a in draws.items()}, method=name)

    template = repeat_runs(task.record._replace(feedback=None), count)
    ranks = simulation_based_calibration(task.unknown, template, infer_each, seed=seed)
    lines = markdown_head("parameter", "data sets in each fifth of the ranks", "p")
    for key in task.unknown.names:
        counts = " ".join(map(str, ranks.counts(key, _BINS)))
        lines.append(markdown_row(key, counts, f"{ranks.p_value(key, _BINS):.2g}"))
    return "\n".join(lines)


def _make_checked_task(
    name: str, values: Mapping[str, Any], choices: Mapping[str, str], build: Callable[..., Any]
) -> InferenceTask:
    """Check the settings of a method, and build its task."""
    for key in _RULES.keys() & values["infer"].keys():
        require_range(f"infer.{key}", values["infer"][key], _RULES[key])
    task = _make_task(values, build)
    if name in ("nuts", "svi"):
        _check_gradient(name, task, choices["model"])
    return task


def _draw_part(
    name: str,
    values: Mapping[str, Any],
    build: Callable[..., Any],
    folder: Path,
    group: tuple[int, int],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Draw some chains, from the first of `group` on, unless they are stored; return the posterior as a dictionary, and other results."""
    torch.set_num_threads(int(values["threads"]))
    path = folder / "chains_{}_{}.json".format(*group)
    if not path.is_file():
        settings = {**values["infer"], "first_chain": group[0], "chains": group[1]}
        label = f"{name}, {group[1]} chains from {group[0] + 1} on"
        steps = Steps(label, path.with_suffix(".pt"))
        posterior, extra = _draw_by(name, _make_task(values, build), settings, int(values["seed"]), steps)  # fmt: skip
        text = json.dumps([posterior.to_dict(), extra])
        write_atomically(path, lambda file: file.write(text.encode()))
    result: tuple[dict[str, Any], dict[str, Any]] = tuple(json.loads(path.read_text()))
    return result


class Steps:
    """Steps of a part of an inference: lines on standard error, at most one in ten seconds, and the file of their state."""

    def __init__(self, label: str, file: Path | None) -> None:
        self.label, self.file, self.total = label, file, 0
        self.rates: list[float] = []
        self.first, self.reported = (-1, 0.0), time.monotonic()

    def __call__(self, done: int, rate: float | None = None) -> None:
        """Note that steps are done, with an acceptance rate, and say so after a while."""
        now = time.monotonic()
        self.rates += [] if rate is None else [rate]
        if self.first[0] < 0:
            self.first = done, now
        if now - self.reported > _SILENCE:
            self.reported = now
            minutes = (
                (now - self.first[1]) / max(done - self.first[0], 1) * (self.total - done) / 60.0
            )
            recent = self.rates[-_RECENT:]
            words = f", {sum(recent) / len(recent):.0%} accepted" if recent else ""
            print(f"{self.label}: {done} of {self.total} steps{words}, {minutes:.1f} min left", file=sys.stderr, flush=True)  # fmt: skip


def _make_task(values: Mapping[str, Any], build: Callable[..., Any]) -> InferenceTask:
    """Build model, filter and data of a configuration."""
    node = values["model"]
    priors = make_priors(values["infer"]["parameters"], node, build)
    unknown = ParameterisedModel(lambda **changed: build(node, **changed), priors)
    numbers = torch.arange(values["first_run"], values["first_run"] + values["runs"])
    episode = build(values["scenario"]).draw(build(values["noise"]), numbers, int(values["seed"]))
    record = episode.record._replace(y=episode.record.y.double())
    passes = values["infer"].get("look_ahead")
    if passes is None:
        return InferenceTask(unknown, build(values["filter"]), record)
    return InferenceTask(unknown, TwistedParticleFilter(values["particles"], passes=passes), record)


def _check_gradient(name: str, task: InferenceTask, model: str) -> None:
    """Check that the likelihood has a gradient for each parameter; that of particles is not the gradient of the likelihood."""
    remedy = "Use filter=ekf, or method=pmmh, which needs no gradient."
    by_particles = hasattr(task.method, "particles")
    require(not by_particles, f"method={name}", "have a likelihood with a gradient", f"a filter of particles, {type(task.method).__name__}", remedy)  # fmt: skip
    values = {
        key: value[0].detach().requires_grad_() for key, value in task.unknown.sample(1, 0).items()
    }
    likelihood = choose_likelihood(task)(task.unknown.model(values), task.record)
    missing = list(values)
    if likelihood.requires_grad:
        gradients = torch.autograd.grad(likelihood.sum(), list(values.values()), allow_unused=True)
        missing = [k for k, g in zip(values, gradients, strict=True) if g is None or not g.any()]
    require(
        not missing,
        f"method={name}",
        "have a likelihood with a gradient",
        f"model={model}, whose {', '.join(missing)} has none with this filter",
        "Use filter=ekf and a model of tensors, or method=pmmh, which needs no gradient.",
    )


def choose_likelihood(task: InferenceTask) -> MarginalLikelihood:
    """Choose the likelihood of a method with gradients: of a linear model Pyro's, which is exact and takes less time."""
    model = task.unknown.some_model()
    is_kalman = isinstance(task.method, GaussianFilter) and isinstance(model, LinearGaussian)
    is_plain = is_kalman and not getattr(task.method, "noise_adaptations", ())
    return GaussianHmmLikelihood() if is_plain else FilterLikelihood(task.method)


def _draw_by(
    name: str, task: InferenceTask, settings: Mapping[str, Any], seed: int, steps: Steps
) -> tuple[ParameterPosterior, dict[str, Any]]:
    """Draw by a method; return the posterior and what else is stored."""
    unknown, record = task.unknown, task.record
    steps.total = settings["draws"] + settings["warmup"] if "warmup" in settings else record.y.shape[1]  # fmt: skip
    options = {key: settings[key] for key in _SETTINGS[name]}
    if name == "smc2":
        particles = settings["values"]
        result = smc2(unknown, task.method, record, particles, seed, tick=steps, **options)
        floor = None if unknown.some_model().has_counts else likelihood_floor(record.y.numpy())
        extra = {
            "log_evidence": float(result.log_evidence[-1]),
            "evidence_floor": None if floor is None else float(floor.sum()),
            "ess": float(result.ess[-1]),
        }
        return draw_equally(result.values, result.weights, "SMC2"), extra
    if name == "pmmh":
        files = PmmhSettings(tick=steps, checkpoint=steps.file)
        first = seed + 100_003 * settings["first_chain"]
        return pmmh(unknown, task.method, record, seed=first, settings=files, **options), {}
    model = program(unknown, choose_likelihood(task))
    if name == "nuts":
        return nuts(model, record, seed=seed, tick=steps, **options), {}
    fit = svi(model, record, normal_guide(unknown), seed=seed, **options)
    return fit.posterior, {"losses": fit.losses}


def draw_equally(values: Mapping[str, Tensor], weights: Tensor, method: str) -> ParameterPosterior:
    """Resample weighted values at equal quantiles, so that all have the same weight: as many as there are."""
    indices = pick_evenly(weights, len(weights))
    draws = {key: value[indices].unsqueeze(0) for key, value in values.items()}
    return ParameterPosterior(draws, method=method)
