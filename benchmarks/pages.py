"""How long a report takes: 7 filters in 8 cells, 100 runs each. Writes pages.md.

    python benchmarks/pages.py [--runs 100] [--keep FOLDER]

The results are real ones, of a linear walk under eight noise regimes; the page is written as users get it, by the command
line, with all figures, tables and tests.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from race import cpu_name

HERE = Path(__file__).parent
FILTERS = ("ekf", "ukf", "ckf", "sir", "apf", "rpf", "gpf")
NOISES = (
    "nominal",
    "paper_bursts",
    "outliers",
    "student",
    "laplace",
    "mixture",
    "bias_step",
    "gauss_markov",
)
LIMIT = 60.0  # seconds


def command(*words: str) -> float:
    """Runs pfbench on one thread; returns the seconds that it took."""
    begun = time.perf_counter()
    env = {**os.environ, "OMP_NUM_THREADS": "1"}
    subprocess.run(
        [sys.executable, "-m", "pfbench", *words], check=True, stdout=subprocess.DEVNULL, env=env
    )
    return time.perf_counter() - begun


def measured(folder: Path, runs: int) -> tuple[float, float, int, float]:
    """Seconds of the study and of its report; figures of the page, and its size in MB."""
    places = f"results_dir={folder}/results", f"episode_cache_dir={folder}/worlds"
    sweep = f"filter={','.join(FILTERS)}", f"noise={','.join(NOISES)}"
    study = command(
        "run",
        "-m",
        "study=pages",
        "scenario=linear_walk",
        f"runs={runs}",
        "particles=100",
        *sweep,
        *places,
    )
    report = command("report", "study=pages", places[0], f"reports_dir={folder}/reports")
    page = folder / "reports" / "pages" / "index.html"
    return (
        study,
        report,
        len(list((page.parent / "figures").glob("*.svg"))),
        page.stat().st_size / 1e6,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument(
        "--keep", type=Path, help="a folder for results and page, which are otherwise thrown away"
    )
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        study, report, figures, size = measured(given.keep or Path(scratch), given.runs)
    cells = f"{len(FILTERS)} filters, {len(NOISES)} cells, {given.runs} runs"
    text = (
        "# How long a report takes\n\n"
        f"Made by `python benchmarks/pages.py` on {cpu_name()}, one thread, wall time.\n\n"
        "| what | seconds |\n|---|---|\n"
        f"| study: {cells} of linear_walk, 100 particles | {study:.0f} |\n"
        f"| its report: {figures} figures as SVG and as PNG, tables, tests, a page of {size:.1f} MB | {report:.0f} |\n\n"
        f"To be had: a report of this size in less than {LIMIT:.0f} s. It {'is' if report < LIMIT else 'is not'}.\n"
    )
    (HERE / "pages.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
