"""What the command line accepts, refuses and says."""

from __future__ import annotations

from pathlib import Path

import pytest

from commands import object_of, pneud, pneud_here


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["--virtual", "--bus", "can0"], "none of auto, socketcan:IF, unixcan:NAME"),
        (["--virtual", "--duration", "-1"], "--duration"),
        (["--virtual", "--rate", "1"], "--rate 1"),
        (["--virtual", "--config", "nowhere.toml"], "nowhere.toml: no such file"),
        (["--virtual", "check", "virtual.toml"], "--virtual belongs to the daemon"),
        (["--config", "virtual.toml"], "bus auto is for virtual runs"),
        (["plant", "--bus", "auto"], "name one"),
        (["sim", "virtual.toml", "--duration", "0"], "--duration 0"),
        (["replay", "nowhere.mcap"], "nowhere.mcap"),
    ],
)
def test_usage_error_is_one_line_exit_2_and_empty_stdout(args: list[str], says: str) -> None:
    done = pneud_here(*args)
    assert done.returncode == 2
    assert done.stdout == ""
    assert says in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert "Traceback" not in done.stderr


def test_unknown_option_is_a_usage_error() -> None:
    done = pneud_here("--nonsense")
    assert done.returncode == 2
    assert done.stdout == ""
    assert "--nonsense" in done.stderr


def test_missing_interface_is_exit_3_with_one_line() -> None:
    done = pneud("--config", "rig.toml", "--bus", "socketcan:nope0")
    assert done.returncode == 3
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1


def test_log_is_never_overwritten(tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    log.write_bytes(b"precious")
    done = pneud_here("sim", "virtual.toml", "-o", log, "--duration", "0.1")
    assert done.returncode == 2
    assert "never overwritten" in done.stderr
    assert log.read_bytes() == b"precious"


@pytest.mark.parametrize(
    "verb", ["plant", "sim", "replay", "recover", "check", "design", "reproduce", "doctor", "bench"]
)
def test_every_verb_has_help(verb: str) -> None:
    done = pneud_here(verb, "--help")
    assert done.returncode == 0
    assert "Usage" in done.stdout


def test_version() -> None:
    assert pneud_here("--version").stdout.startswith("pneud ")


def test_sim_object_is_the_documented_one() -> None:
    summary = object_of(pneud_here("sim", "virtual.toml", "--duration", "1", "--json"))
    assert list(summary) == [
        "schema",
        "state",
        "bus",
        "rate_hz",
        "ticks",
        "skipped",
        "lateness_us",
        "sensor_to_command_us",
        "tracking_mm",
        "command_v",
        "saturated_ticks",
        "frames",
        "log",
        "log_dropped",
        "faults",
    ]
    assert summary["state"] == "tracking"
    assert summary["ticks"] == 1000
    assert summary["lateness_us"] is None
    assert summary["tracking_mm"] is None  # too short
    assert list(summary["frames"]) == ["rx", "tx", "lost", "crc", "stale", "late"]
