"""Error messages of the command line: key, value and remedy, also for errors of Hydra."""

from __future__ import annotations

import difflib
import dis
import errno
import re
import tempfile
import traceback
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import Any

from pfbench.core.parameter_checks import require
from pfbench.files.escapes import ESCAPED
from pfbench.job.trust import WRITTEN, walk_nodes

# extra of the package that installs a launcher
_EXTRAS = {"ray": "ray", "submitit": "slurm", "joblib": "launch"}
# errors of the file system: remedy
_STORAGE = {
    errno.ENOSPC: "Free space",
    errno.EDQUOT: "Free space of the quota",
    errno.EFBIG: "Raise the limit of the file size (ulimit -f)",
    errno.EROFS: "Make the folder writable or set another one",
    errno.EACCES: "Change its permissions or set another folder",
    errno.EPERM: "Change its permissions or set another folder",
    errno.ENOTDIR: "Set a folder instead of a file",
    errno.EISDIR: "Set a file instead of a folder",
    errno.EEXIST: "Set a folder instead of a file",
    errno.ENOENT: "Make it, or correct its name",
    errno.ENAMETOOLONG: "Use a shorter name",
}
_OTHER_STORAGE = "Check the file and its folder, or set another one"
_ALL_KEYS = " List all: pfbench run --cfg job"


def format_error(error: BaseException, words: Sequence[str] = ()) -> str:
    """Format an error for a user.

    Returns the key, the value given, and a remedy, without characters that a terminal obeys.
    """
    return _choose_sentence(error, words).translate(ESCAPED)


def _choose_sentence(error: BaseException, words: Sequence[str]) -> str:
    """Return the sentence of an error."""
    if type(error).__name__ == "InstantiationException" and error.__cause__ is not None:
        return _format_refusal(f"{error}", error.__cause__, words)
    if isinstance(error, OSError) and error.errno is not None:
        name, remedy = (
            error.filename or "files of the command",
            _STORAGE.get(error.errno, _OTHER_STORAGE),
        )
        return f"{name} must be accessible, got '{error.strerror}'. {remedy}, then repeat the command. Finished jobs are kept."
    if isinstance(error, MemoryError):
        return "memory must be enough for the command, got an array that is too large. Reduce runs, particles or steps."
    text = f"{error}".strip() or type(error).__name__
    if match := re.search(r"tried to allocate (\d+) bytes", text):
        size = int(match[1]) / 2**30
        return f"memory must hold an array of {size:.3g} GiB. Reduce runs, particles or steps."
    if message := _format_hydra_error(text, words):
        return message
    return text if is_named(error) else describe_unknown(error)


def _format_hydra_error(text: str, words: Sequence[str]) -> str:
    """Format an error of Hydra; empty for other errors."""
    if match := re.search(r"Could not override '([^']*)'", text):
        return _format_override(match[1], words)
    if match := re.search(
        rf"[Cc]ould not (?:find|load) 'hydra/launcher/({'|'.join(_EXTRAS)})", text
    ):
        launcher = next((word for word in words if word.startswith("hydra/launcher=")), "launcher")
        return f'{launcher} is not installed. Run pip install "pfbench[{_EXTRAS[match[1]]}]"'
    if message := format_choice_error(text, words):
        return message
    if match := re.search(r"Could not find '(.+)/([^/']*)'", text):
        return format_unknown_choice(match[1], match[2], re.findall(r"^\t(\w+)$", text, re.M))
    matches = ((re.search(pattern, text), sentence) for pattern, sentence in _SENTENCES.items())
    return next((sentence.format(**match.groupdict()) for match, sentence in matches if match), "")


def _format_override(key: str, words: Sequence[str]) -> str:
    """Format the error of a word whose key the configuration lacks."""
    if not key:
        return "each word must be key=value, got one without a key. Write the key before the equals sign."
    if key == "experiment":
        name = next((w.partition("=")[2] for w in words if w.startswith("experiment=")), "NAME")
        return f"experiment={name} must be added with a plus sign. Use +experiment={name}"
    return _format_unknown_key(key, words)


def notes_of(error: BaseException) -> list[str]:
    """Return the remarks that a job has added to its error, such as the file of the traceback."""
    return list(getattr(error, "__notes__", []))


def suggest_similar(name: str, options: Sequence[str]) -> str:
    """Return a sentence with the options that are similar to a misspelt name."""

    def similarity(a: str, b: str) -> float:
        return difflib.SequenceMatcher(None, a, b).ratio()

    scores = {
        option: similarity(option, name)
        for option in options
        if similarity(option.rpartition(".")[2], name.rpartition(".")[2]) >= 0.6
    }
    best = [option for option, score in scores.items() if score > max(scores.values()) - 0.1]
    return f" Similar: {', '.join(best[:3])}." if best else ""


def require_choice(key: object, value: Any, options: Sequence[str], remedy: str = "") -> None:
    """Raise an error unless a value is one of some names."""
    got = value if isinstance(value, str) and value else repr(value)
    advice = f"{suggest_similar(got, options)} {remedy}".strip()
    require(value in options, key, f"be one of {', '.join(options)}", got, advice or "Choose one.")


def format_unknown_choice(group: str, name: str, options: Sequence[str]) -> str:
    """Format an error about a choice that does not exist."""
    if group != "experiment" and name.lower() in options:
        return f"{group}={name} does not exist. Names are in lower case: {group}={name.lower()}"
    is_listed = "/" not in group
    available = f"pfbench list {group}" if is_listed else ", ".join(options)
    return f"{group}={name} does not exist.{suggest_similar(name, options)} List all: {available}"


def _format_refusal(text: str, cause: BaseException, words: Sequence[str]) -> str:
    """Format an error of a class under the full key that the user gave."""
    location = re.search(r"full_key: (\S+)", text)
    # Hydra writes the place in a list without a point: filter.noise_adaptations0
    key = re.sub(r"(?<=[a-z_])(\d+)(?=\.|$)", r".\1", location[1]) if location else "configuration"
    message = " ".join(f"{cause}".split())
    if unknown := re.search(r"got an unexpected keyword argument '(\w+)'", message):
        return _format_unknown_key(f"{key}.{unknown[1]}", words)
    target = re.search(r"Error loading '([\w.]+)'", message)
    if target and (module := re.search(r"No module named '([\w.]+)'", message)):
        return (
            f"{key}._target_ must be importable, got {target[1]}: the module {module[1]} is not "
            "installed. Install it, or set PYTHONPATH to its parent folder."
        )
    if type(cause) is not ValueError:
        overrides = [word.lstrip("+") for word in words if word.lstrip("+").startswith(f"{key}.")]
        if len(overrides) == 1 and "not supported between instances of" in message:
            name, _, value = overrides[0].partition("=")
            return f"{name} must be a number, got {value}. Write it as 0.5 or 1e-3."
        source = " ".join(overrides) or "its YAML file"
        return f"{key}: a value is not valid ({type(cause).__name__}: {message}). Check {source}."
    match = re.match(r"(?:\w+\.)*(\w+)(?=[=:]| must | is not )", message)
    if match is None:
        return f"{key}: {message}"
    keys = (word.lstrip("+").partition("=")[0] for word in words)
    same_name = [name for name in keys if name.endswith(f".{match[1]}")]
    full = min(same_name, key=lambda name: not name.startswith(key), default=f"{key}.{match[1]}")
    rest = message[match.end() :].replace(f"Change {match[0]}.", f"Change {full}.")
    return full + rest


def _format_unknown_key(name: str, words: Sequence[str]) -> str:
    """Format an error about a key that does not exist."""
    override = next((word for word in words if word.lstrip("+~").startswith(f"{name}=")), name)
    keys = _composed_keys(words, name)
    if name in keys and {"-m", "--multirun"} & set(words):
        return (
            f"{override}: not all jobs of this sweep have the key {name}. "
            "Run those without it in a separate sweep."
        )
    parent, _, last = name.rpartition(".")
    others = [key for key in keys if key != name and not key.endswith("._target_")]
    nearby = [key for key in others if parent and key.rpartition(".")[0] == parent]
    elsewhere = [key for key in others if key.rpartition(".")[2] == last]  # the key of another part
    choices = f" Keys of {parent}: {', '.join(nearby)}." if nearby else _ALL_KEYS
    options = [*nearby, *elsewhere] if nearby else others
    return f"{override}: key {name} does not exist.{suggest_similar(name, options) or choices}"


def _composed_keys(words: Sequence[str], excluded: str) -> list[str]:
    """List the dotted keys of the configuration of all other overrides."""
    from pfbench.cli.compose import expand_sweep
    from pfbench.job.config import compose

    others = [word for word in words if "=" in word and excluded not in word]
    try:
        alternatives = expand_sweep([word for word in others if not word.startswith("hydra")])
        first = [options[0] for options in alternatives]
        jobs = [first, *(
            [*first[:i], option, *first[i + 1 :]]
            for i, options in enumerate(alternatives) for option in options[1:]
        )]  # fmt: skip
        paths = [path for job in jobs for path, _ in walk_nodes(compose(job).values)]
        return [path for path in dict.fromkeys(paths) if path and "[" not in path]
    except Exception:  # with a second mistake, a suggestion would only confuse
        return []


# of the texts of Hydra and other libraries about a single value
_SENTENCES = {
    r"Ambiguous value for argument '(?P<key>[^']+)'": "{key} must be one value, got several. Add -m to run all: pfbench run -m ...",
    r"Interpolation key '(?P<other>(?P<group>[^'.]+)\.?(?P<name>[^']*))' not found\s+full_key: (?P<key>\S+)":
        "{key} must be set, since {other} does not exist. Set {key}=... or choose a {group} that defines {name}.",
    r"Missing mandatory value: (?P<key>\S+)": "{key} must be set. Set {key}=...",
    r"LexerNoViableAlt|^(mismatched input|extraneous input|no viable alternative|token recognition error)":
        "each word must be key=value. Quote a value with spaces or signs; names consist of a-z, A-Z, 0-9 and underscores.",
    r"Error parsing override '(?P<word>[^']*)'": "'{word}' must be key=value. Quote it if the shell reads brackets or spaces.",
    r"Error merging override [+~]*(?P<key>[^\s=]+)=(?P<value>\S*)":
        "{key} must have a value of its type, got {value}. See its default: pfbench run --cfg all",
    r"An item is already at '(?P<key>[^']+)'": "{key} exists already. Leave out the plus sign: {key}=VALUE",
}  # fmt: skip


def format_flag(words: Sequence[str], flag: str, command: str) -> str:
    """Format an error about a flag that does not exist, such as `--scenario`.

    Returns the flag, and how the override is written.
    """
    key, _, value = flag.lstrip("-").partition("=")
    following = words[words.index(flag) + 1 :] if flag in words else []
    if not value and following and not re.match(r"-|.*=", following[0]):
        value = following[0]
    return (
        f"{flag} is not an option. Overrides have no dashes: write {key}={value or 'VALUE'} "
        f"(pfbench {command} --help)"
    )


def format_choice_error(text: str, words: Sequence[str]) -> str:
    """Format an error of Hydra about the choice of a file or the search path.

    Returns the key, the value given, and a remedy. Empty for other errors.
    """
    path = next((word for word in words if re.match(r"\+?\w+=\.{0,2}/", word)), "")
    if path and re.search(r"Could not (find|load)", text) and path.partition("=")[2] in text:
        group = path.lstrip("+").partition("=")[0]
        return (
            f"{path} must be a name, got a path. Add its folder with hydra.searchpath=[file://FOLDER], "
            f"or choose a name: pfbench list {group}"
        )
    if "Config group override must be a string or a list" in text:
        from pfbench.job.config import list_groups

        is_number = re.compile(r"[+~]*(\w+)=(null|true|false|[-+.\d].*)", re.IGNORECASE)
        numbers = (
            word for word in words if (m := is_number.fullmatch(word)) and m[1] in list_groups()
        )
        if (word := next(numbers, None)) is None:
            return "each group must have the name of a file. List the groups: pfbench list"
        group = word.lstrip("+").partition("=")[0]
        return f"{word} must name a file of the group. Choose one: pfbench list {group}"
    return ""


# --------------------------------------------------------------------------------------------------
# Errors that pfbench does not name: stage and file by the entry on the stack, and the file of the trace.
#
# A sentence is written where an error is expected: pfbench raises it by a `raise` statement. All other errors are of Python or of
# a library. They are reported with what was being done, their class and text, and a file with the whole trace.

# what a folder of pfbench does; those without an entry serve the others
_STAGES = {
    "claims": "writing the page of the claims",
    "cli": "running the command",
    "filter": "running the filter",
    "job": "running the job",
    "judge": "comparing the trajectories",
    "learn": "training the network",
    "model": "evaluating the model",
    "noise": "drawing the errors of the measurements",
    "report": "writing the page",
    "results": "reading the results",
    "scenario": "drawing the data of the scenario",
    "stats": "comparing the filters",
}
# modules of the folder job with a stage of their own
_STAGES |= dict.fromkeys(
    (
        "config",
        "file_rules",
        "model_fit",
        "search_folders",
        "shared_loader",
        "trust",
        "tuned_knobs",
    ),
    "composing the configuration",
)
_STAGES["replay"] = "computing the stored run again"
_FILE_NAMES = ("path", "file")  # local variables of functions that read or write
_RAISE = dis.opmap["RAISE_VARARGS"]


def is_named(error: BaseException) -> bool:
    """Return whether pfbench raised an error itself, so that its text is a sentence for the user."""
    if any(base.__module__.partition(".")[0] == "pfbench" for base in type(error).__mro__):
        return True
    entry = error.__traceback__
    while entry is not None and entry.tb_next is not None:
        entry = entry.tb_next
    if entry is None:
        return True
    is_raised = entry.tb_frame.f_code.co_code[entry.tb_lasti] == _RAISE
    return is_raised and _module(entry.tb_frame)[0] == "pfbench"


def describe_unknown(error: BaseException) -> str:
    """Describe an error that pfbench does not name.

    Returns Stage or file, class and text of the error, and a remedy.
    """
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    package_frames = [frame for frame in reversed(frames) if _module(frame)[0] == "pfbench"]
    names = [name for frame in package_frames for name in reversed(_module(frame)[1:])]
    stage = next((_STAGES[name] for name in names if name in _STAGES), "running the command")
    files = [frame.f_locals.get(name) for frame in package_frames[:3] for name in _FILE_NAMES]
    path = next((value for value in files if isinstance(value, Path)), None)
    name = f"{stage} ({path})" if path else stage
    reason = " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":").rstrip(".")
    calls = traceback.extract_tb(error.__traceback__)
    if own_frames := [call for call in calls if Path(call.filename).parent.match(WRITTEN)]:
        return f"{own_frames[-1].name} of your class must succeed, got {reason}. Correct the line: {own_frames[-1].line}"
    subject = (
        str(path)
        if path
        else "the words of the command, the files that they name, and a class of your own by pfbench check"
    )
    return f"{name} must succeed, got {reason}. Check {subject}."


def keep_trace(error: BaseException, words: Sequence[str]) -> Path | None:
    """Write the trace of an error into a file of its own in the system's temporary folder.

    Returns the file, or None if none can be written.
    """
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="pfbench-", suffix=".txt", delete=False, encoding="utf-8", errors="backslashreplace"
        ) as file:  # fmt: skip
            file.write(f"{' '.join(['pfbench', *words])}\n\n")
            file.writelines(traceback.format_exception(error))
    except OSError:
        return None
    return Path(file.name)


def _module(frame: FrameType) -> list[str]:
    """Return the parts of the name of a frame's module, at least two."""
    return [*str(frame.f_globals.get("__name__", "")).split("."), ""]
