"""Filters that start recorded drives and flights with a wrong heading: how many settle, and when.

The recorded start of each run is turned about the vertical by plus or minus the angle, which is also the standard
deviation of the heading in the filter. Fixes and runs are those of the scenario. Results are kept in
recorded_headings.json.

Run: python benchmarks/recorded_headings.py [--runs 20]; --page writes the page from the stored results alone, --filter
NAME adds or replaces the rows of one filter.
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
from heading_errors import (
    ANGLES,
    change,
    describe_times,
    filters,
    format_nees,
    format_settled,
)
from torch import Tensor

from pfbench import job
from pfbench.core import PhiloxStream
from pfbench.filter import Filter, InvariantFilter, run_filter

HERE = Path(__file__).parent
STORE = HERE / "recorded_headings.json"
SCENARIOS = {"recorded_quad_flights": 3.0, "recorded_car_drive": 5.0}  # deg, stated heading error
SETTLED = 10.0  # deg
WINDOW = 5.0  # s
SEEDS = (1, 2)


def measure(scenario: str, method: Filter, angle: float, runs: int) -> dict[str, Any]:
    """Run a filter on recorded data with all seeds and compare its heading with the reference.

    Args:
        scenario: Configuration of the scenario.
        method: Filter.
        angle: Heading error, deg.
        runs: Number of runs of each seed.

    Returns:
        Runs that settle, seconds until they do, error and squared error over variance of the heading in the last
        fifth, position error.
    """
    started = time.process_time()
    outcomes = [o for seed in SEEDS for o in run_seed(scenario, method, angle, runs, seed)]
    at, final, squared, distance = np.array(outcomes).T
    return {
        "settled": int((final < SETTLED).sum()),
        **describe_times(at),
        "heading": float(np.median(final)),
        "nees": float(np.median(squared)),
        "position": float(np.median(distance)),
        "cpu_s": time.process_time() - started,
    }


def run_seed(
    scenario: str, method: Filter, angle: float, runs: int, seed: int
) -> list[tuple[float, ...]]:
    """Run a filter on recorded data and describe each run, see `settle`.

    Args:
        scenario: Configuration of the scenario.
        method: Filter.
        angle: Heading error, deg.
        runs: Number of runs.
        seed: Seed of the simulated errors.
    """
    sizes = f"scenario.tuning.attitude_sd_deg=[1.0,1.0,{angle}]"
    plan = job.build_plan(
        job.compose([f"scenario={scenario}", f"runs={runs}", f"seed={seed}", sizes])
    )
    known = f"scenario.tuning.attitude_sd_deg=[1.0,1.0,{SCENARIOS[scenario]}]"
    source = job.build_plan(
        job.compose([f"scenario={scenario}", f"runs={runs}", f"seed={seed}", known])
    )
    episode, model = source.draw_episode(source.runs), plan.model
    turn = episode.record.y.new_zeros(runs, 15)
    turn[:, 2] = math.radians(angle) * (1 - 2 * (torch.arange(runs) % 2))
    assert episode.record.start is not None
    record = episode.record._replace(start=model.chart.add(episode.record.start, turn))
    true = episode.truth["attitude"]
    chart = model.group_chart(method.chart) if isinstance(method, InvariantFilter) else model.chart
    ratio: list[Tensor] = []

    def heading_error(t: int, mean: Tensor) -> Tensor:
        state = torch.cat([true[:, t], mean[:, 4:]], -1)
        return model.chart.subtract(state, mean)[:, 2]

    def watch(t: int, info: Any) -> dict[str, Tensor]:
        covariance = info.covariance()
        if chart is not model.chart:
            slope = torch.linalg.inv(change(model, chart, info.mean))
            covariance = slope @ covariance @ slope.mT
        ratio.append(heading_error(t, info.mean).square() / covariance[:, 2, 2])
        return {}

    with torch.no_grad():
        result = run_filter(method, model, record, PhiloxStream(seed + 1, source.runs), watch)
    error = torch.stack([heading_error(t, result.mean[:, t]) for t in range(true.shape[1])], 1)
    error = torch.where(result.lost[:, None], math.pi, error.rad2deg().abs())
    position = (result.mean[..., 7:10] - episode.truth["position"]).square().sum(-1)
    return [
        settle(error[r], torch.stack(ratio, 1)[r], position[r], episode.time) for r in range(runs)
    ]


def settle(error: Tensor, ratio: Tensor, position: Tensor, seconds: Tensor) -> tuple[float, ...]:
    """Describe a run, over the steps that have a reference.

    Args:
        error: Heading error, deg, [T].
        ratio: Squared heading error over variance, [T].
        position: Squared position error, m^2, [T].
        seconds: Time, s, [T].

    Returns:
        Seconds until the heading stays within the bound for a window, inf for never; root mean square heading error,
        deg, and mean ratio of the last fifth; root mean square position error, m.
    """
    has_reference = position.isfinite() & error.isfinite()
    error, ratio, position = error[has_reference], ratio[has_reference], position[has_reference]
    seconds = seconds[has_reference] - seconds[0]
    width = int((seconds < seconds[0] + WINDOW).sum())
    inside = (error < SETTLED).double().unfold(0, width, 1).amin(1)
    first = torch.nonzero(inside)
    last = slice(len(error) - len(error) // 5, None)
    return (
        float(seconds[first[0, 0]]) if len(first) else math.inf,
        float(error[last].square().mean().sqrt()),
        float(ratio[last].mean()),
        float(position.mean().sqrt()),
    )


def page(stored: dict[str, Any]) -> str:
    """Return the page of the stored results."""
    assert __doc__ is not None
    lines = [
        "# Wrong headings on recorded data",
        "",
        " ".join(__doc__.split("\n\n")[1].split()[:-5]),
        "Written by `benchmarks/recorded_headings.py`. The same with simulated data: [wrong headings](heading_errors.md).",
        "",
        f"{stored['runs']} runs of each scenario with each of {len(SEEDS)} seeds, on the same recordings; in brackets are 95 %",
        "intervals, Wilson's for the share and that of order statistics for the time. A run settles when the root mean square of its heading error in the last",
        f"fifth is below {SETTLED:.0f} degrees. The time is the median over runs of the start of the first {WINDOW:.0f} s within this",
        "bound. Heading and position errors are medians of root mean squares. NEES of the heading: median over runs in the",
        "last fifth; 1 is consistent, and collapsed particles have none.",
        "",
        "| scenario | heading error [deg] | filter | settled [%] | time [s] | heading [deg] | NEES | position [m] |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in stored["rows"]:
        lines.append(
            f"| {row['scenario']} | {row['angle']} | {row['filter']} | "
            f"{format_settled(row, len(SEEDS) * stored['runs'])} | "
            f"{row['heading']:.1f} | {format_nees(row['nees'])} | {row['position']:.2f} |"
        )
    return "\n".join(lines) + "\n"


def measure_all(names: list[str], runs: int) -> list[dict[str, Any]]:
    """Return the rows of filters in all scenarios and at all angles."""
    rows = []
    for scenario in SCENARIOS:
        for angle in ANGLES:
            for name in names:
                values = measure(scenario, filters()[name], angle, runs)
                rows.append({"scenario": scenario, "angle": angle, "filter": name, **values})
                print(rows[-1], flush=True)
    return rows


def write_rows(rows: list[dict[str, Any]], runs: int) -> None:
    """Store rows in the order of the table."""
    stored = {(row["scenario"], row["angle"], row["filter"]): row for row in rows}
    keys = [(s, a, f) for s in SCENARIOS for a in ANGLES for f in filters() if (s, a, f) in stored]
    rows = [stored[key] for key in keys]
    STORE.write_text(json.dumps({"runs": runs, "rows": rows}, indent=1) + "\n")


def main() -> None:
    """Measure all filters and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--page", action="store_true")
    parser.add_argument("--filter", choices=filters())
    options = parser.parse_args()
    if options.filter:
        stored = json.loads(STORE.read_text())
        rows = [row for row in stored["rows"] if row["filter"] != options.filter]
        write_rows(rows + measure_all([options.filter], stored["runs"]), stored["runs"])
    elif not options.page:
        write_rows(measure_all(list(filters()), options.runs), options.runs)
    (HERE / "recorded_headings.md").write_text(page(json.loads(STORE.read_text())))


if __name__ == "__main__":
    main()
