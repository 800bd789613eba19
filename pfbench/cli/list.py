"""Commands of names: what a configuration can choose.

Command `pfbench list`: list what a configuration can choose.
Command `pfbench completion`: print the completion of words for a shell.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from pathlib import Path

from pfbench.cli.command import Command, list_commands
from pfbench.cli.compose import given_keys, read_description
from pfbench.cli.messages import require_choice
from pfbench.core.parameter_checks import require
from pfbench.job.config import FILTER_SETS, compose_tree, list_groups
from pfbench.results.paper_block import conf_dir, read_part

_OTHER = {"model": "scenario", "scenario": "model"}


def list_options(words: Sequence[str]) -> None:
    """Print the configuration groups, or the files of one group."""
    groups = list_groups()
    if not words:
        for group, names in groups.items():
            print(f"{group:12} {', '.join(names)}")
        print("\nNext: pfbench list GROUP")
        return
    group = words[0] or "an empty word"
    require_choice("group", group, list(groups))
    texts = describe_files(group)
    if len(words) > 1:
        fitting = _list_fitting(group, words[1:])
        texts = {name: text for name, text in texts.items() if name in fitting}
    for name, text in texts.items():
        print(f"{name:24} {text}")
    if not texts:
        print(f"No {group} fits.")


def describe_files(group: str) -> dict[str, str]:
    """Return the descriptions of a group by name, those of the current folder last."""
    texts = {name: read_part(group, name) for name in list_groups()[group]}
    texts |= {path.stem: path.read_text() for path in list_own_files(group)}
    return {name: read_description(text) for name, text in texts.items()}


def describe_choices(group: str | None) -> dict[str, str]:
    """Return the descriptions of the files of a group by name, or the groups with their numbers of files."""
    groups = list_groups()
    if group is None:
        return {name: f"{len(describe_files(name))} names" for name in groups}
    require_choice("group", group, list(groups))
    sets = {name: ", ".join(names) for name, names in FILTER_SETS.items()}
    return {**describe_files(group), **(sets if group == "filter" else {})}


def _list_fitting(group: str, words: Sequence[str]) -> Collection[str]:
    """List the models or scenarios that fit overrides, which name the other one."""
    from pfbench.job.model_fit import list_fitting_models, list_fitting_scenarios

    needed = _OTHER.get(group)
    example = f"pfbench list {group} {needed}=NAME" if needed else f"pfbench list {group}"
    is_fit = needed in given_keys(words)
    require(is_fit, "words", f"be {example}", " ".join(words), "See pfbench list --help")
    if group == "scenario":
        return list_fitting_scenarios(words)
    tree = compose_tree(words)
    return list_fitting_models(tree, scenario=tree.hydra.runtime.choices["scenario"])


# of a file of the user in `conf` of the current folder, which the command line and Python use without a search path
_CHOICE = re.compile(r"\+?(\w+)=([\w,]+)")


def list_own_files(group: str) -> list[Path]:
    """List the files of a group in `conf` of the current folder, unless that is the folder of pfbench. A link may lead out of it."""
    folder = Path("conf")
    if not folder.is_dir() or folder.resolve() == conf_dir().resolve():
        return []
    return sorted(
        p
        for p in (folder / group).glob("*.yaml")
        if p.is_file() and not p.is_symlink() and p.name.isprintable()
    )


def add_search_path(words: Sequence[str]) -> list[str]:
    """Add the folder `conf` to words that choose one of its files, unless they set a search path.

    A file with the name of a shipped one counts, too: Hydra's loader then refuses it.
    """
    if not Path("conf").is_dir() or any(
        re.match(r"[+~]*hydra\.searchpath\b|--config-dir\b|-cd\b", word) for word in words
    ):
        return list(words)
    for match in filter(None, map(_CHOICE.fullmatch, words)):
        has_knobs = match[1] == "filter" and re.search(r"_tuned\b|tuned_baselines", match[2])
        if {*match[2].split(",")} & {path.stem for path in list_own_files(match[1])} or (
            has_knobs and list_own_files("tuned")
        ):
            return [*words, "hydra.searchpath=[file://conf]"]
    return list(words)


LIST_COMMAND = Command(
    list_options,
    """\
pfbench list [GROUP] [key=value ...]

List the configuration groups with their files, or the files of a group with their descriptions.

  pfbench list
  pfbench list filter
  pfbench list model scenario=sar_flight     the models that fit a scenario
  pfbench list scenario model=ins_gnss       the scenarios that fit a model""",
)


_SHELLS = ("bash", "zsh")
_SCRIPT = """\
{head}_pfbench() {{
    local word="${{COMP_LINE:0:$COMP_POINT}}"
    word="${{word##* }}"
    local key="${{word%%=*}}" value="${{word##*[=,]}}" names=""
    if [[ "$word" != *=* ]]; then
        names="{words}"
        [[ $COMP_CWORD -eq 1 ]] && names="{commands}"
        COMPREPLY=($(compgen -W "$names" -- "$word"))
        return
    fi
    case "${{key#+}}" in
{cases}
    esac
    local own
    own=$(ls "conf/${{key#+}}" 2>/dev/null | sed -n 's/\\.yaml$//p')
    COMPREPLY=($(compgen -W "$names $own" -- "$value"))
}}
complete -o nospace -F _pfbench pfbench
"""


def print_completion(words: Sequence[str]) -> None:
    """Print the script of a shell."""
    shell = " ".join(words) or "none"
    require_choice("shell", shell, _SHELLS, "Use: pfbench completion bash")
    print(make_script(shell))


def make_script(shell: str) -> str:
    """Make the script of a shell."""
    groups = describe_choices(None)
    cases = [f'        {group}) names="{" ".join(describe_choices(group))}" ;;' for group in groups]
    keys = [f"{group}=" for group in groups if group != "experiment"]
    keys += ["+experiment=", "runs=", "seed=", "study=", "particles=", "-m", "--dry-run"]
    head = "autoload -U +X bashcompinit && bashcompinit\n" if shell == "zsh" else ""
    return _SCRIPT.format(
        head=head, words=" ".join(keys), commands=" ".join(list_commands()), cases="\n".join(cases)
    )


COMPLETION_COMMAND = Command(
    print_completion,
    """\
pfbench completion bash|zsh

Print the completion of commands, keys and names. It also completes the files of conf/ in the current folder.

  pfbench completion bash > ~/.local/share/bash-completion/completions/pfbench
  eval "$(pfbench completion zsh)"        in ~/.zshrc""",
)
