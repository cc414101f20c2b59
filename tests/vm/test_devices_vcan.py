"""Other people's devices over real SocketCAN: 29-bit identifiers, no SYNC, CAN FD."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hil.device_sets import device_sets

from commands import object_of, pneud_forked, pneud_here
from dumped import dumped, identifiers

pytestmark = pytest.mark.vm


@pytest.mark.parametrize(
    ("name", "ids"),
    [
        ("extended", {"18000080", "01A00000", "01A10000", "01A20000", "02A00000"}),
        ("bare", {"000002AA", "18FF1001", "18FF1002", "18FF1003"}),
        ("flexible", {"080", "1A0", "2A0"}),
    ],
)
def test_a_device_set_tracks_over_vcan0(name: str, ids: set[str], tmp_path: Path) -> None:
    file = device_sets()[name].write(tmp_path, name, base="vcan.toml")
    log = tmp_path / "run.mcap"
    seen = tmp_path / "candump.log"
    with dumped(seen):
        done = pneud_forked(
            "--virtual", "--config", file, "--bus", "socketcan:vcan0", "--duration", 10, "--headless",
            "--json", "--log", log,
        )  # fmt: skip
    print(done.stdout, done.stderr)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert (summary["state"], summary["faults"]) == ("tracking", [])
    assert set(identifiers(seen)) == ids
    assert object_of(pneud_here("replay", log, "--json"))["identical"] is True
