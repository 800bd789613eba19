"""Command `pfbench infer`: infer parameters of a model by NUTS, SVI, PMMH or SMC2."""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pfbench.cli.command import Command, Option, in_range
from pfbench.cli.compose import given_keys
from pfbench.cli.list import list_own_files
from pfbench.cli.messages import require_choice
from pfbench.core.parameter_checks import require
from pfbench.files.atomic_write import write_atomically
from pfbench.job.config import compose, is_simulated_from, list_groups
from pfbench.results.paper_block import list_named_parts

HELP = """\
pfbench infer model=NAME method=nuts|svi|pmmh|smc2 'parameters={KEY:[LOW,HIGH]}' [key=value ...]
pfbench infer scenario=NAME [key=value ...]

Infer numbers of a model from measurements of a scenario, by the likelihood of a filter. LOW and HIGH are the 5 % and the
95 % quantile of a prior on the values that the model accepts. A prior can have a name instead. The result has the posterior table and all draws; a finished one is not computed again,
and an interrupted one goes on: from the chains of nuts that are finished, and from a state of pmmh that is stored each 20 s.

Without a method and parameters: all noise numbers of an inertial log (IMU, bias walks, fixes), lever arm and delay, with priors
from data sheets (method=noise). The numbers become a scenario that run, tune and estimate know by its name.

  pfbench infer data.root=. scenario=user_log scenario.folder=drive infer.sheet.gyro_deg_s=0.0038 infer.sheet.accelerometer_ug=70
  pfbench infer model=local_level method=nuts 'parameters={level_sd:[10,100],measurement_sd:[50,300]}'
  pfbench infer model=stochastic_volatility method=pmmh 'parameters={sigma:[0.1,1]}' particles=200 infer.chains=16
  pfbench infer model=stochastic_volatility method=smc2 filter=sir 'parameters={rho:{beta:[20,1.5],on:[-1,1]}}'

  scenario=NAME              where the measurements come from; that of the model's name by default
  runs=1 seed=1 noise=NAME   runs that share the parameters
  filter=NAME                filter of the likelihood: ekf, and sir for pmmh
  infer.draws=500            settings of the method: pfbench list infer
  overwrite=true             infer again
  OPTIONS

Python: pfbench.ppl, docs/parameter_inference.md"""

NOISE = "noise"  # method without named parameters
_USAGE = "Use: pfbench infer model=NAME method=nuts 'parameters={KEY:[LOW,HIGH]}'"


def infer_parameters(
    words: Sequence[str], method: str, cores: int, calibrate: int | None, name: str, folder: str
) -> None:
    """Infer the parameters of a model, and print their posterior."""
    from pfbench import job
    from pfbench.job.inputs import find_inputs
    from pfbench.ppl import inference_job

    method, composed = _read_words(words, method)
    config = compose(composed)
    values, choices = config.values, config.choices
    job.apply_global_settings(values)
    has_truth = choices["noise"] == "nominal" and is_simulated_from(values["scenario"], choices["scenario"])  # fmt: skip
    about = {"versions": job.read_versions(), "inputs": find_inputs(values, config.trusted)}
    if calibrate is not None:
        print(inference_job.calibrate(method, values, choices, _build, calibrate))
        return
    scenario_file = None
    if method == NOISE:
        scenario_file = check_scenario_name(name or f"{choices['scenario']}_noise", folder)
    truth = values["model"] if has_truth else {}
    path, content = inference_job.infer(method, values, choices, _build, about, truth, cores)
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


def _read_words(words: Sequence[str], method: str) -> tuple[str, list[str]]:
    """Return the method, and the words of the configuration: the method is a file of the group `infer`."""
    if {"-m", "--multirun"} & set(words):
        raise ValueError("pfbench infer must be run without -m, got a sweep. Repeat the command for each choice.")  # fmt: skip
    keys = given_keys(words)
    if "scenario" in keys and "parameters" not in keys:
        method = method or NOISE
    if not {"model", "scenario"} & keys or not method:
        raise ValueError(f"{'method' if {'model', 'scenario'} & keys else 'model'} must be set. {_USAGE}")  # fmt: skip
    require_choice("method", method, list_groups()["infer"], _USAGE)
    words_by_key = {word.partition("=")[0]: word.partition("=")[2] for word in words}
    by_kalman = method in (NOISE, "nuts", "svi")
    require(not by_kalman or "particles" not in keys, "particles", f"be left out for method={method}, a Kalman filter", words_by_key.get("particles"), "Leave it out, or use method=pmmh.")  # fmt: skip
    others = [f"++infer.{word}" if word.startswith("parameters") else word for word in words]
    if "scenario" not in keys:  # that of the name of the model
        model = words_by_key["model"]
        names = [*list_groups()["scenario"], *(path.stem for path in list_own_files("scenario"))]
        require(model in names, "scenario", f"be set for model={model}", "none of its name", "Add scenario=NAME, also for a scenario of your own: pfbench list scenario.")  # fmt: skip
        others.insert(0, f"scenario={model}")
    return method, [f"+infer={method}", *([] if "runs" in keys else ["runs=1"]), *others]


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


_FIRST = "# Noise numbers that `pfbench infer` found"
_PLAIN = ("gyro_density", "accelerometer_density", "gyro_bias_walk", "accelerometer_bias_walk")


def check_scenario_name(name: str, folder: str) -> Path:
    """Return the file of a scenario, which must not be one that another command or a person wrote."""
    require(re.fullmatch(r"\w+", name), "name", "consist of letters, digits and underscores", name)
    path = Path(folder) / "scenario" / f"{name}.yaml"
    is_new = not path.is_file() or path.read_text(encoding="utf-8").startswith(_FIRST)
    require(is_new and name not in list_named_parts("scenario"), "name", "be that of a new file, or of one that this command wrote", name, "Add name=NAME.")  # fmt: skip
    return path


def list_places(words: Sequence[str]) -> list[str]:
    """List the words that say where the log is, which a file may not: a command has them each time."""
    return [word for word in words if re.match(r"\+*(data\.root|scenario\.(root|folder|files|cache_dir)\b)", word)]  # fmt: skip


def write_scenario(
    path: Path, base: str, words: Sequence[str], node: Mapping[str, Any], content: Mapping[str, Any]
) -> str:
    """Write a variant of a scenario with the inferred numbers; return a sentence on what it leaves out.

    `words` are those of the command, whose settings of the scenario the variant keeps. `node` is the scenario as composed.
    """
    import yaml
    from omegaconf import OmegaConf

    values = {name: row["value"] for name, row in content["rows"].items()}
    plain = [w.lstrip("+") for w in words if re.match(r"\+*scenario\.", w) and w not in list_places(words)]  # fmt: skip
    settings: Any = OmegaConf.to_container(OmegaConf.from_dotlist(plain)).get("scenario", {})  # type: ignore[union-attr]
    tuning = settings.setdefault("tuning", {})
    tuning |= {name: values[name] for name in _PLAIN}
    for kind in ("position", "velocity"):
        if f"{kind}_vertical" in values:
            level = values[f"{kind}_horizontal"]
            tuning[f"{kind}_sd"] = [level, level, values[f"{kind}_vertical"]]
    model, left_out = _add_geometry(settings, node, values)
    defaults = [base, "_self_", *([{"override /model@_global_.model": model}] if model else [])]
    text = yaml.safe_dump({"defaults": defaults, **settings}, sort_keys=False)
    head = f"{_FIRST} from {content['fixes']} fixes (docs/parameter_inference.md).\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda file: file.write((head + text).encode()))
    return left_out


def _add_geometry(
    settings: dict[str, Any], node: Mapping[str, Any], values: Mapping[str, float]
) -> tuple[str, str]:
    """Add lever arm and delay that are not zero; return the model that reads them, and a sentence on what is left out."""
    lever = [values["lever_forward"], values["lever_right"], -values["lever_up"]]
    delay, model, left_out = values.get("delay", 0.0), "", []
    if any(lever) and "constraints" in node:
        earlier = node["constraints"].get("lever_arm") or (0.0, 0.0, 0.0)
        settings.setdefault("constraints", {})["lever_arm"] = [a + b for a, b in zip(earlier, lever, strict=True)]  # fmt: skip
        model = "strapdown_blocks"
    elif any(lever):
        left_out.append("the lever arm")
    if delay and "corrections" in node:
        shifts = node["corrections"].get("shift_s") or {}
        delay += shifts.get("gnss", 0.0)
        settings.setdefault("corrections", {})["shift_s"] = {**shifts, "gnss": delay}
    elif delay:
        left_out.append("the delay")
    return model, f"{' and '.join(left_out)} not written: scenario=user_log has the keys for them" if left_out else ""  # fmt: skip


_FEW = 0.8  # of the true positions inside 90 % intervals, below which a note says so


def format_noise(content: Mapping[str, Any]) -> str:
    """Format the numbers with priors and verdicts, and the scores of held-out fixes."""
    import pandas as pd

    rows = pd.DataFrame.from_dict(content["rows"], orient="index")
    scores = pd.DataFrame.from_dict(content["scores"], orient="index")
    table = rows.rename(columns={"low": "5 %", "high": "95 %", "prior low": "prior 5 %", "prior high": "prior 95 %", "value": "for a filter"})  # fmt: skip
    k = f"Pareto k {content['pareto_k']:.2f}, {content['ess']:.0f} effective draws, {content['cpu_seconds']:.0f} s of CPU"  # fmt: skip
    head = f"noise of {content['choices']['scenario']} by the EKF in closed form, {content['fixes']} fixes: {k}"  # fmt: skip
    split = "second half of the fixes, numbers inferred from the first half:"
    texts = (frame.to_string(float_format=lambda value: f"{value:.4g}") for frame in (table, scores))  # fmt: skip
    share = content["scores"]["inferred"].get("position in 90 %", 1.0)
    note = "" if share > _FEW else (
        f"\nThe reference is inside the 90 % intervals of position at {share:.0%} of the fixes: these numbers fit the next fix, not the position, as "
        "where errors of fixes last. `pfbench estimate FOLDER` has such errors as states."
    )  # fmt: skip
    return f"\n{split}\n".join(texts).join((f"{head}\n", note))


COMMAND = Command(
    infer_parameters,
    HELP,
    options={
        "method": Option("nuts", "nuts, svi, pmmh or smc2; noise without parameters", default=""),
        "cores": Option("1", "processes of the chains of nuts and pmmh", in_range("whole [1, inf)")),
        "calibrate": Option(
            "100", "ranks of true parameters in 100 simulated data sets, uniform if the method is right", in_range("whole [20, inf)"), None
        ),
        "name": Option("SCENARIO_noise", "of the scenario of method=noise", default=""),
        "folder": Option("conf", "folder of its file"),
    },
)  # fmt: skip
