"""Manifest of the operators: name, purpose, arguments and results of each, as `operators.toml` states them."""

from __future__ import annotations

import re
import tomllib
from functools import cache
from pathlib import Path
from typing import NamedTuple

KERNELS_FOLDER = Path(__file__).parent
_ARGUMENT = re.compile(r"(\w+): (\w+)(?: \[(.*)\])?(?: (below|to) (?:(\d+) )?([A-Z]|1))?")
_RESULT = re.compile(r"(real|float32|float64|int64|bool) \[(.*)\]")
_TERM = re.compile(r"(?:(\d+) )?(\w+)")
_KINDS = ("real", "number", "int64", "int")


class Limit(NamedTuple):
    """Largest value of an argument: `factor` times the size of `axis`, minus 1 for indices.

    Attributes:
        factor: Factor of the size.
        axis: Letter of an axis, or `1`.
        is_index: Whether the values are indices, which lie below the size.
    """

    factor: int
    axis: str
    is_index: bool

    @property
    def text(self) -> str:
        """The largest value in words, for instance `2 N - 1`."""
        size = self.axis if self.factor == 1 else f"{self.factor} {self.axis}"
        return f"{size} - 1" if self.is_index else size

    def largest(self, sizes: dict[str, int]) -> int:
        """Return the largest value for the sizes of a call by letter."""
        size = 1 if self.axis == "1" else sizes[self.axis]
        return self.factor * size - self.is_index


class Argument(NamedTuple):
    """An argument of an operator.

    Attributes:
        name: Name.
        kind: `real`, `number`, `int64`, or `int` for a plain integer.
        axes: Letter of each axis, in lower case where the size may also be 1.
        positive: Letters of the axes that must have an entry.
        limit: Range of the values from 0 on, or None.
        has_batch: Whether the first axis is any number of batch axes.
    """

    name: str
    kind: str
    axes: str
    positive: str = ""
    limit: Limit | None = None
    has_batch: bool = False

    @property
    def shape(self) -> str:
        """Shape in words, as in the manifest."""
        words = [f"{axis.upper()} or 1" if axis.islower() else axis for axis in self.axes]
        return f"[{', '.join(['...', *words[1:]] if self.has_batch else words)}]"


class OperatorResult(NamedTuple):
    """A result of an operator.

    Attributes:
        kind: Type, or `real` for that of the real arguments.
        axes: Size of each axis: sums of sizes with factors, as (factor, name) pairs.
    """

    kind: str
    axes: tuple[tuple[tuple[int, str], ...], ...]


class Operator(NamedTuple):
    """An operator of the kernels.

    Attributes:
        name: Name.
        summary: What it computes, one sentence.
        arguments: Its arguments, in order.
        results: Its results, in order.
        is_on_cpu: Whether it has a C++ function for the CPU.
        text: Arguments and results as they are written in the manifest.
    """

    name: str
    summary: str
    arguments: tuple[Argument, ...]
    results: tuple[OperatorResult, ...]
    is_on_cpu: bool
    text: tuple[str, ...]

    @property
    def schema(self) -> str:
        """Arguments and results as torch writes them, for instance `(Tensor x, SymInt n) -> Tensor`."""
        words = ("SymInt" if a.kind == "int" else "Tensor" for a in self.arguments)
        parameters = ", ".join(f"{w} {a.name}" for w, a in zip(words, self.arguments, strict=True))
        result_types = ", ".join(["Tensor"] * len(self.results))
        return (
            f"({parameters}) -> {result_types if len(self.results) == 1 else f'({result_types})'}"
        )


@cache
def read_operators() -> dict[str, Operator]:
    """Read all operators from operators.toml."""
    content = tomllib.loads((KERNELS_FOLDER / "operators.toml").read_text())
    return {
        name: Operator(
            name,
            entry["summary"],
            tuple(_parse_argument(name, text) for text in entry["arguments"]),
            tuple(_parse_result(name, text) for text in entry["results"]),
            entry.get("device") != "cuda",
            (*entry["arguments"], *entry["results"]),
        )
        for name, entry in content.items()
    }


def _parse_argument(operator: str, text: str) -> Argument:
    """Parse an argument such as `n: number [R|1, 1] to N`."""
    match = _ARGUMENT.fullmatch(text)
    if match is None or match[2] not in _KINDS:
        raise ValueError(f"{operator}: an argument must be 'name: kind [axes]', got {text!r}.")
    axes = [axis.strip() for axis in (match[3] or "").split(",") if axis.strip()]
    has_batch = axes[:1] == ["..."]
    axes = ["B", *axes[1:]] if has_batch else axes
    if not all(re.fullmatch(r"[A-Z](\|1|>0)?|1", axis) for axis in axes):
        raise ValueError(
            f"{operator}: axes must be letters, letters with |1 or >0, or 1, got {text!r}."
        )
    letters = "".join(a[0].lower() if "|" in a else a[0] for a in axes)
    positive = "".join(a[0] for a in axes if ">" in a)
    limit = Limit(int(match[5] or 1), match[6], match[4] == "below") if match[4] else None
    return Argument(match[1], match[2], letters, positive, limit, has_batch)


def _parse_result(operator: str, text: str) -> OperatorResult:
    """Parse a result such as `float32 [components, R, 4 quarters]`."""
    match = _RESULT.fullmatch(text)
    words = [axis.strip() for axis in match[2].split(",") if axis.strip()] if match else []
    words = ["B" if axis == "..." else axis for axis in words]
    terms = [[_TERM.fullmatch(term) for term in axis.split(" + ")] for axis in words]
    if match is None or any(term is None for axis in terms for term in axis):
        raise ValueError(f"{operator}: a result must be 'kind [axes]', got {text!r}.")
    axes = tuple(tuple((int(term[1] or 1), term[2]) for term in axis if term) for axis in terms)
    return OperatorResult(match[1], axes)
