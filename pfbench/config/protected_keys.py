"""Check of a composed configuration: what only the command line may set is as the command line sets it.

`pfbench.config.file_rules` checks each file. Here the result is compared with a composition of the
same words without any file of a search path, whatever way a file may have found.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from pfbench.config.file_rules import launchers
from pfbench.config.trust import UntrustedConfigError, check_study

FOLDER_KEYS = ("results_dir", "reports_dir", "episode_cache_dir")
_SETTINGS = (*FOLDER_KEYS, "trust", "overwrite", "memory_limit_gib")
_DATA = ("data", "checkpoint")  # a folder of the user's own may name them
# parts of the node `hydra` that differ between jobs and lead to nothing
_OF_A_JOB = ("overrides", "runtime", "searchpath")
_OF_A_NAME = ("name", "override_dirname", "config_name", "num", "id")


def check_composed(
    tree: Any, words: Sequence[str], compose_reference: Callable[[list[str]], Any] | None
) -> None:
    """Check a composed configuration.

    Args:
        tree: Composed configuration with its node `hydra`, not resolved.
        words: Overrides of its composition.
        compose_reference: Composes overrides without files of a search path. None if the words name
            no search path, so that all files are those of pfbench.

    Raises:
        UntrustedConfigError: If the study or a choice has an invalid name, or a file set what only
            the command line may set.
    """
    check_study(tree._get_node("study")._value() if "study" in tree else None)  # not resolved
    for group, name in tree.hydra.runtime.choices.items():
        if isinstance(name, str) and (name.startswith("/") or ".." in name.split("/")):
            raise UntrustedConfigError(
                f"{group} must be the name of a file in its group, got {name!r}. Use its name."
            )
    if compose_reference is None:
        return
    launcher = tree.hydra.runtime.choices.get("hydra/launcher")
    is_shipped = launcher in launchers()  # another one is of a folder of the user's own
    pattern = r"[+~]*hydra/launcher" if is_shipped else r"[+~]*hydra[/.]launcher"
    others = [word for word in _list_setting_words(words) if not re.match(pattern, word)]
    reference = compose_reference(
        [*others, f"hydra/launcher={launcher if is_shipped else 'basic'}"]
    )
    for (key, value), (_, expected) in zip(
        _list_settings(tree, words), _list_settings(reference, words), strict=True
    ):
        if value != expected and (is_shipped or key != "hydra.launcher"):
            raise UntrustedConfigError(
                f"{key} must be set on the command line, got {value!r:.200} from a file. "
                f"Remove the key from the file, and add {key}=... to the command."
            )


def _list_setting_words(words: Sequence[str]) -> list[str]:
    """Return the words that set what is compared, without the search path."""
    keys = "|".join((*_SETTINGS, *_DATA, "hydra"))
    return [
        word
        for word in words
        if re.match(rf"[+~]*({keys})\b", word) and not re.match(r"[+~]*hydra\.searchpath\b", word)
    ]


def _list_settings(tree: Any, words: Sequence[str]) -> Iterator[tuple[str, Any]]:
    """Yield key and value of each setting that is compared."""
    values = to_plain(tree)
    is_own = any("own://" in word or "pkg://" in word for word in words)
    for key in (*_SETTINGS, *(() if is_own else _DATA)):
        yield key, values.get(key)
    hydra = {key: value for key, value in values["hydra"].items() if key not in _OF_A_JOB}
    hydra["job"] = {k: v for k, v in hydra["job"].items() if k not in _OF_A_NAME}
    hydra["sweeper"] = {k: v for k, v in (hydra["sweeper"] or {}).items() if k != "params"}
    for key, value in sorted(hydra.items()):
        yield f"hydra.{key}", value


def to_plain(tree: Any) -> dict[str, Any]:
    """Return an unresolved configuration as plain dictionaries and lists."""
    from omegaconf import OmegaConf

    content = OmegaConf.to_container(tree, resolve=False)
    assert isinstance(content, dict)
    return {str(key): value for key, value in content.items()}
