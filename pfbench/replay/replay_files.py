"""Files of a replay: traces as CSV and Parquet, and a figure."""

from __future__ import annotations

import io
from importlib.util import find_spec
from pathlib import Path

from pfbench.files.escapes import escape_csv
from pfbench.files.recorded_folder import RecordedFolder
from pfbench.replay.run_selection import StoredRun
from pfbench.replay.traces import plot_traces, tabulate_traces
from pfbench.report.plots.figure_files import FigureSpec, draw_figure
from pfbench.report.plots.plotting import format_slug
from pfbench.results import store
from pfbench.results.frame import to_long_rows
from pfbench.results.status import count_statuses

_FIGURE = "traces"


def write_replay(stored: StoredRun, result: store.JobResult, reports: str | Path) -> list[Path]:
    """Write the files of a replay to `<reports>/<study>/replay/<condition>_<filter>_run_<number>/`.

    Args:
        stored: Run.
        result: The run computed again, scored at all steps.
        reports: Folder of all reports.

    Returns:
        traces.csv, traces.parquet if pyarrow is installed, and traces.svg.
    """
    condition, job = stored.condition, stored.job
    names = (condition.scenario, condition.noise, condition.model, job.label)
    name = format_slug(f"{'_'.join(names)}_run_{stored.run}")
    folder = Path(reports) / str(result.meta["study"]) / "replay" / name
    table = tabulate_traces(result)
    drawing = FigureSpec(_FIGURE, "", lambda: plot_traces(result))
    with RecordedFolder(folder) as target:
        paths = [target.write("traces.csv", table.rename(columns=escape_csv).to_csv(index=False))]
        if find_spec("pyarrow"):
            buffer = io.BytesIO()
            table.to_parquet(buffer, index=False)
            paths.append(target.write("traces.parquet", buffer.getvalue()))
        figure = draw_figure(drawing, ("svg",))["svg"]
        paths.append(target.write(f"{_FIGURE}.svg", figure))
    return paths


def tabulate_metrics(
    stored: StoredRun, replayed: store.JobResult
) -> list[tuple[str, float, float, str]]:
    """List the metrics of a run, as stored and as computed again.

    Args:
        stored: Run.
        replayed: The run computed again, with scores at the stored steps.

    Returns:
        Name, stored value, new value and unit: errors of each group, and metrics of the filter.
    """
    old, new = (
        to_long_rows(stored.condition, stored.job, result, 0.0, {})
        for result in (stored.result, replayed)
    )
    rows = []
    both = new.merge(old, on=["metric", "group", "component"], suffixes=("", "_stored"))
    for row in both.to_dict("records"):
        is_error = row["metric"] in ("rmse", "max_error") and row["component"] == "norm"
        if (is_error or not row["group"]) and row["metric"] != "seconds_per_step":
            name = f"{row['metric']} {row['group']}".strip()
            rows.append((name, float(row["value_stored"]), float(row["value"]), str(row["unit"])))
    return rows


def describe_status(result: store.JobResult) -> str:
    """Describe the status of a run, such as "track kept, overconfident".

    Args:
        result: Result with one run.
    """
    count = count_statuses(result.data, result.meta)
    words = {
        "lost": count.lost,
        "diverged": count.diverged or 0,
        "collapsed": count.collapsed,
        "severely overconfident": count.severely_overconfident,
        "overconfident": count.overconfident and not count.severely_overconfident,
        **count.marked,
    }
    present = [word for word, number in words.items() if number]
    if count.lost or count.diverged:
        return ", ".join(present)
    ending = "no divergence threshold" if count.diverged is None else "track kept"
    return ", ".join([ending, *present])
