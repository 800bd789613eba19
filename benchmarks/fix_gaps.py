"""Particle and Kalman filters on recorded data with gaps between fixes: who keeps track, and at what cost.

Recorded flights of a quadrotor and a recorded car drive, with a fix at each interval, or an outage. Filters, runs and
numbers are paired. The first seconds after a start are omitted. Results are kept in fix_gaps.json.

Run: python benchmarks/fix_gaps.py [--runs 20] [--only flights]; --page writes the page from the stored results alone.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pfbench import job
from pfbench.core import PhiloxStream
from pfbench.filter import run_filter
from pfbench.results import order_statistic_interval

HERE = Path(__file__).parent
STORE = HERE / "fix_gaps.json"
KALMAN = ("ekf", "ekf_scaled", "invariant_ekf", "ukf", "rbpf_heading")
FLIGHT, CAR = "scenario=recorded_quad_flights", "scenario=recorded_car_drive"
FIXES = "scenario.receiver.fix_interval_s="
# words of a job, seconds that are omitted, filters
WORLDS: dict[str, tuple[list[str], float, tuple[str, ...]]] = {
    "flights, fix each 1 s": (
        [FLIGHT, FIXES + "1.0"],
        10.0,
        (*KALMAN, "sir", "ekf_pf", "interval_pf"),
    ),
    "flights, fix each 10 s": (
        [FLIGHT, FIXES + "10.0"],
        10.0,
        (*KALMAN, "sir", "ekf_pf", "interval_pf"),
    ),
    "car, outage of 30 s": ([CAR, "noise=outage"], 60.0, (*KALMAN, "sir", "interval_pf")),
}


def measure(world: str, name: str, runs: int, particles: int) -> dict[str, Any]:
    """Run a filter in a world.

    Args:
        world: Key of `WORLDS`.
        name: Filter.
        runs: Number of runs.
        particles: Number of particles of a particle filter.

    Returns:
        Root mean square position error of each run, m; log evidence of each run; CPU time, s.
    """
    words, skipped_s, _ = WORLDS[world]
    sizes = [f"runs={runs}", f"particles={particles}"]
    plan = job.build_plan(job.compose([*words, f"filter={name}", *sizes]))
    episode, model = plan.draw_episode(plan.runs), plan.model
    started = time.process_time()
    with torch.no_grad():
        result = run_filter(plan.method, model, episode.record, PhiloxStream(2, plan.runs))
    cpu_s = time.process_time() - started
    error = (result.mean[..., 7:10] - episode.truth["position"]).square().sum(-1)
    error = error[:, episode.time > episode.time[0] + skipped_s]
    return {
        "rmse": error.nanmean(1).sqrt().nan_to_num(nan=1e9).tolist(),  # a lost run
        "log_evidence": result.log_evidence.tolist(),
        "cpu_s": cpu_s,
    }


def summarise(values: list[float]) -> str:
    """Return a median and its interval, by ranks."""
    low, high = order_statistic_interval(np.array(values), 0.95)[:2]
    return f"{np.median(values):.3g} [{low:.3g}, {high:.3g}]"


def page(stored: dict[str, Any]) -> str:
    """Return the page of the stored results."""
    assert __doc__ is not None
    lines = [
        "# Gaps between fixes",
        "",
        " ".join(__doc__.split("\n\n")[1].split()[:-5]),
        "Written by `benchmarks/fix_gaps.py`.",
        "",
        f"{stored['runs']} runs, particle filters with {stored['particles']} particles. Error: root mean square of the position",
        "of each run. Ratio: error over that of the EKF in the same run. Brackets: 95 % intervals of medians, by ranks.",
        "Evidence: median of the log evidence minus that of the EKF. CPU time is relative to SIR.",
        "",
        "| data | filter | error [m] | ratio | evidence | CPU time |",
        "|---|---|---|---|---|---|",
    ]
    rows = {(row["world"], row["filter"]): row for row in stored["rows"]}
    for (world, name), row in rows.items():
        ekf, sir = rows[world, "ekf"], rows[world, "sir"]
        ratio = summarise((np.array(row["rmse"]) / np.array(ekf["rmse"])).tolist())
        gain = np.median(np.array(row["log_evidence"]) - np.array(ekf["log_evidence"]))
        lines.append(
            f"| {world} | `{name}` | {summarise(row['rmse'])} | {ratio} | {gain:.1f} | "
            f"{row['cpu_s'] / sir['cpu_s']:.2g} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure all filters and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--particles", type=int, default=500)
    parser.add_argument("--only", default="")
    parser.add_argument("--page", action="store_true")
    options = parser.parse_args()
    stored = json.loads(STORE.read_text()) if STORE.exists() else {"rows": []}
    rows = {(row["world"], row["filter"]): row for row in stored["rows"]}
    sizes = {"runs": options.runs, "particles": options.particles}
    for world, (_, _, names) in WORLDS.items() if not options.page else ():
        for name in names if options.only in world else ():
            values = measure(world, name, options.runs, options.particles)
            rows[world, name] = {"world": world, "filter": name, **values}
            print(world, name, summarise(values["rmse"]), round(values["cpu_s"], 1), flush=True)
            ordered = [rows[w, n] for w in WORLDS for n in WORLDS[w][2] if (w, n) in rows]
            STORE.write_text(json.dumps({**sizes, "rows": ordered}, indent=1) + "\n")
    (HERE / "fix_gaps.md").write_text(page(json.loads(STORE.read_text())))


if __name__ == "__main__":
    main()
