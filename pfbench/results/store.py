"""Results on disk: one `<key>.npz` per job, readable with numpy alone, written atomically.

A file holds `meta`, a JSON text, and plain arrays without pickles. A failed job leaves
`<key>.failed.json` in the same folder.
"""

from __future__ import annotations

import json
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from pfbench.files.atomic_write import remove_temporary_files, write_atomically
from pfbench.files.digest import DIGEST, has_valid_digest, hash_content
from pfbench.files.limits import LimitError, check_zip
from pfbench.files.work_start import start_work
from pfbench.results.config_key import list_same_configuration
from pfbench.results.result_format import FORMAT, check_arrays, check_metadata

# values of the key `budget`
_LARGEST_NOTE = 10_000_000  # bytes
SAME_N, SAME_TIME, SAME_LIKELIHOODS = BUDGETS = ("particles", "time", "likelihoods")


class DamagedResultError(ValueError):
    """A file of a result is damaged, or is the result of another job."""


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
    digest = np.array(hash_content({"meta": text, **plain}))
    start_work()
    _write(path, lambda file: np.savez_compressed(file, meta=text, digest=digest, **plain))
    _note(path).unlink(missing_ok=True)
    for note in list_same_configuration(path, ".failed.json"):  # of inputs that have changed
        if _read_note(note)["choices"] == full["choices"]:
            note.unlink(missing_ok=True)
    remove_temporary_files(path)
    return path


def read_result(path: str | Path) -> JobResult:
    """Read a job.

    Raises:
        FileNotFoundError: If the file does not exist.
        DamagedResultError: If the file is damaged or is the result of another job.
        ValueError: If it is not a result of pfbench, or has another format.
    """
    path = Path(path)
    with _opened(path) as file:
        meta = _meta(path, file)
        data = {name: _member(path, file, name) for name in file.files}
    if not has_valid_digest(data):
        raise DamagedResultError(
            f"{path} is damaged: its digest must be that of its content. Run the job again."
        )
    if meta["key"] != path.stem:
        raise DamagedResultError(
            f"{path} must be the result of job {path.stem}, got that of job {meta['key']}. "
            "Give the file its own name, or delete it."
        )
    data = {name: value for name, value in data.items() if name not in ("meta", DIGEST)}
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
    note[DIGEST] = hash_content(note)
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
    """List the failures of jobs without a result by key: failure notes, then damaged files."""
    notes = sorted(Path(folder).glob("*.failed.json"))
    results = (note.with_name(note.name.replace(".failed.json", ".npz")) for note in notes)
    pairs = zip(notes, results, strict=True)
    failed = [_read_note(note) for note, result in pairs if not result.exists()]
    damaged = {path.name.partition(".")[0] for path in Path(folder).glob("*.npz.damaged*")}
    lost = sorted(key for key in damaged if not (Path(folder) / f"{key}.npz").exists())
    return failed + [_unknown_failure(key, f"{key}.npz was damaged") for key in lost]


def _note(path: Path) -> Path:
    return path.with_name(f"{path.stem}.failed.json")


def _read_note(path: Path) -> dict[str, Any]:
    """Read a failure note. Of a damaged one only the name of the file is used."""
    try:
        is_note = path.is_file() and path.stat().st_size <= _LARGEST_NOTE
        note: Any = json.loads(path.read_bytes()) if is_note else None
        is_complete = isinstance(note, dict) and set(note) >= {"key", "choices", "message"}
        if is_complete and has_valid_digest(note) and path.name.startswith(str(note["key"])):
            return dict(note)
    except (OSError, ValueError, RecursionError):
        pass
    return _unknown_failure(path.name.partition(".")[0], f"{path.name} is damaged")


def _unknown_failure(key: str, reason: str) -> dict[str, Any]:
    """Return the failure of a job whose choices are unknown."""
    unknown = dict.fromkeys(("scenario", "noise", "model", "filter"), "unknown")
    return {"key": key, "choices": unknown, "message": f"{reason}. Run the job again"}


def _write(path: Path, fill: Callable[[IO[bytes]], Any]) -> None:
    try:
        write_atomically(path, fill)
    except FileNotFoundError:
        # Another sweep finished the same key and removed this temporary file. Its result is kept.
        if not path.exists():
            raise


@contextmanager
def _opened(path: Path) -> Iterator[np.lib.npyio.NpzFile]:
    if not path.exists():
        raise FileNotFoundError(f"result {path} does not exist. Run the job.")
    if not path.is_file():  # reading a pipe or a device would not end
        raise DamagedResultError(
            f"{path} is damaged: it must be a file, got another kind. Delete it and run the job again."
        )
    try:
        check_zip(path)
    except LimitError as error:
        raise DamagedResultError(
            f"{path} is damaged: its size must be plausible ({error}). Delete it and run the job again."
        ) from error
    # opened here, since numpy leaves a damaged file open
    with path.open("rb") as raw:
        try:
            file = np.load(raw, allow_pickle=False)
        except Exception as error:  # numpy and zipfile raise many kinds for damaged files
            raise DamagedResultError(
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
    except Exception as error:
        raise DamagedResultError(
            f"{path} is damaged: {name!r} must be readable ({error}). "
            "Delete it and run the job again."
        ) from error


def _meta(path: Path, file: np.lib.npyio.NpzFile) -> dict[str, Any]:
    text = str(_member(path, file, "meta"))
    try:
        meta = json.loads(text)
    except (ValueError, RecursionError) as error:
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
