"""What a step of each method costs, relative to the bootstrap filter with as many particles: benchmarks/methods.md.

    python benchmarks/methods.py [--below 10] [--particles 500] [--runs 50] [--steps 10] [--rounds 3]

All methods filter the same flights, one core, one after the other in interleaved rounds; Gaussian filters have no particles and
are on the same axis. Results are stored in methods.json. Filters that are not in it are measured beside SIR, and with
--below those again whose stored ratio is smaller. --page writes the page from the stored results alone.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_module
from race import cpu_name

from pfbench import job
from pfbench.core import PhiloxStream, Record, map_inputs
from pfbench.filter import ParticleFilter, run_filter
from pfbench.job import memory as process_memory
from pfbench.kernels import dispatch
from pfbench.noise import NominalNoise

HERE = Path(__file__).parent
FIRST = "sir"
STORE = HERE / "methods.json"


def methods(particles: int) -> dict[str, Any]:
    """Every filter that can be composed, by the name of its yaml; networks cost the same before they are trained."""
    names = job.list_groups()["filter"]
    job.register_experiments()
    with initialize_config_module("pfbench.conf", version_base="1.3"):
        words = (
            f"particles={particles}",
            "checkpoint=untrained",
            "tuned=gps_ins_inflated_nominal",
        )
        return {
            name: job.instantiate(compose("config", [f"filter={name}", *words])["filter"])
            for name in names
        }


def flights(runs: int, steps: int) -> tuple[Any, Record]:
    """The first steps of simulated flights and the model of all filters."""
    job.register_experiments()
    with initialize_config_module("pfbench.conf", version_base="1.3"):
        cfg = compose(
            "config", ["scenario=flight_500s", "model=ins_gnss_inflated", "episode_cache_dir=null"]
        )
    model, episode = (
        job.instantiate(cfg.model),
        job.instantiate(cfg.scenario).draw(NominalNoise(), torch.arange(runs), 1),
    )
    record = model.prepare(episode.record)
    first = record._replace(y=record.y[:, :steps], u=map_inputs(lambda a: a[:, :steps], record.u))
    return model, first


def race(found: dict[str, Any], model: Any, record: Record, rounds: int) -> dict[str, list[float]]:
    """Milliseconds of processor time per step and round; the first round warms up and does not count."""
    runs, steps = record.y.shape[:2]
    spent: dict[str, list[float]] = {name: [] for name in found}
    for turn in range(rounds + 1):
        for name, method in found.items():
            begun = time.process_time()
            run_filter(method, model, record, PhiloxStream(turn, torch.arange(runs)))
            if turn:
                spent[name].append(1e3 * (time.process_time() - begun) / steps)
            print(f"round {turn} of {rounds}: {name}", file=sys.stderr)
    return spent


def begins_with(method: Any) -> str:
    """Particles at the start; a method that adapts their number may have its own."""
    if isinstance(method, ParticleFilter):
        return str(method.particle_count.initial_count(method.particles))
    return str(method.particles) if hasattr(method, "particles") else "none"


def refusals(found: dict[str, Any], model: Any, record: Record) -> dict[str, str]:
    """Return the reason of each filter that refuses the model."""
    reasons = {}
    first = record.select_steps(slice(0, 1))
    for name, method in found.items():
        try:
            run_filter(method, model, first, PhiloxStream(0, torch.arange(len(record.y))))
        except ValueError as error:
            reasons[name] = str(error)
    return reasons


def rows_of(found: dict[str, Any], spent: dict[str, list[float]]) -> dict[str, Any]:
    """Return the stored rows: median time, and the ratio to SIR in the same round with its range."""
    rows = {}
    for name, times in spent.items():
        ratios = [a / b for a, b in zip(times, spent[FIRST], strict=True)]
        rows[name] = {
            "particles": begins_with(found[name]),
            "ms": statistics.median(times),
            "ratio": [min(ratios), statistics.median(ratios), max(ratios)],
        }
    return rows


def page(stored: dict[str, Any]) -> str:
    """Return the page of the stored results."""
    setting = stored["setting"]
    lines = [
        "# What a step costs",
        "",
        f"18-state INS/GNSS, {setting['runs']} runs in a batch, {setting['particles']} particles, double precision, inner loops "
        f"compiled, one core; medians of {setting['rounds']} interleaved rounds of {setting['steps']} steps, and their range. "
        "Rows may be of different days, each measured beside SIR: their ratios compare, their milliseconds need not. "
        "Written by `python benchmarks/methods.py`.",
        "",
        "| filter | particles at the start | ms per step | times SIR (range) |",
        "|---|---|---|---|",
    ]
    for name in order_of(stored):
        row = stored["rows"][name]
        low, middle, high = row["ratio"]
        lines.append(
            f"| `{name}` | {row['particles']} | {row['ms']:.2f} | {middle:.2f} ({low:.2f}-{high:.2f}) |"
        )
    if stored["refused"]:
        lines += ["", "Filters that refuse this model:", ""]
        lines += [f"- `{name}`: {reason}" for name, reason in sorted(stored["refused"].items())]
    return "\n".join([*lines, "", f"{stored['machine']}.", ""])


def order_of(stored: dict[str, Any]) -> list[str]:
    """Return the filters by their median ratio."""
    return sorted(stored["rows"], key=lambda name: stored["rows"][name]["ratio"][1])


def measure(stored: dict[str, Any], options: argparse.Namespace) -> dict[str, Any]:
    """Return the stored results with those of the filters that they lack, or of all."""
    setting = {key: getattr(options, key) for key in ("particles", "runs", "steps", "rounds")}
    stored = stored or {"setting": setting, "rows": {}, "refused": {}}
    if setting != stored["setting"]:
        raise ValueError(
            f"settings must be {stored['setting']}, got {setting}. Remove {STORE.name}."
        )
    slow = {name: row for name, row in stored["rows"].items() if row["ratio"][1] >= options.below}
    process_memory.keep_freed_memory()
    warnings.simplefilter("ignore")  # of methods that say what they cost
    model, record = flights(options.runs, options.steps)
    found = {
        name: method
        for name, method in methods(options.particles).items()
        if name == FIRST or name not in (*slow, *stored["refused"])
    }
    with dispatch.use_kernels(), torch.no_grad():
        refused = refusals(found, model, record)
        found = {name: method for name, method in found.items() if name not in refused}
        rows = rows_of(found, race(found, model, record, options.rounds))
    version = f"Python {platform.python_version()}, torch {torch.__version__}"
    return {
        "setting": setting,
        "machine": f"{cpu_name()}; {version}",
        "rows": slow | rows,
        "refused": stored["refused"] | refused,
    }


def main() -> None:
    """Measure what is missing, and write page and figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in (("particles", 500), ("runs", 50), ("steps", 10), ("rounds", 3)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--below", type=float, default=0.0, help="measure cheaper filters again")
    parser.add_argument("--page", action="store_true", help="write page and figure only")
    options = parser.parse_args()
    torch.set_num_threads(1)
    stored = json.loads(STORE.read_text()) if STORE.exists() else {}
    if not options.page:
        stored = measure(stored, options)
        STORE.write_text(json.dumps(stored, indent=1) + "\n")
    (HERE / "methods.md").write_text(page(stored))


if __name__ == "__main__":
    main()
