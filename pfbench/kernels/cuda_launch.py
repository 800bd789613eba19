"""Compilation of the kernels of particles.cu by torch's NVRTC, and their launch."""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

_SOURCES = Path(__file__).parent / "src"


def launch_kernel(
    name: str, grid: tuple[int, int, int], threads: int, *args: Tensor | int, shared: int = 0
) -> None:
    """Launch a kernel of particles.cu in the current stream of its first argument's device.

    Args:
        name: Name of the kernel, with its template arguments.
        grid: Blocks along each axis. Nothing is launched if one is 0.
        threads: Threads of a block.
        args: Arguments of the kernel; integers are 32 bits wide.
        shared: Bytes of shared memory of a block.

    Raises:
        RuntimeError: If the driver refuses the launch.
    """
    assert isinstance(args[0], Tensor)
    if 0 in grid:  # the driver rejects empty grids
        return None
    device = args[0].device
    if torch.cuda.current_device() != device.index:
        with torch.cuda.device(device):
            return launch_kernel(name, grid, threads, *args, shared=shared)
    function, driver = compile_kernel(name, device.index)
    values = [
        ctypes.c_void_p(a.data_ptr()) if isinstance(a, Tensor) else ctypes.c_int(a) for a in args
    ]
    pointers = (ctypes.c_void_p * len(values))(*map(ctypes.addressof, values))
    stream = ctypes.c_void_p(torch.cuda.current_stream().cuda_stream)
    code = driver.cuLaunchKernel(function, *grid, threads, 1, 1, shared, stream, pointers, None)
    if code:
        raise RuntimeError(f"{name} cannot run: the CUDA driver returned error {code}.")


@cache
def compile_kernel(name: str, device: int) -> tuple[Any, Any]:
    """Compile a kernel.

    Args:
        name: Name of the kernel, with its template arguments.
        device: Index of the CUDA device.

    Returns:
        The kernel, and the driver, which torch would open again at each call.
    """
    return torch.cuda._compile_kernel(read_source(), name).func, ctypes.CDLL("libcuda.so.1")


def read_source() -> str:
    """Return the source of the kernels as one text, with the generator that C++ uses, too."""
    generator = (_SOURCES / "generator.h").read_text().replace("#pragma once\n", "")
    text = (_SOURCES / "particles.cu").read_text()
    line = next(line for line in text.splitlines() if line.startswith('#include "generator.h"'))
    return text.replace(line, generator)
