"""A foreign program, in C, takes the place of the software plant on a real SocketCAN interface."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from commands import object_of, pneud_forked, pneud_here
from foreign import axis, built

pytestmark = pytest.mark.vm


def test_an_axis_arms_and_tracks_on_a_foreign_node(tmp_path: Path) -> None:
    node = built(tmp_path)
    config = axis(tmp_path, "vcan.toml", ("frequency_hz = 0.1\n", "frequency_hz = 0.5\n"))
    log = tmp_path / "run.mcap"
    with subprocess.Popen([node, "vcan0", "200"], stderr=subprocess.PIPE, text=True) as foreign:
        try:
            done = pneud_forked(
                "--config", config, "--bus", "socketcan:vcan0", "--arm", "--unproven", "--duration", 12,
                "--headless", "--json", "--log", log,
            )  # fmt: skip
        finally:
            foreign.terminate()
            _, said = foreign.communicate(timeout=10)
    print(done.stdout, done.stderr, said)
    assert foreign.returncode == 0, said
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert (summary["state"], summary["faults"]) == ("tracking", [])
    assert summary["frames"]["crc"] == summary["frames"]["stale"] == 0
    assert summary["frames"]["rx"] > 2.5 * summary["ticks"]
    assert summary["tracking_mm"]["rms"] < 12.0  # gains for 50 Hz: 4.4 on pneud's own plant
    mapped = object_of(pneud_here("map", log, "--dbc", tmp_path / "foreign.dbc", "--json"))
    rules = {m["name"]: m["checksum"] and m["checksum"]["protection"] for m in mapped["messages"]}
    assert rules["LINEAR_POSITION"] == "e2e-p01" and rules["DRIVE_SETPOINT"] == "e2e-p02"


def test_an_interface_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    done = subprocess.run([built(tmp_path), "can7"], capture_output=True, text=True, check=False)
    assert done.returncode == 3
    assert done.stderr.startswith("node: can7: ") and done.stderr.count("\n") == 1
