"""Recordings of rigs whose sensors run free: without SYNC, commands are what ticks are counted by."""

from __future__ import annotations

from pathlib import Path

import pytest
from hil.device_sets import device_sets

from commands import object_of, pneud_here
from pneud.log.files.reader import read_log


def recorded(name: str, folder: Path) -> Path:
    """What candump would have written of a run."""
    file = device_sets()[name].write(folder, name)
    assert pneud_here("sim", file, "-o", folder / "run.mcap", "--duration", 0.8).returncode == 0
    done = pneud_here("export", folder / "run.mcap", "-o", folder / "run.log")
    assert done.returncode == 0, done.stderr
    return folder / "run.log"


@pytest.mark.parametrize("name", ["free", "bare", "flexible"])
def test_an_export_comes_back_to_the_bit(name: str, tmp_path: Path) -> None:
    log = recorded(name, tmp_path)
    done = pneud_here("import", log, "-o", tmp_path / "again.mcap")
    assert (done.returncode, done.stderr) == (0, "")
    ran, again = read_log(tmp_path / "run.mcap"), read_log(tmp_path / "again.mcap")
    for one, other in zip(ran, again, strict=True):
        assert (one.t_ns, one.frames, one.sent) == (other.t_ns, other.frames, other.sent)
        assert repr((one.state, one.command)) == repr((other.state, other.command))
    assert object_of(pneud_here("replay", tmp_path / "again.mcap", "--json"))["identical"]


@pytest.mark.parametrize("suffix", ["asc", "blf"])
def test_frames_of_can_fd_come_back_from_other_tools_recordings(suffix: str, tmp_path: Path) -> None:
    recorded("flexible", tmp_path)
    recording = tmp_path / f"run.{suffix}"
    assert pneud_here("export", tmp_path / "run.mcap", "-o", recording).returncode == 0
    done = pneud_here("import", recording, "-o", tmp_path / "again.mcap")
    assert done.returncode == 0
    assert "passed over" not in done.stderr
    ran, again = read_log(tmp_path / "run.mcap"), read_log(tmp_path / "again.mcap")
    for one, other in zip(ran, again, strict=True):
        assert [f[1:] for f in (*one.frames, *one.sent)] == [f[1:] for f in (*other.frames, *other.sent)]
        assert one.state == other.state


@pytest.mark.parametrize("name", ["free", "bare", "extended"])
def test_a_recording_of_others_is_a_log_to_replay_and_to_read(name: str, tmp_path: Path) -> None:
    log = recorded(name, tmp_path)
    log.with_name("run.log.json").unlink()
    words = ["--dbc", tmp_path / f"{name}.dbc", "--config", tmp_path / f"{name}.toml"]
    done = pneud_here("import", log, "-o", tmp_path / "again.mcap", *words)
    assert done.returncode == 0, done.stderr
    assert "requests were inferred from Enable" in done.stderr
    ticks = sum(1 for _ in read_log(tmp_path / "run.mcap"))
    assert done.stdout.startswith(f"{tmp_path / 'again.mcap'}: {ticks} ticks from channel ")
    replayed = object_of(pneud_here("replay", tmp_path / "again.mcap", "--json"))
    assert replayed["ticks"] == ticks
    assert replayed["engaged_ticks"] > 0.5 * ticks
    assert pneud_here("report", tmp_path / "again.mcap", "-o", tmp_path / "again.html").returncode == 0


def test_a_recording_without_commands_is_refused_with_the_reason(tmp_path: Path) -> None:
    log = recorded("free", tmp_path)
    log.with_name("run.log.json").unlink()
    log.write_text("".join(line for line in log.read_text().splitlines(True) if " 2A0#" not in line))
    words = ["--dbc", tmp_path / "free.dbc", "--config", tmp_path / "free.toml"]
    done = pneud_here("import", log, "-o", tmp_path / "again.mcap", *words)
    assert (done.returncode, done.stdout) == (2, "")
    assert "there is no command (0x2A0) in it, so it has no ticks" in done.stderr
