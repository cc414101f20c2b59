"""CANopen nodes over real SocketCAN: what candump sees is what was planned, and what the log has."""

from __future__ import annotations

import signal
import struct
import subprocess
from itertools import pairwise
from pathlib import Path

import pytest

from commands import PNEUD, eventually
from dumped import dumped, frames
from pneud import resources
from pneud.loading import load, plans_of_nodes
from pneud.log.files.reader import read_log

pytestmark = pytest.mark.vm
POSITIONS = 100  # that are waited for
NODES = """
[[bus.nodes]]
id = 1
profile = "encoder406"
heartbeat_timeout_ms = 3000

[[bus.nodes]]
id = 2
profile = "analog404"
heartbeat_timeout_ms = 3000

[[bus.nodes]]
id = 3
profile = "valve408"
heartbeat_timeout_ms = 3000

[control]
"""
Heard = list[tuple[int, bytes]]


def written(heard: Heard, node: int) -> list[tuple[int, int, int]]:
    """What was written to a node by SDO, and confirmed: (index, sub, value)."""
    found: list[tuple[int, int, int]] = []
    theirs = [frame for frame in heard if frame[0] in (0x600 + node, 0x580 + node)]
    for (can_id, data), (_, answer) in pairwise(theirs):
        if can_id == 0x600 + node and data[0] >> 5 == 1 and answer[0] == 0x60:
            size = 4 - (data[0] >> 2 & 3)
            one = (*struct.unpack_from("<HB", data, 1), int.from_bytes(data[4 : 4 + size], "little"))
            if found[-1:] != [one]:  # else it was tried again
                found.append(one)
    return found


def test_candump_the_plan_and_the_log_agree(tmp_path: Path) -> None:
    text = (resources.configs() / "vcan.toml").read_text()
    assert "\n[control]\n" in text
    axis, log = tmp_path / "axis.toml", tmp_path / "run.mcap"
    text = "".join(line for line in text.splitlines(keepends=True) if not line.startswith("dbc ="))
    axis.write_text(text.replace("\n[control]\n", NODES, 1))
    seen = tmp_path / "candump.log"
    with dumped(seen):
        common = ["--config", str(axis), "--bus", "socketcan:vcan0"]
        plant = subprocess.Popen([*PNEUD, "plant", *common], stderr=subprocess.PIPE)
        run = subprocess.Popen([*PNEUD, *common, "--headless", "--log", str(log)], stderr=subprocess.PIPE)
        try:
            eventually(lambda: seen.read_text().count(" 281#") > POSITIONS, 170.0)
        finally:
            run.send_signal(signal.SIGINT)
            _, err = run.communicate(timeout=60)
            plant.terminate()
            _, said = plant.communicate(timeout=60)
            print(err, said)
    heard = [(int(can_id, 16), bytes.fromhex(data)) for can_id, data in frames(seen)]
    assert b"nodes: 1, 2, 3 configured and started" in err

    # nothing is sampled before all nodes are configured, and each has all of what was planned
    first_sync = next(n for n, (can_id, _) in enumerate(heard) if can_id == 0x080)
    starts = [n for n, (can_id, data) in enumerate(heard) if can_id == 0 and data[0] == 1]
    assert [heard[n][1][1] for n in starts] == [1, 2, 3]
    assert max(starts) < first_sync
    for plan in plans_of_nodes(load(axis)):
        wanted = [(s.object.index, s.object.sub, s.value) for s in plan.steps if s.write]
        assert written(heard[:first_sync], plan.node.id) == wanted

    # each frame of the log was on the bus, in this order
    logged = [(f.can_id, f.data) for tick in read_log(log) for f in tick.frames if f.can_id == 0x281]
    on_bus = iter(frame for frame in heard if frame[0] == 0x281)
    assert len(logged) > 0.8 * POSITIONS
    assert all(frame in on_bus for frame in logged)
