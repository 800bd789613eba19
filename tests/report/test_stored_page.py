"""Published studies: their figure, and their page without results."""

from __future__ import annotations

import json
import re
import runpy
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import synthetic_results as synthetic
from checkout import ROOT
from command_line import pfbench

from pfbench.files.recorded_folder import RecordedFolder
from pfbench.report import read_page_data, write_page_data
from pfbench.report.board.pack import StudyFacts
from pfbench.report.options import ReportOptions
from pfbench.report.study_report import decide_again, rebuild_page, write_report
from pfbench.results.looks import PartName, find_looks
from pfbench.results.step_times import StepTimes


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Report of a study of invented results."""
    home = tmp_path_factory.mktemp("home")
    synthetic.study(home / "results" / "demo", runs=12, steps=10)
    return write_report("demo", home / "results", home / "reports").parent


def test_a_study_is_published_from_the_data_of_its_page(study: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(study, tmp_path / "demo"))
    publish_study = runpy.run_path(str(ROOT / "experiments/analyses/publish_reports.py"))[
        "publish_study"
    ]
    publish_study(folder)
    first = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    text = (folder / "report.md").read_text()
    assert "](headline.svg)" in text
    drawing = (folder / "headline.svg").read_text()
    rows = pd.read_csv(folder / "verdicts.csv").query(
        "metric == 'rmse' and world == 'all' and regime == 'all'"
    )
    rows = rows[rows["baseline"] == rows["baseline"].iloc[0]]
    assert len(rows) == 4
    for ratio in rows["ratio"]:
        assert f">{ratio:.2f}<" in drawing
    publish_study(folder)
    assert first == {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_page_offers_its_figures_and_each_kind_of_file_once(study: Path, tmp_path: Path) -> None:
    page = (study / "index.html").read_text()
    links = re.findall(r'href="([^"#]+)" download', page)
    assert {"runs.parquet", "verdicts.csv", "pfbench.bib", "headline.svg"} < set(links)
    assert [link for link in links if not (study / link).is_file()] == []
    heads = re.findall(r"<h3>(\w+)</h3><ul>", page)
    assert heads == ["Numbers", "LaTeX", "Figures"]
    assert "pfbench paper study=demo journal=ieee" in page
    copy = Path(shutil.copytree(study, tmp_path / "demo"))
    assert 'href="headline.svg" download' in rebuild_page(copy).read_text()
    (copy / "headline.svg").unlink()
    assert "headline.svg" not in rebuild_page(copy).read_text()


def test_a_published_figure_names_the_filters_that_it_does_not_show(
    study: Path, tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(study, tmp_path / "demo"))
    publish_study = runpy.run_path(str(ROOT / "experiments/analyses/publish_reports.py"))[
        "publish_study"
    ]
    publish_study(folder)
    assert "Not shown" not in (folder / "report.md").read_text()
    pack = read_page_data(folder)
    rows = next(iter(pack["views"].values()))["rows"]
    for row, words in zip(rows[-2:], ("track not kept", "not run in all conditions"), strict=True):
        row.update(ratio=None, ratio_low=None, ratio_high=None, words=words)
    with RecordedFolder(folder, is_complete=False) as target:
        write_page_data(pack, target)
    publish_study(folder)
    names = {look["key"]: look["name"] for look in pack["filters"]}
    first, second = (names[row["filter"]] for row in rows[-2:])
    note = f"Not shown, track not kept: {first}. Not shown, not run in all conditions: {second}."
    assert f"](headline.svg)\n\n{note}\n\n" in (folder / "report.md").read_text()
    drawing = (folder / "headline.svg").read_text()
    assert f">{first}<" not in drawing
    assert f">{second}<" not in drawing


def test_a_page_is_made_again_without_results(study: Path, tmp_path: Path) -> None:
    """As from a fresh clone: git stores some files only."""
    folder = tmp_path / "reports" / "demo"
    folder.mkdir(parents=True)
    for name in ("report.md", "runs.parquet", "verdicts.csv", "page.json.gz"):
        shutil.copy(study / name, folder)
    text = (folder / "report.md").read_bytes()
    printed = pfbench("report", "study=demo", f"reports_dir={tmp_path}/reports", home=tmp_path)
    assert printed.code == 0, printed.err
    assert "without results" in printed.out
    assert (folder / "report.md").read_bytes() == text
    links = re.findall(r'href="([^#"]+)" download', (folder / "index.html").read_text())
    assert links == ["verdicts.csv", "runs.parquet"]
    (folder / "page.json.gz").write_bytes((study / "page.json.gz").read_bytes()[:-9])
    damaged = pfbench("report", "study=demo", f"reports_dir={tmp_path}/reports", home=tmp_path)
    assert damaged.code == 2
    assert "page.json.gz must be the data of a page" in damaged.err


def test_a_table_of_the_readme_is_the_opening_view(
    study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    numbers = runpy.run_path(str(ROOT / "experiments/analyses/readme_numbers.py"))
    monkeypatch.setitem(numbers["board_table"].__globals__, "TOP", tmp_path)
    (tmp_path / "reports" / "demo").mkdir(parents=True)
    shutil.copy(study / "verdicts.csv", tmp_path / "reports" / "demo")
    lines = numbers["board_table"]("demo").split("\n")
    rows = pd.read_csv(study / "verdicts.csv").iloc[:4]
    # the world of this study states no divergence threshold, so that there is no share of tracks
    assert lines[0].startswith(
        "| filter | error [m] | ratio to `ekf` | true values in 90 % regions |"
    )
    assert rows["track"].isna().all()
    for line, row in zip(lines[2:], rows.to_dict("records"), strict=True):
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        assert cells[0] == f"`{row['filter']}`"
        numbers_shown = [float(word.strip("[],")) for word in (cells[1] + " " + cells[2]).split()]
        names = ("value", "low", "high", "ratio", "ratio_low", "ratio_high")
        assert numbers_shown == pytest.approx([row[name] for name in names], rel=5e-3)


def test_a_stored_page_is_decided_again_from_its_runs(study: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(study, tmp_path / "demo"))
    files = ("report.md", "verdicts.csv", "page.json.gz", "index.html")
    first = {name: (folder / name).read_bytes() for name in files[:3]}
    rebuild_page(folder)
    assert first == {name: (folder / name).read_bytes() for name in first}
    runs, rows = pd.read_parquet(folder / "runs.parquet"), pd.read_csv(folder / "verdicts.csv")
    best = rows["filter"].iloc[0]
    runs.loc[runs["filter"] == best, "rmse"] *= 50.0
    runs.to_parquet(folder / "runs.parquet")
    rebuild_page(folder)
    changed = pd.read_csv(folder / "verdicts.csv").query("metric == 'rmse'")
    assert changed["filter"].iloc[0] != best
    ratios = [
        table[(table["filter"] == best) & (table["baseline"] != best)]["ratio"].iloc[0]
        for table in (rows, changed)
    ]
    assert ratios[1] == pytest.approx(50.0 * ratios[0], rel=1e-3)
    runs[runs["filter"] != best].to_parquet(folder / "runs.parquet")
    with pytest.raises(
        ValueError, match=rf"must have runs of all filters of the page, got none of {best}"
    ):
        rebuild_page(folder)


def test_facts_of_a_page_are_restored(study: Path) -> None:
    pack = read_page_data(study)
    times = StepTimes(np.array([1e-3, 2e-3, 4e-3]), "group")
    regime = PartName("nominal", "Nominal", "nominal noise")
    options = ReportOptions(alpha=0.01, equivalence_margin=0.1, metric="crps", baseline="sir")
    cell = ("world", "nominal")
    facts = StudyFacts(
        find_looks(["ekf", "sir"]), {}, {"nominal": regime}, options, {cell: {"sir": times}},
        [], "Runs are copies.", "Jobs differ.",
    )  # fmt: skip
    entries = json.loads(json.dumps(facts.to_entries()))
    restored = StudyFacts.from_pack({**pack, "worlds": [], "failures": [], "facts": entries})
    assert restored.times[cell]["sir"].seconds.tolist() == times.seconds.tolist()
    assert restored.times[cell]["sir"].group == "group"
    assert restored._replace(times=facts.times) == facts
    entries["looks"][0]["key"] = "own_filter"  # not installed: the stored look
    own = StudyFacts.from_pack({**pack, "worlds": [], "failures": [], "facts": entries})
    assert own.looks["own_filter"].name == facts.looks["ekf"].name


def test_warnings_stand_first_in_each_view_that_is_decided_again(study: Path) -> None:
    pack = read_page_data(study)
    pack["failures"] = [{}, {}]
    pack["facts"] |= {"warning": "Runs are copies.", "differing": "Jobs differ."}
    pack["facts"]["options"]["baseline"] = pack["baselines"][0]
    for view in decide_again(pack, study / "runs.parquet")["views"].values():
        start = "2 jobs have no valid result and are missing from all tables. Runs are copies. "
        assert view["sentence"].startswith(start)
        assert view["small_print"].endswith(" Jobs differ.")
