"""Hydra's application of `pfbench run`."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from pfbench.results.paper_block import conf_dir

_MULTIRUN_FLAGS = ("-m", "--multirun")


def make_application(task: Callable[[Any], Any]) -> Callable[[], None]:
    """Make the application that runs a task for each job."""
    import hydra

    full = hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="config")(task)

    def run() -> None:
        words = sys.argv[1:]
        flags = [word for word in words if word.startswith("-")]
        if set(flags) <= set(_MULTIRUN_FLAGS):
            overrides = [word for word in words if word not in flags]
            _run_overrides(task, overrides, is_multirun=bool(flags))
        else:
            with _shared_loader():
                full()

    return run


@contextmanager
def _shared_loader() -> Iterator[None]:
    """Let Hydra's own application load by the loader of pfbench, which checks what it loads."""
    from hydra._internal import hydra as module

    from pfbench.job.shared_loader import SharedLoader

    hydra: Any = module
    by_hydra = hydra.ConfigLoaderImpl
    hydra.ConfigLoaderImpl = SharedLoader
    try:
        yield
    finally:
        hydra.ConfigLoaderImpl = by_hydra


def _run_overrides(task: Callable[[Any], Any], overrides: list[str], *, is_multirun: bool) -> None:
    """Run the jobs of overrides, as `hydra.main` does."""
    from hydra import version
    from hydra._internal import utils
    from hydra._internal.hydra import Hydra
    from hydra.core.global_hydra import GlobalHydra

    from pfbench.job.shared_loader import SharedLoader

    version.setbase("1.3")
    name = utils.detect_task_name(*utils.detect_calling_file_or_module_from_task_function(task))
    application = Hydra(name, SharedLoader(utils.create_config_search_path(str(conf_dir()))))
    GlobalHydra.instance().initialize(application)
    try:
        mode = application.get_mode("config", overrides) if _can_set_mode(overrides) else None
        utils._run_app(
            run=not is_multirun,
            multirun=is_multirun,
            mode=mode,
            hydra=application,
            config_name="config",
            task_function=task,
            overrides=overrides,
        )
    finally:
        GlobalHydra.instance().clear()


def _can_set_mode(overrides: Sequence[str]) -> bool:
    """Return whether overrides can set `hydra.mode`, which no file of pfbench sets. Other files need a search path."""
    return any(re.match(r"[+~]*hydra\b", word) for word in overrides)
