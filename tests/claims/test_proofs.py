"""Proofs: statements on the papers that need no runs, margins or choices of ours. Each quotes its equation."""

import ast
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from filter_cases import method_of
from refusals import check_refused

from pfbench.claims.claim_lines import read_proofs
from pfbench.core import PhiloxStream, Record
from pfbench.core.linear_algebra import factor
from pfbench.filter import (
    AllComponents,
    DmcController,
    EssResampler,
    GaussianFilter,
    GaussianSmoothing,
    GaussianVelocity,
    InertiaVelocity,
    LikelihoodFitness,
    MetropolisHastings,
    ParticleFilter,
    PathBlockKernel,
    PrintedFitness,
    PrintedWeighting,
    PriorStart,
    SharedGuideProposal,
    SmoothedSegment,
    SwarmLimits,
    SwarmProposal,
    Systematic,
    run_filter,
)
from pfbench.filter.linearisation import is_normal
from pfbench.model.linear_gaussian import LinearGaussian

RULES = ("ckf", "hckf", "ssrckf", "ssrhckf5", "ssr53", "mssrckf")


def linear_model() -> LinearGaussian:
    """Five errors, two of which are driven, three differences measured."""
    f = torch.eye(5).double() + 0.1 * torch.triu(torch.ones(5, 5).double(), 1)
    g = torch.tensor([[0.2, 0.0], [0.0, 0.3], [0.1, 0.0], [0.0, 0.0], [0.0, 0.1]])
    h = torch.tensor([[1.0, 0, 0, 0, 0], [0, 0, 1.0, 0, 0.5], [0.2, 1.0, 0, 0, 0]])
    return LinearGaussian(f, g, h, [1.0, 0.7, 0.4], [0.1] * 5, [1.0, 2.0, 1.0, 0.5, 0.3])


def measurements(steps: int, width: int, runs: int = 2) -> torch.Tensor:
    return PhiloxStream(5, torch.arange(runs)).normal("y", steps, width)


# the list


def test_there_are_twelve_proofs_and_each_has_its_test() -> None:
    proofs = read_proofs()
    assert [proof.id for proof in proofs] == [f"P{k}" for k in range(1, 13)]
    tree = ast.parse(Path(__file__).read_text())
    tests = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    assert {proof.test for proof in proofs} <= tests
    assert all(proof.test.startswith(f"test_{proof.id.lower()}_") for proof in proofs)
    assert all(4 < len(proof.shows.split()) <= 32 and proof.equation for proof in proofs)


# 000


def test_p11_the_printed_bandwidth_does_not_exist_for_two_states() -> None:
    """(9): h_opt = (4 / (n_x - 2))^(1/(n_x + 4)) N^(-1/(n_x + 4))."""
    printed, n = GaussianSmoothing(offset=-2), torch.tensor([[100.0]]).double()
    for states in (1, 2):
        with pytest.raises(ValueError, match="does not exist"):
            printed.bandwidth(states, n)
        base = np.float64(4.0) / (states - 2) if states != 2 else math.inf
        assert base == -4.0 or base == math.inf


def test_p12_six_noises_give_no_density_of_fifteen_states() -> None:
    """(3): w = [w_gx, w_gy, w_gz, w_ax, w_ay, w_az]; (10): x_k from a kernel; (11): min(1, beta), beta by densities.

    A gain G of 15 x 6 has rank 6 at most: moves almost surely leave the plane of G, where the density is 0.
    """
    gain = PhiloxStream(1, torch.arange(1)).normal("g", 15, 6)[0]
    assert int(torch.linalg.matrix_rank(gain)) == 6
    step = PhiloxStream(1, torch.arange(1)).normal("step", 15, 1)[0]
    joined = torch.cat([gain, step], 1)
    assert int(torch.linalg.matrix_rank(joined)) == 7  # a kernel step is no sum of noises
    model = LinearGaussian(
        torch.eye(15).double(), gain, torch.eye(4, 15).double(), [1.0] * 4, [0.0] * 15, [1.0] * 15
    )
    assert model.transition(model.origin.expand(1, 1, -1), None) is None
    move = MetropolisHastings(PathBlockKernel(3, SmoothedSegment(False)))
    method = ParticleFilter(20, EssResampler(Systematic(), 1.0), moves=(move,))
    check_refused(
        [
            (
                "must have a model with a density of x_t given x_t-1",
                lambda: run_filter(
                    method, model, Record(measurements(2, 4)), PhiloxStream(1, torch.arange(2))
                ),
            )
        ],
        remedy=False,
    )


# 001


def test_p8_the_printed_error_is_50_percent_whatever_is_estimated() -> None:
    """(20): Err = ((x_true^2 - x)^2 + (y_true^2 - y)^2) / (x_true^2 + y_true^2)^2 x 100 %, at (160 km, 160 km)."""
    true = np.array([160e3, 160e3])
    estimates = np.array([[160e3, 160e3], [0.0, 0.0], [-1e6, 1e6], [1e6, 1e6], [-1e6, -1e6]])
    err = 100 * ((true**2 - estimates) ** 2).sum(1) / (true**2).sum() ** 2
    assert np.abs(err - 50.0).max() < 0.01
    true_km = true / 1e3
    near = true_km + np.array([[0.0, 0.0], [50.0, 50.0], [-50.0, -50.0], [50.0, -50.0]])
    err_km = 100 * ((true_km**2 - near) ** 2).sum(1) / (true_km**2).sum() ** 2
    assert 49.15 < err_km.min() < err_km.max() < 49.6


@pytest.mark.parametrize("m", [5, 10, 20, 40])
def test_p9_the_printed_generator_divides_the_covariance(m: int) -> None:
    """(11): u ~ U(1/m - sqrt(3m - 3)/m, 1/m + sqrt(3m - 3)/m); (12): z = mean + u (x_k - mean), k one of m.

    E u^2 = 1/m, so the covariance is S/m. With the sum over k it would be (m - 1)/m S.
    """
    half = math.sqrt(3 * m - 3) / m
    second = half**2 / 3 + 1 / m**2
    assert second == pytest.approx(1 / m)
    assert half**2 / 3 * m == pytest.approx((m - 1) / m)
    g = np.random.default_rng(m)
    centres = g.normal(0.0, 2.0, 20_000 // m)[:, None]
    sample = centres + g.normal(size=(len(centres), m))
    means = sample.mean(1, keepdims=True)
    u = g.uniform(1 / m - half, 1 / m + half, sample.shape)
    moved = means + u * (sample - means)
    inside = (sample - means).var()
    assert sample.var() - moved.var() == pytest.approx((1 - 1 / m) * inside, abs=0.1)


def test_p10_the_printed_shift_widens_the_cloud() -> None:
    """(18): x(j) = x + (x - mean) u_j, u_j of a Halton sequence on [0, 1): E(1 + u)^2 = 7/3, E(1 + u) = 3/2."""
    u = (np.arange(100000) + 0.5) / 100000
    assert ((1 + u) ** 2).mean() == pytest.approx(7 / 3)
    assert (1 + u).mean() == pytest.approx(3 / 2)


# 002


def test_p1_every_cubature_rule_is_the_kalman_filter_on_a_linear_model() -> None:
    """(10) to (27): sums over points that are exact to degree two give the moments of a linear map."""
    for n in (5, 17):
        for name in RULES:
            xi, w = (a.double() for a in method_of(name).linearisation.points(n)[:2])
            torch.testing.assert_close(w.sum(), torch.ones(()).double())
            assert float((w @ xi).abs().max()) < 1e-12
            torch.testing.assert_close(
                xi.mT @ (w.unsqueeze(1) * xi), torch.eye(n).double(), rtol=0, atol=1e-12
            )
    model, y = linear_model(), measurements(10, 3)
    found = {name: run_filter(method_of(name), model, Record(y), PhiloxStream(1, torch.arange(2))).mean for name in (*RULES, "ekf")}  # fmt: skip
    assert max(float((found[name] - found["ekf"]).abs().max()) for name in RULES) < 1e-8


def test_p2_a_cholesky_decomposition_detects_and_does_not_guarantee() -> None:
    """ "the Cholesky decomposition ensures the positive definiteness of the covariance matrix": P = [1 2; 2 1]."""
    p = torch.tensor([[[1.0, 2.0], [2.0, 1.0]], [[1.0, 0.5], [0.5, 1.0]]]).double()
    _, ok = factor(p)
    assert ok.tolist() == [False, True]
    assert float(torch.linalg.eigvalsh(p[0]).amin()) == pytest.approx(-1.0)


def test_p3_the_weights_of_one_guide_are_equal_on_a_linear_model() -> None:
    """(2) to (4) with q = N(x+, P+): p(y | x) N(x; x-, P-) / N(x; x+, P+) = p(y), whatever x is. ESS = N."""
    for name in ("ckf", "fmcpf"):
        guide = method_of("ckf") if name == "ckf" else method_of("fmcpf").proposal.guide_filter
        assert isinstance(guide, GaussianFilter)
        method = ParticleFilter(
            50, EssResampler(Systematic(), 1.0), proposal=SharedGuideProposal(guide)
        )
        found = run_filter(
            method, linear_model(), Record(measurements(10, 3)), PhiloxStream(1, torch.arange(2))
        )
        torch.testing.assert_close(found.trace["ess"], torch.full((2, 10), 50.0).double())


# 003


def test_p4_a_fixed_gain_of_one_eleventh_gives_the_tables() -> None:
    """(27), (28), (32), (33): dU = (A'QA + R)^-1 A'Q (Y - Y^), Q = I, R = 10 I, A = I on what is measured.

    The error of a fixed gain a is a geometric series of the noise: variance a / (2 - a), 0.2182 of the noise.
    """
    model = LinearGaussian(
        torch.eye(2), torch.eye(2), torch.eye(2), [1.0, 10.0], [0.0, 0.0], [1.0, 1.0]
    )
    belief = ParticleFilter(4).init(model, 1, PhiloxStream(1, torch.arange(1)))
    h = torch.eye(2).double().expand(1, 1, 2, 2)
    gain = DmcController().compute_gain(model, belief, Record(torch.zeros(1, 2).double()), h)
    torch.testing.assert_close(gain[0, 0], torch.eye(2).double() / 11)
    a = 1 / 11
    series = sum((a * (1 - a) ** k) ** 2 for k in range(400))
    assert series == pytest.approx(a / (2 - a))
    assert math.sqrt(series) == pytest.approx(0.2182, abs=5e-5)
    velocity, position = (np.array(v) for v in ([0.2259, 0.2293, 0.2250], [1.8137, 2.1560, 2.0752]))
    assert (np.abs(velocity / (math.sqrt(series) * 1.0) - 1) < 0.06).all()
    assert (np.abs(position / (math.sqrt(series) * 10.0) - 1) < 0.17).all()


# 004


def test_p5_a_swarm_of_thirty_iterations_returns_the_fix() -> None:
    """(37) read as exp(-r'R^-1 r / 2), (38), (45): with the printed weights all particles go to its maximum, the fix.

    Section 6: 6.87 m, 7.2 m, 4.83 m and 0.20 m/s, 0.21 m/s, 0.14 m/s: one ratio, as of a receiver and its dilutions.
    """
    ratios = np.array([6.87, 7.2, 4.83]) / np.array([0.20, 0.21, 0.14])
    assert ratios == pytest.approx([34.35, 34.29, 34.50], abs=0.01)
    assert ratios.std() / ratios.mean() < 0.01
    model, y = (
        LinearGaussian([[1.0]], [[0.1]], [[1.0]], [1.0], [0.0], [1.0]),
        measurements(6, 1, 20),
    )
    swarm = SwarmProposal(
        GaussianVelocity(), None, LikelihoodFitness(), AllComponents(), SwarmLimits(True, 0.5, None), None, 30,
        PriorStart(), PrintedWeighting(),
    )  # fmt: skip
    method = ParticleFilter(40, EssResampler(Systematic(), 1.0), proposal=swarm)
    found = run_filter(method, model, Record(y), PhiloxStream(2, torch.arange(20))).mean
    optimal = run_filter(method_of("ekf"), model, Record(y), PhiloxStream(2, torch.arange(20))).mean
    from_fix, of_kalman = ((a - y)[:, 1:].square().mean().sqrt() for a in (found, optimal))
    assert from_fix < 0.1
    assert of_kalman > 5 * from_fix


def test_p6_the_printed_fitness_has_a_constant_gradient() -> None:
    """(37): Y = exp[-(z_New - z_Pred) / (2 R_k)]: d ln Y / d z_Pred = 1 / (2 R), so ln Y grows without bound."""
    model = LinearGaussian([[1.0]], [[1.0]], [[1.0]], [2.0], [0.0], [1.0])
    x = torch.tensor([[[0.0], [1.0], [2.0], [1e6]]]).double()
    value = PrintedFitness().fit_measurement(model, x, Record(torch.zeros(1, 1).double()))[0]
    assert is_normal(model.observation(x, None))
    torch.testing.assert_close(value, x[0, :, 0] / 8.0)


def test_p7_the_printed_escape_factor_is_constant() -> None:
    """(35): c3 = c4 = 0.12 - 0.12 cos(k pi) / itermax, itermax = 150, "the value curves of c3 and c4" rise to 0.24."""
    velocity = InertiaVelocity(escape_coefficient=0.12, printed_iterations=150)
    factors = np.array([velocity.compute_escape_factor(k / 150) for k in range(1, 151)])
    assert np.abs(factors - 0.12).max() == pytest.approx(0.0008)
    meant = InertiaVelocity(escape_coefficient=0.12).compute_escape_factor(1.0)
    assert meant == pytest.approx(0.24)
