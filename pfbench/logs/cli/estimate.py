"""Command `pfbench estimate`: the track of an own log without a reference, as tables, GPX and KML."""

from __future__ import annotations

from collections.abc import Sequence

from pfbench.cli.current_folder import add_search_path
from pfbench.logs.cli.inspect import split_folder

HELP = """\
pfbench estimate FOLDER [filter=NAME,...] [key=value ...]

Estimate the track of an own log without a reference (docs/use_your_data.md). The folder has the tables imu and gnss.
Level and heading at the start come from the specific force and the course of the fixes. In place of errors the
command prints distances to held-out fixes, innovations, and how far filters are apart. It writes
reports/estimate_NAME/ with a page, a table of each track, and track.gpx and track.kml.

  pfbench estimate my_log
  pfbench estimate my_log filter=ekf,student scenario.alignment.heading_deg=30

  filter=NAME,...                    filters, the answer is that of the first one (ekf,ukf)
  scenario.KEY=VALUE ...             keys of scenario=user_log_aligned
  scenario=NAME                      a variant of it, such as one with noise numbers of pfbench infer
  particles=N seed=N ...             other keys of pfbench run
  reports_dir=FOLDER                 folder of reports (reports)"""

_OWN = ("filter", "reports_dir")


def estimate_log(words: Sequence[str]) -> None:
    """Estimate the track of a log, and write its page and files."""
    folder, pairs = split_folder(words, "estimate")
    options = {key: value for key, _, value in (w.partition("=") for w in pairs) if key in _OWN}
    others = [word for word in pairs if word.partition("=")[0] not in _OWN]
    from pfbench.job import estimate_track
    from pfbench.logs.judge.track_page import describe_track, write_track_page

    names = [name for name in options.get("filter", "ekf,ukf").strip("[]").split(",") if name]
    estimate = estimate_track(folder, names, add_search_path(others))
    page = write_track_page(estimate, options.get("reports_dir", "reports"))
    print("\n".join(describe_track(estimate)))
    print(f"report: {page.resolve()}")
