"""Several axes and their software rigs on one bus in simulated time: the loop without process or clock.

What the loop does for several is done here by the same parts: frames go by `Routes`, faults touch others by
`Company`. The same seed gives the same records on every run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from pneud.bus.mapped_inbox import inbox_of
from pneud.bus.shared import identifiers
from pneud.bus.wire import wire_time_ns
from pneud.compiled.backend import INTERPRETED, Backend
from pneud.config import conversions
from pneud.loading import SYNC_COUNTERS, Loaded, plans_of_plant
from pneud.loop.company import Company
from pneud.loop.conditions import Conditions
from pneud.loop.routes import Routes
from pneud.loop.turn import END_TICKS, Turn
from pneud.replay.lockstep import COMPUTING_NS, START_NS
from pneud.rig.beam import span
from pneud.rig.node import Hook, PlantNode
from pneud.rig.segment import Front, Rigs, Segment
from pneud.safety.faults import BLOCKS_ARM
from pneud.safety.supervisor import is_engaged
from pneud.signals import Frame, Record, Request, RequestKind, State, Tick, Timing, Told

if TYPE_CHECKING:
    from pneud.scenario.engine import Engine
    from pneud.scenario.format import Scenario

ARM = Request(RequestKind.ARM, (1.0,))


class _Whole:
    """A way to the bus that is as it should be."""

    down = False
    tx_failed = rx_dropped = 0


class SimulatedLane:
    """One axis: as the loop's lane, as far as others see it.

    Attributes:
        turn: the exchange.
        node: its rig.
        identifiers: of frames that are this axis's alone.
        touched: as of a lane.
        told: likewise.
    """

    def __init__(self, loaded: Loaded, node: PlantNode, how: Backend) -> None:
        p = conversions.axis_of(loaded.config, loaded.codecs.command_lsb_v)
        self.turn = Turn(how.axis(p), inbox_of(loaded.codecs, loaded.config.bus), loaded.codecs)
        self.node = node
        self.identifiers = frozenset(identifiers(loaded.config, loaded.codecs))
        self.touched = 0
        self.told: Told | None = None
        self.waits = True
        self.conditions = Conditions(self.turn.inbox, _Whole())
        self.shut = False

    def see(self, tick: Tick) -> None:
        """Whether the run is still to arm the axis, and cannot yet."""
        ready = tick.state == State.DISARMED and not tick.present & BLOCKS_ARM
        self.waits = not (ready or is_engaged(tick.state) or tick.latched)


def _fronts(lanes: Sequence[SimulatedLane], axes: Sequence[Loaded]) -> list[Front]:
    """The CANopen nodes before the plants that have some; they are configured."""
    found: list[Front] = []
    for lane, axis in zip(lanes, axes, strict=True):
        if plans := plans_of_plant(axis):
            from pneud.rig.canopen import CanopenRig, slaves_of  # noqa: PLC0415 - for rigs with nodes only

            found.append(CanopenRig(lane.node, plans, slaves_of(plans), configured=True))
    return found


Ask = Callable[[Sequence[Tick]], Mapping[int, Request]]
"""Asked in every tick but the first: the last tick of each axis → requests by the places of the axes."""


class Together:
    """One run of several axes; iterate over `records`."""

    def __init__(
        self,
        axes: Sequence[Loaded],
        duration_s: float,
        seed: int = 0,
        how: Sequence[Backend] = (),
        hooks: Sequence[Hook | None] = (),
        ask: Ask | None = None,
        scenario: Scenario | None = None,
    ) -> None:
        """A run that has not begun.

        Args:
            axes: on one bus.
            duration_s: simulated time until they are told to shut down.
            seed: of the first axis's noise; the others' are behind it.
            how: each is computed.
            hooks: what happens to each one's frames.
            ask: what operators want; else all are armed once all can be, and track.
            scenario: what happens to the rig of the axis that it names, else of the first; nothing of what it
                does to a machine.
        """
        segment = Segment()
        hows, hooks = how or [INTERPRETED] * len(axes), hooks or [None] * len(axes)
        self.engine: Engine | None = None
        self.struck = 0  # place of the axis that a scenario happens to
        if scenario is not None:
            self.struck = [axis.config.name for axis in axes].index(scenario.axis or axes[0].config.name)
        self.lanes = []
        for n, (axis, one, hook) in enumerate(zip(axes, hows, hooks, strict=True)):
            p = conversions.plant_of(axis.config)
            if scenario is not None and n == self.struck:
                from pneud.scenario.engine import Engine  # noqa: PLC0415 - for runs with a scenario only

                self.engine = Engine(
                    scenario, p, axis.codecs, seed + n, axis.config.loop.rate_hz,
                    advance=one.advance, segment=segment,
                )  # fmt: skip
                node = self.engine.node
            else:
                node = PlantNode(p, axis.codecs, seed + n, hook=hook, advance=one.advance, segment=segment)
            self.lanes.append(SimulatedLane(axis, node, one))
        names = [axis.config.name for axis in axes]
        span([lane.node for lane in self.lanes], names, [conversions.beam_of(a.config) for a in axes])
        c = axes[0].config
        self._rigs = Rigs([lane.node for lane in self.lanes], _fronts(self.lanes, axes))
        self._routes, self._ask, self._armed = Routes(self.lanes), ask, False
        self._company = Company(self.lanes, [axis.config for axis in axes], None)
        self._sync = axes[0].codecs.sync
        bus, codec = axes[0].config.bus, self._sync
        told = (codec.length, bus.bitrate_bit_s, codec.can_id, codec.data_bit_s)
        self._heard_ns = wire_time_ns(*told) if bus.follows else 0
        self._period_ns = round(1e9 / c.loop.rate_hz)
        self._wait_ns = round(self._period_ns * c.loop.set_deadline)
        self._total = max(1, round(duration_s * c.loop.rate_hz))

    def records(self) -> Iterator[tuple[Record, ...]]:
        """The ticks, each as the loop hands it to the recorders: one record for each axis."""
        lanes, rigs, routes = self.lanes, self._rigs, self._routes
        turns = [lane.turn for lane in lanes]
        idle, count, left = 0, 0, list[Frame]()
        while idle < END_TICKS:
            t_ns = START_NS + count * self._period_ns
            left += rigs.poll(t_ns)
            routes.open(left)
            sequence = count % SYNC_COUNTERS + 1
            sync = Frame(t_ns, self._sync.can_id, self._sync.encode(counter=sequence))
            rigs.on_frame(sync)
            if self._heard_ns:  # another controller's, which is heard when it has come
                t_ns += self._heard_ns
                for lane in lanes:
                    lane.node.look(t_ns)
                    lane.turn.feed((sync._replace(stamp_ns=t_ns),))
                    lane.turn.before += 1
            for turn in turns:
                turn.begin(t_ns)
            early = [lane.conditions.early(t_ns, 0) for lane in lanes]
            left = self._hear(rigs.poll(t_ns + self._wait_ns))
            whole = all(turn.inbox.complete for turn in turns)
            now_ns = max(t_ns, *(turn.newest_ns for turn in turns)) if whole else t_ns + self._wait_ns
            set_ns, asked = now_ns, self._asked(count)
            for number, lane in enumerate(lanes):
                turn, request = lane.turn, self._own_request(count, lane) or asked.get(number)
                lane.see(turn.decide(0, lane.conditions.host(early[number]), request, lane.told))
                now_ns += COMPUTING_NS
                rigs.on_frame(Frame(now_ns, turn.command_id, turn.command(sequence, count)))
                turn.sent(now_ns)
                turn.speak(self._sender(now_ns))
            timing = Timing(0, set_ns - t_ns, 0, COMPUTING_NS, COMPUTING_NS, -1)
            yield tuple(lane.turn.record(timing, sync, lane.node.truth().position_m) for lane in lanes)
            self._company.after()
            count += 1
            over = all(lane.shut and not is_engaged(lane.turn.tick.state) for lane in lanes)
            idle = idle + 1 if over else 0

    def _sender(self, sent_ns: int) -> Callable[[int, bytes], int]:
        """What sends a frame behind a command."""

        def send(can_id: int, data: bytes) -> int:
            self._rigs.on_frame(Frame(sent_ns, can_id, data))
            return sent_ns

        return send

    def _hear(self, answers: list[Frame]) -> list[Frame]:
        """One after another until all sets are complete, as the loop does; what is left for the next tick."""
        for i, frame in enumerate(answers):
            if all(lane.turn.inbox.complete for lane in self.lanes):
                return answers[i:]
            self._routes.feed([frame])
        return []

    def _asked(self, count: int) -> Mapping[int, Request]:
        """What operators want in this tick; or that all are armed, once all can be."""
        if self._ask is not None:
            return self._ask([lane.turn.tick for lane in self.lanes]) if count else {}
        if self._armed or not self._company.look():
            return {}
        self._armed = True
        return dict.fromkeys(range(len(self.lanes)), ARM)

    def end(self) -> None:
        """Tell the axes to shut down, with the next tick."""
        self._total = 0

    def _own_request(self, count: int, lane: SimulatedLane) -> Request | None:
        if count >= self._total and not lane.shut:
            lane.shut = True
            return Request(RequestKind.SHUTDOWN)
        if lane.touched:
            kind, lane.touched = lane.touched, 0
            return Request(kind)
        return None
