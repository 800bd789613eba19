"""`pfbench report all`, which `make report` runs: every study with results, as its experiment says, and nothing spoilt."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from command_line import pfbench

from pfbench.claims import page as claims_page
from pfbench.report import study_report


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, Any]:
    """Options of each report that was asked for; none is drawn."""
    asked: dict[str, Any] = {}

    def write(study: str, results: str, out: str, options: study_report.ReportOptions) -> Path:
        if study == "broken":
            raise ValueError("the cell holds results that differ")
        asked[study] = options
        return Path(out) / study / "index.html"

    def of_claims(results: str, out: str, *_: Any, **__: Any) -> Path:
        asked["claims"] = None
        return Path(out) / "claims" / "index.html"

    monkeypatch.setattr(study_report, "write_report", write)
    monkeypatch.setattr(claims_page, "write_claims", of_claims)
    monkeypatch.chdir(tmp_path)
    return asked


def there(home: Path, *files: str) -> None:
    for name in files:
        (home / name).parent.mkdir(parents=True, exist_ok=True)
        (home / name).touch()


@pytest.mark.slow
def test_what_has_results_is_made_again_and_what_has_none_stays(
    made: dict[str, Any], tmp_path: Path
) -> None:
    there(
        tmp_path,
        "results/mine/a.npz",
        "results/recorded_car/a.npz",
        "results/datasheets/t004.npz",
        "results/empty/note.txt",
    )
    there(
        tmp_path,
        "reports/recorded_car/report.md",
        "reports/paper_001/report.md",
        "reports/claims/report.md",
    )
    said = pfbench("report", "all", "report.alpha=0.01", home=tmp_path)
    assert said.code == 0
    assert list(made) == ["mine", "recorded_car"]
    assert (made["mine"].start_time_s, made["recorded_car"].start_time_s) == (
        0.0,
        98.0,
    )  # as its experiment says
    assert {options.alpha for options in made.values()} == {0.01}
    assert "paper_001: the published report is unchanged" in said.out
    assert "pfbench run -m +experiment=paper_001" in said.out
    assert "holds no runs of claims. Next: pfbench claims run" in said.out
    there(tmp_path, "results/claims_2/a.npz", "results/claims_2/a.values.json")
    assert pfbench("report", "all", home=tmp_path).code == 0
    assert list(made)[-1] == "claims"  # and no study of this name
    assert "claims_2" not in made


def test_a_page_alone_is_published_too_and_a_first_ledger_is_written_of_what_there_is(
    made: dict[str, Any], tmp_path: Path
) -> None:
    there(tmp_path, "results/paper_001/a.npz", "reports/all_seven/index.html")
    there(tmp_path, "reports/claims_2/index.html")
    said = pfbench("report", "all", home=tmp_path)
    assert "all_seven: the published report is unchanged" in said.out
    assert list(made) == ["paper_001", "claims"]


def test_a_study_is_shown_as_its_experiment_says(made: dict[str, Any], tmp_path: Path) -> None:
    there(tmp_path, "results/recorded_car/a.npz")
    assert pfbench("report", "study=recorded_car", home=tmp_path).code == 0
    assert made["recorded_car"].start_time_s == 98.0
    assert (
        pfbench("report", "study=recorded_car", "report.start_time_s=1.0", home=tmp_path).code == 0
    )
    there(tmp_path, "results/my_own/a.npz")
    assert pfbench("report", "study=my_own", home=tmp_path).code == 0
    assert made["my_own"].start_time_s == 0.0
    assert made["recorded_car"].start_time_s == 1.0  # the words come last


def test_one_report_that_fails_stops_no_other(made: dict[str, Any], tmp_path: Path) -> None:
    there(tmp_path, "results/broken/a.npz", "results/mine/a.npz")
    said = pfbench("report", "all", home=tmp_path)
    assert said.code == 1
    assert "mine" in made
    assert "got ValueError: the cell holds results that differ" in said.err
    assert "all 2 reports must be written, got 1 failures: broken" in said.err


def test_without_any_results_everything_stays(made: dict[str, Any], tmp_path: Path) -> None:
    there(tmp_path, "reports/paper_001/report.md")
    said = pfbench("report", "all", home=tmp_path)
    assert said.code == 0
    assert made == {}
    assert said.out.count("is unchanged") == 2


def test_a_page_of_a_script_names_the_command_that_writes_it(
    made: dict[str, Any], tmp_path: Path
) -> None:
    there(tmp_path, "reports/learn_quad_noise/report.md", "reports/claims/report.md")
    said = pfbench("report", "all", home=tmp_path)
    assert "Next: python -m pfbench.experiments.learn_quad_noise" in said.out
    assert made == {}
