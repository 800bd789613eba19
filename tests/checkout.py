"""Folders of the checkout, and a guard: tests see the published reports, never results and reports of a user's own."""

import os
import re
from pathlib import Path
from typing import Any

TESTS = Path(__file__).resolve().parent
ROOT = TESTS.parent
PUBLISHED_FILE = re.compile(
    r"reports/(README\.md|published\.json|\w+/((report|worlds)\.md|(heat_map|heat_map_at_home|matrices)\.svg|verdicts\.json(\.gz)?|words\.json|values\.json\.gz|runs\.parquet|figures/paper_\w+\.svg|results\.json\.gz"
    r"|headline\.(png|svg)))"
)
_EVENTS = ("open", "os.listdir", "os.scandir")
_OWN = (f"{ROOT}/reports", f"{ROOT}/results")  # `make demo` and users write there
_LISTED = re.findall(r"\]\((\w+)/report\.md\)", (ROOT / "reports" / "README.md").read_text())


def list_published() -> list[Path]:
    """Folders of the published reports: those that the list of reports links to."""
    return [ROOT / "reports" / name for name in dict.fromkeys(_LISTED)]


def refuse_own_files(event: str, arguments: tuple[Any, ...]) -> None:
    """Raise if a test opens or lists what `make demo` or a user may have left in the checkout.

    An audit hook, see conftest.py: a test that passes in a fresh clone only is found there, not in a clone in use.
    """
    if event not in _EVENTS or not isinstance(arguments[0], str | os.PathLike):
        return
    if event == "open" and arguments[1] is None and not os.path.isabs(arguments[0]):
        return  # os.open may name a file relative to an open folder, as shutil.rmtree does
    path = os.path.abspath(arguments[0])
    if not path.startswith(_OWN):
        return
    name = os.path.relpath(path, ROOT)
    top, _, below = name.partition("/")
    is_published = PUBLISHED_FILE.fullmatch(name) and below.split("/")[0] in (
        *_LISTED,
        "README.md",
        "published.json",
    )
    if top in ("reports", "results") and not (event == "open" and is_published):
        raise AssertionError(f"a test must not read {name}, which a clone in use may have")
