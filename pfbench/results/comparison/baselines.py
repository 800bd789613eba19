"""Planned pairs of a study: proposed methods against the baselines of their papers."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import combinations

from pfbench.results.conditions import natural_sort_key

_FEW = 5  # filters up to which all pairs are planned if no proposed method is compared
# filters that measure the others, the first that a study has: the tuned control, EKF, SIR
REFERENCES = ("ekf_scaled_tuned", "ekf", "sir")


def list_planned_pairs(
    labels: Collection[str], baselines: Mapping[str, Sequence[str]]
) -> list[tuple[str, str]]:
    """List the planned pairs of a study.

    Args:
        labels: Filters of the study.
        baselines: Baselines of the paper of each proposed method, by label.

    Returns:
        Proposed methods with each baseline of their paper. Without such a pair: all pairs of at most
        five filters, or each filter with the first of `REFERENCES` that the study has.
    """
    labels = sorted(set(labels), key=natural_sort_key)
    pairs = [
        (method, baseline)
        for method in labels
        for baseline in baselines.get(method, ())
        if baseline in labels
    ]
    if pairs:
        return pairs
    if len(labels) <= _FEW:
        return list(combinations(labels, 2))
    reference = next((label for label in REFERENCES if label in labels), None)
    return [(label, reference) for label in labels if reference and label != reference]
