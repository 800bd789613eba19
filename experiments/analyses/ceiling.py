"""What any filter could reach in each scenario: bound, smoothers and Kalman filter, written to docs/ceiling.md.

The cubature filter, the iterated smoother of the same rule, sampled smoothed paths and the posterior Cramer-Rao bound
see the same runs. Results are kept in ceiling.json after each scenario. A second call goes on with those that are missing.

Run: python experiments/analyses/ceiling.py [--again] [SCENARIO ...]; --page writes the page from the stored results alone.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pfbench import job
from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    CubaturePoints,
    GaussianFilter,
    ParticleFilter,
    RejectionBackwardSampler,
    SigmaPointLinearisation,
    sample_smoothed_paths,
    sample_trajectories,
    smooth_iteratively,
)
from pfbench.model import StateSpaceModel

STORE = Path(__file__).with_name("ceiling.json")
PAGE = Path(__file__).parents[2] / "docs" / "ceiling.md"
PASSES, PARTICLES, PATHS, CHAIN_STEPS = 4, 500, 50, 10
CONVERGED = 0.1  # largest shift of the last pass, in standard deviations
MODEL_OF_THE_DATA = (0.5, 2.0)  # range of the smoother's NEES for simulated sensors
LARGEST_EXCESS = 1.1  # of the sampled smoother over other errors, else its paths are too few
UNCHANGED = 0.05  # largest probability that a chain has not left its start
EARLIER_START = (
    "filters start from a measurement before the record, which the bound does not contain"
)
FEW_RUNS = 10

# scenario, and overrides of the command line where they differ from the scenario; runs
CONDITIONS: dict[str, int] = {
    **dict.fromkeys(("local_level", "linear_walk", "pendulum", "benes", "growth"), 50),
    **dict.fromkeys(("lorenz63", "stochastic_volatility"), 20),
    **{f"passive_{i}{suffix}": 20 for i in (1, 2, 3) for suffix in ("", "_random", "_printed")},
    **dict.fromkeys(("flight_300s", "flight_500s", "gps_ins", "gps_ins_generic"), FEW_RUNS),
    **dict.fromkeys(("gps_ins_markov", "azimuth", "azimuth_small"), FEW_RUNS),
    **dict.fromkeys(("anshun_nl", "anshun_nl_small", "anshun_short", "sar_flight_short"), FEW_RUNS),
    "recorded_boreas": FEW_RUNS,
    "recorded_quad_flights": 20,
    "recorded_fixed_wing": FEW_RUNS,
    "recorded_fixed_wing_aided": FEW_RUNS,
    "recorded_walk": FEW_RUNS,
    "recorded_berlin": FEW_RUNS,
    "recorded_car_drive": FEW_RUNS,
    "recorded_car_drive noise=outage": FEW_RUNS,
    "flight_300s_closed_loop": FEW_RUNS,
    "azimuth_closed_loop": FEW_RUNS,
}
LEFT_OUT = {
    "`anshun_fit`, `anshun_real_orbits`, `anshun_uav`, `sar_flight`, `sar_flight_slow`, `azimuth_fast`": "1000 to 3000 "
    "steps, too long for this script. Their shorter or slower variants are in the table.",
    "`azimuth_constant_errors`, `sar_flight_constant_errors`": "all runs have the same initial errors, which are not "
    "drawn from the initial distribution of the model. The limits of a mean over runs do not hold then.",
    "`terrain`, `terrain_fixed_wing`": "the smoothers have one mode. The exact filter is in "
    "[robustness.md](robustness.md#terrain-referenced-navigation).",
    "`recorded_car_constrained`": "the scenario `recorded_car_drive` with further components of the measurement.",
    "`recorded_canyon`, `gps_ins_inflated`": "the scenarios `recorded_berlin` and `gps_ins_generic` with another model.",
    "`home_002_bursts`, `home_004_outliers`": "the scenarios `anshun_short` and `gps_ins_inflated` with another noise.",
    "`lorenz63_twin`, `lorenz96_twin`, `double_pendulum_twin`": "chaotic systems without process noise. Their limits are the printed "
    "errors of [twins.md](twins.md).",
    "`user_log`, `user_log_aligned`, `user_raw_log`, `user_ins_log`": "the data are of the user.",
}


def mean_squares(error: Tensor) -> list[float]:
    """Return the mean squared length over steps of errors [R, T, k], for each run; steps of NaN are left out."""
    return error.square().sum(-1).nanmean(1).tolist()


def root_mean(squares: list[float]) -> float:
    """Return the root of the mean of the squares over runs; lost runs are left out."""
    return float(np.sqrt(np.nanmean(squares)))


def relative_gain(squares: list[float], limit: float | list[float]) -> tuple[float, float]:
    """Return the share by which the root mean square exceeds a limit, and its standard error over runs.

    The limit is a number, or the squares of the same runs, whose chance then cancels in part.
    """
    causal = np.array(squares)
    paired = isinstance(limit, list)
    floor = np.array(limit) if isinstance(limit, list) else np.full(len(causal), limit**2)
    both = np.isfinite(causal) & np.isfinite(floor)
    causal, floor = causal[both], floor[both]
    ratio = math.sqrt(floor.mean() / causal.mean())
    relative = causal / causal.mean() - (floor / floor.mean() if paired else 1.0)
    error = 0.5 * ratio * relative.std(ddof=1) / math.sqrt(len(causal))
    return 1.0 - ratio, float(error)


def describes_data(row: dict[str, Any]) -> bool:
    """Return whether the model is that of the data, so that its limits hold."""
    low, high = MODEL_OF_THE_DATA
    consistent = low < row["smoother_nees"] < high
    return not row["recorded"] and (row["drawn_from_model"] or consistent)


def is_sampled_well(row: dict[str, Any]) -> bool:
    """Return whether the sampled means are not worse than other estimates: the exact mean is the best."""
    if row["sampled"] is None:
        return False
    others = min(root_mean(row["filter"]), root_mean(row["smoother"]))
    return root_mean(row["sampled"]) < LARGEST_EXCESS * others


def largest_limit(row: dict[str, Any]) -> float | list[float] | None:
    """Return the largest limit that holds: the bound, or the squares of an exact smoother, or None."""
    if not describes_data(row):
        return None
    limits: list[float | list[float]] = [] if row["bound"] is None else [row["bound"]]
    if row["linear"]:
        limits.append(row["smoother"])
    elif is_sampled_well(row):
        limits.append(row["sampled"])
    sizes = [root_mean(a) if isinstance(a, list) else a for a in limits]
    return limits[int(np.argmax(sizes))] if limits else None


def sample_states(model: StateSpaceModel, record: Record, runs: int) -> Tensor | None:
    """Return states of sampled smoothed paths [R, PATHS, T, D], or None if chains do not mix.

    Raises:
        ValueError: If the model has neither a transition density nor normal noise.
    """
    draws = PhiloxStream(7, torch.arange(runs))
    if has_transition(model, record):
        method, sampler = ParticleFilter(PARTICLES), RejectionBackwardSampler()
        return sample_trajectories(method, model, record, draws, PATHS, sampler)
    for steps in (CHAIN_STEPS, 4 * CHAIN_STEPS):
        sample = sample_smoothed_paths(model, record, draws.at_step(0), PATHS, steps)
        unchanged = float((1.0 - sample.changed).max()) ** steps
        print(f"probability of an unchanged chain: {unchanged:.2g}", flush=True)
        if unchanged < UNCHANGED:
            return sample.states
    return None


def has_transition(model: StateSpaceModel, record: Record) -> bool:
    """Return whether the model has a transition density."""
    first = model.prepare(record).at_step(0)
    centre = model.origin.expand(len(record.y), 1, -1)
    return model.transition(centre, first.u) is not None


def sampled_squares(
    plan: job.JobPlan, episode: Any, truth: Tensor, index: list[int]
) -> list[float] | None:
    """Return the mean squared errors of sampled smoothed means, without the chance of the paths."""
    if plan.model.linear or not is_drawn_from_model(plan):
        return None
    try:
        states = sample_states(plan.model, episode.record, len(plan.runs))
    except ValueError as error:
        print(f"no sampled paths: {error}", flush=True)
        return None
    if states is None:
        return None
    states, chart = states.transpose(1, 2), plan.model.chart
    mean = chart.mean(states, states.new_full(states.shape[:-1], 1.0 / PATHS))
    variance = chart.subtract(states, mean.unsqueeze(2))[..., index].var(2) / PATHS
    squares = np.array(mean_squares(plan.model.error(mean, truth)[..., index]))
    return list(squares - variance.sum(-1).mean(1).numpy())


def is_drawn_from_model(plan: job.JobPlan) -> bool:
    """Return whether the data of each run are drawn from the model of the filter, the start included."""
    scenario = plan.values["scenario"]
    name = scenario["_target_"].rpartition(".")[2]
    return name == "ModelSimulation" or bool(scenario.get("randomise_emitter"))


@torch.no_grad()
def measure(condition: str, runs: int) -> dict[str, Any]:
    """Return errors of filter and smoothers, and the bound, of the main group of a condition."""
    start_time = time.process_time()
    plan = job.build_plan(
        job.compose([*f"scenario={condition}".split(), "filter=ckf", f"runs={runs}"])
    )
    episode, model = plan.draw_episode(plan.runs), plan.model
    group = "position" if "position" in model.groups else next(iter(model.groups))
    index = list(model.groups[group])
    method = GaussianFilter(SigmaPointLinearisation(CubaturePoints(), largest_angle=None))
    try:
        result = smooth_iteratively(method, model, episode.record, PASSES)
    except ValueError as error:
        return {"refused": str(error)}
    sd, reason = job.compute_pcrb(plan.values, model, plan.recording_regime, episode, plan.runs)
    if sd is not None and episode.record.spread is not None:
        sd, reason = None, EARLIER_START
    truth = model.assemble(episode.truth)
    causal, smoothed = (
        model.error(mean, truth)[..., index] for mean in (result.filtered.mean, result.mean)
    )
    covariance = result.covariance[..., index, :][..., index]
    scaled = torch.linalg.solve(covariance, smoothed.unsqueeze(-1)).squeeze(-1)
    return {
        "group": group,
        "unit": model.units[index[0]],
        "runs": len(plan.runs),
        "steps": int(episode.record.y.shape[1]),
        "recorded": "root" in plan.values["scenario"],
        "drawn_from_model": is_drawn_from_model(plan),
        "linear": bool(model.linear),
        "filter": mean_squares(causal),
        "smoother": mean_squares(smoothed),
        "smoother_nees": float((scaled * smoothed).sum(-1).nanmean()) / len(index),
        "sampled": sampled_squares(plan, episode, truth, index),
        "bound": None if sd is None else math.sqrt(mean_squares(sd[None][..., index])[0]),
        "reason": reason,
        "last_change": float(np.nanmax(result.changes[:, -1].numpy())),
        "cpu_s": time.process_time() - start_time,
    }


def format_rows(store: dict[str, Any]) -> list[str]:
    """Return the lines of the table."""
    rows = []
    for name, r in store.items():
        if "refused" in r:
            continue
        limit, at_most = largest_limit(r), "-"
        if limit is not None:
            gain, error = relative_gain(r["filter"], limit)
            at_most = f"{100 * gain:.0f} ± {100 * error:.0f} %"
        kind = "recorded" if r["recorded"] else "simulated"
        quantity = f"{r['group']} [{r['unit']}]" if r["unit"] else r["group"]
        bound = "-" if r["bound"] is None else f"{r['bound']:.3g}"
        sampled = f"{root_mean(r['sampled']):.3g}" if is_sampled_well(r) else "-"
        valid = int(np.isfinite(np.array(r["filter"]) + np.array(r["smoother"])).sum())
        runs = f"{r['runs']}" if valid == r["runs"] else f"{valid} of {r['runs']}"
        rows.append(
            f"| `{name}` | {kind} | {quantity} | {runs} x {r['steps']} | "
            f"{root_mean(r['filter']):.3g} | {root_mean(r['smoother']):.3g} | {r['smoother_nees']:.2g} | "
            f"{r['last_change']:.1g} | {sampled} | {bound} | {at_most} |"
        )
    return rows


INTRODUCTION = """# The most that any causal filter could get

How much error is left to gain over the cubature filter `ckf` in each scenario, in nominal noise unless the name of a row has
another. Terms: [glossary](glossary.md).

Two quantities limit the error of every filter if the model of the filter describes the data:

- **PCRB.** The posterior Cramér-Rao bound, where it exists: no filter has a smaller root mean square error.
- **Smoother.** The mean of the states given the whole record has the smallest mean square error of all estimates. A filter reads
  the past alone, so it cannot be better.

Two smoothers are compared. The [iterated smoother](methods/smoothing.md) with cubature points and {passes} passes is exact on
linear models. On other models it approximates, so its error is not a limit there. Means of {paths} sampled paths are exact in the
limit: backward sampling with {particles} particles where the transition has a density, otherwise chains in noise space. These have
{chain_steps} steps, or four times as many where a chain could stay at its start. The variance of these means is subtracted.

| column | content |
|---|---|
| error | main group of the model; errors are root mean squares over all runs and steps, which a few bad runs raise above the median over runs that pages of studies show |
| NEES | normalised squared error of the iterated smoother per component, 1 if its covariance is right |
| change | largest shift of its last pass in standard deviations; above {converged:g} it has not converged |
| sampled | error of the mean of the sampled paths, empty if these are too few or do not move enough |
| at most | largest reduction of the error of `ckf` that the larger limit leaves, with the standard error over the runs |

`at most` is empty where no limit holds. A model describes the data if they are drawn from it, the start included. For simulated
sensors it also counts as such if NEES is between {low:g} and {high:g}. The exact mean is not worse than other estimates, so `sampled`
is empty if its error is {excess:g} times that of `ckf` or of the iterated smoother. On recorded data no limit
holds: the distribution of their errors is unknown. The error of the smoother then shows what this model reaches with the whole
record. Runs that are lost are left out. A negative value is chance.

| scenario | data | error | runs x steps | `ckf` | smoother | NEES | change | sampled | PCRB | at most |
|---|---|---|---|---|---|---|---|---|---|---|
"""


EXAMPLE = """## Example

The error of `ckf` and of the smoother on a scenario:

```python
import torch

from pfbench import job
from pfbench.filter import smooth_iteratively

plan = job.build_plan(job.compose(["scenario=linear_walk", "filter=ckf", "runs=20"]))
episode, model = plan.draw_episode(plan.runs), plan.model
with torch.no_grad():
    result = smooth_iteratively(plan.method, model, episode.record)
truth = model.assemble(episode.truth)
errors = [
    model.error(mean, truth).square().mean().sqrt() for mean in (result.filtered.mean, result.mean)
]
assert errors[1] < errors[0]
```"""


def page(store: dict[str, Any]) -> str:
    """Return the page of stored results."""
    ordered = {name: store[name] for name in CONDITIONS if name in store}
    low, high = MODEL_OF_THE_DATA
    text = INTRODUCTION.format(
        passes=PASSES, paths=PATHS, particles=PARTICLES, chain_steps=CHAIN_STEPS,
        excess=LARGEST_EXCESS,
        converged=CONVERGED, low=low, high=high,
    )  # fmt: skip
    missing = [
        f"- `{name}`: {r['reason'].removeprefix('no bound: ').rstrip('.')}."
        for name, r in ordered.items()
        if "refused" not in r and r["bound"] is None
    ]
    refused = [f"- `{name}`: {r['refused']}" for name, r in ordered.items() if "refused" in r]
    refused += [f"- {names}: {reason}" for names, reason in LEFT_OUT.items()]
    parts = [
        text + "\n".join(format_rows(ordered)),
        EXAMPLE,
        "## Scenarios without a PCRB\n\n" + "\n".join(missing),
        "## Scenarios without a smoother\n\n" + "\n".join(refused),
        "To measure them again: `python experiments/analyses/ceiling.py --again`. Numbers are stored in `experiments/analyses/ceiling.json`.",
    ]
    return "\n\n".join(parts) + "\n"


def main() -> None:
    """Measure conditions, store the results and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("conditions", nargs="*", default=list(CONDITIONS))
    parser.add_argument("--again", action="store_true", help="measure stored conditions too")
    parser.add_argument("--page", action="store_true", help="write the page only")
    options = parser.parse_args()
    store: dict[str, Any] = json.loads(STORE.read_text()) if STORE.exists() else {}
    for name in () if options.page else options.conditions:
        if options.again or name not in store:
            store[name] = measure(name, CONDITIONS[name])
            print(name, store[name], flush=True)
            STORE.write_text(json.dumps(store, indent=1) + "\n")
    PAGE.write_text(page(store))


if __name__ == "__main__":
    main()
