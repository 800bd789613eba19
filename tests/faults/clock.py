"""A clock that jumps: sweeps whose calendar and files are hours or years off, forwards and backwards."""

import os
import random
import time
from pathlib import Path
from typing import Any
from unittest import mock

from faults.children import run_child
from faults.sweeps import judge, new_home, run_sweep, undisturbed
from faults.tally import Tally

JUMPS = (0.0, 1e-3, 1.0, 3600.0, 86400.0, 3.2e7, 1e9)  # s


def attempt(seed: int, home: Path) -> list[Any]:
    """Run half of a sweep and all of it, both with a clock that jumps."""
    rng, real = random.Random(seed), time.time

    def jumping() -> float:
        return real() + rng.choice((-1.0, 1.0)) * rng.choice(JUMPS)

    with mock.patch("time.time", jumping):
        run_sweep(home, "filter=sir,ckf")
        for file in home.rglob("*"):
            date = max(0.0, jumping())
            os.utime(file, (date, date))
        said = run_sweep(home)
    return list(judge(home, said))


def run(count: int, seed: int) -> Tally:
    """Run `count` sweeps with a clock that jumps at each reading."""
    undisturbed()
    tally = Tally("clock that jumps")
    for number in range(count):
        with new_home() as home:
            ending = run_child(lambda: attempt(seed * 100_003 + number, home))  # noqa: B023
        value = ending.value if ending.state == "done" else ["crash", ending.state, ending.value]
        tally.add(*value)
    return tally
