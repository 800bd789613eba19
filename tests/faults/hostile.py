"""Hostile configuration files: all cases of the tests of trust, as outcomes."""

import tempfile
from pathlib import Path

from hostile_cases import COMMANDS, FILES, GROUPS, NODES, text_of, try_file

from faults.children import run_child
from faults.sweeps import CLEAR
from faults.tally import FINE, Tally

# (name, group, text, command). The command line of `try_file` sets the folders of two files, so they are left out.
ALL = [
    (name, GROUPS[number % len(GROUPS)], text_of(node), COMMANDS[number % (len(COMMANDS) - 1)])
    for number, (name, node) in enumerate(NODES.items())
] + [
    (name, group, text, "train" if group == "train" else ("run -m", "run", "datasheet")[number % 3])
    for number, (name, (group, text)) in enumerate(FILES.items())
    if name not in ("results", "reports")
]
CASES = len(ALL)
BATCH = 10


def attempt(group: str, text: str, command: str) -> list[str]:
    """Run a command with a file and return outcome, remark and example."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            said = try_file(Path(folder), group, text, command)
        except AssertionError as error:
            return ["code run", "a file was changed", f"{error}"]
    if said.code == 0:
        return ["code run", "accepted", said.out[-300:]]
    if "Traceback" in said.err or not CLEAR.search(said.err):
        return ["unclear", "refused", said.err[-500:]]
    return [FINE, "refused with a clear message", ""]


def run(count: int, seed: int) -> Tally:
    """Try the cases of one batch; `seed` is its number."""
    tally = Tally("hostile files")
    for name, *words in ALL[seed * BATCH : seed * BATCH + count]:
        ending = run_child(lambda: attempt(*words))  # noqa: B023
        value = ending.value if ending.state == "done" else ["crash", ending.state, ending.value]
        tally.add(value[0], value[1], f"{name}: {value[2]}")
    return tally
