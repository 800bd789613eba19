"""References of the methods, and their BibTeX entries."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path

from pfbench.report.journal.study_pack import Pack
from pfbench.report.provenance import format_bibtex
from pfbench.results.conditions import Condition

SELF = "pfbench"


def list_cited_keys(pack: Pack) -> list[str]:
    """List the keys of the references of all filters, in their order.

    Args:
        pack: Data of the report.
    """
    keys = dict.fromkeys(str(look.get("cite") or "") for look in pack["filters"])
    return [key for key in keys if key in _entries()]


def find_entries(keys: Iterable[str]) -> str:
    """Return the BibTeX entries of keys; keys without an entry are left out.

    Args:
        keys: Keys of references.
    """
    entries = _entries()
    return "\n".join(entries[key] for key in dict.fromkeys(keys) if key in entries)


def format_bibliography(pack: Pack, conditions: Sequence[Condition]) -> str:
    """Format the BibTeX file of a study: pfbench itself, then the references of its filters.

    Args:
        pack: Data of the report.
        conditions: Conditions of the study.
    """
    return f"{format_bibtex(conditions)}\n{find_entries(list_cited_keys(pack))}"


def renew_bibliography(pack: Pack) -> str:
    """Format the BibTeX file of stored data: its entry of pfbench, then the present references of the filters.

    Args:
        pack: Data of the report, with its BibTeX entries.
    """
    entry, end, _ = str(pack["bibtex"]).partition("\n}\n")
    return f"{entry}{end}\n{find_entries(list_cited_keys(pack))}"


def cite(keys: Sequence[str]) -> str:
    """Return the citation of keys, empty without one.

    Args:
        keys: Keys of references.
    """
    known_keys = [key for key in keys if key == SELF or key in _entries()]
    return rf"~\cite{{{','.join(known_keys)}}}" if known_keys else ""


@cache
def _entries() -> dict[str, str]:
    """Read the entries by key."""
    text = Path(__file__).with_name("methods.bib").read_text(encoding="utf-8")
    entries = re.findall(r"^@\w+\{(\w+),\n.*?^\}\n", text, re.MULTILINE | re.DOTALL)
    blocks = re.findall(r"^@\w+\{\w+,\n.*?^\}\n", text, re.MULTILINE | re.DOTALL)
    return dict(zip(entries, blocks, strict=True))
