"""The C++ library: what it takes of torch, and its variants."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from pfbench.kernels import cpp_library, library_build

COMPILER = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
compiler = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler")


def compiles_beside_torch(declarations: str) -> subprocess.CompletedProcess[str]:
    """Check declarations of C functions against those of torch's headers."""
    assert COMPILER is not None
    headers = "#include <torch/csrc/stable/c/shim.h>\n"
    command = [COMPILER, "-std=c++17", "-fsyntax-only", "-x", "c++", "-"]
    command += [f"-I{Path(torch.__file__).parent / 'include'}"]
    return subprocess.run(
        command, input=headers + declarations, text=True, capture_output=True, check=False
    )


@compiler
def test_the_declarations_of_torchs_functions_are_those_of_its_headers() -> None:
    text = (library_build.FOLDER / "torch_interface.h").read_text()
    done = compiles_beside_torch(text.replace("#pragma once", ""))
    assert done.returncode == 0, done.stderr
    wrong = text.replace("aoti_torch_get_dim(AtenTensorHandle tensor, int64_t*", "aoti_torch_get_dim(AtenTensorHandle tensor, int32_t*")  # fmt: skip
    assert wrong != text
    assert "aoti_torch_get_dim" in compiles_beside_torch(wrong.replace("#pragma once", "")).stderr


def test_the_variant_follows_the_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    for capability, variant in {"DEFAULT": "baseline", "AVX2": "avx2", "AVX512": "avx2"}.items():
        monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda name=capability: name)
        assert cpp_library.choose_variant() == variant
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    assert cpp_library.choose_variant() == "baseline"


DRAW = """
import hashlib
import torch
from pfbench.kernels import dispatch as cpp
from pfbench.kernels.cpp_library import choose_variant

torch.set_num_threads(1)
key = torch.tensor(3), 99, torch.tensor(7), torch.arange(50), 15, 130
values = [cpp.philox_normals(*key), cpp.philox_normals_float64(*key), cpp.philox_uniforms(*key)]
weights = torch.softmax(values[1][0], 1)
uniforms = values[2][0, :, :1].clone()
values.append(cpp.resample_systematic(weights, torch.full((50, 1), 520.0), uniforms))
values.append(cpp.resample_systematic(weights.float(), torch.full((50, 1), 520.0), uniforms))
print(choose_variant(), *(hashlib.sha256(a.numpy().tobytes()).hexdigest() for a in values))
"""


@compiler
@pytest.mark.slow
def test_every_variant_draws_the_same_bits_and_chooses_the_same_ancestors() -> None:
    rows = {}
    for capability in ("default", "avx2"):
        environment = {**os.environ, "ATEN_CPU_CAPABILITY": capability, "OMP_NUM_THREADS": "1"}
        done = subprocess.run(
            [sys.executable, "-c", DRAW],
            env=environment,
            text=True,
            capture_output=True,
            check=True,
        )
        variant, *hashes = done.stdout.split()
        rows[variant] = hashes
    if len(rows) == 1:
        pytest.skip("the processor has one variant")
    assert rows["baseline"] == rows["avx2"]
    assert len(set(rows["avx2"])) > 3


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
