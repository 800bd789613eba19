"""Files that hold no class, a number that is not finite, or a circle: the message names key, value and remedy."""

from __future__ import annotations

from pathlib import Path

import pytest
from refusals import check_refused

from pfbench import job
from pfbench.results.store import compute_config_key

NOMINAL = "_target_: pfbench.noise.NominalNoise\n"
CLASS = "noise must be keys and values with the key _target_"
FORM = r"\S*/noise/mine\.yaml must be keys and values"
FILES = {
    "text": ("just a text", rf"{FORM}, got a scalar\. Write key: value .* pfbench list noise"),
    "list": ("[1, 2]", rf"{FORM}, got a sequence\. "),
    "empty": ("", rf"{FORM}, got an empty file\. "),
    "keys": ("sd: 1.0", rf"{CLASS}, got \{{'sd': 1\.0\}}\. "),
    "circle": (
        f"{NOMINAL}a: ${{noise.b}}\nb: ${{noise.a}}",
        r"noise\.a must not refer to itself, got \$\{noise\.b\}, .* Set noise\.a to a value",
    ),
    "parent": (
        f"{NOMINAL}a: [1, '${{noise.a}}']",
        r"noise\.a\[1\] must not refer to itself, got \$\{noise\.a\}",
    ),
    "nan": (f"{NOMINAL}steps: .nan", r"noise\.steps must be finite, got nan\. Set noise\.steps to"),
    "inf": (f"{NOMINAL}a: {{b: [0.0, -.inf]}}", r"noise\.a\.b\.1 must be finite, got -inf\. "),
}


@pytest.mark.parametrize("name", FILES)
def test_what_no_class_can_take_is_refused_by_its_key(tmp_path: Path, name: str) -> None:
    text, message = FILES[name]
    (tmp_path / "noise").mkdir()
    (tmp_path / "noise" / "mine.yaml").write_text(f"{text}\n")
    words = [f"hydra.searchpath=[file://{tmp_path}]", "scenario=linear_walk", "noise=mine"]
    check_refused([(f"^{message}", lambda: job.compose(words))], remedy=False)
    (tmp_path / "noise" / "mine.yaml").write_text(f"{NOMINAL}a: [1, 0.5, null]\nb: ${{noise.a}}\n")
    assert job.compose(words).values["noise"]["b"] == [1, 0.5, None]


def test_a_number_outside_the_groups_is_named_too() -> None:
    check_refused(
        [
            (
                r"^a\.1\.b must be finite, got nan\. Set a\.1\.b",
                lambda: compute_config_key({"a": [0.5, {"b": float("nan")}], "c": 1}),
            )
        ],
        remedy=False,
    )
