"""Files of a tuning: a filter with the chosen knobs, and the record of the search."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pfbench.config.composition import compose
from pfbench.config.paper_files import read_paper_block
from pfbench.files.atomic_write import write_atomically
from pfbench.job.tuning.candidate_search import TuningResult
from pfbench.job.tuning.knobs import apply_candidate


def write_filter_file(
    result: TuningResult, folder: Path, suffix: str, world: Mapping[str, Any]
) -> Path:
    """Write the configuration file of a tuned filter.

    Args:
        result: Result of the search.
        folder: Folder of configuration files.
        suffix: End of the filter's name, after `_`.
        world: Scenario, model, seed, runs and regimes of the search.

    Returns:
        The file, `FOLDER/filter/METHOD_SUFFIX.yaml`.
    """
    nodes = compose([f"filter={result.method}"]).values["filter"]["noise_adaptations"]
    lines = [
        f"# {result.method} tuned on {world['scenario']}, model {world['model']}, seed {world['seed']}.",
        "defaults:",
        f"  - {result.method}",
        "  - _self_",
        "noise_adaptations:",
    ]
    for node in apply_candidate(nodes, result.choice.values):
        pairs = [f"{key}: {json.dumps(value)}" for key, value in node.items()]
        pairs[0] = f"_target_: {node['_target_']}"
        lines += [f"  - {pairs[0]}", *(f"    {pair}" for pair in pairs[1:])]
    block = read_paper_block("filter", result.method)
    name = {key: f"{block.get(key, result.method)} (tuned)" for key in ("name", "long_name")}
    lines += ["paper:", *(f"  {key}: {json.dumps(value)}" for key, value in name.items())]
    lines += ["  family: kalman", "  proposed: false", '  cite: ""', "  baselines: []"]
    lines.append(f"  tuning: {json.dumps(_describe_world(world))}")
    path = folder / "filter" / f"{result.method}_{suffix}.yaml"
    return _write(path, "\n".join(lines) + "\n")


def write_record(
    results: Sequence[TuningResult], folder: Path, suffix: str, world: Mapping[str, Any]
) -> Path:
    """Write all candidates with their scores.

    Args:
        results: Results of the search by filter.
        folder: Folder of configuration files.
        suffix: End of the filters' names.
        world: Scenario, model, seed, runs and regimes of the search.

    Returns:
        The file, `FOLDER/tuning/SUFFIX.json`.
    """
    content = {"world": dict(world), "filters": [result.to_record() for result in results]}
    text = json.dumps(content, indent=1) + "\n"
    return _write(folder / "tuning" / f"{suffix}.json", text)


def _describe_world(world: Mapping[str, Any]) -> str:
    """Describe the data of the search for reports."""
    return (
        f"{world['scenario']} (model {world['model']}, seed {world['seed']}, {world['runs']} runs; "
        f"noise: {', '.join(world['regimes'])})"
    )


def _write(path: Path, text: str) -> Path:
    """Write a text file as a whole."""
    write_atomically(path, lambda file: file.write(text.encode()))
    return path
