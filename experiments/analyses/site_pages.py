"""Pages of the site that are written from the code: public names, keys of the configuration, and commands."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from types import ModuleType

import pfbench
from pfbench.cli.command import list_commands
from pfbench.cli.compose import read_description
from pfbench.cli.main import USAGE
from pfbench.job import conf_dir
from pfbench.job.config import list_groups
from pfbench.results.paper_block import read_part

Pages = dict[str, str]
_GROUPS = {  # title and first sentence of the page of a group
    "scenario": ("Scenarios", "Test situations: vehicle, trajectory and sensors."),
    "noise": ("Noise regimes", "Behaviour of the measurement and process noise in a scenario."),
    "filter": ("Filters", "Filters and forms of filters. Their stages are keys."),
    "model": ("Models", "What the filters assume."),
    "train": ("Trainings", "Settings of `pfbench train`."),
    "infer": ("Inference of parameters", "Settings of `pfbench infer`."),
    "report": ("Reports", "Settings of `pfbench report`."),
    "tuned": ("Tuned knobs", "What `pfbench tune` has chosen in each world."),
    "experiment": ("Experiments", "Published studies, run by `pfbench run -m +experiment=NAME`."),
}
_KEY = re.compile(r"( *)([\w/]+):(?: +([^#]*?))?(?: +# (.*))?")


def write_pages() -> Pages:
    """Write all pages, by path."""
    return {**_write_names(), **_write_keys(), "reference/commands.md": _write_commands()}


def list_rooms() -> list[str]:
    """List the folders of the package with public names."""
    return [name for name in pfbench.__all__ if isinstance(getattr(pfbench, name), ModuleType)]


# --------------------------------------------------------------------------------------------------
# Public names


def _write_names() -> Pages:
    """Write a page for the top of the package and one for each folder."""
    top = [name for name in pfbench.__all__ if name not in (*list_rooms(), "__version__")]
    first = "First names, from `import pfbench`. See also the tutorials.".replace("`", "``")
    pages = {"reference/api/pfbench.rst": _format_names("pfbench", first, {"": top})}
    for room in list_rooms():
        name = f"pfbench.{room}"
        text = (importlib.import_module(name).__doc__ or "").splitlines()[0]
        pages[f"reference/api/{room}.rst"] = _format_names(name, text, _names_by_module(room))
    names = ["pfbench", *list_rooms()]
    rows = [f"| [{name}]({name}.rst) | {_first_line(name)} |" for name in names]
    head = "# Public names\n\nEvery name has its arguments, shapes and units. All others may change.\n\n"
    table = "\n".join(["| folder | content |", "|---|---|", *rows])
    tree = "\n".join(["", "", "```{toctree}", ":hidden:", "", *names, "```", ""])
    return {**pages, "reference/api/index.md": head + table + tree}


def _first_line(room: str) -> str:
    """Return the description of a folder."""
    module = pfbench if room == "pfbench" else importlib.import_module(f"pfbench.{room}")
    return (module.__doc__ or "").splitlines()[0]


def _names_by_module(room: str) -> dict[str, list[str]]:
    """Return the names of a folder by the module that defines them."""
    file = Path(str(pfbench.__file__)).parent / room / "__init__.pyi"
    names: dict[str, list[str]] = {}
    for node in ast.parse(file.read_text()).body:
        if isinstance(node, ast.ImportFrom):
            names.setdefault(str(node.module), []).extend(alias.name for alias in node.names)
    return names


def _format_names(room: str, text: str, names: Mapping[str, list[str]]) -> str:
    """Format the page of a folder as reStructuredText: one entry for each name."""
    lines = [room, "=" * len(room), "", text, ""]
    for module, members in names.items():
        if module and len(names) > 6:
            heading = (module.rpartition(".")[2].replace("_", " ")).capitalize()
            lines += [heading, "-" * len(heading), ""]
        for name in members:
            lines += [*_format_entry(room, name, module), ""]
    return "\n".join(lines)


def _format_entry(room: str, name: str, module: str) -> Iterator[str]:
    """Yield the lines of a name: its docstring by autodoc, or the value and the comment of a constant."""
    value = getattr(importlib.import_module(room), name)
    if inspect.isclass(value):
        yield f".. autoclass:: {room}.{name}"
    elif inspect.isfunction(value):
        yield f".. autofunction:: {room}.{name}"
    else:
        yield from (f".. py:data:: {room}.{name}", "", f"   {describe_constant(module, name)}")


@cache
def _read_module(module: str) -> str:
    """Read the source of a module."""
    return Path(str(importlib.import_module(module).__file__)).read_text(encoding="utf-8")


def describe_constant(module: str, name: str) -> str:
    """Return the comment `#:` of a constant.

    Args:
        module: Module that defines it.
        name: Its name.

    Raises:
        ValueError: If there is none.
    """
    source = _read_module(module)
    pattern = rf"((?:^#: [^\n]*\n)*)^{name}\b[^\n]*?(?:#: ([^\n]*))?$"
    match = re.search(pattern, source, re.MULTILINE)
    text = " ".join((match[1] or "").replace("#: ", "").split()) or match[2] if match else None
    if not text:
        raise ValueError(f"{module}.{name} must have a comment `#:`, got none. Add one.")
    return text


# --------------------------------------------------------------------------------------------------
# Keys of the configuration


def _write_keys() -> Pages:
    """Write the table of the keys of a job, and a page for each group."""
    groups = {name: names for name, names in list_groups().items() if name in _GROUPS}
    rows = [
        f"| [{name}]({name}.md) | {len(names)} | {_GROUPS[name][1]} |"
        for name, names in sorted(groups.items())
    ]
    lines = [
        "# Keys of the configuration", "",
        "`pfbench run KEY=VALUE` sets a key of the job, and `GROUP=NAME` chooses a file of a group. In Python the keys are keywords: "
        "`pfbench.run(..., particles=1000)`, with two underscores for a point. `pfbench run --cfg job` prints all keys of a job.", "",
        "## Keys of a job", "", "| key | default | meaning |", "|---|---|---|",
        *(f"| `{key}` | `{value}` | {_escape(text)} |" for key, value, text in read_keys()), "",
        "## Groups", "", "| group | names | content |", "|---|---|---|", *rows, "",
        "```{toctree}", ":hidden:", "", *sorted(groups), "```", "",
    ]  # fmt: skip
    pages = {
        f"reference/keys/{name}.md": _format_group(name, names) for name, names in groups.items()
    }
    return {"reference/keys/index.md": "\n".join(lines), **pages}


def _escape(text: str) -> str:
    """Escape a text for a cell of a table."""
    return text.replace("|", "\\|")


def read_keys() -> list[tuple[str, str, str]]:
    """Read the keys of a job with defaults and comments, from the main configuration."""
    text = (conf_dir() / "config.yaml").read_text(encoding="utf-8")
    keys, folders = [], list[str]()
    for line in text[text.index("\nstudy:") : text.index("\nhydra:")].splitlines():
        match = _KEY.fullmatch(line)
        if match is None:
            continue
        indent, name, value, comment = match.groups()
        folders = [*folders[: len(indent) // 2], name]
        if value:
            keys.append((".".join(folders), value.strip(), comment or ""))
    return keys


def _format_group(group: str, names: list[str]) -> str:
    """Format the page of a group: each name with its description and its keys."""
    title, sentence = _GROUPS[group]
    lines = [f"# {title}", "", sentence, ""]
    for name in names:
        text = read_part(group, name).strip()
        lines += [f"## {name}", "", read_description(text).replace("[", "\\["), ""]
        lines += [":::{dropdown} Keys and values", "```yaml", text, "```", ":::", ""]
    return "\n".join(lines)


# --------------------------------------------------------------------------------------------------
# Commands


def _write_commands() -> str:
    """Write the page of the command line: the help of all commands."""
    commands = list_commands()
    rows = [f"| [`{name}`](#pfbench-{name}) | {file.summary} |" for name, file in commands.items()]
    end = USAGE.partition("Exit codes: ")[2].partition("\n")[0]
    lines = [
        "# Command line",
        "",
        "| command | use |",
        "|---|---|",
        *rows,
        "",
        f"Exit codes: {end}.",
        "",
    ]
    for name, file in commands.items():
        text = file.load().format_help().strip()
        lines += [f"## pfbench {name}", "", "```text", text, "```", ""]
    return "\n".join(lines)
