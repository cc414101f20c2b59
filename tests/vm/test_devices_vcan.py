"""Other people's devices over real SocketCAN: 29-bit identifiers, and no SYNC."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

from device_sets import device_sets

pytestmark = pytest.mark.vm
PNEUD = [sys.executable, "-m", "pneud.cli"]


def pneud(*args: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*PNEUD, *map(str, args)], capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.parametrize(
    ("name", "ids"),
    [
        ("extended", {"18000080", "01A00000", "01A10000", "01A20000", "02A00000"}),
        ("bare", {"000002AA", "18FF1001", "18FF1002", "18FF1003"}),
    ],
)
def test_a_device_set_tracks_over_vcan0(name: str, ids: set[str], tmp_path: Path) -> None:
    file = device_sets()[name].write(tmp_path, name, base="vcan.toml")
    log = tmp_path / "run.mcap"
    with (tmp_path / "candump.log").open("w+") as seen:
        candump = subprocess.Popen(["candump", "-L", "vcan0"], stdout=seen)
        try:
            done = pneud(
                "--virtual", "--config", file, "--bus", "socketcan:vcan0", "--duration", 8, "--headless",
                "--json", "--log", log,
            )  # fmt: skip
            time.sleep(1.0)  # candump shares the one CPU, and has yet to write what it received
        finally:
            candump.send_signal(signal.SIGINT)
            candump.wait(10)
        seen.seek(0)
        found = Counter(line.split()[2].split("#")[0] for line in seen)
    print(done.stdout, done.stderr)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert (summary["state"], summary["faults"]) == ("tracking", [])
    assert set(found) == ids
    assert json.loads(pneud("replay", log, "--json").stdout)["identical"] is True
