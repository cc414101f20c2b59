"""CANopen rigs in real time over unixcan: from power-up to tracking, and what happens to nodes on the way."""

from __future__ import annotations

import json
import os
import re
import secrets
import signal
import struct
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from commands import PNEUD, eventually, pneud
from pneud import resources
from pneud.bus.link import open_link
from pneud.canopen.objects import Command
from pneud.console.client import Client
from pneud.log.files.reader import read_log
from running import serves

canopen = pytest.importorskip("canopen")

pytestmark = [pytest.mark.slow, pytest.mark.realtime]
RATE_HZ = 300


def config(folder: Path, *changes: tuple[str, str]) -> Path:
    """The axis with CANopen nodes, and with time-outs that a stall of a shared machine does not reach."""
    text = (resources.configs() / "canopen.toml").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    file = folder / "axis.toml"
    file.write_text(re.sub(r"_timeout_ms = 50\.0", "_timeout_ms = 250.0", text))
    return file


def channel() -> str:
    return f"unixcan:nodes-{os.getpid()}-{secrets.token_hex(2)}"


@contextmanager
def plant(file: Path, bus: str) -> Iterator[None]:
    with subprocess.Popen(
        [*PNEUD, "plant", "--config", file, "--bus", bus], stderr=subprocess.PIPE
    ) as process:
        assert process.stderr is not None
        assert b"Ctrl-C stops" in process.stderr.readline()
        try:
            yield
        finally:
            process.terminate()


class Daemon:
    """A daemon without a plant of its own."""

    def __init__(self, process: subprocess.Popen[str], socket: str) -> None:
        self.process, self.socket = process, socket

    def ask(self, verb: str = "status", **fields: Any) -> dict[str, Any]:
        with Client(self.socket) as client:
            return client.ask(verb, **fields)

    def is_(self, state: str) -> Callable[[], bool]:
        return lambda: bool(self.ask()["state"] == state)

    def faults(self) -> set[str]:
        return {fault["name"] for fault in self.ask()["faults"]}

    def armable(self) -> bool:
        found = self.ask()
        return found["state"] == "disarmed" and not found["faults"]

    def end(self) -> str:
        """What it has said."""
        self.process.send_signal(signal.SIGINT)
        _, said = self.process.communicate(timeout=30)
        assert "Traceback" not in said, said
        return said


@contextmanager
def daemon(file: Path, bus: str, folder: Path) -> Iterator[Daemon]:
    socket = f"/tmp/pneud-nodes-{os.getpid()}-{secrets.token_hex(2)}.sock"
    words = ["--config", file, "--bus", bus, "--rate", RATE_HZ, "--headless", "--json", "--socket", socket]
    process = subprocess.Popen(
        [*PNEUD, *map(str, words), "--log", str(folder / "run.mcap")],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        eventually(lambda: serves(socket))
        yield Daemon(process, socket)
    finally:
        process.kill()
        process.communicate()
        for left in (socket, f"{socket}.lock"):
            Path(left).unlink(missing_ok=True)


def test_from_power_up_to_tracking_and_the_library_reads_the_same(tmp_path: Path) -> None:
    file, bus, log = config(tmp_path), channel(), tmp_path / "run.mcap"
    network = canopen.Network()
    network.connect(interface="unixcan", channel=bus.partition(":")[2])
    positions: set[int] = set()
    states: dict[int, list[int]] = {1: [], 2: [], 3: []}
    try:
        encoder = network.add_node(1, str(resources.configs() / "encoder406.eds"))
        encoder.tpdo.read(from_od=True)
        encoder.tpdo[2].cob_id = 0x281
        encoder.tpdo[2].subscribe()
        encoder.tpdo[2].add_callback(lambda pdo: positions.add(pdo["Position value"].raw))
        for node, heard in states.items():
            network.subscribe(0x700 + node, lambda _, data, __, heard=heard: heard.append(data[0]))
        done = pneud(
            *("--virtual", "--config", file, "--bus", bus, "--rate", RATE_HZ, "--duration", 8),
            *("--headless", "--json", "--log", log),
        )
    finally:
        network.disconnect()
    assert done.returncode == 0, done.stderr
    assert "nodes: 1, 2, 3 configured and started" in done.stderr
    summary = json.loads(done.stdout)
    assert (summary["state"], summary["faults"]) == ("tracking", [])
    assert summary["tracking_mm"]["rms"] < 0.05
    for node, heard in states.items():
        assert heard[0] == 0, node  # boot-up
        assert heard[-1] == 5, node
    frames = [frame for tick in read_log(log) for frame in tick.frames if frame.can_id == 0x281]
    assert len(frames) > 6 * RATE_HZ
    said = {struct.unpack("<i", frame.data)[0] for frame in frames}
    assert len(said ^ positions) <= 0.02 * len(said)  # at begin and end one of them may have heard more
    replayed = json.loads(pneud("replay", log, "--json").stdout)
    assert replayed["identical"]


def test_a_node_that_reboots_stops_the_axis_and_is_configured_anew(tmp_path: Path) -> None:
    file, bus = config(tmp_path), channel()
    with plant(file, bus), daemon(file, bus, tmp_path) as run:
        eventually(run.armable)
        for node in (2, 3):
            run.ask("arm")
            eventually(run.is_("holding"))
            with open_link(bus) as link:
                link.send(0, bytes((Command.RESET, node)))
            eventually(run.is_("fault"))
            assert "heartbeat_lost" in run.faults()
            eventually(lambda: run.ask("clear")["state"] == "disarmed" if clearable(run) else False)
            eventually(run.armable)
        said = run.end()
    assert "node 2 (analog404) has rebooted; it is configured anew before anything arms" in said
    assert "nodes: 2 configured and started" in said
    assert "nodes: 3 configured and started" in said


def clearable(run: Daemon) -> bool:
    return not any(fault["present"] for fault in run.ask()["faults"])


def test_nothing_arms_before_all_nodes_are_ready(tmp_path: Path) -> None:
    # the third kind of misbehaviour, of the first node: an object that its EDS has and it has not
    file, bus = config(tmp_path, ("[plant]\n", "[plant]\nodd_nodes = 9\n")), channel()
    with plant(file, bus), daemon(file, bus, tmp_path) as run:
        eventually(lambda: "heartbeat_lost" in run.faults())
        found: list[str] = []
        for _ in range(20):
            try:
                run.ask("arm")
            except Exception as e:
                found.append(str(e))
        assert len(found) == 20, found
        assert run.ask()["state"] == "waiting"
        assert all(frames_of(bus, 0.2, 0x080) == 0 for _ in range(3))  # no SYNC meanwhile
        said = run.end()
    lines = [line for line in said.splitlines() if line.startswith("pneud: nodes: ")]
    assert len(lines) == 1  # said once, however often it is tried again
    assert re.match(r"pneud: nodes: node 1 \(encoder406\), 0x\w{4}:\w\w .*: .*\(abort 0x06.*; .*", lines[0])


def frames_of(bus: str, seconds: float, can_id: int) -> int:
    found: list[Any] = []
    with open_link(bus) as link:
        link.wait(seconds)
        link.drain(found)
    return sum(frame.can_id == can_id for frame in found)


def test_the_verbs_on_a_bus(tmp_path: Path) -> None:
    file, bus = config(tmp_path), channel()

    def asked(*words: object, status: int = 0) -> dict[str, Any]:
        done = pneud("nodes", *words, "--json")
        assert done.returncode == status, done.stderr
        found: dict[str, Any] = json.loads(done.stdout)
        return found

    with plant(file, bus):
        assert [node["id"] for node in asked("list", "--bus", bus)["nodes"]] == [1, 2, 3]
        assert asked("configure", file, "--bus", bus)["ok"]
        assert not asked("configure", file, "--bus", bus, "--dry-run")["differs"]
        assert [node["identity"]["serial"] for node in asked("keep", file, "--bus", bus)["nodes"]] == [
            1000,
            1001,
            1002,
        ]
        assert "serial = 1002" in file.read_text()
        assert asked("set-id", 9, "--of", 2, "--bus", bus)["id"] == 9
        assert [node["id"] for node in asked("list", "--bus", bus)["nodes"]] == [1, 3, 9]
        refused = pneud("nodes", "set-id", 5, "--bus", bus)
        assert refused.returncode == 1
        assert refused.stderr == "pneud: no node is without an identifier; name one by --of\n"


def test_verbs_leave_a_bus_alone_that_a_daemon_drives(tmp_path: Path) -> None:
    file, bus = config(tmp_path), channel()
    with plant(file, bus), daemon(file, bus, tmp_path) as run:
        eventually(run.armable)
        done = pneud("nodes", "configure", file, "--bus", bus)
        assert done.returncode == 2
        assert (
            "0x080 is on this bus already, so a daemon runs there, which configures its nodes itself"
            in done.stderr
        )
