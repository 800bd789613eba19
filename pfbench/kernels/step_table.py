"""Table of compiled steps: C++ code holds the addresses, and Python the numbers of the steps.

A step checks nothing itself. `run_steps` compares type, shape and strides of each argument with those that
the step was compiled for.
"""

from __future__ import annotations

import os
from pathlib import Path

import torch
from torch import Tensor

from pfbench.kernels.cpp_library import load_library
from pfbench.kernels.private_folder import find_compiled_code

_operators = torch.library.Library("pfbench", "FRAGMENT")


def run_steps(
    step: int,
    constants: list[Tensor],
    state: list[Tensor],
    inputs: list[Tensor],
    shared: list[Tensor],
) -> list[Tensor]:
    """Run a compiled step T times.

    Args:
        step: Number of the compiled step from `register_step`.
        constants: First arguments of each step.
        state: Next arguments of the first step. Later steps take the first outputs of the last one.
        inputs: Inputs of all steps, [T, ...]. Each step takes one row.
        shared: Last arguments of each step.

    Returns:
        The outputs of each step, in order, as views [R, N, ...] of [..., R, N].
    """
    load_library()
    results: list[Tensor] = torch.ops.pfbench.run_steps.default(
        step, constants, state, inputs, shared
    )
    return results


def register_step(library: Tensor, outputs: int, arguments: list[Tensor]) -> int:
    """Load a compiled step, so that `run_steps` can call it and check its arguments.

    The address of the step stays in C++: Python holds a number of a table.

    Args:
        library: Path of the library that torch's compiler wrote for the step, as bytes, uint8 [n].
        outputs: Number of tensors that a step returns.
        arguments: Arguments of one step with the types, shapes and strides that it was compiled for.

    Returns:
        Number of the step.

    Raises:
        PermissionError: If others can write the library, see `find_compiled_code`.
        RuntimeError: If the library is not a step of torch's compiler.
    """
    load_library()
    name = os.fsdecode(bytes(library.tolist())) if _is_path(library) else ""
    if name:  # the operator refuses all else
        try:
            library = encode_path(find_compiled_code(Path(name)))
        except PermissionError:
            raise
        except OSError as error:  # missing, or no possible name of a file
            raise RuntimeError(
                f"register_step: library must be a step of torch's compiler, got {name[:200]!r}."
            ) from error
    return int(torch.ops.pfbench.register_step.default(library, outputs, arguments))


def encode_path(path: str | Path) -> Tensor:
    """Return a path as bytes, uint8 [n], as an operator takes it.

    Args:
        path: Path of a file.
    """
    return torch.tensor(list(os.fsencode(path)), dtype=torch.uint8)


def _is_path(a: Tensor) -> bool:
    """Return whether a tensor can be a path as bytes."""
    return a.dtype == torch.uint8 and a.dim() == 1 and 0 not in a


for _kernel in (run_steps, register_step):
    _operators.define(_kernel.__name__ + torch.library.infer_schema(_kernel, mutates_args=()))
