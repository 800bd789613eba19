"""One job: one cell (scenario, noise, filter) with all its Monte Carlo runs. Seeds, build, run, measure, save."""

from __future__ import annotations

import hashlib
import inspect
import logging
import math
import platform
import re
import subprocess
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from torch import Tensor
from tqdm import tqdm

import pfbench
from pfbench import budget, fusion, memory, native, store
from pfbench.bound import posterior_bound
from pfbench.draws import MonteCarlo
from pfbench.filter.belief import Cloud, Info, gather
from pfbench.filter.compiled import Compiled
from pfbench.filter.gaussian import GaussianFilter
from pfbench.filter.learned_weights import by_content, origin
from pfbench.filter.loop import Estimate, run_filter, runs_at_once
from pfbench.filter.particle import ParticleFilter
from pfbench.judge import Judge, Tally
from pfbench.model.base import StateSpaceModel
from pfbench.noise.regimes import Nominal
from pfbench.record import Episode
from pfbench.scenario.told import Witness
from pfbench.scenario.worlds import cached

log = logging.getLogger("pfbench")

DATASHEETS = "datasheets"  # the folder of results in which the scenes' own datasheets lie

# what changes where and how fast a job runs, not what it computes
PLACES = (
    "results", "reports", "worlds", "data", "study", "threads", "engine", "memory", "fresh", "report", "scenario.root",
    "scenario.cache",
    "particles",  # counted where a filter uses it, as filter.particles
    "bound",  # stands beside what a filter does; fresh=true adds it to a finished job
    "runs_in",  # an experiment's table from which `runs` is taken
    "train", "checkpoint",  # a job depends on the weights that its filter has, which are named by what they are
)  # fmt: skip
# what says how jobs are compared and changes nothing in one: no part of its name while it is usual
USUAL: Mapping[str, Any] = {"budget": store.SAME_N}
SHARED = ("time", "bound", "range", "scored")  # arrays without an axis of runs
_COMPILE_FROM = 5e8  # normals; compiling the loops costs some seconds and saves 15 ms for each million


def run(cfg: DictConfig) -> float:
    """Runs one job and saves it, or finds that it is done; returns the headline error (rms of the main group's norm).

    Raises:
        ValueError: a study that names no folder.
        Exception: whatever stopped the job, after a note of it has been left beside the results.
    """
    config: Any = OmegaConf.to_container(cfg, resolve=True)
    if not re.fullmatch(r"\w[\w.-]*", str(cfg.study)):
        raise ValueError(f"study={cfg.study}: it names a folder of results; use letters, digits, points, dashes and underscores")
    if cfg.study in (DATASHEETS, "claims"):
        raise ValueError(f"study={cfg.study}: `pfbench report` puts pages of its own there; give the study another name")
    path = Path(cfg.results) / cfg.study / f"{name_of(config)}.npz"
    choices = _choices()
    name = " ".join(choices[part] for part in ("scenario", "noise", "filter"))
    if path.exists() and not cfg.fresh:
        log.info("%s: done already (%s)", name, path)
        return _headline(store.load(path).arrays, store.describe(path))
    try:
        meta, arrays = in_parts(cfg, name)
    except Exception as error:
        log.error("%s: failed, see %s", name, store.failed(path, choices, error) or f"the error; {path} is kept")
        raise
    store.save(path, {"key": path.stem, "study": cfg.study, "choices": choices, "config": config, **meta}, arrays)
    headline = _headline(arrays, meta)
    seconds, lost = meta["seconds"], int(arrays["lost"].sum())
    log.info(
        "%s: rms error %.4g, %d of %d runs lost, %.3g ms per step, %.1f s in all",
        name, headline, lost, meta["runs"], 1e3 * seconds["per_step"], seconds["world"] + seconds["filter"],
    )  # fmt: skip
    return headline


def name_of(config: Mapping[str, Any]) -> str:
    """The key of a job: of what it computes, and of what it states of itself that is not usual."""
    config = {**config, "filter": by_content(config.get("filter"))}
    return store.key(config, (*PLACES, *(name for name, usual in USUAL.items() if config.get(name) == usual)))


def in_parts(cfg: DictConfig, name: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """`compute`; some of the runs after the others where all at once would not fit into the memory. The numbers are the same.

    A bound that the runs have in common is then the mean of the parts' own.

    Raises:
        ValueError: not even one run would fit; worlds that last differently long; as `compute`.
    """
    cfg, bought = within_budget(cfg)
    size = runs_that_fit(cfg)
    if size == cfg.runs:
        meta, arrays = compute(cfg, name)
        return {**meta, "bought": bought}, arrays
    parts = []
    for first in range(cfg.first_run, cfg.first_run + cfg.runs, size):
        part = cfg.copy()
        part.first_run, part.runs = first, min(size, cfg.first_run + cfg.runs - first)
        parts.append(compute(part, f"{name}, runs from {first}"))
    metas, found = zip(*parts, strict=True)
    if any(arrays["time"].shape != found[0]["time"].shape for arrays in found):
        raise ValueError(
            "memory: these worlds last differently long, and a job that is done in parts needs them alike; give fewer runs in "
            f"a job (runs={size}, first_run=...)"
        )
    shares = np.array([meta["runs"] for meta in metas]) / cfg.runs
    arrays = {
        name: found[0][name] if name in SHARED else np.concatenate([arrays[name] for arrays in found]) for name in found[0]
    }
    if "bound" in arrays:
        square = sum(share * part["bound"].astype(float) ** 2 for share, part in zip(shares, found, strict=True))
        arrays["bound"] = np.sqrt(square).astype(np.float32)
    seconds = {name: sum(meta["seconds"][name] for meta in metas) for name in metas[0]["seconds"]}
    taken = [meta["memory"] for meta in metas]
    meta = {
        **metas[0], "runs": cfg.runs, "first_run": cfg.first_run, "parts": len(parts), "seconds": seconds, "bought": bought,
        "memory": None if None in taken else max(taken),
        "likelihoods_per_step": float(shares @ [meta["likelihoods_per_step"] for meta in metas]),
    }  # fmt: skip
    return meta, arrays


def within_budget(cfg: DictConfig) -> tuple[DictConfig, dict[str, float] | None]:
    """The job with as many particles as its budget buys, and what was found; as it is where the budget is a number of particles.

    A filter without particles, and one that was given a number of its own (filter.particles=...), stay as they are.

    Raises:
        ValueError: a step that is compiled as a whole, which costs what nobody knows before.
    """
    settings(cfg)
    shared = "particles" in cfg["filter"] and OmegaConf.is_interpolation(cfg["filter"], "particles")
    if cfg.budget == store.SAME_N or not shared:
        return cfg, None
    if cfg.engine == "compiled":
        raise ValueError(f"engine=compiled with budget={cfg.budget}: trials are not compiled; give engine=auto or budget=same N")
    model, scenario, witness, method = build(cfg.model), build(cfg.scenario), Witness(build(cfg.noise)), build(cfg["filter"])
    episode = scenario.draw(witness, torch.arange(cfg.first_run, cfg.first_run + cfg.runs), cfg.seed)
    model = (witness.tell(model, episode.time) if cfg.told else model).to(cfg.device, getattr(torch, cfg.dtype))
    trial = budget.Trial(
        model, episode.record, clock_of(cfg), cfg.seed, Tally(model), lambda method: at_once(cfg, method, model, cfg.runs)
    )
    with fusion.fused(fuses(cfg.engine, ParticleFilter(cfg.particles), model, cfg.runs * episode.record.y.shape[1])):
        found = budget.bought(cfg.budget, method, cfg.particles, trial)
    log.info("budget=%s: %d particles, as %d of sir", cfg.budget, found.particles, cfg.particles)
    cfg = cfg.copy()
    cfg["filter"].particles = found.particles
    return cfg, found._asdict()


def clock_of(cfg: DictConfig) -> Callable[[], float]:
    """The processor's time: what a filter took whatever else the machine did. Of several threads it would be their sum."""
    return time.process_time if cfg.device == "cpu" and cfg.threads == 1 else time.perf_counter


def runs_that_fit(cfg: DictConfig) -> int:
    """How many of a job's runs may be worked on at a time; found out by a trial where there may be too many.

    Raises:
        ValueError: not even one.
    """
    settings(cfg)
    limit = memory.limit(cfg.memory, cfg.device)
    model, method = build(cfg.model), build(cfg["filter"])
    if limit is None or not memory.worth_asking(method, model, cfg.runs, limit):
        return int(cfg.runs)
    scenario, witness = build(cfg.scenario), Witness(build(cfg.noise))
    episode = scenario.draw(witness, torch.arange(cfg.first_run, cfg.first_run + min(2, cfg.runs)), cfg.seed)
    model = (witness.tell(model, episode.time) if cfg.told else model).to(cfg.device, getattr(torch, cfg.dtype))
    truth = model.assemble(episode.truth).to(model.anchor)

    def watch(runs: int, steps: int) -> Judge:
        return Judge(model, truth[:runs, :steps], min(cfg.scored, 1))

    needs = memory.needs(method, model, episode, lambda runs: at_once(cfg, method, model, runs), watch)
    size = memory.fitting(needs, cfg.runs, limit)
    if size < cfg.runs:
        log.info(
            "memory: %d runs at once would take about %.3g GiB, and %.3g GiB may be taken here (memory=...): %d at a time then, "
            "with the same results", cfg.runs, needs.of(cfg.runs) / memory.GIB, limit / memory.GIB, size,
        )  # fmt: skip
    return size


def compute(cfg: DictConfig, name: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Draws the worlds, runs the filter on them and measures: what `store.save` wants, but for the job's identity.

    Raises:
        ValueError: bad values in the configuration.
    """
    settings(cfg)
    # the model first: a scenario may hold it, and what is wrong with a model is told under its own name
    model, scenario, noise, method = (build(cfg[part]) for part in ("model", "scenario", "noise", "filter"))
    runs = torch.arange(cfg.first_run, cfg.first_run + cfg.runs)
    trained = origin(OmegaConf.to_container(cfg["filter"], resolve=True), _choices()["scenario"], cfg.seed, runs)
    started = time.perf_counter()
    witness = Witness(noise)
    episode: Episode = scenario.draw(witness, runs, cfg.seed)
    drawn = time.perf_counter()
    config: Any = OmegaConf.to_container(cfg, resolve=True)
    least, said = lower_bound(config, model, witness, episode)
    bounded = time.perf_counter()
    dtype = getattr(torch, cfg.dtype)
    model = witness.tell(model, episode.time) if cfg.told else model
    model = model.to(cfg.device, dtype)
    truth = model.assemble(episode.truth).to(cfg.device, dtype)
    steps = episode.record.y.shape[1]
    draws = MonteCarlo(cfg.seed, runs.to(cfg.device), dtype)
    clock = clock_of(cfg)
    judge, tally = Judge(model, truth, cfg.scored, clock), Tally(model)

    def watch(t: int, info: Info) -> dict[str, Tensor]:
        with tally.paused():
            return judge(t, info)

    if cfg.device != "cpu":
        torch.cuda.reset_peak_memory_stats(cfg.device)
    compiling = time.perf_counter()
    fuse = fuses(cfg.engine, method, model, cfg.runs * steps)
    compiled = time.perf_counter() - compiling
    step = compiled_step(cfg.engine, fuse, method, tally, clock)
    held, tidy = native.peak_from_here(), memory.Tidy()

    def tick() -> None:
        bar.update()
        tidy()

    begun = clock()
    with (
        fusion.fused(fuse),
        torch.no_grad(),
        tqdm(total=steps, desc=name, unit="step", delay=2, disable=None, leave=False) as bar,
    ):
        estimate = run_filter(step or method, model, episode.record, draws, watch, tick, at_once(cfg, method, model, cfg.runs))
    if cfg.device != "cpu":
        torch.cuda.synchronize()
    spent = clock() - begun - judge.seconds - (step.seconds if step else 0.0)
    seconds = {
        "world": drawn - started, "bound": bounded - drawn, "scores": judge.seconds,
        "compile": compiled + (step.seconds if step else 0.0), "filter": spent,
        "per_step": spent / steps,
    }  # fmt: skip
    likelihoods = tally.count / (cfg.runs * steps)
    engine = "compiled" if step and step.at_work else "loops" if fuse else "eager"
    cost = {"engine": engine, "memory": _taken(cfg.device, held), "likelihoods_per_step": likelihoods}
    meta = describe(cfg, model, method, steps, seconds, episode.notes) | cost
    if (number := estimate.trace.get("particles")) is not None:
        meta["particles_used"] = {"least": int(number.min()), "mean": float(number.mean()), "most": int(number.max())}
    return {**meta, "bound": said, "trained": trained}, {**_arrays(episode, estimate, judge), **_shared(episode, least)}


def _taken(device: str, held: int | None) -> int | None:
    """Bytes that the filter took beyond what was held before; None where the system does not tell."""
    if device != "cpu":
        return int(torch.cuda.max_memory_allocated(device))
    return None if held is None else max(0, native.peak() - held)


def settings(cfg: DictConfig | Mapping[str, Any]) -> None:
    """The one door for global things: threads, and the checks of what concerns the whole job.

    Raises:
        ValueError: names the key, the value and the remedy.
    """
    for key, least in (("runs", 1), ("first_run", 0), ("threads", 1), ("seed", 0), ("scored", 0)):
        if type(cfg[key]) is not int or cfg[key] < least:
            raise ValueError(f"{key}={cfg[key]}: give a whole number, {least} or more")
    if type(cfg["told"]) is not bool:
        raise ValueError(f"told={cfg['told']}: give true (the filter knows the noise regime) or false")
    if cfg["bound"] not in (True, False, "auto"):
        raise ValueError(f"bound={cfg['bound']}: give auto (where the model's laws are the world's), true or false")
    if cfg["memory"] is not None and not (isinstance(cfg["memory"], int | float) and cfg["memory"] > 0):
        raise ValueError(f"memory={cfg['memory']}: give the GiB that a job may take, or null for most of what is free")
    if cfg["dtype"] not in ("float32", "float64"):
        raise ValueError(f"dtype={cfg['dtype']}: give float64 (the default) or float32")
    if cfg["budget"] not in store.BUDGETS:
        raise ValueError(f"budget={cfg['budget']}: give one of {', '.join(store.BUDGETS)}")
    if cfg["engine"] not in ("auto", "eager", "loops", "compiled"):
        raise ValueError(f"engine={cfg['engine']}: give auto, eager, loops or compiled")
    if not re.fullmatch(r"cpu|cuda(:\d+)?", str(cfg["device"])):
        raise ValueError(f"device={cfg['device']}: give cpu, cuda, or one of several as cuda:1")
    if cfg["device"] != "cpu" and (torch.device(cfg["device"]).index or 0) >= torch.cuda.device_count():
        raise ValueError(f"device={cfg['device']}: torch finds {torch.cuda.device_count()} CUDA devices here; give device=cpu")
    torch.set_num_threads(cfg["threads"])
    native.keep_memory()


def build(node: Any) -> Any:
    """The object that a configuration node names by `_target_`; lists and dicts below it become plain ones."""
    return hydra.utils.instantiate(node, _convert_="all")


def at_once(cfg: DictConfig, method: Any, model: StateSpaceModel, runs: int) -> int:
    """Runs that a step takes together: all of them on another device than the CPU."""
    if cfg.device != "cpu" or not isinstance(method, ParticleFilter):
        return runs
    return runs_at_once(runs, method.particles, model.chart.size)


def fuses(engine: str, method: Any, model: StateSpaceModel, run_steps: int) -> bool:
    """Are inner loops compiled: where it was asked for, or where a job is large enough to pay for the compilation?

    What is compiled is kept on disk for later jobs; a compilation that took noticeably long is told.
    """
    numbers = 0
    if isinstance(method, ParticleFilter):
        numbers = run_steps * method.particles * model.noise_dim
    elif isinstance(method, GaussianFilter):  # by its linear algebra: eight normals for each entry of a covariance
        numbers = run_steps * 8 * model.chart.dimension**2
    if engine == "eager" or (engine == "auto" and numbers < _COMPILE_FROM):
        return False
    begun = time.perf_counter()
    try:
        with fusion.fused(), torch.no_grad():
            draws = MonteCarlo(0, torch.arange(2, device=model.anchor.device))
            draws.uniform("compiles", 2, 2)
            x = draws.normal("compiles", 2, 2)
            gather(Cloud(x, x[..., 0], x[:, 0, 0]), torch.zeros(2, 2, dtype=torch.int64, device=x.device))
    except Exception as error:  # torch raises many kinds where no C++ compiler is at hand
        log.warning("engine=%s: nothing compiles here (%s); going on eagerly", engine, type(error).__name__)
        return False
    took = time.perf_counter() - begun
    if took > 0.5:
        log.info("engine=%s: inner loops compiled in %.1f s; later jobs find them ready", engine, took)
    return True


def compiled_step(
    engine: str, fuse: bool, method: Any, tally: Tally, clock: Callable[[], float]
) -> Compiled | None:
    """The filter with its step compiled as a whole, where that was asked for and can be."""
    if engine != "compiled" or not fuse:
        return None
    if not isinstance(method, ParticleFilter) or method.keeper is not None:
        what = "its moves carry a past" if isinstance(method, ParticleFilter) else f"it is a {type(method).__name__}"
        log.info("engine=compiled: the step of this filter is not compiled as a whole (%s), only its inner loops", what)
        return None
    return Compiled(method, tally, clock)


def lower_bound(
    config: Mapping[str, Any], model: StateSpaceModel, witness: Witness, episode: Episode
) -> tuple[Tensor | None, str]:
    """No filter's rms error can be smaller: standard deviations of the posterior Cramer-Rao bound, and what they are.

    The bound is that of the world, and so of the model that is told the noise regime, whatever the filters are told. Runs have
    a recursion in common where there is one, else each its own. It is kept beside the worlds, for all filters of a study; the
    model's source file decides it too. Where filters start from a measurement that the record does not hold, it starts from the
    model's own initial law.

    Args:
        config: of the job, resolved: model, scenario, noise, seed, bound, worlds.
        model: that filters believe in, on the processor in double precision, not told.
        witness: of the noise regime, after the worlds were drawn.
        episode: the worlds.

    Returns:
        Standard deviations [T, d] and their description; or None and why there is no bound.
    """
    why = _boundless(config, episode)
    if why:
        return None, why
    try:
        told = model if isinstance(witness.regime, Nominal) else witness.tell(model, episode.time)
    except ValueError:
        return None, "no bound: the errors of this noise regime have no law step by step"
    initial = None if episode.record.spread is None else torch.diag_embed(model.initial(1).variance[0])
    where = {**config["scenario"], "root": None, "cache": None}
    code = hashlib.sha256(Path(inspect.getfile(type(model))).read_bytes()).hexdigest()
    drawn = config["noise"], config["seed"], config["first_run"], config["runs"]
    recipe = ("bound 1", code, config["model"], where, *drawn)

    def build() -> dict[str, Tensor]:
        truth = told.assemble(episode.truth)
        try:
            found, apart = posterior_bound(told, truth, episode.record, initial), model.linear
        except ValueError:  # no recursion in common; where runs have none of their own either, that says why
            found, apart = posterior_bound(told, truth, episode.record, initial, run_by_run=True), True
        sd = found.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
        return {"bound": sd.contiguous(), "apart": torch.tensor(apart)}

    try:
        kept = cached(config["worlds"], recipe, build)
    except ValueError as error:
        return None, "no bound: " + f"{error}".removeprefix("Told: ")
    how = "the mean of the runs' own" if bool(kept["apart"]) else "one recursion for all runs"
    law = "; it starts from the model's own initial law, without the measurement from which filters start"
    first = "" if initial is None else law
    knows = "" if told is model else " that is told the noise regime"
    return kept["bound"], f"posterior Cramer-Rao bound of the model{knows}, {how}{first}"


def _boundless(config: Mapping[str, Any], episode: Episode) -> str:
    """Why nobody need look for a bound, or nothing."""
    if config["bound"] is False:
        return "no bound: it was not asked for (bound=false)"
    if config["bound"] is True:
        return ""
    if "root" in config["scenario"]:
        return "no bound: the scene was recorded, and the laws of its errors are not known"
    if episode.record.loop is not None:
        return "no bound: what a filter estimates changes this world"
    for name, value in config["model"].items():
        if "inflation" in name and value not in (None, 1.0):
            return f"no bound: the model has more process noise than the world, on purpose (model.{name})"
    return ""


def describe(
    cfg: DictConfig, model: StateSpaceModel, method: Any, steps: int, seconds: dict[str, float], notes: tuple[str, ...]
) -> dict[str, Any]:
    """What ran: everything that a report may have to say."""
    return {
        "label": _choices()["filter"],
        "seed": cfg.seed,
        "first_run": cfg.first_run,
        "runs": cfg.runs,
        "particles": cfg["filter"].get("particles"),
        "steps": steps,
        "dtype": cfg.dtype,
        "device": cfg.device if cfg.device == "cpu" else torch.cuda.get_device_name(cfg.device),
        "threads": cfg.threads,
        "exact": method.exact or (model.linear and isinstance(method, GaussianFilter) and method.plain),
        "told": cfg.told,
        "choices_made": [*model.choices, *notes],
        "versions": versions(),
        "host": platform.node(),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": seconds,
        "state": {
            "names": list(model.names),
            "units": list(model.units),
            "groups": {name: list(parts) for name, parts in model.groups.items()},
        },
    }


def versions() -> dict[str, str]:
    """Versions of what decides the numbers; `commit` is empty outside a checkout."""
    where = Path(pfbench.__file__).parent
    command = ["git", "-C", str(where), "describe", "--always", "--dirty", "--exclude", "*"]
    try:
        commit = subprocess.run(command, capture_output=True, text=True, check=False, timeout=10).stdout.strip()
    except (OSError, subprocess.TimeoutExpired):
        commit = ""
    return {
        "pfbench": pfbench.__version__,
        "commit": commit,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
    }


def _choices() -> dict[str, str]:
    chosen = HydraConfig.get().runtime.choices
    return {part: str(chosen[part]) for part in ("scenario", "noise", "filter", "model")}


def _arrays(episode: Episode, estimate: Estimate, judge: Judge) -> dict[str, np.ndarray]:
    trace = dict(estimate.trace)
    gone = torch.isnan(estimate.mean).any(-1, keepdim=True)
    arrays = {
        "time": episode.time,
        "error": torch.where(gone, torch.nan, trace.pop("error")).float(),
        "sd": torch.where(gone, torch.nan, estimate.variance.clamp(min=0).sqrt()).float(),
        "nees": torch.where(gone, torch.nan, trace.pop("nees")).float(),
        "log_evidence": estimate.log_evidence.double(),
        "lost": estimate.lost,
        **{name: value if value.dtype == torch.bool else value.float() for name, value in trace.items()},
    }
    if episode.track is not None:
        arrays["track"] = episode.track.float()
    arrays |= {name: value.float() if value.is_floating_point() else value for name, value in judge.arrays().items()}
    return {name: value.cpu().numpy() for name, value in arrays.items()}


def _shared(episode: Episode, least: Tensor | None) -> dict[str, np.ndarray]:
    """What all runs have in common: the bound [T, d], the range [T] by which errors of a location become relative."""
    parts = {"bound": least, "range": episode.sheet.get("range")}
    return {name: value.float().numpy() for name, value in parts.items() if value is not None}


def _headline(arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> float:
    """Root mean square of the norm of the main group: position where there is one, else the first."""
    groups = meta["state"]["groups"]
    parts = groups.get("position", next(iter(groups.values())))
    square = (arrays["error"][..., parts].astype(float) ** 2).sum(-1)[~arrays["lost"]]
    return math.sqrt(np.nanmean(square)) if np.isfinite(square).any() else math.inf
