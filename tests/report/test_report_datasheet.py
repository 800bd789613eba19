"""The page of a datasheet: figures where there are data, a sentence where there are none, numbers that are right."""

import re
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
import synthetic_results as synthetic
import torch
from checkout import ROOT
from command_line import block, pfbench

from pfbench.core.record import Episode, Record
from pfbench.job import datasheet_data
from pfbench.model.linear_gaussian import LinearGaussian, linear_walk
from pfbench.noise.base import NominalNoise
from pfbench.report import datasheet, scenario_figures
from pfbench.results import status, store
from pfbench.results.plotting import RC
from pfbench.scenario.simulated import ModelSimulation

STEPS, RUNS, SLOTS = 30, 6, 4
META: dict[str, Any] = {
    "key": "0123456789abcdef", "study": "datasheets", "label": "datasheet", "seed": 1, "first_run": 0, "runs": RUNS,
    "steps": STEPS, "choices": {"scenario": "flight", "noise": "nominal", "model": "ins_gnss", "filter": "none"},
    "config": {"scenario": {"interval": 1.0}}, "about": "A <b>made up</b> flight.", "kinds": ["range"] * SLOTS + ["rate"],
    "satellites": ["G01", "G02", "G07", "G30"], "modelling_choices": ["nothing"], "state": synthetic.STATE,
    "pcrb": "posterior Cramer-Rao bound of the model", "versions": synthetic.VERSIONS,
    "seconds": {"world": 1.0, "measures": 0.5},
}  # fmt: skip


def arrays(rng: np.random.Generator) -> dict[str, np.ndarray]:
    time = np.arange(1.0, STEPS + 1)
    up = np.column_stack([np.linspace(0.3, 0.6, STEPS)] * SLOTS)
    up[:10, 2] = np.nan
    return {
        "time": time,
        "error": (rng.standard_normal((RUNS, 1, 9)) * time[:, None]).astype(np.float32),
        "sd": np.full((RUNS, STEPS, 9), np.nan, np.float32),
        "nees": np.full((RUNS, STEPS, 3), np.nan, np.float32),
        "log_evidence": np.full(RUNS, np.nan),
        "lost": np.zeros(RUNS, bool),
        "residual": rng.standard_normal((RUNS, STEPS, SLOTS + 1)).astype(np.float32),
        "seen": np.column_stack([np.ones((STEPS, SLOTS)), time > 5]).astype(np.float32),
        "track": np.broadcast_to(
            np.column_stack([3 * time, 4 * time, 0 * time]), (RUNS, STEPS, 3)
        ).astype(np.float32),
        "force": rng.standard_normal((STEPS, 3)).astype(np.float32),
        "rate": rng.standard_normal((STEPS, 3)).astype(np.float32),
        "azimuth": np.where(np.isnan(up), np.nan, np.arange(SLOTS) * 1.5 + 0.001 * time[:, None]),
        "elevation": up,
        "pcrb": np.full((STEPS, 9), 0.5, np.float32),
    }


@pytest.fixture
def whole() -> store.JobResult:
    return store.JobResult(META, arrays(np.random.default_rng(4)))


def without(sheet: store.JobResult, *names: str, **more: Any) -> store.JobResult:
    return store.JobResult(
        {**sheet.meta, **more}, {k: v for k, v in sheet.data.items() if k not in names}
    )


def names(sheet: store.JobResult) -> list[str]:
    return [drawing.name for drawing in datasheet.datasheet_figures(sheet)]


def test_every_figure_is_drawn_where_there_are_data(whole: store.JobResult, tmp_path: Path) -> None:
    file = store.write_result(tmp_path / "results" / "0123456789abcdef.npz", whole.meta, whole.data)
    page = datasheet.write_datasheet(file, tmp_path / "reports")
    assert page == tmp_path / "reports" / "datasheets" / "flight_nominal" / "index.html"
    drawn = {path.name for path in (page.parent / "figures").iterdir()}
    wanted = ("track", "sensors", "sky", "seen", "residuals", "residuals_time", "spread")
    assert drawn == {
        f"flight_nominal_{name}.{ending}" for name in wanted for ending in ("svg", "png")
    }
    text = page.read_text()
    assert "<b>made up" not in text  # a stranger's text is no markup
    assert "Cramér-Rao bound" in text
    assert text.count("<img ") == len(wanted)
    assert "Missing figures" not in text
    assert "Track of the first run: 0.145 km" in text  # 29 steps of 5 m
    assert "Satellites above the horizon: 3 to 4 of 4." in text
    first = {path: path.read_bytes() for path in page.parent.rglob("*") if path.is_file()}
    datasheet.write_datasheet(file, tmp_path / "reports")
    assert {path: path.read_bytes() for path in page.parent.rglob("*") if path.is_file()} == first


def test_what_is_missing_is_said_and_not_drawn(whole: store.JobResult) -> None:
    none = without(
        whole, "track", "force", "rate", "azimuth", "elevation", "pcrb", pcrb="no bound: recorded"
    )
    assert names(none) == ["seen", "residuals", "residuals_time", "spread"]
    said = " ".join(datasheet.list_missing_figures(none))
    for part in ("Track:", "Specific force", "Satellites:"):
        assert part in said
    assert any(fact == "No bound: recorded." for fact in datasheet.list_facts(none))
    still = none.data | {"error": 0 * none.data["error"], "seen": np.ones((STEPS, SLOTS + 1))}
    assert names(store.JobResult(none.meta, still)) == ["residuals", "residuals_time"]
    assert (
        "Spread of attitude, velocity, position: equal in all runs."
        in datasheet.list_missing_figures(store.JobResult(none.meta, still))
    )
    blind = none.data | {
        "error": none.data["error"] * np.nan,
        "residual": none.data["residual"].copy(),
    }
    blind["residual"][..., :3] = np.nan
    said = " ".join(datasheet.list_missing_figures(store.JobResult(none.meta, blind)))
    assert "Residuals of range (3 of 4)" in said
    assert "Spread of attitude, velocity, position: the truth is not available." in said


def test_old_or_other_files_are_refused(tmp_path: Path) -> None:
    file = synthetic.write(tmp_path / "demo", synthetic.METHODS[0], runs=3, steps=5)
    with pytest.raises(ValueError, match="file must be a datasheet, got the job"):
        datasheet.write_datasheet(file, tmp_path)


def test_the_spread_is_the_deviation_over_runs_beside_the_bound(whole: store.JobResult) -> None:
    whole.data["error"][:, 7] = np.nan  # an instant without truth is no gap
    panels = scenario_figures.plot_error_spread(whole).axes
    error = np.delete(whole.data["error"].astype(float), 7, axis=1)
    assert [axis.get_title() for axis in panels] == ["attitude", "velocity", "position"]
    for axis, first, scale in zip(panels, (0, 3, 6), (60 * np.degrees(1), 1.0, 1.0), strict=True):
        value, bound = axis.lines
        square = (error[..., first : first + 3] ** 2).sum(-1).sum(0) / (RUNS - 1)
        np.testing.assert_allclose(value.get_ydata(), np.sqrt(square) * scale, rtol=1e-5)
        np.testing.assert_allclose(
            bound.get_ydata(), np.full(STEPS - 1, np.sqrt(0.75) * scale), rtol=1e-5
        )


def test_the_sky_has_north_up_and_east_to_the_right_and_names(whole: store.JobResult) -> None:
    with matplotlib.rc_context(RC):
        figure = scenario_figures.plot_sky(whole)
        figure.canvas.draw()
    (axis,) = figure.axes
    centre, north, east = (
        axis.transData.transform(point) for point in ((0.0, 0.0), (0.0, 45.0), (np.pi / 2, 45.0))
    )
    assert north[1] - centre[1] > 10 > abs(north[0] - centre[0])
    assert east[0] - centre[0] > 10 > abs(east[1] - centre[1])
    assert {text.get_text() for text in axis.texts} >= {"G01", "G02", "G07", "G30"}
    lines = [line for line in axis.lines if len(np.asarray(line.get_xdata())) > 2]
    np.testing.assert_allclose(lines[0].get_ydata(), 90 - np.degrees(whole.data["elevation"][:, 0]))
    assert [len(np.asarray(line.get_xdata())) for line in lines] == [
        STEPS,
        STEPS,
        STEPS - 10,
        STEPS,
    ]
    visible = scenario_figures.plot_measurements(whole).axes[0].lines[0].get_ydata()
    np.testing.assert_array_equal(visible, [3] * 10 + [4] * (STEPS - 10))


def test_a_scene_may_spell_its_satellites_and_show_them_at_some_steps_alone(
    whole: store.JobResult,
) -> None:
    assert scenario_figures.list_satellites(whole) == ["G01", "G02", "G07", "G30"]
    codes = [[ord(letter) for letter in name] for name in ("E1 ", "R24", "G05", "C06")]
    spelled = whole.data | {"satellites": np.array(codes, np.float32)}
    for name in ("azimuth", "elevation"):
        spelled[name] = np.where(np.arange(STEPS)[:, None] % 3 == 0, spelled[name], np.nan)
    sheet = store.JobResult(whole.meta, spelled)
    assert scenario_figures.list_satellites(sheet) == ["E1", "R24", "G05", "C06"]
    assert any(
        fact == "Satellites above the horizon: 3 to 4 of 4." for fact in datasheet.list_facts(sheet)
    )
    line = scenario_figures.plot_measurements(sheet).axes[0].lines[0]
    assert line.get_linestyle() == "None"
    np.testing.assert_array_equal(line.get_xdata(), np.arange(1.0, STEPS + 1, 3))
    assert {text.get_text() for text in scenario_figures.plot_sky(sheet).axes[0].texts} >= {
        "E1",
        "R24",
        "G05",
        "C06",
    }


def test_runs_with_the_same_residuals_count_once(whole: store.JobResult) -> None:
    table = datasheet.whiteness_table(whole)
    assert table["residuals"].tolist() == [RUNS * STEPS * SLOTS, RUNS * STEPS]
    whole.data["residual"][:] = whole.data["residual"][:1]
    assert datasheet.whiteness_table(whole)["residuals"].tolist() == [STEPS * SLOTS, STEPS]
    assert any("counted once" in fact for fact in datasheet.list_facts(whole))


# the measures


def test_white_normal_numbers_lie_in_their_bands_and_others_do_not() -> None:
    rng = np.random.default_rng(2)
    white = rng.standard_normal((20, 200, 3))
    law = status.compute_whiteness(white)
    # bands are of 1.96 standard errors: three of them allow 5.9
    assert abs(law.mean) < 3 * law.mean_band
    assert abs(law.variance - 1) < 3 * law.variance_band
    assert abs(law.lag) < 3 * law.lag_band
    assert law.numbers == 12000
    assert law.variance_band == pytest.approx(1.96 * np.sqrt(2 / 12000))
    assert law.lag_band == pytest.approx(1.96 / np.sqrt(20 * 199 * 3))
    assert status.compute_whiteness(white + 0.2).mean > 5 * law.mean_band
    assert status.compute_whiteness(1.1 * white).variance > 1 + 5 * law.variance_band
    slow = white.copy()
    for t in range(1, 200):
        slow[:, t] = 0.5 * slow[:, t - 1] + np.sqrt(0.75) * white[:, t]
    assert status.compute_whiteness(slow).lag == pytest.approx(0.5, abs=0.05)


def test_neighbours_are_the_measurements_next_to_each_other() -> None:
    z = np.full((1, 9, 1), np.nan)
    z[0, ::2, 0] = [1.0, -1.0, 1.0, -1.0, 1.0]
    law = status.compute_whiteness(z)
    assert law.lag == -1.0
    assert law.lag_band == pytest.approx(1.96 / 2)
    assert law.variance == 1.0
    empty = status.compute_whiteness(z * np.nan)
    assert empty.numbers == 0
    assert np.isnan(empty.variance)


WALK = ("scenario=linear_walk", "scenario.steps=12")
PAGE = ROOT / "docs" / "write_a_scenario.md"


def doubles(values: Any) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


# measures


def test_residuals_at_the_truth_are_the_errors_that_were_drawn() -> None:
    model = linear_walk(1.0, 0.5, 2.0)
    episode = ModelSimulation(model, steps=30).draw(NominalNoise(), torch.arange(40), seed=3)
    truth = model.assemble(episode.truth)
    z = datasheet_data.compute_residuals(model, truth, episode)
    assert torch.allclose(z[..., 0], (episode.record.y[..., 0] - truth[..., 0]) / 2.0)
    assert abs(float(z.var()) - 1.0) < 4 * (2 / z.numel()) ** 0.5


def test_a_residual_that_hangs_on_an_unknown_state_is_unknown_and_no_other() -> None:
    eye = np.eye(3)
    # the first state is seen alone, the two unknown ones by their difference, and all by their sum
    h = [[1.0, 0.0, 0.0], [0.0, 1.0, -1.0], [1.0, 1.0, 1.0]]
    model = LinearGaussian(eye, eye, h, [2.0, 1.0, 1.0], np.zeros(3), np.ones(3))
    truth = doubles([[[4.0, np.nan, np.nan]], [[1.0, 2.0, 3.0]]])
    y = doubles([[[6.0, 0.0, 0.0]], [[np.nan, 0.0, 5.0]]])
    z = datasheet_data.compute_residuals(model, truth, Episode(Record(y), doubles([1.0]), {}))[:, 0]
    nan = np.nan
    np.testing.assert_allclose(z.numpy(), [[1.0, nan, nan], [nan, 1.0, -1.0]])


def test_deviations_are_about_the_mean_of_the_runs_that_have_a_truth() -> None:
    model = linear_walk(1.0, 0.5, 2.0)
    truth = doubles([[[1.0, 5.0]], [[3.0, np.nan]], [[8.0, 7.0]]])
    np.testing.assert_allclose(
        datasheet_data.compute_deviations(model, truth)[:, 0].numpy(),
        [[-3.0, -1.0], [-1.0, np.nan], [4.0, 1.0]],
    )


# the command


def test_a_scene_becomes_a_file_and_a_page_and_is_not_drawn_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    said = pfbench("datasheet", *WALK, "runs=6", home=tmp_path)
    assert said.code == 0, said.err
    page = tmp_path / "reports" / "datasheets" / "linear_walk_nominal" / "index.html"
    assert f"datasheet: {page.resolve()}" in said.out
    text = page.read_text()
    assert "12 steps" in text
    assert "6 runs" in text
    assert "Posterior Cramer-Rao bound" in text
    (file,) = (tmp_path / "results" / "datasheets").glob("*.npz")
    stamp, drawn = file.stat().st_mtime_ns, page.stat().st_mtime_ns
    assert (
        pfbench("datasheet", *WALK, "runs=6", "filter=ekf", "particles=7", home=tmp_path).code == 0
    )  # nothing of the scene
    assert file.stat().st_mtime_ns == stamp
    assert page.stat().st_mtime_ns > drawn
    assert pfbench("datasheet", *WALK, "runs=6", "overwrite=true", home=tmp_path).code == 0
    assert file.stat().st_mtime_ns > stamp
    assert (
        pfbench("datasheet", *WALK, "noise=student", home=tmp_path).code == 0
    )  # as many runs as it takes by itself
    other = (tmp_path / "reports" / "datasheets" / "linear_walk_student" / "index.html").read_text()
    assert f"{datasheet_data.RUNS} runs" in other
    assert "No bound: measurement distribution must be normal" in other
    assert f"{datasheet_data.RUNS} runs" in other


def test_a_page_needs_only_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert pfbench("datasheet", *WALK, "runs=3", home=tmp_path).code == 0
    (file,) = (tmp_path / "results" / "datasheets").glob("*.npz")
    elsewhere = datasheet.write_datasheet(file, tmp_path / "elsewhere")
    assert (
        elsewhere.read_bytes()
        == (tmp_path / "reports" / "datasheets" / "linear_walk_nominal" / "index.html").read_bytes()
    )


MISTAKES = {
    "unknown scenario": (
        ("scenario=flight_30s",),
        "scenario=flight_30s does not exist. Similar: flight_300s",
    ),
    "no data": (("scenario=recorded_berlin",), "data.root"),
    "no runs": ((*WALK, "runs=0"), "runs must be a whole number of at least 1, got 0"),
    "unknown key": ((*WALK, "scenario.stps=3"), "Similar: scenario.steps."),
    "bound": ((*WALK, "pcrb=maybe"), "pcrb must be auto"),
    "no scenario": (
        ("noise=student",),
        "scenario must be set. Use: pfbench datasheet scenario=NAME",
    ),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_mistakes_are_told_as_elsewhere(tmp_path: Path, case: str) -> None:
    words, message = MISTAKES[case]
    said = pfbench("datasheet", *words, home=tmp_path)
    assert said.code == 2
    assert message in said.err
    assert not list(tmp_path.rglob("*.npz"))


OLD_COMMANDS = {
    ("report", "scenario=flight_300s"): "pfbench datasheet scenario=flight_300s",
    ("report", "study=datasheets"): "pfbench datasheet scenario=NAME",
    ("report", "study=claims"): "pfbench claims",
}


@pytest.mark.parametrize("words", OLD_COMMANDS)
def test_an_old_command_names_the_new_one(tmp_path: Path, words: tuple[str, ...]) -> None:
    said = pfbench(*words, home=tmp_path)
    assert said.code == 2
    assert f"se: {OLD_COMMANDS[words]}" in said.err


def test_a_study_with_a_scenario_is_still_a_study(tmp_path: Path) -> None:
    said = pfbench("report", "study=none", *WALK, home=tmp_path)
    assert said.code == 2
    assert "study must be a study with results, got none" in said.err


@pytest.mark.slow
def test_the_page_write_a_scenario_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for language, code in re.findall(
        r"^```(python|bash)\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE
    ):
        if language == "python":
            exec(compile(code, PAGE.name, "exec"), names)
        else:
            block(code, tmp_path)
    assert (tmp_path / "reports" / "datasheets" / "survey_nominal" / "index.html").exists()
    assert len(list(tmp_path.glob("results/mine/*.npz"))) == 2
    assert "Cramer-Rao bound" in (tmp_path / "reports" / "mine" / "index.html").read_text()
