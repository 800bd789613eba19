"""A study in Python: its tables, decisions, figures and pages, read from the files of the command line."""

from __future__ import annotations

import math
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pfbench.cli.compose import choose_places
from pfbench.cli.messages import require_choice
from pfbench.cli.progress import StudyState, format_repeat, read_state
from pfbench.cli.report import PAPER_COMMAND, check_has_results
from pfbench.door.parts import format_words, plain_errors
from pfbench.job.config import compose
from pfbench.job.trust import trusted_packages, trusting
from pfbench.report.options import ReportOptions
from pfbench.results.conditions import Condition, load_conditions

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

    from pfbench.door.comparisons import Comparison, Summary
    from pfbench.report.published_study import PublishedComparison


@dataclass(frozen=True)
class Study:
    """Results of a study. All is read when it is asked for, so that results of later runs count.

    Attributes:
        name: Name.
        results: Folder of all results.
        reports: Folder of all reports.
        trust: Packages that define classes of the user, for `replay` and `more`.
    """

    name: str
    results: str = "results"
    reports: str = "reports"
    trust: tuple[str, ...] = ()

    @plain_errors()
    def table(self, metric: str | None = None) -> pd.DataFrame:
        """Load the results as one table.

        Args:
            metric: Metric whose rows are selected. None for all.

        Returns:
            A row per job, run, component and metric, as `pfbench.load` returns.
        """
        from pfbench.results.frame import load_frame

        frame = load_frame(self.name, self.results)
        names = sorted(frame["metric"].unique())
        if metric is None:
            return frame
        require_choice("metric", metric, names, "Leave it out for all.")
        return frame[frame["metric"] == metric].reset_index(drop=True)

    def errors(self, group: str | None = None) -> pd.DataFrame:
        """Return the root mean square error over time, a row per run and a column per filter.

        A run that a filter loses is infinite, as in all comparisons; `table("rmse")` has its error.

        Args:
            group: Group of the state. The main group by default.

        Returns:
            Errors in displayed units: arcmin for rad, deg/h for rad/s, mg for m/s^2, else those of the model.
            `attrs["unit"]` names that of each scenario. Rows of several conditions have their names in the index.
        """
        from pfbench.results.frame import list_main_groups

        frame = self.table("rmse")
        mains = list_main_groups(self.conditions())
        names = sorted(set(frame["group"]))
        if group is not None:
            require_choice("group", group, names, "Leave it out for the main group.")
        selected = [
            group or mains[key]
            for key in zip(frame["scenario"], frame["noise"], frame["model"], strict=True)
        ]
        rows = frame[(frame["group"] == selected) & (frame["component"] == "norm")]
        rows = rows.assign(value=rows["value"].where(rows["keeps_track"], math.inf))
        index = [n for n in ("scenario", "noise", "model") if rows[n].nunique() > 1]
        table = rows.pivot_table("value", [*index, "run"], "label", observed=True)
        table.attrs["unit"] = dict(zip(rows["scenario"], rows["unit"], strict=True))
        return table

    @plain_errors()
    def summary(self, **options: Any) -> Summary:
        """Summarise the study as the first view of its report.

        Args:
            **options: Options of a report, such as `baseline="ekf"`.

        Returns:
            Sentence, leaderboard and failed jobs, as text and in a notebook as tables.
        """
        from pfbench.door.comparisons import summarise_study

        has_results = any((Path(self.results) / self.name).glob("*.npz"))
        failures = self.failed()
        conditions = self.conditions() if has_results or not failures else []
        return summarise_study(self.name, conditions, failures, options)

    @plain_errors()
    def compare(self, a: str, b: str) -> Comparison:
        """Compare two filters in the runs that both have, as all pages do.

        Args:
            a: Label of the first filter.
            b: Label of the second filter.

        Returns:
            A verdict for each condition, corrected for their number.
        """
        from pfbench.door.comparisons import compare_in_conditions

        return compare_in_conditions(self.conditions(), a, b)

    @plain_errors()
    def against(self, published: str | Path) -> PublishedComparison:
        """Compare the filters of this study with all filters of a published one, which do not run again.

        A filter of the published study runs here, too, in each world: its errors must agree, else the worlds differ.

        Args:
            published: Name of a report, such as `"all_seven"`, or the folder of its `runs.parquet`.

        Returns:
            Verdicts by condition. Printed, each own filter has its counts and the strongest published filter.

        Raises:
            ValueError: If no world, seed and witness are shared.
        """
        from pfbench.report.published_study import compare_with_published, find_published

        folder = find_published(str(published), Path(self.reports))
        return compare_with_published(self.conditions(), folder)

    @plain_errors()
    def plot(self, kind: str = "cost", ax: Axes | None = None, **choice: Any) -> Axes:
        """Draw a figure in the looks of the report.

        Args:
            kind: cost (median error against time per step), time (error over time), calibration (coverage of 50 and 90 %
                intervals), or run (error of one run over time).
            ax: Axes to draw into. New ones by default.
            **choice: For a study of several conditions `scenario`, `noise` and `model`; for `run` also `run` and `filter`.

        Returns:
            The axes.
        """
        from pfbench.door.figures import draw_study

        return draw_study(self, kind, ax, choice)

    @plain_errors()
    def replay(self, label: str, run: int, **choice: str) -> pd.DataFrame:
        """Compute one stored run again with all its traces.

        Args:
            label: Label of the filter.
            run: Number of the run.
            **choice: scenario, noise and model, where the filter has results in several conditions.

        Returns:
            A row per step: time, error, standard deviation, NEES and traces such as the effective sample size.
        """
        from pfbench.door.running import check_trusted, preserved_process
        from pfbench.job.replay import find_run, recompute_run, tabulate_traces

        with preserved_process(), trusting(self.trust):
            stored = find_run(self.name, self.results, run, label, choice)
            check_trusted(stored.result.meta, trusted_packages())
            changes = choose_places(compose([]).values, ())
            return tabulate_traces(recompute_run(stored, changes))

    @plain_errors()
    def report(self, open: bool = False, **options: Any) -> Path:  # noqa: A002
        """Write the report.

        Args:
            open: Whether a browser shows it.
            **options: Options of a report, such as `figure_formats=("svg",)`.

        Returns:
            Path of index.html.
        """
        from pfbench.report import write_report

        path = write_report(self.name, self.results, self.reports, ReportOptions(**options))
        if open:
            webbrowser.open(path.resolve().as_uri())
        return path

    def paper(self, journal: str = "ieee", **settings: Any) -> list[Path]:
        """Write figures, tables and text for a journal, as `pfbench paper` does.

        Args:
            journal: Name of the page format.
            **settings: Words of `pfbench paper`.

        Returns:
            The files.
        """
        folder = Path(self.reports) / self.name / "paper"
        places = {"results_dir": self.results, "reports_dir": self.reports}
        words = format_words({"study": self.name, "journal": journal, **places, **settings})
        with plain_errors(words):
            PAPER_COMMAND(words)
        return sorted(path for path in folder.rglob("*") if path.is_file())

    def status(self) -> StudyState:
        """Return what is finished, failed and running, and the time left."""
        return read_state(Path(self.results) / self.name)

    def failed(self) -> list[dict[str, str]]:
        """List the failed jobs, each with its choices, its message, the command that repeats it and the file of its note."""
        folder = Path(self.results) / self.name
        return [
            {
                **note["choices"],
                "message": note["message"],
                "repeat": format_repeat(note),
                "note": str(folder / f"{note['key']}.failed.json"),
            }
            for note in self.status().failures
        ]

    @plain_errors()
    def more(self, runs: int, workers: int = 1, progress: bool = True) -> Study:
        """Add runs to all jobs. Their numbers continue those of the study.

        Args:
            runs: Number of runs to add.
            workers: Number of processes.
            progress: Whether each job prints a line.

        Returns:
            The study.
        """
        from pfbench.door.running import continue_jobs

        continue_jobs(self, runs, workers, progress)
        return self

    @plain_errors()
    def remove(self, label: str) -> Study:
        """Remove the results of a filter, such as one whose class has another name now. Other results stay as they are.

        Args:
            label: Label of the filter.

        Returns:
            The study.

        Raises:
            ValueError: If no result has this label.
        """
        from pfbench.results.store import remove_result

        jobs = [job for condition in self.conditions() for job in condition.jobs]
        labels = sorted({job.label for job in jobs})
        require_choice("label", label, labels, "List them: study.summary()")
        for job in jobs:
            for path in (job.parts or (job.path,)) if job.label == label else ():
                remove_result(path)
        return self

    @plain_errors()
    def to_xarray(self) -> Any:
        """Return errors, variances and traces as a data set of xarray.

        Returns:
            Variables with the axes condition, filter, run, time and state; attributes with unit, seed, version and key.
        """
        from pfbench.door.figures import make_dataset

        return make_dataset(self.conditions())

    @plain_errors()
    def conditions(self) -> list[Condition]:
        """Return the conditions of the study, whose filters have the same data."""
        return load_conditions(self.name, self.results)

    def __repr__(self) -> str:
        try:
            return f"study {self.name}\n\n{self.summary()!r}"
        except ValueError as error:
            return f"study {self.name} has no summary: {error}"

    def _repr_html_(self) -> str:
        return self.summary()._repr_html_()


@plain_errors()
def open_study(
    name: str, results: str = "results", reports: str = "reports", *, trust: tuple[str, ...] = ()
) -> Study:
    """Open a study that Python or the command line has run.

    Args:
        name: Name of the study.
        results: Folder of all results.
        reports: Folder of all reports.
        trust: Packages that define classes of the user, for `replay` and `more`.

    Returns:
        The study.

    Raises:
        ValueError: If it has neither results nor failed jobs.
    """
    if not isinstance(name, str):
        raise TypeError(
            f"study must be the name of a study, got {name!r}. List them: pfbench status"
        )
    study = Study(name, str(results), str(reports), tuple(trust))
    if not study.status().failures:
        check_has_results(name, Path(results))
    return study
