"""Small studies as tables, for tests of decisions."""

import numpy as np
import pandas as pd


def make_study(
    effects,
    worlds=3,
    regimes=2,
    runs=30,
    *,
    lost=None,
    seed=0,
    world_sd=0.1,
    run_sd=0.3,
    families=None,
):
    """Make a table of losses.

    Each filter has random numbers of its own, so that another filter changes nothing.

    Args:
        effects: Log loss by filter.
        worlds: Number of worlds.
        regimes: Number of regimes.
        runs: Number of runs.
        lost: Share of runs in which a filter loses track, by filter.
        seed: Seed.
        world_sd: SD of a filter over worlds.
        run_sd: SD over runs.
        families: Family by scenario.
    """
    rows = []
    for name, effect in effects.items():
        rng = np.random.default_rng([seed, *name.encode()])
        for w in range(worlds):
            level = effect + world_sd * rng.standard_normal()
            for r in range(regimes):
                loss = np.exp(level + run_sd * rng.standard_normal(runs))
                keeps = rng.random(runs) >= (lost or {}).get(name, 0.0)
                scenario = f"scenario_{w}"
                rows.append(
                    pd.DataFrame(
                        {
                            "filter": name,
                            "scenario": scenario,
                            "family": (families or {}).get(scenario, scenario),
                            "regime": f"regime_{r}",
                            "model": "model",
                            "seed": 1,
                            "run": range(runs),
                            "rmse": loss,
                            "lost": ~keeps,
                            "keeps_track": keeps,
                        }
                    )
                )
    return pd.concat(rows, ignore_index=True)
