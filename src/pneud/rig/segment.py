"""One bus with the nodes of one software rig or more on it: they share the wire, and so their time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

from pneud.rig.transmission import Wire
from pneud.rig.valvenode import ValveNode
from pneud.signals import Frame

if TYPE_CHECKING:
    from pneud.rig.node import PlantNode, Truth


class Segment:
    """A wire and all who hear what it carries; `PlantNode` joins by itself."""

    def __init__(self) -> None:
        self.wire = Wire()
        self.nodes: list[PlantNode] = []

    def run(self, t_ns: int) -> None:
        """Deal with all that happens until `t_ns`: ends of transmissions, and valve nodes that give up."""
        wire, nodes = self.wire, self.nodes
        while True:
            first = freely = nodes[0]
            if len(nodes) > 1:
                first, freely = min(nodes, key=_deadline), min(nodes, key=_next)
            upcoming, deadline_ns = wire.upcoming, first.valve.deadline_ns
            if freely.next_ns <= min(t_ns, deadline_ns, freely.next_ns if upcoming is None else upcoming[0]):
                freely.sample_freely()
            elif upcoming is not None and upcoming[0] <= t_ns and upcoming[0] <= deadline_ns:
                end_ns, item = wire.take()
                for node in nodes:
                    node.hear(end_ns, item)
            elif deadline_ns <= t_ns:
                first.expire()
            else:
                break


def _deadline(node: PlantNode) -> int:
    return node.valve.deadline_ns


class Front(Protocol):
    """What stands before a plant on the bus: nodes of a network, which have to be configured."""

    def wake(self, t_ns: int) -> None: ...  # noqa: D102
    def hear(self, frame: Frame) -> None: ...  # noqa: D102
    def own_due(self) -> int | None: ...  # noqa: D102
    def say(self, t_ns: int) -> list[Frame]: ...  # noqa: D102


class Rigs:
    """Several rigs on one segment, as one to who serves them."""

    def __init__(self, nodes: Sequence[PlantNode], fronts: Sequence[Front] = ()) -> None:
        """Rigs to which nothing has happened yet.

        Args:
            nodes: all on one segment.
            fronts: of those that have one.
        """
        self.nodes = tuple(nodes)
        self._fronts = tuple(fronts)

    @property
    def started(self) -> bool:
        """Whether time has begun to pass for any."""
        return any(node.started for node in self.nodes)

    @property
    def valve(self) -> ValveNode:
        """That of the first."""
        return self.nodes[0].valve

    def truth(self) -> Truth:
        """That of the first."""
        return self.nodes[0].truth()

    def on_frame(self, frame: Frame) -> None:
        """A frame was sent: the wire carries it once, and what happens to one rig's frames happens to it."""
        for front in self._fronts:
            front.hear(frame)
        takers = [node for node in self.nodes if node.takes(frame.can_id)]
        carrier = next((node for node in takers if node.hook is not None), takers[0] if takers else None)
        for node in takers:
            if node is carrier:
                node.on_frame(frame)
            else:
                node.note(frame)

    def due(self) -> int | None:
        """Earliest time at which `poll` may have a frame; None as long as no frame comes in."""
        dues = [node.due() for node in self.nodes] + [front.own_due() for front in self._fronts]
        times = [due_ns for due_ns in dues if due_ns is not None]
        return min(times) if times else None

    def poll(self, t_ns: int, *, current_only: bool = False) -> list[Frame]:
        """The frames of all that have ended by `t_ns`, in order of their stamps."""
        for front in self._fronts:
            front.wake(t_ns)
        frames = [frame for node in self.nodes for frame in node.poll(t_ns, current_only=current_only)]
        for front in self._fronts:
            frames += front.say(t_ns)
        return sorted(frames, key=_stamp)

    def advance(self, t_ns: int) -> None:
        """Deal with all events until `t_ns`, and integrate the plants to it."""
        for node in self.nodes:
            node.advance(t_ns)


def _next(node: PlantNode) -> int:
    return node.next_ns


def _stamp(frame: Frame) -> int:
    return frame.stamp_ns
