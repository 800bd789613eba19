"""Random numbers of R: its Mersenne Twister with normal numbers by inversion, so that data that R packages draw are made again."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri

_WORDS, _SCALE, _BIG = 624, 2.3283064365386963e-10, 134217728


class RNumbers:
    """The numbers after `set.seed(seed)` of R 3.6 and later, in the order in which R draws them."""

    def __init__(self, seed: int) -> None:
        state = [seed]
        for _ in range(50 + _WORDS + 1):
            state.append((69069 * state[-1] + 1) % 2**32)
        self.words = np.random.RandomState()
        self.words.set_state(("MT19937", np.array(state[-_WORDS:], dtype=np.uint32), _WORDS))

    def uniform(self) -> float:
        """Draw `runif(1)`."""
        word = int(self.words.randint(0, 2**32, dtype=np.uint32))
        return min(max(word * _SCALE, _SCALE / 2), 1.0 - _SCALE / 2)

    def normal(self, mean: float = 0.0, sd: float = 1.0) -> float:
        """Draw `rnorm(1, mean, sd)`."""
        return mean + sd * float(ndtri((int(_BIG * self.uniform()) + self.uniform()) / _BIG))

    def normals(self, count: int, sd: float = 1.0) -> list[float]:
        """Draw `rnorm(count, 0, sd)`."""
        return [self.normal(0.0, sd) for _ in range(count)]
