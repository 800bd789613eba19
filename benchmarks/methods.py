"""What a step of each method costs, relative to the bootstrap filter with as many particles: benchmarks/methods.md.

    python benchmarks/methods.py [--particles 500] [--runs 50] [--steps 10] [--rounds 5]

All methods filter the same flights, one core, one after the other in interleaved rounds; Gaussian filters have no particles and
are on the same axis.
"""

from __future__ import annotations

import argparse
import platform
import statistics
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_module
from matplotlib.figure import Figure
from race import cpu_name

from pfbench import job
from pfbench.core import PhiloxStream, Record, map_inputs
from pfbench.filter import GaussianFilter, ParticleFilter, run_filter
from pfbench.kernels import compilation, process_memory
from pfbench.noise import NominalNoise

HERE = Path(__file__).parent
FIRST = "sir"


def methods(particles: int) -> dict[str, Any]:
    """Every filter that can be composed, by the name of its yaml; networks cost the same before they are trained."""
    names = sorted(path.stem for path in (HERE.parent / "conf" / "filter").glob("*.yaml"))
    with initialize_config_module("pfbench.conf", version_base="1.3"):
        words = (f"particles={particles}", "checkpoint=untrained")
        return {
            name: job.instantiate(compose("config", [f"filter={name}", *words])["filter"])
            for name in names
        }


def flights(runs: int, steps: int) -> tuple[Any, Record]:
    """The first steps of simulated flights and the model of all filters."""
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
    return "none" if isinstance(method, GaussianFilter) else str(method.particles)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in (("particles", 500), ("runs", 50), ("steps", 10), ("rounds", 5)):
        parser.add_argument(f"--{name}", type=int, default=default)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    process_memory.keep_freed_memory()
    warnings.simplefilter("ignore")  # of methods that say what they cost
    model, record = flights(chosen.runs, chosen.steps)
    found = methods(chosen.particles)
    with compilation.use_compiled(), torch.no_grad():
        spent = race(found, model, record, chosen.rounds)
    ratios = {
        name: [a / b for a, b in zip(times, spent[FIRST], strict=True)]
        for name, times in spent.items()
    }
    order = sorted(ratios, key=lambda name: statistics.median(ratios[name]))
    lines = [
        "# What a step costs",
        "",
        f"18-state INS/GNSS, {chosen.runs} runs in a batch, {chosen.particles} particles, double precision, inner loops "
        f"compiled, one core; medians of {chosen.rounds} interleaved rounds of {chosen.steps} steps, and their range. Written by "
        "`python benchmarks/methods.py`.",
        "",
        "| filter | particles at the start | ms per step | times SIR (range) |",
        "|---|---|---|---|",
    ]
    for name in order:
        own = ratios[name]
        low, middle, high = min(own), statistics.median(own), max(own)
        cost = f"{statistics.median(spent[name]):.2f} | {middle:.2f} ({low:.2f}-{high:.2f})"
        lines.append(f"| `{name}` | {begins_with(found[name])} | {cost} |")
    lines += [
        "",
        f"{cpu_name()}; Python {platform.python_version()}, torch {torch.__version__}.",
        "",
    ]
    (HERE / "methods.md").write_text("\n".join(lines))
    draw(order, ratios, found, chosen)
    print("\n".join(lines))


def draw(
    order: list[str],
    ratios: dict[str, list[float]],
    found: dict[str, Any],
    chosen: argparse.Namespace,
) -> None:
    """One bar per method on a logarithmic axis."""
    figure = Figure(figsize=(6.5, 0.6 + 0.19 * len(order)), layout="constrained")
    axis = figure.subplots()
    for place, name in enumerate(order):
        colour = "#E69F00" if isinstance(found[name], GaussianFilter) else "#0072B2"
        middle = statistics.median(ratios[name])
        axis.plot([min(ratios[name]), max(ratios[name])], [place, place], color=colour, lw=1)
        axis.plot(middle, place, "o" if colour == "#0072B2" else "s", color=colour, ms=4)
        said = f"{middle:.2g}" if middle < 9.5 else f"{middle:.0f}"
        axis.annotate(
            said,
            (max(ratios[name]), place),
            (5, 0),
            textcoords="offset points",
            va="center",
            fontsize=7,
        )
    axis.axvline(1.0, color="0.6", lw=0.8, zorder=0)
    axis.set_yticks(range(len(order)), order, fontsize=7)
    axis.set_ylim(len(order) - 0.4, -0.6)
    axis.set(xscale="log")
    axis.margins(x=0.08)
    axis.set_xlabel(
        "cost of a step, times that of SIR; circles: particles, squares: Gaussian filters",
        fontsize=8,
    )
    axis.set_title(
        f"18-state INS/GNSS, {chosen.runs} runs, {chosen.particles} particles, one core", fontsize=9
    )
    axis.tick_params(axis="x", labelsize=8)
    axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(HERE / "methods.png", dpi=150, metadata={"Software": None})


if __name__ == "__main__":
    main()
