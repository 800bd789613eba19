"""Measure the times per step of a published study by turns: `python benchmarks/study_times.py STUDY FOLDER [--write]`.

The filters of a world with one number of particles are built once, take their first steps uncounted, and take turns in
five rounds, as in `pfbench cost`, without the runs of the study. A table of each world and number goes to FOLDER, so that the
command can be stopped and repeated. `--write` puts them into runs.parquet, where times of other filters go, and makes
the page again. The times are those of the present version on this machine.
"""

from __future__ import annotations

import json
import math
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pfbench.files import RecordedFolder
from pfbench.job import build_plan, compose
from pfbench.job.budget import EpisodeSource, max_runs_in_memory
from pfbench.job.filter_pass import choose_engine, wrap_steps
from pfbench.job.memory import first_steps
from pfbench.job.plan import describe_commit
from pfbench.job.step_timing import TimingTask
from pfbench.report import RUNS_FILE, format_runs, read_stored_study, rebuild_page
from pfbench.results.step_times import StepTimes

TOP = Path(__file__).parents[1]
ROUNDS = 5
MEAN_TIME = 0.1  # s, of a filter in a round
FEWEST_STEPS = 10
KEYS = ["scenario", "regime", "level"]
Cells = dict[str, dict[str, Any]]


def list_cells(table: pd.DataFrame) -> pd.DataFrame:
    """List the filters of a study in each world, a row each, with the number of particles that they take turns at."""
    cells = table.drop_duplicates(["scenario", "regime", "filter"]).copy()
    named = cells["filter"].astype(str).str.extract(r"particles=(\d+)")[0].astype(float)
    cells["level"] = named.fillna(100.0)
    cells.loc[cells["filter"].astype(str).str.contains("budget=time"), "level"] = 0.0
    runs = table.groupby(["scenario", "regime", "filter"], observed=True)["run"].nunique()
    cells["runs"] = [runs[tuple(key)] for key in cells[["scenario", "regime", "filter"]].to_numpy()]
    return cells


def build_tasks(study: str, rows: pd.DataFrame) -> dict[str, TimingTask]:
    """Build the filters of a world, which share its episodes, with as many steps as last `MEAN_TIME` on average."""
    built: dict[str, tuple[Any, Any, int]] = {}
    source = None
    for row in rows.itertuples():
        number = [f"particles={int(row.particles)}"] if math.isfinite(row.particles) else []
        name = re.sub(r"\[.*", "", str(row.filter))
        plan = build_plan(compose([
            f"+experiment={study}", f"scenario={row.scenario}", f"noise={row.regime}", f"filter={name}",
            f"seed={row.seed}", f"runs={row.runs}", *number,
        ]))  # fmt: skip
        source = source or EpisodeSource(plan)
        size = max_runs_in_memory(plan, source)
        built[str(row.filter)] = plan, source.batch(0, size), size
    mean = float(rows["ms"].mean()) / 1e3
    steps = max(FEWEST_STEPS, math.ceil(MEAN_TIME / mean)) if mean > 0 else 50
    tasks = {}
    for label, (plan, episode, size) in built.items():
        model = plan.make_filter_model(episode)
        part = first_steps(model, episode.record, min(steps, episode.record.y.shape[1]))
        engine = choose_engine(plan.values["engine"], plan.method, model, size, part.y.shape[1])
        method = wrap_steps(engine, plan.method) or plan.method
        tasks[label] = TimingTask(plan, model, part, engine, method)
    return tasks


def time_tasks(tasks: dict[str, TimingTask]) -> dict[str, list[float]]:
    """Time filters by turns. The first filter of a round is another one each time.

    Returns processor times per step of all runs by round, s.
    """
    for task in tasks.values():
        task.measure()
    times: dict[str, list[float]] = {label: [] for label in tasks}
    for number in range(ROUNDS):
        for k in range(len(tasks)):
            label = list(tasks)[(k + number) % len(tasks)]
            times[label].append(tasks[label].measure()[0])
    return times


def measure(study: str, folder: Path) -> None:
    """Measure all worlds of a study that are not in the folder, those of few particles first."""
    cells = list_cells(read_stored_study(TOP / "reports" / study, decides=False).table)
    order = cells.groupby(KEYS, observed=True).size().index.to_frame(index=False)
    for key in order.sort_values(["level", "scenario"]).itertuples(index=False, name=None):
        scenario, regime, level = key
        path = folder / f"{scenario}-{regime}-{level:g}.json"
        if not path.exists():
            rows = cells[(cells[KEYS] == list(key)).all(axis=1)]
            entry = {
                **dict(zip(KEYS, key, strict=True)),
                "commit": describe_commit(TOP),
                "times": time_tasks(build_tasks(study, rows)),
            }
            path.write_text(json.dumps(entry))
        print(path.name, flush=True)


def write(study: str, folder: Path) -> None:
    """Put the measured times into the runs of a study, and make its page again."""
    place = TOP / "reports" / study
    pack, table = read_stored_study(place)
    entries = [json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))]
    if not entries:
        sys.exit(f"{folder} must hold measured times, got none. Leave out --write first.")
    table["ms"] = np.nan
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for entry in entries:
        world = entry["scenario"], entry["regime"]
        group = "-".join((*world, f"{entry['level']:g}"))
        for label, seconds in entry["times"].items():
            times = StepTimes(np.array(seconds), group)
            found.setdefault(world, {})[label] = {"seconds": seconds, "group": group}
            is_cell = (table[["scenario", "regime", "filter"]] == [*world, label]).all(axis=1)
            table.loc[is_cell, "ms"] = 1e3 * times.to_metadata()["median"]
    pack["facts"]["times"] = [[*world, times] for world, times in found.items()]
    with RecordedFolder(place, is_complete=False) as target:
        target.write(RUNS_FILE, format_runs(table, pack))
    rebuild_page(place)


if __name__ == "__main__":
    STUDY, FOLDER = sys.argv[1], Path(sys.argv[2])
    FOLDER.mkdir(parents=True, exist_ok=True)
    write(STUDY, FOLDER) if "--write" in sys.argv else measure(STUDY, FOLDER)
