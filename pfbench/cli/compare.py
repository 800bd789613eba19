"""Command `pfbench compare`: compare an own study with a published one in the same runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pfbench.cli.command import Command, Option
from pfbench.cli.compose import compose_study
from pfbench.cli.report import check_has_results
from pfbench.files.atomic_write import write_atomically
from pfbench.results.conditions import load_conditions


def compare_study(words: Sequence[str], published: str) -> None:
    """Compare a study with a published one, print the verdicts and write them."""
    from pfbench.report.overview.figures import to_svg
    from pfbench.report.published_study import compare_with_published, find_published

    config = compose_study(words)
    study, results = config.values["study"], Path(config.values["results_dir"])
    check_has_results(study, results)
    folder = find_published(published, Path(config.values["reports_dir"]))
    compared = compare_with_published(load_conditions(study, results), folder)
    print(compared)
    path = Path(config.values["reports_dir"]) / study / "published.csv"
    write_atomically(path, lambda file: file.write(compared.table().to_csv(index=False).encode()))
    print(f"verdicts: {path.resolve()}")
    if compared.cells:
        try:
            svg = to_svg(compared.plot()).encode()
        except ValueError as error:  # the verdicts above stand without it
            print(f"no heat map: {error}")
            return
        picture = path.with_name("published_heat_map.svg")
        write_atomically(picture, lambda file: file.write(svg))
        print(f"heat map: {picture.resolve()}")


COMMAND = Command(
    compare_study,
    """\
pfbench compare study=NAME published=all_seven [key=value ...]

Compare the filters of an own study with all filters of a published one, in the same worlds and runs. The
published filters do not run again: random numbers follow from seed and run. At least one filter of the
published study runs again in each world as a witness; its errors must agree, else the worlds differ.

  pfbench run -m +experiment=all_seven scenario=growth particles=100 study=mine filter=ukf,my_filter
  pfbench compare study=mine published=all_seven

  OPTIONS

The verdicts are written to REPORTS_DIR/NAME/published.csv, and published_heat_map.svg has the own filters
next to the seven methods. In Python: study.against("all_seven"), and .plot().""",
    options={"published": Option("NAME", "name of a report among reports_dir, or a folder with its runs.parquet")},
    required=("published",),
)  # fmt: skip
