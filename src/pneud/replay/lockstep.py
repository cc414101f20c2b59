"""The axis and the software rig in simulated time: the same cycle, the same frames, no process and no clock.

Frames carry quantisation, age, checksums and the delays of the bus, exactly as in real time; only waiting
takes no time. The same seed gives the same records on every run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from pneud.bus.inbox import Inbox
from pneud.compiled.backend import INTERPRETED, Backend, backend
from pneud.config import conversions
from pneud.loading import Loaded, load
from pneud.replay.simulated_machine import DOWN, HEALTHY, SimulatedMachine
from pneud.rig.node import PlantNode
from pneud.safety.faults import BLOCKS_ARM
from pneud.safety.supervisor import is_engaged
from pneud.scenario.engine import Engine
from pneud.scenario.format import Scenario
from pneud.signals import Frame, Host, Record, Request, RequestKind, State, Timing

START_NS = 1_000_000_000
COMPUTING_NS = 100_000  # from the last answer to the command's send()
SYNC_COUNTERS = 240
END_TICKS = 20


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
            operator: asks of the axis what it likes; without one it is armed once, and a fault ends the run.
        """
        self._requests = requests
        self.axis = how.axis(conversions.axis_of(loaded.config, loaded.codecs.command_lsb_v))
        self.inbox = Inbox(loaded.codecs, loaded.config.bus)
        rig, rate_hz = conversions.plant_of(loaded.config), loaded.config.loop.rate_hz
        self._machine = SimulatedMachine(scenario, round(1e9 / rate_hz))
        if scenario is None:
            self.engine = None
            self.node = PlantNode(rig, loaded.codecs, seed, advance=how.advance)
        else:
            self.engine = Engine(
                scenario, rig, loaded.codecs, seed, rate_hz, self._machine.begin, how.advance
            )
            self.node = self.engine.node
        self._operator = operator
        self.shut = False  # the run is over and the axis is coming to rest
        self.tx = 0
        self._codecs = loaded.codecs
        self._period_ns = round(1e9 / loaded.config.loop.rate_hz)
        self._wait_ns = round(self._period_ns * loaded.config.loop.set_deadline)
        self._total = max(1, round(duration_s * loaded.config.loop.rate_hz))

    def records(self) -> Iterator[Record]:
        """The ticks, as the loop hands them to the recorder."""
        sync, command = self._codecs.sync, self._codecs.valve_command
        armed, idle, count = False, 0, 0
        last_state, last_present = int(State.STARTING), 0
        left_over: list[Frame] = []
        machine, stalled, foreign = self._machine, 0, 0
        while idle < END_TICKS:
            skipped = machine.skip(START_NS + (count + stalled) * self._period_ns)
            stalled += skipped
            t_ns = START_NS + (count + stalled) * self._period_ns
            link = machine.link(t_ns)
            frames = self.node.poll(t_ns)
            if link != DOWN and not machine.plant_stands(t_ns):
                left_over.extend(frames)
            before = len(left_over)
            for frame in left_over:
                self.inbox.feed(frame)
            sync_frame = Frame(t_ns, sync.can_id, sync.encode(counter=count % SYNC_COUNTERS + 1))
            if link == HEALTHY:
                self.node.on_frame(sync_frame)
            self.inbox.begin(t_ns)
            answers = self.node.poll(t_ns + self._wait_ns)
            if link == DOWN or machine.plant_stands(t_ns):
                answers = []
            for frame in answers:
                self.inbox.feed(frame)
            done_ns = answers[-1].stamp_ns if self.inbox.complete else t_ns + self._wait_ns
            foreign, known = self.inbox.foreign, foreign
            host = self.inbox.conditions | machine.host(link)
            if foreign != known:
                host |= int(Host.OTHER_CONTROLLER)
            measurement = self.inbox.measurement(skipped, host)

            request = None
            if not self.shut and count >= self._total:
                self.shut = True
                request = Request(RequestKind.SHUTDOWN)
            elif self._requests is not None:
                request = self._requests.get(count)
            elif self._operator is not None:
                request = self._operator(last_state, last_present)
            elif not armed and last_state == State.DISARMED and not last_present & BLOCKS_ARM:
                armed = True
                request = Request(RequestKind.ARM, (1.0,))
            tick = self.axis.cycle(measurement, request, t_ns)
            last_state, last_present = tick.state, tick.present

            sent_ns = done_ns + COMPUTING_NS
            data = command.encode(
                tick.command.voltage_v,
                tick.command.enable,
                sync_frame.data[0],
                counter=count & command.counter_mask,
            )
            command_frame = Frame(sent_ns, command.can_id, data)
            if link == HEALTHY:
                self.node.on_frame(command_frame)
                self.tx += 2
            self.inbox.commanded_ns = sent_ns if link == HEALTHY else -1
            yield Record(
                tick,
                Timing(0, done_ns - t_ns, 0, COMPUTING_NS, COMPUTING_NS, -1),
                (*left_over, *answers),
                before,
                (sync_frame, command_frame)
                if link == HEALTHY
                else (unsent(sync_frame), unsent(command_frame)),
                self.node.truth().position_m,
            )
            left_over = []
            count += 1
            over = self.shut or (tick.state == State.FAULT and self._operator is None)
            idle = idle + 1 if over and not is_engaged(tick.state) else 0


def unsent(frame: Frame) -> Frame:
    """The frame as it stands in the log where it could not be sent."""
    return frame._replace(stamp_ns=-1)


def simulate(config_file: str | Path, duration_s: float = 10.0, seed: int = 0) -> Iterator[Record]:
    """The ticks of a run in simulated time, with what comes to rest after it.

    Args:
        config_file: path, or bare name of a configuration that comes with pneud.
        duration_s: simulated time until the axis is told to shut down.
        seed: of the sensors' noise.

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
