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
from pneud.safety.supervisor import is_engaged
from pneud.signals import Request, RequestKind, State, Tick


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
    turn = Turn(backend(chosen.loop.compiled, p).axis(p), inbox_of(codecs, chosen.bus), codecs)
    command = codecs.valve_command

    ticks = commands = mismatches = engaged = worst_lsb = 0
    first: Difference | None = None
    same_states = True
    gap = ""
    exact = log.metadata.get("detail") == "full"
    told = log.metadata["schema"] not in WITHOUT_STANDING
    tuning = _Tuned(_known(chosen, codecs), None if config is None else _configured(log, codecs))
    expected = 1
    from_ns = log.start_ns() + round(from_s * 1e9) if from_s > 0.0 else 0
    for logged in log.items(from_ns):
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
        turn.open(logged.frames[: logged.before])
        turn.begin(logged.t_ns)
        turn.feed(logged.frames[logged.before :])
        tick = turn.decide(logged.skipped, logged.host, tuning.asked(logged.request), logged.told)
        turn.sent(next((f.stamp_ns for f in logged.sent if f.can_id == command.can_id), -1))
        if logged.log_time_ns < from_ns:
            continue
        states_differ = _states(tick, told) != _states(logged, told)
        different = states_differ or crc_of(tick) != logged.check
        same_states = same_states and not states_differ
        sent = {f.can_id: f.data for f in logged.sent}
        sync, data = sent.get(codecs.sync.can_id), sent.get(command.can_id, b"")
        whole = len(logged.sent) == 1 + (sync is not None) and command.valid(data)
        whole = whole and (chosen.bus.sync is not True if sync is None else codecs.sync.valid(sync))
        if whole:
            commands += 1
            counted = sync if codecs.sync.counter_values > 1 else None
            sequence = command.decode(data)[2] if counted is None else codecs.sync.counter(counted)
            again = turn.command(sequence, command.counter(data))
            if again != data:
                different = True
                apart = abs(command.decode(data)[0] - command.decode(again)[0])
                worst_lsb = max(worst_lsb, round(apart / codecs.command_lsb_v))
        else:
            different, same_states = True, False
        if different:
            mismatches += 1
            if first is None:
                first = _difference(logged.number - 1, logged, tick, whole, exact, told)
        if look is not None:
            look(logged, tick)
        engaged += is_engaged(tick.state)
        ticks += 1
    return ReplayOutcome(
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


def _thawed(log: LogReader, state: LoggedState) -> Snapshot:
    try:
        found: Snapshot = from_json(Snapshot, state.data)
    except SnapshotError as e:
        raise LogError(
            f"{log.path}: the snapshot after record {state.number} is of another version's axis: {e};"
            f" replay from the start, or with pneud {log.metadata.get('pneud', 'of the log')}"
        ) from None
    return found


def _states(t: Tick | LoggedTick, told: bool) -> tuple[int, ...]:
    """What may not differ at all; `told` where the log says how the load stands at its target."""
    states = t.state, t.present, t.latched, t.answer, t.command.enable, *(t.program or ())
    return (*states, t.in_position, t.hunting) if told else states


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
