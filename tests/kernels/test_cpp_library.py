"""The C++ library: what it takes of torch, and its variants."""

import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from pfbench import job
from pfbench.kernels import cpp_library, cpp_library as private_folder, library_build
from pfbench.scenario.simulated import load_or_build

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


LOAD = """
from pathlib import Path
import torch
from pfbench.kernels import cpp_library, dispatch as cpp
cpp_library._WITH_PACKAGE = Path("no library came with the package")
try:
    cpp.sum_and_squares(torch.rand(1, 2))
    print("loaded")
except OSError as error:
    print("refused", error)
"""


def test_a_folder_that_others_can_write_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = private_folder.code_folder()
    assert (folder, folder.stat().st_mode & 0o777) == (tmp_path / "pfbench", 0o700)
    for mode in (0o770, 0o707, 0o777, 0o720):
        folder.chmod(mode)
        with pytest.raises(PermissionError, match="others cannot write"):
            private_folder.code_folder()
    folder.rmdir()
    (tmp_path / "elsewhere").mkdir()
    folder.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(PermissionError, match="Remove it"):
        private_folder.code_folder()


def test_a_folder_of_another_user_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    private_folder.code_folder()
    monkeypatch.setattr(os, "getuid", lambda: 12345)
    with pytest.raises(PermissionError, match="of this user"):
        private_folder.code_folder()


def test_no_episode_comes_from_the_current_folder_or_from_another_version(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who gives a folder away could give false episodes with it."""
    monkeypatch.setattr(os, "environ", {"XDG_CACHE_HOME": str(tmp_path)})
    assert job.compose(["scenario=growth"]).values["episode_cache_dir"] == f"{tmp_path}/pfbench/worlds"  # fmt: skip
    for version in ("1.0", "1.1", "1.1"):
        monkeypatch.setattr("pfbench.__version__", version)
        load_or_build(tmp_path, "flight", dict)
    assert len(list(tmp_path.glob("*.npz"))) == 2


@pytest.mark.slow
def test_a_library_that_others_can_write_is_not_loaded(tmp_path: Path) -> None:
    def load() -> str:
        environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
        command = [sys.executable, "-c", LOAD]
        done = subprocess.run(
            command, capture_output=True, text=True, env=environment, check=True, timeout=600
        )
        return done.stdout

    name = library_build.name_library(cpp_library.choose_variant())
    cpp_library.load_library()  # compiles it if it does not exist
    folders = (cpp_library._WITH_PACKAGE, private_folder.code_folder())
    built = next(folder / name for folder in folders if (folder / name).exists())
    (tmp_path / "pfbench").mkdir(mode=0o700)
    library = Path(shutil.copyfile(built, tmp_path / "pfbench" / name))
    library.chmod(0o600)
    assert load() == "loaded\n"
    library.chmod(0o666)
    assert load().startswith("refused")
