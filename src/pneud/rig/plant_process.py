"""The software rig as a process: beside the daemon it is forked, alone it is `pneud plant`."""

from __future__ import annotations

import mmap
import signal
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple, Protocol

from pneud import crew
from pneud.bus.codec import Codecs, fd_of
from pneud.bus.link import Link, LinkError, open_link
from pneud.bus.wire import Carriage
from pneud.physics.plant import BeamParameters, PlantParameters
from pneud.rig.answering import Plant, serve
from pneud.rig.beam import span
from pneud.rig.node import Advance, PlantNode
from pneud.rig.segment import Rigs, Segment
from pneud.rig.truth import TruthWriter
from pneud.rt import setup
from pneud.signals import ValveState

if TYPE_CHECKING:
    from pneud.canopen.plan import Plan
    from pneud.rig.canopen import CanopenRig


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
    name: str = ""  # of the axis
    beam: BeamParameters | None = None  # to another one's piston

    def node(self, segment: Segment | None = None) -> PlantNode:
        """Its nodes and the cylinder between them, to which nothing happens; perhaps on a bus with others."""
        return PlantNode(self.plant, self.codecs, self.seed, advance=self.advance, segment=segment)

    def front(self, node: PlantNode) -> CanopenRig:
        """The CANopen nodes that it is the inside of."""
        from pneud.rig.canopen import CanopenRig, slaves_of  # noqa: PLC0415 - for rigs with nodes only

        return CanopenRig(node, self.plans, slaves_of(self.plans, self.odd_nodes))


class Play(Protocol):
    """What happens to a rig."""

    @property
    def descriptors(self) -> tuple[int, ...]:
        """Those that it needs in the plant's process."""

    def node(self, rig: Rig, segment: Segment) -> PlantNode:
        """The rig's nodes and the cylinder between them, to which it happens, on a bus."""

    def over(self) -> None:
        """The controller has left for good."""


def fork_plant(
    channel: str, rigs: Sequence[Rig], truths: Sequence[mmap.mmap], play: Play | None, to: int = 0
) -> int:
    """The software rig, or several on one bus, in a process of their own, until SIGTERM.

    Args:
        channel: the bus, not "auto".
        rigs: what each is made of.
        truths: shared memory of each for the true positions.
        play: what happens to one of them.
        to: which one.

    Returns:
        Its process id.
    """

    def main() -> None:
        stop = crew.asked_to_leave(signal.SIGTERM)
        fd = fd_of(rig.codecs for rig in rigs)
        with open_link(channel, virtual=True, by=rigs[0].carriage, fd=fd) as link:
            answer(link, rigs, play, stop, truths=[TruthWriter(truth) for truth in truths], to=to)
        if play is not None:
            play.over()

    keep = play.descriptors if play is not None else ()
    return crew.fork(main, keep=keep, name="plant", known=(LinkError,))


def answer(
    link: Link,
    rigs: Sequence[Rig],
    play: Play | None,
    stop: Callable[[], bool],
    *,
    truths: Sequence[TruthWriter] = (),
    to: int = 0,
    on_valve_state: Callable[[ValveState], None] | None = None,
) -> None:
    """Be the rig on a bus, or several, until told to stop.

    Args:
        link: to the bus.
        rigs: what each is made of.
        play: what happens to one of them.
        stop: as for `serve`.
        truths: of each, as for `serve`.
        to: which one.
        on_valve_state: as for `serve`.
    """
    segment = Segment()
    nodes = [
        rig.node(segment) if play is None or n != to else play.node(rig, segment)
        for n, rig in enumerate(rigs)
    ]
    if any(rig.beam is not None for rig in rigs):
        span(nodes, [rig.name for rig in rigs], [rig.beam for rig in rigs])
    for node, truth in zip(nodes, truths, strict=False):
        node.on_truth = truth.put
    setup.apply(rigs[0].priority, None, False)
    fronts = [rig.front(node) for rig, node in zip(rigs, nodes, strict=True) if rig.plans]
    alone = len(nodes) == 1
    plant: Plant = (fronts or nodes)[0] if alone else Rigs(nodes, fronts)
    serve(link, plant, stop=stop, on_valve_state=on_valve_state)
