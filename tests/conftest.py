"""Compiled modules are kept, results of a user are not seen, one thread for each test process, and less work for the garbage collector."""

import gc
import os
import sys

# Packages are installed without compiled modules. Else each process that a test starts compiles them again: seconds.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# torch's compiler starts processes for kernels of a GPU, tries each set of vector instructions of the processor, and compiles
# all headers in advance, which takes longer than the few kernels of the tests save.
os.environ |= {"TORCHINDUCTOR_COMPILE_THREADS": "1", "TORCHINDUCTOR_VEC_ISA_OK": "1"}
os.environ["TORCHINDUCTOR_CPP_CACHE_PRECOMPILE_HEADERS"] = "0"

import checkout  # noqa: E402
import composed_once  # noqa: E402
import nightly  # noqa: E402
import pytest  # noqa: E402
import torch  # noqa: E402
from hypothesis import HealthCheck, settings  # noqa: E402

settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")  # a machine with other work is no fault of a test
composed_once.install()
sys.addaudithook(checkout.refuse_own_files)
torch.set_num_threads(1)  # with xdist, more threads than cores make everything slower


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of tests/nightly.txt, before `-m` selects."""
    nightly.mark(items)


def pytest_collection_finish() -> None:
    """Modules and collected tests live until the end: without them a full collection is short."""
    gc.collect()
    gc.freeze()
    gc.get_freeze_count = lambda: 1  # else each command that a test runs counts all of them
