"""One verdict for each pair of a published study, in all that shows it; its ratio is that of the errors of the runs.

The crawler reads the texts that a reader gets: the data in the html page, report.md, the tables, and what `summary` and
`compare` print. An oracle without code of pfbench computes the tables again from the stored runs.
"""

import base64
import gzip
import io
import json
import math
import re
import shutil
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from checkout import ROOT, list_published
from row_oracle import compare_pairs, compare_rows

from pfbench.door.comparisons import Comparison
from pfbench.report import RUNS_FILE, read_stored_study, render_study
from pfbench.report.board.entries import StudyFacts, ViewKey
from pfbench.report.board.pack import open_court
from pfbench.report.study_page.page_writer import describe_opening

FEW = ["paper_000_growth", "paper_004_alone", "paper_003_states"]
TURNED = {"better": "worse", "worse": "better"}
OTHERS = ("baseline", "missing", "loses track")  # verdicts that are no word on a pair
Said = tuple[
    str, str, str, str, float | None, float
]  # place, first, second, word, ratio, tolerance


def read_texts(study: str) -> tuple[dict[str, Any], dict[str, str]]:
    """All texts of a study by file, made from its stored runs, with report.md as it is published."""
    folder = ROOT / "reports" / study
    pack, table = read_stored_study(folder)
    pack["paper_figures"] = ()  # pictures
    files = render_study(pack, table, folder, {})
    texts = {name: text for name, text in files.items() if isinstance(text, str)}
    return pack, {**texts, "report.md": (folder / "report.md").read_text()}


def read_html(text: str) -> dict[str, Any]:
    """The data that a page carries for its script."""
    found = re.search(r'id="data">([^<]*)<', text)
    assert found is not None
    data: dict[str, Any] = json.loads(gzip.decompress(base64.b64decode(found[1])))
    return data


def crawl(pack: dict[str, Any], texts: dict[str, str]) -> tuple[int, list[str]]:
    """Compare every word and ratio on a pair with the tables of the study; return their number and the contradictions."""
    is_board = (
        "worlds.html" in texts
    )  # the first page of several methods stands before that of the study
    html, markdown = ("worlds.html", "worlds.md") if is_board else ("index.html", "report.md")
    decisions = pd.read_csv(io.StringIO(texts["decisions.csv"])).to_dict("records")
    views = pd.read_csv(io.StringIO(texts["verdicts.csv"])).to_dict("records")
    metric = pack["facts"]["options"]["metric"]
    decided = {("pair", r["world"], r["a"], r["b"]): r for r in decisions}
    decided |= {("pair", w, b, a): turn(r) for (_, w, a, b), r in decided.items()}
    rows = {
        ("view", r["metric"], r["world"], r["regime"], r["baseline"], r["filter"]): r for r in views
    }
    said: list[tuple[str, Any, str, Any, float]] = []
    data = read_html(texts[html])
    for pair in data["planned"]:
        said.append(
            (
                f"{html} planned",
                ("pair", "all", pair["a"], pair["b"]),
                pair["word"],
                pair["estimate"],
                2e-3,
            )
        )
    for key, row in list_html_rows(data):
        said.append(
            (f"{html} view", ("view", *key, row["filter"]), row["verdict"], row["ratio"], 1e-9)
        )
        said.append(
            (f"{html} words", ("view", *key, row["filter"]), start_of(row), row["ratio"], 1e-9)
        )
    for row in views:
        key = "pair", row["world"], row["filter"], row["baseline"]
        if (
            row["metric"] == metric
            and row["regime"] == "all"
            and key in decided
            and row["verdict"] not in OTHERS
        ):
            said.append(("verdicts.csv", key, row["verdict"], row["ratio"], 1e-3))
    key = ViewKey(*data["opening"])
    for place, text in ((markdown, texts[markdown]), ("summary", write_summary(pack))):
        for world, name, word, ratio in read_tables(text, pack, key):
            said.append(
                (
                    place,
                    ("view", key.metric, world, key.regime, key.baseline, name),
                    word,
                    ratio,
                    0.03,
                )
            )
    decided |= rows
    problems = []
    for place, where, word, ratio, tolerance in said:
        row = decided.get(where)
        if row is None:
            problems.append(f"{place}: {where} is in no table")
            continue
        wanted, shown = row.get("word", row.get("verdict")), math.nan if ratio is None else ratio
        if word != wanted:
            problems.append(f"{place} {where}: {word} against {wanted}")
        elif not (
            math.isclose(row["ratio"], shown, rel_tol=tolerance)
            or (pd.isna(shown) and (pd.isna(row["ratio"]) or word == "baseline"))
        ):
            problems.append(f"{place} {where}: {shown} is not {row['ratio']}")
    return len(said), problems + check_first(pack, texts[markdown])


def list_html_rows(data: dict[str, Any]) -> list[tuple[tuple[str, ...], dict[str, Any]]]:
    """Rows of all views of a page, which has them as lists."""
    views, found = data["views"], []
    for key, rows in zip(views["keys"], views["rows"], strict=True):
        for values in rows:
            found.append((tuple(key), dict(zip(views["columns"], values, strict=True))))
    return found


def start_of(row: dict[str, Any]) -> str:
    """The verdict that the words of a row begin with."""
    words = str(row["words"])
    return (
        str(row["verdict"])
        if row["verdict"] == "missing" or words.startswith(str(row["verdict"]))
        else words.partition(",")[0].partition(" within")[0]
    )


def write_summary(pack: dict[str, Any]) -> str:
    """The tables that `study.summary` prints, of the opening view alone, as Markdown."""
    opening = describe_opening(pack)
    lines = ["| # | filter | ratio | verdict |"]
    lines += [
        f"| {r['rank']} | {r['name']} | {r['ratio']} {r['interval']} | {r['words']} |"
        for r in opening["rows"]
    ]
    return "\n".join([opening["caption"], "", *lines])


def read_tables(text: str, pack: dict[str, Any], key: ViewKey) -> list[tuple[str, str, str, float]]:
    """World, filter, word and ratio of the rows of the tables of a text."""
    names = {look["name"]: look["key"] for look in pack["filters"]}
    worlds = {world["name"]: world["key"] for world in pack["worlds"]}
    world, found = key.world, []
    for line in text.splitlines():
        caption = re.fullmatch(r"(.*); ratio to .*\.", line)
        if caption and pack.get("world_orders"):
            world = next((worlds[part] for part in caption[1].split("; ") if part in worlds), world)
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        name = cells[1].removesuffix(" (proposed)") if len(cells) > 3 else ""
        if line.startswith("| ") and name in names and re.match(r"\d+$|–$|$", cells[0]):
            word = re.sub(r"^\W+", "", cells[3]).partition(",")[0].partition(" within")[0]
            word = re.sub(r"^loses (track|runs) in .*", "loses track", word)
            number = re.match(r"[\d.e+-]+", cells[2])
            ratio = float(number[0]) if number and re.search(r"\d", number[0]) else math.nan
            found.append(
                (world, names[name], word.replace("not run in all conditions", "missing"), ratio)
            )
    return found


def turn(row: dict[str, Any]) -> dict[str, Any]:
    return {
        **row,
        "word": TURNED.get(row["word"], row["word"]),
        "ratio": 1 / row["ratio"] if row["ratio"] else math.inf,
    }


def check_first(pack: dict[str, Any], markdown: str) -> list[str]:
    """The filter that a sentence calls the first of its table is in the first row of its table."""
    texts = describe_opening(pack)["texts"]
    tables = re.findall(r"^\| 1 \| ([^|]*?)(?: \(proposed\))? \|", markdown, re.MULTILINE)
    problems = []
    for text in texts:
        named = re.search(
            r"(?:irst in the table|\(first|First): (.*?)(?:, [\d.]+ |, [a-z]|\)[;.])", text
        )
        if text not in markdown:
            problems.append(f"report.md lacks: {text}")
        if named and named[1] not in tables:
            problems.append(f"{named[1]} is not among {tables}: {text}")
    return problems


def compare_in_console(pack: dict[str, Any], table: pd.DataFrame) -> list[str]:
    """What `compare` prints of each pair with the baseline is the word and the ratio of the row of its condition."""
    facts, problems = StudyFacts.from_pack(pack), []
    court = open_court(table, facts.looks, facts.options)
    conditions = court.runs.conditions
    for key, view in pack["views"].items():
        mask = (
            (conditions["scenario"] == key.world) & (conditions["regime"] == key.regime)
        ).to_numpy()
        if key.metric != "rmse" or not mask.any():
            continue
        for row in view["rows"]:
            if row["verdict"] in OTHERS:
                continue
            text = repr(Comparison({"c": court.find("rmse", mask, row["filter"], key.baseline)}))
            if f": {row['verdict']}" not in text:
                problems.append(f"{key} {row['filter']}: {row['verdict']} against {text}")
            if (number := re.search(r" is ([\d.]+) ", text)) and not math.isclose(
                float(number[1]), row["ratio"], rel_tol=0.03
            ):
                problems.append(f"{key} {row['filter']}: {row['ratio']} against {text}")
    return problems


def compute_again(study: str, texts: dict[str, str], folder: Path) -> list[str]:
    """Compute the tables of a study again from its stored runs by scipy alone, without any code of pfbench."""
    for name in ("decisions.csv", "verdicts.csv"):
        (folder / name).write_text(texts[name])
    shutil.copy(ROOT / "reports" / study / RUNS_FILE, folder)
    (rows, problems), (pairs, others) = compare_rows(folder), compare_pairs(folder, 10**6)
    return problems + others if rows and pairs else [f"{study}: nothing was computed"]


def check_study(study: str, folder: Path) -> None:
    pack, texts = read_texts(study)
    count, problems = crawl(pack, texts)
    assert count > 20
    console = compare_in_console(*read_stored_study(ROOT / "reports" / study))
    assert problems == console == compute_again(study, texts, folder) == []


@pytest.mark.parametrize("study", FEW)
def test_a_pair_has_one_word_and_one_ratio(study: str, tmp_path: Path) -> None:
    check_study(study, tmp_path)


def plant_in_html(text: str, column: str, value: Any) -> str:
    data = read_html(text)
    columns = data["views"]["columns"]
    row = next(r for r in data["views"]["rows"][0] if r[columns.index("verdict")] not in OTHERS)
    row[columns.index(column)] = value
    packed = base64.b64encode(gzip.compress(json.dumps(data).encode())).decode()
    return re.sub(r'(id="data">)[^<]*<', lambda m: f"{m[1]}{packed}<", text)


PLANTED = {
    "word in html": ("index.html", lambda text: plant_in_html(text, "verdict", "worse")),
    "ratio in html": ("index.html", lambda text: plant_in_html(text, "ratio", 1.234)),
    "number in report.md": ("report.md", lambda text: text.replace("| 0.998 [", "| 0.898 [", 1)),
    "word in report.md": ("report.md", lambda text: text.replace("equal within", "better within", 1)),
    "word in a table": ("decisions.csv", lambda text: text.replace(",equal,", ",worse,", 1)),
    "sentence": ("report.md", lambda text: text.replace("first in the table: ", "first in the table: Another ", 1).replace("Of ", "Of all ", 1)),
}  # fmt: skip


@pytest.mark.parametrize("kind", PLANTED)
def test_a_planted_contradiction_is_found(kind: str) -> None:
    pack, texts = read_texts(FEW[0])
    name, change = PLANTED[kind]
    changed = change(texts[name])
    assert changed != texts[name]
    assert crawl(pack, {**texts, name: changed})[1] != []


@pytest.mark.slow
@pytest.mark.parametrize(
    "study", [p.name for p in list_published() if (p / RUNS_FILE).is_file() and p.name not in FEW]
)
def test_a_pair_has_one_word_and_one_ratio_in_every_study(study: str, tmp_path: Path) -> None:
    check_study(study, tmp_path)
