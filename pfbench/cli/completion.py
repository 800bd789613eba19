"""Command `pfbench completion`: completion of commands, keys and names for a shell."""

from __future__ import annotations

from collections.abc import Sequence

from pfbench.cli.list import describe_choices
from pfbench.core.parameter_checks import require

HELP = """\
pfbench completion bash|zsh

Print the completion of commands, keys and names. It also completes the files of conf/ in the current folder.

  pfbench completion bash > ~/.local/share/bash-completion/completions/pfbench
  eval "$(pfbench completion zsh)"        in ~/.zshrc"""

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
    shell = words[0] if words else ""
    require(
        len(words) == 1 and shell in _SHELLS,
        "shell",
        f"be one of {', '.join(_SHELLS)}",
        " ".join(words) or "none",
        "Use: pfbench completion bash",
    )
    print(make_script(shell))


def make_script(shell: str) -> str:
    """Make the script of a shell."""
    from pfbench.cli.main import COMMANDS

    groups = describe_choices(None)
    cases = [f'        {group}) names="{" ".join(describe_choices(group))}" ;;' for group in groups]
    keys = [f"{group}=" for group in groups if group != "experiment"]
    keys += ["+experiment=", "runs=", "seed=", "study=", "particles=", "-m", "--dry-run"]
    head = "autoload -U +X bashcompinit && bashcompinit\n" if shell == "zsh" else ""
    return _SCRIPT.format(
        head=head, words=" ".join(keys), commands=" ".join(COMMANDS), cases="\n".join(cases)
    )
