"""What DAPPER itself gives for settings of twins_settings.csv: twins_dapper.json.

Run with a Python in which DAPPER is installed (MIT licence, github.com/nansencenter/DAPPER), pfbench is not needed:
python experiments/analyses/twins_dapper.py COMMIT RUNS ID ...
"""

from __future__ import annotations

import ast
import csv
import importlib
import json
import statistics
import sys
from pathlib import Path

HERE = Path(__file__).parent
FIRST_SEED = 3000


def run_setting(row: dict[str, str], seed: int) -> float:
    """Return rmse.a of one experiment of DAPPER."""
    import dapper
    import dapper.da_methods as methods

    module = importlib.import_module("dapper.mods." + row["source"].replace("/", "."))
    model = importlib.reload(module).HMM  # a new dko changes the burn-in for good
    model.tseq.dko = int(row["dko"])
    call = ast.parse(row["setting"], mode="eval").body
    options = {word.arg: ast.literal_eval(word.value) for word in call.keywords}
    if call.args:
        options["upd_a"] = ast.literal_eval(call.args[0])
    dapper.set_seed(seed)
    truth, measurements = model.simulate()
    experiment = getattr(methods, call.func.id)(**options)
    experiment.seed = seed
    experiment.assimilate(model, truth, measurements, liveplots=False)
    experiment.stats.average_in_time()
    return float(experiment.avrgs.err.rms.a.val)


def main(commit: str, runs: str, *ids: str) -> None:
    """Run DAPPER with seeds 3000, 3001, ... and store mean, standard error and runs of each row."""
    store_file = HERE / "twins_dapper.json"
    store = json.loads(store_file.read_text()) if store_file.exists() else {}
    rows = {row["id"]: row for row in csv.DictReader((HERE / "twins_settings.csv").open())}
    for name in ids:
        values = [run_setting(rows[name], FIRST_SEED + k) for k in range(int(runs))]
        mean, error = statistics.mean(values), statistics.stdev(values) / len(values) ** 0.5
        numbers = {"mean": round(mean, 3), "standard_error": round(error, 3)}
        store[name] = {"commit": commit, "runs": len(values), **numbers}
        print(name, store[name], flush=True)
        store_file.write_text(json.dumps(store, indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
