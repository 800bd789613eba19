"""One thread for each test process, and less work for the garbage collector."""

import gc

import torch
from hypothesis import HealthCheck, settings

settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")  # a machine with other work is no fault of a test
torch.set_num_threads(1)  # with xdist, more threads than cores make everything slower


def pytest_collection_finish() -> None:
    """Modules and collected tests live until the end: without them a full collection is short."""
    gc.collect()
    gc.freeze()
