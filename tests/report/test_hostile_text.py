"""Names, units and messages of another person have no meaning in any file of a report, a datasheet or the claims."""

from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import synthetic_results as synthetic
from escape_cases import HOSTILE, faults_of_folder, find_faults
from hostile_report import disguise, write_hostile_report

from pfbench.claims import claim_lines, page as claims_page
from pfbench.report import datasheet
from pfbench.results import store


@pytest.mark.parametrize(
    ("name", "text"),
    [("a.html", HOSTILE), ("a.html", f'<p title="{HOSTILE}" onclick="x">'), ("a.md", HOSTILE),
     ("a.tex", HOSTILE), ("a.csv", f"a,{HOSTILE}"), ("a.svg", "<svg><img/></svg>")],
)  # fmt: skip
def test_the_faults_are_found_without_escapes(name: str, text: str) -> None:
    assert find_faults(name, text)


def test_report_of_a_study(tmp_path: Path) -> None:
    made = write_hostile_report(tmp_path)
    kinds = {file.suffix for file in made.rglob("*")}
    assert kinds >= {".html", ".md", ".csv", ".json", ".bib"}
    assert faults_of_folder(made) == {}
    text = (made / "report.md").read_text()
    assert not [line for line in text.splitlines() if line in ("# a", "# b", "# c")]
    assert "onerror" in text  # it is shown, as text


def test_datasheet(tmp_path: Path) -> None:
    path = synthetic.write(tmp_path, synthetic.Method(HOSTILE, 1.0), runs=6, steps=20)
    disguise(path)
    meta, data = store.read_result(path)
    rng = np.random.default_rng(1)
    more = {"residual": rng.standard_normal((6, 20, 2)), "seen": np.ones((20, 2))}
    about = {"about": HOSTILE, "kinds": [HOSTILE] * 2, "pcrb": HOSTILE, "satellites": [],
             "config": {"scenario": {HOSTILE: f"</pre>{HOSTILE}"}},
             "seconds": {"world": 1.0, "measures": 1.0}}  # fmt: skip
    store.write_result(path, {**meta, **about}, {**data, **more})
    made = datasheet.write_datasheet(path, tmp_path / "reports", ("svg",)).parent
    assert (made / "tables" / "residuals.csv").is_file()
    assert faults_of_folder(made) == {}
    assert "onerror" in (made / "index.html").read_text()
    assert "6 runs, seed" in (made / "report.md").read_text()  # the other form says the same


def test_claims(tmp_path: Path) -> None:
    texts = dict.fromkeys(("words", "section", "printed", "figure", "mark"), HOSTILE)
    hostile = [
        plan._replace(claim=replace(plan.claim, **texts)) for plan in claim_lines.read_plans()
    ]
    with mock.patch.object(claims_page, "read_plans", return_value=hostile):
        made = claims_page.write_claims(tmp_path, tmp_path / "reports").parent
    assert faults_of_folder(made) == {}
    assert "onerror" in (made / "report.md").read_text()
