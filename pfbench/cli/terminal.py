"""Surroundings of a command: outputs that may close while it works, and signals that end it."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from pfbench.files.command_start import has_work_started
from pfbench.files.escapes import ESCAPED

_SIGNALS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
_WATCH = "watch of the sweep"  # name of a thread
_PARENT_CHECK = 1.0  # s, between two looks whether the process of the sweep lives


class SignalStop(BaseException):
    """A signal ends the command. It passes all handlers of errors, as KeyboardInterrupt does.

    Attributes:
        number: Number of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


class LastingOutput:
    """Output stream that a command can write to after its reader is gone or its disk is full.

    Attributes:
        error: First error of the stream, None while it works. What is written after it is lost.
    """

    def __init__(self, stream: Any, *, is_quiet: bool = False) -> None:
        self._stream, self._is_quiet = stream, is_quiet
        self.error: OSError | None = None

    def write(self, text: str) -> int:
        """Write a text."""
        self._try(self._stream.write, text.translate(ESCAPED))
        return len(text)

    def flush(self) -> None:
        """Write what is buffered."""
        self._try(self._stream.flush)

    def tell(self) -> None:
        """Print once that the output is closed, if the command still works."""
        if self.error is not None and has_work_started() and not self._is_quiet:
            self._is_quiet = True
            print(
                f"note: the output cannot be written any longer ({self.error.strerror}). "
                "The command goes on without it",
                file=sys.stderr,
            )

    def _try(self, action: Callable[..., object], *values: str) -> None:
        """Use the stream while it works. Then all that follows goes to nowhere, what Python flushes at its end included."""
        if self.error is not None:
            return
        try:
            action(*values)
            return
        except OSError as error:
            self.error = error
        with contextlib.suppress(OSError), open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), self._stream.fileno())
        self.tell()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextlib.contextmanager
def lasting_outputs() -> Iterator[LastingOutput]:
    """Replace the outputs of the process by lasting ones, and restore them and the handlers of the log."""
    streams, root = (sys.stdout, sys.stderr), logging.getLogger()
    handlers, level = list(root.handlers), root.level
    opened = [_opened(stream) for stream in streams]
    out, err = LastingOutput(opened[0]), LastingOutput(opened[1], is_quiet=True)
    sys.stdout, sys.stderr = out, err
    try:
        yield out
    finally:
        out.tell()
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        sys.stdout, sys.stderr = streams
        for stream in set(opened) - set(streams):
            stream.close()
        root.handlers[:], root.level = handlers, level  # Hydra's write to streams that may close


def _opened(stream: Any) -> Any:
    """Return a stream that can write each character; one to nowhere if the process has none."""
    if stream is None:
        return open(os.devnull, "w")
    with contextlib.suppress(AttributeError, OSError):  # a word may have bytes that do not decode
        stream.reconfigure(errors="backslashreplace")
    return stream


@contextlib.contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Raise SignalStop for the signals that end a process, unless the program around handles or ignores them."""

    def stop(received: int, frame: object) -> None:
        for number in signals:
            signal.signal(number, signal.SIG_IGN)  # a second one must not interrupt the tidying
        raise SignalStop(received)

    signals: list[int] = []
    if threading.current_thread() is threading.main_thread():
        signals += [number for number in _SIGNALS if signal.getsignal(number) == signal.SIG_DFL]
    for number in signals:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number in signals:
            signal.signal(number, signal.SIG_DFL)


def stop_workers() -> None:
    """End the processes of the launchers joblib and Ray, which would go on without the sweep."""
    loky = sys.modules.get("joblib.externals.loky.reusable_executor")
    if loky is not None and loky._executor is not None:
        loky._executor.shutdown(wait=True, kill_workers=True)
    if "ray" in sys.modules:
        sys.modules["ray"].shutdown()


def end_with_parent() -> None:
    """End this process when the process of its sweep is gone, if it is a worker of joblib.

    The sweep may be killed without a word: a worker would go on for the rest of its job.
    """
    parent = multiprocessing.parent_process()
    if parent is None or any(thread.name == _WATCH for thread in threading.enumerate()):
        return

    def watch() -> None:
        while os.getppid() == parent.pid:
            time.sleep(_PARENT_CHECK)
        os._exit(1)

    threading.Thread(target=watch, name=_WATCH, daemon=True).start()
