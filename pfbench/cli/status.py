"""Command `pfbench status`: print what is finished, failed and running, and the time left."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pfbench.cli.command import Command
from pfbench.cli.compose import given_keys
from pfbench.cli.progress import list_repeats, read_state
from pfbench.cli.report import NOT_STUDIES, check_has_results
from pfbench.job.config import compose
from pfbench.results.conditions import read_undamaged
from pfbench.results.inputs import describe_libraries


def report_status(words: Sequence[str]) -> None:
    """Print the state of all studies, or of one."""
    values = compose(words).values
    results = Path(values["results_dir"])
    if "study" in given_keys(words):
        _print_study(results / str(values["study"]))
        return
    folders = [path for path in results.glob("*") if path.is_dir() and path.name not in NOT_STUDIES]
    for state in sorted(map(read_state, folders), key=lambda state: -state.changed):
        print(state)
    if not folders:
        print(f"No study has results in {results}. Next: pfbench run -m +experiment=quickstart")


def _print_study(folder: Path) -> None:
    """Print the state of a study, and its failed jobs."""
    state = read_state(folder)
    if not (state.failures or state.running):
        check_has_results(folder.name, folder.parent)
    jobs = filter(None, map(read_undamaged, folder.glob("*.npz")))
    mixed = describe_libraries([meta for _, meta in jobs])
    print(state, *filter(None, [mixed]), *list_repeats(folder), sep="\n")


COMMAND = Command(
    report_status,
    """\
pfbench status [study=NAME] [results_dir=FOLDER]

Print the numbers of finished and failed jobs of each study, the sweeps that are at work with the time left, and
for one study the failed jobs with the words that repeat them.

  pfbench status
  pfbench status study=mine""",
    keys=("study", "results_dir"),
)
