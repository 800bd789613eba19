"""Divergence thresholds of all scenarios, and what they separate.

For each scenario: the error of the raw estimate, of dead reckoning, the threshold, and the share of runs that diverge
for an EKF, for an EKF that receives the measurements of another run, and for dead reckoning. Where the EKF diverges, a
bootstrap filter of 5000 particles is tried too. A scenario whose threshold does not separate has none.
Results are kept in a JSON file, so that a run that was stopped goes on. `--seed 2` adds runs of another seed, judged by
the threshold of the first one.

Run: python benchmarks/divergence.py [--runs 20] [--seed 1] [names]; with --write the thresholds go into conf/scenario.
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
from pfbench.core import Episode, PhiloxStream
from pfbench.filter import Filter, GaussianFilter, ParticleFilter, TaylorLinearisation, run_filter
from pfbench.job import build_plan
from pfbench.job.plan import describe_state
from pfbench.job.raw_estimate import compute_dead_reckoning, compute_raw_estimate
from pfbench.model import StateSpaceModel
from pfbench.results import is_diverged, main_component_group
from pfbench.results.paper_block import conf_dir

HERE = Path(__file__).parent
STORE = HERE / "divergence.json"
FILTERS = ("ekf", "sir", "swapped", "dead_reckoning")  # columns of the table
MOST_CORRECT = 0.1  # share of diverged runs of the better correct filter [ours]
LEAST_WRONG = 0.5  # share of diverged runs of the worse wrong one [ours]
WITHOUT_TRUTH = ("user_log",)


def measure(name: str, runs: int, seed: int = 1, limit: float | None = None) -> dict[str, Any]:
    """Measure one scenario.

    Args:
        name: Scenario.
        runs: Number of runs.
        seed: Seed of the runs.
        limit: Threshold of another seed, None for that of these runs.

    Returns:
        Errors, threshold, and shares of diverged runs.
    """
    settings = [f"scenario={name}", "filter=ekf", f"runs={runs}", f"seed={seed}", "pcrb=false"]
    plan = build_plan(job.compose(settings))
    with torch.no_grad():
        episode = plan.draw_episode(plan.runs)
        model = plan.make_filter_model(episode)
        truth = model.assemble(episode.truth)
        group = main_component_group(describe_state(model))
        raw = compute_raw_estimate(model, truth, episode.record, group.places)
        threshold = raw.threshold if limit is None else limit

        def share(error: Tensor, lost: Tensor) -> float:
            diverged = is_diverged(error.numpy(), lost.numpy(), threshold)
            return float((diverged | lost.numpy()).mean())

        ekf, rows = GaussianFilter(TaylorLinearisation()), {}
        for key, method, shift in (
            ("ekf", ekf, 0),
            ("swapped", ekf, 1),
            ("sir", ParticleFilter(5000), 0),
        ):
            if key == "sir" and rows["ekf"] <= MOST_CORRECT and limit is None:
                continue
            error, lost = filter_errors(method, model, episode, truth, seed, shift)
            rows[key] = share(error[..., group.places], lost)
        reckoning = compute_dead_reckoning(model, truth, episode.record)[..., group.places]
        rows["dead_reckoning"] = share(reckoning, torch.zeros(len(reckoning), dtype=torch.bool))
    unit = {"group": group.group, "unit": model.units[group.places[0]]}
    return raw._asdict() | {"threshold": threshold, "runs": runs, "diverged": rows} | unit


def add_seed(row: dict[str, Any], seed: int, more: dict[str, Any]) -> dict[str, Any]:
    """Pool the shares of diverged runs of a scenario with those of another seed.

    Args:
        row: Row of the scenario, whose threshold stays.
        seed: The other seed.
        more: Its row.

    Returns:
        The row with all runs, and the shares of each seed.
    """
    seeds = row.get("seeds", {"1": {name: row[name] for name in ("runs", "diverged")}})
    seeds |= {str(seed): {name: more[name] for name in ("runs", "diverged")}}
    names = [name for name in FILTERS if all(name in part["diverged"] for part in seeds.values())]
    total = sum(part["runs"] for part in seeds.values())
    pooled = {
        name: sum(part["runs"] * part["diverged"][name] for part in seeds.values()) / total
        for name in names
    }
    return row | {"runs": total, "diverged": pooled, "seeds": seeds}


def separates(diverged: dict[str, float]) -> bool:
    """Whether a threshold tells a correct filter from a wrong one.

    Args:
        diverged: Shares of diverged runs by filter.

    Returns:
        Whether the better correct filter is near 0 and the worse wrong one is not.
    """
    correct = min(diverged["ekf"], diverged.get("sir", 1.0))
    wrong = max(diverged["swapped"], diverged["dead_reckoning"])
    return correct <= MOST_CORRECT and wrong >= LEAST_WRONG


def filter_errors(
    method: Filter, model: StateSpaceModel, episode: Episode, truth: Tensor, seed: int, shift: int
) -> tuple[Tensor, Tensor]:
    """Run a filter with the measurements of the run `shift` places away.

    Args:
        method: Filter.
        model: Model of the filter.
        episode: Episode of the runs.
        truth: True states, [R, T, D].
        seed: Seed of the filter.
        shift: Places; 0 is correct.

    Returns:
        Errors, [R, T, d], and lost runs, [R].
    """
    record = episode.record._replace(feedback=None)
    record = record._replace(y=record.y.roll(shift, 0))
    draws = PhiloxStream(seed, torch.arange(len(truth)))
    result = run_filter(method, model, record, draws)
    return model.error(result.mean, truth), result.lost


def round_up(value: float) -> float:
    """Round to two significant digits."""
    return float(f"{value:.2g}")


def remove_threshold(name: str) -> None:
    """Remove the threshold, and an empty node `paper`, from a scenario's file."""
    path = conf_dir() / "scenario" / f"{name}.yaml"
    text = re.sub(r"^  divergence_threshold:.*\n", "", path.read_text(), flags=re.M)
    path.write_text(re.sub(r"^paper:\n(?! )", "", text, flags=re.M))


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
        "Diverged runs in percent: an extended Kalman filter (EKF), a bootstrap filter of 5000 particles (SIR) where the EKF",
        "diverges, the EKF with the measurements of another run, and dead reckoning from the initial state. A threshold separates",
        f"if the better of the first two has at most {100 * MOST_CORRECT:.0f} % and the worse of the last two at least {100 * LEAST_WRONG:.0f} %. A scenario whose threshold does not",
        "separate has none, and its reports do not state divergence. Scenarios at the limit have runs of a second seed, judged",
        "by the threshold of the first one. Scenarios of recorded logs that are not in the table were not measured.",
        "",
        "| scenario | group | raw estimate | window [steps] | dead reckoning | threshold | unit | runs | EKF | SIR | other run | dead reckoning |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, row in sorted(rows.items()):
        shares = " | ".join(
            f"{100 * row['diverged'][key]:.0f}" if key in row["diverged"] else "–"
            for key in FILTERS
        )
        threshold = f"{round_up(row['threshold']):g}"
        if not separates(row["diverged"]):
            threshold = f"none ({threshold})"
        head.append(
            f"| {name} | {row['group']} | {row['rmse']:.3g} | {row['steps'] or '–'} | {row['dead_reckoning']:.3g} "
            f"| {threshold} | {row['unit'] or '–'} | {row['runs']} | {shares} |"
        )
    (HERE / "divergence.md").write_text("\n".join(head) + "\n")


def main() -> None:
    """Measure all scenarios, or the named ones."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    every = sorted(path.stem for path in (conf_dir() / "scenario").glob("*.yaml"))
    rows = json.loads(STORE.read_text()) if STORE.exists() else {}
    for name in options.names or [n for n in every if n not in rows and n not in WITHOUT_TRUTH]:
        try:
            if options.seed == 1:
                row = measure(name, options.runs)
            else:
                more = measure(name, options.runs, options.seed, rows[name]["threshold"])
                row = add_seed(rows[name], options.seed, more)
        except (ValueError, FileNotFoundError) as error:
            print(f"{name}: not measured. {error}")
            continue
        print(name, json.dumps(row), flush=True)
        rows = json.loads(STORE.read_text()) | {name: row}
        STORE.write_text(json.dumps(rows, indent=1, sort_keys=True, allow_nan=False) + "\n")
    if options.write:
        for name, row in rows.items():
            if not separates(row["diverged"]):
                remove_threshold(name)
            elif np.isfinite(row["threshold"]):
                write_threshold(name, row["threshold"])
    write_page(rows)


if __name__ == "__main__":
    main()
