"""The Python door: the jobs of the command line, own classes of a notebook, and a study that is read from the same files."""

import importlib
import logging
import os
import pydoc
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from command_line import pfbench as command
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from notebook_cells import MODEL, PROPOSAL, WORLD, Notebook
from refusals import check_refused

import pfbench
from pfbench.cli.compose import plan_study
from pfbench.door import laws, own_source
from pfbench.job import IGNORED_IN_KEY, compose, job_key
from pfbench.job.trust import FOLDERS
from pfbench.results import main_component_group, store
from pfbench.results.status import keeps_track
from pfbench.scenario import ModelSimulation

SMALL = {"runs": 4, "particles": 40}
WALK = pfbench.get("scenario", "linear_walk", steps=6)
WALK_WORDS = ("scenario=linear_walk", "scenario.steps=6", "runs=4", "particles=40")


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty current folder, in which all results lie."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PFBENCH_TRUST", raising=False)
    monkeypatch.setenv("PFBENCH_RESULTS", str(tmp_path / "results"))
    monkeypatch.setenv("PFBENCH_EPISODES", str(tmp_path / "worlds"))
    return tmp_path


@pytest.fixture
def notebook(home: Path, monkeypatch: pytest.MonkeyPatch) -> Notebook:
    return Notebook(monkeypatch)


def stored(study: str) -> dict[str, store.JobResult]:
    """Results of a study by label."""
    results = map(store.read_result, Path("results", study).glob("*.npz"))
    return {result.meta["label"]: result for result in results}


def keys(study: str) -> set[str]:
    return {path.stem for path in Path("results", study).glob("*.npz")}


# the same jobs as the command line


def test_results_of_the_command_line_are_skipped_and_the_other_way_round(
    home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = command("run", "-m", *WALK_WORDS, "filter=sir,ekf", "study=s", home=home)
    assert said.code == 0, said.err
    before = keys("s")
    study = pfbench.run(WALK, ["sir", "ekf", "rpf"], study="s", **SMALL)
    printed = capsys.readouterr().out
    assert printed.count("skipped   linear_walk") == 2
    assert "run: 1 finished, 2 skipped, 0 failed" in printed
    assert before < keys("s")
    again = command("run", "-m", *WALK_WORDS, "filter=sir,ekf,rpf", "study=s", home=home)
    assert again.out.count("skipped   linear_walk") == 3
    assert sorted(study.errors().columns) == ["ekf", "rpf", "sir"]


@pytest.mark.parametrize(
    ("scenario", "filters", "settings", "words"),
    [
        ("flight_500s", "tuned_baselines", {}, ["filter=tuned_baselines"]),
        ("passive_1_printed", ["sir", "mcmc_rpf"], {"seed": 2}, ["filter=sir,mcmc_rpf", "seed=2"]),
        (
            pfbench.get("scenario", "terrain", initial_sd=50.0),
            [pfbench.get("filter", "sir", resampler__ess_threshold=1.0)],
            {"budget": "time"},
            ["scenario.initial_sd=50.0", "filter=sir", "filter.resampler.ess_threshold=1.0", "budget=time"],
        ),
    ],
)  # fmt: skip
def test_keys_are_those_of_the_command_line(
    home: Path, monkeypatch: pytest.MonkeyPatch, scenario, filters, settings, words
) -> None:
    """For named sets, changed parts and settings; the jobs themselves are not run."""
    composed = []

    def keep(configs, workers, progress) -> None:
        composed.extend(configs)

    monkeypatch.setattr("pfbench.door.running._run_jobs", keep)
    monkeypatch.setattr("pfbench.door.running.open_study", lambda *a, **b: None)
    pfbench.run(scenario, filters, noise=["nominal", "outliers"], study="k", **settings)
    name = scenario if isinstance(scenario, str) else scenario.name
    from pfbench.job.config import expand_filter_sets

    full = [f"scenario={name}", "noise=nominal,outliers", "runs=50", "study=k", *words]
    expected = plan_study(expand_filter_sets(full)).compose_jobs()
    assert {job_key(c.values, {}) for c in composed} == {job_key(c.values, {}) for c in expected}
    assert len(composed) == len(expected) == len({job_key(c.values, {}) for c in composed})
    assert "results_dir" in IGNORED_IN_KEY


# own classes


def test_a_proposal_of_a_notebook_runs_in_workers_and_is_computed_again(notebook: Notebook) -> None:
    notebook.run("%matplotlib inline\nSCALE = 3.0")
    notebook.run(PROPOSAL)
    study = pfbench.run(WALK, ["sir", notebook["Defensive"]()], study="own", workers=2, **SMALL)
    result = stored("own")["defensive"]
    target = result.meta["config"]["filter"]["proposal"]["_target_"]
    assert re.fullmatch(r"own_defensive_[0-9a-f]{10}\.Defensive", target)
    assert result.meta["inputs"]["filter"].keys() == {
        "code of own_defensive",
        "values of own_defensive.Defensive",
    }
    assert result.meta["config"]["filter"]["particles"] == SMALL["particles"]  # that of the study
    assert not np.array_equal(result.data["error"], stored("own")["sir"].data["error"])
    traces = study.replay("defensive", 2)
    assert np.array_equal(traces["error position [m]" if "error position [m]" in traces else traces.columns[1]].to_numpy(), result.data["error"][2, :, 0])  # fmt: skip
    untrusted = re.escape(f"open it by pfbench.study('own', trust=('{target.partition('.')[0]}',))")
    check_refused([(untrusted, lambda: pfbench.study("own").replay("defensive", 2))])
    said = command("replay", "study=own", "filter=defensive", "run=2", home=Path.cwd())
    assert f"add trust=[{target.partition('.')[0]}]" in said.err
    place = [f"hydra.searchpath=[own://{next(Path('.cache/own').glob('defensive_*'))}]", f"trust=[{target.partition('.')[0]}]"]  # fmt: skip
    again = command("run", *WALK_WORDS, "filter=defensive", "study=own", *place, home=Path.cwd())
    assert "skipped   linear_walk" in again.out, again.err


def test_a_changed_class_or_helper_is_a_new_job_and_replaces_the_old_one(
    notebook: Notebook,
) -> None:
    notebook.run("SCALE = 3.0")
    notebook.run(PROPOSAL)
    pfbench.run(WALK, ["ekf", notebook["Defensive"]()], study="own", progress=False, **SMALL)
    first = keys("own")
    for change in ("SCALE = 2.0", "def log_normal(w):\n    return -0.5 * (w * w).sum(-1)"):
        notebook.run(change)
        before = keys("own")
        study = pfbench.run(WALK, ["ekf", notebook["Defensive"]()], study="own", progress=False, **SMALL)  # fmt: skip
        assert len(keys("own") - before) == 1
    assert len(first) == 2
    assert list(study.errors().columns) == ["defensive", "ekf"]  # the newest code alone
    assert {path.stem[:8] for path in Path("results/own").glob("*.npz")} == {k[:8] for k in first}


def test_a_model_of_a_notebook_is_simulated_with_its_arguments(notebook: Notebook) -> None:
    notebook.run(MODEL)
    world = pfbench.run(notebook["Room"](0.2, measurement_sd=0.7), ["ukf"], study="room", **SMALL)
    config = stored("room")["ukf"].meta["config"]
    arguments = {key: config["model"][key] for key in ("cooling_rate", "measurement_sd")}
    assert arguments == {"cooling_rate": 0.2, "measurement_sd": 0.7}
    assert config["scenario"]["model"] == {"_target_": config["model"]["_target_"], **arguments}
    assert stored("room")["ukf"].data["error"].shape[:2] == (4, 100)
    assert world.errors()["ukf"].between(0, 5).all()
    assert pfbench.check(notebook["Room"]).passed
    one = pfbench.own(ModelSimulation(notebook["Room"](), 7))  # named by its model
    assert (one.name, pfbench.own(ModelSimulation, model=notebook["Room"], steps=7)) == (
        "room",
        one,
    )


TURNS = """
class Compass(Room):
    def initial(self, runs):
        return normal_batch(runs, torch.full_like(self.sd, 3.0), torch.full_like(self.sd, 18.0))
    def propagate(self, x, u, w):
        return x + 0.3 + 0.01 * w
    def observation(self, x, u):
        return independent_normal(wrap_angle(x), 0.1 * self.sd)
class Steep(Compass):
    def observation(self, x, u):
        return independent_normal(math.pi * torch.tanh(50.0 * (x - 19.0)), 0.1 * self.sd)
class Circle(Compass):
    def residual(self, y, y_hat):
        return wrap_angle(y - y_hat)
"""


def test_a_measured_angle_without_a_residual_is_found(notebook: Notebook) -> None:
    notebook.run("import math\nfrom pfbench.core import wrap_angle")
    notebook.run(MODEL + TURNS)
    assert all(pfbench.check(notebook[name]).passed for name in ("Circle", "Steep"))
    (row,) = pfbench.check(notebook["Compass"]).rows
    assert row.message.startswith("channel 1 of Compass jumps by 2 pi. Define residual(self, y")


def test_parts_of_a_script_share_its_classes_and_depend_on_what_they_reach(
    notebook: Notebook,
) -> None:
    """Model and scenario have one input type and one helper; a class that no part reaches changes no key."""

    def run_world() -> set[str]:
        world, model, slips = (notebook[name]() for name in ("Sea", "Line", "Slips"))
        study = pfbench.run(world, ["ekf", "sir"], model=model, noise=["nominal", slips], study="sea", **SMALL)  # fmt: skip
        assert study.errors().shape == (8, 2)
        return keys("sea")

    notebook.run("SD = 1.0")
    notebook.run(WORLD)
    before = run_world()
    assert len(before) == 4
    notebook.run("class Unrelated:\n    pass")
    assert run_world() == before
    notebook.run("SD = 2.0")  # of the model
    changed = run_world()
    assert len(changed) == 8
    helper = WORLD[WORLD.index("@dataclass") : WORLD.index("class Line")]
    notebook.run(helper.replace("self.gain", "1.0 * self.gain"))  # of model and scenario
    notebook.run(WORLD[WORLD.index("class Line") : WORLD.index("@dataclass(frozen=True)\nclass Slips")])  # fmt: skip
    assert len(run_world()) == 12
    result = next(iter(stored("sea").values()))
    assert {"code of own_ship", "code of own_drive", "code of own_sea", "values of own_sea.Sea"} == result.meta["inputs"]["scenario"].keys()  # fmt: skip
    ship = notebook["Ship"](torch.ones(1, 5, dtype=torch.float64))
    assert pfbench.check(notebook["Line"](), inputs=ship).passed
    assert "inputs must be Ship for Line, got none" in repr(pfbench.check(notebook["Line"]()))


def test_classes_that_use_each_other_are_one_module(notebook: Notebook) -> None:
    notebook.run(
        "class A:\n    def __call__(self, a, n, draws):\n        return B\nclass B(A):\n    is_exact = True"
    )
    a, b = (pfbench.own(notebook[name]()).packages for name in "AB")
    assert a == b


@pytest.mark.parametrize("name", sorted(pfbench.names("noise")))
def test_regimes_keep_the_contract_of_own_ones(name: str) -> None:
    if name == "replay" and "PFBENCH_DATA" not in os.environ:
        pytest.skip("its record is not part of the package")
    assert pfbench.check(pfbench.get("noise", name)).passed


def test_a_regime_that_states_another_distribution_is_found(notebook: Notebook) -> None:
    notebook.run(
        WORLD.replace("NoiseRegime)", "NominalNoise)").replace(
            "import NoiseRegime", "import NominalNoise"
        )
    )
    (law,) = (row for row in pfbench.check(notebook["Slips"]()).rows if not row.holds)
    assert law.statement == "error_distribution is that of the errors"
    assert not pfbench.run(WALK, "ekf", noise=notebook["Slips"](), study="n", **SMALL).failed()


REGIMES = {"Three": "len(time), 3", "Few": "len(time), min(2, size)", "Long": "200, size"}  # array


def test_a_regime_is_tried_in_its_world_and_checked_with_any_number_of_channels(
    notebook: Notebook,
) -> None:
    notebook.run("from pfbench.noise import NoiseRegime")
    for name, shape in REGIMES.items():
        notebook.run(
            f"class {name}(NoiseRegime):\n    def draw_errors(self, draws, channels, time):\n        size = len(channels.sd)\n"
            f"        return draws.normal('mine', {shape})"
        )
    three, few, long = (notebook[name]() for name in REGIMES)
    lorenz = pfbench.get("scenario", "lorenz63", steps=5)
    assert not pfbench.run(lorenz, "ekf", noise=three, study="n", progress=False, **SMALL).failed()
    sentence = (
        "draw_errors must return errors [R, T, Dy] = {} for {} of any number of channels, got"
    )
    for call, shape in (
        (lambda: pfbench.check(three), [2, 200, 1]),
        (lambda: pfbench.check(few), [2, 200, 3]),
        (lambda: pfbench.check(long, scenario=lorenz), [2, 5, 3]),
    ):
        assert sentence.format(shape, shape[-1]) in call().rows[0].message
    assert pfbench.check(long).passed
    check_refused(
        [
            (
                re.escape(sentence.format([2, 5, 3], 3)),
                lambda: pfbench.run(lorenz, "ekf", noise=few, study="m", **SMALL),
            ),
            (
                "scenario must be given for a noise only",
                lambda: pfbench.check(lorenz, scenario=lorenz),
            ),
        ],
        remedy=False,
    )


def test_a_file_that_an_own_stage_reads_must_be_stated(
    notebook: Notebook, monkeypatch: pytest.MonkeyPatch
) -> None:
    # and not those that pfbench itself opens meanwhile, also where it is installed as other libraries are
    monkeypatch.setattr(laws, "_LIBRARIES", (*laws._LIBRARIES, str(Path(laws.__file__).parents[1])))
    notebook.run(
        "from pathlib import Path\nPath('gain.txt').write_text('0.8')\nfrom pfbench.kernels.library_build import name_library\nclass Reads:\n    is_exact = False\n    def __call__(self, model, log_w, x, log_ratio, record):\n"
        "        gain = float(Path('gain.txt').read_text())\n        name_library.__wrapped__('baseline')\n"
        "        return log_w + gain * model.log_likelihood(record.y, x, record.u) + log_ratio\n"
        "class Says(Reads):\n    def input_files(self):\n        return ['gain.txt']"
    )
    (row,) = (row for row in pfbench.check(notebook["Reads"](), runs=20).rows if not row.holds)
    assert re.search(
        r"Reads opens [^,]*gain\.txt\. Return their paths from .*input_files", row.message
    )
    assert "input_files" not in repr(pfbench.check(notebook["Says"](), runs=20))


@pytest.mark.parametrize(
    ("weights", "sentence"),
    [("log_w * float('nan')", "estimate must be finite"), ("log_w.sum(-1)", "Weighs must return log weights")],
)  # fmt: skip
def test_a_filter_that_gives_nothing_is_refused_before_the_jobs(
    notebook: Notebook, weights: str, sentence: str
) -> None:
    notebook.run(
        f"class Weighs:\n    is_exact = False\n    def __call__(self, model, log_w, x, log_ratio, record):\n        return {weights}"
    )
    part = notebook["Weighs"]()
    assert not pfbench.check(part, runs=20).passed
    check_refused([(sentence, lambda: pfbench.run(WALK, ["sir", part], study="n", **SMALL))])
    assert not Path("results/n").exists()


def test_names_of_own_parts(notebook: Notebook) -> None:
    notebook.run("SCALE = 3.0")
    notebook.run(PROPOSAL)
    mine = pfbench.own(notebook["Defensive"](0.4), "Wide PF", base="rpf")
    assert (mine.group, mine.name) == ("filter", "wide_pf")
    study = pfbench.run(WALK, [mine, "rpf"], study="named", progress=False, **SMALL)
    node = stored("named")["wide_pf"].meta["config"]["filter"]
    assert node["proposal"]["share"] == 0.4
    assert node["resampler"]["_target_"] == "pfbench.filter.RegularisedResampler"
    assert "Wide PF" in str(study.summary())
    own = pfbench.own(notebook["Defensive"], "SIR")  # not the shipped one
    (file,) = Path(own.folders[0]).rglob("own_sir.yaml")
    assert "name: Own SIR\n" in file.read_text()


CLOSURE = """
def make(scale):
    class Scaled:
        is_exact = True

        def __call__(self, a, n, draws):
            return scale * a

    return Scaled
"""
BAD_CELLS = {
    CLOSURE: ("make(2.0)()", "Scaled must be defined at the top level, got a class inside of make"),
    f"SD = 1.0\n{WORLD}\nclass Bare:\n    def draw_errors(self, draws, channels, time):\n        return 0.0": (
        "Bare()", "Bare must be a subclass of pfbench.noise.NoiseRegime to be a noise regime, got a subclass of object"
    ),
    f"SD = 1.0\n{WORLD}\nclass Flat(Slips):\n    def draw_errors(self, draws, channels, time):\n        return time": (
        "Flat()", "Flat.draw_errors must return errors [R, T, Dy] = [2, 6, 1] for 1 of any number of channels, got [6]"
    ),
    f"SD = 1.0\n{WORLD}\nclass Loud(Slips):\n    def draw_errors(self, draws, channels, time):\n        return time.nothing": (
        "Loud()", "draw_errors of your class must succeed, got AttributeError: 'Tensor' object has no attribute 'nothing'. Correct the line: return time.nothing"
    ),
    f"SD = 1.0\n{WORLD}\nclass Dead(Sea):\n    def draw(self, noise, runs, seed):\n        e = super().draw(noise, runs, seed)\n        return Episode(e.record, e.time[:5], e.truth)": (
        "Dead()", "Dead.draw must return record.y with the axes of runs, steps and components, [2, 5, ...], got [2, 8, 1]"
    ),
    f"SD = 1.0\n{WORLD}\nclass Calm(Sea):\n    def draw(self, noise, runs, seed):\n        return super().draw(noise, runs, seed)._replace(record=Record(torch.randn(len(runs), 8, 1)))": (
        "Calm()", "draw of your class must succeed, got AttributeError: 'Episode' object has no attribute '_replace'"
    ),
    f"SD = 1.0\n{WORLD}\nclass Short(Sea):\n    def draw(self, noise, runs, seed):\n        e = super().draw(noise, runs, seed)\n        return Episode(Record(e.record.y, Ship(torch.ones(8))), e.time, e.truth)": (
        "Short()", "record.u.speed must have the axes [2 or 1, 8, ...] of runs and steps, got [8]. Write values[None]"
    ),
    f"SD = 1.0\n{WORLD}\nclass Other(Sea):\n    def draw(self, noise, runs, seed):\n        e = super().draw(noise, runs, seed)\n        return Episode(e.record, e.time, {{'pos': e.truth['position']}})": (
        "Other()", "Other.draw must name groups of Line (position), got 'pos'. Use these names"
    ),
    f"SD = 1.0\n{WORLD}\nclass Near(Sea):\n    def draw(self, noise, runs, seed):\n        e = super().draw(noise, runs, seed)\n        return Episode(e.record, e.time, {{**e.truth, 'vel': e.truth['position']}})\nclass Line(Line0):\n    def __init__(self):\n        super().__init__()\n        self.groups = {{'position': (0,), 'velocity': (0,)}}".replace("class Line(S", "class Line0(S"): (
        "Near()", "Near.draw must name groups of Line (position, velocity), got 'vel'. Use these names"
    ),
    f"{MODEL}\nclass Bare(Room):\n    def __init__(self):\n        super().__init__()\n        self.units = ()": (
        "Bare()", "Bare.units must have one unit for each of 1 names, got (). Write ''"
    ),
    f"{MODEL}\nclass Whole(Room):\n    def __init__(self):\n        super().__init__()\n        self.groups = {{'temperature': 0}}": (
        "Whole()", "Whole.groups['temperature'] must be a tuple of components from 0 to 0, got 0. Write (0,)"
    ),
    f"{MODEL}\nclass Alone(Room):\n    def initial(self, runs):\n        return independent_normal(self.sd, self.sd)": (
        "Alone()", "Alone.initial must return a distribution of batch shape [R] = [2], got []. Use normal_batch"
    ),
    f"{MODEL}\nclass Flat(Room):\n    def observation(self, x, u):\n        return independent_normal(x[..., 0], self.sd)": (
        "Flat()", "Flat.observation must return a distribution of batch shape [R, N], got [2]. Compute it from the states x, with their last axis"
    ),
    f"SD = 1.0\n{WORLD}\nclass Line(Line0):\n    def observation(self, x, u):\n        return independent_normal(x[..., 0], self.sd)".replace("class Line(S", "class Line0(S"): (
        "Sea()", "Line.observation must return a distribution of batch shape [R, N] = [2, 4], got [2]. Compute it from the states x, with their last axis"
    ),
    "class Empty:\n    pass": ("Empty", "must have the methods of a part: filter init and step"),
    "class Call:\n    def __call__(self, x, y):\n        return x": ("Call()", "Got __call__(self, x, y)"),
    "class Plain:\n    def propagate(self, x, u, w):\n        return x": (
        "Plain", "Plain must be a subclass of pfbench.model.StateSpaceModel to be a model, which is a module of torch"
    ),
    "from pfbench.model import StateSpaceModel\nclass Half(StateSpaceModel):\n    def propagate(self, x, u, w):\n        return x": (
        "Half", "Half must define initial, observation to be a model"
    ),
    "class Lost:\n    is_exact = True\n    def __call__(self, belief):\n        return MISSING(belief)": (
        "Lost()", "MISSING must be defined before the class is passed"
    ),
    "import pfbench\nimport numpy\nBIG = numpy.zeros(3)\ndel numpy\nfrom dataclasses import dataclass\n@dataclass(frozen=True)\n"
    "class Array:\n    values: object = None\n    def __call__(self, belief):\n        return belief": (
        "Array(BIG)", "Array.values must be numbers, texts, lists or objects of dataclasses, got ndarray. Pass numbers or a list"
    ),
}  # fmt: skip


@pytest.mark.parametrize("cell", BAD_CELLS, ids=lambda cell: cell.strip().splitlines()[-1][:20])
def test_classes_that_no_other_process_can_use_are_refused_in_a_sentence(
    notebook: Notebook, cell: str
) -> None:
    expression, sentence = BAD_CELLS[cell]
    notebook.run(cell)
    thing = eval(expression, vars(notebook.main))
    kinds = {"draw_errors": "noise", "draw": "scenario", "propagate": "scenario"}
    group = next((kinds[name] for name in kinds if hasattr(thing, name)), "filters")
    model = {"model": notebook["Line"]()} if hasattr(thing, "draw") else {}
    with pytest.raises((ValueError, TypeError), match=re.escape(sentence)):
        pfbench.run(**{"scenario": WALK, "filters": ["sir"], group: [thing], **model, **SMALL})
    assert not Path("results").exists()


def test_an_object_of_an_earlier_definition_is_refused(notebook: Notebook) -> None:
    notebook.run("SCALE = 3.0")
    notebook.run(PROPOSAL)
    old = notebook["Defensive"]()
    notebook.run(PROPOSAL)
    check_refused(
        [(r"got one that was defined before\. Make the object again", lambda: pfbench.own(old))],
        remedy=False,
    )


# bad input: the sentences of the command line


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: pfbench.get("filter", "sirr"), "filter=sirr does not exist. Similar: sir"),
        (lambda: pfbench.get("filters", "sir"), "group must be one of scenario, noise, filter, model"),
        (lambda: pfbench.names("filtre"), "group must be one of "),
        (lambda: pfbench.run("terrian", "sir"), "scenario=terrian does not exist. Similar: terrain"),
        (lambda: pfbench.run(WALK, []), "filter must be at least one, got an empty list"),
        (lambda: pfbench.run(WALK, 3), "filter must be a name, a part or a class, got 3"),
        (lambda: pfbench.run(WALK, WALK), "filter must be a filter, got the scenario scenario=linear_walk"),
        (lambda: pfbench.run(WALK, "sir", workers=0), "workers must be a whole number of at least 1, got 0"),
        (lambda: pfbench.run(WALK, "sir", workers=True), "workers must be a whole number of at least 1, got True"),
        (lambda: pfbench.run(WALK, "sir", runs=0), "runs must be a whole number of at least 1, got 0"),
        (lambda: pfbench.run(WALK, "sir", particles=1e3), "particles must be a whole number of at least 2, got 1000.0. Write it"),
        (lambda: pfbench.run(WALK, "sir", partcles=3), "partcles=3: key partcles does not exist. Similar: particles"),
        (lambda: pfbench.run(WALK, "sir", filter__resampler__foo=3), "does not exist. Keys of filter.resampler: filter.resampler.ess_threshold, "),
        (lambda: pfbench.run(WALK, "sir", noise__ess_threshold=3), "does not exist. Similar: filter.resampler.ess_threshold"),
        (lambda: pfbench.run(WALK, "sir", study="a/b"), "study must be a name of letters"),
        (lambda: pfbench.run(WALK, "sir", particles=object()), "particles must be a number, a text, a list or a dictionary"),
        (lambda: pfbench.study("nothing"), "study must be a study with results, got nothing"),
        (lambda: pfbench.study(3), "study must be the name of a study, got 3"),
        (lambda: pfbench.own(WALK), "own must receive a class or an object, got the part scenario=linear_walk"),
        (lambda: pfbench.own("sir"), "'sir' must have the methods of a part"),
        (
            lambda: pfbench.own(type("Sea", (), {"__module__": "builtins", "draw": lambda *_: None})),
            "Sea must be in a file or a notebook, got a class without a source. Save it in a module.",
        ),
    ],
)  # fmt: skip
def test_bad_input_is_a_sentence(home: Path, call, sentence: str) -> None:
    with pytest.raises((ValueError, TypeError)) as caught:
        call()
    assert sentence in str(caught.value)
    assert re.search(r"\bmust\b|does not exist", str(caught.value))
    assert not Path("results").exists()


def test_unknown_keys_have_the_sentence_of_the_command_line(home: Path) -> None:
    with pytest.raises(ValueError, match="key partcles") as caught:
        pfbench.run(WALK, "sir", partcles=3, study="s")
    assert str(caught.value) in command("run", *WALK_WORDS, "filter=sir", "partcles=3", "study=s", home=home).err  # fmt: skip
    assert caught.value.__suppress_context__  # without the traceback of Hydra


def test_a_failed_job_is_listed_with_the_words_that_repeat_it(
    home: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    bad = pfbench.get("filter", "sir", particles=0)
    study = pfbench.run(WALK, ["ekf", bad], study="f", **SMALL)
    (note,) = study.failed()
    assert "must be a whole number of at least 2, got 0" in note["message"]
    printed = capsys.readouterr().out
    assert note["repeat"] in printed
    assert note["message"] in repr(study.summary())
    mended = f"  if another setting has mended it: remove {Path(note['note']).resolve(strict=True)}"
    assert f"linear_walk / nominal / sir: {note['message']}\n{mended}" in repr(study)
    assert "1 finished, 0 skipped, 1 failed" in printed
    words = note["repeat"].split()[2:]
    assert "filter.particles=0" in words
    said = command(*words[:0], "run", *words, home=home)
    assert "must be a whole number of at least 2, got 0" in said.err + said.out
    with pytest.raises(RuntimeError, match="must be a whole number of at least 2, got 0"):
        pfbench.run(WALK, [bad], study="g", progress=False, **SMALL)
    assert capsys.readouterr() == ("", "")
    caplog.clear()
    pfbench.run(WALK, ["ekf", bad], study="f", progress=False, **SMALL)
    (record,) = (
        r for r in caplog.records if r.levelname == "WARNING"
    )  # without lines of progress one warning says it
    assert "1 of 2 jobs failed: filter.particles must be a whole number" in record.getMessage()


# a study


def test_a_run_leaves_no_global_state(home: Path) -> None:
    torch.set_num_threads(2)
    logger = logging.getLogger("pfbench")
    before = (
        torch.get_num_threads(), dict(os.environ), list(sys.argv), list(logger.handlers), logger.level,
        GlobalHydra.instance().hydra, HydraConfig.instance().cfg,
    )  # fmt: skip
    try:
        pfbench.run(WALK, "sir", study="s", **SMALL)
        after = (
            torch.get_num_threads(), dict(os.environ), list(sys.argv), list(logger.handlers), logger.level,
            GlobalHydra.instance().hydra, HydraConfig.instance().cfg,
        )  # fmt: skip
    finally:
        torch.set_num_threads(1)
    assert before == after


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> pfbench.Study:
    """A study of two noise regimes and three filters, read only."""
    folder = tmp_path_factory.mktemp("study")
    return pfbench.run(
        pfbench.get("scenario", "linear_walk", steps=20), ["ekf", "sir", "rpf"], noise=["nominal", "outliers"],
        study="s", runs=12, particles=60, progress=False, results_dir=str(folder / "results"), reports_dir=str(folder / "reports"),
    )  # fmt: skip


def test_errors_are_those_of_the_files(study: pfbench.Study) -> None:
    errors = study.errors()
    assert (errors.index.names, errors.attrs) == (
        ["noise", "run"],
        {"unit": dict.fromkeys(study.table("rmse")["scenario"], "m")},
    )
    for condition in study.conditions():
        for job in condition.jobs:
            group = main_component_group(job.meta["state"])
            error = job.load().data["error"][..., group.places] * group.scale
            kept = keeps_track(job.load().data, job.meta)
            rmse = np.where(kept, np.sqrt((error**2).sum(-1).mean(-1)), np.inf)
            np.testing.assert_allclose(errors.loc[condition.noise][job.label], rmse, rtol=1e-6)
    assert set(study.table("rmse")["metric"]) == {"rmse"}
    check_refused(
        [
            ("metric must be one of", lambda: study.table("rsme")),
            ("group must be one of", lambda: study.errors("wing")),
        ],
        remedy=False,
    )


def test_a_comparison_is_the_one_of_the_page_and_of_the_errors(study: pfbench.Study) -> None:
    """Word and interval are those of the view of the condition; the ratio is that of `errors()`, in which a lost run is infinite."""
    comparison = study.compare("sir", "ekf")
    keeps = study.table("rmse").pivot_table("keeps_track", ["noise", "run"], "label", "min", observed=True) > 0  # fmt: skip
    errors = study.errors().clip(upper=1e99)
    rows = pd.read_csv(study.report(figure_formats=("svg",)).with_name("verdicts.csv"))
    for noise, verdict in zip(("nominal", "outliers"), comparison.verdicts.values(), strict=True):
        logs = np.log(errors.loc[noise])
        d = (logs["sir"] - logs["ekf"]).to_numpy()
        means = np.add.outer(d, d)[np.triu_indices(len(d))] / 2
        lost = 1 - keeps.loc[noise][["sir", "ekf"]].all(axis=1).mean()
        ratio = np.exp(np.median(means)) if lost <= 0.2 else np.nan
        assert verdict.ratio == pytest.approx(ratio, rel=1e-5, nan_ok=True)
        view = rows.query("metric == 'rmse' and regime == @noise and filter == 'sir' and baseline == 'ekf'")  # fmt: skip
        for row in view.to_dict("records"):
            assert row["verdict"] in (verdict.word, "loses track")
            shown = [row[name] for name in ("ratio", "ratio_low", "ratio_high", "p")]
            np.testing.assert_allclose(verdict[3:7], shown, rtol=1e-3)
    assert "sir" in repr(comparison)
    assert len(comparison.table()) == 2
    with pytest.raises(ValueError, match="must have one condition, got 2"):
        _ = comparison.word
    check_refused(
        [
            (
                "filter must be a filter of the study, got 'sirr'",
                lambda: study.compare("sirr", "ekf"),
            )
        ],
        remedy=False,
    )


def test_summary_page_and_html(study: pfbench.Study, capsys: pytest.CaptureFixture[str]) -> None:
    summary = study.summary()
    page = study.report(figure_formats=("svg",)).with_name("report.md").read_text()
    assert summary.sentence in page
    for row in summary.rows:
        assert row[1] in page
    assert repr(summary) in repr(study)
    one = pfbench.run(WALK, ["ekf", "sir"], study="one", results_dir=study.results, **SMALL)
    for row in one.summary().rows:  # one number in the table, in errors() and on the console
        error = one.errors()[row[1].lower()].median()
        assert float(row[2].split()[0]) == pytest.approx(error, rel=5e-3)
        assert f"median RMS error {error:.4g} m" in capsys.readouterr().out or row[1] != "EKF"
    check_refused(
        [("label must be one of ekf, sir, got ukf. Similar: ekf", lambda: one.remove("ukf"))]
    )
    assert list(one.remove("sir").errors().columns) == ["ekf"]
    html = study._repr_html_()
    assert html.count("<tr>") == 4
    assert summary.rows[0][1] in html
    assert list(summary.table()["filter"]) == [row[1] for row in summary.rows]
    assert study.status().finished == 6
    assert repr(study.status()) == "s: 6 finished, 0 failed"


@pytest.mark.parametrize("kind", ["cost", "time", "calibration", "run"])
def test_figures_show_each_filter_once(study: pfbench.Study, kind: str) -> None:
    ax = study.plot(kind, noise="outliers", run=3)
    labels = {text.get_text().strip() for text in (*ax.texts, *ax.get_yticklabels())}
    legend = ax.get_legend()  # a value beyond the axis stands after the name
    labels |= {text.get_text().split()[0] for text in (legend.get_texts() if legend else ())}
    assert {"EKF", "SIR", "RPF"} <= labels
    check_refused(
        [
            ("must select one condition of the study, got 2", lambda: study.plot(kind)),
            ("kind must be one of cost, time, calibration, run", lambda: study.plot("pie")),
        ],
        remedy=False,
    )


def test_more_runs_are_those_of_one_longer_study(home: Path) -> None:
    part = pfbench.run(WALK, ["sir", "ekf"], study="a", progress=False, **SMALL)
    part.more(3, progress=False)
    full = pfbench.run(WALK, ["sir", "ekf"], study="b", progress=False, runs=7, particles=40)
    pd.testing.assert_frame_equal(part.errors(), full.errors())


def test_arrays_for_xarray(study: pfbench.Study) -> None:
    pytest.importorskip("xarray")
    data = study.to_xarray()
    assert data["error"].dims == ("condition", "filter", "run", "time", "state")
    job = study.conditions()[1].jobs[0]
    condition = study.conditions()[1].name
    selected = data["error"].sel(condition=condition, filter=job.label).to_numpy()
    assert np.array_equal(selected, job.load().data["error"])
    assert data.attrs["seed"] == 1


def test_names_list_what_the_command_line_lists(
    home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = pfbench.names("filter")
    said = command("list", "filter", home=home)
    lines = dict(line.split(maxsplit=1) for line in said.out.splitlines())
    assert {name: names[name] for name in lines} == lines
    assert names["tuned_baselines"].startswith("ekf_scaled_tuned")
    shown = pydoc.render_doc(pfbench.run, renderer=pydoc.plaintext)
    assert "runs: 'int' = 50, particles: 'int' = 500, seed: 'int' = 1" in shown
    assert not {
        k for k, v in compose([]).values.items() if type(v) is not dict and f"{k}" not in shown
    }
    assert "<td" in names._repr_html_()


def test_the_door_is_light() -> None:
    code = (
        "import sys, pfbench\n"
        "def loaded(names): return [name for name in names if name in sys.modules]\n"
        "print(loaded(('torch', 'pandas', 'numpy', 'hydra')))\n"
        "pfbench.names('filter'), pfbench.get('filter', 'sir', particles=3)\n"
        "print(loaded(('torch', 'pyro', 'hydra', 'matplotlib')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["[]", "[]"]


def test_an_own_module_imports_public_names_from_their_door() -> None:
    """The module of a private file would change the key of an own class whenever files move."""
    homes = {}
    for folder in (*FOLDERS, "job", "testing", "judge"):
        door = importlib.import_module(f"pfbench.{folder}")
        for name in door.__all__:
            value = getattr(door, name)
            room = str(getattr(value, "__module__", "")).partition("pfbench.")[2].partition(".")[0]
            if room in (folder, "logs") and getattr(value, "__qualname__", None) == name:
                homes[f"{folder}.{name}"] = own_source.find_home(value)
    assert len(homes) > 300
    wrong = {name: home for name, home in homes.items() if home != f"pfbench.{name.split('.')[0]}"}
    assert wrong == {}
