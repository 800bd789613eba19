"""Scenario of a log with inferred noise numbers: a file that `run`, `tune` and `estimate` know by its name, and the table of numbers."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pfbench.core.parameter_checks import require
from pfbench.files.atomic_write import write_atomically

_FIRST = "# Noise numbers that `pfbench infer` found"
_PLAIN = ("gyro_density", "accelerometer_density", "gyro_bias_walk", "accelerometer_bias_walk")


def check_scenario_name(name: str, folder: str) -> Path:
    """Return the file of a scenario, which must not be one that another command or a person wrote."""
    from pfbench.results.paper_block import list_named_parts

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
    return f"\n{split}\n".join(texts).join((f"{head}\n", ""))
