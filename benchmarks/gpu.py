"""SIR on W4, large, on one GPU: particle-steps per second, and bytes per second beside what the device can copy. Writes gpu.md.

    python benchmarks/gpu.py                              # needs a CUDA device
    python benchmarks/gpu.py --device cpu --scale 0.02    # to try it out

A step that writes down nothing but its particles has to move NEEDED bytes for each of them. That times the particle-steps of a
second, over the bytes that a copy of a large tensor reads and writes in a second on the same device, is the share of the device
that is put to use. What the eager engine really moves is counted, operation by operation (`Traffic`), what the compiled one does
from its kernels (`COMPILED`).
"""

from __future__ import annotations

import argparse
import platform
import statistics
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import workload
from house import model_and_record
from race import cpu_name
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from pfbench.core import PhiloxStream, Record, map_inputs
from pfbench.filter import EssResampler, FilterResult, ParticleFilter, Systematic, run_filter
from pfbench.filter.loop import choose_run_batch
from pfbench.filter.particle.compiled_filter import CompiledParticleFilter
from pfbench.job import memory as process_memory
from pfbench.kernels import cuda, dispatch
from pfbench.model import StateSpaceModel

HERE = Path(__file__).parent
ENGINES = ("compiled", "kernels", "eager")
SIZES = ((1000, 10_000, 200), (100, 500, 200))  # runs, particles, steps
TOLERANCE = 4.5  # standard errors

STATE = 15 * 4  # bytes of a particle in single precision
# Its ancestor's state is read and its own written; its log weight is written, and read for the greatest one, for their sum and
# for the cumulative sum; its ancestor's number, four bytes, is written and read. Noise is made where it is used.
NEEDED = 2 * STATE + (1 + 3) * 4 + 2 * 4

# By the compiled step, counted kernel by kernel, each array once: ancestors drawn (4 read, 4 written), parents copied, moved with
# their noise and weighed (4 + 60, 60 + 4), log weights and weights normalised (4, 4 + 4), what log weights are after resampling (4
# written), and what sums of 128 particles leave, 33 numbers (written and read).
COMPILED = 8 + 128 + 12 + 4 + 2 * 33 * 4 / 128
FUSED = "weighed"  # of those kernels, one that no other step has

SECONDS = (0.5, 0.2)  # of the first size: what must be, and the aim
SHARE = 0.5  # of the copy rate, likewise: what must be


class Moved(NamedTuple):
    """Bytes that operations move for each particle in a step: all of them, and those that make random numbers."""

    whole: float
    noise: float


class Measured(NamedTuple):
    """One engine at one size.

    Attributes:
        engine: what ran.
        runs, particles, steps: of the workload.
        block: runs that a step took together.
        first: seconds of the first pass, compilation included.
        seconds: of each pass after it.
        peak: most bytes that tensors took on the device after the first pass; None on the CPU.
        moved: what was counted; None where nothing was, or the step has other kernels.
        evidence: log evidence minus the exact one [R], of the last pass.
    """

    engine: str
    runs: int
    particles: int
    steps: int
    block: int
    first: float
    seconds: list[float]
    peak: int | None
    moved: Moved | None
    evidence: np.ndarray

    @property
    def size(self) -> str:
        return f"{self.runs} x {self.particles} x {self.steps}"

    @property
    def rate(self) -> float:
        """Particle-steps per second."""
        return self.runs * self.particles * self.steps / statistics.median(self.seconds)


class Traffic(TorchDispatchMode):
    """Adds up the bytes that operations move: each reads each of its arguments once and writes each result once; views move none.

    What is repeated without being stored (a stride of 0) counts once, as does what an operation may have to read several times.
    """

    def __init__(self) -> None:
        super().__init__()
        self.bytes = 0

    def __torch_dispatch__(
        self, operation: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        out = operation(*args, **(kwargs or {}))
        given, made = (
            [a for a in tree_leaves(tree) if isinstance(a, Tensor)]
            for tree in ((args, kwargs), out)
        )
        stored = {a.untyped_storage().data_ptr() for a in given}
        view = (
            any(a.untyped_storage().data_ptr() in stored for a in made)
            and not operation._schema.is_mutable
        )
        if not view and "empty" not in operation._schema.name:
            self.bytes += sum(map(_bytes, given + made))
        return out


def _bytes(a: Tensor) -> int:
    stored = [size for size, stride in zip(a.shape, a.stride(), strict=True) if stride]
    return int(np.prod(stored, dtype=np.int64)) * a.element_size()


def timed(device: torch.device, what: Callable[..., Any], *given: Any) -> tuple[float, Any]:
    """Seconds until the device has done it, and its result."""
    wait(device)
    begun = time.perf_counter()
    result = what(*given)
    wait(device)
    return time.perf_counter() - begun, result


def wait(device: torch.device) -> None:
    """Until the device has done what it was asked."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def copy_rate(device: torch.device, rounds: int = 9, copies: int = 10) -> float:
    """Bytes per second that copies within the device's memory read and write: the median of some rounds."""
    size = 2**30 if device.type == "cuda" else 2**28  # bytes, far more than a cache holds
    source = torch.ones(size // 4, device=device)
    target = torch.empty_like(source)

    def several() -> None:
        for _ in range(copies):
            target.copy_(source)

    several()
    return 2 * size * copies / statistics.median(timed(device, several)[0] for _ in range(rounds))


class Pass:
    """The project's SIR filter, resampling at every step, on a record that is on the device. `engine` as in a job.

    Args:
        engine: one of ENGINES.
        model, record: on the device.
        particles: N.
        block: runs that a step takes together.
    """

    def __init__(
        self, engine: str, model: StateSpaceModel, record: Record, particles: int, block: int
    ) -> None:
        method = ParticleFilter(particles, EssResampler(Systematic(), ess_threshold=1.0))
        self.method = CompiledParticleFilter(method) if engine == "compiled" else method
        self.engine, self.model, self.record, self.block = engine, model, record, block
        self.runs = torch.arange(len(record.y), device=record.y.device)

    def __call__(self, seed: int) -> FilterResult:
        draws = PhiloxStream(seed, self.runs, self.record.y.dtype)
        with dispatch.use_kernels(self.engine != "eager"), torch.no_grad():
            return run_filter(self.method, self.model, self.record, draws, run_batch=self.block)

    @property
    def ran(self) -> str:
        """The engine, once it has run."""
        fell_back = isinstance(self.method, CompiledParticleFilter) and not self.method.is_active
        return "kernels (the step did not compile)" if fell_back else self.engine


def measure(engine: str, work: workload.Workload, device: torch.device, rounds: int) -> Measured:
    """One engine on one workload; in blocks of half as many runs, and so on, where the device's memory does not do.

    Raises:
        torch.OutOfMemoryError: not even one run fits.
    """
    model, record = model_and_record(work, torch.float32)
    model = model.to(device)
    record = record.to(model.anchor)
    (runs, steps, _), particles = record.y.shape, int(work.particles)
    block = runs if device.type == "cuda" else choose_run_batch(runs, particles, model.chart.size)
    filtered, first = None, 0.0
    while filtered is None:
        filtered = Pass(engine, model, record, particles, block)
        try:
            first, _ = timed(device, filtered, 0)
        except torch.OutOfMemoryError:
            if block == 1:
                raise
            filtered, block = None, -(-block // 2)
        if device.type == "cuda":  # what the failed pass held, and what compiling took
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats(device)
    seconds, estimate = [], None
    for seed in range(rounds):
        spent, estimate = timed(device, filtered, seed + 1)
        seconds.append(spent)
    peak = torch.cuda.max_memory_allocated(device) if device.type == "cuda" else None
    evidence = estimate.log_evidence.cpu().double().numpy() - work.log_evidence
    counted = moved(model, record, particles) if engine == "eager" else None
    if filtered.ran == "compiled" and FUSED in kernels_of(filtered):
        counted = Moved(COMPILED, 0.0)
    return Measured(
        filtered.ran, runs, particles, steps, block, first, seconds, peak, counted, evidence
    )


def kernels_of(filtered: Pass) -> set[str]:
    """Names of the hand-written CUDA kernels that a pass launches."""
    names, launch = set(), cuda.launch_kernel

    def launch_and_note(name: str, *args: Any, **options: Any) -> None:
        names.add(name.split("<")[0])
        launch(name, *args, **options)

    cuda.launch_kernel = launch_and_note
    try:
        filtered(0)
    finally:
        cuda.launch_kernel = launch
    return names


def moved(model: StateSpaceModel, record: Record, particles: int) -> Moved:
    """By the eager engine in a step of a few runs: what three steps move more than two."""
    few, counts = record.select_runs(slice(0, 4)), []
    for steps in (2, 3):
        begun = few._replace(y=few.y[:, :steps], u=_begun(few.u, steps))
        with Traffic() as traffic:
            Pass("eager", model, begun, particles, len(few.y))(0)
        counts.append(traffic.bytes)
    draws = PhiloxStream(0, torch.arange(len(few.y), device=few.y.device), few.y.dtype)
    with dispatch.use_kernels(False), Traffic() as traffic:
        draws.normal("counted", particles, model.noise_dim)
    each = len(few.y) * particles
    return Moved((counts[1] - counts[0]) / each, traffic.bytes / each)


def _begun(u: Any, steps: int) -> Any:
    return map_inputs(lambda a: a[:, :steps], u)


@np.errstate(invalid="ignore")  # of runs that were lost
def disagreements(found: Sequence[Measured]) -> list[str]:
    """Engines whose evidence differs from that of the first one of their size, which made the same draws; paired by run."""
    said = []
    for one in found:
        other = next(other for other in found if other.size == one.size)
        off = one.evidence - other.evidence
        error = off.std(ddof=1) / len(off) ** 0.5
        if not abs(off.mean()) <= TOLERANCE * error + 1e-3:
            far = f"{off.mean():.3g} +- {error:.2g}"
            said.append(
                f"{one.size}, {one.engine}: log evidence differs from {other.engine}'s by {far}"
            )
    return said


def table(found: Sequence[Measured], rate: float) -> list[str]:
    """What each engine reached at each size; `rate` is the device's copy rate, bytes per second."""
    heads = (
        "R x N x T", "engine", "s, median (range)", "particle-steps per s", "needed GB/s", "its share", "moved GB/s", "its share",
        "peak GiB", "s of the first pass", "log evidence minus exact", "evidence, exact = 1",
    )  # fmt: skip
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for one in found:
        needed, did = NEEDED * one.rate, (one.moved.whole if one.moved else 0.0) * one.rate
        ratio, root = np.exp(one.evidence), len(one.evidence) ** 0.5
        cells = (
            one.size + (f", by {one.block} runs" if one.block < one.runs else ""), one.engine,
            f"{statistics.median(one.seconds):.3g} ({min(one.seconds):.3g} to {max(one.seconds):.3g})", f"{one.rate:.3g}",
            f"{needed / 1e9:.3g}", f"{needed / rate:.2g}",
            f"{did / 1e9:.3g}" if one.moved else "-", f"{did / rate:.2g}" if one.moved else "-",
            f"{one.peak / 2**30:.2f}" if one.peak else "-", f"{one.first:.3g}",
            f"{one.evidence.mean():.2f} ± {one.evidence.std(ddof=1) / root:.2f}",
            f"{ratio.mean():.2f} ± {ratio.std(ddof=1) / root:.2f}",
        )  # fmt: skip
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def goals(found: Sequence[Measured], rate: float) -> list[str]:
    """What became of the goals, which are of the first size as it is: by its fastest engine."""
    at_size = [one for one in found if (one.runs, one.particles, one.steps) == SIZES[0]]
    if not at_size:
        return []
    best = max(at_size, key=lambda one: one.rate)
    seconds, share = statistics.median(best.seconds), NEEDED * best.rate / rate
    required, desired = (
        f"{wanted:g}, {'met' if seconds <= wanted else 'missed'}" for wanted in SECONDS
    )
    return [
        f"| {best.size}, {best.engine} | reached | required | desired |", "|---|---|---|---|",
        f"| seconds | {seconds:.3g} | {required} | {desired} |",
        f"| bytes needed, share of the copy rate | {share:.2g} | {SHARE:g}, {'met' if share >= SHARE else 'missed'} | - |",
        *([f"| bytes moved, likewise | {best.moved.whole * best.rate / rate:.2g} | - | - |"] if best.moved else []), "",
    ]  # fmt: skip


def page(
    found: Sequence[Measured], failed: Sequence[str], rate: float, device: torch.device
) -> str:
    """gpu.md."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else cpu_name()
    counted = [one.moved for one in found if one.moved and one.engine == "eager"]
    lines = [
        "# SIR on W4, large, on one device", "",
        f"15-state INS error model, single precision, systematic resampling at every step. {name} copies {rate / 1e9:.4g} GB/s, "
        f"read plus written, measured here. A step needs to move {NEEDED} bytes for each particle: its ancestor's 15 states read "
        "and its own written (120), its log weight written and read three times (16), its ancestor's number written and read "
        "(8); noise is made where it is used. Shares are of the copy rate. "
        + (
            f"What eager operations move is counted from their arguments and results: {counted[0].whole:.0f} bytes, of which "
            f"{counted[0].noise:.0f} for random numbers; by the compiled step, from its kernels: {COMPILED:.0f}. " if counted else ""
        )
        + "Evidence is unbiased: on average its ratio to the exact one is 1, and its logarithm is low by about half its "
        "variance. Written by `python benchmarks/gpu.py`.", "",
        *goals(found, rate), *table(found, rate), "",
        "**Not the same work, or none:** " + "; ".join(failed) + "." if failed else "All engines agree.", "",
        f"{name}; Python {platform.python_version()}, torch {torch.__version__}"
        + (f", CUDA {torch.version.cuda}." if device.type == "cuda" else "."), "",
    ]  # fmt: skip
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--device", default="cuda", help="cuda, or one of several as cuda:1; cpu to try it out"
    )
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument(
        "--scale",
        type=float,
        default=1.0,
        help="below 1: fewer runs, particles and steps, to try it out",
    )
    parser.add_argument("--out", type=Path, default=HERE, help="folder for gpu.md")
    chosen = parser.parse_args()
    device = torch.device(chosen.device)
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        sys.exit(
            f"device={chosen.device}: torch {torch.__version__} finds {torch.cuda.device_count()} CUDA devices here; run it "
            "where there is one, with a torch that was built for CUDA, or try it out by --device cpu --scale 0.02"
        )
    if device.type == "cpu":
        torch.set_num_threads(1)
        process_memory.keep_freed_memory()
    rate = copy_rate(device)
    found: list[Measured] = []
    failed: list[str] = []
    for runs, particles, steps in SIZES:
        size = (
            max(4, round(runs * chosen.scale)),
            max(10, round(steps * chosen.scale)),
            max(50, round(particles * chosen.scale)),
        )
        work = workload.make(*size)
        for engine in ENGINES:
            try:
                found.append(measure(engine, work, device, chosen.rounds))
            except (
                Exception
            ) as error:  # a compiler's, or memory: the other engines shall be measured all the same
                traceback.print_exc()
                failed.append(f"{engine}, {size}: {type(error).__name__}")
                continue
            print(
                f"{found[-1].size}, {engine}: {statistics.median(found[-1].seconds):.3g} s",
                file=sys.stderr,
            )
    failed += disagreements(found)
    text = page(found, failed, rate, device)
    (chosen.out / "gpu.md").write_text(text)
    print(text)
    sys.exit("; ".join(failed) if failed else 0)


if __name__ == "__main__":
    main()
