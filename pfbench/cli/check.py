"""Command `pfbench check`: compose all configurations and print versions, or compute printed numbers of other projects."""

from __future__ import annotations

import os
from collections.abc import Sequence
from importlib import import_module
from itertools import islice
from pathlib import Path

from pfbench import job
from pfbench.cli.command import Command
from pfbench.cli.messages import format_error, require_choice
from pfbench.core.parameter_checks import require
from pfbench.files.command_start import collect_rarely, start_work
from pfbench.job.config import SUFFIX, compose, list_groups
from pfbench.results.paper_block import read_part


def check_installation(words: Sequence[str]) -> None:
    """Print the state of the installation as a table of item, value and status, or that of the oracle book."""
    if words[:1] == ["oracles"]:
        _check_oracles(words[1:])
        return
    require(not words, "check", "be without words", " ".join(words), "Use: pfbench check, or pfbench check oracles")  # fmt: skip
    import torch

    start_work()  # to compose all files is the work
    collect_rarely()  # it makes millions of objects, and no arrays
    has_cuda = torch.cuda.is_available()
    root = compose([]).values["data"]["root"]
    hint = "recorded scenarios need PFBENCH_DATA or data.root=..."
    errors = []
    for group, name in ((group, name) for group, names in list_groups().items() for name in names):
        choice = f"{'+' if group in _ADDED else ''}{group}={name}"
        try:
            compose([choice, *_add_needs(group, name), "data.root=somewhere"])
        except Exception as error:
            errors.append(f"{choice}: {format_error(error, [choice])}")
    total = sum(map(len, list_groups().values()))
    rows = [
        ("item", "value", "status"),
        *((name, value or "unknown", "ok") for name, value in job.read_versions().items()),
        ("threads", f"{torch.get_num_threads()} of {os.cpu_count()} cores", "ok"),
        ("device", torch.cuda.get_device_name() if has_cuda else "cpu", "ok"),
        ("data root", str(root or "not set"), "ok" if root else hint),
        ("configurations", f"{total - len(errors)} of {total}", "failed" if errors else "ok"),
    ]
    for item, value, status in rows:
        print(f"{item:15} {value:24} {status}")
    if errors:
        raise ValueError("configurations must compose, got errors:\n  " + "\n  ".join(errors))


def _check_oracles(words: Sequence[str]) -> None:
    """Compute the rows of the oracle book, or of one recipe, and print them."""
    names = [word for word in words if "=" not in word]
    require(len(names) < 2, "oracles", "have at most one name", " ".join(names), "Use: pfbench check oracles NAME")  # fmt: skip
    config = compose([word for word in words if "=" in word])
    book = import_module("pfbench.experiments.oracles.book")
    recipes = sorted(recipe.name for recipe in book.list_recipes())
    for name in names:  # before the work starts
        require_choice("oracle", name.partition(".")[0], recipes, "Use: pfbench check oracles NAME")
    start_work()
    book.run_book("".join(names), Path(config.values["results_dir"]) / "oracles")


_ADDED = ("experiment", "infer")  # groups that are not in the list of defaults


def _add_needs(group: str, name: str) -> list[str]:
    """Return the scenario of a model or of the model that it extends, and a world in which a filter is tuned."""
    if group == "filter" and name.endswith(f"_{SUFFIX}"):
        knobs = f"\n{name.removesuffix(f'_{SUFFIX}')}:"
        return [f"tuned={w}" for w in list_groups()["tuned"] if knobs in read_part("tuned", w)][:1]
    if group != "model":
        return []
    parts = name.split("_")
    entries = [f"/model@_global_.model: {'_'.join(parts[:n])}\n" for n in range(len(parts), 0, -1)]
    texts = {scenario: read_part("scenario", scenario) for scenario in list_groups()["scenario"]}
    fitting = (scenario for entry in entries for scenario in texts if entry in texts[scenario])
    return [f"scenario={scenario}" for scenario in islice(fitting, 1)]


COMMAND = Command(
    check_installation,
    """\
pfbench check
pfbench check oracles [NAME] [results_dir=results]

Print versions, threads, device and data folder, and compose all configurations.
The exit code is 1 if a configuration does not compose.

oracles: numbers that other projects printed, with their settings, and those of pfbench: z, hit or miss, cheapest first. Finished
rows are kept in results/oracles until pfbench or the recipes change. NAME is that of a recipe or of a row.

  pfbench check oracles                    all, in three minutes on one core
  pfbench check oracles pomp_walk          those of a recipe
  pfbench check oracles pomp_walk.kalman   one

Page: docs/oracles.md""",
)
