"""`pfbench data`: the list is that of the page, and a folder is checked file by file."""

import hashlib
from pathlib import Path

import pytest
from checkout import ROOT
from command_line import pfbench as command

from pfbench.logs.cli import data
from pfbench.logs.cli.data import check_data_set, read_data_sets
from pfbench.results.paper_block import list_named_parts, read_part

CONTENT = b"t,x\n0,1\n"
FILES = {"imu.csv": {"bytes": len(CONTENT), "sha256": hashlib.sha256(CONTENT).hexdigest()}}


def test_the_states_of_a_data_set(tmp_path: Path) -> None:
    assert check_data_set("walk", FILES, tmp_path)[0] == "missing"
    (tmp_path / "walk").mkdir()
    assert check_data_set("walk", FILES, tmp_path)[1] == ["walk/imu.csv is missing"]
    (tmp_path / "walk" / "imu.csv").write_bytes(CONTENT)
    assert check_data_set("walk", FILES, tmp_path)[0] == "complete"
    (tmp_path / "walk" / "imu.csv").write_bytes(CONTENT.replace(b"1", b"2"))
    assert check_data_set("walk", FILES, tmp_path)[1] == ["walk/imu.csv differs"]


def test_a_damaged_folder_is_refused_with_its_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    entry = next(iter(read_data_sets().values()))
    monkeypatch.setattr(data, "read_data_sets", lambda: {"walk": {**entry, "files": FILES}})
    (tmp_path / "walk").mkdir()
    with pytest.raises(ValueError, match=r"got .* where walk/imu.csv is missing"):
        data.list_data([str(tmp_path)])
    (tmp_path / "walk" / "imu.csv").write_bytes(CONTENT)
    data.list_data([str(tmp_path)])
    assert "1 of 1 data sets are complete" in capsys.readouterr().out


def test_bad_words_are_answered_by_a_sentence(tmp_path: Path) -> None:
    said = command("data", "nowhere", home=tmp_path)
    assert said.code == 2
    assert "FOLDER must be a folder, got nowhere." in said.err
    assert "must receive one folder, got a b" in command("data", "a", "b", home=tmp_path).err


def test_the_page_has_source_commit_licence_and_size_of_each() -> None:
    page = (ROOT / "docs" / "data_sets.md").read_text()
    for name, facts in read_data_sets().items():
        (row,) = [line for line in page.splitlines() if line.startswith(f"| `{name}` |")]
        size = sum(file["bytes"] for file in facts["files"].values()) / 1e6
        for text in (facts["source"], facts["commit"][:10], facts["licence"], f" {size:.1f} "):
            assert text in row
        assert len(facts["commit"]) == 40
        assert all(len(file["sha256"]) == 64 for file in facts["files"].values())


def test_all_folders_that_scenarios_name_are_listed() -> None:
    names = set(read_data_sets())
    for part in [
        (group, name) for group in ("scenario", "noise") for name in list_named_parts(group)
    ]:
        text = read_part(*part)
        if "${data.root}" in text and not part[1].startswith("user_"):
            assert any(name in text for name in names), part
