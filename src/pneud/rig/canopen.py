"""The software rig as a CANopen rig: its three nodes have to be configured and started before they answer."""

from __future__ import annotations

from collections.abc import Sequence

from pneud.canopen.objects import Nmt, mapping_word
from pneud.canopen.plan import EVENT, SYNC, Plan
from pneud.canopen.words import RESET_BIT, status_of
from pneud.rig.node import ENCODER_NODE, PRESSURE_NODE, VALVE_NODE, PlantNode, Truth
from pneud.rig.slave import HEALTHY, Oddity, Slave, drawn
from pneud.rig.valvenode import ValveNode
from pneud.signals import Frame, ValveState

LATE_COMMANDS = 0x8250  # emergency: a PDO with commands has not come in time
_LAG_NS = 5_000_000  # how far behind the clock an idle plant is kept
_FIRST_SERIAL = 1000


def slaves_of(plans: Sequence[Plan], seed: int | None = None) -> tuple[Slave, ...]:
    """The nodes of a rig.

    Args:
        plans: what they will be configured to; nothing of it but their EDS and identifiers is used.
        seed: one of them misbehaves, as the seed has it; none: all are as they should be.
    """
    found = []
    for place, plan in enumerate(plans):
        odd: Oddity = HEALTHY
        if seed is not None and seed % len(plans) == place:
            writable = [(step.object.index, step.object.sub) for step in plan.steps if step.write]
            odd = drawn(seed // len(plans), writable)[1]
        serial = plan.node.identity.serial
        found.append(
            Slave(plan.eds, plan.node.id, _FIRST_SERIAL + place if serial is None else serial, odd=odd)
        )
        for number, o in enumerate(("vendor", "product", "revision"), 1):
            if (value := getattr(plan.node.identity, o)) is not None:
                found[-1].identify(number, value)
    return tuple(found)


class CanopenRig:
    """A plant whose nodes are CANopen nodes: what they send and take depends on how they are configured.

    Args:
        inner: the plant; its hook is put behind what its nodes let through.
        plans: of its nodes.
        slaves: as of `slaves_of`.
        configured: they are, and are started; else they are as they come from their boxes.
    """

    def __init__(
        self, inner: PlantNode, plans: Sequence[Plan], slaves: Sequence[Slave], *, configured: bool = False
    ) -> None:
        self.slaves = slaves
        self._inner = inner
        self._hook = inner.hook
        inner.hook = self._pass
        self._configured = configured
        self._plans = plans
        self._powered = False
        self._messages = {
            message.can_id: (slave, message.pdo, message)
            for plan, slave in zip(plans, slaves, strict=True)
            for message in plan.messages
        }
        of = {"position": ENCODER_NODE, "valve": VALVE_NODE}
        self._places = [of.get(plan.node.filled[0], PRESSURE_NODE) for plan in plans]
        self._valve = slaves[self._places.index(VALVE_NODE)]
        self._valve.written = self._written
        self._states = [slave.state for slave in slaves]
        self._shown = ValveState.BOOT

    @property
    def valve(self) -> ValveNode:
        """As the plant's."""
        return self._inner.valve

    @property
    def started(self) -> bool:
        """As the plant's."""
        return self._inner.started

    def truth(self) -> Truth:
        """As the plant's."""
        return self._inner.truth()

    def advance(self, t_ns: int) -> None:
        """As the plant's."""
        self._inner.advance(t_ns)

    def on_frame(self, frame: Frame) -> None:
        """A frame was sent at its stamp."""
        self.hear(frame)
        self._inner.on_frame(frame)

    def hear(self, frame: Frame) -> None:
        """The nodes of the network hear a frame; the plant behind them does not, yet."""
        self.wake(frame.stamp_ns)
        self._show(frame.stamp_ns)
        for slave in self.slaves:
            slave.on_frame(frame)
        self._reboot()

    def due(self) -> int | None:
        """Earliest time [ns] at which `poll` may have a frame."""
        times = [t for t in (self._inner.due(), self.own_due()) if t is not None]
        return min(times) if times else None

    def own_due(self) -> int | None:
        """The same of what `say` says."""
        times = [t for t in (slave.due() for slave in self.slaves) if t is not None]
        return min(times) if times else None

    def poll(self, t_ns: int, *, current_only: bool = False) -> list[Frame]:
        """What the nodes have sent until now, in order of stamps."""
        self.wake(t_ns)
        frames = self._inner.poll(t_ns, current_only=current_only)
        own = self.say(t_ns)
        return sorted((*frames, *own), key=lambda frame: frame.stamp_ns) if own else frames

    def say(self, t_ns: int) -> list[Frame]:
        """What they have sent as nodes of the network until now, when the plant has been polled."""
        inner = self._inner
        if inner.started and inner.due() is None and inner.now_ns < t_ns - 2 * _LAG_NS:
            inner.advance(t_ns - _LAG_NS)
        self._show(t_ns)
        own = [frame for slave in self.slaves for frame in slave.poll(t_ns)]
        self._reboot()
        return own

    def wake(self, t_ns: int) -> None:
        """Power-up, with the first that is heard of the time."""
        if self._powered:
            return
        self._powered = True
        for plan, slave in zip(self._plans, self.slaves, strict=True):
            slave.power_up(t_ns)
            if self._configured:
                slave.configure(
                    {(s.object.index, s.object.sub): s.value for s in plan.steps if s.write}, t_ns
                )

    def _pass(self, frame: Frame, outgoing: bool) -> Sequence[Frame]:
        """What nodes that are not started, or configured otherwise, neither send nor take."""
        known = self._messages.get(frame.can_id)
        if known is not None:
            slave, pdo, message = known
            kind = SYNC if pdo.sent else EVENT
            words = [mapping_word(c.object) for c in message.carried]
            fits = slave.get(pdo.parameters, 2) == kind and slave.mapping(pdo) == words
            if not slave.uses(pdo, frame.can_id) or not fits:
                return ()
        return (frame,) if self._hook is None else self._hook(frame, outgoing)

    def _written(self, index: int, sub: int) -> None:
        """A value of the valve's node has been written."""
        if (index, sub) == (0x6040, 0) and self._valve.get(index, sub) & RESET_BIT:
            self._inner.valve.reset()

    def _show(self, t_ns: int) -> None:
        """Let the valve's node say what state the valve is in."""
        state = self._inner.valve.state
        if state == self._shown:
            return
        self._valve.set(0x6041, 0, status_of(state))
        if state == ValveState.TIMED_OUT:
            self._valve.emergency(t_ns, LATE_COMMANDS)
        elif self._shown == ValveState.TIMED_OUT:
            self._valve.emergency(t_ns, 0)
        self._shown = ValveState(state)

    def _reboot(self) -> None:
        """What reboots as a node of the network does so as a part of the plant."""
        for n, slave in enumerate(self.slaves):
            if slave.state == Nmt.BOOT != self._states[n]:
                self._inner.reboot(self._places[n])
            self._states[n] = slave.state
            if (
                slave is self._valve
                and self._inner.valve.state == ValveState.BOOT
                and slave.state != Nmt.BOOT
            ):
                self._inner.valve.booted()
