"""One axis's exchange: frames in, a command out.

Rig, virtual run, simulation, replay and import go through the same steps in every tick, and differ in where
the frames come from and in who tells the time: `open`, `begin`, `feed` as often as frames come, `decide`,
`command`, `sent`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from pneud.axis.cycle import Axis, AxisState
from pneud.bus.codec import Codecs
from pneud.bus.inbox import Inbox, InboxState
from pneud.signals import NOTHING_HEARD, Frame, Record, Request, Tick, Timing, Told

if TYPE_CHECKING:
    from pneud.bus.switching import Saying, SwitchMessage

END_TICKS = 20  # times that the valve is told to centre before a run ends


class Turn:
    """An axis, what it hears and what it says.

    Attributes:
        axis: decides.
        inbox: judges what comes.
        frames: that have come for this tick.
        before: how many of them had come when SYNC left.
        command_id: identifier of the commands.
        t_ns: this tick's SYNC.
        tick: what has been decided; there is none before the first `decide`.
        data: of the command.
        sent_ns: when it was sent; −1 where it could not be.
        speaks: there are outputs, which `speak` sends.
    """

    __slots__ = (
        *("_counts", "_cycle", "_echoes", "_encode", "_take", "axis", "before", "command_id", "data"),
        *("_hearing", "_weighing", "_outputs", "_said", "_saying", "frames", "inbox"),
        *("sent_ns", "speaks", "t_ns", "tick"),
    )
    tick: Tick

    def __init__(self, axis: Axis, inbox: Inbox, codecs: Codecs) -> None:
        self.axis = axis
        self.inbox = inbox
        self.frames: list[Frame] = []
        self.before = 0
        self.t_ns = 0
        self.data = b""
        self.sent_ns = -1
        self.command_id = codecs.valve_command.can_id
        self._counts = codecs.valve_command.counter_values
        self._encode = codecs.valve_command.encode
        self._echoes = codecs.row is not None  # no valve may tell what it puts out
        self._take = inbox.feed
        self._cycle = axis.cycle
        self._hearing = inbox.hearing
        self._weighing = inbox.weighing
        self._said: list[Frame] = []
        self._saying: Saying | None = None
        self._outputs: tuple[SwitchMessage, ...] = ()
        if codecs.switching is not None and codecs.switching.outputs:
            from pneud.bus.switching import Saying  # noqa: PLC0415 - for axes with outputs alone

            self._outputs = codecs.switching.outputs
            self._saying = Saying(self._outputs, codecs.switching.period_ns)
        self.speaks = bool(self._outputs)

    @property
    def outputs(self) -> tuple[SwitchMessage, ...]:
        """The messages that say what the outputs do."""
        return self._outputs

    @property
    def newest_ns(self) -> int:
        """Stamp of the last frame since SYNC, 0 without one."""
        return self.frames[-1].stamp_ns if len(self.frames) > self.before else 0

    def open(self, left_over: Sequence[Frame]) -> None:
        """A tick, with the frames that have come since the last one's set was taken."""
        self.frames.clear()
        self.feed(left_over)
        self.before = len(self.frames)

    def begin(self, t_ns: int) -> None:
        """SYNC leaves at `t_ns`."""
        self.t_ns = t_ns
        self.inbox.begin(t_ns)

    def feed(self, frames: Sequence[Frame]) -> None:
        """Frames that have come, in order of their stamps."""
        self.frames.extend(frames)
        take = self._take
        for frame in frames:
            take(frame)

    def decide(self, skipped: int, host: int, request: Request | None, told: Told | None = None) -> Tick:
        """What the axis makes of all that has come.

        Args:
            skipped: ticks skipped just before this one.
            host: bits of `signals.Host`.
            request: at most one request of the operator.
            told: by the axis that leads this one, or is beside it.
        """
        heard = None if self._hearing is None else self._hearing.heard(self.t_ns)
        if self._weighing is not None:
            force_n, age_ns = self._weighing.force_n, self._weighing.age_ns(self.t_ns)
            heard = (heard or NOTHING_HEARD)._replace(force_n=force_n, force_age_ns=age_ns)
        self.tick = tick = self._cycle(self.inbox.measurement(skipped, host), request, self.t_ns, told, heard)
        return tick

    def rehearse(self) -> None:
        """Do for nothing what is about to be done in earnest, so that the processor has it at hand.

        Most of what there is to do is new to a processor that has slept, and takes twice as long.
        """
        self.axis.rehearse(self.tick.measurement, self.t_ns)
        self.centre(0)

    def command(self, sequence: int, counter: int) -> bytes:
        """What to send to the valve, by the counters of SYNC and, as far as it fits, of the command."""
        c = self.tick.command
        self.data = data = self._encode(c.voltage_v, c.enable, sequence, counter=counter % self._counts)
        return data

    def centre(self, counter: int) -> bytes:
        """The command for a valve whose axis decides nothing any more."""
        return self._encode(0.0, 0, 1, counter=counter % self._counts)

    def sent(self, stamp_ns: int) -> None:
        """The command was sent at `stamp_ns`; −1 where it could not be."""
        self.sent_ns = self.inbox.commanded_ns = stamp_ns
        if self._echoes and stamp_ns >= 0:
            self.inbox.echo = (self.tick.command.voltage_v, self.tick.command.enable)

    def speak(self, send: Callable[[int, bytes], int]) -> None:
        """Send what the outputs say, where that is due.

        Args:
            send: identifier and bytes → when it was sent; −1 where it could not be.
        """
        self._said.clear()
        if self._saying is not None and self.tick.station is not None:
            for can_id, data in self._saying.due(self.tick.station.outputs, self.t_ns):
                self._said.append(Frame(send(can_id, data), can_id, data))

    def record(self, timing: Timing, sync: Frame, truth_m: float) -> Record:
        """The tick as it is recorded, with its SYNC if it was sent; another's is among the frames."""
        command = Frame(self.sent_ns, self.command_id, self.data)
        sent = (sync, command) if self.inbox.makes_sync else (command,)
        if self.speaks:
            sent = (*sent, *self._said)
        return Record(self.tick, timing, tuple(self.frames), self.before, sent, truth_m)

    def freeze(self) -> dict[str, Any]:
        """All that the next ticks depend on, after `sent`."""
        return {"axis": self.axis.freeze(), "inbox": self.inbox.freeze()}

    def thaw(self, axis: AxisState, inbox: InboxState) -> None:
        """Go on from a frozen state."""
        self.axis.thaw(axis)
        self.inbox.thaw(inbox)
