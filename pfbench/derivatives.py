"""Exact derivatives of maps that take a state each, all of them in one pass: the axis of states holds the components."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import torch
from torch import Tensor
from torch.autograd import forward_ad

from pfbench.fusion import fused, recording

Map: TypeAlias = Callable[[Tensor], Tensor]
"""[R, P, d] -> [R, P, D], each of the P on its own."""
Subtract: TypeAlias = Callable[[Tensor, Tensor], Tensor]
"""How values of a map differ: [R, P, D], [R, 1, D] -> [R, P, k]."""


def slopes(f: Map, value: Tensor, d: int, subtract: Subtract = torch.subtract) -> Tensor:
    """Derivative [R, k, d] at 0 of how f differs from its `value` there [R, 1, D].

    Backward, unless somebody wants a gradient of it: forward torch works out a shape, at a third of a millisecond, for each
    operation between what has a tangent and what has none. Backward a branch that `torch.where` does not take can spoil a
    derivative (0 times infinity); then all are taken forward.
    """
    found = None
    if not (torch.is_grad_enabled() or value.is_cuda or recording()):
        found = _backward(f, value, d, subtract)
    return _forward(f, value, d, subtract) if found is None else found


def _backward(f: Map, value: Tensor, d: int, subtract: Subtract) -> Tensor | None:
    """As `slopes`; None where one is spoilt."""
    k = subtract(value, value).shape[-1]
    with torch.enable_grad(), fused(False):
        centre = value.new_zeros(len(value), k, d).requires_grad_()
        moved = subtract(f(centre), value)
        if not moved.requires_grad:  # the map does not depend on the state
            return torch.zeros_like(centre)
        (found,) = torch.autograd.grad(moved.diagonal(dim1=1, dim2=2).sum(), centre)
    spoilt = torch.isfinite(value).all(-1).squeeze(1) & ~torch.isfinite(found.sum((1, 2)))
    return None if bool(spoilt.any()) else found


def _forward(f: Map, value: Tensor, d: int, subtract: Subtract) -> Tensor:
    """As `slopes`; the axis of states holds the directions."""
    centre = value.new_zeros(len(value), d, d)
    directions = torch.eye(d, dtype=value.dtype, device=value.device).expand_as(centre).contiguous()
    with forward_ad.dual_level():  # torch.func.jvp costs three times as much, and seconds at the first call
        moved = subtract(f(forward_ad.make_dual(centre, directions)), value)
        still, found = forward_ad.unpack_dual(moved)
    return torch.zeros_like(still).mT if found is None else found.mT
