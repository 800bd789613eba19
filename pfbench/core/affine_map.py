"""Affine maps of particles with sparse matrices."""

from __future__ import annotations

import torch
from torch import Tensor

from pfbench.kernels import cpp
from pfbench.kernels.compilation import compilable


def affine_map(phi: Tensor, x: Tensor, gain: Tensor, w: Tensor) -> Tensor:
    """Compute phi x + gain w.

    The compiled version skips zero coefficients, which most are in error models of an INS.

    Args:
        phi: Transition matrix, [R or 1, D, D].
        x: States, [R, N, D].
        gain: Noise gain, [R or 1, D, W].
        w: Noise, [R, N, W].

    Returns:
        States, [R, N, D].
    """
    return _affine(phi, x, gain, w).permute(1, 2, 0)


def _dense_affine(phi: Tensor, x: Tensor, gain: Tensor, w: Tensor) -> Tensor:
    runs = x.shape[0]
    if len(phi) == len(gain) == 1:  # the same for all runs: one product, components first in memory
        shifted = gain[0] @ w.permute(2, 0, 1).flatten(1)
        return shifted.addmm_(phi[0], x.permute(2, 0, 1).flatten(1)).unflatten(1, x.shape[:2])
    noise = gain.expand(runs, -1, -1) @ w.mT
    return torch.baddbmm(noise, phi.expand(runs, -1, -1), x.mT).transpose(0, 1)


_affine = compilable(_dense_affine, operator=cpp.propagate_affine)
