"""Lists of logs and scenarios, and viewers that are started with a log."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from commands import object_of, pneud_here
from pneud import resources
from pneud.log.files.listing import listed
from pneud.log.files.reader import read_log

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
    assert "without its end" in words


def test_the_parts_of_a_run_are_one_log(tmp_path: Path, folder: Path) -> None:
    parts = tmp_path / "parts"
    parts.mkdir()
    shutil.copy(folder / "a.mcap", parts / "x.mcap")
    shutil.copy(folder / "a.mcap", parts / "y.mcap")
    runs = {read_log(path).metadata.get("run") for path in parts.glob("*.mcap")}
    assert [log.parts for log in listed(parts)] == ([2] if runs != {None} else [1, 1])


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
    ("option", "program"),
    [("--rerun", "rerun"), ("--foxglove", "lichtblick"), ("--foxglove", "foxglove-studio")],
)
def test_a_viewer_is_started_with_the_log(option: str, program: str, programs: Path, tmp_path: Path) -> None:
    log, seen = GOLDEN / "composite.mcap", tmp_path / "seen"
    assert pneud_here("view", log, option).returncode == 3
    stub = programs / program
    stub.write_text(f'#!/bin/sh\necho "$@" > {seen}\nexit $(/bin/cat {tmp_path}/status)\n')
    stub.chmod(0o755)
    for status in (0, 1):
        (tmp_path / "status").write_text(str(status))
        assert pneud_here("view", log, option).returncode == status
        assert seen.read_text().split() == [str(log)]


def test_one_viewer_is_named(programs: Path) -> None:
    for options in ((), ("--rerun", "--foxglove")):
        done = pneud_here("view", GOLDEN / "composite.mcap", *options)
        assert (done.returncode, done.stdout) == (2, "")


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("rerun") is None, reason="no rerun")
def test_rerun_opens_a_log(tmp_path: Path) -> None:
    recording = tmp_path / "log.rrd"
    subprocess.run(["rerun", GOLDEN / "composite.mcap", "--save", recording], check=True, timeout=60)
    stats = subprocess.run(
        ["rerun", "rrd", "stats", recording], capture_output=True, text=True, timeout=60, check=True
    )
    for topic in ("/axis/tick", "/can/frames"):
        assert topic in stats.stdout
