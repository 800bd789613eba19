"""Large tensors lie in large pages, so that freed memory is used again."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

KERNEL = Path("/sys/kernel/mm/transparent_hugepage/enabled")
PROGRAM = """
import pfbench.kernels.dispatch
import torch
kept = [torch.ones(10**6) for _ in range(20)]
print(next(line.split()[1] for line in open("/proc/self/smaps_rollup") if "AnonHugePages" in line))
"""


def large_pages(**more: str) -> int:
    """KiB in large pages of a process with 80 MB of tensors."""
    env = {key: value for key, value in os.environ.items() if key != "THP_MEM_ALLOC_ENABLE"}
    words = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(words, env=env | more, check=True, capture_output=True, text=True)
    return int(done.stdout)


@pytest.mark.skipif(
    not KERNEL.exists() or "[madvise]" not in KERNEL.read_text(),
    reason="large pages are not chosen by programs here",
)
def test_large_tensors_lie_in_large_pages_unless_a_user_says_no() -> None:
    assert large_pages() > 20_000
    assert large_pages(THP_MEM_ALLOC_ENABLE="0") == 0
