"""Software CANopen nodes and the `canopen` library on one bus in simulated time: no thread, no waiting."""

from __future__ import annotations

import queue
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import pytest

canopen = pytest.importorskip("canopen")

from pneud.rig.slave import Slave  # noqa: E402
from pneud.signals import Frame  # noqa: E402

FRAME_NS = 120_000


class Wire:
    """The bus: what is sent reaches all slaves, and what they send reaches the library."""

    channel_info = "simulated"

    def __init__(self, *slaves: Slave) -> None:
        self.slaves = slaves
        self.now_ns = 1_000_000_000
        self.network: Any = None
        self.heard: list[Frame] = []
        for slave in slaves:
            slave.power_up(self.now_ns)

    def send(self, message: Any) -> None:
        self.now_ns += FRAME_NS
        frame = Frame(self.now_ns, message.arbitration_id, bytes(message.data))
        self.heard.append(frame)
        for slave in self.slaves:
            slave.poll(self.now_ns - 1)  # which may have booted since
            slave.on_frame(frame)

    def pass_until(self, t_ns: int) -> None:
        """Let time pass, and deliver what comes meanwhile in its order."""
        while (due := [d for s in self.slaves if (d := s.due()) is not None]) and min(due) <= t_ns:
            at_ns = max(self.now_ns, min(due))
            self.now_ns = at_ns
            for slave in self.slaves:
                for frame in slave.poll(at_ns):
                    self.heard.append(frame)
                    for other in self.slaves:
                        if other is not slave:
                            other.on_frame(frame)
                    self.network.notify(frame.can_id, bytearray(frame.data), frame.stamp_ns * 1e-9)
        self.now_ns = max(self.now_ns, t_ns)

    def pause(self, seconds: float) -> None:
        self.pass_until(self.now_ns + round(seconds * 1e9))

    def clock(self) -> float:
        return self.now_ns * 1e-9

    def get(self, waiting: list[bytes], timeout_s: float) -> bytes:
        """What a queue of the library gets, in as much simulated time as that takes."""
        end_ns = self.now_ns + round(timeout_s * 1e9)
        while not waiting and self.now_ns < end_ns:
            due = [d for s in self.slaves if (d := s.due()) is not None]
            self.pass_until(min(end_ns, max(self.now_ns + 1, min(due, default=end_ns))))
        if not waiting:
            raise queue.Empty
        return waiting.pop(0)


@contextmanager
def network_of(wire: Wire) -> Iterator[Any]:
    """The library's network on the simulated bus."""

    class Queue:
        def __init__(self) -> None:
            self._waiting: list[bytes] = []

        def put(self, item: bytes) -> None:
            self._waiting.append(item)

        def empty(self) -> bool:
            return not self._waiting

        def get(self, block: bool = True, timeout: float = 0.0) -> bytes:
            return wire.get(self._waiting, timeout)

    queues = SimpleNamespace(Queue=Queue, Empty=queue.Empty)
    with (
        patch("canopen.sdo.client.queue", queues),
        patch("canopen.lss.queue", queues),
        patch("canopen.lss.time", SimpleNamespace(sleep=wire.pause)),
    ):
        network = canopen.Network(bus=wire)
        wire.network = network
        yield network
