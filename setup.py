"""Build of the C++ operators of pfbench/kernels, where there is a compiler. All else is in pyproject.toml."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path
from subprocess import CalledProcessError

from setuptools import Extension, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext

HOME = Path(__file__).parent
KERNELS = HOME / "pfbench" / "kernels"
# not imported as a part of pfbench, which needs torch
specification = importlib.util.spec_from_file_location(
    "library_build", KERNELS / "library_build.py"
)
assert specification is not None
assert specification.loader is not None
library_build = importlib.util.module_from_spec(specification)
specification.loader.exec_module(library_build)


class BuildOperators(build_ext):
    """Build of one library for each variant of vector instructions, all at once."""

    def initialize_options(self) -> None:
        """Use one process for each variant, as far as there are processors."""
        super().initialize_options()
        self.parallel = True

    def get_ext_filename(self, name: str) -> str:
        """Return the path of a library: its name contains a hash of the sources."""
        *folders, last = name.split(".")
        return str(Path(*folders, library_build.name_library(last)))

    def build_extension(self, extension: Extension) -> None:
        """Build a library. Without a compiler the package works in torch operations."""
        target = Path(self.get_ext_fullpath(extension.name))
        target.parent.mkdir(parents=True, exist_ok=True)
        for old in KERNELS.glob(f"{target.name.rpartition('_')[0]}_*.so"):
            if old.name != target.name:  # of older sources, in a checkout
                old.unlink()
        if (KERNELS / target.name).exists():  # of an editable installation
            shutil.copy(KERNELS / target.name, target)
            return
        try:
            library_build.build_library(extension.name.rpartition(".")[2], target)
        except (OSError, CalledProcessError) as error:
            print(f"pfbench: C++ operators are not built: {error}", file=sys.stderr)


class PlatformWheel(bdist_wheel):
    """Wheel whose libraries depend on the platform and not on the version of Python."""

    def get_tag(self) -> tuple[str, str, str]:
        """Return the tag of the wheel."""
        return "py3", "none", super().get_tag()[2]

    def egg2dist(self, egginfo_path: str, distinfo_path: str) -> None:
        """Write the metadata of the wheel, with the commit of an unchanged checkout."""
        super().egg2dist(egginfo_path, distinfo_path)
        if commit := _find_commit():
            Path(distinfo_path, "COMMIT").write_text(f"{commit}\n")


def _find_commit() -> str:
    """Return the commit of this checkout; empty if a file is changed, or without git."""
    git = ["git", "-C", str(HOME)]
    try:
        changes = subprocess.run(
            [*git, "status", "--porcelain", "--untracked-files=no"],
            capture_output=True,
            text=True,
            check=True,
        )
        head = subprocess.run(
            [*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
        )
    except (OSError, CalledProcessError):
        return ""
    return "" if changes.stdout else head.stdout.strip()


setup(
    ext_modules=[
        Extension(f"pfbench.kernels.{variant}", sources=[], optional=True)
        for variant in library_build.find_variants()
    ],
    cmdclass={"build_ext": BuildOperators, "bdist_wheel": PlatformWheel},
)
