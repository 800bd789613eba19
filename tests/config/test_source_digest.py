"""The code of a user's classes is part of a job's key: a changed default is another job."""

import importlib
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pfbench.job import compose, job_key, run
from pfbench.job.inputs import find_inputs
from pfbench.job.trust import hash_user_code
from pfbench.results.store import read_result

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


# --------------------------------------------------------------------------------------------------
# Values decide: of the same source another number is another job.

REACH = """
import os
from pathlib import Path
import numpy as np
import torch
import reachhelp
from pfbench.filter import Systematic

GLOBAL = 0.9
AT_IMPORT = float(Path("gain.txt").read_text())
VARIABLE = float(os.environ.get("REACH_AT_IMPORT", "0.9"))
ARRAY = np.array([0.9, 5.0])
TENSOR = torch.tensor([0.9, 5.0])
TABLE = {"gain": [0.9]}


class Settings:
    def __init__(self):
        self.gain = 0.9


SETTINGS = Settings()


def make(gain):
    return lambda: gain


CLOSED = make(0.9)


def with_default(gain=0.9):
    return gain


def with_keyword(*, gain=0.9):
    return gain


def with_attribute():
    return with_attribute.gain


with_attribute.gain = 0.9


class Shift:
    attribute = 0.9
    is_exact = False

    def __init__(self, way, when, file="declared.txt"):
        self.way, self.when, self.file = way, when, file

    def input_files(self):
        return [self.file]

    def gain(self):
        return {
            "global": lambda: GLOBAL, "import": lambda: AT_IMPORT, "variable": lambda: VARIABLE,
            "environment": lambda: float(os.environ.get("REACH_GAIN", "0.9")), "array": lambda: ARRAY[0],
            "tensor": lambda: float(TENSOR[0]), "table": lambda: TABLE["gain"][0], "object": lambda: SETTINGS.gain,
            "closure": CLOSED, "default": with_default, "keyword": with_keyword, "function": with_attribute,
            "class": lambda: self.attribute, "helper": lambda: reachhelp.GAIN, "inner helper": reachhelp.gain,
            "declared": lambda: float(Path(self.file).read_text()), "method": self.number,
        }[self.way]()

    def number(self):
        return 0.9

    def __call__(self, a, n, draws):
        ancestors = Systematic()(a, n, draws)
        acts = {"1": draws.step >= 1, "5": draws.step >= 5, "threshold": a[:, -1:].exp() > 0.01}[self.when]
        return torch.where(torch.as_tensor(acts), ancestors.roll(int(10 * self.gain()), -1), ancestors)
"""
REACH_FILES = {
    "reachlab.py": REACH,
    "reachhelp.py": "GAIN = 0.9\nINNER = {'gain': 0.9}\n\n\ndef gain():\n    return INNER['gain']\n",
    "gain.txt": "0.9",
    "declared.txt": "0.9",
}
# Python that changes the value; `start again` imports the modules anew, as another process does
CHANGES = {
    "global": "lab.GLOBAL = 0.2",
    "import": "Path('gain.txt').write_text('0.2'); start_again()",
    "variable": "os.environ['REACH_AT_IMPORT'] = '0.2'; start_again()",
    "environment": "os.environ['REACH_GAIN'] = '0.2'",
    "array": "lab.ARRAY[0] = 0.2",
    "tensor": "lab.TENSOR[0] = 0.2",
    "table": "lab.TABLE['gain'][0] = 0.2",
    "object": "lab.SETTINGS.gain = 0.2",
    "closure": "lab.CLOSED.__closure__[0].cell_contents = 0.2",
    "default": "lab.with_default.__defaults__ = (0.2,)",
    "keyword": "lab.with_keyword.__kwdefaults__['gain'] = 0.2",
    "function": "lab.with_attribute.gain = 0.2",
    "class": "lab.Shift.attribute = 0.2",
    "helper": "lab.reachhelp.GAIN = 0.2",
    "inner helper": "lab.reachhelp.INNER['gain'] = 0.2",
    "declared": "Path('declared.txt').write_text('0.2')",
    "method": "lab.Shift.number = lambda self: 0.2",
}
MOMENTS = ("1", "5", "threshold")


@pytest.fixture
def reach(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], Any]:
    """Write the modules, and return a function that imports them as a new process does."""
    for name, text in REACH_FILES.items():
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("REACH_GAIN", "REACH_AT_IMPORT"):
        monkeypatch.setenv(name, "0.9")

    def start_again() -> Any:
        for name in ("reachlab", "reachhelp"):
            sys.modules.pop(name, None)
        importlib.invalidate_caches()
        return importlib.import_module("reachlab")

    return start_again


def shift_words(way: str, when: str) -> list[str]:
    node = f"{{_target_:reachlab.Shift,way:{way},when:'{when}'}}"
    return [
        "scenario=linear_walk", "filter=sir", "filter.resampler.ess_threshold=1", f"++filter.resampler.scheme={node}",
        "trust=[reachlab]", "runs=2", "particles=30", "study=reach", "engine=kernels", "pcrb=false",
    ]  # fmt: skip


def keys_around(way: str, when: str, reach: Callable[[], Any]) -> tuple[str, str]:
    """Keys of a job before and after a change."""
    lab = reach()
    config = compose(shift_words(way, when))
    before = job_key(config.values, find_inputs(config.values, config.trusted))
    exec(CHANGES[way], {"lab": lab, "Path": Path, "os": os, "start_again": reach})
    return before, job_key(config.values, find_inputs(config.values, config.trusted))


@pytest.mark.parametrize("way", CHANGES)
def test_another_value_of_the_same_source_is_another_key(
    way: str, reach: Callable[[], Any]
) -> None:
    before, after = keys_around(way, "5", reach)
    assert before != after


def test_the_same_values_are_the_same_key_in_another_process(reach: Callable[[], Any]) -> None:
    """Hashes of texts differ between processes, and a second import may take its code from a stored file."""
    code = (
        "from pfbench.job import compose, job_key\nfrom pfbench.job.inputs import find_inputs\n"
        f"config = compose({shift_words('array', '5')!r})\nprint(job_key(config.values, find_inputs(config.values, config.trusted)))"
    )
    environment = {**os.environ, "PYTHONPATH": os.getcwd()}
    keys = {
        subprocess.run(
            [sys.executable, "-c", code],
            env={**environment, "PYTHONHASHSEED": seed}, capture_output=True, text=True, check=True,
        ).stdout
        for seed in ("1", "2")
    }  # fmt: skip
    assert len(keys) == 1
    assert len(keys.pop().strip()) == 16


@pytest.mark.parametrize("when", MOMENTS)
@pytest.mark.parametrize("way", CHANGES)
def test_no_result_is_stale_whatever_changes_and_whenever_it_acts(
    way: str, when: str, reach: Callable[[], Any]
) -> None:
    """The second job is computed, and gives what a new folder gives."""
    lab = reach()
    words = [*shift_words(way, when), "results_dir=results"]
    first = run(compose(words))
    assert run(compose(words)).status == "skipped"
    exec(CHANGES[way], {"lab": lab, "Path": Path, "os": os, "start_again": reach})
    second, other = run(compose(words)), run(compose([*words[:-1], "results_dir=new"]))
    assert second.status == "finished"
    numbers = [read_result(path).data["error"] for path in (first.path, second.path, other.path)]
    assert np.array_equal(numbers[1], numbers[2])
    assert not np.array_equal(numbers[0], numbers[1])  # the change acts


def test_a_value_that_cannot_be_described_is_refused(reach: Callable[[], Any]) -> None:
    lab = reach()
    lab.GLOBAL = (x for x in range(3))
    config = compose(shift_words("global", "5"))
    with pytest.raises(
        ValueError, match=r"reachlab.Shift must reach values .* .cannot pickle 'generator'"
    ):
        find_inputs(config.values, config.trusted)
