"""Kills of a sweep by SIGKILL: at random times, at operations on files, and in the middle of a file."""

import io
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from command_line import Said, environment, processes_of

from faults import children
from faults.sweeps import SWEEP, judge, new_home, result_files, run_jobs, run_sweep, undisturbed
from faults.tally import FINE, Tally
from pfbench.results import store

MODES = ("time", "operation", "byte")
COMMANDS = 0.1  # of the sweeps: started by `pfbench run -m`; the others call its jobs directly
MOST_KILLS = 8  # of one sweep before it may finish
OPERATIONS = 25  # as many as a sweep of three jobs makes
BYTES = 25_000  # as many as it writes
LAUNCHERS = {
    "cores": ("joblib", ("hydra/launcher=cores", "hydra.launcher.n_jobs=2")),
    "ray": ("ray", ("hydra/launcher=ray_local", "hydra.launcher.ray.init.num_cpus=2")),
}
RAY = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_AUTH_MODE": "disabled"}


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def die_at_operation(home: Path, number: int) -> None:
    """Make this process die before its n-th change of a file below a folder."""
    seen = [0]

    def hook(event: str, args: tuple[Any, ...]) -> None:
        writes = event in ("os.rename", "os.remove", "os.mkdir") or (
            event == "open" and bool(int(args[2] or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
        )
        if writes and str(args[0]).startswith(str(home)):
            seen[0] += 1
            if seen[0] >= number:
                die()

    sys.addaudithook(hook)


def die_at_byte(number: int) -> None:
    """Make this process die after it has written n bytes of new files."""
    left = [number]
    original = Path.open

    class Dying(io.FileIO):
        def write(self, content: Any) -> int:
            view = memoryview(content).cast("B")[: left[0]]
            left[0] -= len(view)
            written = super().write(view)
            if left[0] <= 0:
                os.fsync(self.fileno())
                die()
            return written

    def opened(path: Path, mode: str = "r", *args: Any, **more: Any) -> Any:
        if mode == "xb":
            return io.BufferedWriter(Dying(path, "xb"), buffer_size=64)
        return original(path, mode, *args, **more)

    Path.open = opened  # type: ignore[method-assign,assignment]


def kill_once(home: Path, run: Callable[[Path], int], longest: float, rng: random.Random) -> bool:
    """Run jobs in a child and kill it, after `longest` seconds at most; return False if it ended before."""
    mode = rng.choice(MODES)
    delay, operation, size = (
        rng.uniform(0.0, longest),
        rng.randint(1, OPERATIONS),
        rng.randint(1, BYTES),
    )

    def task() -> int:
        if mode == "operation":
            die_at_operation(home, operation)
        if mode == "byte":
            die_at_byte(size)
        return run(home)

    process = children.start(task)
    children.has_ended(process, delay if mode == "time" else 120.0)
    children.kill(process)
    return children.collect(process) == f"signal {signal.SIGKILL.value}"


def finished_files(home: Path) -> dict[Path, bytes]:
    """Return the content of the finished results, each of which must be readable."""
    files = {file: file.read_bytes() for file in result_files(home)}
    for file in files:
        store.read_result(file)
    return files


def try_kills(
    home: Path, run: Callable[[Path], int], kills: int, longest: float, rng: random.Random
) -> tuple[int, list[str]]:
    """Kill one sweep several times, finish it, and return the number of kills and the outcome."""
    made, files = 0, {}
    for _ in range(kills):
        made += kill_once(home, run, longest, rng)
        try:
            now = finished_files(home)
        except ValueError as error:
            return made, ["lost", "a kill left a damaged result", f"{error}"]
        if any(now.get(file) != content for file, content in files.items()):
            return made, ["lost", "a finished job was lost", f"{sorted(files)}"]
        files = now
    ending = children.run_child(lambda: judge(home, Said(run(home), "", "")))
    if ending.state != "done":
        return made, ["crash", ending.state, f"{ending.value}"]
    if any(file.read_bytes() != content for file, content in files.items()):
        return made, ["lost", "a finished job was repeated", f"{sorted(files)}"]
    if leftover := list((home / "results").rglob("*.tmp")):
        # of a kill between renaming and tidying; no reader takes these names
        return made, [
            ending.value[0],
            "equal, with a temporary file that is not read",
            f"{leftover}",
        ]
    return made, list(ending.value)


def run_command(home: Path) -> int:
    return run_sweep(home).code


def seconds_of(run: Callable[[Path], int]) -> float:
    """Return the duration of a sweep that is not disturbed."""
    with new_home() as home:
        start_time = time.perf_counter()
        children.run_child(lambda: run(home))
        return time.perf_counter() - start_time


def run(count: int, seed: int) -> Tally:
    """Kill serial sweeps until `count` kills are made."""
    undisturbed()  # before the first fork
    longest = {jobs: seconds_of(jobs) for jobs in (run_jobs, run_command)}
    rng, tally = random.Random(seed), Tally("kills, serial")
    while tally.trials < count:
        kills = min(rng.randint(1, MOST_KILLS), count - tally.trials)
        jobs = run_command if rng.random() < COMMANDS else run_jobs
        with new_home() as home:
            made, (outcome, remark, example) = try_kills(home, jobs, kills, longest[jobs], rng)
        for number in range(made):  # the last kill decides
            last = number == made - 1
            tally.add(outcome if last else FINE, remark if last else "killed again", example)
    return tally


def launch(home: Path, words: tuple[str, ...]) -> subprocess.Popen[str]:
    """Start the sweep with a launcher as a process of its own."""
    env = os.environ | environment(home) | RAY
    env.pop("PFBENCH_DATA", None)
    command = [sys.executable, "-m", "pfbench", *SWEEP, *words]
    pipe = subprocess.PIPE
    return subprocess.Popen(
        command, env=env, cwd=home, stdout=pipe, stderr=pipe, text=True, start_new_session=True
    )


def kill_all(home: Path, sweep: subprocess.Popen[str]) -> None:
    """Kill a sweep and all processes of its launcher."""
    children.kill(sweep.pid)
    for _ in range(3):  # a process may just have started another
        for process in processes_of(home, ""):
            children.kill(process)
        time.sleep(0.1)
    sweep.communicate()


def run_launcher(name: str, count: int, seed: int) -> Tally:
    """Kill sweeps of a launcher: the whole sweep, which is repeated, or one of its processes."""
    module, words = LAUNCHERS[name]
    tally, rng = Tally(f"kills, launcher {name}"), random.Random(seed)
    if find_spec(f"hydra_plugins.hydra_{module}_launcher") is None:
        tally.skipped = "not installed"
        return tally
    undisturbed()
    while tally.trials < count:
        with new_home() as home:
            victim, delay = rng.choice(("sweep", "worker")), rng.uniform(4.0, 18.0)
            sweep = launch(home, words)
            try:
                sweep.wait(delay)
                continue  # ended before the kill
            except subprocess.TimeoutExpired:
                pass
            workers = [p for p in processes_of(home, "") if p != sweep.pid]
            workers = [p for p in workers if _is_worker(p)]
            if victim == "worker" and workers:
                os.kill(rng.choice(workers), signal.SIGKILL)
            else:
                kill_all(home, sweep)
                sweep = launch(home, words)
            try:
                _, err = sweep.communicate(timeout=180)
            except subprocess.TimeoutExpired:
                kill_all(home, sweep)
                tally.add("crash", f"the sweep hangs after the kill of a {victim}")
                continue
            kill_all(home, sweep)
            said = children.run_child(lambda: judge(home, Said(sweep.returncode, "", err)))  # noqa: B023
            outcome, remark, example = (
                said.value if said.state == "done" else ("crash", said.state, "")
            )
        tally.add(outcome, remark, example)
    return tally


def _is_worker(process: int) -> bool:
    """Return whether a process computes jobs."""
    try:
        words = Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return False
    return b"loky" in words or b"ray::" in words
