"""The inbox: frames in, one `Measurement` a tick out.

It judges every frame by its length, checksum, counter and age. Where frames answer SYNC, the counters also
say which one (`lag`): what answers an earlier one is late whatever its stamp, and an older frame behind a
newer one takes nothing back. Without SYNC, and of sources without a counter, stamp and age say all there is.

It reads no clock and does no I/O, so that a replay that feeds it the logged frames in the logged order, and
says when the commands were sent, gets the same measurements to the bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from pneud.bus.cadence import Cadence, CadenceState
from pneud.bus.codec import Codec, Codecs
from pneud.bus.lag import UNREAD, UNTOLD, Lag, LagState, Reading, told_by
from pneud.bus.wire import (
    CAN_ERR_FLAG,
    ERR_BUS_OFF,
    ERR_CONTROLLER,
    ERR_NOT_PASSIVE,
    ERR_PASSIVE,
    ERR_RESTARTED,
    wire_time_ns,
)
from pneud.config.bus_tables import BusConfig
from pneud.signals import ALL_SOURCES, Defect, Frame, Host, Measurement, Source

if TYPE_CHECKING:
    from pneud.bus.load_cell import Weighing
    from pneud.bus.switching import Hearing

NEVER_NS = 1 << 62  # the age of a source that has not been heard of yet
UNHEARD_NS = -NEVER_NS  # when it was sampled; also what is older than can be told

CORRUPT, FROZEN, _LATE = int(Defect.CORRUPT), int(Defect.FROZEN), int(Defect.LATE)
_EMCY_IDS = range(0x081, 0x100)
_EMCY_BASE = 0x080
_HEARTBEATS = range(0x701, 0x780)
_HEARTBEAT_BASE = 0x700
_OPERATIONAL, _BOOT = 5, 0  # NMT states in a heartbeat
_SURPLUS = 8  # frames of one source, more or fewer than SYNC asked for, that are put down to delay and loss
_COUNTED = 16  # and how far they are counted
_FORGET_TICKS = 16  # a surplus of one is forgotten in so many ticks, so that one that has ended does not stay
_EMERGENCY, _HEARTBEAT_LOST = int(Host.EMERGENCY), int(Host.HEARTBEAT_LOST)
_BUS_PASSIVE, _BUS_OFF = int(Host.BUS_PASSIVE), int(Host.BUS_OFF)
_CLASH = int(Host.IDENTIFIER_CLASH)


class Counts(NamedTuple):
    """What has come in since the start.

    `emcy` holds the last CANopen error code of each node that sent one: (node, code) in order of nodes.
    """

    rx: int  # every frame but error frames
    lost: int  # missing according to the counters; corrupt ones are not, nor where two nodes clash
    crc: int  # wrong checksum or length
    stale: int  # counter standing still
    late: int  # answers an earlier SYNC than this tick's, or older than can be told
    foreign: int  # the controller's own frames, sent by someone else
    error_frames: int
    emcy: tuple[tuple[int, int], ...]


class OriginState(NamedTuple):
    """What is known of one source between two ticks."""

    counter: int
    corrupt: int
    defects: int
    sample_ns: int
    values: tuple[float, ...]
    lag: LagState = LagState()
    cadence: CadenceState = CadenceState()


def age_ns(stamp_ns: int, t_ns: int) -> int:
    """How old at a SYNC is what came, or was sampled, at a stamp [ns]; `NEVER_NS` of what never did."""
    return NEVER_NS if stamp_ns == UNHEARD_NS else max(0, t_ns - stamp_ns)


class InputState(NamedTuple):
    """What is known of a message with inputs between two ticks."""

    counter: int = -1
    stamp_ns: int = UNHEARD_NS
    bits: int = 0


class CellState(NamedTuple):
    """What is known of a load cell between two ticks."""

    counter: int = -1
    stamp_ns: int = UNHEARD_NS
    force_n: float = math.nan


NO_CELL = CellState()


class InboxState(NamedTuple):
    """All that measurements depend on between two ticks; the counts, which are for people, are not in it."""

    encoder: OriginState
    pressure: OriginState
    valve: OriginState
    commanded_ns: int = UNHEARD_NS
    syncs: int = 0
    t_ns: int = 0
    readings: tuple[Reading, Reading, Reading] = UNREAD
    parts: tuple[OriginState, ...] = ()  # of a `MappedInbox`, in place of the three sources
    counters: tuple[int, ...] = ()  # of its multiplexed messages
    awaited: int = 0  # what of its multiplexed messages has come and is not used
    echo: tuple[float, int] = (0.0, 0)  # the last command: voltage [V], enable
    offset_ns: int = 0  # from the last tick's SYNC to its newest position, where sensors run free
    inputs: tuple[InputState, ...] = ()  # of the messages with inputs
    cell: CellState = NO_CELL  # of the load cell


class Origin:
    """What is known of one source, or of a part of one."""

    __slots__ = (
        *("bit", "cadence", "check", "codec", "corrupt", "counter", "counts", "decode", "defects", "doubted"),
        *("has_age", "lag", "lost", "tells_age"),
        *("sample_ns", "surplus", "values"),
    )

    def __init__(
        self,
        bit: int,
        codec: Codec,
        unknown: tuple[float, ...],
        bus: BusConfig,
        *,
        has_age: bool = False,
        counted: bool = True,
        period_us: float | None = None,
    ) -> None:
        self.bit = bit
        self.codec = codec
        self.check, self.decode = codec.check, codec.decode
        self.cadence = None if period_us is None else Cadence(period_us * 1e3)
        self.tells_age = has_age
        self.has_age = has_age or self.cadence is not None  # a sample is older than its frame
        # how many values its counter has, if it counts
        self.counts = codec.counter_values if counted and codec.counter_values > 1 else 0
        lags = bus.sync and self.counts
        self.lag = Lag(lags, round(bus.sensor_timeout_ms * 1e6)) if lags else None
        self.counter = -1  # the newest one seen
        self.corrupt = 0  # frames since then whose counter could not be believed
        self.defects = 0
        self.surplus = 0  # frames beyond those that SYNC asked for
        self.lost = 0
        self.doubted = 0  # lost ones, unless there turn out to be two counters
        self.sample_ns = UNHEARD_NS
        self.values: tuple[Any, ...] = unknown

    def settle(self) -> None:
        """Count what is missing, but not where two nodes count under one identifier."""
        if self.surplus <= 0:
            self.lost += self.doubted
        self.doubted = 0

    def miss(self, counter: int) -> None:
        """What is missing before a frame with this counter may be lost."""
        if self.counter >= 0:
            missing = (counter - self.counter - 1) % self.counts
            self.doubted += max(0, missing - self.corrupt)

    def found(self) -> None:
        """A frame has come after a newer one, before which it was missing."""
        if self.doubted:
            self.doubted -= 1
        elif self.lost:
            self.lost -= 1

    def at_ease(self, syncs: int) -> bool:
        """Nothing is open: neither of frames too many nor of a SYNC that the last one may have answered."""
        lag, counts = self.lag, self.counts
        awaited = lag is None or (not lag.open and self.counter == (lag.offset + syncs) % counts)
        return awaited and -_SURPLUS < self.surplus <= 1

    def freeze(self) -> OriginState:
        """Between two ticks."""
        return OriginState(
            self.counter,
            self.corrupt,
            self.defects,
            self.sample_ns,
            self.values,
            self.lag.freeze() if self.lag is not None else LagState(),
            self.cadence.state if self.cadence is not None else CadenceState(),
        )

    def thaw(self, state: OriginState) -> None:
        """Go on from there."""
        self.counter, self.corrupt, self.defects, self.sample_ns, self.values, lag, cadence = state
        if self.lag is not None:
            self.lag.thaw(lag)
        if self.cadence is not None:
            self.cadence.state = cadence

    def age_ns(self, t_ns: int, fresh: int) -> int:
        """How old the newest value is at a SYNC, by the bits of what is fresh there [ns]."""
        return 0 if fresh & self.bit else age_ns(self.sample_ns, t_ns)


class Inbox:
    """Collects the frames of each tick.

    In every tick: `feed` what was left over, `begin`, `feed` what answers, `measurement`; then set
    `commanded_ns`. With SYNC (`bus.sync`) a frame counts only if it was sampled after this tick's SYNC, does
    not answer an earlier one, and arrives before `measurement`; without, the newest one counts.
    """

    def __init__(self, codecs: Codecs, bus: BusConfig) -> None:
        self._sources = self._listened(codecs, bus)
        self._encoder = self._sources[0]
        self._whole = sum(o.bit for o in self._sources)
        self._origins = {o.codec.can_id: o for o in self._sources}
        own = (codecs.sync, codecs.valve_command) if bus.sync is True else (codecs.valve_command,)
        self._own = frozenset(codec.can_id for codec in own)
        self._older_s = codecs.older_s
        self.sync = bool(bus.sync)  # whether frames answer SYNC
        self.makes_sync = bus.sync is True
        self._heard_id = (
            codecs.sync.can_id if bus.follows else -1
        )  # of SYNC, where another controller sends it
        self._sync_wire_ns, self._command_wire_ns, self._encoder_wire_ns = (
            wire_time_ns(codec.length, bus.bitrate_bit_s, codec.can_id, codec.data_bit_s)
            for codec in (codecs.sync, codecs.valve_command, codecs.encoder)
        )
        # what was sampled before this is late; between ticks everything is
        self._not_before_ns = NEVER_NS if bus.sync else UNHEARD_NS + 1
        self._t_ns = 0
        self._sync_delay_ns = 0  # for which the own last command kept the wire
        self.commanded_ns = UNHEARD_NS
        """When the last command was sent, to be set after `measurement`; −1 where it could not be."""
        self.echo = (0.0, 0)
        """The last command that left: voltage [V], enable; to be set where no valve tells."""
        self._syncs = 0
        self._before_ns = 0  # the last tick's SYNC
        self._known_offset_ns = 0  # of the last position that a tick had
        self._readings = UNREAD  # the last three positions that were fresh
        self._fresh = 0
        self._rx = self._crc = self._stale = self._late = self._errors = 0
        self.foreign = 0
        """The controller's own frames that someone else has sent so far."""
        self._emcy: dict[int, int] = {}
        self._nodes = frozenset(d.node for d in bus.devices if d.node is not None)
        self._patience_ns = {
            f.node: round(f.heartbeat_timeout_ms * 1e6)
            for f in bus.devices
            if f.node is not None and f.heartbeat_timeout_ms is not None
        }
        self._due_ns: dict[int, int] = {}  # when the next heartbeat of each node is due
        self.conditions = 0  # bits of Host: what nodes and controller report of themselves
        self.hearing: Hearing | None = None
        """Of the inputs, where there are any."""
        if codecs.switching is not None and codecs.switching.inputs:
            from pneud.bus.switching import Hearing  # noqa: PLC0415 - for axes with inputs alone

            self.hearing = Hearing(codecs.switching.inputs)
        self.weighing: Weighing | None = None
        """Of the load cell, where there is one."""
        if codecs.load_cell is not None:
            from pneud.bus.load_cell import Weighing  # noqa: PLC0415 - for axes with one alone

            self.weighing = Weighing(codecs.load_cell)

    def _listened(self, codecs: Codecs, bus: BusConfig) -> Sequence[Origin]:
        """What is listened to, the encoder first."""
        nan, frames = math.nan, bus.frames
        encoder_us, pressure_us = frames.encoder.period_us, frames.pressure.period_us
        return (
            Origin(
                int(Source.ENCODER), codecs.encoder, (nan, 0, 0.0), bus, has_age=True, period_us=encoder_us
            ),
            Origin(int(Source.PRESSURE), codecs.pressure, (nan, nan, nan), bus, period_us=pressure_us),
            Origin(
                int(Source.VALVE), codecs.valve_status, (nan, 0), bus, period_us=frames.valve_status.period_us
            ),
        )

    @property
    def complete(self) -> bool:
        """All that is awaited in this tick has come."""
        return self._fresh == self._whole

    def begin(self, t_ns: int) -> None:
        """This tick's SYNC left at `t_ns`."""
        self._before_ns, self._t_ns = self._t_ns, t_ns
        if self.sync:
            self._not_before_ns = t_ns
            # behind a late command SYNC waits for its end; one that has yet to be sent, it goes before
            begun_ns = self.commanded_ns - t_ns
            self._sync_delay_ns = begun_ns if begun_ns >= 0 else max(0, begun_ns + self._command_wire_ns)
            clash = 0
            self._syncs += self.makes_sync
            forget = self._syncs % _FORGET_TICKS == 0
            for origin in self._sources:
                if origin.doubted and (origin.surplus <= 0 or origin.surplus > _SURPLUS):
                    origin.settle()
                if origin.surplus > -_SURPLUS:
                    origin.surplus -= 2 if forget and origin.surplus > 1 else 1
                    if origin.surplus > _SURPLUS:
                        clash = _CLASH
            self.conditions = self.conditions & ~_CLASH | clash
        if self._patience_ns:
            self._await_heartbeats(t_ns)

    def bus_restarted(self) -> None:
        """The interface went down: what its controller reported before no longer holds."""
        self.conditions &= ~(_BUS_PASSIVE | _BUS_OFF)

    def feed(self, frame: Frame) -> None:
        """Take one received frame, whatever it is."""
        stamp_ns, can_id, data = frame
        origin = self._origins.get(can_id)
        if origin is None:
            self._feed_other(stamp_ns, can_id, data)
            return
        self._rx += 1
        if origin.surplus <= _COUNTED:
            origin.surplus += 1
        counter = origin.check(data)
        if counter < 0:
            self._crc += 1
            origin.corrupt += 1
            origin.defects |= CORRUPT
            return
        counts = origin.counts
        if counts and counter == origin.counter:
            self._stale += 1
            origin.defects |= FROZEN
            return
        values = origin.decode(data)
        sample_ns = stamp_ns
        if origin.has_age:
            if origin.cadence is not None:
                sample_ns = self._on_the_beat(origin, stamp_ns, values)
            else:
                age_s = values[2]
                sample_ns = UNHEARD_NS if age_s >= self._older_s else stamp_ns - round(age_s * 1e9)
        late = sample_ns < self._not_before_ns
        if counts:
            lag, older = origin.lag, False
            if (
                lag is not None
                and (lag.open or counter != (lag.offset + self._syncs) % counts)
                and self._lags(origin, lag, counter, values[0], late)
            ):
                late, older = True, lag.older(counter, origin.counter)
            if older:
                origin.found()
            else:
                if counter != (origin.counter + 1) % counts:
                    origin.miss(counter)
                origin.counter = counter
                origin.corrupt = 0
        if late:
            self._late += 1
            origin.defects |= _LATE
            return
        origin.values = values
        origin.sample_ns = sample_ns
        origin.defects = 0
        self._fresh |= origin.bit

    def _on_the_beat(self, origin: Origin, stamp_ns: int, values: tuple[Any, ...]) -> int:
        """When a sample was taken of a source that keeps a beat."""
        age_s = values[2] if origin.tells_age else 0.0
        if age_s >= self._older_s or origin.cadence is None:
            return UNHEARD_NS
        return origin.cadence.instant(stamp_ns - round(age_s * 1e9))

    def _lags(self, origin: Origin, lag: Lag, counter: int, value: Any, late: bool) -> bool:
        """Whether a frame whose counter is not the expected one answers an earlier SYNC."""
        behind = lag.behind(counter, self._syncs)
        if not behind:
            return False
        if late:  # it came between two ticks, or so nearly: it may well answer the last SYNC
            return True
        says = UNTOLD
        if origin is self._encoder:
            says = told_by(self._readings, value, self._t_ns, self._before_ns)
        return lag.late(behind, says, self._t_ns - origin.sample_ns)

    def measurement(self, skipped: int, host: int) -> Measurement:
        """The newest valid values; ends this tick."""
        t_ns, fresh = self._t_ns, self._fresh
        encoder, pressure, valve = self._sources
        position_m, status, _ = encoder.values
        p1_pa, p2_pa, supply_pa = pressure.values
        applied_v, valve_state = valve.values
        offset_ns = self._offset_ns()
        self._fresh = 0
        if fresh & encoder.bit and self.sync:
            readings = self._readings
            self._readings = (readings[1], readings[2], (t_ns, position_m))
        encoder_ns = pressure_ns = valve_ns = 0
        if fresh != ALL_SOURCES:
            encoder_ns, pressure_ns, valve_ns = (o.age_ns(t_ns, fresh) for o in self._sources)
        return Measurement(
            t_ns,
            fresh,
            position_m,
            p1_pa,
            p2_pa,
            supply_pa,
            applied_v,
            status,
            valve_state,
            encoder_ns,
            pressure_ns,
            valve_ns,
            encoder.defects,
            pressure.defects,
            valve.defects,
            offset_ns,
            skipped,
            host,
        )

    def _offset_ns(self) -> int:
        """When the newest position was sampled, after this tick's SYNC; nothing more answers that SYNC."""
        if self.sync:
            self._not_before_ns = NEVER_NS
            # another's is heard when it has come, and nothing can be ahead of it
            return self._sync_delay_ns + self._sync_wire_ns if self.makes_sync else 0
        encoder = self._encoder
        if self._fresh & encoder.bit:
            self._known_offset_ns = encoder.sample_ns - self._encoder_wire_ns - self._t_ns
        # without a reading the estimate is carried on from the last one, by as much as ticks are apart
        return self._known_offset_ns

    @property
    def at_ease(self) -> bool:
        """All that a tick in which every source answers once and in time would change are its counts."""
        return all(origin.at_ease(self._syncs) for origin in self._sources)

    def pass_over(self, ticks: int) -> None:
        """Go on as though so many ticks of that kind had come, whose counters all went on.

        Only where it is `at_ease`. What those ticks told is not known: the next few have to be fed again
        before anything is read from it.
        """
        self._syncs += ticks
        self._rx += ticks * len(self._sources)
        for origin in self._sources:
            if origin.counts:
                origin.counter = (origin.counter + ticks) % origin.counts

    def freeze(self) -> InboxState:
        """The state after `measurement`, to be logged."""
        encoder, pressure, valve = self._sources
        return InboxState(
            encoder.freeze(),
            pressure.freeze(),
            valve.freeze(),
            self.commanded_ns,
            self._syncs,
            self._t_ns,
            self._readings,
            offset_ns=self._known_offset_ns,
            inputs=self._frozen_inputs(),
            cell=self._frozen_cell(),
        )

    def _frozen_inputs(self) -> tuple[InputState, ...]:
        return () if self.hearing is None else self.hearing.freeze()

    def _frozen_cell(self) -> CellState:
        return NO_CELL if self.weighing is None else self.weighing.freeze()

    def thaw(self, state: InboxState) -> None:
        """Go on from a frozen state."""
        for origin, known in zip(self._sources, (state.encoder, state.pressure, state.valve), strict=True):
            origin.thaw(known)
        self._thaw_times(state)

    def _thaw_times(self, state: InboxState) -> None:
        self.commanded_ns = state.commanded_ns
        self._syncs, self._t_ns, self._readings = state.syncs, state.t_ns, state.readings
        self._known_offset_ns = state.offset_ns
        if self.hearing is not None:
            self.hearing.thaw(state.inputs)
        if self.weighing is not None:
            self.weighing.thaw(state.cell)

    def counts(self) -> Counts:
        """What has come in since the start."""
        beside = [one for one in (self.hearing, self.weighing) if one is not None]
        return Counts(
            self._rx,
            sum(o.lost + o.doubted for o in self._sources),
            self._crc + sum(one.crc for one in beside),
            self._stale + sum(one.stale for one in beside),
            self._late,
            self.foreign,
            self._errors,
            tuple(sorted(self._emcy.items())),
        )

    def _feed_other(self, stamp_ns: int, can_id: int, data: bytes) -> None:
        if can_id & CAN_ERR_FLAG:
            self._errors += 1
            self._feed_error(can_id, data)
            return
        self._rx += 1
        if self.hearing is not None and self.hearing.hears(can_id):
            self.hearing.take(Frame(stamp_ns, can_id, data))
        elif self.weighing is not None and can_id == self.weighing.can_id:
            self.weighing.take(Frame(stamp_ns, can_id, data))
        elif can_id in self._own:
            self.foreign += 1
        elif can_id == self._heard_id:
            self._syncs += 1
        elif can_id in _EMCY_IDS and len(data) >= 2:
            self._emcy[can_id - _EMCY_BASE] = int.from_bytes(data[:2], "little")
            self._find_emergencies()
        elif can_id in _HEARTBEATS and data:
            self._feed_heartbeat(stamp_ns, can_id - _HEARTBEAT_BASE, data[0] & 0x7F)

    def _feed_error(self, can_id: int, data: bytes) -> None:
        """What the CAN controller reports of itself."""
        if can_id & ERR_RESTARTED:
            self.conditions &= ~(_BUS_PASSIVE | _BUS_OFF)
        if can_id & ERR_BUS_OFF:
            self.conditions |= _BUS_OFF
        if can_id & ERR_CONTROLLER and len(data) > 1:
            if data[1] & ERR_PASSIVE:
                self.conditions |= _BUS_PASSIVE
            elif data[1] & ERR_NOT_PASSIVE:
                self.conditions &= ~_BUS_PASSIVE

    def _feed_heartbeat(self, stamp_ns: int, node: int, state: int) -> None:
        if state == _BOOT and self._emcy.pop(node, 0):
            self._find_emergencies()
        if node in self._patience_ns:
            # one that is not operational is as good as none
            self._due_ns[node] = stamp_ns + self._patience_ns[node] if state == _OPERATIONAL else UNHEARD_NS

    def _await_heartbeats(self, t_ns: int) -> None:
        late = False
        for node, patience_ns in self._patience_ns.items():
            late = late or t_ns > self._due_ns.setdefault(node, t_ns + patience_ns)
        self._set(_HEARTBEAT_LOST, late)

    def _find_emergencies(self) -> None:
        self._set(_EMERGENCY, any(self._emcy.get(node, 0) for node in self._nodes))

    def _set(self, condition: int, holds: bool) -> None:
        self.conditions = self.conditions | condition if holds else self.conditions & ~condition
