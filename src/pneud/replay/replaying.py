"""A log through the axis again: the same frames, requests and times, and every command compared."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

from pneud.axis.cycle import AxisState
from pneud.bus.codec import Codecs
from pneud.bus.inbox import InboxState
from pneud.bus.mapped_inbox import inbox_of
from pneud.compiled.backend import backend
from pneud.config import conversions
from pneud.config.models import Config
from pneud.config.reading import parse
from pneud.config.sections import ConfigError
from pneud.control.model import Model, as_replayed
from pneud.control.step import Controller
from pneud.control.tunables import parted, tunables, tuned
from pneud.loading import at_rate, codecs_of
from pneud.log.files.naming import LogError
from pneud.log.files.reader import LoggedState, LogReader
from pneud.log.format.fingerprint import numeric_fingerprint
from pneud.log.format.records import COARSE, COARSE_ERROR, FLOAT_ERROR, LoggedTick, crc_of
from pneud.log.format.schema import STANDING, WITHOUT_STANDING
from pneud.log.format.snapshot import SnapshotError, from_json
from pneud.loop.turn import Turn
from pneud.replay.feeding import Fed, fed, states_of, without_standing
from pneud.safety.supervisor import is_engaged
from pneud.signals import Frame, Request, RequestKind, State, Tick


class Difference(NamedTuple):
    """Where a replay first left its log."""

    tick: int
    variable: str
    logged: str
    replayed: str

    def __str__(self) -> str:
        return f"tick {self.tick}: {self.variable} logged {self.logged}, replayed {self.replayed}"


class ReplayOutcome(NamedTuple):
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
    compiled: bool = False  # the axis was computed in C

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


class Snapshot(NamedTuple):
    """What a log holds of the state between two ticks."""

    axis: AxisState
    inbox: InboxState


def replay(
    log: LogReader,
    config: Config | None = None,
    from_s: float = 0.0,
    look: Callable[[LoggedTick, Tick], None] | None = None,
) -> ReplayOutcome:
    """Feed a log through the axis again.

    It begins at the last snapshot before `from_s`, and goes on at the next one where records are missing.

    Args:
        log: the log.
        config: another configuration than the log's own; what was tuned in the run stays as it was.
        from_s: compare from so long after the log's start.
        look: called with every tick compared, as it is in the log and as it comes out.

    Raises:
        ConfigError: the configuration in the log cannot be used by this version.
        DatabaseError: nor its DBC.
        BuildError: it requires the compiled law, which cannot be had.
        LogError: a snapshot that is needed is of another version's axis.
    """
    chosen = at_rate(config or parse(log.config_text, f"{log.path}:{log.config_name}"), log.rate_hz)
    codecs = codecs_of(chosen.bus, log.dbc_name, log.dbc, chosen.gas)
    p = conversions.axis_of(chosen, codecs.command_lsb_v)
    how = backend(chosen.loop.compiled, p)
    turn = Turn(how.axis(p), inbox_of(codecs, chosen.bus), codecs)
    compared = _Compared(codecs, chosen.bus.sync, log)
    gap = ""
    tuning = _Tuned(_known(chosen, codecs), None if config is None else _configured(log, codecs))
    expected = 1
    from_ns = log.start_ns() + round(from_s * 1e9) if from_s > 0.0 else 0
    for logged in fed(log, from_ns):
        if isinstance(logged, LoggedState):
            if logged.number + 1 != expected:  # the start, or behind missing records
                state = _thawed(log, logged)
                if expected > 1 or not (from_ns or log.records_before):
                    gap = gap or f"records {expected} to {logged.number} are missing"
                turn.thaw(state.axis._replace(law=tuning.of(state.axis.law)), state.inbox)
                expected = logged.number + 1
            continue
        if logged.number != expected:
            gap = gap or f"records {expected} to {logged.number - 1} are missing"
            continue
        expected += 1
        request = logged.request
        if request is not None:
            request = tuning.asked(request)
        turn.open(logged.frames[: logged.before])
        turn.begin(logged.t_ns)
        turn.feed(logged.frames[logged.before :])
        tick = turn.decide(logged.skipped, logged.host, request, logged.told)
        turn.sent(compared.commanded_ns(logged.sent))
        if logged.log_time_ns < from_ns:
            continue
        compared.add(logged, tick, turn)
        if look is not None:
            look(logged.whole(), tick)
    return ReplayOutcome(
        compared.ticks,
        compared.commands,
        compared.mismatches,
        compared.first,
        compared.engaged,
        compared.worst_lsb,
        compared.same_states,
        log.metadata.get("fingerprint") == numeric_fingerprint(),
        log.truncated or bool(gap),
        log.damage or gap,
        how.name == "compiled",
    )


class _Compared:
    """What differs from the log, tick by tick."""

    def __init__(self, codecs: Codecs, sync: bool | str, log: LogReader) -> None:
        self.ticks = self.commands = self.mismatches = self.engaged = self.worst_lsb = 0
        self.first: Difference | None = None
        self.same_states = True
        self._sync, self._command, self._lsb_v = codecs.sync, codecs.valve_command, codecs.command_lsb_v
        self._sync_id, self._command_id = codecs.sync.can_id, codecs.valve_command.can_id
        self._makes_sync = sync is True
        self._counted = codecs.sync.counter_values > 1
        self._exact = log.metadata.get("detail") == "full"
        self._told = log.metadata["schema"] not in WITHOUT_STANDING  # how the load stands at its target

    def commanded_ns(self, sent: tuple[Frame, ...]) -> int:
        """When the command was sent; −1 where it was not."""
        if len(sent) == 2 and sent[0].can_id == self._sync_id and sent[1].can_id == self._command_id:
            return sent[1].stamp_ns
        return next((f.stamp_ns for f in sent if f.can_id == self._command_id), -1)

    def add(self, logged: Fed, tick: Tick, turn: Turn) -> None:
        """One tick, after the axis has decided it again."""
        states_differ = not self._alike(states_of(tick), logged.states)
        different = states_differ or crc_of(tick) != logged.check
        self.same_states = self.same_states and not states_differ
        whole, again = self._sent_again(logged.sent, turn)
        self.commands += whole
        self.same_states = self.same_states and whole
        different = different or not again
        if different:
            self.mismatches += 1
            if self.first is None:
                self.first = _difference(
                    logged.number - 1, logged.whole(), tick, whole, self._exact, self._told
                )
        self.engaged += is_engaged(tick.state)
        self.ticks += 1

    def _alike(self, one: tuple[int, ...], other: tuple[int, ...]) -> bool:
        if self._told:
            return one == other
        return without_standing(one) == without_standing(other)

    def _sent_again(self, sent: tuple[Frame, ...], turn: Turn) -> tuple[bool, bool]:
        """Whether a valid SYNC, if any, and a valid command were sent, and whether that comes out again."""
        if len(sent) == 2 and sent[0].can_id == self._sync_id and sent[1].can_id == self._command_id:
            beat, data = sent[0].data, sent[1].data
            if self._counted and len(data) == self._command.length and self._sync.valid(beat):
                again = turn.command(self._sync.counter(beat), self._command.counter(data))
                if again == data:
                    return True, True
        return self._sent_otherwise(sent, turn)

    def _sent_otherwise(self, sent: tuple[Frame, ...], turn: Turn) -> tuple[bool, bool]:
        sync, command = self._sync, self._command
        frames = {f.can_id: f.data for f in sent}
        said = _said(turn, frames)
        beat, data = frames.get(sync.can_id), frames.get(command.can_id, b"")
        whole = len(sent) == 1 + len(said) + (beat is not None) and command.valid(data)
        if not whole or not (sync.valid(beat) if beat is not None else not self._makes_sync):
            return False, False
        told = beat if self._counted else None
        sequence = command.decode(data)[2] if told is None else sync.counter(told)
        again = turn.command(sequence, command.counter(data))
        if again != data:
            apart_v = abs(command.decode(data)[0] - command.decode(again)[0])
            self.worst_lsb = max(self.worst_lsb, round(apart_v / self._lsb_v))
        return True, again == data and all(said.values())


class _Known(NamedTuple):
    """What of a configuration may be tuned."""

    law: Controller
    model: Model


def _known(c: Config, codecs: Codecs) -> _Known:
    return _Known(conversions.axis_of(c, codecs.command_lsb_v).controller, conversions.model_of(c))


def _configured(log: LogReader, codecs: Codecs) -> _Known | None:
    """What the log's own configuration says; None where this version cannot use that."""
    try:
        return _known(at_rate(parse(log.config_text, log.config_name), log.rate_hz), codecs)
    except ConfigError:
        return None


class _Tuned:
    """What nobody tuned in the run is as in the replay; all else stays as it was."""

    def __init__(self, here: _Known, own: _Known | None) -> None:
        """What the replay has, and the log's own configuration where that is another one."""
        self._here = here
        self._own = own

    def of(self, logged: Controller) -> Controller:
        """The law in the place of one in the log."""
        if self._own is None:
            return logged
        had = tunables(logged)
        law = self._here.law
        return as_replayed(logged, self._own.law, law if had == tunables(self._own.law) else tuned(had, law))

    def asked(self, request: Request | None) -> Request | None:
        """The request in the place of one in the log; whatever it is for, it brings all gains along."""
        own, here = self._own, self._here
        if request is None or own is None or request.kind != RequestKind.GAINS:
            return request
        gains, more = parted(request.values) or ((), ())
        if gains == tunables(own.law):
            gains = tunables(here.law)
        rest = len(more) % len(Model._fields)
        believed = zip(more[rest:], own.model, here.model, strict=False)
        mixed = (there if was == there_before else was for was, there_before, there in believed)
        return Request(request.kind, (*gains, *more[:rest], *mixed))


def _said(turn: Turn, sent: dict[int, bytes]) -> dict[int, bool]:
    """Which output messages a log has in a tick, and whether each says what it does here."""
    station = turn.tick.station
    return {
        message.codec.can_id: station is not None
        and message.codec.valid(data := sent[message.codec.can_id])
        and message.encode(station.outputs & message.mask(), message.codec.counter(data)) == data
        for message in turn.outputs
        if message.codec.can_id in sent
    }


def _thawed(log: LogReader, state: LoggedState) -> Snapshot:
    try:
        found: Snapshot = from_json(Snapshot, state.data)
    except SnapshotError as e:
        raise LogError(
            f"{log.path}: the snapshot after record {state.number} is of another version's axis: {e};"
            f" replay from the start, or with pneud {log.metadata.get('pneud', 'of the log')}"
        ) from None
    return found


def _difference(
    number: int, logged: LoggedTick, tick: Tick, whole: bool, exact: bool, told: bool
) -> Difference:
    """The first value that differs, in the order in which a cycle makes them."""
    if not whole:
        return Difference(number, "frames sent", "not one valid SYNC, if any, and one valid command", "both")
    for name, was, now in pairs(logged, tick):
        if differ(name, was, now, exact=exact):
            return Difference(number, name, f"{was!r}", f"{now!r}")
    for name in STANDING if told else ():
        if getattr(logged, name) != getattr(tick, name):
            return Difference(number, name, f"{getattr(logged, name)}", f"{getattr(tick, name)}")
    if logged.program != tick.program:
        return Difference(number, "program", f"{logged.program}", f"{tick.program}")
    if logged.weighed != tick.weighed:
        return Difference(number, "weighed", f"{logged.weighed}", f"{tick.weighed}")
    if logged.station != tick.station:
        return Difference(number, "station", f"{logged.station}", f"{tick.station}")
    return Difference(number, "the checksum of the states", f"{logged.check:08x}", f"{crc_of(tick):08x}")


def differ(name: str, was: float | str, now: float | str, *, exact: bool) -> bool:
    """Whether a value is another one than the log's, which in a compact log has 32 bits or fewer."""
    if was == now or repr(was) == repr(now):  # the latter makes NaN equal to itself
        return False
    if not exact and isinstance(was, float) and isinstance(now, float):
        error = COARSE_ERROR if name in COARSE else FLOAT_ERROR
        return not abs(was - now) <= error * abs(now)
    return True


def pairs(logged: LoggedTick, tick: Tick | LoggedTick) -> Iterator[tuple[str, float | str, float | str]]:
    """Name, value in the log and value now of all in a tick, in the order in which a cycle makes it."""
    for group in ("measurement", "estimate", "reference"):
        old, new = getattr(logged, group), getattr(tick, group)
        for name, was, now in zip(new._fields, old, new, strict=True):
            yield f"{group}.{name}", was, now
    yield "state", State(logged.state).label, State(tick.state).label
    yield "present", logged.present, tick.present
    yield "latched", logged.latched, tick.latched
    for name, was, now in zip(tick.command._fields, logged.command, tick.command, strict=True):
        yield f"command.{name}", was, now
