"""A log through the axis again: the same frames, requests and times, and every command compared."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from pneud import parameters
from pneud.bus.inbox import Inbox
from pneud.compiled.law import law
from pneud.config import Config, parse
from pneud.loading import at_rate, codecs_of
from pneud.log.fingerprint import numeric_fingerprint
from pneud.log.reader import LogReader
from pneud.log.records import COARSE, COARSE_ERROR, FLOAT_ERROR, LoggedTick, crc_of
from pneud.safety.supervisor import is_engaged
from pneud.signals import State, Tick


class Difference(NamedTuple):
    """Where a replay first left its log."""

    tick: int
    variable: str
    logged: str
    replayed: str

    def __str__(self) -> str:
        return f"tick {self.tick}: {self.variable} logged {self.logged}, replayed {self.replayed}"


class Outcome(NamedTuple):
    """What a replay comes to."""

    ticks: int
    commands: int
    mismatches: int  # ticks in which anything differs
    first: Difference | None
    engaged_ticks: int
    worst_lsb: int  # greatest difference of a command on the wire
    same_states: bool
    same_fingerprint: bool
    truncated: bool
    damage: str

    @property
    def identical(self) -> bool:
        """Every state and command to the bit."""
        return self.mismatches == 0

    @property
    def equivalent(self) -> bool:
        """Every command within one step on the wire, and the same states."""
        return self.worst_lsb <= 1 and self.same_states

    @property
    def good(self) -> bool:
        """Engaged, and as equal as the numeric fingerprints let one expect."""
        return self.engaged_ticks > 0 and (self.identical or (self.equivalent and not self.same_fingerprint))


def replay(log: LogReader, config: Config | None = None) -> Outcome:
    """Feed a log through the axis again.

    Args:
        log: the log.
        config: another configuration than the log's own.

    Raises:
        ConfigError: the configuration in the log cannot be used by this version.
        DatabaseError: nor its DBC.
        BuildError: it requires the compiled law, which cannot be had.
    """
    chosen = config or parse(log.config_text, f"{log.path}:{log.config_name}")
    if chosen.loop.rate_hz != log.rate_hz:
        chosen = at_rate(chosen, log.rate_hz)
    codecs = codecs_of(chosen.bus, log.dbc_name, log.dbc)
    p = parameters.axis_of(chosen, codecs.command_lsb_v)
    axis = law(chosen.loop.compiled, p).axis(p)
    inbox = Inbox(codecs, chosen.bus)
    command = codecs.valve_command

    ticks = commands = mismatches = engaged = worst_lsb = 0
    first: Difference | None = None
    same_states = True
    gap = ""
    for logged in log:
        if logged.number != ticks + 1:
            gap = f"records {ticks + 1} to {logged.number - 1} are missing"
            break
        for frame in logged.frames[: logged.before]:
            inbox.feed(frame)
        inbox.begin(logged.t_ns)
        for frame in logged.frames[logged.before :]:
            inbox.feed(frame)
        measurement = inbox.measurement(logged.skipped, logged.host)
        tick = axis.cycle(measurement, logged.request, logged.t_ns)
        different = crc_of(tick) != logged.check or _states(tick) != _states(logged.record.tick)
        same_states = same_states and _states(tick) == _states(logged.record.tick)
        sent = {f.can_id: f.data for f in logged.sent}
        sync, data = sent.get(codecs.sync.can_id, b""), sent.get(command.can_id, b"")
        whole = len(logged.sent) == 2 and codecs.sync.valid(sync) and command.valid(data)
        if whole:
            commands += 1
            again = command.encode(
                tick.command.voltage_v,
                tick.command.enable,
                codecs.sync.counter(sync),
                counter=command.counter(data),
            )
            if again != data:
                different = True
                apart = abs(command.decode(data)[0] - command.decode(again)[0])
                worst_lsb = max(worst_lsb, round(apart / codecs.command_lsb_v))
        else:
            different, same_states = True, False
        if different:
            mismatches += 1
            if first is None:
                first = _difference(ticks, logged, tick, whole)
        engaged += is_engaged(tick.state)
        ticks += 1
    return Outcome(
        ticks,
        commands,
        mismatches,
        first,
        engaged,
        worst_lsb,
        same_states,
        log.metadata.get("fingerprint") == numeric_fingerprint(),
        log.truncated or bool(gap),
        log.damage or gap,
    )


def _states(t: Tick) -> tuple[int, int, int, int, int]:
    return t.state, t.present, t.latched, t.answer, t.command.enable


def _difference(number: int, logged: LoggedTick, tick: Tick, whole: bool) -> Difference:
    """The first value that differs, in the order in which a cycle makes them."""
    if not whole:
        return Difference(number, "frames sent", "not one valid SYNC and one valid command", "both")
    for name, was, now in _pairs(logged, tick):
        if repr(was) != repr(now):  # which makes NaN equal to itself
            # a compact log holds floats of 32 bits or fewer
            error = COARSE_ERROR if name.rpartition(".")[2] in COARSE else FLOAT_ERROR
            if isinstance(was, float) and isinstance(now, float) and abs(was - now) <= error * abs(now):
                continue
            return Difference(number, name, f"{was!r}", f"{now!r}")
    return Difference(number, "the checksum of the states", f"{logged.check:08x}", f"{crc_of(tick):08x}")


def _pairs(logged: LoggedTick, tick: Tick) -> Iterator[tuple[str, float | str, float | str]]:
    for group in ("measurement", "estimate", "reference"):
        old, new = getattr(logged, group), getattr(tick, group)
        for name in new._fields:
            yield f"{group}.{name}", getattr(old, name), getattr(new, name)
    yield "state", State(logged.state).label, State(tick.state).label
    yield "present", logged.present, tick.present
    yield "latched", logged.latched, tick.latched
    yield "answer", logged.answer, tick.answer
    for name in tick.command._fields:
        yield f"command.{name}", getattr(logged.command, name), getattr(tick.command, name)
