"""Run the harness of faults and write its table: `make faults`.

Batches are stored in results/faults, so that the same command continues after an interruption.
`--only` selects classes by the start of their names, `--table` writes the table of the stored batches.
`--short` runs a few trials of each class in minutes, and neither stores nor writes anything.
"""

import argparse
import subprocess
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from typing import Any, NamedTuple

from checkout import ROOT
from pfbench.experiments.study_parts import ResumableResults

from faults import (
    clock,
    commands,
    damage,
    folders,
    hostile,
    kills,
    numerics,
    page,
    parallel,
    readers,
    sanitizers,
    storage,
)
from faults.tally import Tally

STORE = ROOT / "results" / "faults"


class FaultClass(NamedTuple):
    """One row of the table.

    Attributes:
        run: Function of number of trials and seed.
        required: Number of trials of the whole harness.
        batch: Number of trials of one batch.
        short: Number of trials of the short form.
    """

    run: Callable[[int, int], Tally]
    required: int
    batch: int
    short: int = 1


CLASSES: dict[str, FaultClass] = {
    **{
        f"damaged files: {kind}": FaultClass(partial(damage.run, kind), 3000, 500, 20)
        for kind in damage.KINDS
    },
    "hostile files": FaultClass(hostile.run, hostile.CASES, hostile.BATCH),
    "hostile folders": FaultClass(folders.run, 10_000, 100, 2 * len(folders.KINDS)),
    "hostile commands": FaultClass(commands.run, 10_000, 100, len(commands.COMMANDS)),
    **{
        f"extreme numbers, {engine}": FaultClass(
            partial(numerics.run, engine), numerics.number_of_trials(engine), numerics.BATCH
        )
        for engine in numerics.ENGINES
    },
    "kills, serial": FaultClass(kills.run, 200, 10),
    **{
        f"kills, launcher {name}": FaultClass(partial(kills.run_launcher, name), 20, 2)
        for name in kills.LAUNCHERS
    },
    **{name: FaultClass(partial(storage.run, name), 30, 5) for name in storage.FAULTS},
    "clock that jumps": FaultClass(clock.run, 30, 5),
    "sweeps at the same time": FaultClass(parallel.run, 30, 5),
    "sanitizers: random shapes": FaultClass(
        partial(sanitizers.run, "random shapes"), 10 * sanitizers.CALLS, sanitizers.CALLS, 500
    ),
    "sanitizers: operators' tests": FaultClass(partial(sanitizers.run, "operators' tests"), 1, 1),
    **{
        f"damaged logs: {reader}": FaultClass(partial(readers.run, reader), 10_000, 500, 20)
        for reader in readers.READERS
    },
}


def commit() -> str:
    """Return the short commit of the checkout, with `+` if the package differs from it."""
    words = ["git", "-C", str(ROOT)]
    head = subprocess.run([*words, "rev-parse", "--short=10", "HEAD"], capture_output=True)
    state = subprocess.run([*words, "status", "--short", "pfbench"], capture_output=True)
    return head.stdout.decode().strip() + ("+" if state.stdout.strip() else "")


def run_batch(fault: FaultClass, number: int) -> dict[str, Any]:
    """Run one batch and return its tally with date and commit."""
    date = datetime.now(UTC).date().isoformat()
    size = min(fault.batch, fault.required - number * fault.batch)
    return {"date": date, "commit": commit(), "tally": fault.run(size, number).to_dict()}


def stored_parts(name: str) -> ResumableResults:
    """Return the finished batches of a class."""
    slug = name.replace(":", "").replace(",", "").replace(" ", "_")
    return ResumableResults(STORE / f"{slug}.json", {"class": name, "batch": CLASSES[name].batch})


def run_class(name: str) -> None:
    """Run the missing batches of a class."""
    fault, parts = CLASSES[name], stored_parts(name)
    finished = parts.state["done"]
    for batch in [b for b, part in finished.items() if Tally.from_dict(part["tally"]).skipped]:
        del finished[batch]  # what was missing then, such as recorded data, may be there now
    for number in range(-(-fault.required // fault.batch)):
        start = time.perf_counter()
        part = parts(f"batch {number}", partial(run_batch, fault, number))
        tally = Tally.from_dict(part["tally"])
        text = tally.skipped or f"{tally.trials} trials, {tally.bad or 'nothing'} bad"
        print(f"{name}, batch {number}: {text}, {time.perf_counter() - start:.0f} s", flush=True)
        if tally.skipped:
            return


def run_short(name: str) -> bool:
    """Run a few trials of a class and return whether none is bad."""
    start = time.perf_counter()
    tally = CLASSES[name].run(CLASSES[name].short, 0)
    text = tally.skipped or f"{tally.trials} trials, {tally.bad or 'nothing'} bad"
    print(f"{name}: {text}, {time.perf_counter() - start:.0f} s", flush=True)
    for example in tally.examples.values():
        print(f"  {example[0]}", flush=True)
    return not tally.bad


def collect(name: str) -> dict[str, Any]:
    """Return the row of a class from its finished batches."""
    parts = stored_parts(name).state["done"].values()
    joint = Tally(name)
    for part in parts:
        joint.merge(Tally.from_dict(part["tally"]))
    dates, commits = ({part[key] for part in parts} for key in ("date", "commit"))
    row = joint.to_dict() | {"required": CLASSES[name].required}
    return row | {"date": max(dates, default=""), "commits": sorted(commits)}


def main() -> int:
    """Run the classes that are selected, or all, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", default=[""], help="starts of names of classes")
    parser.add_argument("--table", action="store_true", help="only write the table")
    parser.add_argument("--short", action="store_true", help="a few trials of each class")
    options = parser.parse_args()
    names = [name for name in CLASSES if name.startswith(tuple(options.only))]
    if not names:
        parser.error(f"--only must be the start of a class, got {options.only}: {list(CLASSES)}")
    if options.short:
        return int(not all([run_short(name) for name in names]))
    if not options.table:
        for name in names:
            run_class(name)
    rows = [collect(name) for name in CLASSES]
    page.write_table(rows)
    bad = {row["name"]: Tally.from_dict(row).bad for row in rows}
    for name, counts in bad.items():
        if counts:
            print(f"{name}: {counts}")
    return int(any(bad.values()))


if __name__ == "__main__":
    sys.exit(main())
