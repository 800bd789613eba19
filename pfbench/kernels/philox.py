"""The random number generator in torch operations: Philox4x32-10, uniform and normal numbers.

`src/generator.h` is the same in C++ and CUDA. Both draw the same bits: every operation rounds once, in
the same order. Roots are taken by numpy on the CPU, because those of torch are not rounded correctly
on every processor.

References:
    J. Salmon, M. Moraes, R. Dror and D. Shaw (2011), Parallel random numbers: as easy as 1, 2, 3.
    G. Box and M. Muller (1958), A note on the generation of random normal deviates.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor

_MULTIPLY = (0xD2511F53, 0xCD9E8D57)
_WEYL = (0x9E3779B9, 0xBB67AE85)
_WORD = 0xFFFFFFFF
_SIGN = 0x80000000
_BLOCK = 16384  # words whose temporaries fit the second-level cache: 7 instead of 19 ms for 750 000 normals

Words: TypeAlias = tuple[Tensor, Tensor, Tensor, Tensor]
Counter: TypeAlias = tuple[Tensor, int, Tensor, Tensor, int, int]
"""(seed [], purpose, step [], runs [R], components, quarters), see `draw_normals`."""


class Precision(NamedTuple):
    """Constants of the transform of Box and Muller in one floating-point type.

    Coefficients are of powers of the square, the highest first, as in generator.h.

    Attributes:
        dtype: Type of the numbers.
        integer: Integer type of the same size.
        fraction: Bits of the fraction.
        root_half: Bits of the root of 1/2.
        log: Coefficients of -2 log((1 + s) / (1 - s)) / s.
        sine: Coefficients of sin(pi t) / t.
        cosine: Coefficients of cos(pi t).
        log_four: log 4.
    """

    dtype: torch.dtype
    integer: torch.dtype
    fraction: int
    root_half: int
    log: tuple[float, ...]
    sine: tuple[float, ...]
    cosine: tuple[float, ...]
    log_four: float


def _from_hex(numbers: str) -> tuple[float, ...]:
    return tuple(map(float.fromhex, numbers.split()))


SINGLE = Precision(
    torch.float32,
    torch.int32,
    23,
    0x3F3504F3,
    (-0.5985158085823059, -0.7994958162307739, -1.333336353302002, -4.0),
    (
        0.07756039500236511, -0.5982421040534973, 2.550069808959961, -5.167709827423096,
        3.1415927410125732,
    ),
    (
        -0.024396715685725212, 0.23493756353855133, -1.3352121114730835, 4.058709144592285,
        -4.934802055358887, 1.0,
    ),
    1.3862943649291992,
)  # fmt: skip

DOUBLE = Precision(
    torch.float64,
    torch.int64,
    52,
    0x3FE6A09E667F3BCD,
    _from_hex(
        "-0x1.2f52a7e4021abp-2 -0x1.399939e94c893p-2 -0x1.74669ea53e8f9p-2 -0x1.c71c4fe53c39fp-2 "
        "-0x1.2492494537380p-1 -0x1.999999997abefp-1 -0x1.55555555555aep+0 -0x1p+2"
    ),
    _from_hex(
        "0x1.9d1b86f1b22d8p-21 -0x1.6f79770e35db1p-16 0x1.e8f35e9d59d7cp-12 -0x1.e3074ddd1d2c4p-8 "
        "0x1.50783485190b6p-4 -0x1.32d2cce627542p-1 0x1.466bc6775aa6ep+1 -0x1.4abbce625be52p+2 "
        "0x1.921fb54442d18p+1"
    ),
    _from_hex(
        "0x1.167972088fcdep-18 -0x1.b69582e2f780ap-14 0x1.f9d2548937763p-10 -0x1.a6d1efc969530p-6 "
        "0x1.e1f506813c9ebp-3 -0x1.55d3c7e3bfc44p+0 0x1.03c1f081b5993p+2 -0x1.3bd3cc9be45dbp+2 0x1p+0"
    ),
    float.fromhex("0x1.62e42fefa39efp+0"),
)


def philox(counter: Words, key: tuple[Tensor | int, Tensor | int], rounds: int = 10) -> Words:
    """Compute random words by Philox4x32.

    The results agree with the published known-answer vectors. A product of two 32-bit words wraps
    around in int64. The sign bits of the arithmetic shift and the high half of the other product
    are masked after the exclusive or.
    """
    c0, c1, c2, c3 = counter
    index = torch.arange(rounds, device=counter[0].device)
    keys = zip(
        *(((k + weyl * index) & _WORD).unbind(0) for k, weyl in zip(key, _WEYL, strict=True)),
        strict=True,
    )
    for k0, k1 in keys:
        p0, p1 = c0 * _MULTIPLY[0], c2 * _MULTIPLY[1]
        c0, c1, c2, c3 = ((p1 >> 32) ^ c1 ^ k0) & _WORD, p1, ((p0 >> 32) ^ c3 ^ k1) & _WORD, p0
    return c0, c1 & _WORD, c2, c3 & _WORD


def compute_normals(counter: Counter, precision: Precision) -> Tensor:
    """Compute standard normal numbers, [w, R, 4 q], in blocks of components that fit the cache."""
    seed, purpose, step, runs, components, quarters = counter
    size = max(1, _BLOCK // max(1, len(runs) * quarters))
    blocks = torch.arange(components, device=runs.device).split(size)
    return torch.cat(
        [_normals((seed, purpose), step, runs, block, quarters, precision) for block in blocks]
    )


def compute_uniforms(counter: Counter) -> Tensor:
    """Compute uniform numbers on (0, 1), odd multiples of 2^-53, float64 [w, R, 4 q]."""
    seed, purpose, step, runs, components, quarters = counter
    block = torch.arange(components, device=runs.device)
    high, low = (
        draw_words((seed, purpose), step, runs, block + offset, quarters) for offset in (0, _SIGN)
    )
    return torch.cat([_unit(*pair) for pair in zip(high, low, strict=True)], dim=-1)


def draw_words(
    key: tuple[Tensor, int], step: Tensor, runs: Tensor, component: Tensor, quarters: int
) -> Words:
    """Draw four random words for each component, run and quarter of the particles.

    Shapes: runs [R], component [w].
    """
    particle = torch.arange(quarters, device=runs.device)
    step, seed = step.to(runs.device), key[0].to(runs.device)
    counter = particle, component[:, None, None], step, runs[:, None]
    c0, c1, c2, c3 = (word.expand(len(component), len(runs), quarters) for word in counter)
    return philox((c0, c1, c2, c3), (seed, key[1]))


def _normals(
    key: tuple[Tensor, int],
    step: Tensor,
    runs: Tensor,
    component: Tensor,
    quarters: int,
    precision: Precision,
) -> Tensor:
    """Compute the normal numbers of some components, [w, R, 4 q]."""
    a, b, c, d = draw_words(key, step, runs, component, quarters)
    if precision is SINGLE:
        pairs = [
            ((x.float() + 0.5) * 2.0**-32, ((y ^ _SIGN) - _SIGN).float() * 2.0**-31)
            for x, y in ((a, b), (c, d))
        ]
    else:
        e, f, g, h = draw_words(key, step, runs, component + _SIGN, quarters)
        pairs = [
            (_unit(x, low_x), _unit(y ^ _SIGN, low_y) * 2.0 - 1.0)
            for x, y, low_x, low_y in ((a, b, e, f), (c, d, g, h))
        ]
    return torch.cat([z for u, v in pairs for z in transform_pair(u, v, precision)], dim=-1)


def transform_pair(u: Tensor, v: Tensor, precision: Precision) -> tuple[Tensor, Tensor]:
    """Transform uniform numbers to standard normal ones by Box and Muller.

    Returns two independent normal numbers for each pair.
    """
    bits = u.view(precision.integer)
    k = (precision.root_half + (1 << precision.fraction) - 1 - bits) >> precision.fraction
    m = (bits + (k << precision.fraction)).view(precision.dtype)  # u = m 2^-k
    s = (m - 1.0) / (m + 1.0)
    squared_radius = s * _polynomial(precision.log, s * s)
    squared_radius = squared_radius + k.to(precision.dtype) * precision.log_four
    radius = _root(squared_radius)
    t = v.abs() - 0.5
    z = t * t
    sine, cosine = t * _polynomial(precision.sine, z), _polynomial(precision.cosine, z)
    return radius * -sine, radius * torch.where(v < 0.0, -cosine, cosine)


def _unit(high: Tensor, low: Tensor) -> Tensor:
    """Return two words as an odd multiple of 2^-53 in (0, 1), exactly."""
    return (((high << 20) | (low >> 12)).double() + 0.5) * 2.0**-52


def _polynomial(coefficients: Sequence[float], z: Tensor) -> Tensor:
    """Evaluate a polynomial by Horner's rule."""
    value = coefficients[0] * z + coefficients[1]
    for coefficient in coefficients[2:]:
        value = value * z + coefficient
    return value


def _root(a: Tensor) -> Tensor:
    """Return the square root, rounded correctly."""
    return a.sqrt() if a.device.type != "cpu" else torch.from_numpy(np.sqrt(a.numpy()))
