"""The daemon and its plant as processes on a bus of their own, with an ear that hears all they send."""

from __future__ import annotations

import json
import os
import re
import secrets
import signal
import subprocess
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from axis_rig import loaded
from commands import PNEUD, eventually
from pneud import resources
from pneud.bus.link import Link, open_link
from pneud.bus.wire import CAN_ERR_FLAG
from pneud.console.client import Client
from pneud.console.endpoint import PlaceError
from pneud.log.files.reader import read_log
from pneud.log.format.records import LoggedTick
from pneud.safety.supervisor import is_engaged
from pneud.signals import Answer, Frame, RequestKind

LAST_FRAMES = 100


def patient_axis(folder: Path) -> Path:
    """The virtual axis with time-outs that a stall of a shared machine does not reach."""
    text = (resources.configs() / "virtual.toml").read_text()
    file = folder / "patient.toml"
    file.write_text(re.sub(r"_timeout_ms = 50\.0", "_timeout_ms = 250.0", text))
    return file


def serves(path: str) -> bool:
    """Whether a console can be talked to there: its socket's file is there a little earlier."""
    try:
        Client(path).close()
    except PlaceError:
        return False
    return True


class Running:
    """A daemon, and what it sends.

    Attributes:
        link: a party of its bus, which does not hear itself.
        socket: of its console.
        commands: data of every VALVE_COMMAND that the daemon has sent.
        syncs: how many SYNC it has sent.
        others: how many frames the plant has sent.
        sent: how many frames have been sent to it and the plant.
        reports: how many of them were error frames.
        summary: what the daemon has said of itself in the end.
    """

    def __init__(self, process: subprocess.Popen[str], link: Link, socket: str, log: Path) -> None:
        self.process = process
        self.link = link
        self.socket = socket
        self.log = log
        self.commands: list[bytes] = []
        self.syncs = self.others = self.sent = self.reports = 0
        self.summary: dict[str, Any] = {}
        codecs = loaded().codecs
        self._command_id, self._sync_id = codecs.valve_command.can_id, codecs.sync.can_id
        self._ends = False
        self._ear = threading.Thread(target=self._listen, daemon=True)
        self._ear.start()

    def send(self, can_id: int, data: bytes) -> None:
        assert self.link.send(can_id, data) > 0
        self.sent += 1
        self.reports += bool(can_id & CAN_ERR_FLAG)

    def _listen(self) -> None:
        frames: list[Frame] = []
        while not self._ends:
            self.link.wait(0.01)
            frames.clear()
            self.link.drain(frames)
            for frame in frames:
                if frame.can_id == self._command_id:
                    self.commands.append(frame.data)
                elif frame.can_id == self._sync_id:
                    self.syncs += 1
                else:
                    self.others += 1

    def deafen(self) -> None:
        """Hear no more."""
        self._ends = True
        self._ear.join()

    @property
    def logged(self) -> str:
        """How much of it is in the log."""
        return f"{self.syncs - self.summary['log_dropped']} of {self.syncs} ticks in the log"

    def status(self) -> tuple[str, list[str]]:
        """State and latched faults, as a client is told who comes and goes."""
        found = self._ask()
        return found["state"], [fault["name"] for fault in found["faults"] if fault["latched"]]

    def ready(self) -> bool:
        """Nothing keeps it from arming, and its log is being written."""
        found = self._ask()
        names = {fault["name"] for fault in found["faults"]} - {"encoder_unreferenced"}  # homing is for that
        return found["state"] == "disarmed" and not names and found["log_written"] > 0

    def _ask(self) -> dict[str, Any]:
        with Client(self.socket) as client:
            return client.ask("status")

    def end(self) -> None:
        """Stop it in order."""
        self.process.send_signal(signal.SIGINT)
        out, err = self.process.communicate(timeout=60)
        self.deafen()
        assert self.process.returncode in (0, 1), err
        assert "Traceback" not in err, err
        assert "exception" not in err.lower(), err
        self.summary = json.loads(out)
        assert "internal" not in self.summary["faults"]
        frames = self.summary["frames"]
        assert frames["tx"] == len(self.commands) + self.syncs
        # it counts all but error frames; some may have come when it listened no more
        came = self.sent - self.reports + self.others - self.link.peers_dropped
        assert came - LAST_FRAMES <= frames["rx"] <= came + self.link.peers_dropped

    def ticks(self) -> Iterator[LoggedTick]:
        """The log, held against what was heard: in every tick one SYNC and the one command that the log has.

        Where the axis is not engaged, that is 0 V and Enable 0, and only a request to arm engages it. On a
        machine that is busy with other things the recorder may have lost records; it must have counted them.
        """
        reader = read_log(self.log)
        number, engaged = 0, False
        for tick in reader:
            assert tick.sent[1].data == self.commands[tick.number - 1]
            if not is_engaged(tick.state):
                assert tick.sent[1].data[:3] == bytes(3)
                assert (tick.command.voltage_v, tick.command.enable) == (0.0, 0)
            elif tick.number == number + 1 and not engaged:
                assert tick.request is not None, "engaged by itself"
                assert (tick.request.kind, tick.answer) == (RequestKind.ARM, Answer.TAKEN)
            number, engaged = tick.number, is_engaged(tick.state)
            yield tick
        assert number == len(self.commands) == self.syncs
        assert reader.missing == self.summary["log_dropped"]
        assert not reader.truncated, reader.damage

    def asked(self, ticks: Iterable[LoggedTick], *expected: RequestKind) -> bool:
        """Whether this was asked of the loop, and done, and nothing else."""
        assert all(tick.answer == Answer.TAKEN for tick in ticks if tick.request is not None)
        found = [tick.request.kind for tick in ticks if tick.request is not None]
        return found == list(expected) or (self.summary["log_dropped"] > 0 and set(found) <= set(expected))


@contextmanager
def running(folder: Path, *, incremental: bool = False, log_name: str = "run.mcap") -> Iterator[Running]:
    """A daemon that is ready to arm, or to be homed."""
    name = f"{os.getpid()}-{secrets.token_hex(3)}"
    bus, socket, log = f"unixcan:fire-{name}", Path(f"/tmp/pneud-fire-{name}.sock"), folder / log_name
    axis = patient_axis(folder)
    if incremental:
        axis.write_text(axis.read_text().replace('kind = "absolute"', 'kind = "incremental"'))
    common = ["--config", str(axis), "--bus", bus]
    # it tells whatever its valve node does, and nobody reads that
    plant = subprocess.Popen([*PNEUD, "plant", *common], stderr=subprocess.DEVNULL)
    with open_link(bus) as link:
        process = subprocess.Popen(
            [*PNEUD, *common, "--socket", str(socket), "--log", str(log), "--headless", "--json"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        run = Running(process, link, str(socket), log)
        try:
            eventually(lambda: serves(str(socket)) or process.poll() is not None)
            eventually(run.ready)
            yield run
        finally:
            run.deafen()
            for one in (process, plant):
                one.kill()
                one.communicate()
            socket.unlink(missing_ok=True)
            socket.with_name(socket.name + ".lock").unlink(missing_ok=True)
