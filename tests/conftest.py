"""One thread for each test process, and less work for the garbage collector."""

import gc

import torch

torch.set_num_threads(1)  # with xdist, more threads than cores make everything slower


def pytest_collection_finish() -> None:
    """Modules and collected tests live until the end: without them a full collection is short."""
    gc.collect()
    gc.freeze()
