"""Two commits by turns: processor time of the filter steps of the same jobs, each job a process of its own.

    python benchmarks/commits.py OLD NEW [ROUNDS] [FILTER,FILTER]

It writes commits.md. The times are those that results store: of all steps, on one thread, without start, data and scores. A cell takes
its turns directly one after the other, so that a slow minute of the machine falls on both. Errors of both commits are compared too.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from pfbench.results import read_metadata

ROOT = Path(__file__).parents[1]
PAGE = Path(__file__).with_suffix(".md")
WORLDS = {  # model, runs, particles
    "gps_ins_inflated": ("ins_gnss_inflated", 20, 100),
    "growth": ("growth", 50, 100),
}
FILTERS = (
    "sir", "mcmc_rpf", "qmc_polymerised", "dmc_reconstructed", "cofm_amssrcpf", "cofm_mssrckf", "fm_mssrckf", "cpso_escape",
    "rpf", "ekf", "ukf",
)  # fmt: skip


def run_job(tree: Path, results: Path, world: str, name: str) -> tuple[float, float]:
    """Run a job by the code of a tree. Returns milliseconds of a step, and the root mean square error of all runs."""
    model, runs, particles = WORLDS[world]
    words = [
        f"scenario={world}",
        f"model={model}",
        f"filter={name}",
        f"runs={runs}",
        f"particles={particles}",
        "threads=1",
        "study=race",
    ]
    environment = {
        **os.environ,
        "PYTHONPATH": str(tree),
        "OMP_NUM_THREADS": "1",
        "PFBENCH_DATA": "",
    }
    command = [
        sys.executable,
        "-m",
        "pfbench",
        "run",
        *words,
        f"results_dir={results}",
        "overwrite=true",
    ]
    done = subprocess.run(command, env=environment, cwd=results, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{world}, {name} in {tree.name}: {done.stderr[-500:]}")
    (file,) = (results / "race").glob("*.npz")
    meta, error = read_metadata(file), np.load(file)["error"].astype(float)
    file.unlink()
    return 1e3 * meta["seconds"]["filter"] / meta["steps"], float(np.sqrt(np.nanmean(error**2)))


def compare(trees: dict[str, Path], folder: Path, world: str, name: str, rounds: int) -> str:
    """Time a cell by turns. Returns its row."""
    times: dict[str, list[float]] = {commit: [] for commit in trees}
    errors: dict[str, float] = {}
    for number in range(
        rounds + 1
    ):  # the first round loads what each commit keeps, such as its operators
        for commit, tree in trees.items():
            results = folder / f"results_{commit}"
            results.mkdir(exist_ok=True)
            taken, errors[commit] = run_job(tree, results, world, name)
            times[commit] += [taken] * (number > 0)
    old, new = (times[commit] for commit in trees)
    ratios = sorted(b / a for a, b in zip(old, new, strict=True))
    first, second = errors.values()
    same = "same" if abs(first / second - 1) < 1e-5 else f"{first / second:.3g}"
    middle = [f"{statistics.median(values):.2f}" for values in (old, new)]
    ratio = f"{statistics.median(ratios):.2f} ({ratios[0]:.2f}-{ratios[-1]:.2f})"
    return f"| `{world}` | `{name}` | {' | '.join(middle)} | {ratio} | {same} |"


def main() -> None:
    old, new, *rest = sys.argv[1:]
    rounds = int(rest[0]) if rest else 3
    filters = rest[1].split(",") if len(rest) > 1 else FILTERS
    with tempfile.TemporaryDirectory() as place:
        trees = {commit: Path(place) / commit for commit in (old, new)}
        for commit, tree in trees.items():
            subprocess.run(
                ["git", "worktree", "add", "-q", "--detach", str(tree), commit],
                cwd=ROOT,
                check=True,
            )
            for name in ("conf", "experiments"):  # those of an installed checkout otherwise
                (tree / "pfbench" / name).symlink_to(tree / name)
        try:
            rows = []
            for world in WORLDS:
                for name in filters:
                    rows.append(compare(trees, Path(place), world, name, rounds))
                    print(rows[-1], flush=True)
        finally:
            for tree in trees.values():
                subprocess.run(
                    ["git", "worktree", "remove", "--force", str(tree)], cwd=ROOT, check=True
                )
    cells = "; ".join(
        f"{world}: {runs} runs, {n} particles" for world, (_, runs, n) in WORLDS.items()
    )
    lines = ["# Two commits by turns", "", f"Processor ms of a step of all runs, medians of {rounds} rounds, and the ratio with its range. {cells}.", ""]  # fmt: skip
    lines += [
        f"| world | filter | {old[:8]} | {new[:8]} | new / old (range) | error, old / new |",
        "|" + "---|" * 6,
    ]
    PAGE.write_text(
        "\n".join([*lines, *rows, "", "Written by `python benchmarks/commits.py`.", ""])
    )


if __name__ == "__main__":
    main()
