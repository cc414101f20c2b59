"""A simulation that goes on by many ticks at once, where nothing is out of the ordinary.

Axis, bus and rig are one compiled function then. What is out of the ordinary is done by the simulation
itself, tick by tick: a start, a request, a fault. Both come to the same ticks and frames, to the last bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pneud.bus.codec import Codec, Codecs
from pneud.bus.dbc_layout import SignalField, bounds
from pneud.bus.inbox import Inbox
from pneud.bus.many import framed
from pneud.compiled import slow
from pneud.config import conversions
from pneud.loading import SYNC_COUNTERS
from pneud.log.files.columns import Block, FrameColumns
from pneud.log.files.writer import LogWriter
from pneud.log.format.frames import Alike
from pneud.log.format.header import SNAPSHOT_S
from pneud.log.format.rows import Rows
from pneud.loop.tally import Tally
from pneud.physics.plant import Wiring
from pneud.replay.heard import HEARD
from pneud.replay.lockstep import Simulation
from pneud.replay.running import TOLD_TICKS
from pneud.replay.stride import Between, Line, Noise, Row, Signal, raw_of, stride
from pneud.replay.tallied import Tallied
from pneud.rig.node import PRESSURE_RANGE_PA, Leap
from pneud.rt.folders import cache_folder
from pneud.signals import ALL_SOURCES, Frame, Record, RequestKind, Timing, ValveState
from pure2c import BuildError, compile_functions
from pure2c.types import columns

FEWEST = 2 * HEARD  # ticks that are worth it
_ROW = np.dtype(columns(Row))
Floats = NDArray[np.float64]

Series = Callable[..., tuple[Between, int]]


class Beat(NamedTuple):
    """What all ticks of a kind have in common, times counted from SYNC."""

    received: tuple[tuple[int, int, int], ...]  # identifier, length, stamp
    before: int
    sent: tuple[tuple[int, int, int], ...]
    timing: Timing
    offset_ns: int  # what the axis takes for the instant of the sample
    status: int  # of the encoder


def beat_of(record: Record) -> Beat | None:
    """That of a tick; None of one in which something is missing."""
    tick, m = record.tick, record.tick.measurement
    if m.fresh != ALL_SOURCES or m.host or m.skipped or m.encoder_defects or m.pressure_defects:
        return None
    if tick.request is not None or record.sent[0].stamp_ns < 0:
        return None
    received, sent = (
        tuple((f.can_id, len(f.data), f.stamp_ns - tick.t_ns) for f in frames)
        for frames in (record.frames, record.sent)
    )
    return Beat(received, record.before, sent, record.timing, m.encoder_offset_ns, m.encoder_status)


def strides() -> Series:
    """The compiled function.

    Raises:
        BuildError: it cannot be had.
    """
    try:
        series = compile_functions([stride], cache=cache_folder("compiled")).series[0]
    except OSError as e:
        raise BuildError(str(e)) from None
    assert series is not None
    return series


def fits(run: Simulation) -> bool:
    """Whether a run is of a kind that can go on by many ticks at once."""
    codecs, node, bus = run.loaded.codecs, run.node, run.loaded.config.bus
    p = node.p
    plain = (
        type(run.inbox) is Inbox
        and bus.sync is True
        and all(d.heartbeat_timeout_ms is None for d in bus.devices)
    )
    beside = (codecs.switching, codecs.load_cell, node.hook, node.station, node.beam, node.on_truth)
    told = [codecs.sync, codecs.valve_command, *(answer.codec for answer in codecs.answers)]
    return (
        run.alone
        and plain
        and all(one is None for one in beside)
        and p.wiring == Wiring()
        and p.free_s == 0.0
        and len(codecs.answers) == 3
        and all(_is_plain(codec) for codec in told)
        and all(f is not None for f in _signals(codecs))
    )


def _is_plain(codec: Codec) -> bool:
    fields = [f for f in (*codec.fields, codec.counter_field) if f is not None]
    return (
        codec.guard.judged != "call"
        and codec.length <= 8
        and not any(f.floating or f.code is not None for f in fields)
    )


def _signals(codecs: Codecs) -> tuple[SignalField | None, ...]:
    """Position, pressures, supply, the valve's voltage, the command's."""
    encoder, pressure, valve = (answer.codec.fields for answer in codecs.answers)
    return encoder[0], *pressure, valve[0], codecs.valve_command.fields[0]


def by_strides(
    run: Simulation,
    rate_hz: float,
    writer: LogWriter | None = None,
    told: Callable[[int], None] | None = None,
) -> Tally | None:
    """All ticks of a run, as `running.through` has them; None where it is none that can be had so.

    Args:
        run: one that has not begun.
        rate_hz: of its ticks.
        writer: gets the ticks, and now and then the state of the axis.
        told: now and then, how many ticks are done.
    """
    if not fits(run):
        return None
    try:
        series = strides()
    except BuildError as e:
        slow.say("the simulation", str(e))
        return None
    found = Tallied(timed=False, sync=True, truth=True)
    snapshot_ticks = max(1, round(SNAPSHOT_S * rate_hz))
    for some in Striding(run, series, snapshot_ticks).go():
        if isinstance(some, Rows):
            found.add(_block(some))
        else:
            found.tally.add(some, ending=run.shut)
            request = some.tick.request
            if request is not None and request.kind == RequestKind.ARM:
                found.tally.asked_to_arm(some.tick)
        if writer is not None:
            if isinstance(some, Rows):
                writer.write_many(some)
            else:
                writer.write(some)
            if run.count % snapshot_ticks == 0:
                writer.snapshot(run.turn.freeze())
        if told is not None and (isinstance(some, Rows) or run.count % TOLD_TICKS == 0):
            told(run.count)
    return found.tally


_NONE = np.zeros(0, dtype=np.int64)
_NO_FRAMES = FrameColumns(_NONE, _NONE, _NONE, _NONE, _NONE.astype(np.uint64), _NONE)


def _block(rows: Rows) -> Block:
    """The ticks as a log's, of which the frames do not matter."""
    t_ns = rows.ticks["t_ns"]
    return Block(t_ns, t_ns, rows.ticks, _NO_FRAMES, (), (), ())


class Striding:
    """One simulation, as far as it can be had by many ticks at once."""

    def __init__(self, run: Simulation, series: Series, most: int) -> None:
        """A run that has not begun.

        Args:
            run: one that `fits`.
            series: from `strides`.
            most: ticks that may be done at once; at every multiple of it there is a halt.
        """
        self._run, self._series = run, series
        c, codecs, node = run.loaded.config, run.loaded.codecs, run.node
        self._period_ns = round(1e9 / c.loop.rate_hz)
        self._most = most
        self._durations = [
            node.duration_ns(codec.length, codec.can_id) for codec in (codecs.sync, codecs.valve_command)
        ]
        self._signals = [Signal(f.scale, f.offset, *bounds(f)) for f in _signals(codecs) if f is not None]
        self._syncs = np.frombuffer(
            b"".join(codecs.sync.encode(counter=n + 1) for n in range(SYNC_COUNTERS)), dtype=np.uint8
        ).reshape(SYNC_COUNTERS, codecs.sync.length)
        self._axis = conversions.axis_of(c, codecs.command_lsb_v)

    def go(self) -> Iterator[Record | Rows]:
        """All ticks, one by one or many at once; none of those go beyond the next halt."""
        records = self._run.records()
        beat: Beat | None = None
        calm, patience = 0, FEWEST
        while True:
            if beat is not None and calm >= patience:
                rows = self._stride(beat)
                if rows is not None:
                    patience = FEWEST
                    yield rows
                    continue
                # what stands in the way will hardly be gone in the next tick
                calm, patience = 0, min(2 * patience, self._most)
            record = next(records, None)
            if record is None:
                return
            yield record
            now = beat_of(record)
            calm = calm + 1 if now is not None and now == beat else 0
            beat = now

    def _stride(self, beat: Beat) -> Rows | None:
        """As many ticks as there are before something has to be done about them; None where that is few."""
        run, node = self._run, self._run.node
        most = min(self._most - run.count % self._most, run.total - run.count)
        usual = node.valve.state in (ValveState.CENTRED, ValveState.ENABLED) and run.inbox.at_ease
        line = self._line(beat)
        if most < FEWEST or run.shut or line is None or not usual:
            return None
        before = node.noise.state()
        rows = np.empty(most, dtype=_ROW)
        args = self._between(), self._axis, node.p, line, node.force_ext_n, PRESSURE_RANGE_PA
        after, done = self._series(self._noise(most), rows, *args)
        if done < most:
            node.noise.restore(before)
        if done < HEARD:
            return None
        if done < most:
            self._noise(done)
        found = self._framed(rows[:done], beat)
        self._arrive(after, found, beat, line)
        return found

    def _line(self, beat: Beat) -> Line | None:
        """The bus, where all that is sent has come before the next tick begins."""
        run, node = self._run, self._run.node
        (_, _, sync_ns), (_, _, command_ns) = beat.sent
        sync_wire_ns, command_wire_ns = self._durations
        heard_ns = max(command_ns, run.wait_ns) + command_wire_ns
        if sync_ns or beat.before or heard_ns > self._period_ns or node.valve.timeout_ns <= self._period_ns:
            return None
        times = node.epoch_ns, self._period_ns, sync_wire_ns, heard_ns, beat.offset_ns, beat.status
        return Line(int(not run.armed), *times, *self._signals)

    def _between(self) -> Between:
        """Where the run is."""
        run, node = self._run, self._run.node
        coming_v, enable, _ = run.loaded.codecs.valve_command.decode(run.turn.data)
        valve = node.valve
        return Between(
            run.axis.state,
            node.state,
            node.plant_ns,
            run.turn.t_ns,
            valve.output_v,
            int(valve.state),
            coming_v,
            enable,
            run.state,
            run.present,
        )

    def _noise(self, ticks: int) -> Floats:
        """The numbers that the sensors draw in so many ticks."""
        node = self._run.node
        first, last = int(node.p.detail.encoder_noise_m == 0.0), 4 if node.p.pressure_noise_pa > 0.0 else 1
        drawn = np.zeros((ticks, len(Noise._fields)))
        if last > first:
            drawn[:, first:last] = node.noise.draw_many(ticks * (last - first)).reshape(ticks, last - first)
        return drawn

    def _framed(self, ticks: NDArray[Any], beat: Beat) -> Rows:
        """The ticks with the frames that carried them."""
        codecs, node = self._run.loaded.codecs, self._run.node
        number = self._run.count + np.arange(len(ticks))
        encoder, pressure, valve = (answer.codec for answer in codecs.answers)
        age = encoder.fields[2]
        age_s = min(node.p.node_delay_s, codecs.older_s)
        raws: dict[int, list[Any]] = {
            encoder.can_id: [
                ticks["raw.position"],
                beat.status,
                None if age is None else raw_of(age_s, Signal(age.scale, age.offset, *bounds(age))),
            ],
            pressure.can_id: [ticks["raw.p1"], ticks["raw.p2"], ticks["raw.supply"]],
            valve.can_id: [ticks["raw.applied"], ticks["raw.valve"]],
        }
        command = codecs.valve_command
        sequence = number % SYNC_COUNTERS
        said = framed(command, [ticks["raw.command"], ticks["command.enable"], sequence + 1], number)
        data = {codecs.sync.can_id: self._syncs[sequence], command.can_id: said}
        for codec in (encoder, pressure, valve):
            counter = node.counter(codec.can_id) + np.arange(len(ticks))
            data[codec.can_id] = framed(codec, raws[codec.can_id], counter)
        received, sent = (
            tuple(Alike(*one, data[one[0]].tobytes()) for one in ones) for ones in (beat.received, beat.sent)
        )
        return Rows(ticks, beat.timing, received, beat.before, sent)

    def _arrive(self, after: Between, rows: Rows, beat: Beat, line: Line) -> None:
        """Bring all parts of the simulation to where it has come."""
        run, node, count = self._run, self._run.node, len(rows.ticks)
        run.axis.thaw(after.axis)
        run.count += count
        run.state, run.present = after.state, after.present
        run.tx += count * len(rows.sent)
        run.inbox.pass_over(count - HEARD)
        *_, (command_id, length, sent_ns) = beat.sent
        said = rows.sent[-1].data
        for i in range(count - HEARD, count):
            t_ns = int(rows.ticks["t_ns"][i])
            run.turn.open(())
            run.turn.begin(t_ns)
            run.turn.feed([_frame(one, i, t_ns) for one in rows.received])
            run.inbox.measurement(0, 0)
            run.turn.data = said[i * length : (i + 1) * length]
            run.turn.sent(t_ns + sent_ns)
        heard = run.count - 2  # the command of the last tick is on its way
        node.leap(
            Leap(
                count,
                after.t_ns,
                float(rows.ticks["truth_m"][-1]),
                after.rig,
                after.rig_ns,
                after.t_ns + rows.received[-1].after_ns,
                after.t_ns + run.wait_ns,
                after.t_ns - line.period_ns + line.command_ns,
                heard % run.loaded.codecs.valve_command.counter_values,
                after.output_v,
                ValveState(after.valve),
            )
        )
        node.on_frame(Frame(after.t_ns + sent_ns, command_id, run.turn.data))


def _frame(of: Alike, place: int, t_ns: int) -> Frame:
    """One of them."""
    data = of.data[place * of.length : (place + 1) * of.length]
    return Frame(t_ns + of.after_ns, of.can_id, data)
