"""Results on disk: one `<key>.npz` per job, readable with numpy alone, written atomically.

A file holds `meta`, a JSON text, and plain arrays without pickles. A failed job leaves
`<key>.failed.json` in the same folder.
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

from pfbench.results.result_format import FORMAT, check_arrays, check_metadata

# values of the key `budget`
SAME_N, SAME_TIME, SAME_LIKELIHOODS = BUDGETS = ("particles", "time", "likelihoods")


class JobResult(NamedTuple):
    """Result of a finished job.

    Attributes:
        meta: Metadata: key, study, choices, config, label, seed, versions, seconds, and state
            (names, units, groups).
        data: `time` [T] (s), `error` and `sd` [R, T, D], `nees` [R, T, G], `log_evidence` and
            `lost` [R]. Optional: traces [R, T], `track` [R, T, 3] (m; East, North, Up), and the
            scored steps [S] with `crps`, `pit` [R, S, D] and `energy_score` [R, S, G].
    """

    meta: dict[str, Any]
    data: dict[str, np.ndarray]


def config_key(config: Mapping[str, Any], ignore: tuple[str, ...] = ()) -> str:
    """Compute the key of a job: 16 hexadecimal digits of the SHA-256 of its configuration.

    Args:
        config: Plain nested dictionary with string keys.
        ignore: Dotted paths that change where a job runs but not what it computes, such as
            `results` or `data.root`. A path covers all keys below it and may be missing.

    Returns:
        The key.

    Raises:
        ValueError: If JSON cannot represent a value (NaN included).
    """
    relevant = _without(config, {tuple(path.split(".")) for path in ignore})
    try:
        text = json.dumps(relevant, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"configuration must be numbers, texts, lists and dicts, got {error}."
        ) from error
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def write_result(path: str | Path, meta: Mapping[str, Any], data: Mapping[str, Any]) -> Path:
    """Write a finished job. An interruption leaves the old or the new file, never a partial one.

    The failure note of the same key and temporary files of interrupted writes are removed.

    Args:
        path: `<folder>/<key>.npz`. The folder is created.
        meta: See `JobResult`. `format` is added.
        data: See `JobResult`. Tensors must be converted first.

    Returns:
        The path.

    Raises:
        ValueError: If a part is missing, is not a plain array, or has an inconsistent shape.
    """
    path = Path(path)
    full = {"format": FORMAT, **meta}
    plain: dict[str, Any] = {name: np.asarray(value) for name, value in data.items()}
    check_metadata(path, full)
    check_arrays(path, full, plain)
    # Unsorted, since the order of the groups is that of the last axis of nees.
    text = np.array(json.dumps(full))
    _write(path, lambda file: np.savez_compressed(file, meta=text, **plain))
    _note(path).unlink(missing_ok=True)
    for stale in path.parent.glob(f"{path.stem}.*.tmp"):
        stale.unlink(missing_ok=True)
    return path


def read_result(path: str | Path) -> JobResult:
    """Read a job.

    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If the file is damaged, is not a result of pfbench, or has another format.
    """
    path = Path(path)
    with _opened(path) as file:
        meta = _meta(path, file)
        data = {name: _member(path, file, name) for name in file.files if name != "meta"}
    check_arrays(path, meta, data)
    return JobResult(meta, data)


def read_metadata(path: str | Path) -> dict[str, Any]:
    """Read the metadata of a job without its arrays. Errors as in `read_result`."""
    path = Path(path)
    with _opened(path) as file:
        return _meta(path, file)


def write_failure(
    path: str | Path, choices: Mapping[str, Any], error: BaseException
) -> Path | None:
    """Write the failure note of a job.

    Args:
        path: `<folder>/<key>.npz`.
        choices: Names of scenario, noise, filter and model.
        error: Error of the job.

    Returns:
        The note `<key>.failed.json`, or None if a result of that key exists, which is kept.
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


def list_results(folder: str | Path) -> Iterator[JobResult]:
    """Read all finished jobs of a folder, sorted by scenario, noise, label, seed and key.

    Arrays are read one job at a time.

    Raises:
        ValueError: If a file cannot be read, see `read_result`.
    """
    paths = sorted(Path(folder).glob("*.npz"), key=_rank)
    return map(read_result, paths)


def list_failures(folder: str | Path) -> list[dict[str, Any]]:
    """Read the failure notes of a folder, by key, of jobs without a result."""
    notes = sorted(Path(folder).glob("*.failed.json"))
    results = (note.with_name(note.name.replace(".failed.json", ".npz")) for note in notes)
    pairs = zip(notes, results, strict=True)
    return [json.loads(note.read_text()) for note, result in pairs if not result.exists()]


def _without(config: Any, paths: set[tuple[str, ...]]) -> Any:
    if not isinstance(config, Mapping):
        return config
    below = {name: {path[1:] for path in paths if path[0] == name} for name in config}
    return {
        name: _without(value, below[name])
        for name, value in config.items()
        if () not in below[name]
    }


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
        # Another sweep finished the same key and removed this temporary file. Its result is kept.
        if not path.exists():
            raise
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def _opened(path: Path) -> Iterator[np.lib.npyio.NpzFile]:
    if not path.exists():
        raise FileNotFoundError(f"result {path} does not exist. Run the job.")
    # opened here, since numpy leaves a damaged file open
    with path.open("rb") as raw:
        try:
            file = np.load(raw, allow_pickle=False)
        except (OSError, EOFError, ValueError, zipfile.BadZipFile) as error:
            raise ValueError(
                f"{path} is damaged: it must be an npz file ({error}). Delete it and run the job again."
            ) from error
        if not isinstance(file, np.lib.npyio.NpzFile):
            raise ValueError(
                f"{path} must be a result of pfbench, got a single array. Move it away."
            )
        yield file


def _member(path: Path, file: np.lib.npyio.NpzFile, name: str) -> np.ndarray:
    try:
        return file[name]
    except KeyError as error:
        raise ValueError(
            f"{path} must be a result of pfbench, got a file without {name!r}. Move it away."
        ) from error
    except (OSError, EOFError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(
            f"{path} is damaged: {name!r} must be readable ({error}). "
            "Delete it and run the job again."
        ) from error


def _meta(path: Path, file: np.lib.npyio.NpzFile) -> dict[str, Any]:
    text = str(_member(path, file, "meta"))
    try:
        meta = json.loads(text)
    except ValueError as error:
        raise ValueError(
            f"{path}: 'meta' must be JSON ({error}). This is not a result of pfbench: move it away."
        ) from error
    check_metadata(path, meta)
    return meta


def _rank(path: Path) -> tuple[str, str, str, int, str]:
    meta = read_metadata(path)
    choices = meta["choices"]
    names = str(choices["scenario"]), str(choices["noise"]), str(meta["label"])
    return *names, int(meta["seed"]), str(meta["key"])
