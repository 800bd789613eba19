"""Command `pfbench infer`: infer parameters of a model by NUTS, SVI, PMMH or SMC2."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pfbench.cli.command import Command
from pfbench.cli.compose import given_keys
from pfbench.cli.messages import suggest_similar
from pfbench.cli.noise_scenario import (
    check_scenario_name,
    format_noise,
    list_places,
    write_scenario,
)
from pfbench.core.parameter_checks import require
from pfbench.job.config import compose, is_simulated_from, list_groups

HELP = """\
pfbench infer model=NAME method=nuts|svi|pmmh|smc2 'parameters={KEY:[LOW,HIGH]}' [key=value ...]
pfbench infer scenario=NAME [key=value ...]

Infer numbers of a model from measurements of a scenario, by the likelihood of a filter. LOW and HIGH are the 5 % and the
95 % quantile of a prior on the values that the model accepts. A prior can have a name instead. The result has the posterior table and all draws; a finished one is not computed again,
and an interrupted one goes on: from the chains of nuts that are finished, and from a state of pmmh that is stored each 20 s.

Without a method and parameters: all noise numbers of an inertial log (IMU, bias walks, fixes), lever arm and delay, with priors
from data sheets (method=noise). The numbers become a scenario that run, tune and estimate know by its name.

  pfbench infer scenario=user_log scenario.folder=drive infer.sheet.gyro_deg_s=0.0038 infer.sheet.accelerometer_ug=70
  pfbench infer model=local_level method=nuts 'parameters={level_sd:[10,100],measurement_sd:[50,300]}'
  pfbench infer model=stochastic_volatility method=pmmh 'parameters={sigma:[0.1,1]}' particles=200 infer.chains=16
  pfbench infer model=stochastic_volatility method=smc2 filter=sir 'parameters={rho:{beta:[20,1.5],on:[-1,1]}}'

  scenario=NAME              where the measurements come from; that of the model's name by default
  runs=1 seed=1 noise=NAME   runs that share the parameters
  filter=NAME                filter of the likelihood: ekf, and sir for pmmh
  infer.draws=500            settings of the method: pfbench list infer
  cores=2                    processes of the chains of nuts and pmmh
  overwrite=true             infer again
  calibrate=100              ranks of true parameters in 100 simulated data sets, uniform if the method is right
  name=SCENARIO_noise        of the scenario of method=noise, a file of folder=conf

Python: pfbench.ppl, docs/parameter_inference.md"""

NOISE = "noise"  # method without named parameters
_USAGE = "Use: pfbench infer model=NAME method=nuts 'parameters={KEY:[LOW,HIGH]}'"


def infer_parameters(words: Sequence[str]) -> None:
    """Infer the parameters of a model, and print their posterior."""
    from pfbench import job
    from pfbench.job.inputs import find_inputs
    from pfbench.ppl.inference_job import calibrate, infer

    options = {"name": "", "folder": "conf", "cores": "1", "calibrate": ""}
    options |= {k: v for k, _, v in (word.partition("=") for word in words) if k in options}
    method, composed = _read_words([w for w in words if w.partition("=")[0] not in options])
    config = compose(composed)
    values, choices = config.values, config.choices
    job.apply_global_settings(values)
    has_truth = choices["noise"] == "nominal" and is_simulated_from(values["scenario"], choices["scenario"])  # fmt: skip
    about = {"versions": job.read_versions(), "inputs": find_inputs(values, config.trusted)}
    if count := options["calibrate"]:
        print(calibrate(method, values, choices, _build, int(count) if count.isdigit() else count))
        return
    scenario_file = None
    if method == NOISE:
        name = options["name"] or f"{choices['scenario']}_noise"
        scenario_file = check_scenario_name(name, options["folder"])
    cores = int(options["cores"]) if options["cores"].isdigit() else 0
    require(cores > 0, "cores", "be a number of processes from 1 on", options["cores"], "Use cores=2.")  # fmt: skip
    path, content = infer(
        method, values, choices, _build, about, values["model"] if has_truth else {}, cores
    )
    print(format_noise(content) if scenario_file else format_posterior(content))
    print(f"inference: {path.resolve()}")
    if scenario_file:
        _keep_scenario(scenario_file, words, values, content)


def _keep_scenario(
    path: Path, words: Sequence[str], values: Mapping[str, Any], content: Mapping[str, Any]
) -> None:
    """Write the scenario with the inferred numbers, if they are reliable, and say how it is used."""
    remedy = "Use more draws: infer.draws=2000 infer.rounds=6."
    require(content["converged"], "Pareto k", "be below 0.7 for numbers that a filter may use", f"{content['pareto_k']:.2f}", remedy)  # fmt: skip
    left_out = write_scenario(path, content["choices"]["scenario"], words, values["scenario"], content)  # fmt: skip
    use = " ".join(["Use: pfbench run", f"scenario={path.stem}", *list_places(words)])
    print("\n".join(filter(None, (left_out, f"scenario={path.stem}: {path.resolve()}", use))))


def _read_words(words: Sequence[str]) -> tuple[str, list[str]]:
    """Return the method, and the words of the configuration: the method is a file of the group `infer`."""
    if {"-m", "--multirun"} & set(words):
        raise ValueError("pfbench infer must be run without -m, got a sweep. Repeat the command for each choice.")  # fmt: skip
    keys = given_keys(words)
    if "scenario" in keys and not keys & {"method", "parameters"}:
        words, keys = [*words, f"method={NOISE}"], keys | {"method"}
    if not {"model", "scenario"} & keys or "method" not in keys:
        raise ValueError(f"{'method' if {'model', 'scenario'} & keys else 'model'} must be set. {_USAGE}")  # fmt: skip
    methods = list_groups()["infer"]
    words_by_key = {word.partition("=")[0]: word.partition("=")[2] for word in words}
    method = words_by_key["method"]
    if method not in methods:
        raise ValueError(
            f"method must be one of {', '.join(methods)}, got {method}.{suggest_similar(method, methods)} {_USAGE}"
        )
    by_kalman = method in (NOISE, "nuts", "svi")
    require(not by_kalman or "particles" not in keys, "particles", f"be left out for method={method}, a Kalman filter", words_by_key.get("particles"), "Leave it out, or use method=pmmh.")  # fmt: skip
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
    has_name = model in list_groups()["scenario"]
    require(has_name, "scenario", f"be set for model={model}", "none of its name", "Choose one: pfbench list scenario.")  # fmt: skip
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
    note = "" if content["converged"] else "\nr_hat is not below 1.05, or unknown from so few draws: the chains may not have mixed. Use more draws: infer.warmup=... infer.draws=..."  # fmt: skip
    renamed = table.rename(columns={"low": "low 90 %", "high": "high 90 %"})
    return f"{head}\n{renamed.to_string(float_format=lambda value: f'{value:.4g}')}{format_evidence(content)}{note}"


def format_evidence(content: Mapping[str, Any]) -> str:
    """Format the log evidence of a result and its floor; empty for a method without evidence."""
    evidence, floor = content.get("log_evidence"), content.get("evidence_floor")
    if evidence is None or floor is None:
        return "" if evidence is None else f"\nlog evidence {evidence:.2f}"
    verdict = "above" if evidence > floor else "below: this model is worse than no model"
    return f"\nlog evidence {evidence:.2f}, {verdict}; an autoregression or independent normals fitted to the measurements have {floor:.2f}"


COMMAND = Command(infer_parameters, HELP)
