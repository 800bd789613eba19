"""How many particles a cloud should have."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pfbench.filter.belief import Cloud


class Size(Protocol):
    """A cloud -> the number of particles wanted in each run, float [R, 1], at most the number of slots."""

    def first(self, slots: int) -> int:
        """The number to begin with, of so many slots."""

    def __call__(self, cloud: Cloud) -> Tensor: ...


@dataclass(frozen=True)
class Fixed:
    """All slots, always."""

    def first(self, slots: int) -> int:
        return slots

    def __call__(self, cloud: Cloud) -> Tensor:
        runs, slots = cloud.log_w.shape
        return torch.full((runs, 1), slots, dtype=torch.float64, device=cloud.log_w.device).to(cloud.log_w.dtype)
