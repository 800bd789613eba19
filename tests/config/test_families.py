"""Names in families are files of their own to Hydra, and the reader of their texts loses nothing."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from refusals import check_refused

from pfbench import job
from pfbench.results import paper_block
from pfbench.results.paper_block import FAMILY_FOLDER, list_named_parts, read_families, read_part

FILES = sorted(job.conf_dir().glob(f"*/{FAMILY_FOLDER}/*.yaml"))


@pytest.mark.parametrize("file", FILES, ids=lambda file: f"{file.parents[1].name}-{file.stem}")
def test_each_entry_of_a_family_is_read_whole(file: Path) -> None:
    """By a parser of YAML the file has the same names, and each the same content."""
    group, content = file.parents[1].name, yaml.safe_load(file.read_text())
    assert file.read_text().startswith("# ")
    assert content == {name: yaml.safe_load(read_families(group)[name]) for name in content}


@pytest.mark.parametrize("group", sorted({file.parents[1].name for file in FILES}))
def test_a_name_is_stated_once(group: str) -> None:
    files = [file for file in FILES if file.parents[1].name == group]
    several = [name for file in files for name in yaml.safe_load(file.read_text())]
    alone = [file.stem for file in (job.conf_dir() / group).glob("*.yaml")]
    assert len({*several, *alone}) == len(several) + len(alone)
    assert sorted([*several, *alone]) == list_named_parts(group)


def test_a_file_of_a_user_builds_on_an_entry_and_has_another_name(tmp_path: Path) -> None:
    (tmp_path / "filter").mkdir()
    text = "defaults: [rpf_printed, _self_]\nresampler: {scale: 0.7}\n"
    for name in ("mine", "rpf_half"):
        (tmp_path / "filter" / f"{name}.yaml").write_text(text)
    words = [f"hydra.searchpath=[file://{tmp_path}]", "scenario=linear_walk"]
    own, printed = (
        job.compose([*words, f"filter={n}"]).values["filter"] for n in ("mine", "rpf_printed")
    )
    assert own == {**printed, "resampler": {**printed["resampler"], "scale": 0.7}}
    refusal = r"rpf_half\.yaml must have another name than pfbench's own filter rpf_half"
    check_refused([(refusal, lambda: job.compose([*words, "filter=rpf_half"]))], remedy=False)


def test_an_entry_is_read_as_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "noise" / "families").mkdir(parents=True)
    (tmp_path / "noise" / "families" / "steps.yaml").write_text(
        "# Two.\n"
        "one:  # First one.\n  _target_: pfbench.noise.BiasStep\n  # why\n  bias_sd: 1e-4\n"
        "two:  # Second one.\n  defaults: [one, _self_]\n  onset_s: 2.0\n"
    )
    monkeypatch.setattr(paper_block, "conf_dir", lambda: tmp_path)
    monkeypatch.setattr(paper_block, "read_families", read_families.__wrapped__)
    assert read_part("noise", "one").startswith("# First one.\n_target_: ")
    assert read_part("noise", "two") == "# Second one.\ndefaults: [one, _self_]\nonset_s: 2.0\n"
    assert read_part("noise", "../noise/one") == ""
    assert list_named_parts("noise") == ["one", "two"]
