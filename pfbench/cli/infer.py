"""Command `pfbench infer`: parameters of a model from measurements."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

from pfbench.cli.compose import given_keys
from pfbench.cli.messages import suggest_similar
from pfbench.job.config import compose, is_simulated_from, list_groups

HELP = """\
pfbench infer model=NAME method=nuts|svi|pmmh|smc2 'parameters={KEY:[LOW,HIGH]}' [key=value ...]

Infer numbers of a model from measurements of a scenario, by the likelihood of a filter. LOW and HIGH are the 5 % and the
95 % quantile of a prior on the values that the model accepts. A prior can have a name instead. The result has the posterior table and all draws; a finished one is not computed again.

  pfbench infer model=local_level method=nuts 'parameters={level_sd:[10,100],measurement_sd:[50,300]}'
  pfbench infer model=stochastic_volatility method=pmmh 'parameters={sigma:[0.1,1]}' particles=200 infer.chains=16
  pfbench infer model=stochastic_volatility method=smc2 filter=sir 'parameters={rho:{beta:[20,1.5],on:[-1,1]}}'

  scenario=NAME              where the measurements come from; that of the model's name by default
  runs=1 seed=1 noise=NAME   runs that share the parameters
  filter=NAME                filter of the likelihood: ekf, and sir for pmmh
  infer.draws=500            settings of the method: pfbench list infer
  overwrite=true             infer again

Python: pfbench.ppl, docs/parameter_inference.md"""

_USAGE = "Use: pfbench infer model=NAME method=nuts 'parameters={KEY:[LOW,HIGH]}'"


def infer_parameters(words: Sequence[str]) -> None:
    """Infer the parameters of a model, and print their posterior."""
    from pfbench import job
    from pfbench.job.inputs import find_inputs
    from pfbench.ppl.inference_job import infer

    method, composed = _read_words(words)
    config = compose(composed)
    values, choices = config.values, config.choices
    job.apply_global_settings(values)
    is_simulated = is_simulated_from(values["scenario"], choices["scenario"])
    truth = values["model"] if is_simulated and choices["noise"] == "nominal" else {}
    about = {"versions": job.read_versions(), "inputs": find_inputs(values, config.trusted)}
    path, content = infer(method, values, choices, _build, about, truth)
    print(format_posterior(content))
    print(f"inference: {path.resolve()}")


def _read_words(words: Sequence[str]) -> tuple[str, list[str]]:
    """Return the method, and the words of the configuration: the method is a file of the group `infer`."""
    if {"-m", "--multirun"} & set(words):
        raise ValueError("pfbench infer must be run without -m, got a sweep. Repeat the command for each choice.")  # fmt: skip
    keys = given_keys(words)
    if not {"model", "scenario"} & keys or "method" not in keys:
        missing = "method" if {"model", "scenario"} & keys else "model"
        raise ValueError(f"{missing} must be set. {_USAGE}")
    methods = [path.stem for path in list_groups()["infer"]]
    words_by_key = {word.partition("=")[0]: word.partition("=")[2] for word in words}
    method = words_by_key["method"]
    if method not in methods:
        raise ValueError(
            f"method must be one of {', '.join(methods)}, got {method}.{suggest_similar(method, methods)} {_USAGE}"
        )
    others = [
        f"++infer.{word}" if word.startswith("parameters") else word
        for word in words
        if not word.startswith("method=")
    ]
    if "scenario" not in keys:
        others.insert(0, f"scenario={_find_scenario(words_by_key['model'])}")
    return method, [f"+infer={method}", *([] if "runs" in keys else ["runs=1"]), *others]


def _find_scenario(model: str) -> str:
    """Return the scenario of the name of a model."""
    names = [path.stem for path in list_groups()["scenario"]]
    if model not in names:
        raise ValueError(
            f"scenario must be set for model={model}, since none has its name. Choose one: pfbench list scenario"
        )
    return model


def _build(node: Any, **changed: Any) -> Any:
    """Build the object of a node, with other numbers by name; the node alone is what is checked."""
    from pfbench import job

    return _build_changed(node, "", changed) if changed else job.instantiate(node)


def _build_changed(node: Any, path: str, changed: dict[str, Any]) -> Any:
    """Build a part of a node at a path, such as `tuning.position_sd[0]`."""
    import hydra

    if path in changed:
        return changed[path]
    if isinstance(node, list):
        return [_build_changed(value, f"{path}[{i}]", changed) for i, value in enumerate(node)]
    if not isinstance(node, dict):
        return node
    if not any(name.startswith(path) for name in changed):
        return hydra.utils.instantiate(node, _convert_="all")
    parts = {k: _build_changed(v, f"{path}.{k}".lstrip("."), changed) for k, v in node.items()}
    return _get_target(str(parts.pop("_target_")))(**parts)


@functools.cache
def _get_target(name: str) -> Any:
    """Return the class or function of a name, which `job.instantiate` has checked."""
    from hydra.utils import get_object

    return get_object(name)


def format_posterior(content: dict[str, Any]) -> str:
    """Format the posterior of a result as a table."""
    import pandas as pd

    table = pd.DataFrame.from_dict(content["table"], orient="index")
    if content["truth"]:
        table["true value"] = pd.Series(content["truth"])
    choices = content["choices"]
    head = f"{content['method']}: {choices['model']} by {choices['filter']}, data of {choices['scenario']}, {content['seconds']:.0f} s"
    note = "" if content["converged"] else "\nr_hat is above 1.05: the chains have not mixed. Use more draws: infer.warmup=... infer.draws=..."  # fmt: skip
    renamed = table.rename(columns={"low": "low 90 %", "high": "high 90 %"})
    return f"{head}\n{renamed.to_string(float_format=lambda value: f'{value:.4g}')}{note}"
