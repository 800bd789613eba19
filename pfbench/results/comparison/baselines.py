"""Planned pairs of a study: proposed methods against the baselines of their papers and tuned ones."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import combinations

from pfbench.results.conditions import natural_sort_key
from pfbench.results.job_labels import parse_label

_FEW = 5  # filters up to which all pairs are planned if no proposed method is compared
# filters that measure the others, the first that a study has: the tuned control, EKF, SIR
REFERENCES = ("ekf_scaled_tuned", "ekf", "sir")


def list_planned_pairs(
    labels: Collection[str], baselines: Mapping[str, Sequence[str]], tuned: Collection[str] = ()
) -> list[tuple[str, str]]:
    """List the planned pairs of a study.

    Where a study varies a setting, the filters of a pair have the same value of it. A filter without
    the setting is compared with each value.

    Args:
        labels: Filters of the study, with their settings.
        baselines: Baselines of the paper of each proposed method, by label without settings.
        tuned: Tuned baselines, labels without settings.

    Returns:
        Proposed methods with each baseline of their paper, and with each tuned baseline. Without such
        a pair: all pairs of at most five filters, or each filter with the first of `REFERENCES` that
        the study has.
    """
    labels = sorted(set(labels), key=natural_sort_key)
    methods = {label: parse_label(label)[0] for label in labels}
    against = {m: (*baselines[m], *tuned) for m in methods.values() if baselines.get(m)}
    pairs = [
        (label, baseline)
        for label in labels
        for method in dict.fromkeys(against.get(methods[label], ()))
        for baseline in _same_settings(label, method, labels)
    ]
    if pairs:
        return pairs
    if len(labels) <= _FEW:
        return list(combinations(labels, 2))
    reference = next((name for name in REFERENCES if name in methods.values()), "")
    return [
        (label, baseline)
        for label in labels
        if methods[label] != reference
        for baseline in _same_settings(label, reference, labels)
    ]


def _same_settings(label: str, method: str, labels: Sequence[str]) -> list[str]:
    """List the labels of a method that do not differ in a setting that a label has too."""
    settings = parse_label(label)[1]
    candidates = {candidate: parse_label(candidate) for candidate in labels}
    return [
        candidate
        for candidate, (name, values) in candidates.items()
        if name == method
        and all(settings.get(key, value) == value for key, value in values.items())
    ]
