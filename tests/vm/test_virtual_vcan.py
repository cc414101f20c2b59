"""A whole virtual run over real SocketCAN, and what the kernel's own tools see of it."""

from __future__ import annotations

import json
import subprocess
import time
from pathlib import Path

import pytest

from commands import PNEUD, Forked, object_of, pneud_forked, pneud_here
from dumped import dumped, identifiers
from pneud import resources

pytestmark = pytest.mark.vm


def pneud(*args: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*PNEUD, *map(str, args)], capture_output=True, text=True, timeout=300, check=False)


@pytest.fixture
def gentle() -> Path:
    """An axis that a virtual machine with one slow CPU can carry."""
    return resources.configs() / "vcan.toml"


def test_a_virtual_run_over_vcan0_tracks_and_candump_sees_the_frames(tmp_path: Path, gentle: Path) -> None:
    log = tmp_path / "run.mcap"
    seen = tmp_path / "candump.log"
    with dumped(seen):
        done = pneud(
            "--virtual", "--config", gentle, "--bus", "socketcan:vcan0", "--duration", 10, "--headless",
            "--json", "--log", log,
        )  # fmt: skip
    ids = identifiers(seen)
    print(done.stdout, done.stderr)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["bus"] == "socketcan:vcan0"
    assert summary["state"] == "tracking"
    assert summary["faults"] == []
    assert summary["frames"]["crc"] == summary["frames"]["stale"] == 0
    assert set(ids) == {"080", "181", "182", "183", "203"}
    assert ids["080"] == ids["203"] >= summary["ticks"]
    assert min(ids["181"], ids["182"], ids["183"]) > 0.9 * ids["080"]

    again = object_of(pneud_here("replay", log, "--json"))
    assert again["identical"] is True
    assert again["engaged_ticks"] > 0.9 * summary["ticks"]


def test_auto_takes_vcan0_where_it_is_idle(gentle: Path) -> None:
    done = pneud_forked("--virtual", "--config", gentle, "--duration", 1, "--headless", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["bus"] == "socketcan:vcan0"
    assert "socketcan:vcan0" in done.stderr


def test_a_link_that_is_no_vcan_is_refused() -> None:
    for verb in (["--virtual", "--headless"], ["plant"]):
        done = pneud_forked(*verb, "--bus", "socketcan:lo")
        assert done.returncode in (2, 3)
        assert done.stdout == ""
        assert done.stderr.count("\n") == 1, done.stderr
        assert "lo" in done.stderr


def test_a_bus_that_is_driven_is_refused() -> None:
    generator = subprocess.Popen(["cangen", "vcan0", "-g", "5", "-I", "080", "-L", "1"])
    try:
        done = pneud_forked("--virtual", "--bus", "socketcan:vcan0", "--headless", "--json")
    finally:
        generator.kill()
        generator.wait()
    assert done.returncode == 2
    assert done.stdout == ""
    assert "another controller drives it" in done.stderr


def test_the_interface_going_down_centres_with_a_named_fault(tmp_path: Path, gentle: Path) -> None:
    log = tmp_path / "run.mcap"
    words = ("--virtual", "--config", gentle, "--bus", "socketcan:vcan1", "--headless", "--json")
    daemon = Forked(*words, "--log", log)
    try:
        while not (log.exists() and log.stat().st_size > 30_000):
            assert daemon.poll() is None, daemon.communicate()
            time.sleep(0.1)
        subprocess.run(["ip", "link", "set", "vcan1", "down"], check=True)
        out, err = daemon.communicate(timeout=60)
    finally:
        daemon.kill()
        subprocess.run(["ip", "link", "set", "vcan1", "up"], check=True)
    assert daemon.returncode == 1, err
    summary = json.loads(out)
    assert summary["state"] == "fault"
    assert "link_down" in summary["faults"]
