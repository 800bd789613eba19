"""Forms of the papers' methods: to the letter, as printed with named completions, repaired by the law of admission."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pytest
import scipy
import torch
from checkout import ROOT
from config_cases import GROUPS, composed
from filter_cases import UNPRINTED, method_of
from model_cases import tracker
from omegaconf import OmegaConf
from refusals import check_refused

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    CountLimits,
    EssResampler,
    EssStepCount,
    FixedCount,
    GaussianSmoothing,
    LastStateKernel,
    LikelihoodRatioKernel,
    MetropolisHastings,
    ParticleBelief,
    ParticleFilter,
    SwarmProposal,
    Systematic,
    run_filter,
)
from pfbench.filter.particle.sqmc import HaltonPoints, halton_points
from pfbench.model.linear_gaussian import LinearGaussian
from pfbench.results.paper_block import (
    METHOD_FORMS,
    check_paper_blocks,
    read_paper_block,
    remove_all_blocks,
)

SEVEN = (
    "mcmc_rpf", "qmc_polymerised", "fm_mssrckf", "cofm_mssrckf", "cofm_amssrcpf", "dmc_reconstructed", "cpso_escape",
)  # fmt: skip
BLOCKS = {name: read_paper_block("filter", name) for name in GROUPS["filter"]}
STATED = [name for name, block in BLOCKS.items() if block.get("form") in ("literal", "printed")]


def method_of_form(name: str) -> str:
    """Return the method of which a filter is a form; itself for the main one."""
    return str(BLOCKS[name].get("form_of", name))


def leaves(node: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of a configuration by dotted keys."""
    if isinstance(node, Mapping | list):
        entries = node.items() if isinstance(node, Mapping) else enumerate(node)
        for key, value in entries:
            yield from leaves(value, f"{path}.{key}" if path else str(key))
    else:
        yield path, node


@cache
def settings(name: str) -> dict[str, Any]:
    """All values of a filter but its look."""
    node = OmegaConf.to_container(composed(f"filter={name}")["filter"], resolve=True)
    return {key: value for key, value in leaves(remove_all_blocks(node)) if key != "_target_"}


def has_key(name: str, key: str) -> bool:
    """Return whether a filter has a part of this key, stated in its file or by default."""
    part = method_of(name)
    for step in key.removesuffix("._target_").split("."):
        if step.isdigit():
            part = part[int(step)]
        elif not hasattr(part, step):
            return False
        else:
            part = getattr(part, step)
    return True


def keys_of(name: str, kind: str, *, misread: bool | None = None) -> list[str]:
    """Keys that a filter cites or completes; only those that are printed otherwise, or are not."""
    entries = BLOCKS[name].get(kind, ())
    if misread is not None:
        entries = [entry for entry in entries if ("printed" in entry) == misread]
    return [key for entry in entries for key in entry["keys"]]


def covers(keys: list[str], key: str) -> bool:
    return any(key == one or key.startswith(f"{one}.") for one in keys)


# what is written


def test_the_seven_methods_are_counted_once() -> None:
    """A form is no further method: the first page counts filters that are proposed and no form of another."""
    proposed = [name for name, block in BLOCKS.items() if block["proposed"]]
    assert sorted(name for name in proposed if "form_of" not in BLOCKS[name]) == sorted(SEVEN)
    assert {method_of_form(name) for name in proposed} == set(SEVEN)
    assert all(BLOCKS[name].get("form") in METHOD_FORMS for name in proposed)
    assert all(method_of_form(name) in BLOCKS for name in BLOCKS)


@pytest.mark.parametrize("method", SEVEN)
def test_each_method_has_its_forms(method: str) -> None:
    forms = {BLOCKS[name].get("form") for name in BLOCKS if method_of_form(name) == method}
    assert forms >= {"literal", "printed"}
    assert ("repaired" in forms) == (method != "dmc_reconstructed")  # no repair of it is admitted
    assert BLOCKS[f"{method}_literal"]["form"] == "literal"


def test_names_say_the_form() -> None:
    for name, block in BLOCKS.items():
        for form in ("literal", "printed"):
            assert not name.endswith(f"_{form}") or block.get("form") == form, name
        assert (block.get("form") == "literal") == name.endswith("_literal"), name


@pytest.mark.parametrize("name", [name for name in STATED if name not in UNPRINTED])
def test_no_value_of_a_stated_form_is_silent(name: str) -> None:
    """Each is printed, with its place, or completed, with a reason; and what is listed exists."""
    cited, completed = keys_of(name, "cites"), keys_of(name, "completions")
    silent = [key for key in settings(name) if not covers([*cited, *completed], key)]
    assert silent == []
    assert [key for key in (*cited, *completed) if not has_key(name, key)] == []
    entries = (*BLOCKS[name]["cites"], *BLOCKS[name]["completions"])
    assert all(len(entry.get("place", entry.get("why", "")).split()) > 1 or "eq" in entry["place"] for entry in entries)  # fmt: skip


LITERAL = [name for name in STATED if name.endswith("_literal") and name not in UNPRINTED]


@pytest.mark.parametrize("name", LITERAL)
def test_a_literal_form_changes_nothing_that_is_printed(name: str) -> None:
    """And all in which the printed form differs from it stands in the list of that form, with what is printed."""
    assert keys_of(name, "completions", misread=True) == []
    base = method_of_form(name)
    other = f"{base}_printed" if f"{base}_printed" in BLOCKS else base
    if BLOCKS[other].get("form") != "printed":
        return
    one, two = settings(name), settings(other)
    differing = [key for key in {**one, **two} if one.get(key, None) != two.get(key, None)]
    assert differing
    named = keys_of(other, "completions", misread=True)
    assert [key for key in differing if not covers(named, key)] == []


@pytest.mark.parametrize(
    ("entry", "key"),
    [
        ({"form": "mended"}, "form must be one of literal, printed, repaired, variant"),
        ({"form_of": 3}, "form_of must be a text"),
        ({"cites": [{"keys": ["a"]}]}, "cites must be a list of entries with keys, place"),
        ({"cites": [{"keys": [], "place": "eq. 1"}]}, "cites must be a list"),
        ({"completions": [{"keys": "a", "why": "b"}]}, "completions must be a list"),
        ({"completions": [{"keys": ["a"], "why": "b", "by": "c"}]}, "keys, why, perhaps printed"),
        ({"completions": [{"keys": ["a"], "why": "b", "printed": 2}]}, "all others texts"),
    ],
)
def test_entries_that_are_no_forms_are_told(entry: dict[str, Any], key: str) -> None:
    check_refused([(key, lambda: check_paper_blocks({"filter": {"paper": entry}}))], remedy=False)


# what each literal form computes


@pytest.mark.parametrize("name", UNPRINTED)
def test_a_form_whose_equations_are_lost_refuses_and_names_the_one_that_completes_it(
    name: str,
) -> None:
    """002: "transforms equation (16) into:" and "Equations (23), (24), and (27) are modified as follows:" end there."""
    method, model = method_of(name), tracker()
    check_refused(
        [
            (
                rf"filter={name} must have equations.*lost.* Choose filter=",
                lambda: run_filter(
                    method, model, Record(torch.zeros(1, 2, 2)), PhiloxStream(1, torch.arange(1))
                ),
            )
        ],
        remedy=False,
    )
    assert method.name == name
    assert BLOCKS[method.instead]["form"] == "printed"


def test_equation_9_of_000_as_printed_has_no_bandwidth_for_two_states() -> None:
    """h_opt = (4 / (n_x - 2))^(1/(n_x + 4)) N^(-1/(n_x + 4)), n_x the size of the state vector, 16."""
    n = torch.tensor([[500.0]], dtype=torch.float64)
    literal = method_of("rpf_literal").resampler
    assert not literal.shrink_to_mean
    for kernel in (
        literal.kernel,
        method_of("mcmc_rpf_literal").moves[0].kernel.random_walk.smoothing,
    ):
        assert float(kernel.bandwidth(15, n)) == pytest.approx(
            (4 / 14) ** (1 / 20) * 500 ** (-1 / 20)
        )
    printed = GaussianSmoothing(offset=-2)
    for d in (1, 2):
        with pytest.raises(ValueError, match=r"kernel.offset must exceed .* Use 2"):
            printed.bandwidth(d, n)
    assert float(printed.bandwidth(3, n)) == pytest.approx(4 ** (1 / 7) * 500 ** (-1 / 7))


def half_seen() -> LinearGaussian:
    """Two states without noise that matters, of which one is measured: the other spreads where a move forgets it."""
    return LinearGaussian(
        [[1.0, 0.0], [0.0, 1.0]],
        [[0.3, 0.0], [0.0, 0.3]],
        [[1.0, 0.0]],
        [1.0],
        [0.0, 0.0],
        [1.0, 1.0],
    )


def test_acceptance_by_likelihoods_alone_runs_anywhere_and_widens_what_is_not_measured() -> None:
    """000: "As the Gaussian regularization Kernel is symmetric, the proposed distribution ratio is reduced to" (lost).

    The true variance of the second state grows by 0.09 a step, to 1.9 after 10. With the transition density the
    moves keep it; without it they add that of the kernel, 0.17 of the cloud's at 400 particles, in each step.
    """
    model, y = half_seen(), torch.zeros(20, 10, 1, dtype=torch.float64)
    variance = {}
    for kernel in (LikelihoodRatioKernel(), LastStateKernel()):
        method = ParticleFilter(
            400, EssResampler(Systematic(), 1.0), moves=(MetropolisHastings(kernel),)
        )
        found = run_filter(method, model, Record(y), PhiloxStream(3, torch.arange(20)))
        assert not bool(found.lost.any())
        variance[type(kernel)] = found.variance[:, -1, 1]
        assert not LikelihoodRatioKernel.is_exact
    truth, spread = 1.0 + 10 * 0.09, {kind: v.std() / 20**0.5 for kind, v in variance.items()}
    assert abs(variance[LastStateKernel].mean() - truth) < 4 * spread[LastStateKernel] + 0.02
    assert variance[LikelihoodRatioKernel].mean() > truth + 8 * spread[LikelihoodRatioKernel]


def test_one_halton_set_of_001_is_the_same_in_each_draw() -> None:
    """ "Based on the example of the HALTON sequence": 1/2, 1/4, 3/4 in base 2; a shift is not printed."""
    points = method_of("qmc_polymerised_literal").points
    assert points == method_of("qmc_polymerised_literal").resampler.placement.points
    assert points == HaltonPoints(0, False, False)
    assert not points.is_exact
    draws = [
        points(PhiloxStream(seed, torch.arange(3), step=seed)).uniform("a", 5, 2) for seed in (1, 2)
    ]
    base = halton_points(0, 5, range(2)).T.expand(3, -1, -1)
    for drawn in draws:
        torch.testing.assert_close(drawn, base)
    assert base[0, :3, 0].tolist() == [0.5, 0.25, 0.75]


def test_the_printed_number_of_002_falls_to_its_minimum_for_good() -> None:
    """Step (3) "Calculate the effective sample size" stands before step (4) "The weight calculation formula"."""
    for name in ("cofm_amssrcpf_printed", "cofm_amssrcpf_each_printed"):
        assert method_of(name).particle_count.before_weights
    x, limits = torch.zeros(1, 30, 1, dtype=torch.float64), CountLimits(12, 30, 20)
    log_w = torch.full((1, 30), -math.inf, dtype=torch.float64)
    log_w[0, :20] = -torch.arange(20.0).double()  # ESS 1.3
    belief = ParticleBelief(x, log_w.log_softmax(1), torch.zeros(1, dtype=torch.float64))
    assert int(EssStepCount(5, 0.5, limits)(belief)) == 25
    assert int(EssStepCount(5, 0.5, limits, before_weights=True)(belief)) == 15


def test_the_printed_guide_of_002_is_that_of_akhlaghi() -> None:
    """The formulas of Q and R are lost; the printed form has those of the likely source, not the repaired ones."""
    guide = method_of("cofm_mssrckf_akhlaghi")
    for name in ("cofm_amssrcpf_printed", "cofm_amssrcpf_each_printed"):
        assert method_of(name).proposal.guide_filter == guide
    assert method_of("cofm_amssrcpf").proposal.guide_filter == method_of("cofm_mssrckf")


# the law of admission


class Case(NamedTuple):
    """Published study of a paper's world at its number of particles, and the labels of form, printed form and SIR."""

    study: str
    form: str
    others: tuple[str, ...]
    reference: str = "ekf"


KAPPA = "[model.process_noise_factor=1.0]"  # the sensors' own noise
CASES = {
    "mcmc_rpf": Case("paper_000", "mcmc_rpf", ("sir",)),  # its printed form refuses the world
    "qmc_polymerised": Case("paper_001", "qmc_polymerised", ("qmc_polymerised_printed", "sir_printed")),
    "fm_mssrckf": Case("paper_002_fading", "fm_mssrckf[noise_adaptations.0.fading_factor=1.002]", ()),
    "cofm_mssrckf": Case("paper_002", "cofm_mssrckf", ()),
    "cofm_amssrcpf": Case("paper_002", "cofm_amssrcpf", ("cofm_amssrcpf_printed",), "cofm_mssrckf"),
    "dmc_reconstructed": Case(
        "paper_003", f"dmc_reconstructed{KAPPA}", (f"dmc_reconstructed_printed{KAPPA}", f"sir_printed{KAPPA}")
    ),
    "cpso_escape": Case("paper_004", "cpso_escape", ("cpso_escape_printed", "sir")),
}  # fmt: skip


def keeps_as_often(runs: pd.DataFrame, form: str, others: tuple[str, ...]) -> bool:
    """Return whether a form keeps track in at least as many runs as the others, in each world; in all without others."""
    kept = runs.groupby(["filter", "scenario", "regime"])["keeps_track"].agg(["sum", "size"])
    own = kept.loc[form]
    if not others:
        return bool((own["sum"] == own["size"]).all())
    return all(bool((own["sum"] >= kept.loc[other]["sum"]).all()) for other in others)


def distance_to(reference: str, name: str, n: int) -> float:
    """Root mean square distance of the estimate with n particles to a reference, on a linear model, 40 runs."""
    model, y = tracker(), PhiloxStream(8, torch.arange(40)).normal("y", 6, 2)
    method = method_of(name)
    if isinstance(method, ParticleFilter):
        method = replace(method, particles=n, particle_count=FixedCount())
    one, two = (
        run_filter(m, model, Record(y), PhiloxStream(3, torch.arange(40))).mean
        for m in (method, method_of(reference))
    )
    return float((one - two).square().mean().sqrt())


def test_only_a_form_that_keeps_track_in_its_paper_s_world_is_called_repaired() -> None:
    """From the published runs: the DMC particle filter keeps track in 0 of 50 where the printed form does in 50."""
    called = {name for name, block in BLOCKS.items() if block.get("form") == "repaired"}
    admitted = {
        name for name, case in CASES.items()
        if keeps_as_often(pd.read_parquet(ROOT / "reports" / case.study / "runs.parquet"), case.form, case.others)
    }  # fmt: skip
    assert called == admitted
    assert set(CASES) - admitted == {"dmc_reconstructed"}


@pytest.mark.parametrize("name", [name for name in CASES if not name.endswith("mssrckf")])
def test_a_repaired_form_comes_nearer_to_the_reference_with_its_number(name: str) -> None:
    """With sixteen times the particles the distance falls by a factor of 4 by the root of N; 2 is asked for."""
    near, far = (distance_to(CASES[name].reference, name, n) for n in (640, 40))
    assert near < 0.5 * far


def test_the_law_refuses_a_form_that_loses_a_run_more() -> None:
    rows = [("form", k < 9) for k in range(10)] + [("sir", k < 9) for k in range(10)]
    runs = pd.DataFrame(rows, columns=["filter", "keeps_track"]).assign(scenario="a", regime="b")
    assert keeps_as_often(runs, "form", ("sir",))
    assert not keeps_as_often(runs, "form", ())
    runs.loc[0, "keeps_track"] = False
    assert not keeps_as_often(runs, "form", ("sir",))


# a step of each form from the equations, by numpy, from the same random numbers


class Equations:
    """Steps of a form on the tracker from the equations of its paper: particles x [N, 2] and weights w [N]."""

    def __init__(self, name: str, x: np.ndarray, active: int) -> None:
        model = tracker()
        self.name, self.slots, self.x = name, len(x), x[:active]
        self.log_w = np.full(active, -math.log(active))
        self.f, self.g, self.h, self.r = (a.numpy() for a in (model.f, model.g, model.h, model.r))
        self.q, self.noise = self.g @ self.g.T, np.diag(self.r**2)
        self.shift = np.zeros_like(x)
        self.chaos: Any = None
        self.path, self.past = self.x[:, None], list[np.ndarray]()
        law = model.initial(1)
        first = (law.covariance_matrix[0].numpy(), 1.0, np.zeros((2, 2)), np.zeros((2, 2)))
        self.mean, self.learned = law.mean[0].numpy(), [first] * active

    @property
    def w(self) -> np.ndarray:
        return np.exp(self.log_w)

    def draw(self, kind: str, label: str, n: int, k: int) -> np.ndarray:
        return np.asarray(getattr(self.draws, kind)(label, n, k)[0])

    def choose(self, literal: bool) -> np.ndarray:
        """Ancestors: with replacement, or systematic."""
        n = len(self.w)
        u = self.draw("uniform", "resample", n if literal else 1, 1)[:, 0]
        return np.searchsorted(np.cumsum(self.w), u if literal else (np.arange(n) + u) / n, "right")

    def predict(self, x: np.ndarray) -> np.ndarray:
        return x @ self.f.T + self.draw("normal", "noise", len(x), 2) @ self.g.T

    def weigh(self, x: np.ndarray, log_w: np.ndarray) -> None:
        log_w = log_w - 0.5 * (((self.y - x @ self.h.T) / self.r) ** 2).sum(1)
        self.x, self.log_w = x, log_w - scipy.special.logsumexp(log_w)

    def step(self, draws: PhiloxStream, y: np.ndarray) -> None:
        self.draws, self.y, literal = draws, y, self.name.endswith("_literal")
        if self.name.startswith(("pso", "cpso")):
            return self.swarm(literal)
        if self.name.startswith("qmc"):
            return self.polymerise(literal)
        if self.name.startswith(("cpf", "fmcpf", "cofm")):
            return self.propose_by_guides()
        n, each = len(self.w), literal or self.name.startswith(("sir", "dmc"))
        each &= not self.name.startswith("thompson")
        resamples = each or 1 / (self.w**2).sum() < n / 2
        with_replacement = self.name in ("sir_literal", "dmc_reconstructed_literal")
        chosen = self.choose(with_replacement) if resamples else np.arange(n)
        x = self.x[chosen]
        if self.name.startswith("rpf") and resamples and np.ptp(self.w) > 0:  # 000, eqs 7 to 9
            base, nx = (4 / 14, 16) if literal else (1.0, 2)
            h = (
                (0.5 if self.name == "rpf_half" else 1.0)
                * base ** (1 / (nx + 4))
                * n ** (-1 / (nx + 4))
            )
            root = np.linalg.cholesky(np.cov(self.x.T, aweights=self.w, ddof=0))
            x = x + h * self.draw("normal", "regularise", n, 2) @ root.T
        if self.name.startswith("thompson") and resamples:  # 001, eqs 11 and 12, one neighbour
            x = self.combine(x)
        if self.name.startswith("mcmc"):
            self.path = self.path[chosen]
            x = self.move(literal) if resamples and self.past else x
        x = self.predict(x)
        if self.name.startswith(
            "dmc"
        ):  # 003, eqs 27, 28 with Q = I, R = 10 I, and "+ B U" of step V
            x = x + literal * self.shift[chosen]
            gain = np.linalg.solve(self.h.T @ self.h + 10 * np.eye(2), self.h.T)
            self.shift = (y - x @ self.h.T) @ gain.T
            x = x + self.shift
        self.weigh(x, 0 * self.log_w if resamples else self.log_w)
        self.path = np.concatenate([self.path, x[:, None]], 1)[:, -5:]
        self.past = [*self.past, y][-4:]

    def move(self, literal: bool) -> np.ndarray:
        """000, eqs 10 to 13: the child from the kernel, its parents from p(parents | y), and the ratio of the child."""

        def score(x: np.ndarray, parent: np.ndarray) -> np.ndarray:
            off, jump = (self.past[-1] - x @ self.h.T) / self.r, np.linalg.solve(self.g, (x - parent @ self.f.T).T)  # fmt: skip
            by_likelihood = self.name == "mcmc_rpf_likelihood"
            return -0.5 * ((off**2).sum(1) + (0.0 if by_likelihood else (jump**2).sum(0)))

        path, n, label = self.path.copy(), len(self.path), "move_0.sweep_0."
        base, nx = (4 / 14, 16) if literal else (1.0, 2)
        root = np.linalg.cholesky(np.cov(path[:, -1].T, ddof=0))
        h = base ** (1 / (nx + 4)) * n ** (-1 / (nx + 4))
        path[:, -1] += h * self.draw("normal", f"{label}walk", n, 2) @ root.T
        m, p, filtered = path[:, 0], np.zeros((2, 2)), []
        for y in self.past[:-1] if "likelihood" not in self.name else ():
            m, p = m @ self.f.T, self.f @ p @ self.f.T + self.q
            gain = p @ self.h.T @ np.linalg.inv(self.h @ p @ self.h.T + self.noise)
            m, p = m + (y - m @ self.h.T) @ gain.T, p - gain @ self.h @ p
            filtered.append((m, p))
        for j in reversed(range(len(filtered))):
            m, p = filtered[j]
            if j < len(filtered) - 1:
                gain = p @ self.f.T @ np.linalg.inv(self.f @ p @ self.f.T + self.q)
                m, p = m + (path[:, j + 2] - m @ self.f.T) @ gain.T, p - gain @ self.f @ p
            z = self.draw("normal", f"{label}block_{j}", n, 2)
            path[:, j + 1] = m + z @ np.linalg.cholesky(p).T
        gained = score(path[:, -1], path[:, -2]) - score(self.path[:, -1], self.path[:, -2])
        accepted = np.log(self.draw("uniform", f"{label}accept", n, 1)[:, 0]) < gained
        self.path = np.where(accepted[:, None, None], path, self.path)
        return self.path[:, -1]

    def polymerise(self, literal: bool) -> None:
        """001, section 3.2 and eqs 16 to 19: cells keep their counts, and particles move from the mean by Halton's numbers."""
        x, log_w, n = self.x, self.log_w, len(self.x)
        if np.ptp(self.w) > 1e-12:
            mean = self.w @ x
            place = 8 * (x - x.min(0)) / np.ptp(x, axis=0)
            cells = np.minimum(place, 7.5).astype(int) @ [8, 1]
            skip = 1 if literal else 21
            u = scipy.stats.qmc.Halton(2, scramble=False).random(n + skip)[skip:]
            u = u if literal else (u + self.draw("uniform", "polymer", 1, 2)) % 1
            placed, weights, used = [], [], 0
            for cell in np.unique(cells):
                own, count = cells == cell, int((cells == cell).sum())
                total = self.w[own].sum()
                centre = self.w[own] @ x[own] / total - mean
                moves = np.concatenate([np.zeros((1, 2)), u[used : used + count - 1]])
                placed.append(mean + centre * (1 + moves))
                weights.append(np.full(count, np.log(total / count)))
                used += count - 1
            x, log_w = np.concatenate(placed), np.concatenate(weights)
        self.weigh(self.predict(x), log_w)

    def guide(self, m: np.ndarray, learned: Any) -> tuple[np.ndarray, np.ndarray, Any]:
        """002: a Kalman filter with fading memory (eq. 29), R and Q of Akhlaghi, the factor of Yang, and a bound."""
        p, kept, r, q = learned
        fading = {"cpf": 1.0, "fmcpf": 1.01}.get(self.name.partition("_")[0], 1.002)
        p = fading * self.f @ p @ self.f.T + kept * self.q + q
        noise, v = kept * self.noise + r, self.y - self.h @ self.f @ m
        s = self.h @ p @ self.h.T
        gain = p @ self.h.T @ np.linalg.inv(s + noise)
        factor = np.clip(np.sqrt(v @ v / np.trace(s + noise)) / 1.5, 1.0, 10.0)
        if self.name.startswith("cofm"):
            e, after, shift = v - self.h @ gain @ v, p - gain @ self.h @ p, gain @ v
            r = 0.99 * r + 0.01 * (np.outer(e, e) + self.h @ after @ self.h.T)
            kept, q = 0.99 * kept, 0.99 * q + 0.01 * np.outer(shift, shift)
            factor = min(factor, max(1 / (np.diag(s) / np.diag(noise)).max(), 1.0))
        if not self.name.startswith(("cpf", "fmcpf")):
            p = factor * p
            gain = p @ self.h.T @ np.linalg.inv(self.h @ p @ self.h.T + noise)
        seen = self.h @ (lower := np.linalg.cholesky(p))
        information = np.eye(2) + seen.T @ np.linalg.solve(noise, seen)
        root = lower @ np.linalg.inv(np.linalg.cholesky(information).T)
        return self.f @ m + gain @ v, root, (p - gain @ self.h @ p, kept, r, q)

    def propose_by_guides(self) -> None:
        """002, steps 1 to 6 of the particle filter: a guide for each particle, or one for all."""

        def log_normal(x: np.ndarray, m: np.ndarray, p: np.ndarray) -> float:
            return float(scipy.stats.multivariate_normal.logpdf(x, m, p))

        n, each = len(self.x), "each" in self.name
        n = max(n - 10, 100) if self.name.startswith("cofm") else n
        u = self.draw("uniform", "resample", 1, 1)[:, 0]
        chosen = np.searchsorted(np.cumsum(self.w), (np.arange(n) + u) / n, "right")
        z, x, log_w = self.draw("normal", "guide", self.slots, 2)[:n], np.zeros((n, 2)), np.zeros(n)
        parents, learned = self.x[chosen], [self.learned[i] for i in chosen]
        before, cov = self.mean, self.learned[0][0]
        for i in range(n):
            if each or i == 0:
                m, root, learned[i] = self.guide(parents[i] if each else before, learned[i])
            x[i] = m + root @ z[i]
            prior = (self.f @ parents[i], self.q) if each else (self.f @ before, self.f @ cov @ self.f.T + self.q)  # fmt: skip
            log_w[i] = log_normal(x[i], *prior) - log_normal(x[i], m, root @ root.T)
        self.mean, self.learned = m, learned if each else [learned[0]] * n
        self.weigh(x, log_w)
        if self.name.startswith("cofm"):  # entropy regularisation of strength 0.5
            self.log_w = self.log_w / 1.5 - scipy.special.logsumexp(self.log_w / 1.5)

    def combine(self, x: np.ndarray, m: int = 20) -> np.ndarray:
        root = np.linalg.cholesky(np.cov(self.x.T, aweights=self.w, ddof=0))
        white = np.linalg.solve(root, x.T).T
        apart = np.linalg.norm(white[:, None] - white, axis=2)
        near = np.sort(np.argsort(apart, 1, kind="stable")[:, :m], 1)
        centre = x[near].mean(1)
        u = 1 / m + np.sqrt(3 * (m - 1)) / m * (
            2 * self.draw("uniform", "neighbours", len(x), m)[:, :1] - 1
        )
        k = (m * self.draw("uniform", "neighbour", len(x), 1)[:, 0]).astype(int)
        return centre + u * (x[near[np.arange(len(x)), k]] - centre)

    def swarm(self, literal: bool) -> None:
        """004, eqs 29 to 44, steps a to f."""
        n, chaotic, count = len(self.w), self.name.startswith("cpso"), 6
        if self.chaos is None:
            self.scale, low, high = self.x.std(0), self.x.min(0), self.x.max(0)
            seed = (
                self.draw("uniform", "swarm.chaos", *((1, 1) if literal else (n, 2)))
                if chaotic
                else np.zeros((n, 2))
            )
            quarter = np.floor(4 * seed) / 4
            self.chaos = quarter + 1e-3 + (seed - quarter) * 0.992
            if chaotic and literal:
                values = [4 * self.chaos[0] * (1 - self.chaos[0])]
                for _ in range(n - 1):
                    values.append(4 * values[-1] * (1 - values[-1]))
                self.chaos = np.repeat(values, 2, 1)
            for _ in range(0 if literal else 50):
                self.chaos = 4 * self.chaos * (1 - self.chaos)
            if chaotic:
                self.x = low + (high - low) * self.chaos
        else:
            chosen = np.arange(n) if literal else self.choose(False)
            self.x, self.log_w = self.x[chosen], self.log_w * literal
        x = self.predict(self.x)
        v = np.zeros_like(x)

        def fit(q: np.ndarray) -> np.ndarray:
            off = self.y - q @ self.h.T
            printed = literal and chaotic
            return (-off / (2 * self.r**2) if printed else -0.5 * (off / self.r) ** 2).sum(1)

        value = top = bottom = fit(x)
        best = worst = x
        for i in range(1, count + 1):
            label, lead = f"swarm.velocity.{i}", best[top.argmax()]
            if chaotic:
                r = self.draw("uniform", label, n, 8 if "pf" not in self.name else 4).reshape(
                    n, -1, 2
                )
                after = 0.8 * v + 1.2 * r[:, 0] * (best - x) + 1.2 * r[:, 1] * (lead - x)
                if "pf" not in self.name:
                    k = 25 * i  # of 150
                    c = 0.12 * (
                        1 - np.cos(np.pi * k) / 150 if literal else 1 - np.cos(np.pi * i / count)
                    )
                    after = after - c * (r[:, 2] * (worst - x) + r[:, 3] * (x[value.argmin()] - x))
            else:
                r = np.abs(self.draw("normal", label, n, 4)).reshape(n, 2, 2)
                after = r[:, 0] * (best - x) + r[:, 1] * (lead - x)
            after = np.clip(after, -3 * self.scale, 3 * self.scale)
            x, v = x + (v if literal else after), after
            value = fit(x)
            if chaotic:
                self.chaos = 4 * self.chaos * (1 - self.chaos)
                other = x + 0.3 * self.scale * (2 * self.chaos - 1)
                better = fit(other) > value
                x, value = np.where(better[:, None], other, x), np.maximum(fit(other), value)
            best, top = np.where((value > top)[:, None], x, best), np.maximum(value, top)
            worst, bottom = np.where((value < bottom)[:, None], x, worst), np.minimum(value, bottom)
        self.weigh(x, self.log_w)


PRINTED = (
    "sir_literal", "sir_printed", "rpf_literal", "rpf_printed", "rpf_half", "thompson_taylor_literal",
    "dmc_reconstructed_literal", "dmc_reconstructed_printed", "pso_pf_literal", "pso_pf", "cpso_pf",
    "cpso_escape_literal", "cpso_escape_printed", "mcmc_rpf_literal", "mcmc_rpf_printed", "mcmc_rpf_likelihood",
    "qmc_polymerised_literal", "qmc_polymerised_printed", "cpf_each", "fmcpf_each", "cofm_amssrcpf_each_printed",
    "cofm_amssrcpf_printed",
)  # fmt: skip
Y = torch.tensor(
    [[0.9, -1.4], [2.5, 1.0], [-0.4, 0.7], [1.6, 3.0], [-1.0, 0.5], [2.0, -2.0], [0.3, 1.1]],
    dtype=torch.float64,
)


@pytest.mark.filterwarnings("ignore:ParticleGuideProposal")
@pytest.mark.parametrize("name", PRINTED)
def test_a_step_is_that_of_the_equations_of_the_paper(name: str) -> None:
    """Several steps, so that what a step leaves for the next counts, and weights that are uneven; to 1e-12."""
    method, model, draws = method_of(name), tracker(), PhiloxStream(5, torch.arange(1))
    method = replace(method, particles=200 if name.startswith("cofm") else 40)
    if isinstance(method.proposal, SwarmProposal):
        method = replace(method, proposal=replace(method.proposal, iterations=6))
    belief = method.init(model, 1, draws.at_step(0))
    equations = Equations(name, belief.x[0].numpy(), int(belief.log_w.isfinite().sum()))
    for t, y in enumerate(Y[: 7 if name.startswith("mcmc") else 4]):
        at = draws.at_step(t + 1)
        belief, _ = method.step(model, belief, Record(y[None]), at)
        equations.step(at, y.numpy())
        active = belief.log_w[0].isfinite()
        np.testing.assert_allclose(belief.x[0][active].numpy(), equations.x, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(
            belief.log_w[0][active].numpy(), equations.log_w, rtol=1e-12, atol=1e-11
        )


@pytest.mark.parametrize("name", ["fm_mssrckf_printed", "cofm_mssrckf_akhlaghi"])
def test_a_step_of_a_guide_is_that_of_the_equations_of_the_paper(name: str) -> None:
    method, model, draws = method_of(name), tracker(), PhiloxStream(5, torch.arange(1))
    belief = method.init(model, 1, draws.at_step(0))
    equations = Equations(name, belief.mean.numpy(), 1)
    for t, y in enumerate(Y):
        belief, _ = method.step(model, belief, Record(4 * y[None]), draws.at_step(t + 1))
        equations.y = 4 * y.numpy()  # far off, so that the adaptive factor acts
        equations.mean, root, equations.learned[0] = equations.guide(equations.mean, equations.learned[0])  # fmt: skip
        np.testing.assert_allclose(belief.mean[0].numpy(), equations.mean, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(
            belief.covariance[0].numpy(), root @ root.T, rtol=1e-11, atol=1e-12
        )
