"""A CANopen rig over real SocketCAN, from power-up to tracking, with no tool but pneud.

candump, the `canopen` library and the log tell of the same bus; the plan and the library, of the same nodes.
"""

from __future__ import annotations

import json
import math
import signal
import statistics
import struct
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from commands import PNEUD, Figures, eventually, object_of, pneud
from dumped import dumped, frames
from pneud import resources
from pneud.canopen.objects import mapping_word
from pneud.canopen.plan import EVENT, SYNC, Plan
from pneud.config.toml import merged, tables_of, toml_text
from pneud.loading import load, plans_of_nodes
from pneud.log.files.reader import read_log
from pneud.signals import State

canopen = pytest.importorskip("canopen")

pytestmark = pytest.mark.vm
SYNC_ID = 0x080
ACTIVE = 0x07  # of the valve's control word
TRACKED_S = 13.5  # a whole period of the reference lies within, behind what the library asks
MOST_MM = 0.05  # of the true position, half of the time: whoever else has the one processor may hold it up
Heard = list[tuple[int, bytes]]


def written_file(folder: Path) -> Path:
    """`canopen.toml` at a rate, and with time-outs, that a virtual machine with one processor carries."""
    tables = tables_of((resources.configs() / "canopen.toml").read_text(encoding="utf-8"))
    nodes = [{**node, "heartbeat_timeout_ms": 3000.0} for node in tables["bus"].pop("nodes")]
    timeouts = {f"{who}_timeout_ms": 250.0 for who in ("sensor", "valve", "deadline")}
    change = {"loop": {"rate_hz": 100.0}, "reference": {"frequency_hz": 0.25}, "bus": timeouts}
    text = toml_text(merged(tables, change))
    for node in nodes:
        text += f"\n[[bus.nodes]]\n{toml_text(node)}"
    file = folder / "axis.toml"
    file.write_text(text, encoding="utf-8")
    return file


class Library:
    """The `canopen` library: it hears nodes boot, asks them what they hold, then hears what two PDOs say.

    The kernel keeps the rest from it: one processor has all of this to do.
    """

    def __init__(self, plans: tuple[Plan, ...]) -> None:
        self.heard: Heard = []
        self.network = canopen.Network()
        answers = [{"can_id": 0x580, "can_mask": 0x780}, {"can_id": 0x700, "can_mask": 0x780}]
        self.network.connect(interface="socketcan", channel="vcan0", can_filters=answers)
        self.nodes = {
            plan.node.id: self.network.add_node(
                plan.node.id, str(resources.configs() / f"{plan.node.profile}.eds")
            )
            for plan in plans
        }
        for node in self.nodes.values():
            node.sdo.RESPONSE_TIMEOUT = 10.0

    def pdos(self, plan: Plan) -> list[tuple[bool, int, int, list[int]]]:
        """What a node's objects say, read by SDO while it works: (sent, identifier, type, mapping)."""
        node, found = self.nodes[plan.node.id], []
        for sent, maps in ((True, node.tpdo), (False, node.rpdo)):
            if not len(maps):
                continue
            maps.read()
            for one in maps.values():
                if one.enabled:
                    words = [v.index << 16 | v.subindex << 8 | v.length for v in one.map]
                    found.append((sent, one.cob_id, one.trans_type, words))
        return found

    def listen(self, *ids: int) -> None:
        """Hear these from now on."""
        for can_id in ids:
            self.network.subscribe(can_id, lambda i, data, _: self.heard.append((i, bytes(data))))
        self.network.bus.set_filters([{"can_id": i, "can_mask": 0x7FF} for i in ids])

    def hear_out(self) -> None:
        """Let it take what waits for it."""
        heard = -1
        while heard < len(self.heard):
            heard = len(self.heard)
            time.sleep(1.0)


def planned(plan: Plan) -> list[tuple[bool, int, int, list[int]]]:
    """The same as pneud has planned it."""
    return [
        (m.pdo.sent, m.can_id, SYNC if m.pdo.sent else EVENT, [mapping_word(c.object) for c in m.carried])
        for m in plan.messages
    ]


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


@contextmanager
def powered(file: Path, log: Path, socket: Path) -> Iterator[subprocess.Popen[str]]:
    """The rig and its daemon."""
    words = ["--virtual", "--config", file, "--bus", "socketcan:vcan0", "--headless", "--json"]
    words += ["--log", log, "--socket", socket]
    run = subprocess.Popen(
        [*PNEUD, *map(str, words)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        yield run
    finally:
        run.kill()
        print(*run.communicate())  # if a test has not taken it


def of(frames_: Heard, can_id: int) -> list[bytes]:
    return [data for one, data in frames_ if one == can_id]


def test_from_power_up_to_tracking_and_all_who_hear_the_bus_agree(tmp_path: Path, figures: Figures) -> None:
    file, log, seen = written_file(tmp_path), tmp_path / "run.mcap", tmp_path / "candump.log"
    plans = plans_of_nodes(load(file))
    socket = tmp_path / "s"
    position_id = next(m.can_id for m in plans[0].messages if m.pdo.sent)
    command_id = next(m.can_id for m in plans[2].messages if not m.pdo.sent)
    with dumped(seen):
        library = Library(plans)
        began = time.monotonic()
        try:
            with powered(file, log, socket) as run:
                eventually(lambda: f" {command_id:03X}#{ACTIVE:02X}" in seen.read_text(), 120.0)
                ready_s = time.monotonic() - began
                held = [library.pdos(plan) for plan in plans]
                states = {node: one.nmt.state for node, one in library.nodes.items()}
                library.listen(position_id, command_id)
                time.sleep(TRACKED_S)
                run.send_signal(signal.SIGINT)
                out, err = run.communicate(timeout=60)
            library.hear_out()
        finally:
            library.network.disconnect()
    print(out, err)
    assert "nodes: 1, 2, 3 configured and started" in err
    summary: dict[str, Any] = json.loads(out)
    tracking = summary["tracking_mm"]
    ticks = list(read_log(log))
    errors = [
        abs(tick.true_error_m)
        for tick in ticks
        if tick.state == State.TRACKING and not math.isnan(tick.truth_m)
    ]
    typical_mm = 1e3 * statistics.median(errors[len(errors) // 3 :])  # joined by then
    figures(
        f"CANopen rig over vcan0: tracking {ready_s:.1f} s after power-up, true error {typical_mm:.4f} mm"
        f" half of the time, {tracking['rms'] or math.nan:.4f} mm rms, {1e3 * max(errors):.4f} mm at most;"
        f" {summary['skipped']} ticks skipped"
    )
    assert (summary["state"], summary["faults"], tracking["against"]) == ("tracking", [], "plant")
    heard = [(int(can_id, 16), bytes.fromhex(data)) for can_id, data in frames(seen)]

    # nothing is sampled before all nodes are configured, and each has all of what was planned
    first_sync = next(n for n, (can_id, _) in enumerate(heard) if can_id == SYNC_ID)
    starts = [n for n, (can_id, data) in enumerate(heard) if can_id == 0 and data[0] == 1]
    assert [heard[n][1][1] for n in starts] == [1, 2, 3]
    assert max(starts) < first_sync
    for plan, found in zip(plans, held, strict=True):
        wanted = [(s.object.index, s.object.sub, s.value) for s in plan.steps if s.write]
        assert written(heard[:first_sync], plan.node.id) == wanted
        assert found == planned(plan)
    assert states == dict.fromkeys(states, "OPERATIONAL")

    # the log has every frame of the bus in its order, and the library every one from when it began to listen
    logged = [(f.can_id, f.data) for tick in ticks for f in (*tick.frames, *tick.sent) if f.stamp_ns >= 0]
    for can_id in (SYNC_ID, *(message.can_id for plan in plans for message in plan.messages)):
        dumped_, in_log, in_library = of(heard, can_id), of(logged, can_id), of(library.heard, can_id)
        assert in_log == dumped_[: len(in_log)], f"{can_id:03X}"
        assert len(dumped_) - len(in_log) <= 4, f"{can_id:03X}"  # behind the last tick
        if can_id in (position_id, command_id):
            assert len(in_library) > 100
            assert in_library == dumped_[-len(in_library) :], f"{can_id:03X}"

    # the library makes of the encoder's what the axis made of it
    (position,) = (one for one in library.nodes[1].tpdo.values() if one.enabled)
    for tick in ticks:
        mine = [f.data for f in tick.frames if f.can_id == position_id]
        if mine and tick.measurement.fresh & 1:
            position.data = bytearray(mine[-1])
            assert tick.measurement.position_m == pytest.approx(1e-6 * position.map[0].raw, abs=1e-7)
    assert object_of(pneud("replay", log, "--json"))["identical"] is True
    assert typical_mm <= MOST_MM
