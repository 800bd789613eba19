"""Files in git: no ignored file, no figure twice, reports reduced, numbers of README from the files."""

import base64
import gzip
import importlib.util
import json
import re
import shutil
import subprocess
from pathlib import Path
from types import ModuleType

import pandas as pd
import pytest
from checkout import PUBLISHED_FILE, ROOT, list_published, refuse_own_files
from markupsafe import escape
from pyarrow import parquet

from pfbench.claims import write_claims
from pfbench.files.recorded_folder import PUBLISHED_FILES
from pfbench.report import RUNS_FILE, is_equal_drawing, read_stored_study, rebuild_page


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(
        name, ROOT / "experiments" / "analyses" / f"{name}.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def list_git_files(*options: str) -> list[str]:
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("not a git checkout")
    command = ("git", "ls-files", *options)
    return subprocess.run(
        command, cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.splitlines()


def test_no_file_in_git_is_ignored() -> None:
    assert list_git_files("-ci", "--exclude-standard") == []


def test_git_stores_only_the_published_files_of_a_report() -> None:
    stored = [name for name in list_git_files() if name.startswith("reports/")]
    assert [name for name in stored if not PUBLISHED_FILE.fullmatch(name)] == []
    assert (
        json.loads(PUBLISHED_FILES.read_text())["files"] == load("publish_reports").hash_published()
    )
    studies = {name.split("/")[1] for name in stored} - {"README.md", "published.json"}
    assert studies > set(load("publish_reports").HEADLINES)
    for study in studies:
        figures = [name for name in stored if name.startswith(f"reports/{study}/headline.")]
        worlds = ROOT / "reports" / study / "worlds.md"
        text = (worlds if worlds.exists() else worlds.with_name("report.md")).read_text()
        assert len(figures) == text.count("](headline."), study
        assert len(figures) == (study != "claims_2"), study  # its picture is a table of the page
        assert f"reports/{study}/report.md" in stored


def test_a_drawing_that_differs_in_the_last_digit_is_not_written_again() -> None:
    """As of two processors. A moved line, another text and another colour are differences."""
    is_equal = is_equal_drawing
    drawing = (
        b'<path d="M 74.119688 51.399375" style="fill: #0b4f8a"/><text x="12.5">CPF 1.00</text>'
    )
    assert is_equal(drawing, drawing.replace(b"74.119688", b"74.119687"))
    assert not is_equal(drawing, drawing.replace(b"74.119688", b"74.129688"))
    assert not is_equal(drawing, drawing.replace(b"CPF 1.00", b"CPF 1.01"))
    assert not is_equal(drawing, drawing.replace(b"CPF", b"CKF"))
    assert not is_equal(drawing, drawing.replace(b"#0b4f8a", b"#0b4f8b"))
    assert not is_equal(drawing, drawing.replace(b'<text x="12.5">', b""))


def test_no_figure_is_stored_in_two_formats() -> None:
    figures = [Path(name) for name in list_git_files() if name.endswith((".png", ".svg"))]
    stems = [figure.with_suffix("") for figure in figures]
    assert len(stems) == len(set(stems))


def test_published_reports_are_reduced() -> None:
    publish = load("publish_reports")
    for study, stem in publish.HEADLINES.items():
        folder = publish.REPORTS / study
        text = (folder / "report.md").read_text()
        assert publish.reduce_markdown(text, folder, stem) == text, study


LARGE = "all_seven"  # seconds


def check_published_page(folder: Path, copy: Path) -> None:
    """Decide and write a page again, as from a fresh clone, with the runs of git only."""
    copy.mkdir()
    (copy / RUNS_FILE).symlink_to(folder / RUNS_FILE)
    figures = {entry["file"] for entry in read_stored_study(folder).pack["paper_figures"]}
    for name in figures:
        (copy / "figures").mkdir(exist_ok=True)
        shutil.copy(folder / name, copy / name)
        assert (folder / name).stat().st_size < 60_000, name
    page = rebuild_page(copy).read_text()
    drawings = ["headline.svg"]
    pages = ["report.md"]
    if (folder / "worlds.md").exists():
        drawings += ["heat_map.svg", "matrices.svg"]
        pages += ["worlds.md"]
        page = (copy / "worlds.html").read_text()
    for name in drawings:
        assert is_equal_drawing(*((path / name).read_bytes() for path in (copy, folder))), folder
    for name in pages:
        assert (copy / name).read_bytes() == (folder / name).read_bytes(), f"{folder.name}: {name}"
    stored, again = (read_stored_study(path) for path in (folder, copy))
    pd.testing.assert_frame_equal(
        stored.table, again.table
    )  # bytes differ between versions of pyarrow
    links = set(re.findall(r'href="([^#"]+)" download', page))
    numbers = {"verdicts.csv", "decisions.csv", RUNS_FILE, "pfbench.bib", "headline.svg"}
    assert links == numbers | figures, folder.name
    assert page.count('src="data:image/svg+xml;base64') >= len(figures)
    title = stored.pack["title"]
    assert f"<title>{escape(title)} – pfbench</title>" in page, folder.name


PAGES = [folder.name for folder in list_published() if (folder / RUNS_FILE).is_file()]


@pytest.mark.parametrize("study", [name for name in PAGES if name != LARGE])
def test_published_pages_are_decided_by_the_present_rules(study: str, tmp_path: Path) -> None:
    assert len(PAGES) > 20
    check_published_page(ROOT / "reports" / study, tmp_path / study)


@pytest.mark.slow
def test_the_largest_published_page_is_decided_by_the_present_rules(tmp_path: Path) -> None:
    check_published_page(ROOT / "reports" / LARGE, tmp_path / LARGE)


def test_the_page_of_the_claims_is_made_of_its_values(tmp_path: Path) -> None:
    """Words, report and values again from the stored values alone: all decisions are made again."""
    folder = ROOT / "reports" / "claims_2"
    (tmp_path / "claims_2").mkdir()
    shutil.copy(folder / "values.json.gz", tmp_path / "claims_2")
    (tmp_path / "all_seven").symlink_to(ROOT / "reports" / "all_seven")
    write_claims(tmp_path / "none", tmp_path)
    for name in ("words.json", "report.md", "values.json.gz"):
        assert (tmp_path / "claims_2" / name).read_bytes() == (folder / name).read_bytes(), name


def test_the_stored_results_of_a_script_give_its_published_page() -> None:
    publish = load("publish_reports")
    folders = [folder for folder in list_published() if (folder / publish.RESULTS).is_file()]
    assert folders
    for folder in folders:
        page = publish.write_script_page(folder)
        text = publish.reduce_markdown(page, folder, publish.HEADLINES[folder.name])
        assert text == (folder / "report.md").read_text(), folder.name


def test_stored_results_are_rounded_and_make_the_page(tmp_path: Path) -> None:
    publish = load("publish_reports")
    folder = tmp_path / "learn_noise_calibration"
    folder.mkdir()
    counts = {"counts": {"level_sd": [20] * 10}, "other": [1.23456789e-7, 3, True, None]}
    results = {"request": {"runs": 200, "effort": 2}, "done": {"toy, SVI": counts}}
    (folder / f"{folder.name}.json").write_text(json.dumps({**results, "digest": "x"}))
    (folder / "report.md").write_text("older\n")
    publish.publish_report(folder)
    stored = json.loads(gzip.decompress((folder / publish.RESULTS).read_bytes()))
    counts["other"] = [1.23457e-7, 3, True, None]
    assert stored == results
    assert "| SVI | correct | `level_sd` | 20 20 " in (folder / "report.md").read_text()


def test_a_report_keeps_its_headline_figure_only(tmp_path: Path) -> None:
    publish = load("publish_reports")
    folder = tmp_path / "learn_gain"
    folder.mkdir()
    (folder / "ratios.svg").write_text("<svg/>")
    page = (
        "# claims\n\n![a](ratios.svg)\n\n*Kept.*\n\n"
        "## Levels\n\n![b](figures/claims_printed_levels.svg)\n\n*Removed.*\n\n"
        "## Claims\n\n- 0.2 [0.1, 0.3]; [figure of x](../paper_000/index.html#a)\n"
    )
    (folder / "report.md").write_text(page)
    publish.publish_report(folder)
    assert (folder / "headline.svg").read_text() == "<svg/>"
    assert (folder / "report.md").read_text() == (
        "# claims\n\n![a](headline.svg)\n\n*Kept.*\n\n"
        "## Claims\n\n- 0.2 [0.1, 0.3]; [x](../paper_000/report.md)\n"
    )


def test_publishing_removes_only_headlines_that_it_made(tmp_path: Path) -> None:
    publish = load("publish_reports")
    folder = tmp_path / "learn_gain"
    figure = folder / f"{publish.HEADLINES['learn_gain']}.png"
    figure.parent.mkdir(parents=True)
    figure.write_bytes(b"png")
    for name in ("report.md", "headline.mine", "headline.svg"):
        (folder / name).write_text("of the user\n")
    publish.publish_report(folder)
    figure.with_suffix(".svg").write_text("<svg/>")
    publish.publish_report(folder)
    names = {path.name for path in folder.iterdir() if path.is_file()} - {"manifest.json"}
    made = {"report.md", "headline.mine", "headline.svg", "headline.svg.kept"}
    assert names == made | {"ratios.png", "ratios.svg"}
    assert (folder / "headline.svg.kept").read_text() == "of the user\n"
    assert (folder / "headline.svg").read_text() == "<svg/>"


NUMBERS = load("readme_numbers")


@pytest.mark.parametrize("page", NUMBERS.PAGES, ids=lambda page: page.stem)
def test_the_numbers_of_pages_are_those_of_the_published_files(page: Path) -> None:
    text = page.read_text()
    assert NUMBERS.fill_blocks(text) == text, "run: python experiments/analyses/readme_numbers.py"


def test_pages_have_every_block_of_numbers() -> None:
    text = "".join(page.read_text() for page in NUMBERS.PAGES)
    assert set(NUMBERS.BLOCKS) < set(re.findall(r"<!-- numbers:(\w+) -->", text)) - {"end"}
    methods = [page for page in NUMBERS.PAGES if page.name != "README.md"]
    assert sum("<!-- numbers:paper_" in page.read_text() for page in methods) == 8


def test_a_changed_number_of_the_readme_is_found() -> None:
    page = (ROOT / "docs" / "results.md").read_text()
    ratio = NUMBERS.read_table("benchmarks/campaigns.md")[0]["times as fast (quartiles)"]
    blocks = re.findall(r"<!-- numbers:\w+ -->\n.*?<!-- numbers:end -->", page, re.DOTALL)
    text = next(block for block in blocks if ratio in block)
    assert NUMBERS.fill_blocks(text.replace(ratio, "9.9")) == text


def test_the_readme_has_no_measured_number_outside_the_blocks() -> None:
    text = (ROOT / "README.md").read_text()
    prose = re.sub(
        r"<!-- numbers:\w+ -->.*?<!-- numbers:end -->|```.*?```", "", text, flags=re.DOTALL
    )
    assert re.findall(r"\d+(?:\.\d+)? (?:times|%|s for|ms)\b", prose) == []
    counted = "claims|filters|flights|jobs|noise regimes|regimes|runs|scenarios|studies|worlds"
    number = r"[1-9]\d*|two|three|four|five|six|seven|eight|nine|ten|twelve|twenty"
    assert re.findall(rf"\b(?:{number}) (?:\w+ )?(?:{counted})\b", prose, re.IGNORECASE) == []
    assert re.findall(r"\b00\d-\w+", prose) == []  # a claim
    counts = re.findall(
        r"\b\d+ (?:scenarios|models|noise regimes|filters and forms of filters)", text
    )
    changes = (ROOT / "CHANGELOG.md").read_text()
    assert len(counts) == 4
    assert all(count in changes for count in counts)  # which the blocks of the README compute


def test_studies_run_cheapest_first_and_within_a_limit() -> None:
    studies = load("run_studies")
    costs = {"a": 3600.0, "b": 60.0, "c": 7200.0}
    assert studies.plan_studies(["c", "a", "unknown", "b"], costs) == ["b", "a", "c", "unknown"]
    assert studies.plan_studies(["c", "a", "b"], costs, hours=1.5) == ["b", "a"]
    assert studies.list_experiments("quickstart") == ["quickstart", "quickstart_bearings"]
    assert studies.list_experiments("paper_001") == ["paper_001"]
    scripts = set(load("publish_reports").HEADLINES)  # which are no experiments
    assert set(studies.list_studies()) == {folder.name for folder in list_published()} - scripts - {
        "claims_2"
    }


# Studies with jobs of uncommitted code. They run again; no study is added.
WAITING_FOR_A_RERUN: list[str] = []


def test_published_jobs_are_of_committed_code() -> None:
    """A study that has been run again is taken from the list."""
    folders = [folder for folder in list_published() if (folder / RUNS_FILE).is_file()]
    commits = {}
    for folder in folders:  # without deciding the study again
        parts = parquet.read_schema(folder / RUNS_FILE).metadata[b"pfbench"]
        page = json.loads(gzip.decompress(base64.b64decode(parts)))
        commits[folder.name] = dict(page["provenance"])["commit"]
    assert {name for name in commits if "-dirty" in commits[name]} == set(WAITING_FOR_A_RERUN)


@pytest.mark.parametrize("name", ["reports/quickstart/report.md", "results/quickstart/a.npz"])
def test_a_test_that_reads_what_a_user_may_have_written_fails(name: str) -> None:
    """`make demo` and then `make test` pass in one clone. The files need not exist."""
    with pytest.raises(AssertionError, match="a clone in use"):
        (ROOT / name).open()
    for folder in (ROOT / name).parents[:2]:
        with pytest.raises(AssertionError, match="a clone in use"):
            list(folder.iterdir())
    with pytest.raises(AssertionError, match="a clone in use"):
        refuse_own_files("os.scandir", ((ROOT / name).parents[1],))  # as of a pattern


def test_the_cost_of_a_study_is_the_computing_time_of_its_jobs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    studies = load("run_studies")
    seconds = {"a": {"world": 1.0, "filter": 2.0}, "b": {"filter": 4.0, "per_step": 9.0}}
    (tmp_path / "s").mkdir()
    for name in seconds:
        (tmp_path / "s" / f"{name}.npz").touch()
    monkeypatch.setattr(studies, "read_metadata", lambda path: {"seconds": seconds[path.stem]})
    assert studies.measure_cost("s", tmp_path) == 7.0
    assert studies.measure_cost("none", tmp_path) == 0.0
