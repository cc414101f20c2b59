"""A recording of a bus as a log: every SYNC begins a tick, and the axis is computed along.

Where there is no SYNC, as sensors run free, every valid command ends a tick. An exported log tells when each
of these began; of another recording it is taken that the command was computed at once.

What leaves for the valve is what the recording has. Estimates, states and faults are the axis's own, from
the frames, the configuration, and what was asked of it. An exported log has that beside it; of another
recording it is inferred from `Enable`: a rise arms and tracks the configured reference, a fall disarms, a
rise after a fault clears first. Other requests leave no trace on a bus, and a replay then shows where the
commands part.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain, pairwise
from typing import NamedTuple

from pneud.axis.cycle import Axis
from pneud.bus.codec import Codec, Codecs
from pneud.bus.mapped_inbox import inbox_of
from pneud.bus.wire import CAN_ERR_FLAG
from pneud.compiled.backend import backend
from pneud.config import conversions
from pneud.config.models import Config
from pneud.log.files.writer import LogWriter
from pneud.loop.turn import Turn
from pneud.replay.passing import EXTENDED, other_kind
from pneud.replay.remarks import Remarks
from pneud.replay.sidecar import Sidecar
from pneud.replay.surveying import Survey
from pneud.replay.times import Times
from pneud.replay.traffic import Passing
from pneud.safety.supervisor import is_engaged
from pneud.signals import Command, Frame, Record, Request, RequestKind, State, Timing

COMPUTED_NS = 100_000  # from the beginning of a tick without SYNC to its command, as far as nobody knows
UNTIMED = Timing(-1, -1, -1, -1, -1, -1)
_NAN = float("nan")


class Heard(NamedTuple):
    """One tick of a recording; without SYNC, it has a command."""

    sync: Frame | None
    before: tuple[Frame, ...]
    after: tuple[Frame, ...]
    command: Frame | None


class Rebuilt(NamedTuple):
    """What came of a recording."""

    ticks: int
    without_command: int  # ticks in which nothing valid was sent to the valve
    differing: int  # ticks whose command is another than the axis computes


class Ticks:
    """The ticks of a recording, on the channel on which the first SYNC is, or command where there is none."""

    def __init__(
        self, frames: Iterable[Passing], codecs: Codecs, survey: Survey, times: Times, remarks: Remarks
    ) -> None:
        self.elsewhere = 0  # frames on other channels, left out
        self._frames = frames
        self._codecs = codecs
        self._survey = survey
        self._times = times
        self._remarks = remarks
        self._lengths = {
            codec.can_id: (name, codec.length)
            for name, codec in (
                ("sync", codecs.sync),
                ("valve_command", codecs.valve_command),
                *((answer.name, answer.codec) for answer in codecs.answers),
            )
        }

    def __iter__(self) -> Iterator[Heard]:
        """One after another; what comes before the first SYNC belongs to its tick."""
        return self._by_sync() if self._survey.by_sync else self._by_command()

    def _here(self, beat: Codec) -> Iterator[tuple[Frame, bool, bool]]:
        """The frames of the channel, whether each is the axis's own, and whether it is its beat."""
        for recorded, channel, was_sent in self._frames:
            if channel != self._survey.channel:
                self.elsewhere += 1
                continue
            stamp_ns, can_id, data = recorded
            # what another controller sends is heard, not sent, where the recording tells them apart
            own = not self._survey.directed or was_sent is not False
            beats = own and can_id == beat.can_id and beat.valid(data)
            frame = Frame(self._times.at(stamp_ns, is_sync=beats), can_id, data)
            self._check_kind(frame)
            yield frame, own, beats

    def _by_command(self) -> Iterator[Heard]:
        before: list[Frame] = []
        for frame, _, is_command in self._here(self._codecs.valve_command):
            if is_command:
                yield Heard(None, tuple(before), (), frame)
                before = []
            else:
                before.append(frame)
        self._left(before)

    def _by_sync(self) -> Iterator[Heard]:
        command = self._codecs.valve_command
        before: list[Frame] = []
        after: list[Frame] = []
        pending: list[Frame] = []  # came after the command
        begun: Frame | None = None
        sent: Frame | None = None
        for frame, own, is_sync in self._here(self._codecs.sync):
            if is_sync:
                if begun is not None:
                    yield Heard(begun, tuple(before), tuple(after), sent)
                    # without a command, what came was taken by the tick that waited for it
                    before, after = (pending, []) if sent is not None else ([], [])
                begun, sent, pending = frame, None, []
            elif begun is None:
                before.append(frame)
            elif sent is None and own and frame.can_id == command.can_id and command.valid(frame.data):
                sent = frame
            elif sent is None:
                after.append(frame)
            else:
                pending.append(frame)
        if begun is not None:
            yield Heard(begun, tuple(before), tuple(after), sent)
        self._left(pending)

    def _left(self, frames: list[Frame]) -> None:
        if frames:
            self._remarks.add(
                "frames after the last command, which belong to no tick",
                self._times.place,
                partial=False,
                count=len(frames),
            )

    def _check_kind(self, frame: Frame) -> None:
        role, length = self._lengths.get(frame.can_id & (EXTENDED | CAN_ERR_FLAG), ("", 0))
        has, kind = len(frame.data), other_kind(frame.can_id)
        if not role or (has == length and not kind):
            return
        name = f"{role} (0x{frame.can_id & EXTENDED:03X})"
        what = kind or f"with {has} bytes, where the database has {length}"
        self._remarks.add(f"{name} {what}", self._times.place, partial=False)


def rebuild(
    ticks: Iterable[Heard], writer: LogWriter, config: Config, codecs: Codecs, known: Sidecar | None
) -> Rebuilt:
    """Write the log of a recording.

    Raises:
        LogError: the recording cannot be read.
        BuildError: the configuration requires the compiled law, which cannot be had.
    """
    p = conversions.axis_of(config, codecs.command_lsb_v)
    axis = backend(config.loop.compiled, p).axis(p)
    turn = Turn(axis, inbox_of(codecs, config.bus), codecs)
    command = codecs.valve_command
    tells = command.encode(0.0, 0, 1, counter=0) != command.encode(0.0, 1, 1, counter=0)
    period_ns = 1e9 / config.loop.rate_hz
    count = silent = differing = host = 0
    last_ns = None
    for heard, following in pairwise(chain(ticks, (None,))):
        assert heard is not None  # only the last one is
        t_ns = _began_ns(heard, known, count)
        another = heard.sync if heard.sync is not None and not turn.inbox.makes_sync else None
        turn.open(heard.before if another is None else (*heard.before, another))
        turn.begin(t_ns)
        turn.feed(heard.after)
        if known is None:
            passed = 1 if last_ns is None else round((t_ns - last_ns) / period_ns)
            skipped = max(0, passed - 1)
            enabled, following_enabled = (_enabled(command, one, tells=tells) for one in (heard, following))
            request = _inferred(axis, enabled, following_enabled, tells=tells)
        else:
            skipped, host = known.skipped.get(count, 0), known.host.get(count, host)
            request = known.requests.get(count)
        tick = turn.decide(skipped, host, request)
        sent: tuple[Frame, ...] = (heard.sync,) if heard.sync is not None and turn.inbox.makes_sync else ()
        # where the recording stamps the ends of frames, a SYNC close behind a command is taken to be heard
        # later, by less than it takes itself; a replay of the new log does the same
        turn.sent(-1 if heard.command is None else heard.command.stamp_ns)
        if heard.command is None:
            silent += 1
        else:
            sent += (heard.command,)
            voltage_v, enable, _ = command.decode(heard.command.data)
            enable = enable if tells else tick.command.enable
            turn.inbox.echo = (voltage_v, enable)
            if not _same(tick.command, voltage_v, enable, codecs.command_lsb_v):
                differing += 1
                tick = tick._replace(command=tick.command._replace(voltage_v=voltage_v, enable=enable))
        writer.write(Record(tick, UNTIMED, tuple(turn.frames), turn.before, sent, _NAN))
        last_ns = t_ns
        count += 1
    return Rebuilt(count, silent, differing)


def _began_ns(heard: Heard, known: Sidecar | None, number: int) -> int:
    """When a tick began, by the log's own time."""
    if heard.sync is not None:
        return heard.sync.stamp_ns
    assert heard.command is not None
    lasted_ns = COMPUTED_NS if known is None else known.lasted_ns.get(number, COMPUTED_NS)
    return heard.command.stamp_ns - lasted_ns


def _same(c: Command, voltage_v: float, enable: int, lsb_v: float) -> bool:
    return c.enable == enable and abs(c.voltage_v - voltage_v) < 0.5 * lsb_v


def _enabled(command: Codec, heard: Heard | None, *, tells: bool) -> bool:
    """Whether a tick's command enables the valve; one that cannot say so does by a voltage."""
    if heard is None or heard.command is None:
        return False
    voltage_v, enable, _ = command.decode(heard.command.data)
    return bool(enable) if tells else voltage_v != 0.0


def _inferred(axis: Axis, enabled: bool, next_enabled: bool, *, tells: bool) -> Request | None:
    """What must have been asked for, for the valve to be enabled as it was.

    Where commands do not tell (`tells`), that it was disarmed cannot be known: the law may ask for 0 V.
    """
    state = axis.state.supervisor.state
    if not tells and is_engaged(state):
        return None
    if enabled and not is_engaged(state):
        return Request(RequestKind.ARM, (1.0,))
    if not enabled and is_engaged(state):
        return Request(RequestKind.DISARM)
    if state == State.FAULT and not enabled and next_enabled:
        return Request(RequestKind.CLEAR)
    return None
