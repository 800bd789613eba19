"""A study of another person, all of whose texts are hostile, and its report."""

from pathlib import Path
from typing import Any
from unittest import mock

import synthetic_results as synthetic
from escape_cases import HOSTILE

from pfbench.report import study_report
from pfbench.results import store

SHORT = "=<img src=x onerror=evil()>"  # names that are part of the names of files
UNIT = r"$\evil{$|<b>"  # texts in figures must leave space for the panels
LABEL = rf"={UNIT}<img src=x onerror=e()>"
STATE: dict[str, Any] = {
    "names": [f"{HOSTILE}{i}" for i in range(9)],
    "units": [UNIT] * 9,
    "groups": {"attitude": [0, 1, 2], SHORT: [3, 4, 5], "position": [6, 7, 8]},
}


def disguise(path: Path) -> None:
    """Replace all texts of a result by the hostile one."""
    meta, data = store.read_result(path)
    versions = {"pfbench": HOSTILE, "commit": "```\n# a"}
    choices = {**meta["choices"], "noise": f"{SHORT}\n\n# b", "scenario": SHORT}
    texts = {"host": HOSTILE, "modelling_choices": [HOSTILE, f"# {HOSTILE}"], "state": STATE}
    full = {**meta, **texts, "choices": choices, "versions": {**meta["versions"], **versions}}
    store.write_result(path, full, data)


def write_hostile_report(folder: Path) -> Path:
    """Write a study whose texts are hostile and return the folder of its report."""
    results = folder / "results" / "demo"
    with mock.patch.object(synthetic, "STATE", STATE):
        for size, name in enumerate((f"{LABEL}1", f"{LABEL}2", "sir[a=1]"), 1):
            method = synthetic.Method(name, float(size), particles=20)
            disguise(synthetic.write(results, method, runs=8, steps=20))
    broken = {"scenario": HOSTILE, "noise": HOSTILE, "filter": HOSTILE, "model": HOSTILE}
    store.write_failure(results / "00000000deadbeef.npz", broken, ValueError(f"{HOSTILE}\n# c"))
    options = study_report.ReportOptions(figure_formats=("svg",))
    return study_report.write_report("demo", results.parent, folder / "reports", options).parent
