"""Networks of learned proposals, small and with random weights."""

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import nn

from pfbench.filter.learned.networks import (
    DiagonalNormalHead,
    NormalMixtureHead,
)

SMALL = (8,)

NETWORKS: dict[str, Callable[[int, int], nn.Module]] = {
    "diagonal": partial(DiagonalNormalHead, hidden=SMALL),
    "mixture": partial(NormalMixtureHead, hidden=SMALL),
}


def shaken(
    make: Callable[[int, int], nn.Module], size: float = 0.3
) -> Callable[[int, int], nn.Module]:
    """Return the network with random weights, which stand for any result of training."""

    def made(features: int, noise: int) -> nn.Module:
        network = make(features, noise)
        with torch.no_grad():
            for weight in network.parameters():
                weight.add_(size * torch.randn_like(weight) / math.sqrt(weight.shape[-1]))
        return network

    return made
