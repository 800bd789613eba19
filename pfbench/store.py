"""Results on disk: one `<key>.npz` per job, readable with numpy alone, written all at once or not at all.

A file holds `meta`, a JSON text, beside plain arrays; nothing in it is pickled. What a job could not finish is
`<key>.failed.json` at the same place.
"""

from __future__ import annotations

import hashlib
import json
import os
import traceback
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any, NamedTuple
from uuid import uuid4

import numpy as np

FORMAT = 1
SAME_N, SAME_TIME, SAME_LIKELIHOODS = BUDGETS = ("same N", "same time per step", "same likelihood evaluations")  # key `budget`

# Axes that must agree across arrays: R runs, T steps, D components, G groups of components, S steps scored.
_AXES = {
    "time": "T",
    "error": "RTD",
    "sd": "RTD",
    "nees": "RTG",
    "log_evidence": "R",
    "lost": "R",
}
_OPTIONAL = {"scored": "S", "crps": "RSD", "pit": "RSD", "energy": "RSG", "bound": "TD", "range": "T"}
_META = ("key", "study", "choices", "config", "label", "seed", "runs", "state")


class Result(NamedTuple):
    """One finished job.

    Attributes:
        meta: what ran: key, study, choices, config, label, seed, versions, seconds, state (names, units, groups) ...
        arrays: time [T] s; error, sd [R, T, D]; nees [R, T, G]; log_evidence, lost [R]; optional traces [R, T], track
            [R, T, 3] m East, North, Up; the steps scored [S] with crps, pit [R, S, D] and energy [R, S, G], see `judge`.
    """

    meta: dict[str, Any]
    arrays: dict[str, np.ndarray]


def key(config: Mapping[str, Any], ignore: tuple[str, ...] = ()) -> str:
    """The name of a job: 16 hexadecimal digits of the SHA-256 of its configuration.

    Args:
        config: plain nested dict with string keys.
        ignore: dotted paths that change where a job runs but not what it computes, such as "results" or "data.root"; a
            path takes all below it and need not exist.

    Raises:
        ValueError: the configuration holds something that JSON cannot say (NaN included).
    """
    kept = _without(config, {tuple(path.split(".")) for path in ignore})
    try:
        text = json.dumps(kept, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"the configuration has no key: {error}; use numbers, texts, lists and dicts only") from error
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def save(path: str | Path, meta: Mapping[str, Any], arrays: Mapping[str, Any]) -> Path:
    """Writes one finished job; a kill at any moment leaves the old file or the new one, never half of one.

    An earlier failure note of the same key and what killed writes left behind are removed.

    Args:
        path: `<folder>/<key>.npz`; the folder is made.
        meta: see `Result`; "format" is added.
        arrays: see `Result`; tensors must be converted first.

    Raises:
        ValueError: a part is missing, is no plain array, or its shape disagrees with the others.
    """
    path = Path(path)
    full = {"format": FORMAT, **meta}
    plain: dict[str, Any] = {name: np.asarray(value) for name, value in arrays.items()}
    _check_meta(path, full)
    _check_arrays(path, full, plain)
    # Unsorted: the order of the groups is the order of the last axis of nees.
    text = np.array(json.dumps(full))
    _write(path, lambda file: np.savez_compressed(file, meta=text, **plain))
    _note(path).unlink(missing_ok=True)
    for stale in path.parent.glob(f"{path.stem}.*.tmp"):
        stale.unlink(missing_ok=True)
    return path


def load(path: str | Path) -> Result:
    """Reads one job.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is damaged, is not a result of pfbench, or has another format; the message says which.
    """
    path = Path(path)
    with _opened(path) as file:
        meta = _meta(path, file)
        arrays = {name: _member(path, file, name) for name in file.files if name != "meta"}
    _check_arrays(path, meta, arrays)
    return Result(meta, arrays)


def describe(path: str | Path) -> dict[str, Any]:
    """What ran, without reading the arrays; errors as `load`."""
    path = Path(path)
    with _opened(path) as file:
        return _meta(path, file)


def failed(path: str | Path, choices: Mapping[str, Any], error: BaseException) -> Path | None:
    """Notes that the job of `path` (`<folder>/<key>.npz`) raised `error`.

    Returns:
        The note `<key>.failed.json`, or None when a good result of that key stands, which is never touched.
    """
    path = Path(path)
    if path.exists():
        return None
    note = {
        "key": path.stem,
        "choices": dict(choices),
        "message": f"{type(error).__name__}: {error}",
        "traceback": "".join(traceback.format_exception(error)),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    text = json.dumps(note, indent=1, sort_keys=True)
    _write(_note(path), lambda file: file.write(text.encode()))
    return _note(path)


def results(folder: str | Path) -> Iterator[Result]:
    """All finished jobs of a folder by scenario, noise, label, seed and key, whatever the order of the files.

    Arrays are read one job at a time.

    Raises:
        ValueError: as `load`, at the first file that cannot be read.
    """
    paths = sorted(Path(folder).glob("*.npz"), key=_rank)
    return map(load, paths)


def failures(folder: str | Path) -> list[dict[str, Any]]:
    """The notes of the jobs of a folder that failed and have no good result since, by key."""
    notes = sorted(Path(folder).glob("*.failed.json"))
    open_notes = (n for n in notes if not n.with_name(n.name.replace(".failed.json", ".npz")).exists())
    return [json.loads(note.read_text()) for note in open_notes]


def _without(config: Any, paths: set[tuple[str, ...]]) -> Any:
    if not isinstance(config, Mapping):
        return config
    below = {name: {path[1:] for path in paths if path[0] == name} for name in config}
    return {name: _without(value, below[name]) for name, value in config.items() if () not in below[name]}


def _note(path: Path) -> Path:
    return path.with_name(f"{path.stem}.failed.json")


def _write(path: Path, fill: Callable[[IO[bytes]], Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name.split('.')[0]}.{uuid4().hex[:8]}.tmp")
    try:
        with temporary.open("xb") as file:
            fill(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except FileNotFoundError:
        # Two sweeps finished the same key at once and the other one's clean-up took our temporary: its result stands.
        if not path.exists():
            raise
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def _opened(path: Path) -> Iterator[np.lib.npyio.NpzFile]:
    if not path.exists():
        raise FileNotFoundError(f"no result at {path}")
    # Opened here and not by numpy, which leaves a damaged file open.
    with path.open("rb") as raw:
        try:
            file = np.load(raw, allow_pickle=False)
        except (OSError, EOFError, ValueError, zipfile.BadZipFile) as error:
            raise ValueError(f"{path} is damaged or no npz file ({error}); delete it and run the job again") from error
        if not isinstance(file, np.lib.npyio.NpzFile):
            raise ValueError(f"{path} holds a single array and is not a result of pfbench; move it away")
        yield file


def _member(path: Path, file: np.lib.npyio.NpzFile, name: str) -> np.ndarray:
    try:
        return file[name]
    except KeyError as error:
        raise ValueError(f"{path} has no {name!r} and is not a result of pfbench; move it away") from error
    except (OSError, EOFError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{path} is damaged at {name!r} ({error}); delete it and run the job again") from error


def _meta(path: Path, file: np.lib.npyio.NpzFile) -> dict[str, Any]:
    text = str(_member(path, file, "meta"))
    try:
        meta = json.loads(text)
    except ValueError as error:
        raise ValueError(f"{path}: 'meta' is no JSON ({error}): no result of pfbench, move it away") from error
    _check_meta(path, meta)
    return meta


def _rank(path: Path) -> tuple[str, str, str, int, str]:
    meta = describe(path)
    choices = meta["choices"]
    return str(choices["scenario"]), str(choices["noise"]), str(meta["label"]), int(meta["seed"]), str(meta["key"])


def _check_meta(path: Path, meta: Any) -> None:
    """Raises ValueError where the description of a job lacks what every reader counts on."""
    found = meta.get("format") if isinstance(meta, dict) else None
    if found != FORMAT:
        raise ValueError(f"{path} has format {found}; this pfbench reads format {FORMAT}: run the job again")
    missing = [name for name in _META if name not in meta]
    if missing:
        raise ValueError(f"{path}: the description of a job needs {', '.join(missing)}")


def _check_arrays(path: Path, meta: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Raises ValueError where arrays are missing, are pickled, or disagree about R, T, D, G or S."""
    missing = [name for name in _AXES if name not in arrays]
    if missing:
        raise ValueError(f"{path}: a result needs the arrays {', '.join(missing)}")
    for name, value in arrays.items():
        # The first three would be taken for arguments of numpy's savez.
        if name in ("file", "args", "allow_pickle", "meta"):
            raise ValueError(f"{path}: the array name {name!r} is taken; use another")
        if value.dtype.hasobject:
            raise ValueError(f"{path}: {name} holds Python objects; store numbers, booleans or texts")
    size: dict[str, int] = {
        "R": int(meta["runs"]),
        "D": len(meta["state"]["names"]),
        "G": len(meta["state"]["groups"]),
        "T": arrays["time"].size,
        "S": arrays["scored"].size if "scored" in arrays else 0,
    }
    for name, axes in (_AXES | {name: axes for name, axes in _OPTIONAL.items() if name in arrays}).items():
        expected = tuple(size[axis] for axis in axes)
        if arrays[name].shape != expected:
            raise ValueError(f"{path}: {name} has shape {arrays[name].shape}, expected {list(axes)} = {expected}")
