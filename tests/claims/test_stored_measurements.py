"""Measurements beside the page of the claims: the same verdicts without results, study by study."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from synthetic_results import METHODS, write

from pfbench.claims import page, page as figures
from pfbench.claims.claim_records import Claim, ClaimTest

CELL = "flight/surge/ins_gnss"
TEST = ClaimTest("less", "one", CELL, "rmse", "cofm_amssrcpf", "ekf", group="position")
FILES = ("verdicts.json", "measurements.parquet", "jobs.json", "report.md", "index.html")


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Results of two studies, and a claim on each."""
    for study in ("one", "two"):
        for method in METHODS:
            write(tmp_path / "results" / study, method, runs=20, steps=20)
    tests = {"": (TEST, replace(TEST, study="two", a="ukf"))}
    claims = [Claim("X-1", "000", "", "", "", tests, {})]
    monkeypatch.setattr(page, "read_claims", lambda *_: claims)
    monkeypatch.setattr(figures, "claim_figures", lambda _: [])
    return tmp_path


def write_page(home: Path) -> dict[str, bytes]:
    folder = page.write_claims(home / "results", home / "reports").parent
    return {name: (folder / name).read_bytes() for name in FILES}


def test_without_results_the_page_is_the_same_to_the_last_byte(home: Path) -> None:
    first = write_page(home)
    for study in ("two", "one"):  # first of results and files, then of files alone
        shutil.rmtree(home / "results" / study)
        assert write_page(home) == first


def test_the_verdict_follows_the_stored_values(home: Path) -> None:
    write_page(home)
    shutil.rmtree(home / "results")
    path = home / "reports" / "claims" / "measurements.parquet"
    rows = pd.read_parquet(path)
    rows.loc[(rows["study"] == "one") & (rows["label"] == "cofm_amssrcpf"), "value"] *= 9
    rows.to_parquet(path)
    (record,) = json.loads(write_page(home)["verdicts.json"])
    first, second = record["findings"][""]
    assert (first["outcome"], second["pairs"]) == ("fails", 20)


def test_results_replace_the_stored_values_of_their_study(home: Path) -> None:
    write_page(home)
    shutil.rmtree(home / "results")
    for method in METHODS:
        write(home / "results" / "one", method, runs=30, steps=20)
    (record,) = json.loads(write_page(home)["verdicts.json"])
    assert [test["pairs"] for test in record["findings"][""]] == [30, 20]


def test_values_that_no_claim_asks_for_are_not_kept(home: Path) -> None:
    write_page(home)
    path = home / "reports" / "claims" / "measurements.parquet"
    rows = pd.read_parquet(path)
    pd.concat([rows, rows.assign(study="old")]).to_parquet(path)
    shutil.rmtree(home / "results")
    write_page(home)
    assert len(pd.read_parquet(path)) == len(rows)


@pytest.mark.parametrize("name", ["measurements.parquet", "jobs.json"])
def test_a_damaged_file_is_named_and_nothing_is_written(home: Path, name: str) -> None:
    before = write_page(home)
    path = home / "reports" / "claims" / name
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(
        ValueError, match=rf"{re.escape(str(path))} must be written by.*make studies"
    ):
        write_page(home)
    page_file = home / "reports" / "claims" / "index.html"
    assert page_file.read_bytes() == before["index.html"]
