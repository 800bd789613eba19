"""Reader of results of pfbench: the estimate is the track of the truth plus the error."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pfbench.judge.judge_options import SourceOptions
from pfbench.judge.readers.trajectory_table import LOCAL, POSITION_SD, TrajectoryTable
from pfbench.results.store import DamagedResultError, JobResult, read_result

_AXES = ("position_E", "position_N", "position_U")


def read_result_trajectories(file: Path, options: SourceOptions) -> list[TrajectoryTable]:
    """Read the runs of a job whose scenario states the track of the truth.

    Args:
        file: Result `<key>.npz`.
        options: Options.

    Returns:
        One table per run. A lost run has the epochs before its loss.

    Raises:
        ValueError: If the file is damaged, or states no track or no position in East, North, Up.
    """
    try:
        result = read_result(file)
    except DamagedResultError:
        raise ValueError(
            f"{file.name} must be a result of pfbench, got a file that is damaged or of another format. "
            "Run the job again."
        ) from None
    names = list(result.meta["state"]["names"])
    if "track" not in result.data or not set(_AXES) <= set(names):
        raise ValueError(
            f"{file.name} must have the track of the truth and the states {', '.join(_AXES)}, got "
            f"{', '.join(names[:9])}. Use a result of a recorded or simulated flight."
        )
    places = [names.index(name) for name in _AXES]
    return [_run_table(file, result, places, run) for run in range(len(result.data["lost"]))]


def _run_table(file: Path, result: JobResult, places: list[int], run: int) -> TrajectoryTable:
    data = result.data
    error, sd = (data[name][run][:, places].astype(np.float64) for name in ("error", "sd"))
    track = data["track"][run].astype(np.float64)
    east, north, up = (track + error).T
    values = dict(zip(LOCAL, (north, east, -up), strict=True))
    values |= dict(zip(POSITION_SD, sd[:, [1, 0, 2]].T, strict=True))
    number = int(data["run"][run]) if "run" in data else int(result.meta.get("first_run", 0)) + run
    time = data["time"].astype(np.float64)
    used = np.isfinite(np.stack(list(values.values()))).all(axis=0)
    notes = (
        (f"{int((~used).sum())} steps without a finite estimate or truth",)
        if not used.all()
        else ()
    )
    lines, truth = np.arange(1, len(time) + 1), track[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
    table = TrajectoryTable(file.name, time, values, lines, notes, number, truth=truth)
    return table.keep_rows(used)
