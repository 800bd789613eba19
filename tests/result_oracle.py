"""Runs of a study read from its result files with numpy, without any code of pfbench.

Labels and conditions of a sweep have the settings in which its jobs differ, as docs/statistics.md says.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

NOT_A_SETTING = ("scenario.paper.", "scenario.cache_dir", "scenario.root", "first_run", "runs")


def read_runs(folder: Path) -> pd.DataFrame:
    """One row per run: condition, filter, status and all metrics of the main group."""
    files = []
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as file:
            data = {name: file[name] for name in file.files}
        files.append((data, json.loads(str(data["meta"]))))
    names = name_jobs([meta for _, meta in files])
    tables = [
        runs_of(data, meta).assign(scenario=scenario, regime=regime, filter=label)
        for (data, meta), (scenario, regime, label) in zip(files, names, strict=True)
    ]
    return pd.concat(tables, ignore_index=True)


def flatten(node: Any, path: str = "") -> dict[str, str]:
    """Settings by dotted name; stages of a list are numbered."""
    if isinstance(node, list) and any(isinstance(stage, Mapping) for stage in node):
        node = dict(enumerate(node))
    if not isinstance(node, Mapping):
        return {path: str(node)}
    parts = [flatten(value, f"{path}.{name}" if path else str(name)) for name, value in node.items()]  # fmt: skip
    return {key: value for part in parts for key, value in part.items()}


def name_jobs(metas: list[dict[str, Any]]) -> list[tuple[str, str, str]]:
    """Scenario, regime and label of each job, with the settings in which jobs of the same names differ."""
    settings = [
        {k: v for k, v in flatten(meta["config"]).items() if not k.startswith(NOT_A_SETTING)}
        for meta in metas
    ]
    places = [
        (m["choices"]["scenario"], m["choices"]["noise"], m["choices"].get("model")) for m in metas
    ]
    names: list[tuple[str, str, str]] = []
    for meta, own, place in zip(metas, settings, places, strict=True):
        near = [k for k in range(len(metas)) if places[k] == place]
        by_label = [
            [settings[k] for k in near if metas[k]["label"] == label]
            for label in {metas[k]["label"] for k in near}
        ]
        differing = {name for twins in by_label for name in list_differing(twins)}
        of_data = {g: [n for n in differing if n.startswith(f"{g}.")] for g in ("scenario", "noise")}  # fmt: skip
        data = [n for group in of_data.values() for n in group]
        twins = [
            settings[k]
            for k in near
            if metas[k]["label"] == meta["label"]
            and all(settings[k].get(n) == own.get(n) for n in data)
        ]
        of_label = list_differing(twins)
        of_filter = [n for n in of_label if n.startswith("filter.")]
        if len({str([t.get(n) for n in of_filter]) for t in twins}) == len({str(t) for t in twins}):
            of_label = of_filter
        names.append((
            add_settings(place[0], own, of_data["scenario"], "scenario."),
            add_settings(place[1], own, of_data["noise"], "noise."),
            add_settings(meta["label"], own, of_label, "filter."),
        ))  # fmt: skip
    return names


def list_differing(settings: list[dict[str, str]]) -> list[str]:
    """Names of the settings that do not agree."""
    names = sorted(set().union(*settings))
    return [name for name in names if len({s.get(name) for s in settings}) > 1]


def add_settings(name: str, values: dict[str, str], settings: Iterable[str], prefix: str) -> str:
    """Name with settings in brackets; a class is written without its module."""
    texts = []
    for key in sorted(settings):
        value, short = values.get(key, "-"), key.removeprefix(prefix)
        if short.endswith("_target_"):
            short, value = short.removesuffix("._target_"), value.rpartition(".")[2]
        texts.append(f"{short}={value}")
    return f"{name}[{','.join(texts)}]" if texts else name


def runs_of(data: dict[str, np.ndarray], meta: dict[str, Any]) -> pd.DataFrame:
    """Runs of one result file. The main group has one unit: the first of a mixed group."""
    groups, units = meta["state"]["groups"], meta["state"]["units"]
    name = "position" if "position" in groups else next(iter(groups))
    places = [k for k in groups[name] if units[k] == units[groups[name][0]]]
    index, is_whole = list(groups).index(name), len(places) == len(groups[name])
    norm = np.sqrt((data["error"][..., places].astype(float) ** 2).sum(-1))
    nees = data["nees"][..., index].astype(float).mean(1)
    paper = meta["config"]["scenario"].get("paper") or {}
    limit = paper.get("divergence_threshold") or np.inf
    is_lost = data["lost"]
    diverged = ((norm > limit).mean(1) >= 0.1) | (norm[:, -1] > limit)
    energy = data["energy_score"][..., index].astype(float).mean(1)
    overconfident = (nees > stats.chi2.ppf(0.999, len(groups[name]))).astype(float)
    others = {}
    for other, index_of_group in groups.items():
        for unit in dict.fromkeys(units[k] for k in index_of_group):
            part = [k for k in index_of_group if units[k] == unit]
            title = other if len(part) == len(index_of_group) else f"{other} [{unit}]"
            square = (data["error"][..., part].astype(float) ** 2).sum(-1)
            if part != places:
                others[f"{title} error"] = np.sqrt(square.mean(1))
    first = 10**6 * int(meta["seed"]) + int(meta.get("first_run", 0))
    return pd.DataFrame({
        "world": paper.get("family") or meta["choices"]["scenario"],
        "run": first + np.arange(len(norm)),
        "keeps": ~is_lost & ~diverged,
        "error": np.sqrt((norm**2).mean(1)),
        "largest error": norm.max(1),
        "CRPS": data["crps"][..., places].astype(float).mean((1, 2)),
        "energy score": energy if is_whole else np.nan,
        "log score per step": data["log_evidence"] / norm.shape[1],
        "overconfident runs": np.where(is_lost, np.nan, overconfident),
        **others,
    })  # fmt: skip
