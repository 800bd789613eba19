"""Literal forms of methods whose equations are missing in print: they refuse to run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NoReturn

from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import Filter
from pfbench.model.base import StateSpaceModel


@dataclass(frozen=True)
class UnprintedFilter(Filter):
    """Form that repairs and completes nothing, of a method that cannot be computed from its paper.

    Attributes:
        name: Name of the form, `filter=NAME`.
        missing: What the paper does not state, with the place.
        instead: Name of the form that is completed.

    Raises:
        ValueError: At the start, with what is missing and the form to choose.
    """

    name: str
    missing: str
    instead: str
    is_exact = False

    @override
    def init(
        self,
        model: StateSpaceModel,
        runs: int,
        draws: RandomStream,
        start: Tensor | None = None,
        spread: Tensor | None = None,
    ) -> NoReturn:
        """Refuse to start."""
        raise ValueError(
            f"filter={self.name} must have equations to run, and the paper does not state {self.missing}. "
            f"Choose filter={self.instead}, which completes them."
        )

    @override
    def step(
        self, model: StateSpaceModel, belief: Any, record: Record, draws: RandomStream
    ) -> NoReturn:
        """Refuse to continue."""
        self.init(model, len(record.y), draws)
