"""Readings of the papers: each composes, says why, and leaves no value of its world silent; a glob launches them all."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from command_line import pfbench
from config_cases import GROUPS

from pfbench import job
from pfbench.claims.claim_lines import read_claim_data
from pfbench.job.config import CLASSES, check_reading, name_readings
from pfbench.job.readings import make_reading, read_reading, read_reading_table
from pfbench.job.trust import UntrustedConfigError

PAPERS = ("000", "001", "002", "003", "004")
ROWS = [(paper, name) for paper in PAPERS for name in read_reading_table(paper)]
STATED: dict[tuple[str, str], dict[str, Any]] = {
    key: make_reading(*key)["reading"][key[0]] for key in ROWS
}
NOT_OF_THE_WORLD = ("paper", "cache_dir")


def leaves(node: Any, path: str) -> Iterator[str]:
    """Yield the dotted keys of the values of a world; a list is one value, unless it holds nodes."""
    if isinstance(node, Mapping):
        for key, value in node.items():
            if key not in NOT_OF_THE_WORLD:
                yield from leaves(value, f"{path}.{key}")
    else:
        yield path


def list_silent(values: Mapping[str, Any], stated: Mapping[str, Any]) -> list[str]:
    """List the keys of a world that a central reading neither cites nor completes."""
    keys = [
        key for kind in ("cites", "completions") for entry in stated[kind] for key in entry["keys"]
    ]
    world = [
        key for group in ("scenario", "model", "noise") for key in leaves(values[group], group)
    ]
    return [
        key for key in (*world, "particles")
        if not any(key == one or key.startswith(f"{one}.") for one in keys)
    ]  # fmt: skip


def compose(paper: str, name: str, *words: str) -> dict[str, Any]:
    return job.compose([f"reading/{paper}={name}", "episode_cache_dir=null", *words]).values


# what is written


def test_each_paper_has_a_central_reading_and_levels_of_its_factors() -> None:
    assert {paper for paper, _ in ROWS} == set(PAPERS)
    assert len(ROWS) >= 100
    for paper in PAPERS:
        assert STATED[paper, "central"]["factor"] == "none"
    for (paper, name), stated in STATED.items():
        check_reading(paper, stated)
        assert stated["class"] in CLASSES
        assert len(stated["why"].split()) > 1, (paper, name)
        assert (stated["factor"] == "none") == (name == "central")
        assert set(stated.get("filters") or {}) <= set(GROUPS["filter"]), (paper, name)
        assert name == "central" or make_reading(paper, name)["defaults"][0] == "central"


def test_a_level_that_is_fitted_is_not_central() -> None:
    fitted = {key for key, stated in STATED.items() if stated["class"] == "fitted"}
    assert {
        ("002", "bounds_fitted"),
        ("003", "interval_tenth"),
        ("004", "receiver_fitted"),
    } == fitted


@pytest.mark.parametrize("paper", PAPERS)
def test_no_value_of_a_central_world_is_silent(paper: str) -> None:
    """Each is printed, with equation, table or sentence, or completed, with a reason."""
    stated = STATED[paper, "central"]
    values = compose(paper, "central", "filter=sir")
    assert list_silent(values, stated) == []
    assert all(len(entry["place"].split()) > 1 for entry in stated["cites"])
    assert all(len(entry["why"].split()) > 1 for entry in stated["completions"])
    planted = {**values, "model": {**values["model"], "silent_choice": 1.0}}
    assert list_silent(planted, stated) == ["model.silent_choice"]


@pytest.mark.slow
@pytest.mark.parametrize(("paper", "name"), ROWS)
def test_each_reading_builds_its_world_and_the_filters_that_it_sets(paper: str, name: str) -> None:
    for method in list(STATED[paper, name].get("filters") or {"sir": {}})[:2]:
        values = compose(paper, name, f"filter={method}")
        assert "reading" not in values
        for group in ("scenario", "model", "noise", "filter"):
            job.instantiate(values[group])


# what a reading does


def test_a_reading_sets_the_world_and_the_named_filter_alone() -> None:
    values = compose("001", "resampling_half", "filter=sir")
    assert values["filter"]["resampler"]["ess_threshold"] == 0.5
    assert values["scenario"]["aircraft_velocity"][0] == 20.0
    assert values["particles"] == 400
    assert compose("001", "central", "filter=sir")["filter"]["resampler"]["ess_threshold"] == 1.0
    assert compose("001", "speed_200", "filter=sir")["scenario"]["aircraft_velocity"][0] == 200.0
    plain = job.compose(["filter=gpf"]).values["filter"]
    assert compose("001", "resampling_half", "filter=gpf")["filter"] == {**plain, "particles": 400}
    chosen = compose("001", "central", "filter=sir", "scenario=passive_3", "particles=50")
    assert chosen["scenario"]["measurement_sd"][0] == pytest.approx(0.0357)
    assert chosen["particles"] == 50


def flatten(values: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """Map the dotted keys of a job to their values, without those that are null."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        inner = f"{path}.{key}".lstrip(".")
        flat |= flatten(value, inner) if isinstance(value, Mapping) and value else {inner: value}
    return {key: value for key, value in flat.items() if value is not None}


@pytest.mark.parametrize(
    ("paper", "levels", "method"),
    [
        ("001", ("grid_4", "shift_centred", "speed_200"), "qmc_polymerised_printed"),
        ("002", ("guide_moments", "receiver_3"), "cpf"),
        ("004", ("chaos_020", "learning_2", "receiver_fine"), "cpso_pf"),
    ],
)
def test_a_joint_reading_is_all_of_its_levels_and_nothing_else(
    paper: str, levels: tuple[str, ...], method: str
) -> None:
    central, *single, joint = (
        flatten(compose(paper, one, f"filter={method}"))
        for one in ("central", *levels, "_and_".join(levels))
    )
    changed = [{key: one[key] for key in one if one[key] != central.get(key)} for one in single]
    assert all(changed)
    assert sum(map(len, changed)) == len({key for one in changed for key in one})
    merged = dict(central)
    for one in changed:
        merged |= one
    assert joint == merged
    assert read_reading(paper, "_and_".join(levels))["factor"] == "joint"


@pytest.mark.parametrize("paper", PAPERS)
def test_the_world_of_the_figures_is_a_reading_of_the_paper(paper: str) -> None:
    """One world a paper: a study, its figures and the ledger cannot differ but by levels that have a name."""
    for study, reading in read_claim_data()["papers"][paper]["figures"].items():
        own, named = (
            {key: value for key, value in flatten(job.compose([*words, "filter=sir"]).values).items() if is_of_world(key)}
            for words in ([f"+experiment={study}"], [f"reading/{paper}={reading}"])
        )  # fmt: skip
        keys = own.keys() | named.keys()
        assert {key for key in keys if own.get(key, DEFAULT.get(key)) != named.get(key, DEFAULT.get(key))} == set()  # fmt: skip


DEFAULT = {"scenario.initial_errors.randomise": True, "model.initial.randomise": True}


def is_of_world(key: str) -> bool:
    """Return whether a key is of the world, and no name of it."""
    group, *rest = key.split(".")
    return group in ("scenario", "model", "noise", "particles") and "paper" not in rest


def test_a_joint_reading_has_one_level_of_a_factor() -> None:
    for name in ("grid_4_and_grid_16", "central_and_grid_4"):
        with pytest.raises(ValueError, match=r"reading/001 must join levels of different factors"):
            read_reading("001", name)
    fitted = make_reading("003", "interval_tenth_and_noise_5")["reading"]["003"]
    assert fitted["class"] == "fitted"


def test_a_number_of_a_paper_is_a_group() -> None:
    words = ["reading/001=a", "+reading/002=glob(*)", "study=reading/003=x", "filter=sir"]
    assert name_readings(words) == [
        "reading/paper_001=a", "+reading/paper_002=glob(*)", "study=reading/003=x", "filter=sir",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        ({"factor": "a", "why": "b"}, r"reading.001 must state factor, class and why"),
        (
            {"factor": "a", "class": "mine", "why": "b"},
            r"class must be one of printed, cited, ours, fitted",
        ),
        (
            {"factor": "a", "class": "ours", "why": "b", "filters": ["sir"]},
            r"filters must give keys",
        ),
        ({"factor": "a", "class": "ours", "why": "b", "more": 1}, r"perhaps filters, cites"),
    ],
)
def test_a_reading_that_does_not_say_what_it_is_is_told(
    stated: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        check_reading("001", stated)


def foreign(folder: Path, text: str) -> list[str]:
    """Write a level of somebody else, and return the words that choose it."""
    file = folder / "reading" / "paper_001" / "theirs.yaml"
    file.parent.mkdir(parents=True)
    file.write_text(text)
    return [f"hydra.searchpath=[file://{folder}]", "reading/001=theirs", "filter=sir"]


HEAD = "# @package _global_\n# A level of an author.\ndefaults: [central, _self_]\nreading:\n  '001': {factor: speed, class: ours, why: ours is faster}\n"


def test_a_level_of_an_author_is_a_file_and_may_set_the_world_only(tmp_path: Path) -> None:
    words = foreign(tmp_path / "a", HEAD + "scenario: {aircraft_velocity: [60.0, 0.0, 0.0]}\n")
    assert job.compose(words).values["scenario"]["aircraft_velocity"][0] == 60.0
    for k, line in enumerate(("results_dir: /tmp/x", "trust: [os]", "hydra: {job: {chdir: true}}")):
        with pytest.raises(UntrustedConfigError):
            job.compose(foreign(tmp_path / f"b{k}", f"{HEAD}{line}\n"))
    with pytest.raises(UntrustedConfigError, match="public class"):
        job.compose(foreign(tmp_path / "c", HEAD.replace("why: ours is faster", "why: x, filters: {sir: {moves: [{_target_: os.system}]}}")))  # fmt: skip


def count_launched(output: Sequence[str], paper: str) -> set[str]:
    lines = [line for line in output if f"reading/paper_{paper}=" in line]
    return {line.partition(f"reading/paper_{paper}=")[2].split()[0] for line in lines}


@pytest.mark.slow
def test_a_glob_launches_all_readings_of_a_paper(tmp_path: Path) -> None:
    words = ("scenario.steps=2", "runs=2", "particles=20", "filter=sir", "study=all")
    said = pfbench("run", "-m", "reading/001=glob(*)", *words, home=tmp_path)
    assert said.code == 0, said.err
    wanted = {name for paper, name in ROWS if paper == "001"}
    assert count_launched(f"{said.out}\n{said.err}".splitlines(), "001") == wanted
