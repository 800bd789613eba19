"""Command `pfbench train`: train the network of a neural_* filter or of kalman_net."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from pathlib import Path

from pfbench.cli.command import Command
from pfbench.core.parameter_checks import require
from pfbench.job.config import compose

_NOT_OF_A_JOB = ("train.", "train=", "overwrite=", "checkpoint=")


def train_network(words: Sequence[str]) -> None:
    """Train the network of a filter and print the command that uses it."""
    require(
        not {"-m", "--multirun"} & set(words),
        "pfbench train",
        "be run without -m",
        "a sweep: it trains one network",
        "Set train.noise_regimes=[a,b] to train on several noise regimes.",
    )
    from pfbench.filter.learned.checkpoint import read_checkpoint
    from pfbench.report.scenario_figures import write_training_figure

    path = fit_network(words, print)
    lines = read_checkpoint(path)["losses"]
    names = ("epoch", "loss", "validation", "ess")
    losses = {name: [line[name] for line in lines] for name in names}
    figure = write_training_figure(path.with_suffix(".svg"), losses)
    shared = [word for word in words if not word.startswith(_NOT_OF_A_JOB)]
    command = shlex.join(["pfbench", "run", *shared, f"checkpoint={path}"])  # brackets for zsh
    print(
        f"checkpoint: {path.resolve()}\nfigure of the losses: {figure.resolve()}\nNext: {command}"
    )


def fit_network(words: Sequence[str], tell: Callable[[str], object]) -> Path:
    """Train the network of the configuration of words, unless its checkpoint exists.

    Returns the path of the checkpoint.
    """
    from pfbench import job
    from pfbench.job.inputs import find_inputs
    from pfbench.learn.training_job import fit

    config = compose(words)
    values, choices = config.values, config.choices
    job.apply_global_settings(values)
    require(
        not values["oracle_noise"],
        "oracle_noise",
        "be false for training",
        "true",
        "Set oracle_noise=true when the filter runs.",
    )
    names = list(values["train"]["noise_regimes"]) or [choices["noise"]]
    regimes = {
        name: job.instantiate(compose([*words, f"noise={name}"]).values["noise"]) for name in names
    }
    about = {"versions": job.read_versions(), "inputs": find_inputs(values, config.trusted)}
    return fit(values, choices, regimes, job.instantiate, about, tell)


COMMAND = Command(
    train_network,
    """\
pfbench train key=value ...

Train the network of a neural_* filter or of kalman_net. The resulting file is the value of `checkpoint` of a job.
An interrupted training resumes when the command is repeated.

  pfbench train filter=neural_sir scenario=passive_1 train=vsmc train.epochs=20
  pfbench list train         training configurations""",
)
