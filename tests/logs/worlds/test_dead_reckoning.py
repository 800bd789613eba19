"""Windows of dead reckoning: the same as `preintegrate`, with memory that a gap of the reference does not multiply."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic_log import tables, write

from pfbench.logs.worlds.dead_reckoning import integrate_windows
from pfbench.logs.worlds.log_tables import ImuLog
from pfbench.logs.worlds.time_grid import split_samples
from pfbench.nav.strapdown import preintegrate


@pytest.mark.parametrize("seed", range(8))
def test_joined_pairs_are_the_product_in_the_order_of_time(seed: int) -> None:
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.002, 0.02, 400))
    imu = ImuLog(time, rng.normal(size=(400, 3)) * 10, rng.normal(size=(400, 3)) * 3)
    # borders on samples, between them, many in one interval, and one long window
    borders = np.sort(np.concatenate([rng.uniform(time[0], time[-1], 40), time[[0, 60, 61, -1]]]))
    borders = borders[(borders < time[80]) | (borders > time[300])]
    force, rate, spans = (torch.from_numpy(a) for a in split_samples(imu, borders))
    expected = preintegrate(force, rate, spans, spans.new_zeros(len(spans), 6))
    rotation, velocity = integrate_windows(imu, borders)
    sign = (rotation * expected[0]).sum(-1, keepdim=True).sign()
    assert torch.allclose(sign * rotation, expected[0], atol=1e-12)
    assert torch.allclose(velocity, expected[1], atol=1e-11)


READ = """
import resource, sys
from pathlib import Path
from pfbench.scenario import read_log
read_log(sys.argv[1])
status = Path("/proc/self/status")
if status.is_file():  # Linux counts the memory of the parent before exec in ru_maxrss
    print(next(line.split()[1] for line in status.read_text().splitlines() if "VmHWM" in line))
else:
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


def test_a_gap_of_the_reference_costs_no_memory(tmp_path: Path) -> None:
    """30 s of a 90 s log at 100 Hz, with a reference at every sample but for one gap: 3 GiB if rows were padded."""
    log = tables(90.0)
    whole = tables(90.0)["imu"]["t"]
    reference = log["reference"].set_index("t")
    index = reference.index.union(whole)
    dense = reference.reindex(index).interpolate("index").loc[whole].reset_index(names="t")
    log["reference"] = dense[(dense["t"] < 30.0) | (dense["t"] > 60.0)]
    write(tmp_path, log)
    command = [sys.executable, "-c", READ, str(tmp_path)]
    peak = int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    unit = 2**20 if sys.platform == "linux" else 2**30
    assert peak / unit < 1.0  # GiB
