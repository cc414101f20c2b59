"""The software rig as a process: beside the daemon it is forked, alone it is `pneud plant`."""

from __future__ import annotations

import mmap
import signal
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, Protocol

from pneud import crew
from pneud.bus.codec import Codecs
from pneud.bus.link import Link, LinkError, open_link
from pneud.bus.wire import Carriage
from pneud.physics.plant import PlantParameters
from pneud.rig.answering import Plant, serve
from pneud.rig.node import Advance, PlantNode
from pneud.rig.truth import TruthWriter
from pneud.rt import setup
from pneud.signals import ValveState

if TYPE_CHECKING:
    from pneud.canopen.plan import Plan


class Rig(NamedTuple):
    """What a software rig is made of."""

    plant: PlantParameters
    codecs: Codecs  # of the frames
    seed: int  # of the sensors' noise
    priority: int  # to try for, since frames that come late are not what a real bus does
    advance: Advance  # what integrates the plant
    carriage: Carriage  # how frames are taken from the bus and given to it
    plans: tuple[Plan, ...] = ()  # of its nodes, where they have to be configured before they answer
    odd_nodes: int | None = None  # seed of their misbehaviour

    def node(self) -> PlantNode:
        """Its nodes and the cylinder between them, to which nothing happens."""
        return PlantNode(self.plant, self.codecs, self.seed, advance=self.advance)

    def answering(self, node: PlantNode) -> Plant:
        """What answers on the bus for it: itself, or CANopen nodes that it is the inside of."""
        if not self.plans:
            return node
        from pneud.rig.canopen import CanopenRig, slaves_of  # noqa: PLC0415 - for rigs with nodes only

        return CanopenRig(node, self.plans, slaves_of(self.plans, self.odd_nodes))


class Play(Protocol):
    """What happens to a rig."""

    @property
    def descriptors(self) -> tuple[int, ...]:
        """Those that it needs in the plant's process."""

    def node(self, rig: Rig) -> PlantNode:
        """The rig's nodes and the cylinder between them, to which it happens."""

    def over(self) -> None:
        """The controller has left for good."""


def fork_plant(channel: str, rig: Rig, truth: mmap.mmap, play: Play | None) -> int:
    """The software rig in a process of its own, until SIGTERM.

    Args:
        channel: the bus, not "auto".
        rig: what it is made of.
        truth: shared memory for the true positions.
        play: what happens to it.

    Returns:
        Its process id.
    """

    def main() -> None:
        stop = crew.asked_to_leave(signal.SIGTERM)
        with open_link(channel, virtual=True, by=rig.carriage) as link:
            answer(link, rig, play, stop, truth=TruthWriter(truth))
        if play is not None:
            play.over()

    keep = play.descriptors if play is not None else ()
    return crew.fork(main, keep=keep, known=(LinkError,))


def answer(
    link: Link,
    rig: Rig,
    play: Play | None,
    stop: Callable[[], bool],
    *,
    truth: TruthWriter | None = None,
    on_valve_state: Callable[[ValveState], None] | None = None,
) -> None:
    """Be the rig on a bus until told to stop.

    Args:
        link: to the bus.
        rig: what it is made of.
        play: what happens to it.
        stop: as for `serve`.
        truth: as for `serve`.
        on_valve_state: as for `serve`.
    """
    node = rig.node() if play is None else play.node(rig)
    setup.apply(rig.priority, None, False)
    serve(link, rig.answering(node), stop=stop, truth=truth, on_valve_state=on_valve_state)
