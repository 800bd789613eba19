"""Published studies: their figure, and their page without results."""

import base64
import gzip
import json
import re
import runpy
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import synthetic_results as synthetic
from checkout import ROOT
from command_line import pfbench
from pyarrow import parquet
from refusals import check_refused

from pfbench.claims import page as claims_page
from pfbench.report import (
    RUNS_FILE,
    StudyFacts,
    decide_parts,
    format_runs,
    read_stored_study,
    rebuild_page,
    render_page,
    study_report,
    write_report,
)
from pfbench.report.options import ReportOptions
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
    rebuild_page(folder)
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
    rebuild_page(folder)
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
    (copy / "headline.svg").unlink()
    assert 'href="headline.svg" download' in rebuild_page(copy).read_text()
    assert (copy / "headline.svg").read_bytes() == (study / "headline.svg").read_bytes()


def test_a_page_is_made_again_without_results(study: Path, tmp_path: Path) -> None:
    """As from a fresh clone: git stores report.md, its figure and the runs."""
    folder = tmp_path / "reports" / "demo"
    folder.mkdir(parents=True)
    for name in ("report.md", RUNS_FILE):
        shutil.copy(study / name, folder)
    text = (folder / "report.md").read_bytes()
    printed = pfbench("report", "study=demo", f"reports_dir={tmp_path}/reports", home=tmp_path)
    assert printed.code == 0, printed.err
    assert "without results" in printed.out
    assert (folder / "report.md").read_bytes() == text
    for name in ("verdicts.csv", "decisions.csv", "headline.svg"):
        assert (folder / name).read_bytes() == (study / name).read_bytes()
    links = re.findall(r'href="([^#"]+)" download', (folder / "index.html").read_text())
    assert sorted(links) == [
        "decisions.csv",
        "headline.svg",
        "pfbench.bib",
        RUNS_FILE,
        "verdicts.csv",
    ]
    (folder / RUNS_FILE).write_bytes((study / RUNS_FILE).read_bytes()[:-9])
    damaged = pfbench("report", "study=demo", f"reports_dir={tmp_path}/reports", home=tmp_path)
    assert damaged.code == 2
    assert f"{RUNS_FILE} must be " in damaged.err


def test_the_runs_alone_give_the_same_files_twice(study: Path, tmp_path: Path) -> None:
    folder, made = tmp_path / "demo", []
    folder.mkdir()
    shutil.copy(study / RUNS_FILE, folder)
    for _ in range(2):  # the second time beside the files of the first
        rebuild_page(folder)
        made.append({path.name: path.read_bytes() for path in folder.iterdir()})
    assert made[0] == made[1]
    assert set(made[0]) > {"index.html", "report.md", "verdicts.csv", "decisions.csv"}
    assert made[0][RUNS_FILE] == (study / RUNS_FILE).read_bytes()


def test_a_table_of_the_readme_is_the_opening_view(
    study: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    numbers = runpy.run_path(str(ROOT / "experiments/analyses/readme_numbers.py"))
    monkeypatch.setitem(numbers["board_table"].__globals__, "TOP", study.parents[1])
    lines = numbers["board_table"]("demo").split("\n")
    rows = pd.read_csv(study / "verdicts.csv").iloc[:4]
    # the world of this study states no divergence threshold, so that there is no share of tracks
    assert lines[0].startswith(
        "| filter | error [m] | ratio to `ekf` | true values in 90 % intervals |"
    )
    assert rows["track"].isna().all()
    for line, row in zip(lines[2:], rows.to_dict("records"), strict=True):
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        assert cells[0] == f"`{row['filter']}`"
        numbers_shown = [
            float(word.strip("[],").replace("∞", "inf"))
            for word in (cells[1] + " " + cells[2]).split()
        ]
        names = ("value", "low", "high", "ratio", "ratio_low", "ratio_high")
        assert numbers_shown == pytest.approx([row[name] for name in names], rel=5e-3)


def test_a_stored_page_is_decided_again_from_its_runs(study: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(study, tmp_path / "demo"))
    names = [
        path.name for path in folder.iterdir() if path.suffix in (".md", ".csv", ".parquet", ".svg")
    ]
    first = {name: (folder / name).read_bytes() for name in names}
    rebuild_page(folder)
    assert first == {name: (folder / name).read_bytes() for name in first}
    rows = pd.read_csv(folder / "verdicts.csv")
    best = rows["filter"].iloc[0]
    pack, runs = read_stored_study(folder)
    runs.loc[runs["filter"] == best, "rmse"] *= 50.0
    (folder / RUNS_FILE).write_bytes(format_runs(runs, pack))
    rebuild_page(folder)
    changed = pd.read_csv(folder / "verdicts.csv").query("metric == 'rmse'")
    assert changed["filter"].iloc[0] != best
    ratios = [
        table[(table["filter"] == best) & (table["baseline"] != best)]["ratio"].iloc[0]
        for table in (rows, changed)
    ]
    assert ratios[1] == pytest.approx(50.0 * ratios[0], rel=1e-3)


def rewrite(path: Path, change: Callable[[dict[bytes, bytes]], dict[bytes, bytes]]) -> None:
    """Write a file of runs again with other metadata."""
    arrow = parquet.read_table(path)
    parquet.write_table(arrow.replace_schema_metadata(change(dict(arrow.schema.metadata))), path)


def pack_text(text: str) -> bytes:
    return base64.b64encode(gzip.compress(text.encode()))


def drop_facts(old: dict[bytes, bytes]) -> dict[bytes, bytes]:
    """A pack of another version, without the facts of its decisions."""
    pack = json.loads(gzip.decompress(base64.b64decode(old[KEY])))
    return {**old, KEY: pack_text(json.dumps({k: v for k, v in pack.items() if k != "facts"}))}


KEY = b"pfbench"
DAMAGES: dict[str, Callable[[dict[bytes, bytes]], dict[bytes, bytes]]] = {
    "no metadata": lambda old: {k: v for k, v in old.items() if k != KEY},
    "no base 64": lambda old: {**old, KEY: b"\xff\x00 no text"},
    "half": lambda old: {**old, KEY: old[KEY][: len(old[KEY]) // 8 * 4]},
    "no gzip": lambda old: {**old, KEY: base64.b64encode(b"plain")},
    "no JSON": lambda old: {**old, KEY: pack_text("{")},
    "no dictionary": lambda old: {**old, KEY: pack_text("[1, 2]")},
    "another version": drop_facts,
    "a bomb": lambda old: {**old, KEY: base64.b64encode(gzip.compress(bytes(2**20)) * 300)},
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_runs_are_refused_in_words(name: str, study: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(study, tmp_path / "demo"))
    page = (folder / "index.html").read_bytes()
    rewrite(folder / RUNS_FILE, dict)  # the control: the same metadata
    read_stored_study(folder)
    rewrite(folder / RUNS_FILE, DAMAGES[name])
    check_refused(
        [
            (
                rf"{RUNS_FILE} must (be|inflate to) .*got .*\. [A-Z].* again\.$",
                lambda: rebuild_page(folder),
            )
        ],
        remedy=False,
    )
    assert (folder / "index.html").read_bytes() == page


def test_runs_that_lack_a_filter_of_the_page_are_refused(study: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(study, tmp_path / "demo"))
    pack, runs = read_stored_study(folder)
    (folder / RUNS_FILE).write_bytes(format_runs(runs[runs["filter"] != "sir"], pack))
    check_refused(
        [
            (
                r"must have runs of all filters of the page, got none of sir",
                lambda: rebuild_page(folder),
            )
        ],
        remedy=False,
    )
    (folder / RUNS_FILE).unlink()
    check_refused(
        [(rf"{RUNS_FILE} must be the runs of a study", lambda: rebuild_page(folder))], remedy=False
    )


def test_facts_of_a_page_are_restored(study: Path) -> None:
    pack = read_stored_study(study).pack
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


def test_warnings_stand_below_the_sentence_of_each_view(study: Path, tmp_path: Path) -> None:
    pack, runs = read_stored_study(study)
    pack["failures"] = [
        {"key": "k", "choices": dict.fromkeys(("scenario", "noise", "filter"), "x"), "message": "m"}
    ] * 2
    pack["facts"] |= {"warning": "Runs are copies.", "differing": "Jobs differ."}
    decided = decide_parts(runs, StudyFacts.from_pack(pack))
    assert decided["warnings"] == [
        "2 jobs have no valid result and are missing from all tables.",
        "Runs are copies.",
    ]
    for view in decided["views"].values():
        assert view["sentence"].startswith("Of 3 filters, ")
        assert view["small_print"].endswith(" Jobs differ.")
    page = render_page({**pack, **decided, "downloads": []})["index.html"]
    assert "missing from all tables. Runs are copies." in page


@pytest.mark.parametrize(
    "place",
    [
        "../secret.svg",
        "figures/../../secret.svg",
        "/etc/passwd",
        "figures/a.txt",
        "../figures/paper_1.svg",
    ],
)
def test_a_stored_study_names_figures_of_its_folder_only(
    study: Path, tmp_path: Path, place: str
) -> None:
    """The file of a stranger must not bring another file of the user into the page."""
    folder = Path(shutil.copytree(study, tmp_path / "reports" / "demo"))
    (tmp_path / "reports" / "secret.svg").write_text("<svg/>")
    stored = read_stored_study(folder)
    figures = [{"file": place, "caption": "a", "alt": "a"}]
    content = format_runs(stored.table, {**stored.pack, "paper_figures": figures})
    (folder / RUNS_FILE).write_bytes(content)
    check_refused(
        [(r"must name figures/paper_NAME\.svg or \.png", lambda: rebuild_page(folder))],
        remedy=False,
    )


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
