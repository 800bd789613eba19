"""Compiled code is loaded only from a folder that the user alone can write."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from pfbench import job
from pfbench.kernels import cpp_library, cpp_library as private_folder, library_build
from pfbench.scenario.simulated import load_or_build

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
