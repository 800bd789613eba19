"""Run all published studies, cheapest first: `make studies`.

Each study is a sweep that resumes: finished jobs are skipped, so the command can be stopped and repeated. Progress
is printed per study. `experiments/analyses/study_costs.json` has the computing time of each study in seconds on one core: measured
from its results where it has run, else estimated from the times per step of its published report.

    python experiments/analyses/run_studies.py                 all studies
    python experiments/analyses/run_studies.py --hours=2       only studies that end within 2 hours of computing time
    python experiments/analyses/run_studies.py paper_003       these studies
    python experiments/analyses/run_studies.py --list          the plan, without a run
    python experiments/analyses/run_studies.py --cost          only `pfbench cost` of the studies that have results
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import yaml

from pfbench.results import read_metadata

TOP = Path(__file__).parents[2]
COSTS = Path(__file__).with_name("study_costs.json")
_PARTS = ("world", "pcrb", "scores", "filter")  # of the seconds of a job
_OPTIONS = ("--hours=", "--list", "--cost")
LEARNED = "neural_ckf"  # the filter whose network a study named learned_* trains first


def list_studies() -> list[str]:
    """List the published studies that are experiments in YAML: those whose cost is stored."""
    names = {path.stem for path in (TOP / "experiments").glob("*.yaml")}
    return sorted(names & set(read_costs()))


def read_costs() -> dict[str, float]:
    """Read the computing time of each study, s."""
    return dict(json.loads(COSTS.read_text()))


def measure_cost(study: str, results: Path) -> float:
    """Sum the computing time of the jobs of a study, s; 0 without results.

    Args:
        study: Name of the study.
        results: Folder of all studies.
    """
    metas = (read_metadata(path) for path in sorted((results / study).glob("*.npz")))
    return float(sum(meta["seconds"].get(part, 0.0) for meta in metas for part in _PARTS))


def plan_studies(
    studies: Sequence[str], costs: Mapping[str, float], hours: float = float("inf")
) -> list[str]:
    """Order studies by computing time, and leave out those that exceed a limit together.

    Args:
        studies: Names.
        costs: Computing time of each study, s. A study without one comes last.
        hours: Limit of the sum, h.
    """
    plan, total = [], 0.0
    for study in sorted(studies, key=lambda name: (costs.get(name, float("inf")), name)):
        total += costs.get(study, 0.0)
        if total <= 3600 * hours:
            plan.append(study)
    return plan


def list_experiments(study: str) -> list[str]:
    """List the experiments of a study: that of its name, and others that name it."""
    files = sorted((TOP / "experiments").glob(f"{study}_*.yaml"))
    others = [path.stem for path in files if yaml.safe_load(path.read_text())["study"] == study]
    return [study, *others]


def run_study(study: str, results: Path) -> int:
    """Train the network of a study that needs one, run the sweeps, and return the exit code.

    Args:
        study: Name of the study.
        results: Folder of all studies.
    """
    commands = [["run", "-m", f"+experiment={name}"] for name in list_experiments(study)]
    if study.startswith("learned_") and not (results / study / "network.pt").exists():
        words = [f"+experiment={study}", f"filter={LEARNED}", "checkpoint=null"]
        commands.insert(0, ["train", *words])
    codes = []
    for words in commands:
        command = [sys.executable, "-m", "pfbench", *words]
        codes.append(subprocess.run(command, cwd=TOP, check=False).returncode)
        if codes[-1] and words[0] == "train":
            break
    return max(codes)


def measure_step_times(study: str) -> int:
    """Measure the times per step of the filters of a study in turn, and return the exit code.

    Args:
        study: Name of the study.
    """
    print(f"cost of {study}", flush=True)
    words = [sys.executable, "-m", "pfbench", "cost", f"study={study}"]
    return subprocess.run(words, cwd=TOP, check=False).returncode


def main(words: Sequence[str]) -> int:
    """Run the planned studies and return 1 if one of them failed."""
    if unknown := [w for w in words if w.startswith("-") and not w.startswith(_OPTIONS)]:
        print(__doc__ if unknown[0] in ("-h", "--help") else f"unknown option {unknown[0]}. See --help.")  # fmt: skip
        return 2 * (unknown[0] not in ("-h", "--help"))
    costs = read_costs()
    hours = [float(word.partition("=")[2]) for word in words if word.startswith("--hours=")]
    names = [word for word in words if not word.startswith("--")]
    results = TOP / os.environ.get("PFBENCH_RESULTS", "results")
    plan = plan_studies(names or list_studies(), costs, *hours)
    if "--cost" in words:
        plan = [study for study in plan if any((results / study).glob("*.npz"))]
        failed = [study for study in plan if measure_step_times(study)]
        print(f"failed: {', '.join(failed)}" if failed else f"{len(plan)} studies measured")
        return int(bool(failed))
    rest = sum(costs.get(study, 0.0) for study in plan)
    print(f"{len(plan)} studies, {rest / 3600:.1f} h of computing time on one core")
    if "--list" in words:
        print("\n".join(f"{costs.get(study, float('nan')):8.0f} s  {study}" for study in plan))
        return 0
    failed = []
    for number, study in enumerate(plan, start=1):
        print(f"[{number}/{len(plan)}] {study}, {rest / 3600:.1f} h left", flush=True)
        start = time.monotonic()
        code = run_study(study, results)
        rest -= costs.get(study, 0.0)
        failed += [study] if code else []
        if code == 0:
            code = measure_step_times(study)
            costs[study] = round(measure_cost(study, results), 1)
            COSTS.write_text(json.dumps(dict(sorted(costs.items())), indent=1) + "\n")
        print(f"[{number}/{len(plan)}] {study}: exit code {code}, {time.monotonic() - start:.0f} s")
    print(f"failed: {', '.join(failed)}" if failed else "all studies finished")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
