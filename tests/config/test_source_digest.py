"""The code of a user's classes is part of a job's key: a changed default is another job."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

from pfbench.job import job_key
from pfbench.job.trust import hash_user_code

FILES = {
    "codelab/__init__.py": "",
    "codelab/walks.py": (
        "from codelab.constants import SCALE\n\n\nclass Walk:\n"
        "    def __init__(self, noise=0.3):\n        self.noise = noise * SCALE\n"
    ),
    "codehelpers.py": "OFFSET = 0\n",
    "codelab/constants.py": "import json, codehelpers\nfrom . import units\nSCALE = 2.0 * units.METRE\n",
    "codelab/units.py": "METRE = 1.0\n",
    "codelab/plots.py": "COLOUR = 'red'\n",
}
CONFIG = {"model": {"_target_": "codelab.walks.Walk"}, "filter": {}, "seed": 1}


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "codelab").mkdir()
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in [name for name in sys.modules if name.startswith(("codelab", "codehelpers"))]:
        monkeypatch.delitem(sys.modules, name)
    importlib.invalidate_caches()
    return tmp_path


@pytest.mark.parametrize(
    ("file", "old", "new", "is_same"),
    [
        ("codelab/walks.py", "noise=0.3", "noise=0.4", False),  # a default of the class
        ("codelab/constants.py", "2.0", "3.0", False),  # a module that it imports
        ("codelab/units.py", "1.0", "1.5", False),  # one that this module imports
        ("codelab/__init__.py", "", "x = 1\n", False),
        ("codelab/plots.py", "red", "blue", True),  # one that the class does not need
        ("codehelpers.py", "0", "0.5", False),  # one beside the package
    ],
)
def test_the_key_follows_the_source_that_a_class_needs(
    lab: Path, file: str, old: str, new: str, is_same: bool
) -> None:
    before = job_key(CONFIG)
    assert job_key(CONFIG) == before
    (lab / file).write_text(FILES[file].replace(old, new, 1))
    assert (job_key(CONFIG) == before) == is_same


def test_a_configuration_of_pfbench_alone_keeps_its_key(lab: Path) -> None:
    own = {"model": {"_target_": "pfbench.model.LinearGaussian"}, "filter": {"x": [1.0]}}
    assert hash_user_code(own) == {}
    assert hash_user_code({"filter": [own, {"a": CONFIG["model"]}]}) != {}
    assert hash_user_code({"a": {"_target_": "torch.nn.Linear"}}) == {}
