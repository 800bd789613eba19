"""Command `pfbench claims`: the page of the papers' claims."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pfbench.job.config import compose
from pfbench.results.paper_block import conf_dir, experiments_dir

HELP = """\
pfbench claims [key=value ...]

Write the page of all claims of the five papers, with the verdict of the studies on each.
Studies without results count with the measurements that are stored beside the page. Claims
that have neither are listed as not run. They never replace stored verdicts.

  pfbench claims
  pfbench claims report.figure_formats=[svg]"""


def report_claims(words: Sequence[str]) -> None:
    """Write the page of the claims."""
    print(f"claims: {write_claims_page(words).resolve()}")


def write_claims_page(words: Sequence[str]) -> Path:
    """Write the page of the claims.

    Returns the page.
    """
    from pfbench.claims.page import write_claims

    values = compose(words).values
    options = values["report"]
    folders = values["results_dir"], values["reports_dir"]
    return write_claims(
        *folders,
        options["alpha"],
        conf_dir(),
        experiments_dir(),
        allow_mixed_versions=options["allow_mixed_versions"],
        formats=tuple(options["figure_formats"]),
    )
