"""What configures CANopen nodes, in a world: the bus of its library, and queues, as an actor has them."""

from __future__ import annotations

import queue
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import can

from pneud.bus.wire import CAN_ERR_FLAG, CAN_RTR_FLAG
from pneud.prove.canbus import CanBus, Party
from pneud.prove.doors import Door, TimeDoor, deadline_ns
from pneud.prove.world import Happening, World
from pneud.signals import Frame

NAME = "nodes"  # of the process, and of its parties on the bus
SEAMS: dict[str, tuple[str, ...]] = {"pneud.canopen.keeper": ("time",), "pneud.canopen.master": ("time",)}
"""As of `seams`, where nodes have to be configured."""
_ID = (1 << 29) - 1


def adapters(world: World, bus: CanBus) -> dict[str, Any]:
    """What takes the place of functions and modules, by module and name."""
    return {
        "canopen.network.can": CanDoor(world, bus),
        "canopen.sdo.client.queue": QueueDoor(world),
        "canopen.sdo.client.time": TimeDoor(world),
        "pneud.canopen.keeper.open_link": lambda *_, **__: bus.link(NAME),
        "pneud.canopen.keeper.print": lambda words, **_: world.note(words),
    }


class Bus:
    """A bus of python-can."""

    channel_info = "prove"

    def __init__(self, world: World, bus: CanBus) -> None:
        self.party = Party(world, bus, NAME)

    def send(self, message: Any) -> None:
        """Send a message.

        Raises:
            can.CanOperationError: it cannot be sent.
        """
        flag = CAN_RTR_FLAG if message.is_remote_frame else 0
        try:
            self.party.send(message.arbitration_id | flag, bytes(message.data or b""))
        except OSError as e:
            raise can.CanOperationError(f"Failed to transmit: {e}") from e

    def shutdown(self) -> None:
        """Leave it."""
        self.party.close()


class CanDoor(Door):
    """`can`: buses are of the world, and who listens to one is a thread of it."""

    real = can

    def __init__(self, world: World, bus: CanBus) -> None:
        super().__init__(world)
        self._bus = bus

        class Notifier:
            """Hands on what comes, in a thread."""

            def __init__(self, bus: Bus, listeners: Sequence[Any], timeout: float) -> None:
                self.exception: Exception | None = None
                self._stopped = False
                self._bus, self._listeners = bus, listeners
                self._wait_ns = round(1e9 * timeout)
                self._actor = world.thread(self._run)

            def _run(self) -> None:
                while not self._stopped:
                    frames: list[Frame] = []
                    try:
                        self._bus.party.drain(0, frames, self._wait_ns)
                    except OSError as e:
                        self.exception = can.CanOperationError(f"Error receiving: {e}")
                        return
                    for frame in frames:
                        message = _message(frame)
                        for listener in self._listeners:
                            listener.on_message_received(message)

            def stop(self, timeout: float) -> None:
                self._stopped = True
                until_ns = deadline_ns(world, timeout)
                while not self._actor.done and world.now_ns < until_ns:
                    world.wait(until_ns, self._actor.ended)

        self.Notifier = Notifier

    def Bus(self, interface: str, channel: str) -> Bus:
        """Join the bus."""
        assert (interface, channel) == ("prove", "")
        return Bus(self.world, self._bus)


def _message(frame: Frame) -> Any:
    stamp_ns, can_id, data = frame
    return SimpleNamespace(
        is_error_frame=bool(can_id & CAN_ERR_FLAG),
        is_remote_frame=bool(can_id & CAN_RTR_FLAG),
        arbitration_id=can_id & _ID,
        data=bytearray(data),
        timestamp=stamp_ns * 1e-9,
    )


class QueueDoor(Door):
    """`queue`: between the threads of a process."""

    real = queue

    def __init__(self, world: World) -> None:
        super().__init__(world)

        class Queue:
            """A queue."""

            def __init__(self) -> None:
                self._waiting: list[Any] = []
                self._came = Happening()

            def put(self, item: Any) -> None:
                world.step()
                self._waiting.append(item)
                world.happens(self._came)

            def empty(self) -> bool:
                return not self._waiting

            def get(self, block: bool = True, timeout: float | None = None) -> Any:
                world.step()
                until_ns = deadline_ns(world, timeout if block else 0.0)
                while not self._waiting:
                    if world.now_ns >= until_ns:
                        raise queue.Empty
                    world.wait(until_ns, self._came)
                return self._waiting.pop(0)

        self.Queue = Queue
