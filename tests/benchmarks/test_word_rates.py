"""Words under laws whose differences are skewed: the stored table, and a part of it again."""

import json
import math
import sys
from importlib import import_module
from typing import Any

import numpy as np
from checkout import ROOT

FALSE = (
    "better or worse", "star", "until decided", "equal at the margin", "equal at a gap of 10 %", "loses more", "loses track",
)  # fmt: skip


sys.path.insert(0, str(ROOT / "experiments" / "analyses"))
script = import_module("word_rates")


def test_the_table_is_that_of_the_stored_rates_which_hold() -> None:
    stored: dict[str, Any] = json.loads(script.STORED.read_text())
    text = script.PAGE.read_text()
    assert script.fill_page(text) == text
    settings = [script.Setting(*row["setting"]) for row in stored["rows"]]
    assert tuple(settings) == script.SETTINGS
    bound = 0.05 + 3 * math.sqrt(0.05 * 0.95 / stored["studies"])
    rates = {s: row["rates"] for s, row in zip(settings, stored["rows"], strict=True)}
    for setting, row in rates.items():
        if setting.null == "half":
            assert max(row[name] for name in FALSE) <= bound, setting
        else:
            assert row["better or worse"] > 0.5
        assert row["each pair alone"] > bound
    skewed = [row for s, row in rates.items() if s.runs == 200 and s.null == "half"]
    assert max(row["sign test uncorrected"] for row in skewed) > bound
    assert max(row["no sign test"] for row in skewed) > 0.1


def test_no_sign_of_a_word_is_false_too_often_under_skewed_laws() -> None:
    """Seven pairs whose half of the runs is smaller: without a correction of the sign test the rate is too large."""
    studies, rng, found = 400, np.random.default_rng(4), np.zeros(2)
    setting = script.Setting(200, "log-normal")
    for batch in range(studies // script.BATCH):
        losses = script.draw_losses(setting, rng, np.zeros(script.METHODS + script.BASELINES))
        tests = script.run_tests(losses)
        words = script.differ(tests)
        if batch == 0:
            script.check_words(losses, words, 10)
        uncorrected = script.differ(tests, 2 * tests.sign)
        found += [words.any(-1).sum(), uncorrected.any(-1).sum()]
    bound = 0.05 + 2.5 * math.sqrt(0.05 * 0.95 / studies)
    assert found[0] / studies <= bound
    assert found[1] / studies > bound
