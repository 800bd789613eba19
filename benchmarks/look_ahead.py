"""Standard deviation of the log evidence of one record over repetitions, of a filter that looks ahead and of a bootstrap filter.

    python benchmarks/look_ahead.py

It writes look_ahead.md. Each record is one run of a scenario. Repetitions differ in the random numbers of the filter alone.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import torch

from pfbench import job
from pfbench.core import PhiloxStream
from pfbench.filter import (
    GaussianFilter,
    ParticleFilter,
    TaylorLinearisation,
    TwistedParticleFilter,
    run_filter,
)

PAGE = Path(__file__).with_suffix(".md")
SCENARIOS = ("stochastic_volatility", "gps_ins_inflated", "growth")
REPETITIONS = 100
BATCH = 20  # repetitions in one pass
SEED = 5  # of the records
METHODS: dict[str, Any] = {
    "twisted, 50": TwistedParticleFilter(50),
    "twisted, 200": TwistedParticleFilter(200),
    "bootstrap, 200": ParticleFilter(200),
    "bootstrap, 2000": ParticleFilter(2000),
    "EKF": GaussianFilter(TaylorLinearisation()),
}


def measure(scenario: str) -> list[str]:
    """Return a row of each method: mean and standard deviation of the log evidence, k-hat and time of a repetition."""
    words = [
        f"scenario={scenario}",
        "filter=sir",
        "runs=1",
        f"seed={SEED}",
        "episode_cache_dir=null",
    ]
    plan = job.build_plan(job.compose(words))
    episode = plan.draw_episode(torch.arange(1))
    model, rows = plan.make_filter_model(episode), []
    record = episode.record.select_runs(torch.zeros(BATCH, dtype=torch.long))
    for name, method in METHODS.items():
        values, k, start = [], [], time.process_time()
        for first in range(0, REPETITIONS, BATCH):
            draws = PhiloxStream(1, torch.arange(first, first + BATCH))
            with torch.no_grad():
                result = run_filter(method, model, record, draws)
            values.append(result.log_evidence)
            k.append(result.pareto_k)
        seconds, log_z = (time.process_time() - start) / REPETITIONS, torch.cat(values)
        tail = float(torch.cat(k).median())
        numbers = f"{log_z.mean():.3f} | {log_z.std():.3f} | {f'{tail:.2f}' if tail == tail else '–'} | {seconds:.3f}"
        rows.append(f"| `{scenario}` | {record.y.shape[1]} | {name} | {numbers} |")
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    """Measure all scenarios and write the page."""
    torch.set_num_threads(1)
    head = [
        "# Evidence by a filter that looks ahead", "",
        f"Log evidence of one record (seed {SEED}) over {REPETITIONS} repetitions. k-hat: median over repetitions, at most 0.7 is reliable. "
        "Time: processor time of one repetition, s.", "",
        "| scenario | steps | filter, particles | mean | standard deviation | k-hat | time |", "|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    rows = [row for scenario in SCENARIOS for row in measure(scenario)]
    end = [
        "",
        f"Written by `python benchmarks/look_ahead.py`, commit {job.read_versions()['commit']}.",
        "",
    ]
    PAGE.write_text("\n".join([*head, *rows, *end]), encoding="utf-8")


if __name__ == "__main__":
    main()
