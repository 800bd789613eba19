"""Hostile files: nothing runs, is written or is deleted because a file says so."""

import os
from pathlib import Path
from typing import Any

import pytest
from hostile_cases import COMMANDS, FILES, GROUPS, NODES, text_of, try_file
from omegaconf import OmegaConf

from pfbench import job
from pfbench.cli.compose import check_words
from pfbench.job import trust
from pfbench.job.config import compose_tree
from pfbench.job.shared_loader import check_composed
from pfbench.job.trust import UntrustedConfigError


def refuse_to_compose(folder: Path, group: str, text: str) -> None:
    (folder / "conf" / group).mkdir(parents=True)
    (folder / "conf" / group / "hostile.yaml").write_text(text)
    words = [f"hydra.searchpath=[file://{folder / 'conf'}]", "scenario=linear_walk"]
    with pytest.raises(Exception, match=rf"({group}[./]|hydra)(.|\n)*must"):
        job.compose([*words, f"{group}=hostile"])


def test_hostile_nodes_are_refused_before_anything_is_built(tmp_path: Path) -> None:
    assert len(NODES) + len(FILES) >= 60
    for number, (name, node) in enumerate(NODES.items()):
        folder = tmp_path / name
        folder.mkdir()
        group, command = GROUPS[number % len(GROUPS)], COMMANDS[number % (len(COMMANDS) - 1)]
        if number % 9 and group != "scenario":  # a whole command takes three times as long
            refuse_to_compose(folder, group, text_of(node))
            continue
        said = try_file(folder, group, text_of(node), command)
        assert said.code == 2, (name, said)
        assert "must" in said.err, (name, said.err)
        # the key: below its group, in hydra, or at the root, where some files are placed
        places = (f"{group}.", f"{group}/", "hydra", "._target_ must")
        assert any(place in said.err for place in places), (name, said.err)
        assert not (folder / "results").exists(), name
    assert os.environ.get("PFBENCH_TRUST", "") == ""


def test_files_cannot_set_folders_or_the_settings_of_hydra(tmp_path: Path) -> None:
    for number, (name, (group, text)) in enumerate(FILES.items()):
        folder = tmp_path / name
        folder.mkdir()
        command = "train" if group == "train" else ("run -m", "run", "datasheet")[number % 3]
        words = (folder, group, text, command)
        if name in ("results", "reports"):  # the command line of try_file sets them
            continue
        said = try_file(*words)
        assert said.code in (1, 2), (name, said)  # of a sweep, of a command
        assert "must" in said.err, (name, said.err)


BOMB = "a0: &a0 [x, x]\n" + "".join(f"a{i + 1}: &a{i + 1} [*a{i}, *a{i}]\n" for i in range(40))
VALUES = {
    "environment": "name: ${oc.env:HOME}",
    "environment with braces": "name: '${oc.env:HOME,\"{}\"}'",
    "environment by another name": "a: oc.env\nname: ${${noise.a}:HOME}",
    "environment within a text": "name: 'a ${oc.decode:\"${oc.env:HOME}\"} b'",
    "folder": "name: ${hydra:runtime.cwd}",
    "key": "${oc.env:HOME}: 1",
    "bomb": BOMB,
    "alias to itself": "a: &a [*a, *a]",
}


@pytest.mark.parametrize("name", VALUES)
def test_a_value_reads_no_environment_and_stays_small(tmp_path: Path, name: str) -> None:
    """A result of a stranger's scene may be published: it must hold nothing of this machine."""
    (tmp_path / "noise").mkdir()
    file = tmp_path / "noise" / "hostile.yaml"
    target = "_target_: pfbench.noise.NominalNoise"
    words = [f"hydra.searchpath=[file://{tmp_path}]", "scenario=linear_walk", "noise=hostile"]
    file.write_text(f"{target}\n{VALUES[name]}\n")
    with pytest.raises(UntrustedConfigError, match=r"must"):
        job.compose(words)
    file.write_text(
        f"{target}\na: &a [1, 2]\nb: [*a, *a]\nc: ${{noise.a}}\nd: ${{oc.select:noise.e,1}}\n"
    )
    assert job.compose(words).values["noise"]["d"] == 1


def test_a_file_cannot_set_the_folder_of_results(tmp_path: Path) -> None:
    (tmp_path / "conf" / "noise").mkdir(parents=True)
    for key in ("results_dir", "reports_dir"):
        (tmp_path / "conf" / "noise" / "hostile.yaml").write_text(
            f"# @package _global_\n{key}: {tmp_path / 'new'}\n"
        )
        words = [f"hydra.searchpath=[file://{tmp_path / 'conf'}]", "noise=hostile"]
        with pytest.raises(UntrustedConfigError, match=f"{key} must be set on the command line"):
            job.compose(words)
        assert job.compose([*words[:1], f"{key}=here"]).values[key] == "here"


def test_settings_are_compared_even_if_no_file_shows_them() -> None:
    def change(key: str) -> Any:
        tree = compose_tree(["scenario=linear_walk", "hydra/launcher=cores"])
        OmegaConf.update(tree, key, "elsewhere", force_add=True)
        return tree

    words = ["hydra/launcher=cores"]
    check_composed(change("noise.name"), words, compose_tree)
    for key in (
        "hydra.run.dir",
        "hydra.launcher.temp_folder",
        "hydra.job.env_set.A",
        "results_dir",
        "data.root",
    ):
        name = ".".join(key.split(".")[:2]) if "hydra" in key else key.split(".")[0]
        with pytest.raises(UntrustedConfigError, match=f"{name} must be set on the command line"):
            check_composed(change(key), words, compose_tree)
        check_composed(change(key), words, None)


def test_every_alternative_of_a_sweep_is_checked(tmp_path: Path) -> None:
    (tmp_path / "conf" / "noise").mkdir(parents=True)
    words = ["-m", f"hydra.searchpath=[file://{tmp_path / 'conf'}]", "scenario=linear_walk"]
    file = tmp_path / "conf" / "noise" / "hostile.yaml"
    file.write_text(FILES["episodes"][1])
    check_words([*words, "noise=nominal,outliers"])
    with pytest.raises(UntrustedConfigError, match="episode_cache_dir must be set on the command"):
        check_words([*words, "noise=nominal,hostile"])
    file.unlink()
    with pytest.raises(UntrustedConfigError, match="study must be a name"):
        check_words([*words, "study=a,../b"])
    for flag in ("--config-path=/tmp", "--config-name=other", "--experimental-rerun=a"):
        with pytest.raises(UntrustedConfigError, match="--config-path, --config-name and"):
            check_words([flag])


def test_a_misspelt_class_is_compared_with_public_names() -> None:
    with pytest.raises(UntrustedConfigError, match=r"Similar: pfbench\.filter\.ParticleFilter\."):
        check_words(["filter=sir", "filter._target_=pfbench.filter.ParticelFilter"])
    with pytest.raises(UntrustedConfigError) as raised:
        check_words(["filter=sir", "filter._target_=pfbench.filter.run_filter"])
    assert "Similar" not in str(raised.value)  # a function is not offered


def test_studies_are_plain_names() -> None:
    for name in ("adhoc", "a-b_2.c+d", "2026", 2026, 1.0, True):
        assert trust.check_study(name) == str(name)  # YAML reads a number
    for name in (
        "",
        ".",
        "..",
        "../x",
        "a/b",
        "/tmp/x",
        "a\\b",
        "~",
        "a b",
        "-x",
        "x" * 101,
        "a\n",
        None,
        "ä",
    ):
        with pytest.raises(UntrustedConfigError, match="study must be"):
            trust.check_study(name)


MYLAB = """
import os
from pathlib import Path

from pfbench.noise import NominalNoise


class Quiet(NominalNoise):
    pass
"""


def test_a_package_that_the_user_trusts_may_be_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "trustedlab.py").write_text(MYLAB)
    monkeypatch.syspath_prepend(str(tmp_path))
    words = ["scenario=linear_walk", "++noise={_target_: trustedlab.Quiet}"]
    with pytest.raises(UntrustedConfigError, match=r"trust=\[trustedlab\]"):
        job.compose(words)
    config = job.compose([*words, "trust=[trustedlab]"])
    assert type(job.build_plan(config).recording_regime.regime).__name__ == "Quiet"
    monkeypatch.setenv("PFBENCH_TRUST", "trustedlab")
    assert job.compose(words).trusted == ("trustedlab",)
    for name in (
        "trustedlab.os.system",
        "trustedlab.Path",
        "trustedlab.Path.unlink",
        "trustedlab.NominalNoise",
    ):
        with pytest.raises(UntrustedConfigError, match="from elsewhere"):
            trust.check_configuration({"noise": {"_target_": name}}, ("trustedlab",))
    for name in (
        "os", "torch", "pathlib", "builtins", "pfbench", "not a name", "a;b", "torch.hub", "torch.serialization",
        "hydra.utils", "numpy.f2py", "__main__", "pip", "setuptools", "pfbench.job", "os.path", "hydra_plugins",
    ):  # fmt: skip
        with pytest.raises(UntrustedConfigError, match="trust must"):
            trust.split_trust([f"trust=[{name}]"])
    assert trust.split_trust(["trust=[torch.nn,a.b]", "runs=3"])[0] == ["runs=3"]


def test_capital_names_of_the_public_folders_are_classes() -> None:
    """The check recognises a class by its capital."""
    import importlib

    for folder in trust.FOLDERS:
        door = importlib.import_module(f"pfbench.{folder}")
        for name in door.__all__:
            assert name[0].isupper() == isinstance(getattr(door, name), type), name
    assert all(
        name in importlib.import_module(f"pfbench.{folder}").__all__
        for folder, names in trust.BUILDERS.items()
        for name in names
    )


def test_the_experiments_of_pfbench_set_no_protected_key() -> None:
    for file in job.experiments_dir().glob("*.yaml"):
        assert job.compose([f"+experiment={file.stem}"]).values["study"]
