"""Command `pfbench estimate`: estimate the track of an own log without a reference."""

from __future__ import annotations

from collections.abc import Sequence

from pfbench.cli.command import Command, Option, read_list
from pfbench.core.parameter_checks import require


def estimate_log(words: Sequence[str], filter: list[str], reports_dir: str) -> None:  # noqa: A002
    """Estimate the track of a log, and write its page and files."""
    folders = [word for word in words if "=" not in word]
    got = " ".join(folders) or "none"
    require(len(folders) == 1, "estimate", "have one folder", got, "Use: pfbench estimate my_log")
    from pfbench.job import estimate_track
    from pfbench.logs.judge.track_page import describe_track, write_track_page

    estimate = estimate_track(folders[0], filter, [word for word in words if "=" in word])
    page = write_track_page(estimate, reports_dir)
    print("\n".join(describe_track(estimate)))
    print(f"report: {page.resolve()}")


def _read_filters(key: str, text: str, remedy: str) -> list[str]:
    """Read names of filters, perhaps in brackets."""
    return read_list(key, text.strip("[]"), remedy)


COMMAND = Command(
    estimate_log,
    """\
pfbench estimate FOLDER [filter=NAME,...] [key=value ...]

Estimate the track of an own log without a reference (docs/use_your_data.md). The folder has the tables imu and gnss.
Level and heading at the start come from the specific force and the course of the fixes. In place of errors the
command prints distances to held-out fixes, innovations, and how far filters are apart. It writes
reports/estimate_NAME/ with a page, a table of each track, and track.gpx and track.kml.

  pfbench estimate my_log
  pfbench estimate my_log filter=ekf,student scenario.alignment.heading_deg=30

  OPTIONS
  scenario.KEY=VALUE ...             keys of scenario=user_log_aligned
  scenario=NAME                      a variant of it, such as one with noise numbers of pfbench infer
  particles=N seed=N ...             other keys of pfbench run""",
    options={
        "filter": Option("ekf,ukf", "filters, the answer is that of the first one", _read_filters),
        "reports_dir": Option("reports", "folder of reports"),
    },
)
