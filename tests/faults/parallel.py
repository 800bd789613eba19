"""Two and three sweeps of one study at the same time, some with a damaged result from before."""

import random
from pathlib import Path

from faults import children
from faults.damage import damage
from faults.sweeps import judge, new_home, result_files, run_jobs, run_sweep, undisturbed
from faults.tally import Tally


def together(home: Path, processes: int, rng: random.Random) -> list[str]:
    """Run sweeps at the same time in one folder and return how each ended."""
    delays = [rng.choice((0.0, rng.uniform(0.0, 0.5))) for _ in range(processes)]
    log = home / "errors"
    log.mkdir()
    running = []
    for number, delay in enumerate(delays):

        def task(number: int = number) -> int:
            try:
                return run_jobs(home)
            except Exception as error:
                (log / f"{number}").write_text(f"{type(error).__name__}: {error}")
                return 1

        running.append(children.start(task))
        children.has_ended(running[-1], delay)
    endings = []
    for number, process in enumerate(running):
        if not children.has_ended(process, 180.0):
            children.kill(process)
        state, file = children.collect(process), log / f"{number}"
        said = file.read_text()[-300:] if file.exists() else ""
        endings.append("" if state == "exit 0" else f"{state}: {said}")
    return [ending for ending in endings if ending]


def run(count: int, seed: int) -> Tally:
    """Run `count` groups of two or three sweeps."""
    undisturbed()
    rng, tally = random.Random(seed), Tally("sweeps at the same time")
    for _ in range(count):
        processes, is_damaged = rng.choice((2, 3)), rng.random() < 0.5
        with new_home() as home:
            if is_damaged:
                children.run_child(lambda: run_jobs(home))
                for file in (*result_files(home), *(home / "worlds").glob("*.npz")):
                    file.write_bytes(damage(file.read_bytes(), rng))
            failed = together(home, processes, rng)
            ending = children.run_child(lambda: judge(home, run_sweep(home)))
        remark = f"{processes} sweeps" + (", damaged files" if is_damaged else "")
        if failed:
            tally.add("crash", remark, failed[0])
        elif ending.state != "done":
            tally.add("crash", remark, f"{ending}")
        else:
            tally.add(ending.value[0], remark, f"{ending.value[1:]}")
    return tally
