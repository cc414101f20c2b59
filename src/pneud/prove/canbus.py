"""The bus of a world: parties that send frames to each other, and what may become of these on their way."""

from __future__ import annotations

import errno
import heapq
import os
from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

from pneud.bus.link import Link
from pneud.prove.pipes import Readable
from pneud.prove.world import FOREVER_NS, World
from pneud.signals import Frame

EMPTY_LOOK_NS = 30_000  # that a look at an empty queue takes
MOST_WAITING = 4096  # frames, at a party that does not read
_ARRIVES_NS = 3_000
ALL = -1  # axes
OURS = ("loop", "nodes")  # parties of the daemon, by one interface


class Trouble(NamedTuple):
    """What becomes of frames, for some time."""

    kind: str  # drop, twice, late, shuffle, stamp, corrupt
    until_ns: int
    share: float  # of the frames
    by_ns: int  # late, or off
    towards: str  # a party's name: what it hears; "" for all
    axis: int = ALL  # whose frames; those of all have none


class Party(Readable):
    """Somebody on the bus: what a `Link` carries frames by."""

    def __init__(self, world: World, bus: CanBus, name: str) -> None:
        super().__init__(world)
        self.name = name
        self.heard_ns: dict[int, int] = {}  # when a frame came last, by identifier
        self._bus = bus
        self._waiting: list[tuple[int, int, int, int, bytes]] = []  # when, number, stamp, identifier, data
        bus.parties.append(self)

    @property
    def down(self) -> bool:
        """The interface by which it is on the bus is."""
        return self._bus.down and self.name in OURS

    @property
    def full(self) -> bool:
        """The queue of that takes nothing more."""
        return self._bus.full and self.name in OURS

    @property
    def dropped(self) -> int:
        """Nobody counts."""
        return 0

    def can_read(self) -> bool:
        """Whether a frame is there, or the interface is down, which is always readable."""
        return self.down or bool(self._waiting and self._waiting[0][0] <= self.world.now_ns)

    def put(self, due_ns: int, stamp_ns: int, can_id: int, data: bytes) -> None:
        """A frame comes, then."""
        if len(self._waiting) < MOST_WAITING and not self.down:
            self._bus.number += 1
            heapq.heappush(self._waiting, (due_ns, self._bus.number, stamp_ns, can_id, data))
            self.world.happens_at(self.readable, due_ns)

    def due_ns(self) -> int:
        """When a frame comes that is on its way."""
        return self._waiting[0][0] if self._waiting else FOREVER_NS

    def drain(self, offset_ns: int, into: list[Frame], wait_ns: int = 0) -> int:
        """As of `Carrier`."""
        world = self.world
        world.step()
        if self.down:
            raise OSError(errno.ENETDOWN, os.strerror(errno.ENETDOWN))
        waiting, before = self._waiting, len(into)
        if not (waiting and waiting[0][0] <= world.now_ns):
            if wait_ns:
                world.wait(min(world.now_ns + wait_ns, self.due_ns()), self.readable)
            else:
                world.pass_until(min(world.now_ns + EMPTY_LOOK_NS, self.due_ns()))
            if self.down:
                raise OSError(errno.ENETDOWN, os.strerror(errno.ENETDOWN))
        while waiting and waiting[0][0] <= world.now_ns:
            due_ns, _, stamp_ns, can_id, data = heapq.heappop(waiting)
            self.heard_ns[can_id] = due_ns
            into.append(Frame(stamp_ns - offset_ns, can_id, data))
        if len(into) > before + 1:
            into[before:] = sorted(into[before:], key=_stamp)
        return len(into) - before

    def send(self, can_id: int, data: bytes) -> None:
        """As of `Carrier`."""
        self.world.step()
        if self.down:
            raise OSError(errno.ENETDOWN, os.strerror(errno.ENETDOWN))
        if self.full:
            raise OSError(errno.ENOBUFS, os.strerror(errno.ENOBUFS))
        self._bus.carry(self, can_id, bytes(data))

    def gone(self) -> None:
        """Leave the bus."""
        if self in self._bus.parties:
            self._bus.parties.remove(self)


def _stamp(frame: Frame) -> int:
    return frame.stamp_ns


class CanBus:
    """A bus.

    Attributes:
        parties: on it.
        troubles: that it has.
        on_frame: told of every frame that is sent: by whom, identifier, data.
        down: the interface of the daemon's machine is.
        full: its queue takes nothing more.
    """

    def __init__(self, world: World, own: Sequence[Collection[int]]) -> None:
        """Nobody is there.

        Args:
            world: of it.
            own: identifiers of each axis's frames.
        """
        self.parties: list[Party] = []
        self.troubles: list[Trouble] = []
        self.number = 0
        self.down = self.full = False
        self.on_frame: Callable[[str, int, bytes], None] = lambda *_: None
        self._own = own
        self._troubled_ns = [0] * len(own)
        self._world = world

    def link(self, name: str) -> Link:
        """Join, as who runs."""
        return Link("prove", Party(self._world, self, name))

    def party(self, name: str) -> Party | None:
        """Who is there by a name, the newest one."""
        return next((one for one in reversed(self.parties) if one.name == name), None)

    def troubled_ns(self, axis: int) -> int:
        """When there was a trouble last that an axis may have to do with."""
        if any(one.axis in (ALL, axis) for one in self.troubles):
            self._troubled_ns[axis] = self._world.now_ns
        return self._troubled_ns[axis]

    def carry(self, sender: Party | None, can_id: int, data: bytes) -> None:
        """Have all others hear a frame."""
        world = self._world
        self.on_frame("" if sender is None else sender.name, can_id, data)
        now_ns = world.now_ns
        if self.troubles:
            for axis in range(len(self._own)):
                self.troubled_ns(axis)
            self.troubles = [one for one in self.troubles if one.until_ns > now_ns]
        for party in self.parties:
            if party is sender:
                continue
            if self.troubles:
                self._with_troubles(party, can_id, data)
            else:
                due_ns = now_ns + _ARRIVES_NS
                party.put(due_ns, due_ns + world.wall_ns, can_id, data)

    def _with_troubles(self, party: Party, can_id: int, data: bytes) -> None:
        world, draw = self._world, self._world.rng.random
        due_ns, stamp_off_ns, copies, late_ns = world.now_ns + _ARRIVES_NS, 0, 1, 0
        for kind, _, share, by_ns, towards, axis in self.troubles:
            if axis != ALL and can_id not in self._own[axis]:
                continue
            if towards not in ("", party.name) or draw() >= share:
                continue
            if kind == "drop":
                return
            if kind == "twice":
                copies += 1
            elif kind == "late":  # the frame itself is late: it is stamped when it comes
                due_ns += by_ns
            elif kind == "shuffle":
                due_ns += round(draw() * by_ns)
            elif kind == "behind":  # it is stamped in time, and read late
                late_ns += by_ns
            elif kind == "stamp":
                stamp_off_ns += by_ns
            elif kind == "corrupt" and data:
                place = int(draw() * len(data))
                data = data[:place] + bytes((data[place] ^ 1 << int(draw() * 8),)) + data[place + 1 :]
        for _ in range(copies):
            party.put(due_ns + late_ns, due_ns + world.wall_ns + stamp_off_ns, can_id, data)
