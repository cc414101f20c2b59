"""Lists of logs and scenarios, and viewers that are started with a log."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

from commands import object_of, pneud_here
from pneud import resources
from pneud.log.files.listing import length_s, listed
from pneud.log.files.naming import LogError
from pneud.log.files.reader import read_log
from pneud.replay import viewing

GOLDEN = Path(__file__).with_name("golden")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two logs, one of them cut short, and a file that is none."""
    shutil.copy(GOLDEN / "composite.mcap", tmp_path / "a.mcap")
    whole = (GOLDEN / "virtual.mcap").read_bytes()
    (tmp_path / "b.mcap").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "c.mcap").write_bytes(b"something else")
    return tmp_path


def test_logs_with_their_facts(folder: Path) -> None:
    found = object_of(pneud_here("logs", folder, "--json"))["logs"]
    by_name = {Path(log["path"]).name: log for log in found}
    assert set(by_name) == {"a.mcap", "b.mcap"}
    ticks = list(read_log(folder / "a.mcap"))
    log, reader = by_name["a.mcap"], read_log(folder / "a.mcap")
    assert (log["axis"], log["bus"]) == (reader.metadata["name"], reader.metadata["bus"])
    assert (log["rate_hz"], log["parts"], log["closed"]) == (reader.rate_hz, 1, True)
    assert log["start_unix_s"] == pytest.approx(1e-9 * reader.start_ns())
    assert log["length_s"] == pytest.approx(1e-9 * (ticks[-1].log_time_ns - reader.start_ns()), abs=0.01)
    assert log["bytes"] == (folder / "a.mcap").stat().st_size
    assert not by_name["b.mcap"]["closed"]
    words = pneud_here("logs", folder).stdout
    assert "2 logs" in words
    assert "goes on, or was cut short" in words


def test_the_parts_of_a_run_are_one_log(tmp_path: Path, folder: Path) -> None:
    parts = tmp_path / "parts"
    parts.mkdir()
    shutil.copy(folder / "a.mcap", parts / "x.mcap")
    shutil.copy(folder / "a.mcap", parts / "y.mcap")
    runs = {read_log(path).metadata.get("run") for path in parts.glob("*.mcap")}
    assert [log.parts for log in listed(parts)] == ([2] if runs != {None} else [1, 1])


def test_files_of_a_run_are_as_long_as_from_the_first_message_to_the_last(folder: Path) -> None:
    whole = next(log for log in listed(folder) if log.closed)
    assert length_s([folder / "a.mcap"] * 2) == pytest.approx(whole.length_s, abs=1e-9) != 0.0
    assert length_s([]) == 0.0


def test_logs_of_the_daemon_are_the_default(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(folder))
    assert object_of(pneud_here("logs", "--json"))["folder"] == str(folder)
    done = pneud_here("logs", folder / "none")
    assert (done.returncode, done.stdout) == (2, "")


def test_scenarios_with_what_is_expected() -> None:
    found = object_of(pneud_here("scenarios", "--json"))["scenarios"]
    assert [s["name"] for s in found] == sorted(p.stem for p in resources.scenarios().glob("*.toml"))
    silent = next(s for s in found if s["name"] == "all-silent")
    assert (silent["kinds"], silent["reaction"], silent["needs_machine"]) == (["silence"], "centre", False)
    words = pneud_here("scenarios").stdout.splitlines()
    assert len(words) == len(found)
    assert "All nodes are silent at once." in words[0]


@pytest.fixture
def programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that is all there is to find programs in."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", str(folder))
    return folder


@pytest.mark.parametrize(
    ("option", "program", "sdk"),
    [
        ("--rerun", "rerun", True),
        ("--rerun", "rerun", False),
        ("--foxglove", "lichtblick", False),
        ("--foxglove", "foxglove-studio", True),
    ],
)
def test_a_viewer_is_started_with_the_log(
    option: str, program: str, sdk: bool, programs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, seen, kept = GOLDEN / "composite.mcap", tmp_path / "seen", tmp_path / "kept"
    monkeypatch.setattr(sys, "executable", str(programs / "python"))
    monkeypatch.setenv("TMPDIR", str(kept))
    monkeypatch.setattr(tempfile, "tempdir", None)
    kept.mkdir()
    assert pneud_here("view", log, option).returncode == 3
    recording = option == "--rerun" and sdk
    suffix = ".rrd" if recording else ".mcap"

    def write(_: object, path: Path) -> None:
        if not sdk:
            raise LogError("there is no rerun-sdk")
        path.write_bytes(b"RRF2")

    monkeypatch.setattr(viewing, "write", write)
    stub = programs / program
    stub.write_text(
        f'#!/bin/sh\necho "$@" > {seen}\n/usr/bin/head -c 4 "$1" > {tmp_path}/head\n'
        f"exit $(/bin/cat {tmp_path}/status)\n"
    )
    stub.chmod(0o755)
    for status in (0, 1):
        (tmp_path / "status").write_text(str(status))
        done = pneud_here("view", log, option)
        assert done.returncode == status
        assert ("without a blueprint: there is no rerun-sdk" in done.stderr) == (
            option == "--rerun" and not sdk
        )
        (opened,) = map(Path, seen.read_text().split())
        assert opened.name == f"composite{suffix}"
        assert (tmp_path / "head").read_bytes() == (b"RRF2" if recording else b"\x89MCA")
        # one that ended at once, and well, has handed the file over to a viewer that runs already
        assert opened.exists() == (option == "--foxglove" and status == 0)


def test_one_viewer_is_named(programs: Path) -> None:
    for options in ((), ("--rerun", "--foxglove")):
        done = pneud_here("view", GOLDEN / "composite.mcap", *options)
        assert (done.returncode, done.stdout) == (2, "")


@pytest.fixture
def rerun() -> Path:
    """rerun's own program, beside this Python's or on the way."""
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    if importlib.util.find_spec("rerun") is None or (found := shutil.which("rerun", path=path)) is None:
        pytest.skip("no rerun here: pip install rerun-sdk")
    return Path(found)


def told(rerun: Path, *args: object) -> str:
    done = subprocess.run([rerun, *map(str, args)], capture_output=True, text=True, timeout=60, check=True)
    return done.stdout


@pytest.mark.slow
def test_rerun_opens_a_recording_with_its_blueprint(rerun: Path, tmp_path: Path) -> None:
    file = tmp_path / "log.rrd"
    log = read_log(GOLDEN / "encoder-missing.mcap")
    assert viewing.write(log, file) == len(list(log))
    subprocess.run([rerun, "rrd", "verify", file], check=True, timeout=60)
    stats = told(rerun, "rrd", "stats", file)
    for panel in viewing.panels():
        for column in panel.columns:
            assert f"{panel.place}/{column}: " in stats
    for entity in ("/states/axis", "/states/encoder_missing", "/events", "/faults", "/about"):
        assert f"{entity}: " in stats
    printed = told(rerun, "rrd", "print", "-vvv", file)
    assert 'BlueprintActivationCommand(StoreId(Blueprint, "pneud"' in printed
    for name in ("Error [m]", "Faults", "State and faults", "Events"):
        assert name in printed
    assert "encoder_missing" in printed
    saved = tmp_path / "saved.rrd"  # as the viewer takes it in
    subprocess.run([rerun, file, "--save", saved], check=True, timeout=60)
    assert "/error/true_error_m: " in told(rerun, "rrd", "stats", saved)


@pytest.mark.slow
def test_rerun_opens_a_log_as_it_is(rerun: Path, tmp_path: Path) -> None:
    recording = tmp_path / "log.rrd"
    subprocess.run([rerun, GOLDEN / "composite.mcap", "--save", recording], check=True, timeout=60)
    stats = told(rerun, "rrd", "stats", recording)
    for topic in ("/axis/tick", "/can/frames"):
        assert topic in stats


def test_faults_with_their_times() -> None:
    table = viewing.FaultTable(("a", "encoder_missing"))
    t_s = np.arange(6.0)
    none = np.zeros(6, dtype=np.int64)
    more = {"present_more": none, "latched_more": none}
    table.add({"present": np.array([0, 1, 1, 3, 0, 0]), "latched": none, "t_s": t_s, **more})
    table.add({"present": none, "latched": np.array([0, 2, 2, 2, 2, 2]), "t_s": t_s + 6.0, **more})
    spans = [
        ("a", 1.0, 4.0, False),
        ("encoder_missing", 3.0, 4.0, False),
        ("encoder_missing", 7.0, None, True),
    ]
    assert table.spans == spans
    rows = table.markdown().splitlines()
    assert len(rows) == 2 + len(spans)
    assert rows[-1].startswith("| encoder_missing | 7.000 | the end | yes |")
    assert viewing.FaultTable(()).markdown() == "no faults"
