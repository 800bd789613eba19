"""Damaged logs of recorded flights: the mutations of tests/scenario/recorded, where a module offers them.

A module of that folder may define `run_mutations(reader, count, seed)` and `READERS`, names of readers. It returns the
number of mutated logs by outcome. Its words for bad outcomes begin with `SILENT` and `UNWRAPPED`.
"""

from __future__ import annotations

import importlib.util
from types import ModuleType

from checkout import TESTS

from faults.tally import FINE, Tally

FOLDER = TESTS / "scenario" / "recorded"


def find_mutations() -> ModuleType | None:
    """Import the module that offers `run_mutations` and `READERS`; None if no module does."""
    for file in sorted(FOLDER.glob("*.py")):
        if "def run_mutations(" in file.read_text() and not file.name.startswith("test_"):
            spec = importlib.util.spec_from_file_location(file.stem, file)
            if spec is None or spec.loader is None:
                raise ImportError(f"{file} must be a module that Python can import. Check it.")
            module = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
            if hasattr(module, "READERS"):
                return module
    return None


def run(count: int, seed: int) -> Tally:
    """Mutate the logs of all readers, `count` mutations in all."""
    tally, module = Tally("damaged logs"), find_mutations()
    if module is None:
        tally.skipped = "not run"
        return tally
    for reader in module.READERS:
        counts = module.run_mutations(reader, count // len(module.READERS), seed)
        for text, number in counts.items():
            outcome, remark = class_of(module, text)
            for _ in range(number):
                tally.add(outcome, f"{reader}: {remark}", text)
    return tally


def class_of(module: ModuleType, text: str) -> tuple[str, str]:
    """Return outcome and remark of an outcome of `run_mutations`, which may end with an example."""
    for word, outcome in (
        (module.SILENT, "false"),
        (module.EVERY_ROW, "false"),
        (module.UNWRAPPED, "unclear"),
        (module.ERROR, FINE),
        (module.CLOSE, FINE),
        (module.NOTED, FINE),
    ):
        if text == word or text.startswith(f"{word}:"):
            return outcome, word
    raise ValueError(f"the outcome must be a word of {module.__name__}, got {text}. Add it here.")
