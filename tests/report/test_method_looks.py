"""Names and looks of the configuration files: distinct, readable, and the same in every figure."""

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pfbench.job.config import compose
from pfbench.results.conditions import Condition, JobFile
from pfbench.results.looks import MethodLook, describe_settings, find_looks, study_looks
from pfbench.results.paper_block import (
    FAMILIES,
    OWN_WORLD,
    check_paper_blocks,
    list_named_parts,
    plan_installed_pairs,
    read_paper_block,
    remove_nested_blocks,
)
from pfbench.results.plotting import line_styles

METHODS = list_named_parts("filter")
LOOKS = find_looks(METHODS)
GROUNDS = {"colour": "#ffffff", "dark_colour": "#14181c"}
# Machado, Oliveira, Fernandes 2009, severity 1: protanopia, deuteranopia, tritanopia
VISION = (
    np.eye(3),
    np.array([[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]),
    np.array([[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]),
    np.array([[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]),
)  # fmt: skip
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
LEAST_DIFFERENCE = 9.0  # of CIELAB; 2.3 is just noticeable for large areas side by side


def linear(colour: str) -> np.ndarray:
    value = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def contrast(a: str, b: str) -> float:
    """Contrast of two colours, WCAG 2.2."""
    dark, light = sorted(float(TO_XYZ[1] @ linear(colour)) for colour in (a, b))
    return (light + 0.05) / (dark + 0.05)


def to_lab(rgb: np.ndarray) -> np.ndarray:
    x = TO_XYZ @ rgb / np.array([0.9505, 1.0, 1.089])
    f = np.where(x > 0.008856, np.cbrt(np.maximum(x, 0.0)), 7.787 * x + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def least_difference(a: str, b: str) -> float:
    """Least CIELAB difference of two colours over normal vision and three deficiencies."""
    seen = [[to_lab(np.clip(m @ linear(c), 0, 1)) for c in (a, b)] for m in VISION]
    return min(float(np.linalg.norm(x - y)) for x, y in seen)


def test_the_measures_of_colour_know_known_values() -> None:
    assert contrast("#000000", "#ffffff") == pytest.approx(21.0)
    assert contrast("#767676", "#ffffff") == pytest.approx(4.54, abs=0.01)
    assert np.allclose(to_lab(linear("#ff0000")), [53.24, 80.09, 67.20], atol=0.1)
    # red and green of equal brightness: far for normal vision, near for deuteranopia
    assert least_difference("#c00000", "#6b6b00") < 15 < np.linalg.norm(
        to_lab(linear("#c00000")) - to_lab(linear("#6b6b00"))
    )  # fmt: skip


OPTIONAL = {"knob", "tuning", "summary", "form", "form_of", "cites", "completions"}


def test_every_method_states_its_own_name_and_look() -> None:
    keys = {
        "name", "long_name", "family", "proposed", "colour", "marker", "cite", "baselines"
    }  # fmt: skip
    blocks = {m: read_paper_block("filter", m) for m in METHODS}
    assert [m for m in METHODS if set(blocks[m]) - OPTIONAL != keys] == []
    summaries = {m: str(block["summary"]) for m, block in blocks.items() if "summary" in block}
    assert len(summaries) == 7  # the methods of the papers, for the first page of a study
    assert all(
        blocks[m]["proposed"] and 5 < len(text.split()) < 20 for m, text in summaries.items()
    )
    for method in METHODS:
        check_paper_blocks({"filter": {"paper": read_paper_block("filter", method)}})
    assert len({look.name for look in LOOKS.values()}) == len(METHODS)
    assert {look.family for look in LOOKS.values()} == set(FAMILIES)
    assert {key for key, look in LOOKS.items() if look.baselines} == {
        "mcmc_rpf", "qmc_polymerised", "fm_mssrckf", "cofm_mssrckf", "cofm_amssrcpf",
        "dmc_reconstructed", "cpso_escape",
    }  # fmt: skip


def test_scenarios_and_regimes_state_their_names() -> None:
    for group, keys in (("scenario", {"name", "words"}), ("noise", {"name", "words"})):
        blocks = {name: read_paper_block(group, name) for name in list_named_parts(group)}
        assert {name for name, block in blocks.items() if not keys <= set(block)} == set()
        assert len({block["name"] for block in blocks.values()}) == len(blocks)


def test_a_study_of_several_worlds_names_the_data_of_all_tunings() -> None:
    def condition(scenario: str, tuning: str) -> Condition:
        paper = {"name": "Gated EKF (tuned)", **({"tuning": tuning} if tuning else {})}
        meta = {"config": {"filter": {"paper": paper}}}
        return Condition(scenario, "nominal", "", (JobFile(Path("a"), "gate_tuned", meta),))

    worlds = [condition("a", "a (seed 1001)"), condition("b", "b (seed 1001)")]
    tunings = {
        study_looks(conditions)["gate_tuned"].tuning
        for conditions in (worlds, [*worlds, *worlds], [*worlds, condition("c", "")])
    }
    assert tunings == {"a (seed 1001), b (seed 1001)"}
    assert find_looks(["gate_tuned"])["gate_tuned"].tuning == OWN_WORLD


def test_the_name_of_a_filter_says_on_which_other_world_it_was_tuned() -> None:
    """From the data that a result stores: results of earlier versions have the same name everywhere."""

    def name(
        scenario: str, tuning: str, model: str = "m", stored: str = "Gated EKF (tuned)"
    ) -> str:
        filter_node = {"paper": {"name": stored, "tuning": tuning}}
        meta = {"config": {"filter": filter_node}, "choices": {"model": model}}
        job = JobFile(Path("a"), "gate_tuned", meta)
        return study_looks([Condition(scenario, "nominal", "", (job,))])["gate_tuned"].name

    data = "a (model m, seed 1001, 20 runs; noise: nominal)"
    assert name("a", data) == name("a[x=1]", data) == "Gated EKF (tuned)"
    assert name("b", data) == "Gated EKF (tuned on a)"
    assert name("a", data, "n") == "Gated EKF (tuned on a with m)"
    said = "Gated EKF (tuned on a with other settings)"
    assert name("a", data, stored=said) == said


def test_no_two_methods_share_colour_and_marker() -> None:
    marks = [(look.colour, look.marker) for look in LOOKS.values()]
    assert len(set(marks)) == len(marks)


@pytest.mark.parametrize("ground", GROUNDS)
def test_colours_have_contrast(ground: str) -> None:
    low = {
        key: contrast(getattr(look, ground), GROUNDS[ground])
        for key, look in LOOKS.items()
        if contrast(getattr(look, ground), GROUNDS[ground]) < 3.0
    }
    assert low == {}


@pytest.mark.parametrize("ground", GROUNDS)
def test_methods_with_one_marker_differ_in_colour_for_the_colour_blind(ground: str) -> None:
    close = [
        (a.key, b.key)
        for a, b in combinations(LOOKS.values(), 2)
        if a.marker == b.marker
        and least_difference(getattr(a, ground), getattr(b, ground)) < LEAST_DIFFERENCE
    ]
    assert close == []


def test_baselines_exist_and_give_the_planned_pairs() -> None:
    assert {b for look in LOOKS.values() for b in look.baselines} <= set(METHODS)
    pairs = plan_installed_pairs(METHODS)
    assert ("mcmc_rpf", "sir") in pairs
    assert ("cofm_amssrcpf", "fmcpf") in pairs
    assert plan_installed_pairs(
        [f"{name}[particles={n}]" for name in ("mcmc_rpf", "sir") for n in (9, 99)]
    ) == [(f"mcmc_rpf[particles={n}]", f"sir[particles={n}]") for n in (9, 99)]
    tuned = {pair for pair in pairs if "tuning" in read_paper_block("filter", pair[1])}
    assert len(pairs) - len(tuned) == 17
    blocks = {m: read_paper_block("filter", m) for m in METHODS}
    controls = {m for m, block in blocks.items() if "tuning" in block and not block["proposed"]}
    assert len(controls) >= 4
    assert tuned == {(m, control) for m in {method for method, _ in pairs} for control in controls}
    assert plan_installed_pairs(["mcmc_rpf", "sir"]) == [("mcmc_rpf", "sir")]  # rpf did not run


def test_a_guide_filter_and_a_variant_do_not_hand_on_their_block() -> None:
    values = compose(["filter=neural_ckf"]).values["filter"]
    assert values["paper"]["name"] == "Neural CKF-PF"
    assert "paper" not in str({key: node for key, node in values.items() if key != "paper"})
    nested = {"filter": {"paper": {"name": "A"}, "moves": [{"paper": {"name": "B"}, "n": 1}]}}
    assert remove_nested_blocks(nested) == {"filter": {"paper": {"name": "A"}, "moves": [{"n": 1}]}}


def test_a_users_filter_has_its_own_look_but_not_that_of_its_parent() -> None:
    block: dict[str, Any] = {
        "name": "Mine", "family": "guided", "colour": ["#112233", "#ddeeff"], "marker": "v", "proposed": True,
    }  # fmt: skip
    inherited = {"name": "SIR", "family": "particle", "colour": ["#112233", "#ddeeff"]}
    looks = find_looks(
        ["mine", "plain", "child", "variant"],
        {"mine": block, "plain": {}, "child": inherited, "variant": {"name": "Two"}},
    )
    assert looks["mine"] == MethodLook(
        "mine", "Mine", "Mine", "guided", True, "#112233", "#ddeeff", "v"
    )
    assert [looks[key].name for key in ("plain", "child", "variant")] == ["plain", "child", "Two"]
    assert len({(look.colour, look.marker) for look in looks.values()}) == 4


def test_settings_of_one_method_share_its_colour_and_differ_in_marker() -> None:
    labels = ["sir[particles=100]", "sir[particles=400]"]
    first, second = find_looks(labels).values()
    assert first.colour == second.colour == LOOKS["sir"].colour
    assert first.marker != second.marker
    assert (first.name, second.name) == ("SIR [100]", "SIR [400]")
    assert describe_settings(labels) == "In brackets: particles."
    mixed = [*labels, "gpf[a.max_ratio=1000.0]"]
    assert find_looks(mixed)[labels[0]].name == "SIR [particles = 100]"
    assert find_looks(mixed)[mixed[2]].name == "GPF [max ratio = 1000]"
    assert describe_settings(mixed) == ""
    assert (
        find_looks(["sir", "sir[oracle_noise=True]"])["sir[oracle_noise=True]"].name
        == "SIR [oracle noise = True]"
    )


def test_one_method_has_one_look_in_every_figure() -> None:
    few, many = line_styles(["sir", "mcmc_rpf"]), line_styles(METHODS)
    for key in ("sir", "mcmc_rpf"):
        assert few[key].colour == many[key].colour == LOOKS[key].colour
        assert few[key].marker == many[key].marker
        assert few[key].dash == many[key].dash
    assert many["mcmc_rpf"].filled
    assert many["mcmc_rpf"].dash == "-"
    assert not many["sir"].filled
    assert many["sir"].dash != "-"


@pytest.mark.parametrize(
    ("block", "text"),
    [
        ({"marker": "circle"}, "filter.paper.marker must be one of o s"),
        ({"colour": ["red", "blue"]}, "filter.paper.colour must be two colours"),
        ({"proposed": "yes"}, "filter.paper.proposed must be true or false"),
        ({"family": "unknown"}, "filter.paper.family must be one of kalman"),
        ({"baselines": "sir"}, "filter.paper.baselines must be a list"),
        ({"title": "A"}, "filter.paper must have keys of name"),
    ],
)
def test_values_that_do_not_fit_are_refused(block: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        check_paper_blocks({"filter": {"paper": block}})
