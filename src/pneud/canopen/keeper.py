"""The keeper of the nodes: a process beside the loop that configures them, and again where one has rebooted.

It has the bus to itself while it works: the loop sends no SYNC until the nodes are ready, unless its axis is
engaged, and the keeper waits for that. Bytes of shared memory say so to each other, of each axis whether its
own nodes are ready: a node that has to be configured anew is nothing to an axis that goes on without it.
"""

from __future__ import annotations

import mmap
import signal
import sys
import time
from collections.abc import Callable, Sequence, Set

from pneud import crew
from pneud.bus.link import Link, LinkError, open_link
from pneud.bus.wire import CAN_RTR_FLAG
from pneud.canopen import objects
from pneud.canopen.master import NEEDER, BusError, Master, NodeError, network_on
from pneud.canopen.objects import Nmt
from pneud.canopen.plan import Plan
from pneud.canopen.words import RESET_WORD
from pneud.rt.extras import ExtraError, require
from pneud.signals import Frame

_QUIET, _READY = 0, 1  # places in the memory: of the loop, and of the keeper, a byte for each axis
_AGAIN = "it is configured anew before anything arms"
_LOOK_S = 0.02
_AGAIN_S = 2.0  # after a failure
_RESET_S = 0.5  # between two attempts to end a valve's fault
_QUIET_S = 1.0  # longest that the loop takes to be quiet, once its axis is not engaged


class Readiness:
    """Whether the nodes are ready, in memory that loop and keeper share.

    Attributes:
        keeper: its process id, for the loop; 0 where there is none.
        lost: it has died, and nobody configures the nodes any more; known by `look`.
    """

    def __init__(self, axes: Sequence[Set[int]] | None = None) -> None:
        """No node is ready.

        Args:
            axes: identifiers of each one's nodes; None for an axis that has them all.
        """
        self._axes = axes
        self._places = range(_READY, _READY + (1 if axes is None else len(axes)))
        self._memory = mmap.mmap(-1, mmap.PAGESIZE)
        self.keeper = 0
        self.lost = False

    def look(self) -> None:
        """See whether the keeper is there; in the loop's process, which is its parent."""
        if self.keeper and not self.lost and crew.gone(self.keeper):
            self.lost = True

    @property
    def ready(self) -> bool:
        """All nodes are configured and started; until then nothing is to be armed."""
        return not self.lost and all(self._memory[place] for place in self._places)

    def is_ready(self, axis: int) -> bool:
        """Whether those of an axis are, by its place."""
        if self.lost:
            return self._axes is not None and not self._axes[axis]
        return self._memory[_READY + axis] != 0

    def tell(self, to_do: Set[int]) -> None:
        """What has to be configured yet."""
        if self._axes is None:
            self._memory[_READY] = not to_do
        else:
            for place, own in zip(self._places, self._axes, strict=True):
                self._memory[place] = own.isdisjoint(to_do)

    @property
    def quiet(self) -> bool:
        """The loop sends no SYNC."""
        return self._memory[_QUIET] != 0

    @quiet.setter
    def quiet(self, quiet: bool) -> None:
        self._memory[_QUIET] = quiet


def fork_keeper(channel: str, plans: Sequence[Plan], readiness: Readiness) -> int:
    """Keep the nodes of a bus configured, in a process of its own, until SIGTERM.

    Args:
        channel: the bus, not "auto".
        plans: of the nodes.
        readiness: shared with the loop; it is told of the process.

    Returns:
        Its process id.
    """

    def main() -> None:
        keeper = Keeper(channel, plans, readiness, crew.asked_to_leave(signal.SIGTERM))
        keeper.run()

    readiness.keeper = crew.fork(main, name="nodes", known=(LinkError, ExtraError))
    return readiness.keeper


class Keeper:
    """Configures, then watches.

    Args:
        channel: the bus.
        plans: of the nodes.
        readiness: shared with the loop.
        stop: whether to leave.
        say: takes a line for a person.
    """

    def __init__(
        self,
        channel: str,
        plans: Sequence[Plan],
        readiness: Readiness,
        stop: Callable[[], bool],
        say: Callable[[str], None] | None = None,
    ) -> None:
        self._channel = channel
        self._plans = {plan.node.id: plan for plan in plans}
        self._to_do = set(self._plans)  # nodes that have to be configured
        self._readiness = readiness
        self._stop = stop
        self._say = say or _to_standard_error
        self._said = ""
        self._emergencies: dict[int, int] = {}
        self._guarded = {plan.node.id: plan.node for plan in plans if plan.node.guard}
        self._asked_at = dict.fromkeys(self._guarded, 0.0)  # for their state
        self._told_at = dict.fromkeys(self._plans, 0.0)
        self._reset_at = 0.0

    def run(self) -> None:
        """Until told to leave."""
        with open_link(self._channel) as link:
            while not self._stop():
                self._readiness.tell(self._to_do)
                if not self._to_do:
                    self._watch(link)
                elif not self._configured(link):
                    self._sleep(_AGAIN_S, link)

    def _configured(self, link: Link) -> bool:
        end = time.monotonic() + _QUIET_S
        while not self._readiness.quiet and time.monotonic() < end:
            self._sleep(_LOOK_S, link)
        if not self._readiness.quiet:
            self._tell("nodes: to configure them takes a bus without SYNC: that waits until no axis is armed")
            return False
        plans = [plan for node, plan in self._plans.items() if node in self._to_do]
        if link.down:
            link.reopen()
        try:
            with network_on(self._channel) as network:
                found = Master(network).configure(plans)
        except NodeError as e:
            self._tell(f"nodes: {e}")
            return False
        except BusError as e:
            self._tell(f"nodes: {e}")
            return False
        done, self._to_do = self._to_do, set()
        # guarding has paused meanwhile; heartbeats have not
        self._told_at |= dict.fromkeys((*done, *self._guarded), time.monotonic())
        self._hear(link, just_done=done)
        for note in (note for one in found for note in one.notes):
            self._say(f"nodes: {note}")
        self._say(f"nodes: {', '.join(str(one.node) for one in found)} configured and started")
        self._said = ""
        return True

    def _watch(self, link: Link) -> None:
        """Look on until a node has to be configured anew."""
        while not self._stop() and not self._to_do:
            self._look(link)
            self._end_faults(link)

    def _look(self, link: Link) -> None:
        """See how the nodes are that are ready."""
        time.sleep(_LOOK_S)
        self._hear(link)
        self._guard(link)
        self._miss()

    def _hear(self, link: Link, just_done: Set[int] = frozenset()) -> None:
        """Take what has come.

        Args:
            link: to the bus.
            just_done: nodes that have just been configured, however often they have booted meanwhile: of
                these the last that they have said of their state counts.
        """
        frames: list[Frame] = []
        last: dict[int, int] = {}  # state of those
        link.watch_clock()
        link.drain(frames)
        for _, can_id, data in frames:
            node = can_id & 0x7F
            if node not in self._plans or not data:
                continue
            if can_id == objects.HEARTBEAT_ID + node:
                self._told_at[node] = time.monotonic()
                if node in just_done:
                    last[node] = data[0] & 0x7F
                else:
                    self._see(node, data[0] & 0x7F)
            elif can_id == objects.EMCY_ID + node and len(data) >= 2:
                self._emergency(node, int.from_bytes(data[:2], "little"))
        for node, state in last.items():
            self._see(node, state)

    def _see(self, node: int, state: int) -> None:
        """A node says what state it is in."""
        if state != Nmt.OPERATIONAL and node not in self._to_do:
            word = "has rebooted" if state == Nmt.BOOT else "is no longer operational"
            self._again(node, word)

    def _again(self, node: int, why: str) -> None:
        """A node has to be configured anew."""
        self._say(f"nodes: {self._plans[node].name} {why}; {_AGAIN}")
        self._to_do.add(node)

    def _guard(self, link: Link) -> None:
        """Ask nodes without a heartbeat for their state."""
        now = time.monotonic()
        for node, told in self._guarded.items():
            if now - self._asked_at[node] >= told.heartbeat_ms * 1e-3:
                self._asked_at[node] = now
                link.send(objects.HEARTBEAT_ID + node | CAN_RTR_FLAG, b"")

    def _miss(self) -> None:
        """A node that says nothing of its state may have rebooted unheard, and is not ready any more."""
        now = time.monotonic()
        for node, plan in self._plans.items():
            if now - self._told_at[node] > plan.node.patience_ms * 1e-3 and node not in self._to_do:
                what = "does not answer its guarding" if node in self._guarded else "sends no heartbeat"
                self._again(node, what)

    def _emergency(self, node: int, code: int) -> None:
        if code != self._emergencies.get(node, 0):
            words = f"EMCY 0x{code:04X}: {objects.emergency_words(code)}"
            self._say(f"nodes: {self._plans[node].name}: {words}")
        self._emergencies[node] = code

    def _end_faults(self, link: Link) -> None:
        """Ask valves in fault, which the axis has let go of by now, for the end of it."""
        now = time.monotonic()
        if now < self._reset_at:
            return
        self._reset_at = now + _RESET_S
        for node, code in self._emergencies.items():
            if code and self._plans[node].node.profile == "valve408":
                o = objects.CONTROL_WORD
                write = bytes((0x2B, o.index & 0xFF, o.index >> 8, o.sub))
                link.send(objects.SDO_REQUEST_ID + node, write + RESET_WORD.to_bytes(4, "little"))

    def _tell(self, line: str) -> None:
        """Say it, once."""
        if line != self._said:
            self._said = line
            self._say(line)

    def _sleep(self, seconds: float, link: Link) -> None:
        end = time.monotonic() + seconds
        while not self._stop() and time.monotonic() < end:
            if self._readiness.quiet:
                time.sleep(_LOOK_S)
            else:  # an axis goes on, with nodes that have to be looked after
                self._look(link)
                self._readiness.tell(self._to_do)


def _to_standard_error(line: str) -> None:
    print(f"pneud: {line}", file=sys.stderr, flush=True)


def check_library() -> None:
    """Make sure that what configures nodes is installed.

    Raises:
        ExtraError: it is not.
    """
    require(NEEDER, "canopen")
