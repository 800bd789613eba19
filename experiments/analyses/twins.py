"""Printed errors of DAPPER's twin experiments beside ours: docs/twins.md and experiments/twins.csv.

`twins_settings.csv` has the settings and numbers that DAPPER prints in its files `mods/*/*.py` (MIT licence). Each setting is a
job of the study `twins_printed`: finished jobs are skipped, so that a stopped call goes on. The baselines are computed here.
twins_dapper.json has what DAPPER itself gives for some settings, see twins_dapper.py.

Run: python experiments/analyses/twins.py [ID ...], the missing rows by default; --page writes the page from the table alone.
"""

from __future__ import annotations

import argparse
import ast
import csv
import json
import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from pfbench import job
from pfbench.filter import GaussianSmoothing
from pfbench.noise import NominalNoise
from pfbench.results import read_metadata

HERE = Path(__file__).parent
SETTINGS, DAPPER = HERE / "twins_settings.csv", HERE / "twins_dapper.json"
TABLE, PAGE = HERE.parent / "twins.csv", HERE.parents[1] / "docs" / "twins.md"
PICTURE = PAGE.with_suffix(".svg")
SEED = 2012
LOST = 2.0  # times the error of the median run, above which a run has lost the truth [ours]
WORLDS = {
    "Lorenz63": "lorenz63_twin",
    "Lorenz96": "lorenz96_twin",
    "DoublePendulum": "double_pendulum_twin",
}
BASELINES = ("Climatology", "OptInterp", "Var3D")
BURN_IN = {
    "Lorenz63": 16.0,
    "Lorenz96": 20.0,
    "DoublePendulum": 10.0,
}  # model time, the mean is over later analyses


def parse_call(setting: str) -> tuple[str, list[Any], dict[str, Any]]:
    """Return name, arguments and options of a setting such as `EnKF('Sqrt', N=3)`."""
    call = ast.parse(setting, mode="eval").body
    assert isinstance(call, ast.Call), setting
    assert isinstance(call.func, ast.Name), setting
    options = {str(word.arg): ast.literal_eval(word.value) for word in call.keywords}
    return call.func.id, [ast.literal_eval(value) for value in call.args], options


def world_words(row: dict[str, str]) -> list[str]:
    """Return the words of the world of a row."""
    name, dko = row["source"].split("/")[0], int(row["dko"])
    words = [f"scenario={WORLDS[name]}"]
    if name == "DoublePendulum":  # 30 s
        words += [f"model.substeps={dko}", f"scenario.interval_s={dko / 100}"]
        words.append(f"scenario.steps={math.ceil(3000 / dko)}")
    if name == "Lorenz96" and parse_call(row["setting"])[0] in BASELINES:
        words.append("scenario.steps=10001")
    return [
        *words,
        "study=twins_printed",
        f"runs={row['runs']}",
        f"seed={SEED}",
        "pcrb=false",
        "score_steps=0",
    ]


def filter_words(row: dict[str, str], dimension: int, interval: float) -> list[str]:
    """Return the words of the filter that DAPPER's setting names; none for a baseline."""
    name, arguments, options = parse_call(row["setting"])
    if name == "ExtKF":  # its factor is per unit of time
        factor = options["infl"] ** interval
        return ["filter=fading_kf", f"filter.noise_adaptations.0.fading_factor={factor!r}"]
    if name == "EnKF":
        words = (
            ["filter=enkf_centred"] if arguments == ["PertObs"] else ["filter=enkf_sqrt_rotated"]
        )
        if arguments == ["Sqrt"]:
            words.append(f"filter.update.rotates={str(options.get('rot', False)).lower()}")
        return [*words, f"filter.particles={options['N']}", f"filter.inflation={options['infl']}"]
    if name == "PartFilt":  # its bandwidth is reg N^(-1/(d+4))
        scale = options["reg"] / float(GaussianSmoothing().bandwidth(dimension, torch.ones(1, 1)))
        return [
            "filter=rpf_copies", f"filter.particles={options['N']}", f"filter.resampler.scale={scale!r}",
            f"filter.resampler.resampler.ess_threshold={options['NER']}",
        ]  # fmt: skip
    return []


@cache
def draw_world(words: tuple[str, ...]) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray]:
    """Return model, times [T], truth [R, T, D] and measurements [R, T, Dy] of the words of a world."""
    config = job.compose(list(words))
    scenario = job.instantiate(config.values["scenario"])
    episode = scenario.draw(
        NominalNoise(), torch.arange(config.values["runs"]), config.values["seed"]
    )
    truth = np.empty((*episode.record.y.shape[:2], len(scenario.model.names)))
    for name, places in scenario.model.groups.items():
        truth[..., list(places)] = episode.truth[name]
    return scenario.model, episode.time.numpy(), truth, episode.record.y.numpy()


def baseline_errors(
    row: dict[str, str], model: Any, truth: np.ndarray, y: np.ndarray
) -> np.ndarray:
    """Return the errors [R, T, D] of climatology, optimal interpolation or a constant gain, by the moments of each run."""
    name, _, options = parse_call(row["setting"])
    mean, d = truth.mean(1, keepdims=True), truth.shape[-1]
    if name == "Climatology":
        return mean - truth
    covariance = np.stack([np.cov(run.T) for run in truth]) * options.get("xB", 1.0)
    h = np.eye(d)[model.observed]
    innovation = h @ covariance @ h.T + np.diag(model.r.numpy() ** 2)
    gain = covariance @ h.T @ np.linalg.inv(innovation)
    if name == "OptInterp":
        return mean + (y - mean @ h.T) @ gain.mT - truth
    x, error = model.m0.expand(len(y), 1, d), np.empty_like(truth)
    for t in range(y.shape[1]):
        x = model.propagate(x, (), x.new_zeros(1))
        x = (
            x
            + (torch.from_numpy(y[:, t, None]) - x[..., model.observed]) @ torch.from_numpy(gain).mT
        )
        error[:, t] = x[:, 0].numpy() - truth[:, t]
    return error


def dapper_rmse(error: np.ndarray, time: np.ndarray, burn_in: float) -> np.ndarray:
    """Return DAPPER's rmse.a [R]: root mean square over components, then the mean over analyses after the burn-in."""
    return np.sqrt((error[:, time > burn_in].astype(float) ** 2).mean(-1)).mean(1)


def half_digit(row: dict[str, str]) -> float:
    """Return half of the last printed digit."""
    return 0.5 * 10.0 ** -len(row["printed"].partition(".")[2])


def measure(row: dict[str, str]) -> dict[str, str]:
    """Return a row with our error."""
    name = row["source"].split("/")[0]
    words = world_words(row)
    config = job.compose(words)
    dimension = len(job.instantiate(config.values["model"]).names)
    burn_in = BURN_IN[name]
    lost, seconds, filter_ = (
        0,
        0.0,
        filter_words(row, dimension, config.values["scenario"]["interval_s"]),
    )
    filter_ += row["variant"].split()
    if filter_:
        path = job.run(job.compose(words + filter_)).path
        with np.load(path) as data:
            error, time, is_lost = (data[key] for key in ("error", "time", "lost"))
        rmse, lost = dapper_rmse(error, time, burn_in)[~is_lost], int(is_lost.sum())
        seconds = sum(
            read_metadata(path)["seconds"][part] for part in ("world", "filter", "scores")
        )
    else:
        model, time, truth, y = draw_world(tuple(words))
        rmse = dapper_rmse(baseline_errors(row, model, truth, y), time, burn_in)
    numbers = {
        "ours": rmse.mean(), "standard_error": rmse.std(ddof=1) / math.sqrt(len(rmse)), "median": np.median(rmse),
        "lowest": rmse.min(), "highest": rmse.max(),
    }  # fmt: skip
    row = {key: row[key] for key in ("id", "source", "dko", "setting", "variant", "printed")}
    row |= {key: f"{value:.4g}" for key, value in numbers.items()}
    return judge(
        row
        | {
            "z": "",
            "runs": str(len(rmse)),
            "lost": str(lost),
            "hit": "",
            "seconds": f"{seconds:.1f}",
        }
    )


def judge(row: dict[str, str]) -> dict[str, str]:
    """Return a row with its verdict: a printed number is of one experiment, so that it must be like one of our runs."""
    printed, mean, error, median, lowest, highest = (
        float(row[key])
        for key in ("printed", "ours", "standard_error", "median", "lowest", "highest")
    )
    half, n = half_digit(row), int(row["runs"])
    z = (mean - printed) / math.sqrt(error**2 * (n + 1) + half**2 / 3.0)  # of one more run
    loses = highest > LOST * median or row["lost"] != "0"
    hit = "loses" if loses else "yes" if lowest - half <= printed <= highest + half else "no"
    return row | {"z": f"{z:.3g}", "hit": hit}


def format_row(row: dict[str, str], dapper: dict[str, dict[str, float]]) -> str:
    """Return the line of a row in a table of the page."""
    reference = dapper.get(row["id"])
    itself = f"{reference['mean']} ± {reference['standard_error']}" if reference else ""
    words = row["variant"].replace("filter.", "").replace(" ", ", ")
    setting = f"`{row['setting']}`" + (f" with {words}" if words else "")
    ours, error, median, lowest, highest, z = (
        float(row[key]) for key in ("ours", "standard_error", "median", "lowest", "highest", "z")
    )
    cells = (
        row["id"], f"{row['source']}, {row['dko']}", setting, row["printed"], f"{ours:.3f} ± {error:.3f}", f"{z:+.1f}",
        f"{median:.3f} ({lowest:.3f} to {highest:.3f})", f"{row['runs']}{f' and {lost} without numbers' if (lost := int(row['lost'])) else ''}", itself,
    )  # fmt: skip
    return f"| {' | '.join(cells)} |"


HEAD = (
    "| row | source, steps per analysis | setting | printed | mean ± standard error | z | median (range of the runs) | runs | DAPPER itself |\n"
    "|---|---|---|---|---|---|---|---|---|"
)


def draw_figure(rows: list[dict[str, str]]) -> Figure:
    """Draw the median error by the printed one, with the range of the runs."""
    figure = Figure(figsize=(7.0, 0.19 * len(rows) + 0.8), layout="constrained")
    axis = figure.subplots()
    for i, row in enumerate(rows):
        printed, median, *ends = (
            float(row[key]) for key in ("printed", "median", "lowest", "highest")
        )
        half = half_digit(row)
        axis.plot(
            [1.0 - half / printed, 1.0 + half / printed], [i, i], color="#c9d3dd", linewidth=6.0
        )
        colour = {"yes": "#1577c8", "no": "#d56326", "loses": "#8a8a8a"}[row["hit"]]
        axis.plot([end / printed for end in ends], [i, i], color=colour)
        axis.plot([median / printed], [i], "o", markersize=3.0, color=colour)
    names = [f"{row['id']} {row['source'].split('/')[0]}: {row['setting']}" for row in rows]
    axis.set_yticks(range(len(rows)), names, fontsize=6.0)
    axis.set(xlim=(0.6, 1.6), ylim=(len(rows) - 0.5, -0.5), xlabel="our error / the printed one")
    axis.axvline(1.0, color="#c9d3dd", linewidth=0.8, zorder=0)
    return figure


def format_page(rows: list[dict[str, str]], dapper: dict[str, dict[str, float]]) -> str:
    """Return the page."""
    printed = [row for row in rows if not row["variant"]]
    by_hit = {hit: [row for row in printed if row["hit"] == hit] for hit in ("no", "loses", "yes")}
    minutes = sum(float(row["seconds"]) for row in rows) / 60.0
    counts = {hit: len(group) for hit, group in by_hit.items()}
    sections = (("Missed", "no"), ("A run loses the truth", "loses"), ("Met", "yes"))
    tables = "\n\n".join(
        f"## {title}: {counts[hit]}\n\n{NOTES[hit]}\n\n{HEAD}\n"
        + "\n".join(format_row(row, dapper) for row in by_hit[hit])
        for title, hit in sections if counts[hit]
    )  # fmt: skip
    variants = "\n".join(format_row(row, dapper) for row in rows if row["variant"])
    return TEMPLATE.format(
        rows=len(printed), met=counts["yes"], missed=counts["no"], loses=counts["loses"], minutes=minutes,
        tables=tables, head=HEAD, variants=variants, seed=SEED,
    )  # fmt: skip


NOTES = {
    "no": "In T15 the extended Kalman filter of DAPPER has another derivative of the step, see below; whether this is the cause was not tried.",
    "loses": "Some runs have an error of more than twice that of the median run, or no number. The printed number is of one run: compare it with the median.",
    "yes": "The order is that of DAPPER's files.",
}
TEMPLATE = (HERE / "twins_page.md").read_text()


def main() -> None:
    """Measure the rows that are missing or named, then write table and page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ids", nargs="*", help="rows, the missing ones by default")
    parser.add_argument("--page", action="store_true", help="write the page only")
    options = parser.parse_args()
    settings = list(csv.DictReader(SETTINGS.open()))
    stored = {row["id"]: row for row in csv.DictReader(TABLE.open())} if TABLE.exists() else {}
    for row in [] if options.page else settings:
        if row["id"] in options.ids if options.ids else row["id"] not in stored:
            stored[row["id"]] = measure(row)
            print(" ".join(stored[row["id"]].values()), flush=True)
            with TABLE.open("w", newline="") as file:
                writer = csv.DictWriter(file, stored[row["id"]], lineterminator="\n")
                writer.writeheader()
                writer.writerows(stored[each["id"]] for each in settings if each["id"] in stored)
    rows = [judge(stored[row["id"]]) for row in settings if row["id"] in stored]
    with TABLE.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    draw_figure([row for row in rows if not row["variant"]]).savefig(PICTURE)
    PAGE.write_text(format_page(rows, json.loads(DAPPER.read_text())))


if __name__ == "__main__":
    main()
