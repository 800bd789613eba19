"""Command `pfbench completion`: print the completion of words for a shell."""

from __future__ import annotations

from collections.abc import Sequence

from pfbench.cli.command import Command, list_commands
from pfbench.cli.list import describe_choices
from pfbench.cli.messages import require_choice

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


COMMAND = Command(
    print_completion,
    """\
pfbench completion bash|zsh

Print the completion of commands, keys and names. It also completes the files of conf/ in the current folder.

  pfbench completion bash > ~/.local/share/bash-completion/completions/pfbench
  eval "$(pfbench completion zsh)"        in ~/.zshrc""",
)
