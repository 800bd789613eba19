"""The oracle book: cheap rows by day and all of them at night are as on the page; rules of a hit, R's generator, kept rows."""

import json
import math
from pathlib import Path

import pytest
from command_line import pfbench
from pfbench.experiments.oracles import book, page
from pfbench.experiments.oracles.r_numbers import RNumbers

VALUES = json.loads(page.VALUES.read_text())
ROWS = {row["id"]: row for row in VALUES["rows"]}
CHEAP = [entry.name for entry in book.list_recipes() if entry.seconds <= 1]


def check_recipe(name: str) -> None:
    """Compute the rows of a recipe: they are hits where the page says so, with the values of the page."""
    (entry,) = book.list_recipes(name)
    rows = book.compute_rows(entry)["rows"]
    assert {row["id"] for row in rows} == {key for key in ROWS if key.startswith(f"{name}.")}
    for row in rows:
        stored = ROWS[row["id"]]
        assert row["hit"] == stored["hit"], row
        assert row["printed"] == pytest.approx(stored["printed"], rel=1e-12)
        room = row["tolerance"] / 10 + 3 * math.hypot(row["our_error"], stored["our_error"])
        assert abs(row["ours"] - stored["ours"]) <= room + 1e-9 * abs(row["ours"]), row


@pytest.mark.parametrize("name", CHEAP)
def test_cheap_rows_are_those_of_the_page(name: str) -> None:
    check_recipe(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", [e.name for e in book.list_recipes() if e.name not in CHEAP])
def test_all_rows_are_those_of_the_page(name: str) -> None:
    check_recipe(name)


def test_the_page_is_that_of_the_stored_rows() -> None:
    rows = page.list_numbers(VALUES)
    assert page.PAGE.read_text() == page.format_page(VALUES)
    assert page.PICTURE.read_text() == page.draw_picture(rows)
    assert len(rows) >= 60


@pytest.mark.parametrize(
    ("ours", "errors", "is_hit"),
    [(1.04, (0.0, 0.0), True), (1.06, (0.0, 0.0), False), (1.19, (0.04, 0.03), True), (1.21, (0.04, 0.03), False), (math.nan, (1.0, 1.0), False)],
)  # fmt: skip
def test_a_hit_is_within_rounding_and_three_standard_errors(
    ours: float, errors: tuple[float, float], is_hit: bool
) -> None:
    number = book.Number("a", "b", 1.0, ours, 0.05, *errors)
    assert number.is_hit == is_hit
    expected = (ours - 1.0) / math.sqrt(errors[0] ** 2 + errors[1] ** 2 + 0.05**2 / 3)
    assert number.z == pytest.approx(expected, nan_ok=True)


def test_normal_numbers_are_those_that_r_prints() -> None:
    """Of set.seed(1), set.seed(123) and set.seed(42), in the documentation of many packages."""
    first = [round(value, 7) for value in RNumbers(1).normals(3)]
    assert first == [-0.6264538, 0.1836433, -0.8356286]
    assert round(RNumbers(123).normals(3)[2], 8) == 1.55870831
    assert round(RNumbers(42).normal(), 8) == 1.37095845


def test_finished_rows_are_kept_until_a_source_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("check", "oracles", "earth_radii", f"results_dir={tmp_path}")
    first, second = (pfbench(*words, home=tmp_path).out.splitlines() for _ in range(2))
    assert all(" s]" in line for line in first[1:-1])
    assert all("[kept]" in line for line in second[1:-1])
    assert first[-1] == "4 of 4 rows are met"
    monkeypatch.setattr(book, "find_digest", lambda: "123456789012")
    assert "[kept]" not in pfbench(*words, home=tmp_path).out
    assert [file.stem for file in (tmp_path / "oracles").iterdir()] == ["earth_radii_123456789012"]
    (one,) = pfbench("check", "oracles", "earth_radii.meridian_0", home=tmp_path).out.splitlines()[1:-1]  # fmt: skip
    assert "earth_radii.meridian_0" in one


def test_an_unknown_name_is_refused_before_any_work(tmp_path: Path) -> None:
    said = pfbench("check", "oracles", "earth_radi.meridian_0", home=tmp_path)
    assert said.code == 2
    assert "got earth_radi. Similar: earth_radii. Use: pfbench check oracles NAME" in said.err
    assert not list(tmp_path.iterdir())


def test_the_digest_depends_on_recipes_and_on_pfbench(monkeypatch: pytest.MonkeyPatch) -> None:
    before = book.find_digest()
    monkeypatch.setattr(book, "hash_folder", lambda folder: "other")
    assert book.find_digest() != before
