"""pneud as a library: logs and runs as columns, motions and figures; every example of a docstring."""

from __future__ import annotations

import builtins
import doctest
import gc
import json
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import pneud
from commands import object_of, pneud_here
from pneud.config.reading import load_config
from pneud.log.files.reader import read_log as plain_log
from pneud.notebook import frames, html, logs, runs
from pneud.notebook.runs import Run
from pneud.notebook.summary import Summary, summary_of

DURATION_S = 0.6


@pytest.fixture(scope="module")
def run() -> Run:
    return pneud.simulate("virtual.toml", DURATION_S, 1)


@pytest.fixture(scope="module")
def log(run: Run, tmp_path_factory: pytest.TempPathFactory) -> logs.Log:
    return pneud.read_log(run.save(tmp_path_factory.mktemp("kept") / "run.mcap"))


def examples(module: ModuleType) -> list[doctest.DocTest]:
    """Of a module's docstrings."""
    return [test for test in doctest.DocTestFinder().find(module) if test.examples]


def play(test: doctest.DocTest, names: dict[str, Any]) -> None:
    """Run an example in which some names are known."""
    told: list[str] = []
    test.globs.update(names)
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    runner.run(test, out=told.append)
    assert not runner.failures, "".join(told)


@pytest.mark.parametrize(
    "test", [t for module in (logs, runs) for t in examples(module)], ids=lambda test: test.name
)
def test_an_example_of_a_docstring(test: doctest.DocTest, log: logs.Log, run: Run, tmp_path: Path) -> None:
    play(test, {"pneud": pneud, "log": log, "run": run, "path": log.path, "folder": tmp_path})


def test_every_public_name_has_an_example() -> None:
    shown = {test.name.rpartition(".")[2] for module in (logs, runs) for test in examples(module)}
    public = {name for name in vars(logs.Log) if not name.startswith("_")}
    assert public | {"Log", "MotionList", "Run", "save", "simulate", "read_log"} <= shown


def test_columns_say_what_iterating_says(log: logs.Log) -> None:
    ticks, found = list(log), log.columns()
    assert len(found["t_s"]) == len(ticks) > 1000 * DURATION_S
    for name in ("measurement.position_m", "command.voltage_v", "reference.position_m", "truth_m"):
        part, _, field = name.rpartition(".")
        told = [getattr(getattr(tick, part) if part else tick, field) for tick in ticks]
        np.testing.assert_array_equal(found[name], told)
    for name in ("t_s", "error_m", "true_error_m"):
        np.testing.assert_allclose(found[name], [getattr(tick, name) for tick in ticks], rtol=0, atol=1e-15)
    assert found["state_name"].tolist() == [tick.state_name for tick in ticks]
    assert found["fault_names"].tolist() == [" ".join(tick.fault_names) for tick in ticks]
    assert any(found["fault_names"])


def test_frames_of_all_libraries_have_the_same_columns_and_their_units(log: logs.Log) -> None:
    found = log.columns()
    pandas, arrow, data = log.to_pandas(), log.to_arrow(), log.to_xarray()
    polars = log.to_polars()
    assert [*found] == [*pandas.columns] == polars.columns == arrow.column_names
    assert {*found} == {*data.variables}
    for name, column in found.items():
        kept = [
            pandas[name].to_list(),
            polars[name].to_list(),
            arrow[name].to_pylist(),
            data[name].to_numpy(),
        ]
        for other in kept:
            if column.dtype == object:
                assert [*other] == column.tolist()
            else:
                np.testing.assert_array_equal(np.array(other, dtype=float), column)
    for name, unit in {"t_s": "s", "error_m": "m", "estimate.force_n": "N", "command.voltage_v": "V"}.items():
        assert pandas.attrs["units"][name] == log.units()[name] == unit
        assert arrow.schema.field(name).metadata[b"unit"] == unit.encode()
        assert data[name].attrs["units"] == unit
        assert pandas.attrs["descriptions"][name] == data[name].attrs["long_name"]
    assert pandas.attrs["name"] == data.attrs["name"] == "virtual"
    assert arrow.schema.metadata[b"name"] == b"virtual"
    assert data.sizes == {"t_s": len(found["t_s"])}


def test_a_column_that_is_none(log: logs.Log) -> None:
    with pytest.raises(KeyError, match="speed is none of the columns number"):
        log.to_pandas(["t_s", "speed"])


@pytest.mark.parametrize(
    ("library", "extra"),
    [("pandas", "frames"), ("polars", "frames"), ("xarray", "frames"), ("pyarrow", "parquet")],
)
def test_a_library_that_is_missing(
    log: logs.Log, monkeypatch: pytest.MonkeyPatch, library: str, extra: str
) -> None:
    def missing(name: str, *rest: Any) -> Any:
        if name == library:
            raise ImportError(name)
        return ModuleType(name)

    monkeypatch.setattr(frames, "import_module", missing)
    call = {"pyarrow": log.to_arrow}.get(library) or getattr(log, f"to_{library}")
    with pytest.raises(pneud.ExtraError) as e:
        call()
    assert str(e.value) == f"this needs {library}; install it with: pip install 'pneud[{extra}]'"
    assert isinstance(e.value, builtins.ImportError)


def test_the_summary_of_a_log_is_what_sim_prints(run: Run, log: logs.Log, tmp_path: Path) -> None:
    kept = tmp_path / "sim.mcap"
    printed = object_of(
        pneud_here("sim", "virtual.toml", "--duration", DURATION_S, "--seed", 1, "-o", kept, "--json")
    )
    for found in (run.summary, log.summary, pneud.read_log(kept).summary, summary_of(plain_log(kept))):
        assert json.loads(json.dumps({**found, "log": None})) == {**printed, "log": None}
    words = pneud_here("sim", "virtual.toml", "--duration", DURATION_S, "--seed", 1).stdout
    assert str(run.summary) == words.strip()
    assert isinstance(log.summary, Summary)
    assert log.summary is log.summary


def test_what_notebooks_show(run: Run, log: logs.Log) -> None:
    shown = log._repr_html_()
    assert shown.startswith("<table>")
    for text in ("run.mcap", "virtual", "simulated", "no tracking error", "faults", "none"):
        assert text in shown
    moved = log.motions()
    rows = re.findall("<tr>.*?</tr>", moved._repr_html_())
    assert len(rows) == 1 + len(moved)
    cells = re.findall("<td.*?>(.*?)</td>", rows[1])
    assert (cells[0], cells[3]) == ("track", f"{1e3 * moved[0].from_m:.4g}")
    assert log.motions().to_pandas().attrs["units"]["rms_error_m"] == "m"
    assert "V at most" not in run.summary._repr_html_()  # too short to be judged
    assert repr(run).startswith("<Run virtual.mcap: name virtual, bus simulated")
    assert html.table(["a"], [["<b>"], [float("nan")]]).count("&lt;b&gt;") == 1


def test_a_large_log_is_shown_without_its_summary(log: logs.Log, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logs, "MOST_SHOWN_BYTES", 1)
    assert "no tracking error" not in pneud.read_log(log.path)._repr_html_()


def test_a_configuration_in_memory_runs_like_its_file(run: Run) -> None:
    again = pneud.simulate(load_config("virtual.toml"), DURATION_S, 1)
    assert again.config == run.config
    assert [repr(t.tick) for t in again] == [repr(t.tick) for t in run]


def test_gains_by_their_names_and_by_keys() -> None:
    gains: dict[str, float | str] = {
        "law": "ismc-explicit",
        "k1": 90000.0,
        "gain_n_s2": 2000.0,
        "control.motion.bandwidth_rad_s": 280.0,
    }
    c = pneud.simulate(duration_s=0.01, gains=gains).config
    assert (c.control.law, c.control.discretisation, c.control.k1) == ("ismc", "explicit", 90000.0)
    assert c.control.observer.gain_n_s2 == 2000.0
    assert c.control.motion.bandwidth_rad_s == 280.0
    with pytest.raises(pneud.ConfigError, match="gains are not Hurwitz"):
        pneud.simulate(duration_s=0.01, gains={"k3": 1e-3})
    with pytest.raises(pneud.ConfigError, match="k9: unknown key"):
        pneud.simulate(duration_s=0.01, gains={"control.k9": 1.0})


def test_a_scenario_of_pneud_with_its_verdict() -> None:
    run = pneud.simulate(scenario="encoder-missing", duration_s=2.5)
    assert run.summary["scenario"]["name"] == "encoder-missing"
    assert run.summary["faults"]
    with pytest.raises(pneud.ConfigError, match="takes a real machine"):
        pneud.simulate(scenario="clock-step")
    for duration_s in (0.0, float("nan"), 1e7):
        with pytest.raises(pneud.ConfigError, match="duration_s"):
            pneud.simulate(duration_s=duration_s)


def test_a_run_that_nobody_keeps_leaves_nothing(tmp_path: Path) -> None:
    run = pneud.simulate(duration_s=0.01)
    folder = run.path.parent
    kept = run.save(tmp_path / "x.mcap")
    with pytest.raises(pneud.LogError, match="exists already"):
        run.save(kept)
    del run
    gc.collect()
    assert not folder.exists()
    assert len(list(pneud.read_log(kept))) > 10


def test_names_of_the_package() -> None:
    assert {"simulate", "read_log", "Client", "AsyncClient", "RefusedError"} <= {*dir(pneud)}
    assert all(getattr(pneud, name) for name in pneud.__all__)
    assert "import_module" not in dir(pneud)
