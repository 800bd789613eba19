"""Divergence thresholds of all scenarios, and what they separate.

For each scenario: the error of the raw estimate, of dead reckoning, the threshold, and the share of runs that diverge
for the raw estimate's best user (an EKF), for an EKF that receives the measurements of another run, and for dead
reckoning. Results are kept in a JSON file, so that a run that was stopped goes on.

Run: python benchmarks/divergence.py [--runs 20] [names]; with --write the thresholds go into conf/scenario.
"""

from __future__ import annotations

import argparse
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pfbench import job
from pfbench.config.folders import conf_dir
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode
from pfbench.filter import GaussianFilter, TaylorLinearisation
from pfbench.filter.loop import run_filter
from pfbench.job.metadata import describe_state
from pfbench.job.plan import build_plan
from pfbench.job.raw_estimate import compute_dead_reckoning, compute_raw_estimate
from pfbench.model.base import StateSpaceModel
from pfbench.results.state_groups import main_component_group
from pfbench.results.status import is_diverged

HERE = Path(__file__).parent
STORE = HERE / "divergence.json"
FILTERS = ("ekf", "swapped", "dead_reckoning")  # columns of the table
WITHOUT_TRUTH = ("user_log",)


def measure(name: str, runs: int) -> dict[str, Any]:
    """Measure one scenario.

    Args:
        name: Scenario.
        runs: Number of runs.

    Returns:
        Errors, threshold, and shares of diverged runs.
    """
    plan = build_plan(job.compose([f"scenario={name}", "filter=ekf", f"runs={runs}", "pcrb=false"]))
    with torch.no_grad():
        episode = plan.draw_episode(plan.runs)
        model = plan.make_filter_model(episode)
        truth = model.assemble(episode.truth)
        group = main_component_group(describe_state(model))
        raw = compute_raw_estimate(model, truth, episode.record, group.places)

        def share(error: Tensor, lost: Tensor) -> float:
            diverged = is_diverged(error.numpy(), lost.numpy(), raw.threshold)
            return float((diverged | lost.numpy()).mean())

        rows = {}
        for key, shift in zip(FILTERS[:2], (0, 1), strict=True):
            error, lost = filter_errors(model, episode, truth, shift)
            rows[key] = share(error[..., group.places], lost)
        reckoning = compute_dead_reckoning(model, truth, episode.record)[..., group.places]
        rows[FILTERS[2]] = share(reckoning, torch.zeros(len(reckoning), dtype=torch.bool))
    unit = {"group": group.group, "unit": model.units[group.places[0]]}
    return raw._asdict() | {"threshold": raw.threshold, "runs": runs, "diverged": rows} | unit


def filter_errors(
    model: StateSpaceModel, episode: Episode, truth: Tensor, shift: int
) -> tuple[Tensor, Tensor]:
    """Run an EKF with the measurements of the run `shift` places away.

    Args:
        model: Model of the filter.
        episode: Episode of the runs.
        truth: True states, [R, T, D].
        shift: Places; 0 is correct.

    Returns:
        Errors, [R, T, d], and lost runs, [R].
    """
    record = episode.record._replace(feedback=None)
    record = record._replace(y=record.y.roll(shift, 0))
    draws = PhiloxStream(1, torch.arange(len(truth)))
    result = run_filter(GaussianFilter(TaylorLinearisation()), model, record, draws)
    return model.error(result.mean, truth), result.lost


def round_up(value: float) -> float:
    """Round to two significant digits."""
    return float(f"{value:.2g}")


def write_threshold(name: str, value: float) -> None:
    """Write a threshold into the node `paper` of a scenario's file."""
    path = conf_dir() / "scenario" / f"{name}.yaml"
    text, line = path.read_text(), f"  divergence_threshold: {round_up(value):g}"
    if re.search(r"^  divergence_threshold:", text, re.M):
        text = re.sub(r"^  divergence_threshold:[^#\n]*", line, text, flags=re.M)
    elif re.search(r"^paper:", text, re.M):
        text = re.sub(r"^paper:.*\n", lambda m: f"{m[0]}{line}\n", text, flags=re.M)
    else:
        text = f"{text.rstrip()}\npaper:\n{line}\n"
    path.write_text(text)


def write_page(rows: dict[str, Any]) -> None:
    """Write the table."""
    head = [
        "# Divergence thresholds",
        "",
        "A run is diverged if its error in the main group exceeds the threshold in at least 10 % of the scored steps, or in",
        "the last one. The threshold is five times the error of the simplest estimate from raw measurements alone. If the",
        "raw estimate is five times better than dead reckoning, it is at most half of the error of dead reckoning. It is the",
        "same for all filters. Written by `benchmarks/divergence.py`.",
        "",
        "Diverged runs in percent: an extended Kalman filter (EKF), the same filter with the measurements of another run, and",
        "dead reckoning from the initial state. The threshold separates where the first is near 0 and the others near 100.",
        "",
        "| scenario | group | raw estimate | window [steps] | dead reckoning | threshold | unit | runs | EKF | other run | dead reckoning |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, row in sorted(rows.items()):
        shares = " | ".join(
            f"{100 * value:.0f}" for value in (row["diverged"][key] for key in FILTERS)
        )
        head.append(
            f"| {name} | {row['group']} | {row['rmse']:.3g} | {row['steps'] or '–'} | {row['dead_reckoning']:.3g} "
            f"| {round_up(row['threshold']):g} | {row['unit'] or '–'} | {row['runs']} | {shares} |"
        )
    (HERE / "divergence.md").write_text("\n".join(head) + "\n")


def main() -> None:
    """Measure all scenarios, or the named ones."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    every = sorted(path.stem for path in (conf_dir() / "scenario").glob("*.yaml"))
    rows = json.loads(STORE.read_text()) if STORE.exists() else {}
    for name in options.names or [n for n in every if n not in rows and n not in WITHOUT_TRUTH]:
        try:
            rows[name] = measure(name, options.runs)
        except (ValueError, FileNotFoundError) as error:
            print(f"{name}: not measured. {error}")
            continue
        print(name, json.dumps(rows[name]), flush=True)
        STORE.write_text(json.dumps(rows, indent=1, sort_keys=True, allow_nan=False) + "\n")
    if options.write:
        for name, row in rows.items():
            if np.isfinite(row["threshold"]):
                write_threshold(name, row["threshold"])
    write_page(rows)


if __name__ == "__main__":
    main()
