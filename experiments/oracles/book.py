"""The oracle book: rows of printed numbers, what pfbench computes for each, and whether both agree.

A module of this folder whose name ends in `_rows` has recipes: functions that yield `Number`, one for each printed value. A recipe
states who printed the values, where, and under which licence. It takes the setting, the data and the printed values from there, and no
code. Its results are kept in a file whose name has a digest of pfbench and of this folder, so that a changed program runs again.
"""

from __future__ import annotations

import importlib
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import torch

from pfbench.core import require
from pfbench.files import hash_content, hash_folder, write_atomically

HERE = Path(__file__).resolve().parent
WIDTH = 3.0  # standard errors within which a printed value is met


class Source(NamedTuple):
    """Who printed the numbers of a recipe.

    Attributes:
        project: Name of the project, and of what it cites.
        file: File of its repository, or address of the page.
        licence: Licence of the numbers and of the data.
        origin: How the printed value was read, and where the data come from.
    """

    project: str
    file: str
    licence: str
    origin: str


class Number(NamedTuple):
    """A printed number and that of pfbench.

    Attributes:
        name: Name within its recipe.
        setting: Model, data and method, in words.
        printed: The printed value.
        ours: The value of pfbench in the same setting.
        tolerance: Half of a unit of the last printed digit, or the tolerance that the source states.
        printed_error: Standard error of the printed value, if it is an average or a draw.
        our_error: Standard error of our value.
        filters: Names of the filters of the registry that computed it.
        note: What is known about a difference.
    """

    name: str
    setting: str
    printed: float
    ours: float
    tolerance: float
    printed_error: float = 0.0
    our_error: float = 0.0
    filters: tuple[str, ...] = ()
    note: str = ""

    @property
    def error(self) -> float:
        """Standard error of the difference, without that of rounding."""
        return math.hypot(self.printed_error, self.our_error)

    @property
    def z(self) -> float:
        """Difference in standard deviations; a value rounded by at most the tolerance has a third of its square as variance."""
        spread = math.hypot(self.error, self.tolerance / math.sqrt(3.0))
        return (self.ours - self.printed) / spread

    @property
    def is_hit(self) -> bool:
        """Whether the difference is at most the tolerance and three standard errors; NaN is none."""
        return abs(self.ours - self.printed) <= self.tolerance + WIDTH * self.error


class Recipe(NamedTuple):
    """A function that computes the numbers of a source, with its usual time in seconds on one core."""

    name: str
    seconds: float
    source: Source
    make: Callable[[], Iterable[Number]]


REGISTRY = "registry_nile."  # rows of filters of the registry, by their start
_RECIPES: dict[str, Recipe] = {}


def recipe(seconds: float, source: Source) -> Callable[[Callable[[], Iterator[Number]]], Any]:
    """Add the recipe of a function to the book, under the name of the function."""

    def add(make: Callable[[], Iterator[Number]]) -> Callable[[], Iterator[Number]]:
        _RECIPES[make.__name__] = Recipe(make.__name__, seconds, source, make)
        return make

    return add


def list_recipes(name: str = "") -> list[Recipe]:
    """List the recipes, cheapest first: all of them, one by its name, or that of a row.

    Raises:
        ValueError: If no recipe and no row of a recipe has the name.
    """
    for file in sorted(HERE.glob("*_rows.py")):
        importlib.import_module(f"{__package__}.{file.stem}")
    every = sorted(_RECIPES.values(), key=lambda entry: entry.seconds)
    chosen = [entry for entry in every if not name or entry.name == name.partition(".")[0]]
    names = ", ".join(sorted(_RECIPES))
    require(chosen, "oracle", f"be one of {names}", name, "Use: pfbench check oracles NAME")
    return chosen


def find_digest() -> str:
    """Return a digest of the sources of pfbench and of this folder, without its stored values."""
    package = hash_folder(Path(str(files("pfbench"))))
    own = {file.name: file.read_text() for file in sorted(HERE.iterdir()) if file.suffix in (".py", ".csv")}  # fmt: skip
    return hash_content({"package": package, **own})[:12]


def compute_rows(entry: Recipe) -> dict[str, Any]:
    """Compute the rows of a recipe on one core: each has all that a page needs."""
    torch.set_num_threads(1)
    start = time.process_time()
    rows = [
        {
            "id": f"{entry.name}.{number.name}",
            **number._asdict(),
            "z": number.z,
            "hit": number.is_hit,
            "source": entry.source._asdict(),
        }
        for number in entry.make()
    ]
    return {"rows": rows, "seconds": time.process_time() - start}


def read_or_compute(entry: Recipe, folder: Path, digest: str) -> tuple[dict[str, Any], bool]:
    """Return the results of a recipe, and whether they were stored."""
    file = folder / f"{entry.name}_{digest}.json"
    if file.is_file():
        return json.loads(file.read_text()), True
    results = compute_rows(entry)
    text = json.dumps(results)
    write_atomically(file, lambda stream: stream.write(text.encode()))
    for old in folder.glob(f"{entry.name}_{'?' * len(digest)}.json"):
        if old != file:
            old.unlink()
    return results, False


def format_row(row: dict[str, Any], seconds: float | None) -> str:
    """Format a row as a line."""
    verdict = "hit " if row["hit"] else "MISS"
    errors = [f" +- {row[key]:.2g}" if row[key] else "" for key in ("our_error", "printed_error")]
    paid = "kept" if seconds is None else f"{seconds:.1f} s"
    return f"{verdict} z {row['z']:+6.2f}  {row['id']:44} {row['ours']:.10g}{errors[0]}, printed {row['printed']:.10g}{errors[1]}  [{paid}]"


def run_book(name: str, folder: Path) -> list[dict[str, Any]]:
    """Compute all rows or those of a name, cheapest first, and print a line for each; finished ones are kept in the folder.

    Raises:
        ValueError: If the name does not exist.
    """
    recipes, digest, rows = list_recipes(name), find_digest(), []
    seconds = sum(entry.seconds for entry in recipes)
    print(
        f"Recipes: {len(recipes)}; about {seconds:.0f} s on one core; finished rows are kept in {folder}",
        flush=True,
    )
    for entry in recipes:
        results, is_kept = read_or_compute(entry, folder, digest)
        for row in results["rows"]:
            if name in ("", entry.name, row["id"]):
                print(format_row(row, None if is_kept else results["seconds"]), flush=True)
                rows.append({**row, "seconds": results["seconds"]})
    require(rows, "oracle", f"be a row of {recipes[0].name}", name, "Use: pfbench check oracles")
    misses = [row["id"] for row in rows if not row["hit"]]
    said = f"; misses: {', '.join(misses)}" if misses else ""
    registry = sum(row["id"].startswith(REGISTRY) for row in rows)
    of_these = f", {registry} of them filters of the registry on one number" if registry else ""
    print(f"{len(rows) - len(misses)} of {len(rows)} rows are met{of_these}{said}")
    return rows
