"""The plant in real time: its nodes on a bus, frames sent when they are due."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from pneud.rig.node import Truth
from pneud.rig.truth import TruthWriter
from pneud.rig.valvenode import ValveNode
from pneud.signals import Frame, ValveState

IDLE_S = 0.02  # longest wait: how late `stop` and a valve time-out may be noticed
MAX_DRAINS = 4  # looks for further frames before answering
LAG_NS = 5_000_000  # how far behind the clock an idle plant is kept


class BusLink(Protocol):
    """What the runner needs of a link to the bus."""

    def watch_clock(self) -> int:
        """Follow a step of the wall clock."""

    def drain(self, into: list[Frame]) -> int:
        """Append everything received, in order of stamps."""

    def send(self, can_id: int, data: bytes) -> int:
        """Send one frame."""

    def wait(self, timeout_s: float) -> bool:
        """Sleep until something can be drained, or the time is over."""


class Plant(Protocol):
    """What runs a rig, in real time or in simulated time."""

    @property
    def valve(self) -> ValveNode: ...  # noqa: D102
    @property
    def started(self) -> bool: ...  # noqa: D102
    def on_frame(self, frame: Frame) -> None: ...  # noqa: D102
    def due(self) -> int | None: ...  # noqa: D102
    def poll(self, t_ns: int, *, current_only: bool = False) -> list[Frame]: ...  # noqa: D102
    def advance(self, t_ns: int) -> None: ...  # noqa: D102
    def truth(self) -> Truth: ...  # noqa: D102


def serve(
    link: BusLink,
    node: Plant,
    *,
    stop: Callable[[], bool],
    truth: TruthWriter | None = None,
    on_valve_state: Callable[[ValveState], None] | None = None,
) -> None:
    """Run the plant on a bus until `stop()`; a late wake-up delays frames, never the plant's own time.

    Args:
        link: to the bus; its stamps are CLOCK_MONOTONIC.
        node: the plant.
        stop: asked at least every 20 ms.
        truth: where the true position at every SYNC is put.
        on_valve_state: told whenever the valve node changes its state.
    """
    frames: list[Frame] = []
    synced_ns = node.truth().t_ns
    valve_state = node.valve.state
    while not stop():
        due_ns = node.due()
        timeout_s = IDLE_S if due_ns is None else min(IDLE_S, (due_ns - time.monotonic_ns()) * 1e-9)
        if timeout_s > 0.0:
            link.wait(timeout_s)
        heard = False
        for _ in range(MAX_DRAINS):
            # before the drain: whatever was sent until now is then known to the node
            now_ns = time.monotonic_ns()
            link.watch_clock()
            frames.clear()
            link.drain(frames)
            heard = heard or bool(frames)
            come_ns = time.monotonic_ns()
            for frame in frames:
                # a wall clock that was set meanwhile must not take the rig along into the future
                node.on_frame(frame if frame.stamp_ns <= come_ns else frame._replace(stamp_ns=come_ns))
                at = node.truth()
                if at.t_ns != synced_ns:
                    synced_ns = at.t_ns
                    if truth is not None:
                        truth.put(at.t_ns, at.position_m)
            if not frames or not link.wait(0.0):
                break  # else a SYNC came while the plant integrated, and outdated answers must not leave
        # one frame at a time where they are late, so that a SYNC which came meanwhile makes the rest void
        until_ns = now_ns if due_ns is None else min(now_ns, due_ns)
        for frame in node.poll(until_ns, current_only=True):
            link.send(frame.can_id, frame.data)
        if not heard and due_ns is None and node.started:
            node.advance(
                now_ns - LAG_NS
            )  # in small portions, or the next frame would find hours to integrate
        if node.valve.state != valve_state:
            valve_state = node.valve.state
            if on_valve_state is not None:
                on_valve_state(valve_state)
