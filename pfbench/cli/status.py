"""Command `pfbench status`: what is finished, failed and running."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pfbench.cli.compose import split_words
from pfbench.cli.progress import list_repeats, read_state
from pfbench.job.config import compose
from pfbench.results.inputs import describe_libraries

HELP = """\
pfbench status [study=NAME] [results_dir=FOLDER]

Print the numbers of finished and failed jobs of each study, the sweeps that are at work with the time left, and
for one study the failed jobs with the words that repeat them.

  pfbench status
  pfbench status study=mine"""

_NOT_STUDIES = ("datasheets", "claims")


def report_status(words: Sequence[str]) -> None:
    """Print the state of all studies, or of one."""
    values = split_words(words, ("study", "results_dir"), (), "pfbench status study=NAME")
    config = compose([f"{key}={value}" for key, value in values.items()])
    results = Path(config.values["results_dir"])
    if "study" in values:
        from pfbench.cli.report import check_has_results

        folder = results / str(config.values["study"])
        state = read_state(folder)
        if not (state.failures or state.running):
            check_has_results(folder.name, results)
        from pfbench.results.conditions import read_undamaged

        jobs = filter(None, map(read_undamaged, folder.glob("*.npz")))
        mixed = describe_libraries([meta for _, meta in jobs])
        print(state, *filter(None, [mixed]), *list_repeats(folder), sep="\n")
        return
    folders = [
        path for path in results.glob("*") if path.is_dir() and path.name not in _NOT_STUDIES
    ]
    states = sorted(map(read_state, folders), key=lambda state: -state.changed)
    for state in states:
        print(state)
    if not states:
        print(f"No study has results in {results}. Next: pfbench run -m +experiment=quickstart")
