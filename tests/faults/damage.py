"""Damaged and swapped files of each kind: none may be read with another content than was written."""

import logging
import random
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from pfbench.experiments.study_parts import ResumableResults

from faults.children import run_child
from faults.sweeps import CLEAR, result_files, run_sweep
from faults.tally import FINE, Tally
from pfbench.files.atomic_write import hash_content
from pfbench.filter.learned.checkpoint import hash_weights, read_checkpoint, write_checkpoint
from pfbench.job import run_job
from pfbench.results import conditions, store
from pfbench.scenario import simulated

SWAPS = 0.1  # of the trials
MEMORY_GIB = 4.0  # of addresses; a damaged size must not fill the machine


def damage(content: bytes, rng: random.Random) -> bytes:
    """Flip a bit, change, cut, repeat, blank or move some bytes, or append others."""
    if not content:
        return rng.randbytes(8)
    start = rng.randrange(len(content))
    chunk = content[start : start + rng.choice((1, 2, 16, 200))]
    rest = content[start + len(chunk) :]
    kind = rng.randrange(7)
    if kind == 0:
        flipped = bytes([content[start] ^ (1 << rng.randrange(8))])
        return content[:start] + flipped + content[start + 1 :]
    if kind == 1:
        return content[:start]
    if kind == 5:
        return content + rng.randbytes(len(chunk))
    if kind == 6:
        return content[:start] + rest + chunk
    return (
        content[:start]
        + (rng.randbytes(len(chunk)), chunk + chunk, bytes(len(chunk)))[kind - 2]
        + rest
    )


@dataclass(frozen=True)
class Subject:
    """Files of one kind and their reader.

    Attributes:
        files: Two files or more.
        read: Reads one file as the program does, and returns a hash of what it read.
        may_swap: Whether a file under the name of another must be refused. False if the user names
            the files, as for checkpoints.
    """

    files: list[Path]
    read: Callable[[Path], str]
    may_swap: bool = True


def make_results(folder: Path) -> Subject:
    assert run_sweep(folder).code == 0

    def read(path: Path) -> str:
        if (result := run_job._read_finished(path, {"pcrb": False})) is None:
            raise ValueError("the job of a damaged result must run again. It was set aside")
        return hash_content(tuple(result))

    return Subject(result_files(folder), read)


def make_episodes(folder: Path) -> Subject:
    def build(number: int) -> dict[str, torch.Tensor]:
        x = torch.arange(200.0) + number
        return {"x": x, "y": torch.full((3, 2), float(number), dtype=torch.float64)}

    recipes: dict[Path, int] = {}

    def load(number: int) -> dict[str, torch.Tensor]:
        return simulated.load_or_build(folder, f"recipe {number}", partial(build, number))

    for number in range(2):
        load(number)
        new = set(folder.glob("*.npz")) - set(recipes)
        recipes[new.pop()] = number
    return Subject(list(recipes), lambda path: hash_content(load(recipes[path])))


def make_checkpoints(folder: Path) -> Subject:
    files = [folder / "a.pt", folder / "b.pt"]
    for seed, file in enumerate(files):
        generator = torch.Generator().manual_seed(seed)
        weights = {"a.weight": torch.randn(6, 4, generator=generator), "a.bias": torch.zeros(6)}
        write_checkpoint(file, {"networks": {"proposal": weights}, "losses": [1.0, 0.5]})

    def read(path: Path) -> str:
        content = read_checkpoint(path)
        return hash_content(content) + hash_weights(content["networks"])

    return Subject(files, read, may_swap=False)


def make_parts(folder: Path) -> Subject:
    files = [folder / "0.json", folder / "1.json"]

    def read(path: Path) -> str:
        number = int(path.stem)
        parts = ResumableResults(path, {"study": number})
        return hash_content(
            [
                parts(name, lambda: [number + k / 7 for k in range(50)])
                for name in ("first", "second")
            ]
        )

    for file in files:
        read(file)
    return Subject(files, read)


def make_report_data(folder: Path) -> Subject:
    """The results and the failure notes of a study, read as a report reads them."""
    assert run_sweep(folder).code == 0
    study = folder / "results" / "adhoc"
    for key in ("0" * 16, "1" * 16):
        store.write_failure(
            study / f"{key}.npz", {"filter": key}, ValueError(f"job {key} must fail")
        )
    files = [*study.glob("*.failed.json"), *result_files(folder)]

    def read(path: Path) -> str:
        if path.suffix == ".npz":
            if conditions.read_undamaged(path) is None:
                raise ValueError(
                    "a damaged result must be left out of the report. It was set aside"
                )
            return hash_content(tuple(store.read_result(path)))
        key = path.name.partition(".")[0]
        (note,) = (note for note in store.list_failures(study) if note["key"] == key)
        if note["choices"]["filter"] == "unknown":
            raise ValueError(f"the job of a damaged note must be listed: {note['message']}")
        return hash_content(note)

    return Subject(files, read)


KINDS: dict[str, Callable[[Path], Subject]] = {
    "results": make_results,
    "episode caches": make_episodes,
    "checkpoints": make_checkpoints,
    "resumable parts": make_parts,
    "report data": make_report_data,
}


def outcome_of(read: Callable[[], str], expected: str) -> tuple[str, str, str]:
    """Read a file and return outcome, remark and example."""
    try:
        return (FINE, "read as written", "") if read() == expected else ("false", "read", "")
    except ValueError as error:
        outcome = FINE if CLEAR.search(f"{error}") else "unclear"
        return outcome, "refused", f"{error}"
    except Exception as error:
        return "crash", type(error).__name__, f"{error}"


def try_files(kind: str, count: int, seed: int) -> dict[str, Any]:
    """Damage or swap files of a kind `count` times, in this process."""
    logging.disable(logging.CRITICAL)
    tally, rng = Tally(f"damaged files: {kind}"), random.Random(seed)
    with tempfile.TemporaryDirectory() as folder:
        subject = KINDS[kind](Path(folder))
        contents = {file: file.read_bytes() for file in subject.files}
        expected = {file: subject.read(file) for file in subject.files}
        for _ in range(count):
            file, other = rng.sample(subject.files, 2)
            is_swap = subject.may_swap and rng.random() < SWAPS and file.suffix == other.suffix
            new = contents[other] if is_swap else damage(contents[file], rng)
            file.write_bytes(new)
            outcome, remark, example = outcome_of(partial(subject.read, file), expected[file])
            tally.add(outcome, f"{'swapped' if is_swap else 'damaged'}, {remark}", example)
            for path in (file, other):
                path.write_bytes(contents[path])
            for aside in file.parent.glob("*.damaged*"):
                aside.unlink()
    return tally.to_dict()


def run(kind: str, count: int, seed: int) -> Tally:
    """Damage files of a kind in a child, so that a crash of a reader is counted."""
    ending = run_child(lambda: try_files(kind, count, seed), timeout=600.0, memory_gib=MEMORY_GIB)
    if ending.state == "done":
        return Tally.from_dict(ending.value)
    tally = Tally(f"damaged files: {kind}")
    tally.add("crash", ending.state, f"{ending.value}, seed {seed}")
    return tally
