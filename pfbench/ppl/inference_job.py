"""Inference of the parameters of a model from a configuration: data of a scenario, priors by quantiles or names, a result as JSON."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pfbench.core.parameter_checks import require
from pfbench.core.record import Record
from pfbench.files.atomic_write import write_atomically
from pfbench.files.command_start import start_work
from pfbench.filter.belief import Filter
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.model.linear_gaussian import LinearGaussian
from pfbench.ppl.ibis_smc2 import smc2
from pfbench.ppl.likelihood import FilterLikelihood, GaussianHmmLikelihood, MarginalLikelihood
from pfbench.ppl.noise_job import infer_noise
from pfbench.ppl.nuts_svi import normal_guide, nuts, svi
from pfbench.ppl.parameter_posterior import ParameterPosterior
from pfbench.ppl.parameterised_model import ParameterisedModel, Prior
from pfbench.ppl.particle_mcmc import pmmh
from pfbench.ppl.priors import find_range, prior_by_name, prior_by_quantiles
from pfbench.ppl.pyro_program import program
from pfbench.results.plotting import FigureSpec, draw_figure
from pfbench.results.store import compute_config_key, extend_key

_BY_GRADIENT = ("nuts", "svi")
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
    priors = {}
    for name, words in parameters.items():
        require(name in numbers, "parameters", "name numbers of the model", name, f"{choice}.")
        if isinstance(words, Mapping):
            priors[name] = prior_by_name(name, words)
        else:
            ends = find_range(partial(_is_accepted, build, node, name), float(numbers[name]))
            priors[name] = prior_by_quantiles(name, words, numbers[name], ends)
    return priors


def _is_accepted(
    build: Callable[..., Any], node: Mapping[str, Any], name: str, value: float
) -> bool:
    """Return whether a model accepts a value of a number."""
    try:
        build(node, **{name: torch.tensor(value, dtype=torch.float64)})
    except ValueError:
        return False
    return True


def infer(
    name: str,
    values: Mapping[str, Any],
    choices: Mapping[str, str],
    build: Callable[..., Any],
    about: Mapping[str, Any],
    truth: Mapping[str, float],
) -> tuple[Path, dict[str, Any]]:
    """Infer the parameters of a configuration by a method, unless the result exists; return its file and content.

    `build` makes the object of a node, with other arguments as keywords. `truth` has the true values, where they are known.
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
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path.with_suffix(".svg"), lambda file: file.write(picture))
    else:
        posterior, extra = _draw(name, values, choices, build)
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
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda file: file.write(text.encode()))
    return path, json.loads(text)


def _draw(
    name: str, values: Mapping[str, Any], choices: Mapping[str, str], build: Callable[..., Any]
) -> tuple[ParameterPosterior, dict[str, Any]]:
    """Draw by a method from the posterior of the parameters that the configuration names."""
    task = _make_task(values, build)
    if name in _BY_GRADIENT:
        _check_gradient(name, task, choices["model"])
    start_work()
    return _METHODS[name](task, values["infer"], int(values["seed"]))


def _make_task(values: Mapping[str, Any], build: Callable[..., Any]) -> InferenceTask:
    """Build model, filter and data of a configuration."""
    node = values["model"]
    priors = make_priors(values["infer"]["parameters"], node, build)
    unknown = ParameterisedModel(lambda **changed: build(node, **changed), priors)
    numbers = torch.arange(values["first_run"], values["first_run"] + values["runs"])
    episode = build(values["scenario"]).draw(build(values["noise"]), numbers, int(values["seed"]))
    record = episode.record._replace(y=episode.record.y.double())
    return InferenceTask(unknown, build(values["filter"]), record)


def _check_gradient(name: str, task: InferenceTask, model: str) -> None:
    """Check that the likelihood has a gradient for each parameter; the first steps of one run show it."""
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


def _infer_by_nuts(
    task: InferenceTask, settings: Mapping[str, Any], seed: int
) -> tuple[ParameterPosterior, dict[str, Any]]:
    """Draw by the no-U-turn sampler."""
    model = program(task.unknown, choose_likelihood(task))
    counts = {key: settings[key] for key in ("draws", "warmup", "chains")}
    return nuts(model, task.record, seed=seed, **counts), {}


def _infer_by_svi(
    task: InferenceTask, settings: Mapping[str, Any], seed: int
) -> tuple[ParameterPosterior, dict[str, Any]]:
    """Draw from a fitted guide."""
    model = program(task.unknown, choose_likelihood(task))
    options = {key: settings[key] for key in ("steps", "draws", "rate")}
    result = svi(model, task.record, normal_guide(task.unknown), seed=seed, **options)
    return result.posterior, {"losses": result.losses}


def _infer_by_pmmh(
    task: InferenceTask, settings: Mapping[str, Any], seed: int
) -> tuple[ParameterPosterior, dict[str, Any]]:
    """Draw by chains of Metropolis-Hastings."""
    counts = {key: settings[key] for key in ("draws", "warmup", "chains")}
    posterior = pmmh(task.unknown, task.method, task.record, seed=seed, **counts)
    assert posterior.accepted is not None
    return posterior, {"acceptance": float(posterior.accepted.mean())}


def _infer_by_smc2(
    task: InferenceTask, settings: Mapping[str, Any], seed: int
) -> tuple[ParameterPosterior, dict[str, Any]]:
    """Draw from the weighted values after the last measurement."""
    counts = {"particles": settings["values"], "moves": settings["moves"]}
    result = smc2(task.unknown, task.method, task.record, seed=seed, **counts)
    extra = {"log_evidence": float(result.log_evidence[-1]), "ess": float(result.ess[-1])}
    return draw_equally(result.values, result.weights, "SMC2"), extra


def draw_equally(values: Mapping[str, Tensor], weights: Tensor, method: str) -> ParameterPosterior:
    """Resample weighted values at equal quantiles, so that all have the same weight: as many as there are."""
    count = len(weights)
    levels = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    indices = torch.searchsorted(weights.cumsum(0), levels).clamp(max=count - 1)
    draws = {key: value[indices].unsqueeze(0) for key, value in values.items()}
    return ParameterPosterior(draws, method=method)


_METHODS = {
    "nuts": _infer_by_nuts,
    "svi": _infer_by_svi,
    "pmmh": _infer_by_pmmh,
    "smc2": _infer_by_smc2,
}
