"""Damaged logs of recorded flights: the mutations of tests/logs/worlds/mutations.py."""

import importlib
import sys
from types import ModuleType

from checkout import TESTS

from faults.tally import FINE, Tally

READERS = ("log_csv", "log_parquet", "rinex2", "rinex3", "ephemeris", "trajectory", "pseudorange", "urban")  # fmt: skip

_ORBIT = "The orbit remains a possible one, and its neighbours change alike."
REASONS = {  # why a file alone does not show a change of a column in all rows, by class and columns
    ("damaged logs: trajectory", "pd"): (
        "The drive is level, so that no other column depends on its height."
    ),
    ("damaged logs: ephemeris", "cuc, cus"): _ORBIT,
    ("damaged logs: ephemeris", "e"): _ORBIT,
    ("damaged logs: ephemeris", "omega"): _ORBIT,
    ("damaged logs: pseudorange", "t"): (
        "Three times all epochs after one are 0.5 s late. Once all times are multiplied by 3.6. No other column "
        "states the interval of the epochs."
    ),
}


def load_mutations() -> ModuleType:
    """Import the module of the mutations, which lies beside the tests of the readers."""
    folder = str(TESTS / "logs" / "worlds")
    if folder not in sys.path:
        sys.path.append(folder)
    return importlib.import_module("mutations")


def run(reader: str, count: int, seed: int) -> Tally:
    """Mutate the files of a reader `count` times."""
    tally, module = Tally(f"damaged logs: {reader}"), load_mutations()
    if reader not in module.READERS:
        tally.skipped = "not run: PFBENCH_DATA is not set"
        return tally
    for text, number in module.run_mutations(reader, count, seed).items():
        outcome, remark = class_of(module, text)
        for _ in range(number):
            tally.add(outcome, remark, f"batch {seed}, {text}")
    return tally


def class_of(module: ModuleType, text: str) -> tuple[str, str]:
    """Return outcome and remark of an outcome of `run_mutations`, which may end with an example."""
    if text.startswith(f"{module.EVERY_ROW}: "):
        return "false", text  # with its columns
    for word, outcome in (
        (module.SILENT, "false"),
        (module.UNWRAPPED, "unclear"),
        (module.ERROR, FINE),
        (module.CLOSE, FINE),
        (module.NOTED, FINE),
    ):
        if text == word or text.startswith(f"{word}:"):
            return outcome, word
    raise ValueError(f"the outcome must be a word of {module.__name__}, got {text}. Add it here.")
