"""Torch operations are the reference of the operators: tests ask for operators themselves."""

from collections.abc import Iterator

import pytest

from pfbench.kernels import dispatch


@pytest.fixture(autouse=True)
def torch_operations() -> Iterator[None]:
    """Run compilable functions in torch operations unless a test asks for operators."""
    with dispatch.use_kernels(False):
        yield
