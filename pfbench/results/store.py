"""Results on disk: one `<key>.npz` per job, its key, its format, and its atomic writing."""

from __future__ import annotations

import hashlib
import json
import math
import re
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from textwrap import shorten
from typing import IO, Any, NamedTuple

import numpy as np

from pfbench.core.parameter_checks import require
from pfbench.files.atomic_write import (
    DIGEST,
    has_valid_digest,
    hash_content,
    remove_temporary_files,
    write_atomically,
)
from pfbench.files.command_start import start_work
from pfbench.files.limits import LimitError, check_zip, find_input
from pfbench.kernels.generator_version import GENERATOR_VERSION

# A file holds `meta`, a JSON text, and plain arrays without pickles. A failed job leaves
# `<key>.failed.json` in the same folder.

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

    Returns the path.
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
    """Read a job."""
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


def remove_result(path: Path) -> None:
    """Remove a result that a user no longer wants in a study."""
    path.unlink(missing_ok=True)


def write_failure(
    path: str | Path, choices: Mapping[str, Any], error: BaseException, words: Sequence[str] = ()
) -> Path | None:
    """Write the failure note of a job, with the words of the command that repeats it if they are known.

    Returns the note `<key>.failed.json`, or None if a result of that key exists, which is kept.
    """
    path = Path(path)
    if type(error).__name__ == "InstantiationException" and error.__cause__ is not None:
        error = error.__cause__  # the sentence of the class, without that of Hydra
    if path.exists():
        return None
    note = {
        "key": path.stem,
        "choices": dict(choices),
        "message": f"{type(error).__name__}: {error}",
        "traceback": "".join(traceback.format_exception(error)),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        **({"words": list(words)} if words else {}),
    }
    note[DIGEST] = hash_content(note)
    text = json.dumps(note, indent=1, sort_keys=True)
    _write(_note(path), lambda file: file.write(text.encode()))
    return _note(path)


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
        find_input(path.parent, path.name)
        check_zip(path)
    except LimitError as error:
        raise DamagedResultError(
            f"{path} is damaged: it must be a file of this folder, of a plausible size ({error}). "
            "Delete it and run the job again."
        ) from error
    # opened here, since numpy leaves a damaged file open
    with path.open("rb") as raw:
        try:
            file = np.load(raw, allow_pickle=False)
        except Exception as error:  # numpy and zipfile raise many kinds for damaged files
            raise DamagedResultError(
                f"{path} is damaged: it must be an npz file ({error}). Delete it and run the job again."
            ) from error
        require(
            isinstance(file, np.lib.npyio.NpzFile),
            path,
            "be a result of pfbench",
            "a single array",
            "Move it away.",
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


# --------------------------------------------------------------------------------------------------
# Format of a result file: required metadata, and arrays whose shapes agree.

FORMAT = 2

# Axes that must agree across arrays: R runs, T steps, D components, G groups, S scored steps.
_AXES = {"time": "T", "error": "RTD", "sd": "RTD", "nees": "RTG", "log_evidence": "R", "lost": "R"}

_OPTIONAL = {
    "score_steps": "S",
    "crps": "RSD",
    "pit": "RSD",
    "energy_score": "RSG",
    "pcrb": "TD",
    "range": "T",
    "health": "R",
    "pareto_k": "R",
    "run": "R",
    "evidence_floor": "R",
}

_META = ("key", "study", "choices", "config", "label", "seed", "runs", "state")
_LONGEST = 2000  # characters of a name; a label lists the settings in which it differs
_LARGEST = 1 << 63
_HEALTH = 8  # classes of `pfbench.filter.health`


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and len(value) <= _LONGEST


def _is_whole(value: Any) -> bool:
    return type(value) is int and 0 <= value < _LARGEST


def _is_number(value: Any) -> bool:
    return value is None or (type(value) in (int, float) and abs(value) < _LARGEST)


def _are_texts(value: Any) -> bool:
    return isinstance(value, dict) and all(map(_is_text, value.values()))


# requirement and test of keys; a key that is not required may be absent
_KINDS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    **dict.fromkeys(("key", "label"), (f"a text of at most {_LONGEST} characters", _is_text)),
    **dict.fromkeys(("seed", "runs", "steps"), ("a whole number", _is_whole)),
    "particles": ("a number or null", _is_number),
    "config": ("a dictionary", lambda value: isinstance(value, dict)),
    "choices": ("a dictionary of names", _are_texts),
    "versions": ("a dictionary of texts", _are_texts),
    "inputs": (
        "a dictionary of dictionaries of texts",
        lambda value: isinstance(value, dict) and all(map(_are_texts, value.values())),
    ),
    "seconds": (
        "a dictionary of numbers",
        lambda value: isinstance(value, dict) and all(map(_is_number, value.values())),
    ),
}


def check_metadata(path: Path, meta: Any) -> None:
    """Check that the metadata have the format and all required keys."""
    version = meta.get("format") if isinstance(meta, dict) else None
    require(
        version == FORMAT,
        path,
        f"have format {FORMAT}",
        version,
        "Run the job again.",
    )
    missing = [name for name in _META if name not in meta]
    must = f"contain {', '.join(missing)}"
    require(not missing, f"{path}: metadata", must, "none of them", "Run the job again.")
    for name, (kind, is_valid) in _KINDS.items():
        require(
            name not in meta or is_valid(meta[name]),
            f"{path}: {name}",
            f"be {kind}",
            shorten(repr(meta.get(name)), 60),
            "Run the job again.",
        )
    if fault := _find_state_fault(meta["state"]):
        raise ValueError(f"{path}: state must {fault}. Run the job again.")


def _find_state_fault(state: Any) -> str:
    """Return the requirement that a description of a state does not meet, or an empty text."""
    if not isinstance(state, dict) or not {"names", "units", "groups"} <= state.keys():
        return "have names, units and groups, got none of one"
    names, units, groups = state["names"], state["units"], state["groups"]
    for values in (names, units):
        if not isinstance(values, list) or not all(map(_is_text, values)):
            return f"have lists of texts, got {shorten(repr(values), 60)}"
    if len(units) != len(names):
        return f"have one unit for each of {len(names)} names, got {len(units)}"
    if not isinstance(groups, dict) or not all(
        isinstance(group, list) for group in groups.values()
    ):
        return f"have groups of components, got {shorten(repr(groups), 60)}"
    indices = [index for group in groups.values() for index in group]
    wrong = [index for index in indices if not _is_whole(index) or index >= len(names)]
    if wrong:
        return f"have groups of components from 0 to {len(names) - 1}, got {wrong[0]!r:.60}"
    return ""


def check_arrays(path: Path, meta: Mapping[str, Any], data: Mapping[str, np.ndarray]) -> None:
    """Check the names, types and shapes of the arrays of a result."""
    missing = [name for name in _AXES if name not in data]
    require(
        not missing,
        f"{path}: a result",
        f"contain the arrays {', '.join(missing)}",
        "none of them",
        "Run the job again.",
    )
    for name, value in data.items():
        # the first three are arguments of numpy's savez
        require(
            name not in ("file", "args", "allow_pickle", "meta", DIGEST),
            f"{path}: name of an array",
            "not be reserved",
            f"{name!r}",
            "Use another name.",
        )
        require(
            not value.dtype.hasobject,
            f"{path}: {name}",
            "be numbers, booleans or texts",
            "Python objects",
            "Convert them.",
        )
    _check_run_numbers(path, meta, data)
    _check_values(path, data)
    size: dict[str, int] = {
        "R": int(meta["runs"]),
        "D": len(meta["state"]["names"]),
        "G": len(meta["state"]["groups"]),
        "T": data["time"].size,
        "S": data["score_steps"].size if "score_steps" in data else 0,
    }
    for name, axes in (
        _AXES | {name: axes for name, axes in _OPTIONAL.items() if name in data}
    ).items():
        expected = tuple(size[axis] for axis in axes)
        require(
            data[name].shape == expected,
            f"{path}: {name}",
            f"have shape {list(axes)} = {expected}",
            data[name].shape,
            "Run the job again.",
        )


def _check_values(path: Path, data: Mapping[str, np.ndarray]) -> None:
    """Check that scores are real numbers, times increase and no spread is negative."""
    for name in data.keys() & (_AXES.keys() | _OPTIONAL.keys()):
        if data[name].dtype.kind not in ("b" if name == "lost" else "biuf"):
            kind = "booleans" if name == "lost" else "real numbers"
            raise ValueError(
                f"{path}: {name} must be {kind}, got {data[name].dtype}. Run the job again."
            )
    health = data.get("health", np.zeros(1))
    for name, requirement, is_valid in (
        ("time", "increase", bool((np.diff(data["time"]) > 0.0).all())),
        ("sd", "not be negative", not bool((data["sd"] < 0.0).any())),
        ("health", f"be from 0 to {_HEALTH - 1}", bool(((health >= 0) & (health < _HEALTH)).all())),
    ):
        require(
            is_valid,
            f"{path}: {name}",
            requirement,
            "other values",
            "Run the job again.",
        )


def _check_run_numbers(path: Path, meta: Mapping[str, Any], data: Mapping[str, np.ndarray]) -> None:
    """Check that each run has a number of its own: a repeated run would count twice."""
    first = meta.get("first_run", 0)
    require(
        type(first) is int and first >= 0 and first + int(meta["runs"]) <= 1 << 32,
        f"{path}: first_run",
        "be a whole number from 0 to 2**32 - runs",
        first,
        "Run the job again.",
    )
    if "run" in data:
        numbers, counts = np.unique(data["run"], return_counts=True)
        if (counts > 1).any():
            raise ValueError(
                f"{path}: run must have distinct run numbers, got {numbers[counts > 1][0]} "
                f"{counts.max()} times. Run the job again."
            )


# --------------------------------------------------------------------------------------------------
# Key of a job: a hash of its configuration and of the content of the files that it reads.

# digests by name, for the groups of a configuration, see `pfbench.job.inputs`
Inputs = dict[str, dict[str, str]]
_HALF = 8  # digits of a key that depend on the configuration alone
# folders of files whose content is part of the key, see `pfbench.job.inputs`
DATA_FOLDERS = (
    "scenario.root",
    "scenario.trajectory.root",
    "scenario.receiver.constellation.root",
    "model.receiver.constellation.root",
    "noise.root",
)
# paths of a configuration that decide where, when and how fast a job runs, not what it computes
PLACE_SETTINGS = (
    "results_dir",
    "reports_dir",
    "episode_cache_dir",
    "data",
    "study",
    "threads",
    "engine",  # only in double precision, see below
    "memory_limit_gib",
    "overwrite",
    "report",
    *DATA_FOLDERS,
    "scenario.cache_dir",
    "pcrb",  # does not change the filter's results; a job without the bound runs again where it is requested
    "runs_in",  # an experiment's table from which `runs` is taken
    "until_decided",  # caps of a study that adds runs
    "train",
    "checkpoint",  # the filter's weights are part of the key, by a hash of their content
)


# module that the Python door writes for a class of a script or a notebook: its name ends with a digest of the source
_WRITTEN_MODULE = re.compile(r"\b(own_\w+?)_[0-9a-f]{10}\b")


def remove_digests(text: str) -> str:
    """Return a text without the digests in names of written modules: the source is an input of a job, not a setting."""
    return _WRITTEN_MODULE.sub(r"\1", text)


def compute_config_key(config: Mapping[str, Any], ignore: tuple[str, ...] = ()) -> str:
    """Compute the key of a job: 16 hexadecimal digits of the SHA-256 of its configuration.

    The version of the random number generator is part of it. In single precision the engine is, too:
    sums that are rounded in another order may choose other ancestors. In double precision the
    results of all engines agree to rounding.
    """
    if config.get("dtype") == "float32":
        ignore = tuple(path for path in ignore if path != "engine")
    relevant = _without(config, {tuple(path.split(".")) for path in ignore})
    for key, value in list_not_finite(relevant, ""):
        raise ValueError(f"{key} must be finite, got {value}. Set {key} to a number.")
    relevant = {"config": relevant, "generator": GENERATOR_VERSION}
    try:
        text = json.dumps(relevant, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"configuration must be numbers, texts, lists and dicts, got {error}."
        ) from error
    return hashlib.sha256(remove_digests(text).encode()).hexdigest()[:16]


def extend_key(key: str, inputs: Inputs) -> str:
    """Return the key of a job with inputs. Its first half stays that of the configuration."""
    if not inputs:
        return key
    text = json.dumps([key, inputs], sort_keys=True)
    return key[:_HALF] + hashlib.sha256(text.encode()).hexdigest()[: len(key) - _HALF]


def list_same_configuration(path: Path, suffix: str) -> list[Path]:
    """List the files of other inputs next to a result, whose keys have the same first half."""
    return [f for f in path.parent.glob(f"{path.stem[:_HALF]}*{suffix}") if f != path]


def list_not_finite(node: Any, key: str) -> Iterator[tuple[str, float]]:
    """Yield the keys and values of all numbers that are infinite or NaN."""
    if isinstance(node, Mapping | list):
        pairs = node.items() if isinstance(node, Mapping) else enumerate(node)
        for name, value in pairs:
            yield from list_not_finite(value, f"{key}.{name}" if key else f"{name}")
    elif isinstance(node, float) and not math.isfinite(node):
        yield key, node


def _without(config: Any, paths: set[tuple[str, ...]]) -> Any:
    if not isinstance(config, Mapping):
        return config
    below = {name: {path[1:] for path in paths if path[0] == name} for name in config}
    return {
        name: _without(value, below[name])
        for name, value in config.items()
        if () not in below[name]
    }
