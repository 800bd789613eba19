"""The report: whole, the same for the same results, and honest about what is missing."""

import re
import shutil
import unicodedata
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import synthetic_results as synthetic
from refusals import check_refused

from pfbench import job
from pfbench.report import study_report, writers
from pfbench.report.board.curves import make_curves
from pfbench.report.board.entries import round_values
from pfbench.report.board.pack import DECISION_COLUMNS
from pfbench.report.study_page import page_writer
from pfbench.results import store
from pfbench.results.conditions import load_conditions
from pfbench.stats.sentences import format_with_interval

QUICK = study_report.ReportOptions(figure_formats=("svg",))


def everything(folder):
    return {
        path.relative_to(folder): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    root = tmp_path_factory.mktemp("results")
    synthetic.study(root / "demo", runs=12, steps=40)
    return root


@pytest.fixture(scope="module")
def report(results, tmp_path_factory):
    return study_report.write_report(
        "demo",
        results,
        tmp_path_factory.mktemp("reports"),
        study_report.ReportOptions(figure_formats=("svg", "png")),
    ).parent


def test_every_file_is_there_and_offered_by_the_page(report):
    files = {path.relative_to(report).as_posix() for path in report.rglob("*") if path.is_file()}
    numbers = {"verdicts.csv", "runs.parquet", "metrics.csv", "decisions.csv", "consistency.csv"}
    assert files == {
        "index.html",
        "report.md",
        "manifest.json",
        "pfbench.bib",
        "headline.svg",
        *numbers,
    }
    html = (report / "index.html").read_text()
    for name in sorted(numbers | {"pfbench.bib", "headline.svg"}):
        assert f'<a href="{name}" download>' in html


def test_the_page_needs_nothing_but_itself(report):
    html = (report / "index.html").read_text()
    needed = re.findall(r'(?:src|href)="(?!data:|#)[^"]*"(?! download)', html)
    assert needed == []
    assert "http:" not in html.replace("http://www.w3.org/2000/svg", "")
    assert "https:" not in html
    assert "prefers-color-scheme: dark" in html


def test_the_page_says_what_ran_what_failed_and_what_was_lost(report):
    html, text = (report / "index.html").read_text(), (report / "report.md").read_text()
    for said in (
        "1 job has no valid result",
        "00000000deadbeef",
        "covariance lost its positive eigenvalues",
    ):
        assert said in html, said
        assert said in text, said
    for said in ("0123abc", "@misc{pfbench,", "year    = {2026}", "200 particles in each particle filter",
                 "<code>pcrb</code>"):  # fmt: skip
        assert said in html, said
    lost = pd.read_csv(report / "verdicts.csv").query("world == 'all' and metric == 'rmse'")
    assert set(lost.loc[lost["filter"] == "sir", "lost"]) == {1}
    assert set(lost.loc[lost["filter"] == "ekf", "lost"]) == {0}


def test_same_results_same_bytes_whatever_the_order_of_files(results, tmp_path, monkeypatch):
    first = study_report.write_report("demo", results, tmp_path / "one", QUICK).parent
    copy = tmp_path / "copy" / "demo"
    copy.mkdir(parents=True)
    for path in sorted((results / "demo").iterdir(), reverse=True):
        shutil.copy(path, copy)
    real = Path.glob
    monkeypatch.setattr(Path, "glob", lambda self, pattern: reversed(sorted(real(self, pattern))))
    second = study_report.write_report("demo", copy.parent, tmp_path / "two", QUICK).parent
    assert everything(first) == everything(second)


def test_a_new_report_removes_the_figures_of_the_old_one_alone(tmp_path, caplog):
    for method in (
        synthetic.Method("sir", 1.0, particles=9),
        synthetic.Method("gpf", 2.0, particles=9),
    ):
        synthetic.write(tmp_path / "paper_001", method, runs=6, steps=8)
    folder = tmp_path / "reports" / "paper_001"
    study_report.write_report(
        "paper_001",
        tmp_path,
        tmp_path / "reports",
        replace(QUICK, paper_figures=("001-3", "001-4")),
    )
    old = {path.name for path in (folder / "figures").iterdir()}
    assert old == {"paper_001_3.svg", "paper_001_4.svg"}
    mine = [folder / "figures" / "photo.png", folder / "tables" / "mine.csv", folder / "notes.txt"]
    for path in mine:
        path.parent.mkdir(exist_ok=True)
        path.write_text("mine")
    study_report.write_report(
        "paper_001", tmp_path, tmp_path / "reports", replace(QUICK, paper_figures=("001-3",))
    )
    assert {path.name for path in (folder / "figures").iterdir()} == {
        "paper_001_3.svg",
        "photo.png",
    }
    assert all(path.read_text() == "mine" for path in mine)
    assert "figures/photo.png, notes.txt, tables/mine.csv" in caplog.text
    assert {path.name for path in folder.rglob("*.kept")} == set()


def test_mixed_versions_are_refused_and_named_when_allowed(tmp_path):
    folder = tmp_path / "demo"
    synthetic.write(folder, synthetic.METHODS[0], runs=6, steps=20)
    synthetic.write(
        folder,
        synthetic.METHODS[1],
        runs=6,
        steps=20,
        versions={**synthetic.VERSIONS, "commit": "fff9999"},
    )
    check_refused(
        [
            (
                r"versions\.commit",
                lambda: study_report.write_report("demo", tmp_path, tmp_path / "reports", QUICK),
            )
        ],
        remedy=False,
    )
    assert not (tmp_path / "reports").exists()
    mixed = study_report.ReportOptions(figure_formats=("svg",), allow_mixed_versions=True)
    path = study_report.write_report("demo", tmp_path, tmp_path / "reports", mixed)
    assert "0123abc, fff9999" in path.read_text()


def test_the_page_says_what_its_jobs_took_and_how_many_were_asked_for(results, tmp_path):
    study_report.write_report("demo", results, tmp_path, replace(QUICK, planned=6))
    text = (tmp_path / "demo" / "index.html").read_text()
    seconds = sum(
        1.0 + 1e-3 * method.milliseconds * 40 for method in synthetic.METHODS
    )  # a world each, and 40 steps
    assert "4 of 6 in the experiment" in text
    assert f"{seconds:.0f} s (filters {100 * (1 - 4 / seconds):.0f} %, data" in text


def test_a_threshold_of_no_group_is_refused_before_anything_is_written(results, tmp_path):
    check_refused(
        [
            (
                r"report\.convergence_threshold must name groups of the results, got height",
                lambda: study_report.write_report(
                    "demo", results, tmp_path, replace(QUICK, convergence_threshold={"height": 1.0})
                ),
            )
        ],
        remedy=False,
    )
    assert not list(tmp_path.iterdir())


def test_a_toy_without_map_particles_or_rival(tmp_path):
    method = synthetic.Method("kalman", 1.0)
    path = synthetic.write(tmp_path / "demo", method, runs=5, steps=20)
    meta, arrays = store.read_result(path)
    state = {"names": ["x"], "units": [""], "groups": {"state": [0]}}
    toy = {name: arrays[name] for name in ("time", "log_evidence", "lost")}
    toy |= {name: arrays[name][..., :1] for name in ("error", "sd", "nees")}
    store.write_result(path, {**meta, "state": state}, toy)
    made = study_report.write_report("demo", tmp_path, tmp_path / "reports", QUICK)
    assert "kalman" in made.read_text()
    assert (made.parent / "decisions.csv").read_text() == f"{','.join(DECISION_COLUMNS)}\n"


def test_a_filter_that_lost_every_run_has_the_largest_errors_and_no_number(tmp_path):
    folder = tmp_path / "demo"
    synthetic.write(folder, synthetic.METHODS[0], runs=12, steps=20)
    doomed = synthetic.Method("doomed", 1.0, lost=tuple(range(12)))
    synthetic.write(folder, doomed, runs=12, steps=20)
    made = study_report.write_report("demo", tmp_path, tmp_path / "reports", QUICK)
    rows = pd.read_csv(made.parent / "verdicts.csv").query("baseline == 'ekf' and metric == 'rmse'")
    doomed = rows[rows["filter"] == "doomed"]
    assert set(doomed["words"]) == {"loses 100 % of runs"}
    assert doomed["ratio"].isna().all()  # no number stands for a lost run
    assert set(doomed["loses"]) == {"loses more"}
    assert doomed["value"].isna().all()
    row = pd.read_csv(made.parent / "metrics.csv").query(
        "filter == 'doomed' and metric == 'rmse' and component == 'norm' and group == 'position'"
    )
    assert row["runs_with_value"].tolist() == [0]
    assert row["mean"].isna().all()


def test_curves_have_the_rare_steps_with_truth(tmp_path):
    path = synthetic.write(tmp_path / "demo", synthetic.METHODS[0], runs=4, steps=1000)
    meta, arrays = store.read_result(path)
    error = arrays["error"].copy()
    rare = np.zeros(1000, bool)
    rare[[101, 355, 612, 990]] = True  # none of which a stride meets
    error[:, ~rare, 6:] = np.nan
    store.write_result(path, meta, {**arrays, "error": error})
    (condition,) = load_conditions("demo", tmp_path)
    curve = make_curves({job.label: job.load() for job in condition.jobs})
    assert curve["t"] == arrays["time"][rare].tolist()
    norm = np.linalg.norm(error[:, rare, 6:].astype(float), axis=-1)
    np.testing.assert_allclose(curve["filters"]["ekf"]["median"], np.median(norm, 0), rtol=1e-3)


def test_conditions_whose_data_differ_say_so(tmp_path):
    for k, sd in enumerate((1.0, 10.0)):
        path = synthetic.write(
            tmp_path / "demo", synthetic.Method("ekf", 1.0, 1.0, 100 + k), runs=6, steps=20
        )
        meta, arrays = store.read_result(path)
        store.write_result(
            path,
            {**meta, "config": {"filter": {"name": "ekf"}, "scenario": {"gps_sd": sd}}},
            arrays,
        )
    study_report.write_report("demo", tmp_path, tmp_path / "reports", QUICK)
    text = (tmp_path / "reports" / "demo" / "report.md").read_text()
    assert (
        "Conditions in brackets differ in gps sd. Their data differ: filters are compared within each of them."
        in text
    )


def test_options_are_checked():
    check_refused(
        [
            (
                "alpha must be a number between 0 and 1, got 5",
                lambda: study_report.ReportOptions(alpha=5),
            ),
            (
                r"formats must be a list of names of svg, png, got .'gif'",
                lambda: study_report.ReportOptions(figure_formats=("gif",)),
            ),
        ],
        remedy=False,
    )


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"), (-0.0, "0"), (1.0, "1.00"), (9.996, "10.0"), (123.456, "123"), (99_949.0, "99949"), (0.00123, "0.00123"),
        (1.2e-7, "1.20e-07"), (3e8, "3.00e+08"), (-2.5, "-2.50"), (float("nan"), "–"), (float("inf"), "∞"),
        (7, "7"), (True, "yes"), ("a", "a"), (None, "–"), (np.float64(0.5), "0.500"), (np.int64(40), "40"),
    ],
)  # fmt: skip
def test_numbers_have_three_digits(value, text):
    assert writers.format_number(value) == text


@pytest.mark.parametrize(
    ("numbers", "text"),
    [
        ((0.951, 0.899, 0.9964), "0.951 [0.899, 0.996]"), ((1.05, 1.0031, 1.1), "1.050 [1.003, 1.100]"),
        ((0.5, 0.4, 0.6), "0.50 [0.40, 0.60]"), ((1.0, 1.0, 1.0), "1.00 [1, 1]"), ((2.0, 1.0, float("inf")), "2.00 [1, ∞]"),
    ],
)  # fmt: skip
def test_an_interval_without_one_does_not_seem_to_end_there(numbers, text):
    assert format_with_interval(*numbers) == text


@pytest.mark.parametrize(("high", "text"), [(1.0, "[0.500, 1]"), (1.0034, "[0.500, 1.003]"), (0.99996, "[0.500, 1.000]"), (1.2, "[0.500, 1.20]")])  # fmt: skip
def test_an_end_on_a_page_is_1_only_where_it_is(high, text):
    row = round_values({"low": 0.5, "high": high})
    assert page_writer.format_interval(row["low"], row["high"]) == text


def test_markdown_columns_line_up():
    text = writers.format_markdown(pd.DataFrame({"a|b": ["x", "yy"], "n": [1.0, 20.0]}))
    assert text.splitlines() == [
        "| a\\|b |    n |",
        "|------|-----:|",
        "| x    | 1.00 |",
        "| yy   | 20.0 |",
    ]


def written() -> str:
    """Every sign beyond ASCII that the package and its configuration hold, and others that units and names have."""
    folders = (Path(writers.__file__).parents[1], job.conf_dir(), job.experiments_dir())
    files = [
        path
        for folder in folders
        for path in sorted(folder.rglob("*"))
        if path.suffix in {".py", ".yaml", ".jinja"}
    ]
    found = {sign for path in files for sign in path.read_text(encoding="utf-8") if ord(sign) > 127}
    return "".join(
        sorted(found | set("∞−–—±×°′″≥≤²³µαβγδεζηθικλμνξπρστυφχψωΓΔΘΛΞΠΣΥΦΨΩ·÷≈≠→√⁻⁵₀₉éüčßø“”…‰中"))
    )


def test_latex_is_of_letters_that_pdflatex_reads():
    signs = written()
    assert {"–", "∞", "−", "±", "°", "²"} <= set(signs)
    table = pd.DataFrame(
        {signs: [f"before{sign}after" for sign in signs], "value": np.full(len(signs), -np.inf)}
    )
    found = writers.format_latex(table, signs)
    assert found.isascii()
    body = re.sub(r"\\[\\$&%#_{}|~^]", "", found)  # commands of one sign
    assert body.count("$") % 2 == 0
    assert not re.search(
        r"[<>|~]", re.sub(r"\$[^$]*\$", "", body)
    )  # which the first fonts show as others
    for line in found.splitlines():
        assert line.count("{") - line.count(r"\{") == line.count("}") - line.count(r"\}")
    for formula in re.findall(
        r"\$([^$]*)\$", body
    ):  # of two superscripts in a row TeX says that one is too many
        assert formula.count("^") + formula.count("'") // 2 <= 1
    commands = set(re.findall(r"\\([A-Za-z]+)", found))
    for letter in "αωΓΩ":
        assert unicodedata.name(letter).split()[-1].lower() in {name.lower() for name in commands}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("–", "--"), ("a − b", "a $-$ b"), ("± 3", r"$\pm$ 3"), ("5 °", r"5 $^\circ$"), ("m/s²", "m/s$^2$"), ("µg", r"$\mu$g"),
        ("λ Λ", r"$\lambda$ $\Lambda$"), ("x < 3 | y > 2", "x $<$ 3 $|$ y $>$ 2"), ("Müller, Čech", r'M\"{u}ller, \v{C}ech'),
        ("中", "(U+4E2D)"), ("10⁻³", "10$^-$$^3$"), ("50 % of a_b", r"50 \% of a\_b"),
    ],
)  # fmt: skip
def test_what_a_sign_becomes(text, said):
    assert writers.format_latex(pd.DataFrame({"a": [text]})).splitlines()[4] == said + r" \\"


def test_numbers_that_are_none():
    table = pd.DataFrame({"a": [np.inf, -np.inf, np.nan]})
    assert writers.format_latex(table).splitlines()[4:7] == [
        r"$\infty$ \\",
        r"$-\infty$ \\",
        r"-- \\",
    ]
