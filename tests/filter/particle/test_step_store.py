"""Compiled steps on disk: found by what decides their code, and never a wrong number whatever lies in the store."""

from __future__ import annotations

import errno
import json
import os
import random
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from compiled_cases import RUNS, agree, compiler, record_of, run

from pfbench.files.atomic_write import DIGEST, hash_content
from pfbench.filter.belief import ParticleBelief
from pfbench.filter.particle import compiled_filter, step_store
from pfbench.filter.particle.compiled_filter import CompiledParticleFilter
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.job import filter_pass
from pfbench.job.scoring import LikelihoodCounter
from pfbench.model.linear_gaussian import linear_walk
from pfbench.model.textbook import UnivariateGrowth

FILES = ("step.so", "constants.pt", "step.json")


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the empty store of a test."""
    folder = tmp_path / "steps"
    monkeypatch.setattr(step_store, "_folder", lambda: folder)
    return folder


# --------------------------------------------------------------------------------------------------
# The name of a step


def arguments(particles: int = 20, dtype: torch.dtype = torch.float64) -> Any:
    """Belief, record, type and runs of a step."""
    x = torch.randn(RUNS, particles, 1, dtype=dtype)
    belief = ParticleBelief(x, torch.zeros(RUNS, particles, dtype=dtype), torch.zeros(RUNS))
    return belief, record_of(UnivariateGrowth()).at_step(0), dtype, torch.arange(RUNS)


def name(method: Any = None, model: Any = None, given: Any = None, **more: Any) -> str:
    """Name of the step of a filter, by default of one that differs in nothing from the others."""
    parts = (method or ParticleFilter(20)), (model or linear_walk(1.0, 0.3, 1.0))
    found = step_store.name_step(parts, given or arguments(), **more)
    assert found is not None
    return found


def test_equal_steps_have_one_name_whatever_their_numbers() -> None:
    """Particles and measurements are arguments, and what was counted decides nothing."""
    assert name() == name()
    counted = []
    for _ in range(2):
        model = linear_walk(1.0, 0.3, 1.0)
        counter = LikelihoodCounter(model)
        counter.count = len(counted)
        counted.append(name(model=model, uncounted=counter))
    assert counted[0] == counted[1]


def test_one_step_serves_records_of_any_length() -> None:
    """A step of a record is a view of it, whose strides depend on its length."""
    names = set()
    for steps in (2, 9):
        belief, record, *more = arguments()
        y = torch.zeros(RUNS, steps, 1, dtype=torch.float64)[:, 1]
        names.add(name(given=(belief, record._replace(y=y), *more)))
    assert len(names) == 1


def changed_threads() -> str:
    """Name with another number of threads."""
    step_store._describe_platform.cache_clear()
    torch.set_num_threads(2)
    try:
        return name()
    finally:
        torch.set_num_threads(1)
        step_store._describe_platform.cache_clear()


@pytest.mark.parametrize(
    "other",
    [
        lambda: name(ParticleFilter(21)),
        lambda: name(model=linear_walk(1.0, 0.3, 1.0 + 1e-15)),
        lambda: name(model=UnivariateGrowth()),
        lambda: name(given=arguments(21)),
        lambda: name(given=arguments(dtype=torch.float32)),
        lambda: name(library="another"),
        changed_threads,
    ],
    ids=["filter", "last digit", "model", "shape", "precision", "operators", "threads"],
)  # fmt: skip
def test_whatever_decides_the_code_decides_the_name(other: Callable[[], str]) -> None:
    assert other() != name()


def test_structure_counts_not_only_values() -> None:
    """Lists of equal values, values under other names, functions with other arguments."""

    a, b = torch.ones(2), torch.ones(2)
    trees = [
        [1, 2], (1, 2), [[1], 2], [1, [2]], {"a": 1}, {"b": 1}, 1, 1.0, True, "1", b"1", None, float("nan"),
        [a, a], [a, b], a, 2 * a, a.double(), a[:1], a.expand(2, 2), np.ones(2), np.ones(2, dtype=np.float32),
        partial(max, 1), partial(max, 2), partial(min, 1), torch.sin, torch.cos, {1, 2}, {1, 3},
        linear_walk, UnivariateGrowth, UnivariateGrowth(), UnivariateGrowth().propagate, UnivariateGrowth().log_likelihood,
    ]  # fmt: skip
    names = [step_store.name_step(tree, ()) for tree in trees]
    assert None not in names
    assert len(set(names)) == len(trees)


class Slotted:
    """A class that is not of pfbench, as those of a user."""


def test_cycles_have_an_end() -> None:
    loop: list[Any] = [1]
    loop.append(loop)
    assert step_store.name_step(loop, ()) != step_store.name_step([1, [1]], ())


@pytest.mark.parametrize(
    "value",
    [(x for x in [1]), memoryview(b"1")],
    ids=["generator", "memory"],
)
def test_what_cannot_be_described_has_no_name(value: object) -> None:
    assert step_store.name_step([ParticleFilter(20), value], ()) is None


def own_walk(x: Any) -> Any:
    return x


@pytest.mark.parametrize(
    "value",
    [Slotted(), Slotted, own_walk, partial(own_walk, 1), {"a": [own_walk]}, type("Typed", (), {"__module__": "__main__"})()],
    ids=["object", "class", "function", "partial", "nested", "script"],
)  # fmt: skip
def test_a_step_that_reaches_code_of_a_user_has_no_name(value: object) -> None:
    """It may take a number from a global, a closure, the environment or a file, which nothing here would see."""
    assert step_store.name_step([ParticleFilter(20), value], ()) is None


# --------------------------------------------------------------------------------------------------
# Its files. One step is compiled for all tests.


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a store with the step of `filtered`, in place of `step_store._folder`."""
    folder = tmp_path_factory.mktemp("store") / "steps"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(step_store, "_folder", lambda: folder)
        filtered()
    assert len(list(folder.iterdir())) == 1
    return folder


def filtered(builds: bool = True, scale: float = 1.0) -> CompiledParticleFilter:
    """Filter a record with compiled steps, and compare each number with the uncompiled filter."""
    model, method = linear_walk(scale, 0.3, 1.0), ParticleFilter(30)
    record = record_of(model)
    step = CompiledParticleFilter(method, loads_only=not builds)
    agree(run(step, model, record), run(method, model, record))
    return step


def stored_graph(step: CompiledParticleFilter) -> Any:
    (graph,) = step.graphs.values()
    return graph


def damage_step(folder: Path, rng: random.Random) -> str:
    """Damage a stored step in one of many ways. Returns the way."""
    file = folder / rng.choice(FILES)
    data = bytearray(file.read_bytes())
    record = json.loads((folder / "step.json").read_text())
    at, other = rng.randrange(len(data)), folder / rng.choice(FILES)
    way = rng.choice(["flip", "flip", "byte", "cut", "append", "repeat", "empty", "gone", "swap", "field", "field", "field", "extra", "drop",
                      "constants", "mode", "owner of all", "folder", "link", "pipe", "file"])  # fmt: skip
    if way == "flip":
        data[at] ^= 1 << rng.randrange(8)
    elif way == "byte":
        data[at : at + rng.randrange(1, 40)] = rng.randbytes(rng.randrange(1, 40))
    elif way in ("cut", "empty"):
        del data[at if way == "cut" else 0 :]
    elif way in ("append", "repeat"):
        data += rng.randbytes(20) if way == "append" else data[at:]
    if way in ("flip", "byte", "cut", "append", "repeat", "empty"):
        file.write_bytes(bytes(data))
    elif way in ("gone", "folder", "link", "pipe"):
        moved = file.rename(folder.parent / "moved")
        if way == "folder":
            file.mkdir()
        elif way == "link":
            file.symlink_to(moved)
        elif way == "pipe":
            os.mkfifo(file)
    elif way == "swap":
        file.write_bytes(other.read_bytes())
        other.write_bytes(bytes(data))
    elif way == "field":
        record["outputs"] = rng.choice([rng.randrange(-3, 300), 1 << 40, 2.5, "9", None, [10]])
    elif way == "extra":
        record[rng.choice(FILES)] = rng.randrange(9)
    elif way == "drop":
        del record[rng.choice(list(record))]
    elif way == "constants":
        torch.save([torch.randn(rng.randrange(1, 9))] * rng.randrange(4), folder / "constants.pt")
    elif way in ("mode", "owner of all"):
        (file if way == "mode" else folder).chmod(rng.choice([0o622, 0o777, 0o666, 0o722]))
    elif way == "file":
        shutil.rmtree(folder)
        folder.write_bytes(bytes(data[:100]))
    if way in ("field", "extra", "drop"):
        (folder / "step.json").write_text(json.dumps(record))
    return way


def mutate_steps(built: Path, place: Path, trials: int, seed: int) -> Counter[str]:
    """Load damaged copies of a step, each in a process of its own. Returns the outcomes.

    They are: signal, valid (used, with the numbers of the uncompiled step), removed and refused (both said), kept (not used, and
    neither), silent (without a word), false (another number).
    """
    rng, counts = random.Random(seed), Counter[str]()
    outcomes = ["valid", "removed", "refused", "kept", "silent", "false"]
    for trial in range(trials):
        folder = place / str(trial) / built.name
        shutil.copytree(built, folder)
        damage_step(folder, rng)
        if (child := os.fork()) == 0:
            os._exit(outcomes.index(_load_damaged(folder)))
        status = os.waitpid(child, 0)[1]
        counts["signal" if os.WIFSIGNALED(status) else outcomes[os.WEXITSTATUS(status)]] += 1
        shutil.rmtree(folder.parent)
    return counts


def _load_damaged(folder: Path) -> str:
    """Filter with a damaged step, and return the outcome of `mutate_steps`."""
    said: list[str] = []
    step_store.log.warning = lambda text, *values: said.append(text % values)  # type: ignore[method-assign]
    step_store._folder = lambda: folder.parent
    try:
        graph = stored_graph(filtered(builds=False))
    except BaseException:
        return "false"
    if graph is not None:
        return "valid"
    if not said:
        return "silent" if folder.is_dir() else "removed"  # a file of this name is no step
    is_refused = "stored steps are not used" in said[0]
    return "refused" if is_refused else "kept" if folder.exists() else "removed"


@pytest.fixture
def refuse_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a call of torch's compiler fail."""

    def refuse(*_: object) -> None:
        raise AssertionError("the compiler was asked")

    monkeypatch.setattr(compiled_filter, "compile_function", refuse)


needs_step = [pytest.mark.slow, compiler, pytest.mark.filterwarnings("ignore")]


class TestStored:
    """Tests that load the step."""

    pytestmark = needs_step

    @pytest.fixture(autouse=True)
    def filled(self, built: Path, cache: Path) -> Path:
        shutil.copytree(built, cache)
        (folder,) = cache.iterdir()
        return folder

    def test_a_stored_step_needs_no_compiler(self, refuse_compiler: None) -> None:
        graph = stored_graph(filtered(builds=False))
        assert graph.is_stored
        assert graph.entry is not None

    def test_another_process_loads_it_without_importing_the_compiler(self, cache: Path) -> None:
        code = (
            "import sys; from test_step_store import *; torch.set_num_threads(1)\n"
            f"step_store._folder = lambda: Path({str(cache)!r})\n"
            "assert stored_graph(filtered(builds=False)).is_stored\n"
            "assert 'torch._inductor.compile_fx' not in sys.modules\n"
        )
        paths = [str(Path(__file__).parent), str(Path(__file__).parents[2]), *sys.path]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
        done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)  # fmt: skip
        assert done.returncode == 0, done.stderr

    def test_another_model_is_another_step(self, refuse_compiler: None) -> None:
        assert stored_graph(filtered(builds=False, scale=1.5)) is None

    @pytest.mark.parametrize("file", FILES)
    @pytest.mark.parametrize("damage", ["cut", "empty", "flipped", "gone"])
    def test_a_damaged_step_is_removed_and_said_once(
        self, filled: Path, file: str, damage: str, caplog: pytest.LogCaptureFixture
    ) -> None:
        data = bytearray((filled / file).read_bytes())
        data[len(data) // 2] ^= 255
        content = {"cut": data[: len(data) // 2], "empty": b"", "flipped": data}
        (filled / file).unlink()
        if damage in content:
            (filled / file).write_bytes(bytes(content[damage]))
        with caplog.at_level("INFO", "pfbench"):
            assert stored_graph(filtered(builds=False)) is None
        (said,) = [r.getMessage() for r in caplog.records]
        assert said.startswith("engine=compiled: a stored step is damaged")
        assert not filled.exists()

    @pytest.mark.parametrize("outputs", [9, 11, 3, 200])
    def test_another_number_of_outputs_is_damage(
        self, filled: Path, outputs: int, caplog: pytest.LogCaptureFixture
    ) -> None:
        """The number of results that the code writes: with another one it would write beyond its memory."""
        record = json.loads((filled / "step.json").read_text())
        (filled / "step.json").write_text(json.dumps({**record, "outputs": outputs}))
        assert stored_graph(filtered(builds=False)) is None
        assert "a stored step is damaged and removed" in caplog.text
        assert not filled.exists()

    def test_random_damage_ends_no_process(self, filled: Path, tmp_path: Path) -> None:
        """A child takes each mutation, so that a signal would be seen."""
        counts = mutate_steps(filled, tmp_path / "mutants", trials=40, seed=1)
        assert not {"signal", "kept", "silent", "false"} & counts.keys(), counts
        assert counts["removed"] + counts["refused"] + counts["valid"] == 40

    def test_a_step_that_gives_other_numbers_is_not_used(
        self, filled: Path, cache: Path, caplog: pytest.LogCaptureFixture
    ) -> None:
        """A file of another step under this name, with valid digests: as if the name had missed something."""
        names: list[str] = []
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(step_store, "has_step", names.append)
            filtered(builds=False, scale=1.5)
        os.rename(filled, cache / names[0])
        record = {**json.loads((cache / names[0] / "step.json").read_text()), "name": names[0]}
        record[DIGEST] = hash_content({**record, **step_store._read_files(cache / names[0])})
        (cache / names[0] / "step.json").write_text(json.dumps(record))
        assert stored_graph(filtered(builds=False, scale=1.5)) is None
        assert "a stored step is removed (its numbers must be those of" in caplog.text
        assert not list(cache.iterdir())

    @pytest.mark.parametrize("place", ["", "step.so"])
    @pytest.mark.parametrize("fault", ["others can write it", "another user"])
    def test_a_store_of_others_is_not_used(
        self, fault: str, place: str, filled: Path, refuse_compiler: None, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:  # fmt: skip
        if fault == "another user":
            user = os.getuid()
            monkeypatch.setattr(os, "getuid", lambda: user + 1)
        else:
            (filled / place).chmod(0o777)
        assert stored_graph(filtered(builds=False)) is None
        assert "stored steps are not used" in caplog.text
        assert "others cannot write" in caplog.text

    def test_auto_takes_a_stored_step_and_compiles_none(self, cache: Path) -> None:
        method = ParticleFilter(30)

        def wrap(may_load: bool) -> Any:
            return filter_pass._compile_step("kernels", method, None, None, may_load)

        assert wrap(True).loads_only
        assert wrap(False) is None
        shutil.rmtree(cache)
        assert wrap(True) is None  # no step is stored


@pytest.fixture
def entry(tmp_path: Path) -> Any:
    """An entry whose library is a file of some bytes."""
    library = tmp_path / "made.so"
    library.write_bytes(b"code")
    return step_store.NativeEntry(0, [torch.ones(2)], str(library))


def test_what_is_stored_is_complete_and_private(entry: Any, cache: Path) -> None:
    step_store.save_step("a", entry, 3)
    step_store.save_step("a", entry._replace(constants=[]), 4)  # the first of two processes stays
    assert [folder.name for folder in cache.iterdir()] == ["a"]
    assert {file.name for file in (cache / "a").iterdir()} == set(FILES)
    assert json.loads((cache / "a/step.json").read_text())["outputs"] == 3
    assert (cache.stat().st_mode | (cache / "a").stat().st_mode) & 0o077 == 0


@pytest.mark.parametrize("place", ["copyfile", "mkdir"])
def test_a_full_or_read_only_disk_loses_nothing_but_the_store(
    place: str, entry: Any, cache: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:  # fmt: skip
    def fail(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(*((shutil, "copyfile") if place == "copyfile" else (Path, "mkdir")), fail)
    step_store.save_step("a", entry, 3)
    assert "the step is not stored ([Errno 28] No space left" in caplog.text
    assert not cache.exists() or not list(cache.iterdir())


def test_a_limit_of_the_size_of_files_leaves_nothing_behind(
    entry: Any, cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A real limit of the system, which interrupts a write."""
    resource = pytest.importorskip("resource")
    Path(entry.library).write_bytes(bytes(5000))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, before[1]))
    try:
        step_store.save_step("a", entry, 3)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert "the step is not stored (" in caplog.text
    assert not list(cache.iterdir())


def test_what_a_killed_process_left_is_removed_an_hour_later(entry: Any, cache: Path) -> None:
    for name, age in (("tmpnew", 60.0), ("tmpold", 4000.0), ("a" * 40, 4000.0)):
        (cache / name).mkdir(parents=True)
        os.utime(cache / name, 2 * (time.time() - age,))
    step_store.save_step("b" * 40, entry, 3)
    assert sorted(folder.name for folder in cache.iterdir()) == ["a" * 40, "b" * 40, "tmpnew"]


def test_the_store_is_limited_in_size_and_age(
    entry: Any, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [40 * letter for letter in "abcde"]
    for age, name in zip((0.0, 89.0, 89.5, 91.0), names, strict=False):
        step_store.save_step(name, entry, 3)
        os.utime(cache / name, 2 * (time.time() - age * 86400.0,))
    size = sum(file.stat().st_size for file in (cache / names[0]).iterdir())
    monkeypatch.setattr(step_store, "_LARGEST", 2.5 * size)
    step_store.save_step(names[4], entry, 3)
    assert sorted(folder.name for folder in cache.iterdir()) == [names[0], names[1], names[4]]
