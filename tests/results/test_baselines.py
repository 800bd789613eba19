"""Planned pairs of a study, by hand."""

from pfbench.results.paper_block import list_planned_pairs

BASELINES = {"new": ("sir", "ukf"), "sir": (), "ukf": ()}


def test_a_swept_setting_stays_the_same_within_a_pair() -> None:
    labels = [f"{name}[model.q={q}]" for name in ("new", "sir", "ukf") for q in (1.0, 5.0)]
    assert list_planned_pairs(labels, BASELINES) == [
        ("new[model.q=1.0]", "sir[model.q=1.0]"),
        ("new[model.q=1.0]", "ukf[model.q=1.0]"),
        ("new[model.q=5.0]", "sir[model.q=5.0]"),
        ("new[model.q=5.0]", "ukf[model.q=5.0]"),
    ]


def test_a_filter_without_the_setting_meets_each_value() -> None:
    labels = ["new[particles=100]", "new[particles=400]", "sir[particles=100]", "ukf"]
    assert list_planned_pairs(labels, BASELINES) == [
        ("new[particles=100]", "sir[particles=100]"),
        ("new[particles=100]", "ukf"),
        ("new[particles=400]", "ukf"),
    ]


def test_variants_of_a_proposed_method_meet_the_baseline() -> None:
    labels = ["new[stages.1.gain=2,mode=a]", "new[stages.1.gain=2,mode=b]", "sir"]
    assert list_planned_pairs(labels, BASELINES) == [(labels[0], "sir"), (labels[1], "sir")]


def test_each_proposed_method_meets_the_tuned_baselines_once() -> None:
    labels = ["new", "other", "sir", "ekf_tuned", "gate_tuned", "absent_tuned"]
    baselines = {"new": ("sir", "ekf_tuned"), "other": ("ukf",)}
    assert list_planned_pairs(labels, baselines, ["ekf_tuned", "gate_tuned"]) == [
        ("new", "sir"), ("new", "ekf_tuned"), ("new", "gate_tuned"), ("other", "ekf_tuned"), ("other", "gate_tuned"),
    ]  # fmt: skip
    assert list_planned_pairs(["sir", "ekf_tuned"], {}, ["ekf_tuned"]) == [("ekf_tuned", "sir")]


def test_without_a_proposed_method_the_reference_has_the_same_setting() -> None:
    labels = [f"{name}[q={q}]" for name in ("ckf", "sir", "ekf") for q in (1, 2)]
    assert list_planned_pairs(labels, {}) == [
        (f"{name}[q={q}]", f"ekf[q={q}]") for name in ("ckf", "sir") for q in (1, 2)
    ]
    assert len(list_planned_pairs(labels[:5], {})) == 10
    assert list_planned_pairs([f"mine[q={q}]" for q in range(6)], {}) == []
