"""A result is whole or absent, says what it is, and has one name."""

import json
import os
import signal
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from checkout import TESTS
from hypothesis import given, strategies as st
from refusals import check_refused
from synthetic_results import list_results

from pfbench.results import store, store as config_key
from pfbench.results.store import compute_config_key

R, T, D = 3, 5, 2
STATE = {"names": ["x", "v"], "units": ["m", "m/s"], "groups": {"position": [0], "b_velocity": [1]}}


def meta(key="0123456789abcdef", label="sir", scenario="walk", noise="nominal", seed=1):
    choices = {"scenario": scenario, "noise": noise, "filter": label, "model": "toy"}
    return {
        "key": key,
        "study": "demo",
        "choices": choices,
        "config": {"filter": {"particles": 100}},
        "label": label,
        "seed": seed,
        "runs": R,
        "state": STATE,
    }


def arrays(fill=1.0):
    return {
        "time": np.arange(T, dtype=np.float64),
        "error": np.full((R, T, D), fill, np.float32),
        "sd": np.ones((R, T, D), np.float32),
        "nees": np.ones((R, T, 2), np.float32),
        "log_evidence": np.arange(R, dtype=np.float64),
        "lost": np.array([False, True, False]),
        "ess": np.full((R, T), 50, np.float32),
    }


CONFIGS = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-9, 9)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=5),
    lambda below: (
        st.lists(below, max_size=3)
        | st.dictionaries(st.text(min_size=1, max_size=5), below, max_size=4)
    ),
    max_leaves=12,
)


def reversed_deep(config):
    if isinstance(config, dict):
        return {name: reversed_deep(config[name]) for name in reversed(config)}
    return [reversed_deep(item) for item in config] if isinstance(config, list) else config


@given(st.dictionaries(st.text(min_size=1, max_size=5), CONFIGS, max_size=4))
def test_key_knows_content_not_order(config):
    name = compute_config_key(config)
    assert name == compute_config_key(reversed_deep(config))
    assert len(name) == 16
    assert set(name) <= set("0123456789abcdef")


def test_key_survives_the_process():
    code = "from pfbench.results.store import compute_config_key; print(compute_config_key({'b': [1, 2.5, None], 'a': {'c': 'ü'}}))"
    environment = {**os.environ, "PYTHONHASHSEED": "77"}
    other = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment
    )
    assert other.stdout.strip() == compute_config_key({"a": {"c": "ü"}, "b": [1, 2.5, None]})


def test_ignored_paths_change_nothing_and_others_do():
    here = {"seed": 1, "results": "a", "data": {"root": "x", "name": "log"}, "threads": 1}
    there = {"seed": 1, "results": "b", "data": {"root": "y", "name": "log"}, "threads": 8}
    ignore = ("results", "data.root", "threads", "absent.path")
    assert compute_config_key(here, ignore) == compute_config_key(there, ignore)
    assert compute_config_key(here, ignore) != compute_config_key({**here, "seed": 2}, ignore)
    assert compute_config_key(here, ignore) != compute_config_key(
        {**here, "data": {"root": "x", "name": "other"}}, ignore
    )
    assert compute_config_key(here, ("data",)) == compute_config_key(
        {k: v for k, v in here.items() if k != "data"}
    )


def test_the_generator_is_part_of_the_key_and_the_engine_in_single_precision(monkeypatch):
    """Engines agree to rounding in double precision only."""
    keys = {
        (dtype, engine): compute_config_key({"dtype": dtype, "engine": engine}, ("engine",))
        for dtype in ("float64", "float32")
        for engine in ("eager", "kernels")
    }
    assert keys["float64", "eager"] == keys["float64", "kernels"]
    assert len(set(keys.values())) == 3
    monkeypatch.setattr(config_key, "GENERATOR_VERSION", 0)
    assert (
        compute_config_key({"dtype": "float64", "engine": "eager"}, ("engine",))
        not in keys.values()
    )


@pytest.mark.parametrize("value", [float("nan"), {1, 2}, np.zeros(2)])
def test_key_refuses_what_json_cannot_say(value):
    check_refused(
        [
            (
                r"configuration must be numbers|filter\.gain must be finite",
                lambda: compute_config_key({"filter": {"gain": value}}),
            )
        ],
        remedy=False,
    )


def test_what_is_read_is_what_was_written(tmp_path):
    path = store.write_result(tmp_path / "new" / f"{meta()['key']}.npz", meta(), arrays(1 / 3))
    result = store.read_result(path)
    assert result.meta == {"format": 2, **meta()}
    assert list(result.meta["state"]["groups"]) == [
        "position",
        "b_velocity",
    ]  # the order of the last axis of nees
    assert result.data.keys() == arrays().keys()
    for name, value in arrays(1 / 3).items():
        assert result.data[name].dtype == value.dtype
        np.testing.assert_array_equal(result.data[name], value)


def test_numpy_alone_reads_it(tmp_path):
    path = store.write_result(tmp_path / "a.npz", meta(), arrays())
    with np.load(path, allow_pickle=False) as file:
        assert json.loads(str(file["meta"]))["label"] == "sir"
        assert file["error"].shape == (R, T, D)


def test_an_exception_in_the_middle_leaves_the_folder_as_it_was(tmp_path, monkeypatch):
    old = f"{meta()['key']}.npz"
    store.write_result(tmp_path / old, meta(), arrays(1.0))

    def half(file, **members):
        file.write(b"PK half a file")
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez_compressed", half)
    for name in ("new.npz", old):
        with pytest.raises(OSError, match="disk full"):
            store.write_result(tmp_path / name, meta(), arrays(2.0))
    assert [path.name for path in tmp_path.iterdir()] == [old]
    assert store.read_result(tmp_path / old).data["error"][0, 0, 0] == 1.0


def test_a_kill_in_the_middle_leaves_no_result_and_the_next_save_sweeps_up(tmp_path):
    code = textwrap.dedent(
        f"""
        import os, signal, sys
        sys.path[:0] = [{str(TESTS)!r}, {str(TESTS / "results")!r}]
        import numpy as np
        import test_store as t
        from pfbench.results import store
        def half(file, **members):
            file.write(b"PK half a file"); file.flush()
            os.kill(os.getpid(), signal.SIGKILL)
        np.savez_compressed = half
        store.write_result({str(tmp_path)!r} + "/a.npz", t.meta(), t.arrays())
        """
    )
    killed = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert killed.returncode == -signal.SIGKILL, killed.stderr.decode()
    assert len(list(tmp_path.glob("a.*.tmp"))) == 1
    assert not (tmp_path / "a.npz").exists()
    assert list(list_results(tmp_path)) == []
    store.write_result(tmp_path / "b.npz", meta(), arrays())
    assert len(list(tmp_path.glob("a.*.tmp"))) == 1  # another key is none of its business
    store.write_result(tmp_path / "a.npz", meta(), arrays())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npz", "b.npz"]


DAMAGES = {
    "cut": lambda raw: raw[: len(raw) // 2],
    "flip": lambda raw: raw[:200] + bytes(255 - byte for byte in raw[200:400]) + raw[400:],
    "empty": lambda raw: b"",
    "prose": lambda raw: b"these are not the results",
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_named(tmp_path, damage):
    path = store.write_result(tmp_path / "a.npz", meta(), arrays())
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    check_refused([(r"a\.npz is damaged", lambda: store.read_result(path))], remedy=False)


def test_a_foreign_or_other_format_file_is_named(tmp_path):
    np.savez(tmp_path / "foreign.npz", x=np.zeros(3))
    check_refused(
        [
            (
                r"foreign\.npz must be a result of pfbench, got a file without 'meta'",
                lambda: store.read_result(tmp_path / "foreign.npz"),
            )
        ],
        remedy=False,
    )
    np.savez(tmp_path / "future.npz", meta=np.array(json.dumps({"format": 99})))
    check_refused(
        [(r"must have format 2, got 99", lambda: store.read_result(tmp_path / "future.npz"))],
        remedy=False,
    )
    np.save(tmp_path / "single.npy", np.zeros(3))
    (tmp_path / "single.npy").rename(tmp_path / "single.npz")
    check_refused(
        [("single array", lambda: store.read_result(tmp_path / "single.npz"))], remedy=False
    )
    with pytest.raises(FileNotFoundError, match=r"absent\.npz does not exist"):
        store.read_result(tmp_path / "absent.npz")


def test_save_refuses_what_readers_could_not_use(tmp_path):
    def save(data=None, about=None):
        store.write_result(tmp_path / "a.npz", about or meta(), data or arrays())

    check_refused([
        ("must contain the arrays lost", lambda: save({k: v for k, v in arrays().items() if k != "lost"})),
        (r"sd must have shape .* got \(3, 5, 1\)", lambda: save({**arrays(), "sd": np.ones((R, T, 1))})),
        ("note must be numbers, booleans or texts, got Python objects", lambda: save({**arrays(), "note": np.array([{}, None])})),
        ("metadata must contain choices", lambda: save(about={k: v for k, v in meta().items() if k != "choices"})),
    ], remedy=False)  # fmt: skip
    assert not list(tmp_path.iterdir())


def test_repeated_run_numbers_are_refused(tmp_path):
    numbers, path = np.arange(R), tmp_path / f"{meta()['key']}.npz"
    store.write_result(path, meta(), {**arrays(), "run": numbers})
    assert np.array_equal(store.read_result(path).data["run"], numbers)
    numbers[1] = numbers[0]
    check_refused(
        [
            (
                r"run must have distinct run numbers, got 0 2 times",
                lambda: store.write_result(path, meta(), {**arrays(), "run": numbers}),
            )
        ],
        remedy=False,
    )
    with pytest.MonkeyPatch.context() as patch:  # a file that another program wrote
        patch.setattr(store, "check_arrays", lambda *_: None)
        store.write_result(path, meta(), {**arrays(), "run": numbers})
    check_refused(
        [("run must have distinct run numbers", lambda: store.read_result(path))], remedy=False
    )
    for first in (-1, 2**32 - R + 1, 0.5):
        with pytest.raises(ValueError, match="first_run must be a whole number from 0"):
            store.write_result(tmp_path / "b.npz", {**meta(), "first_run": first}, arrays())


def test_failure_is_noted_until_a_success(tmp_path):
    path = tmp_path / "a.npz"
    try:
        raise FloatingPointError("not positive definite")
    except FloatingPointError as error:
        note = store.write_failure(path, meta()["choices"], error)
    assert note == tmp_path / "a.failed.json"
    (found,) = store.list_failures(tmp_path)
    assert found["key"] == "a"
    assert found["message"] == "FloatingPointError: not positive definite"
    assert "raise FloatingPointError" in found["traceback"]
    store.write_result(path, meta(), arrays())
    assert store.list_failures(tmp_path) == []
    assert not note.exists()


def test_failure_never_touches_a_good_result(tmp_path):
    path = store.write_result(tmp_path / "a.npz", meta(), arrays())
    before = path.read_bytes()
    assert store.write_failure(path, meta()["choices"], RuntimeError("later")) is None
    assert path.read_bytes() == before
    assert store.list_failures(tmp_path) == []


def test_results_come_in_order_of_content(tmp_path):
    wanted = [
        ("a", "n", "ekf", 1),
        ("a", "n", "sir", 1),
        ("a", "n", "sir", 2),
        ("a", "o", "ekf", 1),
        ("b", "n", "ekf", 1),
    ]
    for place, (scenario, noise, label, seed) in zip([3, 0, 4, 1, 2], wanted, strict=True):
        described = meta(f"{place:016x}", label, scenario, noise, seed)
        store.write_result(tmp_path / f"{place:016x}.npz", described, arrays())
    found = [(r.meta["choices"]["scenario"], r.meta["choices"]["noise"], r.meta["label"], r.meta["seed"])
             for r in list_results(tmp_path)]  # fmt: skip
    assert found == wanted
