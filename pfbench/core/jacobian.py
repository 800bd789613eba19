"""Exact derivatives of maps of single states, in one pass: the particle axis holds components."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import torch
from torch import Tensor
from torch.autograd import forward_ad

from pfbench.kernels.compilation import is_capturing, use_compiled

Map: TypeAlias = Callable[[Tensor], Tensor]
"""A map [R, P, d] -> [R, P, D] of each of the P values alone."""
Subtract: TypeAlias = Callable[[Tensor, Tensor], Tensor]
"""The difference of values of a map: [R, P, D], [R, 1, D] -> [R, P, k]."""


def jacobian(f: Map, value: Tensor, d: int, subtract: Subtract = torch.subtract) -> Tensor:
    """Compute the derivative of a map at zero.

    Backward mode is used unless a gradient of the result is required, which the value at zero
    shows. In forward mode torch computes a shape for each operation between values with and without
    a tangent, which costs a third of a millisecond. In backward mode the branch that `torch.where`
    does not select can spoil a derivative (0 times infinity). The derivative is then computed
    forward.

    Args:
        f: The map.
        value: Its value at zero, [R, 1, D].
        d: Dimension of its argument.
        subtract: Difference of two values; it wraps angles.

    Returns:
        Derivative, [R, k, d].
    """
    derivative = None
    if not (value.requires_grad or value.is_cuda or is_capturing()):
        derivative = _backward(f, value, d, subtract)
    return _forward(f, value, d, subtract) if derivative is None else derivative


def _backward(f: Map, value: Tensor, d: int, subtract: Subtract) -> Tensor | None:
    """Compute `slopes` in backward mode; None if a derivative is spoilt."""
    k = subtract(value, value).shape[-1]
    with torch.enable_grad(), use_compiled(False):
        centre = value.new_zeros(len(value), k, d).requires_grad_()
        difference = subtract(f(centre), value)
        if not difference.requires_grad:  # the map does not depend on its argument
            return torch.zeros_like(centre)
        total = difference.diagonal(dim1=1, dim2=2).sum()
        (derivative,) = torch.autograd.grad(total, centre)
    finite_mask = torch.isfinite(value).all(-1).squeeze(1)
    spoilt = finite_mask & ~torch.isfinite(derivative.sum((1, 2)))
    return None if bool(spoilt.any()) else derivative


def _forward(f: Map, value: Tensor, d: int, subtract: Subtract) -> Tensor:
    """Compute `slopes` in forward mode; the particle axis holds the directions."""
    centre = value.new_zeros(len(value), d, d)
    eye = torch.eye(d, dtype=value.dtype, device=value.device)
    directions = eye.expand_as(centre).contiguous()
    with forward_ad.dual_level():  # torch.func.jvp costs three times as much
        difference = subtract(f(forward_ad.make_dual(centre, directions)), value)
        primal, tangent = forward_ad.unpack_dual(difference)
    return torch.zeros_like(primal).mT if tangent is None else tangent.mT
