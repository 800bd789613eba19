"""The sweep that is disturbed, its undisturbed numbers, and the judgement of its end."""

import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path

import torch
from command_line import Said, pfbench

from faults.tally import FINE
from pfbench import job
from pfbench.files.atomic_write import hash_content
from pfbench.job.config import JobConfig, compose
from pfbench.results import store

SWEEP = (
    "run",
    "-m",
    "scenario=linear_walk",
    "scenario.steps=20",
    "runs=4",
    "particles=50",
    "filter=sir,rpf,ckf",
)
CLEAR = re.compile(r"\b(must|is not|does not|cannot|requires?)\b")


@contextmanager
def new_home() -> Iterator[Path]:
    """Make a folder for results and episodes, and remove it."""
    with tempfile.TemporaryDirectory(prefix="pfbench-faults-") as folder:
        yield Path(folder).resolve()


def run_sweep(home: Path, *words: str) -> Said:
    """Run the sweep in this process."""
    torch.set_num_threads(1)
    return pfbench(*SWEEP, *words, home=home)


@cache
def job_configs() -> list[JobConfig]:
    """Return the configurations of the jobs of the sweep, composed once."""
    *words, filters = SWEEP[2:]
    names = filters.partition("=")[2].split(",")
    return [compose([*words, f"filter={name}"]) for name in names]


def run_jobs(home: Path) -> int:
    """Run the jobs of the sweep without Hydra, whose composition takes most of its time."""
    folders = {"results_dir": str(home / "results"), "episode_cache_dir": str(home / "worlds")}
    for config in job_configs():
        job.run(replace(config, values=config.values | folders))
    return 0


def result_files(home: Path) -> list[Path]:
    return sorted((home / "results" / "adhoc").glob("*.npz"))


def numbers(home: Path) -> dict[str, str]:
    """Return a hash of the arrays of each finished job, by filter."""
    results = map(store.read_result, result_files(home))
    return {result.meta["label"]: hash_content(result.data) for result in results}


@cache
def undisturbed() -> dict[str, str]:
    """Return the hashes of the sweep without a fault.

    It runs in this process, so that children forked later have all modules.
    """
    job_configs()
    with new_home() as home:
        said = run_sweep(home)
        if said.code != 0:
            raise RuntimeError(f"the sweep without a fault must finish, got {said.err}. Run it.")
        return numbers(home)


def is_clear(text: str) -> bool:
    """Return whether the output of a command states a requirement, and shows no traceback."""
    lines = [line for line in text.splitlines() if line.startswith("error")]
    return bool(lines) and "Traceback" not in text and all(map(CLEAR.search, lines))


def judge(home: Path, said: Said) -> tuple[str, str, str]:
    """Return the outcome of a sweep that should have finished, a remark and an example."""
    expected = undisturbed()
    if said.code != 0:
        return ("unclear" if is_clear(said.err) else "crash"), "stopped", said.err[-500:]
    try:
        ours = numbers(home)
    except ValueError as error:
        return "lost", "unreadable", f"{error}"
    if missing := expected.keys() - ours.keys():
        return "lost", "missing jobs", ", ".join(sorted(missing))
    if ours != expected:
        return "false", "other numbers", f"{ours}"
    return FINE, "equal to the undisturbed sweep", ""
