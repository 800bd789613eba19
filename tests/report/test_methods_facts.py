"""The methods paragraph is written from facts alone: of results, of a stored page, and for a paper."""

import shutil
from pathlib import Path
from typing import Any

import pytest
import synthetic_results as synthetic
from command_line import pfbench
from page_packs import build_pack

from pfbench.report import RUNS_FILE, format_runs, read_stored_study, rebuild_page, write_report
from pfbench.report.journal.paper_folder import format_methods
from pfbench.report.methods_text import FACTS, collect_methods_facts, read_facts, write_methods
from pfbench.results.conditions import Condition, load_conditions

# another value of each fact, and words that the paragraph then has
CHANGED: dict[str, tuple[Any, str]] = {
    "filters": (1, "compares 1 filter with pfbench"),
    "scenarios": (["Canyon", "Flight"], "2 scenarios of 1 world (Canyon; Flight)"),
    "worlds": (5, "5 worlds say little about another world."),
    "regimes": (["Calm", "Surge"], "2 noise regimes (Calm; Surge)"),
    "runs": ([9, 50, 100], "9, 50 and 100 Monte Carlo runs"),
    "steps": ([300, 500], "of 300 and 500 steps per condition"),
    "seeds": ([1, 2], "(seed 1, 2)"),
    "particles": ({"f0": [100], "f1": [100], "f2": [200]}, "exceptions: 200 (Filter 2)."),
    "budgets": (["particles", "time"], "chosen for equal cost (time)."),
    "metric": ("CRPS", "The metric is the CRPS over the time of a run"),
    "alpha": (0.01, "simultaneous intervals (99 %)"),
    "margin": (0.1, "Equal: the interval lies within 10 %, and fewer"),
    "rounds": (7, "Times per step are medians of 7 or more rounds"),
    "software": (
        {"pfbench": ["1.2"], "commit": [], "python": ["3.14"], "torch": ["2.9"], "numpy": ["2.4"],
         "dtype": ["float32"], "device": ["cuda"], "threads": ["4"]},
        "pfbench 1.2 (commit unknown), Python 3.14, torch 2.9, numpy 2.4; float32 on cuda (4 threads).",
    ),
    "is_recorded": (True, "that no result was repeated with another. One world says"),
    "has_threshold": (False, "No divergence threshold is stated, so only numerical failures count."),
    "is_complete": (False, "Not every filter was run in every condition."),
    "tuned": ({"data A": 1, "data B": 1}, "Parameters of 1 of 3 filters were tuned on data B."),
}  # fmt: skip


@pytest.fixture
def pack() -> dict[str, Any]:
    """A page of one world with particle filters."""
    made = build_pack(3, 1, 1, 20, carried=0)
    made["methods"]["particles"] = {"f0": [100], "f1": [100]}
    return made


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of an invented study, and its report."""
    folder = tmp_path_factory.mktemp("facts")
    synthetic.study(folder / "results" / "demo", runs=4, steps=5)
    write_report("demo", folder / "results", folder / "reports")
    return folder


@pytest.fixture
def conditions(home: Path) -> list[Condition]:
    return load_conditions("demo", home / "results")


def text_of(pack: dict[str, Any]) -> str:
    return "\n".join(write_methods(pack))


def test_each_fact_has_a_sentence(pack: dict[str, Any]) -> None:
    assert sorted(CHANGED) == sorted(FACTS)
    before = text_of(pack)
    for name, (value, words) in CHANGED.items():
        changed = text_of({**pack, "methods": {**pack["methods"], name: value}})
        assert words not in before, name
        assert words in changed, name


@pytest.mark.parametrize("name", FACTS)
def test_a_missing_fact_is_named(name: str, pack: dict[str, Any]) -> None:
    del pack["methods"][name]
    with pytest.raises(ValueError, match=rf"got none for {name}\. Run the study and write"):
        write_methods(pack)


def test_a_stored_page_without_facts_is_refused(home: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(home / "reports" / "demo", tmp_path / "reports" / "demo"))
    file = folder / RUNS_FILE
    page = (folder / "index.html").read_bytes()
    stored = read_stored_study(folder)
    facts = {key: value for key, value in stored.pack["methods"].items() if key != "seeds"}
    for methods, missing in ((facts, "seeds"), (None, ", ".join(FACTS))):
        file.write_bytes(format_runs(stored.table, {**stored.pack, "methods": methods}))
        for words in (("report",), ("paper", "journal=ieee")):
            said = pfbench(*words, "study=demo", f"reports_dir={folder.parent}", home=tmp_path)
            assert said.code == 2
            assert f"{file} must have all facts of the methods paragraph" in said.err
            assert f"got none for {missing}. Run the study and write its report again." in said.err
    assert (folder / "index.html").read_bytes() == page
    assert not (folder / "paper").exists()


def test_all_readers_write_the_same_paragraph(home: Path, tmp_path: Path) -> None:
    """A fresh report, a page of stored data, and papers with and without results."""
    folder = Path(shutil.copytree(home / "reports" / "demo", tmp_path / "reports" / "demo"))
    stored = read_stored_study(folder).pack
    texts = write_methods(stored)
    for page in (folder / "index.html", rebuild_page(folder)):
        shown = page.read_text().replace("&#39;", "'")
        assert all(f"<p>{text}</p>" in shown for text in texts)
    for place in (home, tmp_path):  # the second has no results
        words = ("study=demo", "journal=ieee", f"reports_dir={place}/reports")
        assert (said := pfbench("paper", *words, home=place)).code == 0, said.err
        written = (place / "reports" / "demo" / "paper" / "methods.tex").read_text()
        assert written == format_methods(texts)
    assert stored["methods"] == collect_methods_facts(load_conditions("demo", home / "results"))


def test_pairs_and_names_are_those_that_the_page_decides_again(pack: dict[str, Any]) -> None:
    pack["methods"]["particles"] = {"f0": [100], "f1": [200]}
    pack["filters"][1]["name"] = "New name"
    pack["planned"] = [{}, {}]
    text = text_of(pack)
    assert "Particle filters used 100 (Filter 0) and 200 (New name) particles." in text
    assert (
        "table: the 2 planned pairs and the filters against the first baseline, and all other pairs."
        in text
    )
    pack["planned"] = [{}]
    assert "table: the 1 planned pair and the filters against" in text_of(pack)
    pack["planned"] = []
    assert "Two families share the pairs of a table: the filters against the first" in text_of(pack)


def test_the_paragraph_has_the_words_of_the_tests_that_decide(pack: dict[str, Any]) -> None:
    text = text_of(pack)
    for words in (
        "Hodges and Lehmann",
        "Wilcoxon's signed-rank test",
        "trimmed mean",
        "Holm's correction",
        "and the sign test reject, each after Holm's correction, and all agree in sign",
        "the bounds of Clopper and Pearson",
        "Loses more: McNemar's exact test",
        "There is no ratio where more than a fifth of the pairs has a lost run.",
    ):
        assert words in text
    assert "lost or diverges is worse than every other one, and two such runs tie" in text


@pytest.mark.parametrize(("numbers", "text", "kind"), [
    ({"f0": [100], "f1": [100]}, "100 particles", "equal"),
    ({"f0": [100], "f1": [100], "f2": [200]}, "100 particles, with these exceptions: 200 (Filter 2)", "different"),
    ({"f0": [150], "f1": [200]}, "150 (Filter 0) and 200 (Filter 1) particles", "different"),
    ({"f0": [50, 100], "f1": [50, 100]}, "50 or 100 particles", "equal"),
    ({"f0": [64]}, "64 particles", ""),
])  # fmt: skip
def test_the_methods_name_filters_with_other_numbers_of_particles(
    numbers: dict[str, list[int]], text: str, kind: str, pack: dict[str, Any]
) -> None:
    pack["methods"]["particles"] = numbers
    end = f": particle filters have {kind} numbers of particles." if kind else "."
    assert f" Particle filters used {text}. " in text_of(pack)
    assert f" The filters were not given equal time{end} " in text_of(pack)


def test_facts_are_those_of_the_results(conditions: list[Condition]) -> None:
    facts = read_facts(collect_methods_facts(conditions, metric="CRPS"))
    assert (facts.filters, facts.worlds, facts.metric) == (4, 1, "CRPS")
    assert (facts.scenarios, facts.regimes) == (["flight"], ["surge"])
    assert (facts.runs, facts.steps, facts.seeds) == ([4], [5], [5])
    assert facts.particles == {"sir": [200], "cofm_amssrcpf": [200]}
    assert facts.software == {
        **{name: [value] for name, value in synthetic.VERSIONS.items()},
        "dtype": ["float64"], "device": ["cpu"], "threads": ["1"],
    }  # fmt: skip
    assert (facts.rounds, facts.budgets, facts.tuned) == (0, ["particles"], {})
    assert (facts.is_recorded, facts.has_threshold, facts.is_complete) == (False, False, True)


def test_facts_follow_the_metadata_of_the_jobs(conditions: list[Condition]) -> None:
    jobs = conditions[0].jobs
    for number, job in enumerate(jobs):
        job.meta["step_time"] = {"rounds": [1.0] * (7 + number)}
    jobs[0].meta["config"]["budget"] = "time"
    jobs[1].meta["config"]["scenario"] = {"root": "folder", "paper": {"divergence_threshold": 9.0}}
    jobs[2].meta["particles"], jobs[3].meta["seed"] = 50, 6
    facts = read_facts(collect_methods_facts(conditions))
    assert facts.rounds == 7
    assert facts.budgets == ["particles", "time"]
    assert (facts.is_recorded, facts.has_threshold) == (True, True)
    assert facts.particles[jobs[2].label] == [50]
    assert facts.seeds == [5, 6]
    partial = conditions[0]._replace(jobs=jobs[:2])
    assert not collect_methods_facts([*conditions, partial])["is_complete"]
