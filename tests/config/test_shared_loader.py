"""A composition with kept files is Hydra's own, node by node, for all configurations and after each change of a file."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, cast
from unittest import mock

import composed_once
import pytest
import yaml
from hydra import initialize_config_dir, version
from hydra._internal import defaults_list
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path
from hydra.core.global_hydra import GlobalHydra
from hydra.types import RunMode
from omegaconf import DictConfig, ListConfig, OmegaConf
from refusals import check_refused

from pfbench import job
from pfbench.cli import run as run_command
from pfbench.cli.check import _add_needs
from pfbench.files import command_start
from pfbench.files.command_start import reset_work, start_work
from pfbench.job import shared_loader
from pfbench.job.config import list_groups
from pfbench.results import paper_block
from pfbench.results.paper_block import FAMILY_FOLDER, list_named_parts, read_families, read_part

GROUPS = list_groups()


def composed_by(loader: type[ConfigLoaderImpl], words: Sequence[str], mode: RunMode) -> DictConfig:
    """Compose by a loader, and by nothing that these tests or pfbench keep if it is Hydra's own."""
    version.setbase("1.3")
    made = Hydra("app", loader(create_config_search_path(str(job.conf_dir()))))
    own = shared_loader.collect_choices_by_hydra
    is_shared = loader is shared_loader.SharedLoader
    collect = shared_loader._collect_choices if is_shared else own
    by_hydra = composed_once.compose_by_hydra
    with (
        mock.patch.object(ConfigLoaderImpl, "_load_configuration_impl", by_hydra),
        mock.patch.object(defaults_list, "_create_interpolation_map", collect),
    ):
        return made.compose_config("config", list(words), mode, from_shell=False)


def nodes(node: Any, path: str = "") -> Iterator[tuple[Any, ...]]:
    """All nodes with their types, values and metadata; each must know its parent."""
    metadata = {k: v for k, v in vars(node._metadata).items() if k != "resolver_cache"}
    content = node._value()
    children: dict[Any, Any] = {}
    if isinstance(node, DictConfig) and isinstance(content, dict):
        children, content = content, list(content)
    elif isinstance(node, ListConfig) and isinstance(content, list):
        children, content = dict(enumerate(content)), len(content)
    yield path, type(node), metadata, content
    for key, child in children.items():
        assert child._get_parent() is node
        yield from nodes(child, f"{path}.{key}")


def is_same(words: Sequence[str], mode: RunMode = RunMode.RUN) -> bool:
    shared, own = (
        list(nodes(composed_by(loader, words, mode)))
        for loader in (shared_loader.SharedLoader, ConfigLoaderImpl)
    )
    return shared == own


def chosen_together() -> Iterator[list[str]]:
    """Words that choose each file of each group, groups of independent files together: a composition takes 0.1 s."""
    together = [
        [f"{group}={name}" for name in names]
        for group, names in GROUPS.items()
        if group not in ("model", "experiment", "infer")
    ]
    for place in range(max(map(len, together))):
        yield [words[place % len(words)] for words in together]
    for group in ("experiment", "infer"):  # that are not in the list of defaults
        for name in GROUPS[group]:
            yield [f"+{group}={name}"]
    for name in GROUPS["model"]:
        yield [f"model={name}", *_add_needs("model", name)]


@pytest.mark.parametrize("part", range(3))
def test_each_configuration_is_composed_as_by_hydra(part: int) -> None:
    words = list(chosen_together())
    named = {word.lstrip("+") for some in words for word in some}
    assert named >= {f"{group}={name}" for group, names in GROUPS.items() for name in names}
    for some in words[part::3]:
        assert is_same(some), some


@pytest.mark.parametrize("mode", RunMode)
@pytest.mark.parametrize(
    "words",
    [
        ["hydra.mode=MULTIRUN"],
        ["hydra/job_logging=none", "hydra.verbose=true", "runs=3"],
        ["~train", "+report.mine={a: [1, {b: 2}]}"],
        ["+experiment=quickstart", "filter=cofm_amssrcpf", "scenario=linear_walk"],
    ],
)
def test_other_words_are_composed_as_by_hydra(words: list[str], mode: RunMode) -> None:
    assert is_same(words, mode)
    assert is_same(words, mode)  # now of kept files alone


def test_a_composition_changes_no_kept_file() -> None:
    words = ["scenario=linear_walk", "filter=sir"]
    tree = composed_by(shared_loader.SharedLoader, words, RunMode.RUN)
    OmegaConf.set_struct(tree, False)
    tree.filter.resampler.scheme = "other"
    tree.hydra.run.dir = "elsewhere"
    tree.hydra.job.env_set["A"] = "b"
    tree.runs = 1
    assert is_same(words)


def test_a_changed_file_is_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared_loader, "check_defaults", lambda *_, **__: None)  # of interpolations
    (tmp_path / "noise").mkdir()
    file = tmp_path / "noise" / "mine.yaml"
    words = [f"hydra.searchpath=[file://{tmp_path}]", "scenario=linear_walk", "noise=mine"]
    target = "_target_: pfbench.noise.NominalNoise\n"
    for text in ("paper: {name: first}\n", "paper: {name: other}\n", "defaults: [nominal]\n"):
        file.write_text(target + text)
        os.utime(file, ns=(0, hash(text) % 2**40))
        assert is_same(words)
    file.write_text("defaults: [{/filter@x: '${filter}'}]\n")
    assert is_same(words)
    assert composed_by(shared_loader.SharedLoader, words, RunMode.RUN).noise.x.particles == 500
    other = tmp_path / "second" / "noise" / "mine.yaml"
    other.parent.mkdir(parents=True)
    other.write_text(target + "paper: {name: second}\n")
    words[0] = f"hydra.searchpath=[file://{tmp_path / 'second'}]"
    assert is_same(words)
    composed = composed_by(shared_loader.SharedLoader, words, RunMode.RUN)
    assert composed.noise.paper.name == "second"


def test_an_error_of_a_file_is_that_of_hydra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared_loader, "check_defaults", lambda *_, **__: None)  # of interpolations
    (tmp_path / "noise").mkdir()
    file = tmp_path / "noise" / "mine.yaml"
    words = [f"hydra.searchpath=[file://{tmp_path}]", "scenario=linear_walk", "noise=mine"]
    texts = (
        "a: [1\nb: }",
        "a: 1\na: 2",
        "defaults: [nothing_there]\na: 1",
        "defaults: {a: 1}",
        "defaults: [{/filter@x: '${nothing}'}]",
        "# @package a b\nscenario: 3",
    )
    for text in texts:
        file.write_text(text)
        said = []
        for loader in (shared_loader.SharedLoader, ConfigLoaderImpl):
            with pytest.raises(Exception) as raised:  # noqa: PT011
                composed_by(loader, words, RunMode.RUN)
            said.append((raised.type, str(raised.value), str(raised.value.__cause__)))
        assert said[0] == said[1], text


def test_no_file_of_pfbench_sets_the_mode_of_hydra() -> None:
    """So that words alone can."""
    for name in GROUPS["experiment"]:
        words = [f"+experiment={name}"]
        composed = composed_by(shared_loader.SharedLoader, words, RunMode.MULTIRUN)
        assert composed.hydra.mode is None
    for words in (["hydra.mode=RUN"], ["a=1", "++hydra.mode=RUN"], ["hydra={mode: RUN}"]):
        assert run_command._can_set_mode(words)
    assert not run_command._can_set_mode(["scenario=linear_walk", "hydrate=1", "filter=sir"])


@pytest.mark.parametrize("words", [[], ["-m"], ["hydra.mode=MULTIRUN"], ["--multirun", "runs=2,3"]])
def test_an_application_runs_as_that_of_hydra(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import hydra
    from hydra.core.hydra_config import HydraConfig

    seen: list[list[Any]] = []

    def task(cfg: Any) -> None:
        own = cast(Any, HydraConfig.get())
        settings = OmegaConf.to_container(own, resolve=False)
        assert isinstance(settings, dict)
        assert settings["job"].pop("name") in ("run", "test_shared_loader")  # of the module
        seen[-1].append((OmegaConf.to_container(cfg, resolve=True), settings))

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["pfbench run", *words, "scenario=linear_walk"])
    path = str(job.conf_dir())
    decorated = hydra.main(version_base="1.3", config_path=path, config_name="config")(task)
    overrides = [*(w for w in words if w[0] != "-"), "scenario=linear_walk"]
    for run in (decorated, lambda: run_command.run_application(task, overrides, is_sweep=words[:1] in (['-m'], ['--multirun']))):  # fmt: skip
        seen.append([])
        run()
    assert seen[0] == seen[1]
    assert len(seen[0]) == (2 if "runs=2,3" in words else 1)


def test_garbage_is_collected_as_usual_once_work_starts() -> None:
    usual = gc.get_threshold()
    reset_work()
    reset_work()
    assert gc.get_threshold()[0] == command_start._YOUNG_OBJECTS > usual[0]
    start_work()
    assert gc.get_threshold() == usual
    start_work()
    assert gc.get_threshold() == usual
    reset_work()
    command_start.collect_as_usual()
    assert gc.get_threshold() == usual


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


def test_threads_compose_at_the_same_time() -> None:
    def compose(seed: int) -> int:
        words = ["scenario=linear_walk", "filter=sir", f"seed={seed}"]
        return int(job.compose(words).values["seed"])

    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(compose, range(8))) == list(range(8))
    assert not GlobalHydra.instance().is_initialized()


@pytest.mark.parametrize("mode", [[], ["hydra.mode=RUN"], ["hydra.mode=MULTIRUN"]])
@pytest.mark.parametrize("run_mode", [RunMode.RUN, RunMode.MULTIRUN])
def test_a_copied_composition_of_these_tests_is_that_of_hydra(
    mode: list[str], run_mode: RunMode
) -> None:
    """A change of a copy does not reach the next one."""
    words = ["scenario=linear_walk", "filter=rpf", "filter.particles=33", *mode]
    with initialize_config_dir(str(job.conf_dir()), version_base="1.3", job_name="one"):
        for _ in range(2):
            loader = cast(ConfigLoaderImpl, GlobalHydra.instance().config_loader())
            copied = composed_once.compose_once(loader, "config", words, run_mode=run_mode)
            expected = composed_once.compose_by_hydra(loader, "config", words, run_mode=run_mode)
            for tree in (copied, expected):
                assert OmegaConf.is_struct(tree)
            assert OmegaConf.to_yaml(copied) == OmegaConf.to_yaml(expected)
            assert copied.hydra.mode == expected.hydra.mode
            copied.filter.particles = 1
