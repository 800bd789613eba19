"""Command `pfbench datasheet`: write the datasheet of a scenario."""

from __future__ import annotations

from collections.abc import Sequence

from pfbench.cli.command import Command
from pfbench.cli.compose import given_keys, read_description
from pfbench.job.config import compose
from pfbench.results.paper_block import read_part


def report_scenario(words: Sequence[str]) -> None:
    """Write the datasheet of a scenario."""
    from pfbench.job.datasheet_data import RUNS, build_datasheet
    from pfbench.report.datasheet import write_datasheet

    config = compose(words if "runs" in given_keys(words) else [*words, f"runs={RUNS}"])
    data = build_datasheet(
        config, read_description(read_part("scenario", config.choices["scenario"]))
    )
    page = write_datasheet(
        data, config.values["reports_dir"], tuple(config.values["report"]["figure_formats"])
    )
    print(f"datasheet: {page.resolve()}")


COMMAND = Command(
    report_scenario,
    """\
pfbench datasheet scenario=NAME [noise=NAME] [runs=20] [key=value ...]

Write the datasheet of a scenario: trajectory, sensors, measurements and truth of its episodes.

  pfbench datasheet scenario=flight_300s
  pfbench datasheet scenario=flight_300s noise=outliers runs=50
  pfbench list scenario      scenarios""",
    required=("scenario",),
)
