"""A writer removes only what its manifest lists with the same content; everything else stays, and a line says so."""

import json
import re
import shutil
from pathlib import Path

import pytest
from checkout import ROOT
from command_line import plant_programs, run_git
from refusals import check_refused

from pfbench.files import recorded_folder
from pfbench.files.atomic_write import DIGEST, hash_content, remove_temporary_files
from pfbench.files.recorded_folder import MANIFEST, RecordedFolder

OLD = {"page.md": "old page", "figures/a.svg": "a", "figures/b.svg": "b", "tables/t.csv": "1"}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder that was written once."""
    write(tmp_path / "report", OLD)
    return tmp_path / "report"


def write(folder: Path, files: dict[str, str]) -> None:
    with RecordedFolder(folder) as recorded:
        for name, content in files.items():
            recorded.write(name, content)


def content(folder: Path) -> dict[str, str]:
    return {
        path.relative_to(folder).as_posix(): path.read_text()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != MANIFEST
    }


def write_manifest(folder: Path, files: dict[str, str]) -> None:
    """Write a manifest whose digest is right."""
    plain = {"files": files}
    (folder / MANIFEST).write_text(json.dumps({**plain, DIGEST: hash_content(plain)}))


def test_old_files_go_and_equal_runs_give_equal_bytes(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    first = (folder / MANIFEST).read_bytes()
    write(folder, OLD)
    assert (folder / MANIFEST).read_bytes() == first
    write(folder, {"page.md": "new page", "figures/a.svg": "a"})
    assert content(folder) == {"page.md": "new page", "figures/a.svg": "a"}
    assert caplog.text == ""


def test_files_of_the_user_stay_and_are_named(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    mine = {"figures/photo.png": "photo", "tables/mine.csv": "2", "notes.txt": "note"}
    for name, text in mine.items():
        (folder / name).write_text(text)
    (folder / "figures" / "b.svg").write_text("b, changed by hand")
    write(folder, {"page.md": "new page"})
    assert content(folder) == {
        **mine,
        "figures/b.svg": "b, changed by hand",
        "page.md": "new page",
    }
    assert "figures/b.svg, figures/photo.png, notes.txt and 1 more" in caplog.text


def test_folders_of_other_commands_are_not_named(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write(folder / "paper", {"paper.tex": "paper"})
    (folder / "paper" / "mine.tex").write_text("mine")
    (folder / "other").mkdir()
    (folder / "other" / "mine.txt").write_text("mine")
    write(folder, {"page.md": "new page"})
    assert "removed: other/mine.txt" in caplog.text.replace("\n", " ")
    assert "paper.tex" not in caplog.text
    caplog.clear()
    write(folder / "paper", {"paper.tex": "paper"})
    assert "removed: mine.tex" in caplog.text


def test_a_file_in_the_way_is_renamed(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    (folder / "page.md").write_text("page, changed by hand")
    (folder / "new.md").write_text("not of the manifest")
    (folder / "same.md").write_text("same")
    write(folder, {**OLD, "page.md": "new page", "new.md": "new", "same.md": "same"})
    assert content(folder) == {
        **OLD,
        "page.md": "new page",
        "new.md": "new",
        "same.md": "same",
        "page.md.kept": "page, changed by hand",
        "new.md.kept": "not of the manifest",
    }
    assert "page.md.kept, new.md.kept" in caplog.text


def test_a_first_report_replaces_no_file(tmp_path: Path) -> None:
    (tmp_path / "page.md").write_text("written before")
    write(tmp_path, {"page.md": "new"})
    assert content(tmp_path) == {"page.md": "new", "page.md.kept": "written before"}


def test_links_are_neither_followed_nor_removed(folder: Path, tmp_path: Path) -> None:
    precious = tmp_path / "precious.svg"
    precious.write_text("a")  # equal to the content that the manifest lists
    for name in ("figures/a.svg", "page.md"):
        (folder / name).unlink()
        (folder / name).symlink_to(precious)
    write(folder, {"page.md": "new page"})
    assert precious.read_text() == "a"
    assert (folder / "figures" / "a.svg").is_symlink()
    assert (folder / "page.md.kept").is_symlink()
    assert not (folder / "page.md").is_symlink()


def test_a_linked_folder_is_not_written_to(folder: Path, tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    (folder / "figures").rename(photos)
    (folder / "figures").symlink_to(photos)
    write(folder, {"page.md": "new page"})
    assert content(photos) == {"a.svg": "a", "b.svg": "b"}  # digests of the manifest
    check_refused(
        [("must be a folder, got a link", lambda: write(folder, {"figures/a.svg": "new"}))],
        remedy=False,
    )
    assert content(photos) == {"a.svg": "a", "b.svg": "b"}
    check_refused(
        [("figures must be a folder, got a link", lambda: RecordedFolder(folder / "figures"))],
        remedy=False,
    )


@pytest.mark.parametrize(
    "name", ["../x", "figures/../../x", "/tmp/x", "", "figures//x", "a\\b", "./x", MANIFEST]
)
def test_names_outside_of_the_folder_are_refused(
    folder: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    outside = folder.parent / "x"
    outside.write_text("mine")
    write_manifest(folder, {name: hash_content(b"mine"), "figures/a.svg": hash_content(b"a")})
    write(folder, {"page.md": "new page"})
    assert outside.read_text() == "mine"
    assert (folder / "figures" / "a.svg").exists()  # nothing of a suspicious manifest is removed
    assert f"{name!r} is not a file of this folder" in caplog.text
    assert f"{MANIFEST}.damaged" in caplog.text
    check_refused([("must be a path within", lambda: write(folder, {name: "x"}))], remedy=False)


def test_an_absolute_name_is_refused(folder: Path) -> None:
    outside = folder.parent / "x"
    outside.write_text("mine")
    write_manifest(folder, {str(outside): hash_content(b"mine")})
    write(folder, {"page.md": "new page"})
    assert outside.read_text() == "mine"


DAMAGED = (
    "",
    "{",
    "[]",
    "null",
    '{"files": {}}',
    '{"files": 1, "digest": "0"}',
    "\x00",
    "[" * 9999,
)


@pytest.mark.parametrize("text", DAMAGED, ids=range(len(DAMAGED)))
def test_a_damaged_manifest_removes_nothing(
    folder: Path, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    (folder / MANIFEST).write_text(text)
    write(folder, {"page.md": "new page"})
    assert (
        content(folder).items()
        >= {
            "figures/a.svg": "a",
            "tables/t.csv": "1",
            "page.md.kept": "old page",
        }.items()
    )
    assert "Renamed to manifest.json.damaged, and no file is removed" in caplog.text


def test_a_changed_manifest_removes_nothing(folder: Path) -> None:
    manifest = json.loads((folder / MANIFEST).read_text())
    (folder / "mine.txt").write_text("mine")
    manifest["files"]["mine.txt"] = hash_content(b"mine")
    (folder / MANIFEST).write_text(json.dumps(manifest))
    write(folder, {"page.md": "old page"})
    assert content(folder).items() >= {**OLD, "mine.txt": "mine"}.items()


def test_an_error_removes_nothing_and_records_what_was_written(folder: Path) -> None:
    def fail() -> None:
        with RecordedFolder(folder) as recorded:
            recorded.write("figures/c.svg", "c")
            raise RuntimeError("must stop")

    with pytest.raises(RuntimeError):
        fail()
    assert content(folder) == {**OLD, "figures/c.svg": "c"}
    write(folder, {"page.md": "new page"})
    assert content(folder) == {"page.md": "new page"}


def test_an_error_before_the_first_file_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), RecordedFolder(tmp_path / "new"):
        raise RuntimeError("must stop")
    assert not (tmp_path / "new").exists()


def test_a_script_that_writes_some_files_removes_only_recorded_ones(folder: Path) -> None:
    (folder / "mine.md").write_text("mine")
    with RecordedFolder(folder, is_complete=False) as recorded:
        recorded.write("page.md", "reduced")
        recorded.remove("mine.md")
        recorded.remove("figures/a.svg")
    left = {**OLD, "page.md": "reduced", "mine.md": "mine"}
    left.pop("figures/a.svg")
    assert content(folder) == left
    write(folder, {"page.md": "new page"})
    assert content(folder) == {"page.md": "new page", "mine.md": "mine"}


def test_only_own_temporary_files_are_removed(tmp_path: Path) -> None:
    own = tmp_path / "key.0123abcd.tmp"
    others = [tmp_path / name for name in ("key.mine.tmp", "key.0123abcde.tmp", "k.0123abcd.tmp")]
    for file in (own, *others):
        file.write_text("x")
    link = tmp_path / "key.aaaaaaaa.tmp"
    link.symlink_to(others[0])
    remove_temporary_files(tmp_path / "key.npz")
    assert sorted(tmp_path.iterdir()) == sorted([*others, link])


# removals of the package: each is of a file whose exact name the function gave or recorded
REMOVALS = {
    "files/atomic_write.py": 2,
    "files/recorded_folder.py": 1,
    "results/store.py": 3,  # a damaged result, the note of a failure of earlier inputs, and a result by the wish of a user
    "learn/training_job.py": 2,
    "ppl/inference_job.py": 1,  # its own state of a run that has ended
    "cli/progress.py": 2,  # its own log, and the folder of the study if it is empty
}


def test_no_other_module_removes_files() -> None:
    pattern = re.compile(r"\.unlink\(|rmtree\(|\.rmdir\(|os\.remove|removedirs")
    counts = {
        path.relative_to(ROOT / "pfbench").as_posix(): len(pattern.findall(path.read_text()))
        for path in (ROOT / "pfbench").rglob("*.py")
    }
    assert {name: n for name, n in counts.items() if n} == REMOVALS


@pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")
def test_a_published_file_is_replaced_without_copy_and_no_repository_runs_a_program(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As in a fresh clone, which has the published files without their manifest, and in the folder of a stranger."""
    run_git(tmp_path, "init", "-q")
    for name in ("report.md", "headline.svg", "changed.md"):
        (tmp_path / name).write_bytes((ROOT / "reports" / "learn_gain" / "report.md").read_bytes())
    plant_programs(tmp_path)
    (tmp_path / "changed.md").write_text("by hand")
    with RecordedFolder(tmp_path) as folder:
        for name in ("report.md", "changed.md"):
            folder.write(name, "new")
    names = {path.name for path in tmp_path.iterdir() if path.is_file()} - {MANIFEST}
    assert names == {"report.md", "headline.svg", "changed.md", "changed.md.kept", ".gitattributes"}
    assert (tmp_path / "changed.md.kept").read_text() == "by hand"
    assert "changed.md.kept" in caplog.text
    assert "report.md" not in caplog.text
    assert "headline.svg" not in caplog.text


def test_published_files_are_found_by_name_and_digest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    published, name = tmp_path / "published", "study/runs.parquet"
    monkeypatch.setattr(recorded_folder, "PUBLISHED_RUNS", published)
    monkeypatch.setattr(recorded_folder, "PUBLISHED_FILES", published / "published.json")
    assert recorded_folder.find_published_file(name) is None
    assert "pip install" in recorded_folder.describe_missing_runs()
    (published / "study").mkdir(parents=True)
    (published / name).write_bytes(b"runs")
    recorded_folder.write_manifest(published / "published.json", {name: hash_content(b"runs")})
    assert (recorded_folder.describe_missing_runs(), recorded_folder.list_published("runs.parquet")) == ("", ["study"])  # fmt: skip
    own = tmp_path / "reports" / "study"
    recorded_folder.copy_published(own, "runs.parquet")
    assert (own / "runs.parquet").read_bytes() == b"runs"
    (published / name).write_bytes(b"other runs")
    check_refused(
        [
            (
                r"must have the digest in published\.json, got another",
                lambda: recorded_folder.find_published_file(name),
            )
        ],
        remedy=False,
    )
