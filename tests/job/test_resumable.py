"""What is finished is kept, and told again as it was."""

import math
from pathlib import Path

import pytest
import torch
from pfbench.experiments.study_parts import ResumableResults

from pfbench.files.escapes import (
    WIDTH,
    markdown_bullets,
    markdown_head,
    markdown_paragraph,
    markdown_row,
)
from pfbench.ppl.parameter_posterior import ParameterPosterior


def never() -> None:
    raise AssertionError("made twice")


def test_what_is_done_is_not_done_again(tmp_path: Path) -> None:
    path = tmp_path / "new" / "told.json"
    first = ResumableResults(path, {"draws": 3, "wide": (1.0, 2.0)})
    assert first("a", lambda: [0.1, 1e-300]) == [0.1, 1e-300]
    with pytest.raises(KeyboardInterrupt):
        first("b", lambda: (_ for _ in ()).throw(KeyboardInterrupt))
    again = ResumableResults(path, {"draws": 3, "wide": (1.0, 2.0)})
    assert again("a", never) == [0.1, 1e-300]
    assert again("b", lambda: 2) == 2
    assert [file.name for file in path.parent.iterdir()] == ["told.json"]


def test_another_call_and_half_a_file_begin_anew(tmp_path: Path) -> None:
    path = tmp_path / "told.json"
    ResumableResults(path, {"draws": 3})("a", lambda: 1)
    assert ResumableResults(path, {"draws": 4})("a", lambda: 2) == 2
    path.write_text(path.read_text()[:-3])
    assert ResumableResults(path, {"draws": 4})("a", lambda: 3) == 3


def test_a_posterior_is_heard_as_it_was_told(tmp_path: Path) -> None:
    draws = {
        "a": torch.randn(2, 5, dtype=torch.float64),
        "b": torch.rand(2, 5, dtype=torch.float64) / 3.0,
    }
    for accepted in (torch.tensor([0.1, 1 / 3], dtype=torch.float64), None):
        posterior = ParameterPosterior(draws, accepted, "made")
        pieces = ResumableResults(tmp_path / "told.json", {"accepted": accepted is not None})
        pieces("posterior", posterior.to_dict)
        heard = ParameterPosterior.from_dict(
            ResumableResults(pieces.path, pieces.state["request"])("posterior", never)
        )
        for name, a in draws.items():
            assert torch.equal(heard.draws[name], a)
        assert heard.method == "made"
        assert (heard.accepted is None) == (accepted is None)
        assert accepted is None or torch.equal(heard.accepted, accepted)


def test_prose_fits_an_editor_and_tables_have_a_head() -> None:
    text = "a word-with-hyphens " * 40
    lines = [*markdown_paragraph(text), *markdown_bullets(text, "short")]
    assert max(map(len, lines)) <= WIDTH
    assert " ".join(markdown_paragraph(text)).split() == text.split()
    assert lines[-2:] == ["- short", ""]
    assert [*markdown_head("a", "b"), markdown_row(1, math.pi)] == [
        "| a | b |",
        "| --- | --- |",
        f"| 1 | {math.pi} |",
    ]
