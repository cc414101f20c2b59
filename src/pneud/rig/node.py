"""The rig's three nodes as one event-driven object: frames in, frames out, no clock and no I/O.

Time is that of the frames' stamps. The same object serves the lock-step simulation and the plant's process.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

from pneud.bus.codec import SOURCES, Codec, Codecs
from pneud.bus.wire import CAN_ERR_FLAG, wire_time_ns
from pneud.physics.plant import PlantParameters
from pneud.rig import dynamics
from pneud.rig.damage import SEIZED_KG
from pneud.rig.detail import touching
from pneud.rig.dynamics import PlantState, initial_state, stroke_position
from pneud.rig.segment import Segment
from pneud.rig.sensors import Noise, PressureSensor, quantised, sensed
from pneud.rig.transmission import Item
from pneud.rig.valvenode import ValveNode
from pneud.signals import EncoderStatus, Frame, ValveState

if TYPE_CHECKING:
    from pneud.rig.beam import Beam
    from pneud.rig.station import StationNode

ENCODER_NODE, PRESSURE_NODE, VALVE_NODE = 0, 1, 2  # indices of the nodes
PRESSURE_RANGE_PA = 1_310_700.0  # full scale of the pressure sensors, and of PRESSURE in pneud.dbc
MAX_WAITING = 64  # frames from the bus that may wait for the wire; more are lost
IDLE_NS = 10_000_000  # so long without a frame, the plant goes on by itself
_START_NS, _NEVER_NS = -(1 << 62), 1 << 62

Hook = Callable[[Frame, bool], Sequence[Frame]]
"""Stands between the nodes and the wire: (frame, outgoing) → the frames that take its place.

An empty sequence loses the frame, a later stamp delays it. Incoming frames carry the time of sending,
outgoing ones that of the end of their transmission.
"""

Advance = Callable[[PlantState, float, float, float, float, PlantParameters], PlantState]


class Truth(NamedTuple):
    """The rig at the instant a SYNC was sent; before the first one `t_ns` is negative."""

    t_ns: int
    position_m: float  # stroke coordinate
    state: PlantState


class Leap(NamedTuple):
    """Where a rig is some ticks later, before the command of the last one is on its way."""

    ticks: int
    t_ns: int  # the last one's SYNC
    truth_m: float  # at that
    rig: PlantState
    rig_ns: int  # until when it has been integrated
    free_ns: int  # the wire is, from then on
    polled_ns: int  # until when the nodes' frames have been taken
    heard_ns: int  # when the last command was heard
    counter: int  # of that
    output_v: float  # that it led to
    valve: ValveState


class _Answer(NamedTuple):
    codec: Codec
    sync_ns: int  # send stamp of the SYNC it answers, or when it was sampled without
    values: tuple[float, ...]


class _Foreign(NamedTuple):
    frame: Frame  # neither the controller's nor a node's own; all of them hear it
    sender: PlantNode  # through which it was put


class PlantNode:
    """Encoder, pressure and valve node with the cylinder between them.

    `p` (the plant) and `force_ext_n` (external force against positive motion) may be changed between calls;
    they hold for whatever is integrated from then on.

    Args:
        p: the true plant.
        codecs: of the frames.
        seed: of the sensors' noise.
        hook: fault injection on frames.
        advance: `dynamics.advance` or its compiled version.
        segment: the bus that it shares with other rigs; one of its own without.
    """

    def __init__(
        self,
        p: PlantParameters,
        codecs: Codecs,
        seed: int,
        *,
        hook: Hook | None = None,
        advance: Advance = dynamics.advance,
        segment: Segment | None = None,
    ) -> None:
        self.p = p
        self.force_ext_n = 0.0
        self.hook = hook
        self.on_truth: Callable[[int, float, float, float], None] | None = None
        """Told of every SYNC, and whenever the nodes sample by themselves: instant, position, velocity,
        acceleration."""
        self.valve = ValveNode(codecs.valve_command, p.valve_timeout_s, p.dac_bits, p.valve.u_max_v)
        self.beam: Beam | None = None  # to another rig's piston
        self.station: StationNode | None = None  # of inputs and outputs
        self.unsendable = 0  # answers with a value that their frame cannot carry
        self._codecs = codecs
        self._advance = advance
        self.noise = Noise(seed)
        self._pressure = PressureSensor(
            self.noise, p.pressure_noise_pa, p.pressure_resolution_pa, PRESSURE_RANGE_PA
        )
        self._delay_ns = round(p.node_delay_s * 1e9)
        self._age_s = min(p.node_delay_s, codecs.older_s)
        self._sync_id, self._command_id = codecs.sync.can_id, codecs.valve_command.can_id
        told = [codecs.sync, codecs.valve_command, *(answer.codec for answer in codecs.answers)]
        self._taken = frozenset((self._sync_id, self._command_id))
        if codecs.switching is not None:
            from pneud.rig.station import StationNode  # noqa: PLC0415 - for axes with inputs or outputs alone

            self.station = StationNode(codecs.switching, p.board)
            for other in segment.nodes if segment is not None else ():
                if other.station is not None:
                    self.station.join(other.station)
            self._taken |= self.station.ids
            told += [message.codec for message in codecs.switching.messages]
        self._cell = None if codecs.load_cell is None else codecs.load_cell.codec
        self._cell_counter = 0
        self.cell_silent = False  # a load cell says nothing
        self.cell_zero_n = 0.0  # or is off by so much
        if self._cell is not None:
            told.append(self._cell)
        self._data_bit_s = {codec.can_id: codec.data_bit_s for codec in told}
        self._durations = tuple(self.duration_ns(a.codec.length, a.codec.can_id) for a in codecs.answers)
        self._ids = ids_of_nodes(codecs)
        self._answer_ids = frozenset(answer.codec.can_id for answer in codecs.answers)
        self._shortest_ns = min(self._durations)
        self._counters = dict.fromkeys(self._answer_ids, 0)
        self._counts = {answer.codec.can_id: answer.codec.counter_values for answer in codecs.answers}
        self._free_ns = round(p.free_s * 1e9)
        self._jitter_ns = p.free_jitter_s * 1e9
        self.next_ns = _NEVER_NS
        """When the nodes sample by themselves."""
        self._segment = segment if segment is not None else Segment()
        self._segment.nodes.append(self)
        self._wire = self._segment.wire
        self._ended: list[tuple[int, _Answer]] = []  # transmitted, not yet polled
        self._held: list[Frame] = []  # delayed by the hook
        self._now_ns = _START_NS
        self._current_ns = -1  # of the last SYNC, or the last sampling without
        self._epoch_ns = _START_NS
        self._plant_ns = _START_NS
        self._state = initial_state(p)
        self._truth = Truth(-1, stroke_position(self._state, p), self._state)

    @property
    def started(self) -> bool:
        """Whether time has begun to pass; until then the rig rests in its initial state."""
        return self._epoch_ns != _START_NS

    @property
    def epoch_ns(self) -> int:
        """When time began to pass."""
        return self._epoch_ns

    def counter(self, can_id: int) -> int:
        """What the next frame of this identifier is to be counted as."""
        return self._counters[can_id]

    @property
    def now_ns(self) -> int:
        """Up to when events have been dealt with."""
        return self._now_ns

    @property
    def state(self) -> PlantState:
        """The rig, integrated as far as any event has asked for."""
        return self._state

    @property
    def plant_ns(self) -> int:
        """Up to when the plant has been integrated."""
        return self._plant_ns

    def truth(self) -> Truth:
        """The rig at the send stamp of the last SYNC."""
        return self._truth

    def on_frame(self, frame: Frame) -> None:
        """A frame was sent at its stamp; frames come in order of stamps, foreign ones are ignored."""
        if not self.takes(frame.can_id):
            return
        sent_ns = self.note(frame)
        for passed in (frame,) if self.hook is None else self.hook(frame, False):
            if self.takes(passed.can_id) and len(self._wire.waiting) < MAX_WAITING:
                duration = self.duration_ns(len(passed.data), passed.can_id)
                self._wire.add(Item(max(passed.stamp_ns, sent_ns), passed.can_id, duration, passed))

    def takes(self, can_id: int) -> bool:
        """Whether a frame with this identifier is for this rig."""
        return can_id in self._taken

    def note(self, frame: Frame) -> int:
        """A frame for this rig was sent, and another one's `on_frame` has the bus carry it.

        Returns:
            When it was sent, as far as this rig is concerned [ns].
        """
        sent_ns = max(frame.stamp_ns, self._now_ns)
        self.begin(sent_ns)
        self._run(sent_ns)
        if frame.can_id == self._sync_id:
            self._integrate(sent_ns)
            self._truth = Truth(frame.stamp_ns, stroke_position(self._state, self.p), self._state)
            self._current_ns = frame.stamp_ns
            self._tell_truth(frame.stamp_ns)
        return sent_ns

    def put(self, frame: Frame) -> None:
        """A frame of somebody else waits for the wire from its stamp on, no earlier than now.

        An error frame is the report of a CAN controller: it goes out at its stamp and takes no time.
        """
        if frame.can_id & CAN_ERR_FLAG:
            self._held.append(frame)
        else:
            duration = self.duration_ns(len(frame.data), frame.can_id)
            ready_ns = max(frame.stamp_ns, self._now_ns)
            self._wire.add(Item(ready_ns, frame.can_id, duration, _Foreign(frame, self)))

    def reboot(self, node: int) -> None:
        """One of the nodes starts anew: its counter from 0, the valve node's output centred."""
        for can_id in self._ids[node]:
            self._counters[can_id] = 0
        if node == VALVE_NODE:
            self.valve.reboot()

    def take_back(self, node: int, can_id: int | None = None) -> None:
        """One of the nodes has not sent what the hook was given last, and has not counted it."""
        can_id = self._ids[node][0] if can_id is None else can_id
        self._counters[can_id] = (self._counters[can_id] - 1) % self._counts[can_id]

    def due(self) -> int | None:
        """Earliest time [ns] at which `poll` may have a frame; None as long as no frame comes in."""
        times = [end for end, _ in self._ended] + [frame.stamp_ns for frame in self._held]
        if self.station is not None and self.started:
            times.append(self.station.next_ns)
        if self.next_ns != _NEVER_NS:
            times.append(self.next_ns + self._delay_ns + self._shortest_ns)
        upcoming = self._wire.upcoming
        if upcoming is not None:
            end, item = upcoming
            if isinstance(item.load, (_Answer, _Foreign)):
                times.append(end)
            else:
                waiting = {other.can_id for other in self._wire.waiting}
                if not waiting.isdisjoint(self._answer_ids):
                    times.append(end + self._shortest_ns)
                elif self._sync_id in waiting:
                    times.append(end + self._delay_ns + self._shortest_ns)
        return min(times) if times else None

    def poll(self, t_ns: int, *, current_only: bool = False) -> list[Frame]:
        """The nodes' frames whose transmission has ended by `t_ns`, stamped with its end.

        Args:
            t_ns: now; every frame sent until then must have been fed.
            current_only: leave out answers to any but the last SYNC. For a runner that may be late: a node
                that missed its turn stays silent, it does not pass old values off as new ones.
        """
        if self._free_ns:
            self.begin(t_ns)
        if self.station is not None and self.started:
            self._switch(self.station, t_ns)
        self._run(t_ns)
        if not self._ended and not self._held:
            return []
        frames, later = self._held, []
        for end_ns, answer in self._ended:
            if end_ns > t_ns:
                later.append((end_ns, answer))
            elif not current_only or answer.sync_ns >= self._current_ns:
                frames.extend(self._sent(end_ns, answer))
        self._ended = later
        self._held = [frame for frame in frames if frame.stamp_ns > t_ns]
        return sorted((frame for frame in frames if frame.stamp_ns <= t_ns), key=_stamp)

    def _switch(self, station: StationNode, t_ns: int) -> None:
        """Inputs are sent, and a brake engages, also where the controller has gone."""
        if t_ns - self._plant_ns > IDLE_NS:
            self._integrate(t_ns)
        for frame in station.due(t_ns):
            self.put(frame)

    def advance(self, t_ns: int) -> None:
        """Deal with all events until `t_ns` and integrate the plant to it; starts time if need be."""
        self.begin(t_ns)
        self._run(t_ns)
        self._integrate(t_ns)

    def leap(self, to: Leap) -> None:
        """As though so many ticks had come and gone, of which nobody but SYNC and command has a part."""
        self._state, self._plant_ns = to.rig, to.rig_ns
        self._now_ns, self._current_ns = to.polled_ns, to.t_ns
        self._truth = Truth(to.t_ns, to.truth_m, to.rig)
        for can_id, counter in self._counters.items():
            self._counters[can_id] = (counter + to.ticks) % self._counts[can_id]
        self._wire.clear(to.free_ns)
        self.valve.leap(to.heard_ns, to.counter, to.output_v, to.valve)

    def look(self, t_ns: int) -> None:
        """As `advance`; and this is the instant that `truth` tells of, where no SYNC says so."""
        self.advance(t_ns)
        self._truth = Truth(t_ns, stroke_position(self._state, self.p), self._state)

    def begin(self, t_ns: int) -> None:
        """Time begins to pass, unless it does already."""
        if not self.started:
            self._epoch_ns = self._plant_ns = t_ns
            if self._free_ns:
                self.next_ns = t_ns

    def duration_ns(self, data_bytes: int, can_id: int) -> int:
        """How long a frame of the rig takes on the wire."""
        return wire_time_ns(data_bytes, self.p.bitrate_bit_s, can_id, self._data_bit_s.get(can_id, 0.0))

    def _run(self, t_ns: int) -> None:
        self._segment.run(t_ns)
        self._now_ns = max(self._now_ns, t_ns)

    def expire(self) -> None:
        """The valve node has waited for a command for too long."""
        self._integrate(self.valve.deadline_ns)
        self.valve.expire()

    def hear(self, end_ns: int, item: Item) -> None:
        """The transmission of a frame of anybody has ended."""
        load = item.load
        if isinstance(load, _Answer):
            if item.can_id in self._answer_ids:
                self._ended.append((end_ns, load))
            return
        if isinstance(load, _Foreign):
            if load.sender is self:
                self._held.append(load.frame._replace(stamp_ns=end_ns))
        elif item.can_id not in self._taken:
            return  # another axis's command
        frame: Frame = load.frame if isinstance(load, _Foreign) else load
        self._integrate(end_ns)
        if item.can_id == self._command_id:
            self.valve.command(frame.data, end_ns)
        elif self.station is not None and item.can_id in self.station.ids:
            self.station.hear(frame._replace(stamp_ns=end_ns))
        elif item.can_id == self._sync_id and not self._free_ns and self._codecs.sync.valid(frame.data):
            self._sample(end_ns, frame.stamp_ns)

    def sample_freely(self) -> None:
        """The nodes sample by themselves, and not for a SYNC."""
        t_ns = self.next_ns
        self.next_ns += self._free_ns
        self._integrate(t_ns)
        self._current_ns = t_ns
        self._tell_truth(t_ns)
        self._sample(t_ns, t_ns)

    def _tell_truth(self, t_ns: int) -> None:
        if self.on_truth is not None:
            s = self._state
            self.on_truth(t_ns, stroke_position(s, self.p), s.v, s.a)

    def _sample(self, t_ns: int, sync_ns: int) -> None:
        p, state, codecs, valve = self.p, self._state, self._codecs, self.valve
        true, w = sensed(state, p), p.wiring
        shown_m = true.position_m
        if w.encoder_scale != 1.0:
            start_m = p.initial_x1 - p.cylinder.x_e1
            shown_m = start_m + w.encoder_scale * (shown_m - start_m)
        position = shown_m - p.encoder_zero_m
        if p.detail.encoder_noise_m:
            position += p.detail.encoder_noise_m * self.noise.draw()
        position = quantised(position, p.encoder_resolution_m)
        status = int(EncoderStatus.REFERENCED) if p.encoder_referenced else 0
        read = self._pressure.read
        chambers = [true.p1_pa, true.p2_pa]
        if w.dead_pressure:
            chambers[w.dead_pressure - 1] = p.gas.atmosphere_pa
        p1, p2 = reversed(chambers) if w.exchanged_pressures else chambers
        p1, p2, supply = read(p1), read(p2), read(true.supply_pa)
        values = {
            "position_m": position, "second_position_m": position, "status": status, "age_s": self._age_s,
            "p1_pa": p1, "p2_pa": p2, "difference_pa": p1 - p2, "supply_pa": supply,
            "applied_v": valve.output_v, "state": int(valve.state),
        }  # fmt: skip
        valve.booted()
        for i, (_, codec, keys, _, _) in enumerate(codecs.answers):
            answer = _Answer(codec, sync_ns, tuple([values[key] for key in keys]))
            ready_ns = t_ns + self._delay_ns
            if self._jitter_ns and self._free_ns:
                ready_ns += round(abs(self.noise.draw()) * self._jitter_ns)
            self._wire.replace(Item(ready_ns, codec.can_id, self._durations[i], answer, i))
        if self._cell is not None and not self.cell_silent:
            self._weigh(self._cell, t_ns)

    def _weigh(self, codec: Codec, t_ns: int) -> None:
        """What a load cell between the load and what it presses against says."""
        state, detail = self._state, self.p.detail
        force_n = touching(state.x1, state.v, detail) + self.cell_zero_n
        try:
            data = codec.encode(force_n, counter=self._cell_counter % codec.counter_values)
        except ValueError:
            self.unsendable += 1
            return
        self._cell_counter += 1
        self.put(Frame(t_ns + self._delay_ns, codec.can_id, data))

    def _sent(self, end_ns: int, answer: _Answer) -> Sequence[Frame]:
        codec = answer.codec
        counter = self._counters[codec.can_id]
        try:
            data = codec.encode(*answer.values, counter=counter)
        except ValueError:
            self.unsendable += 1
            return ()
        self._counters[codec.can_id] = (counter + 1) % codec.counter_values
        frame = Frame(end_ns, codec.can_id, data)
        return (frame,) if self.hook is None else self.hook(frame, True)

    def _integrate(self, t_ns: int) -> None:
        if self.beam is not None:
            self.beam.carry(t_ns)
        else:
            self.march(t_ns)

    def march(self, t_ns: int, beam_n: float = 0.0) -> None:
        """Integrate the plant alone, with a force of its beam against positive motion."""
        if t_ns > self._plant_ns:
            t0_s = (self._plant_ns - self._epoch_ns) * 1e-9
            t1_s = (t_ns - self._epoch_ns) * 1e-9
            w, command_v = self.p.wiring, self.valve.output_v
            if w.swapped_hoses:
                command_v = -command_v
            if w.valve_unplugged:
                command_v = 0.0
            p = self.p
            if self.station is not None and self.station.is_clamped(t_ns):  # a mass that no force moves
                self._state = self._state._replace(v=0.0, a=0.0)
                p = p._replace(cylinder=p.cylinder._replace(M=SEIZED_KG))
            self._state = self._advance(self._state, command_v, self.force_ext_n + beam_n, t0_s, t1_s, p)
            self._plant_ns = t_ns


def ids_of_nodes(codecs: Codecs) -> tuple[tuple[int, ...], ...]:
    """What each node sends, by its index; a message of several nodes is the first one's."""
    ids: tuple[dict[int, None], ...] = ({}, {}, {})
    for answer in codecs.answers:
        of = [i for i, keys in enumerate(SOURCES.values()) if not set(keys).isdisjoint(answer.filled)]
        if not any(answer.codec.can_id in found for found in ids):
            ids[of[0]][answer.codec.can_id] = None
    return tuple(tuple(found) for found in ids)


def _stamp(frame: Frame) -> int:
    return frame.stamp_ns
