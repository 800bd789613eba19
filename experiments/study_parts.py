"""Parts of the studies of trainings: results in one file, from which a study resumes, and means over trainings and runs."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from pfbench.files import DIGEST, has_valid_digest, hash_content, write_atomically


class ResumableResults:
    """Finished parts of a study by name, JSON values that are written at once.

    A file of another request, or a damaged one, is replaced.

    Args:
        path: File of the results. Its folder is created.
        request: Description of the computation on which the parts depend.

    Attributes:
        path: File of the results.
        state: Content of the file: `request` and `done`, the parts by name.
    """

    def __init__(self, path: Path, request: Mapping[str, Any]) -> None:
        self.path = path
        self.state: dict[str, Any] = {"request": json.loads(json.dumps(request)), "done": {}}
        try:
            stored = json.loads(path.read_text())
        except (FileNotFoundError, ValueError):
            return
        is_whole = isinstance(stored, dict) and has_valid_digest(stored)
        if is_whole and stored.get("request") == self.state["request"]:
            self.state = {key: stored[key] for key in ("request", "done")}

    def __call__(self, name: str, make: Callable[[], Any]) -> Any:
        """Return one part, computed by `make` unless an earlier call has stored it.

        Args:
            name: Name of the part, unique in the study.
            make: Computes the part, a value that JSON can represent.

        Returns:
            The part.
        """
        finished = self.state["done"]
        if name not in finished:
            finished[name] = make()
            # of the values as JSON returns them
            content = json.loads(json.dumps(self.state))
            text = json.dumps({**content, DIGEST: hash_content(content)})
            write_atomically(self.path, lambda file: file.write(text.encode()))
        return finished[name]


def crossed_mean_interval(values: np.ndarray, level: float = 0.95) -> tuple[float, float]:
    """Compute the interval of a mean over two crossed samples, such as trainings and test runs.

    Args:
        values: One value for each pair, [A, B]. A sample of one counts as fixed.
        level: Probability of the interval.

    Returns:
        Mean, and half of the length of Student's interval.

    References:
        F. E. Satterthwaite (1946), An approximate distribution of estimates of variance components.
    """
    variances = [
        (values.mean(axis).var(ddof=1), n)
        for axis, n in ((0, values.shape[1]), (1, values.shape[0]))
        if n > 1
    ]
    variance = sum(spread / n for spread, n in variances)
    if not variance:
        return float(values.mean()), 0.0
    freedom = variance**2 / sum((spread / n) ** 2 / (n - 1) for spread, n in variances)
    quantile = float(stats.t.ppf(0.5 + level / 2, freedom))
    return float(values.mean()), quantile * math.sqrt(variance)
