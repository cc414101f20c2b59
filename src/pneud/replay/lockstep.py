"""The axis and the software rig in simulated time: the same cycle, the same frames, no process and no clock.

Frames carry quantisation, age, checksums and the delays of the bus, exactly as in real time; only waiting
takes no time. The same seed gives the same records on every run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from pneud.bus.mapped_inbox import inbox_of
from pneud.bus.wire import wire_time_ns
from pneud.compiled.backend import INTERPRETED, Backend, backend
from pneud.config import conversions
from pneud.loading import SYNC_COUNTERS, Loaded, load, plans_of_plant
from pneud.log.format.header import LogHeader
from pneud.loop.conditions import Conditions
from pneud.loop.phase import Phase
from pneud.loop.turn import END_TICKS, Turn
from pneud.replay.simulated_machine import DOWN, HEALTHY, SimulatedMachine
from pneud.rig.answering import Plant
from pneud.rig.node import PlantNode
from pneud.safety.faults import BLOCKS_ARM, FAULT_NAMES
from pneud.safety.supervisor import is_engaged
from pneud.scenario.engine import Engine
from pneud.scenario.format import Scenario
from pneud.signals import Frame, Record, Request, RequestKind, State, Timing

START_NS = 1_000_000_000
_STEP_NS = 1_000  # least time between two looks for frames
COMPUTING_NS = 100_000  # from the last answer to the command's send()

Operator = Callable[[int, int], Request | None]
"""Asked in every tick: (state, faults present) of the last one → request."""


class Simulation:
    """One run; iterate over `records`, then look at what is left in the parts."""

    def __init__(
        self,
        loaded: Loaded,
        duration_s: float,
        seed: int = 0,
        how: Backend = INTERPRETED,
        requests: Mapping[int, Request] | None = None,
        scenario: Scenario | None = None,
        operator: Operator | None = None,
    ) -> None:
        """A run that has not begun.

        Args:
            loaded: the axis.
            duration_s: simulated time until the axis is told to shut down.
            seed: of the sensors' noise, and of what a scenario leaves to chance.
            how: axis and plant are computed.
            requests: what is asked in which tick, counted from 0; without it the axis arms and tracks.
            scenario: faults to inject; what it asks of the machine is left out where it is not simulated.
            operator: asks of the axis what it likes, also to end the run; without one it is armed once, and a
                fault ends the run.
        """
        self.loaded, self.compiled = loaded, how.axis is not INTERPRETED.axis
        self.alone = (
            scenario is None and operator is None and requests is None
        )  # nobody else has a part in it
        self._requests = requests
        self.axis = how.axis(conversions.axis_of(loaded.config, loaded.codecs.command_lsb_v))
        self.inbox = inbox_of(loaded.codecs, loaded.config.bus)
        rig, rate_hz = conversions.plant_of(loaded.config), loaded.config.loop.rate_hz
        self._machine = SimulatedMachine(round(1e9 / rate_hz))
        if scenario is None:
            self.engine = None
            self.node = PlantNode(rig, loaded.codecs, seed, advance=how.advance)
        else:
            begin = self._begin_on_machine
            self.engine = Engine(scenario, rig, loaded.codecs, seed, rate_hz, begin, how.advance)
            self.node = self.engine.node
        plans = plans_of_plant(loaded)
        self._slaves: Plant | None = None  # stand before the node, where it is made of them
        if plans:
            from pneud.rig.canopen import CanopenRig, slaves_of  # noqa: PLC0415 - for rigs with nodes only

            self._slaves = CanopenRig(self.node, plans, slaves_of(plans), configured=True)
        self._operator = operator
        self.shut = False  # the run is over and the axis is coming to rest
        self.tx = 0
        self.count = 0  # ticks that are done
        self.state, self.present = int(State.STARTING), 0  # of the last one
        self.turn = Turn(self.axis, self.inbox, loaded.codecs)
        self._conditions = Conditions(self.inbox, self._machine)
        self._sync = loaded.codecs.sync
        self.armed = False  # has been asked to arm
        self._period_ns = round(1e9 / loaded.config.loop.rate_hz)
        self.wait_ns = round(self._period_ns * loaded.config.loop.set_deadline)
        self.total = max(1, round(duration_s * loaded.config.loop.rate_hz))
        bus, codec = loaded.config.bus, loaded.codecs.sync
        told = (codec.length, bus.bitrate_bit_s, codec.can_id, codec.data_bit_s)
        self._heard_ns = wire_time_ns(*told) if bus.follows else 0

    def _begin_on_machine(self, number: int) -> None:
        """A fault of the scenario that is played, by its number, is one of the machine, and begins."""
        assert self.engine is not None
        self._machine.begin(self.engine.scenario.fault[number])

    def records(self) -> Iterator[Record]:
        """The ticks, as the loop hands them to the recorder."""
        turn, machine, node = self.turn, self._machine, self._slaves or self.node
        idle, stalled = 0, 0
        left_over: list[Frame] = []
        phase, start_ns = (None if self.inbox.sync else Phase(self._period_ns)), START_NS
        while idle < END_TICKS:
            count = self.count
            skipped = machine.skip(start_ns + (count + stalled) * self._period_ns)
            stalled += skipped
            t_ns = start_ns + (count + stalled) * self._period_ns
            link = machine.link(t_ns)
            left_over += node.poll(t_ns)
            turn.open([] if link == DOWN or machine.plant_stands(t_ns) else left_over)
            sequence = count % SYNC_COUNTERS + 1
            sync = Frame(t_ns, self._sync.can_id, self._sync.encode(counter=sequence))
            if not self.inbox.sync:
                self.node.look(t_ns)
            elif link == HEALTHY:
                node.on_frame(sync)
            if self._heard_ns:  # another controller's, which is heard when it has come
                t_ns += self._heard_ns
                self.node.look(t_ns)
                turn.feed((sync._replace(stamp_ns=t_ns),))
                turn.before += 1
            turn.begin(t_ns)
            early = self._conditions.early(t_ns, 0)
            silent = link == DOWN or machine.plant_stands(t_ns)  # it may have come to a stand since SYNC
            left_over = self._hear(node, t_ns, silent=silent)
            if phase is not None and turn.frames:
                start_ns += phase.shift_ns(turn.frames[-1].stamp_ns - t_ns)
            done_ns = max(t_ns, turn.newest_ns) if self.inbox.complete else t_ns + self.wait_ns
            request = self._request(count, self.state, self.present)
            tick = turn.decide(skipped, self._conditions.host(early), request)
            self.state, self.present = tick.state, tick.present

            sent_ns = done_ns + COMPUTING_NS
            data = turn.command(sequence, count)
            turn.sent(sent_ns if link == HEALTHY else -1)
            if link == HEALTHY:
                node.on_frame(Frame(sent_ns, turn.command_id, data))
                self.tx += 1 + self.inbox.makes_sync
            if turn.speaks:
                turn.speak(self._sender(sent_ns, link == HEALTHY))
            self.count += 1
            over = self.shut or (tick.state == State.FAULT and self._operator is None)
            idle = idle + 1 if over and not is_engaged(tick.state) else 0
            yield turn.record(
                Timing(0, done_ns - t_ns, 0, COMPUTING_NS, COMPUTING_NS, -1),
                sync if link == HEALTHY else sync._replace(stamp_ns=-1),
                node.truth().position_m,
            )

    def _hear(self, node: Plant, t_ns: int, *, silent: bool) -> list[Frame]:
        """Take what comes in this tick; what is left for the next one."""
        until_ns = t_ns + self.wait_ns
        if silent or self.inbox.sync:
            answers = node.poll(until_ns)
            return [] if silent else self._feed(answers)
        # nodes that go on by themselves have to find the command on the wire when it is sent
        left: list[Frame] = []
        at_ns = t_ns
        while not self.inbox.complete and at_ns < until_ns:
            due_ns = node.due()
            at_ns = until_ns if due_ns is None else min(until_ns, max(at_ns + _STEP_NS, due_ns))
            left += self._feed(node.poll(at_ns))
        return left

    def _sender(self, sent_ns: int, healthy: bool) -> Callable[[int, bytes], int]:
        """What sends a frame behind a command."""

        def send(can_id: int, data: bytes) -> int:
            if not healthy:
                return -1
            (self._slaves or self.node).on_frame(Frame(sent_ns, can_id, data))
            self.tx += 1
            return sent_ns

        return send

    def _feed(self, answers: list[Frame]) -> list[Frame]:
        """One after another until the set is complete, as the loop does; what is left for the next tick."""
        for i, frame in enumerate(answers):
            if self.inbox.complete:
                return answers[i:]
            self.turn.feed((frame,))
        return []

    def _request(self, count: int, last_state: int, last_present: int) -> Request | None:
        """What is asked of the axis in this tick."""
        if not self.shut and count >= self.total:
            self.shut = True
            return Request(RequestKind.SHUTDOWN)
        if self._requests is not None:
            return self._requests.get(count)
        if self._operator is not None:
            request = self._operator(last_state, last_present)
            self.shut |= request is not None and request.kind == RequestKind.SHUTDOWN
            return request
        if not self.armed and last_state == State.DISARMED and not last_present & BLOCKS_ARM:
            self.armed = True
            return Request(RequestKind.ARM, (1.0,))
        return None


def header_of(loaded: Loaded, **extra: str) -> LogHeader:
    """What a log of a simulated run says of it.

    Args:
        loaded: the axis.
        extra: facts beside that, such as the seed.
    """
    return LogHeader(
        name=loaded.config.name,
        bus="simulated",
        rate_hz=loaded.config.loop.rate_hz,
        detail=loaded.config.log.detail,
        config_name=loaded.path.name,
        config_text=loaded.text,
        dbc_name=loaded.dbc.name,
        dbc=loaded.dbc.read_bytes(),
        fault_names=FAULT_NAMES,
        realtime_offset_ns=0,
        extra={what: " ".join(names) for what, names in loaded.config.bus.switches.items() if names} | extra,
    )


def simulate(config_file: str | Path, duration_s: float = 10.0, seed: int = 0) -> Iterator[Record]:
    """The records of a run in simulated time, with what comes to rest after it.

    Raises:
        ConfigError: the configuration cannot be used.
        DatabaseError: its DBC cannot be used.
        BuildError: it requires the compiled law, which cannot be had.
    """
    loaded = load(config_file)
    return Simulation(loaded, duration_s, seed, backend_of(loaded)).records()


def backend_of(loaded: Loaded) -> Backend:
    """How an axis is to be computed on this machine.

    Raises:
        BuildError: the compiled law is required and cannot be had.
    """
    p = conversions.axis_of(loaded.config, loaded.codecs.command_lsb_v)
    return backend(loaded.config.loop.compiled, p)
