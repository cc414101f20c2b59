"""Codecs of the five frames, compiled at start-up from a DBC and the roles its messages play.

Values are in SI units, whatever units the database uses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from fractions import Fraction
from math import ceil, floor, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pneud.bus import database
from pneud.bus.database import MessageSpec, Signal
from pneud.bus.dbc_layout import Guard, SignalField, bit_range, compile_functions
from pneud.bus.protection import RULES, checksum
from pneud.bus.wire import CAN_EFF_FLAG, FD_LENGTHS, Fd
from pneud.config.bus_tables import BusConfig, FrameConfig
from pneud.config.mapping import MessageConfig
from pneud.config.models import GasConfig
from pneud.rt.inputs import read_whole

if TYPE_CHECKING:
    from pneud.bus.load_cell import LoadCell
    from pneud.bus.switching import Switching

_KILO, _MILLI, _MICRO = Fraction(1000), Fraction(1, 1000), Fraction(1, 1_000_000)
UNITS: dict[str, dict[str, Fraction]] = {
    "n": {"N": Fraction(1), "kN": _KILO, "mN": _MILLI},
    "m": {"m": Fraction(1), "mm": _MILLI, "um": _MICRO, "µm": _MICRO, "μm": _MICRO},
    "pa": {
        "Pa": Fraction(1),
        "hPa": Fraction(100),
        "kPa": _KILO,
        "MPa": Fraction(1_000_000),
        "mbar": Fraction(100),
        "bar": Fraction(100_000),
    },
    "v": {"V": Fraction(1), "mV": _MILLI},
    "s": {"s": Fraction(1), "ms": _MILLI, "us": _MICRO, "µs": _MICRO, "μs": _MICRO},
}

# Each role's values in order; a value with a default may be missing from a device's message
_REQUIRED = None
ROLES: dict[str, dict[str, float | None]] = {
    "sync": {},
    "encoder": {"position_m": _REQUIRED, "status": 1, "age_s": 0.0},
    "pressure": {"p1_pa": _REQUIRED, "p2_pa": _REQUIRED, "supply_pa": _REQUIRED},
    "valve_status": {"applied_v": _REQUIRED, "state": _REQUIRED},
    "valve_command": {"voltage_v": _REQUIRED, "enable": _REQUIRED, "sequence": 0},
}


SOURCES: dict[str, tuple[str, ...]] = {
    "encoder": ("position_m", "status", "age_s", "second_position_m"),
    "pressure": ("p1_pa", "p2_pa", "difference_pa", "supply_pa"),
    "valve": ("applied_v", "state"),
}
"""What each source tells, where signals are mapped."""
ROW = tuple(key for keys in SOURCES.values() for key in keys)

_LEAST, _MOST = Fraction(1, 10**100), Fraction(10**100)  # factors and offsets in SI units
FLOAT_STEP_V = 1e-6  # of a command that is a floating-point number
_BEYOND = Fraction(10**400)  # instead of infinity


def exact(value: float) -> Fraction:
    """The number as the database has it; for infinity, as which 1E999 is read, one beyond all floats."""
    return Fraction(str(value)) if isfinite(value) else (_BEYOND if value > 0 else -_BEYOND)


class DatabaseError(Exception):
    """A DBC cannot be used; the text is one line for a person."""

    exit_code = 2


class Codec(NamedTuple):
    """One message in one role.

    `can_id` is as in `struct can_frame`: a 29-bit identifier has its flag.
    `decode`, `counter`, `valid`, `check` take the frame's bytes. `decode` and `counter` expect bytes that are
    `valid`: the message's length and, where it has one, the right checksum. `decode` yields floats in SI
    units, and ints for numbers without a dimension. `encode` takes the values in the order of the role, those
    with a default need not be given, and `counter` by its name; it rounds half to even, leaves reserved bits
    zero and raises ValueError for what the signal cannot carry. `check` yields the counter of what is valid,
    and −1 of what is not. `counter_values` is how many values the counter has, 1 without one. The rest is
    for those who judge many frames at once: where counter and age lie, and how the frame is protected.
    `data_bit_s` is the bit rate of the data where its frames are of CAN FD, and 0 where they are classic.
    `fields` are of a message that plays a role: where its values lie, None for what it does not tell.
    """

    can_id: int
    length: int
    counter_values: int
    encode: Callable[..., bytes]
    decode: Callable[[bytes], tuple[Any, ...]]
    counter: Callable[[bytes], int]
    valid: Callable[[bytes], bool]
    check: Callable[[bytes], int]
    counter_field: SignalField | None
    age_field: SignalField | None
    guard: Guard
    data_bit_s: float = 0.0
    fields: tuple[SignalField | None, ...] = ()


class Answer(NamedTuple):
    """A message that a node sends, or one of its kinds where it is multiplexed."""

    name: str  # its role, or its name in the DBC
    codec: Codec
    keys: tuple[str, ...]  # the values that the codec takes and yields, in order
    filled: tuple[str, ...]  # those of them that the frame tells
    kind: int | None = None  # the multiplexer's value


class Row(NamedTuple):
    """How mapped messages fill the values of the axis, `ROW`."""

    values: tuple[float, ...]  # before anything is heard, and constants
    kind_of: dict[int, Callable[[bytes], int]]  # multiplexers, by identifier


class Codecs(NamedTuple):
    """All frames of an axis.

    Values in order: `valve_command` (voltage_v, enable, sequence); `sync` has its counter only. Those of
    `answers` are with each: as in `ROLES` where three messages play the roles, and `ROW` where signals are
    mapped, which is where there is a `row`.
    """

    sync: Codec
    valve_command: Codec
    answers: tuple[Answer, ...]
    command_lsb_v: float  # one step of the command's voltage
    command_min_v: float
    command_max_v: float
    older_s: float  # an age of this or more means "older than can be told"; infinite without an age
    row: Row | None = None
    fd: Fd | None = None  # what is sent as frames of CAN FD; None on a bus without
    switching: Switching | None = None  # inputs and outputs, where there are any
    load_cell: LoadCell | None = None  # where there is one

    def telling(self, *keys: str) -> tuple[Answer, ...]:
        """The answers that tell any of these values."""
        return tuple(answer for answer in self.answers if not set(keys).isdisjoint(answer.filled))

    @property
    def encoder(self) -> Codec:
        """The message with the position."""
        return self.telling("position_m")[0].codec

    @property
    def pressure(self) -> Codec:
        """The first message with a chamber's pressure."""
        return self.telling("p1_pa", "p2_pa")[0].codec

    @property
    def valve_status(self) -> Codec:
        """The first message of the valve.

        Raises:
            IndexError: it sends none.
        """
        return self.telling("applied_v", "state")[0].codec


def fd_of(axes: Iterable[Codecs]) -> Fd | None:
    """What the axes on one bus have sent as frames of CAN FD; None on a bus without."""
    found = [codecs.fd for codecs in axes if codecs.fd is not None]
    return Fd(frozenset().union(*(fd.ids for fd in found)), found[0].switches) if found else None


def load_codecs(
    bus: BusConfig, dbc_path: Path, gas: GasConfig | None = None, *, keep: bool = False
) -> Codecs:
    """The codecs for the messages named in `bus.frames` or `bus.signals`.

    Raises:
        DatabaseError: the file, a message or a signal is missing or cannot be used; names it and the cure.
    """
    try:
        dbc = read_whole(dbc_path)
    except OSError as e:
        raise DatabaseError(f"{dbc_path}: cannot be read: {e.strerror or e}; see bus.dbc") from None
    return codecs_from(bus, dbc_path, dbc, gas, keep=keep)


def codecs_from(
    bus: BusConfig, path: Path, dbc: bytes, gas: GasConfig | None = None, *, keep: bool = False
) -> Codecs:
    """As `load_codecs`, of a DBC that need not be in a file of its own.

    Args:
        bus: which messages play which roles, or which signals fill which values.
        path: what to call the DBC in errors.
        dbc: its bytes.
        gas: what mapped pressures count from, and the supply that nobody measures.
        keep: keep in the user's cache what the DBC says.

    Raises:
        DatabaseError: a message or a signal is missing or cannot be used; names it and the cure.
    """
    messages = _messages(path, dbc, keep)
    codecs = _of_axis(bus, path, messages, gas)
    if bus.inputs or bus.outputs:
        from pneud.bus import switching  # noqa: PLC0415 - for axes with inputs or outputs alone

        found = switching.loaded(bus, path, messages, codecs)
        fd = codecs.fd and codecs.fd._replace(ids=codecs.fd.ids | found.fd_ids)
        codecs = codecs._replace(switching=found, fd=fd)
    if bus.load_cell is not None:
        from pneud.bus import load_cell  # noqa: PLC0415 - for axes with one alone

        codecs = codecs._replace(load_cell=load_cell.loaded(bus, path, messages, codecs))
    return codecs


def _of_axis(bus: BusConfig, path: Path, messages: list[MessageSpec], gas: GasConfig | None) -> Codecs:
    """What encoder, pressures and valve send and hear."""
    if bus.signals is not None:
        from pneud.bus import mapping  # noqa: PLC0415 - for axes with a mapping alone

        return mapping.mapped(bus, path, messages, gas)
    loader = Loader(path, messages, bus)
    codecs = {role: loader.codec(role, getattr(bus.frames, role)) for role in ROLES}
    fields = loader.fields
    return assembled(
        codecs["sync"],
        codecs["valve_command"],
        tuple(
            Answer(role, codecs[role], tuple(ROLES[role]), tuple(fields[role]))
            for role in ("encoder", "pressure", "valve_status")
        ),
        fields["valve_command"]["voltage_v"],
        fields["encoder"].get("age_s"),
        bus=bus,
    )


def assembled(
    sync: Codec,
    valve_command: Codec,
    answers: tuple[Answer, ...],
    voltage: SignalField,
    age: SignalField | None,
    row: Row | None = None,
    *,
    bus: BusConfig,
) -> Codecs:
    """Codecs, with what the command's voltage and the position's age can say."""
    codecs = (sync, valve_command, *(answer.codec for answer in answers))
    ids = frozenset(codec.can_id for codec in codecs if codec.data_bit_s)
    low, high = sorted((voltage.si(voltage.low), voltage.si(voltage.high)))
    return Codecs(
        sync,
        valve_command,
        answers,
        command_lsb_v=FLOAT_STEP_V if voltage.floating else abs(voltage.scale),
        command_min_v=low,
        command_max_v=high,
        older_s=float("inf") if age is None else age.si(bit_range(age.length, age.signed)[1]),
        row=row,
        fd=Fd(ids, bus.data_bitrate_bit_s is not None) if bus.fd else None,
    )


def _messages(path: Path, dbc: bytes, keep: bool) -> list[MessageSpec]:
    try:
        return database.messages(dbc, keep=keep)
    except Exception as e:  # the parser lets more than its own errors through
        if isinstance(lacking := getattr(e, "e_dbc", e), KeyError):
            why = f"it uses {lacking} and does not define it"
            raise DatabaseError(f"{path}: not a usable DBC: {why}") from None
        raise DatabaseError(f"{path}: not a usable DBC: {' '.join(str(e).split())}") from None


def can_id_of(message: MessageSpec) -> int:
    """The identifier, with its flag where it has 29 bits."""
    return message.can_id | (CAN_EFF_FLAG if message.extended else 0)


class Loader:
    """Takes messages from one database, each for one role only."""

    def __init__(self, path: Path, messages: list[MessageSpec], bus: BusConfig) -> None:
        self.path = path
        self.messages = messages
        self._bus = bus
        self.fields: dict[str, dict[str, SignalField]] = {}
        self._taken: dict[int, str] = {}

    def codec(self, role: str, frame: FrameConfig) -> Codec:
        """The codec of the message that plays `role`."""
        message = self._message(role, frame)
        values = ROLES[role]
        for key in frame.signals:
            if key not in values:
                wanted = ", ".join(values) or "none"
                raise self._error(message.name, key, f"{role} has no such value; it has {wanted}")
        for key, default in values.items():
            if default is _REQUIRED and key not in frame.signals:
                cure = f'add signals.{key} = "NAME" under [bus.frames.{role}]'
                raise self._error(message.name, None, f"no signal is named for {key}; {cure}")
        others = (frame.counter, frame.crc, frame.data_id_nibble)
        named = [*frame.signals.values(), *(name for name in others if name is not None)]
        for name in named:
            if named.count(name) > 1:
                raise self._error(message.name, name, f"has two jobs; look at [bus.frames.{role}]")
        fields = {
            key: self._field(message, key, self._signal(message, name)) for key, name in frame.signals.items()
        }
        self.fields[role] = fields
        counter = None if frame.counter is None else self._counter(message, frame.counter)
        guard = self._guard(f"bus.frames.{role}", message, frame, counter)
        if counter is not None:
            counter = counter._replace(high=min(counter.high, guard.counter_values - 1))
        placed = tuple(fields.get(key) for key in values)
        functions = compile_functions(
            message.can_id,
            message.length,
            placed,
            list(values.values()),
            counter,
            guard,
        )
        return Codec(
            message.can_id,
            message.length,
            guard.counter_values,
            *functions,
            counter_field=counter,
            age_field=fields.get("age_s"),
            guard=guard,
            data_bit_s=self._data_bit_s(message),
            fields=placed,
        )

    def _data_bit_s(self, message: MessageSpec) -> float:
        """The bit rate of the data where a message's frames are of CAN FD; 0 where they are classic.

        Raises:
            DatabaseError: they cannot be frames of this bus.
        """
        name, length = message.name, message.length
        if not self._bus.fd:
            if length > 8:
                raise self._error(
                    name,
                    None,
                    f"is {length} bytes long; classic CAN carries at most 8, CAN FD 64: see bus.fd",
                )
            if message.fd:
                raise self._error(name, None, "is a message of CAN FD; give bus.fd = true, or mend the DBC")
            return 0.0
        if length not in FD_LENGTHS:
            lengths = ", ".join(str(n) for n in FD_LENGTHS if n > 8)
            raise self._error(
                name,
                None,
                f"is {length} bytes long; frames of CAN FD have up to 8, or {lengths}; mend the DBC",
            )
        if length <= 8 and not message.fd:
            return 0.0
        return self._bus.data_bitrate_bit_s or self._bus.bitrate_bit_s

    def _message(self, role: str, frame: FrameConfig) -> MessageSpec:
        name = frame.message
        named = [message for message in self.messages if message.name == name]
        if not named:
            there = ", ".join(sorted({message.name for message in self.messages})) or "none"
            cure = f"bus.frames.{role}.message must be one of: {there}"
            raise self._error(name, None, f"not in the database; {cure}")
        if len(named) > 1:
            which = " and ".join(f"0x{message.can_id:03X}" for message in named)
            raise self._error(name, None, f"is there {len(named)} times, as {which}; give each its own name")
        message = named[0]
        if message.extended:
            raise self._error(name, None, "has a 29-bit identifier; only 11-bit ones are used")
        self._data_bit_s(message)
        if message.length == 0 and (role != "sync" or frame.counter is not None):
            raise self._error(name, None, "has no bytes; give the message its length")
        self._refuse_kinds(message)
        other = self._taken.setdefault(message.can_id, role)
        if other != role:
            raise self._error(name, None, f"0x{message.can_id:03X} is {other} and {role}; each needs its own")
        return message

    def _refuse_kinds(self, message: MessageSpec) -> None:
        if message.multiplexed:
            words = "is multiplexed; name a message that always has the same signals"
            raise self._error(message.name, None, words)

    def _signal(self, message: MessageSpec, name: str) -> Signal:
        for signal in message.signals:
            if signal.name == name:
                if signal.floating:
                    raise self._error(
                        message.name, name, "is a floating-point signal; only integers are used"
                    )
                return signal
        there = ", ".join(signal.name for signal in message.signals) or "none"
        raise self._error(message.name, name, f"not in the message; it has: {there}")

    def _field(self, message: MessageSpec, key: str, signal: Signal) -> SignalField:
        _, _, dimension = key.rpartition("_")
        units = UNITS.get(dimension)
        plain = signal.scale == 1 and signal.offset == 0
        if units is None:
            if not plain:
                raise self._error(message.name, signal.name, f"{key} needs factor 1 and offset 0")
            unit = Fraction(1)
        elif signal.unit in units:
            unit = units[signal.unit]
        else:
            shown = f"unit {signal.unit!r}" if signal.unit else "no unit"
            raise self._error(message.name, signal.name, f"{shown}; {key} needs one of {', '.join(units)}")
        if signal.scale == 0:
            raise self._error(message.name, signal.name, "has the factor 0; give it its resolution")
        return self._placed(message, signal, unit, integer=units is None)

    def _placed(self, message: MessageSpec, signal: Signal, unit: Fraction, *, integer: bool) -> SignalField:
        # the database's decimals are taken exactly, so that −2147.483648 / 1e-6 is the last raw value and
        # not beyond it
        scale, offset = exact(signal.scale), exact(signal.offset)
        for name, value in (("a factor", scale * unit), ("an offset", offset * unit)):
            if value and not _LEAST <= abs(value) <= _MOST:
                raise self._error(message.name, signal.name, f"has {name} that cannot be meant; mend it")
        low, high = bit_range(signal.length, signal.signed)
        bounds = [exact(b) for b in (signal.minimum, signal.maximum) if b is not None]
        if len(bounds) == 2 and any(bounds):  # [0|0] says that there is no range
            first, last = sorted((bound - offset) / scale for bound in bounds)
            low, high = max(low, ceil(first)), min(high, floor(last))
        if low > high:
            raise self._error(message.name, signal.name, "its minimum and maximum leave no value; mend them")
        return SignalField(
            label=f"{message.name}.{signal.name}",
            start=signal.start,
            length=signal.length,
            big_endian=signal.big_endian,
            signed=signal.signed,
            integer=integer,
            scale=float(scale * unit),
            offset=float(offset * unit),
            low=low,
            high=high,
        )

    def _counter(self, message: MessageSpec, name: str) -> SignalField:
        signal = self._signal(message, name)
        if signal.signed or signal.scale != 1 or signal.offset != 0 or signal.length < 2:
            raise self._error(
                message.name, name, "a counter is unsigned with factor 1, offset 0 and 2 bits or more"
            )
        return self._placed(message, signal, Fraction(1), integer=True)

    def _guard(
        self, table: str, message: MessageSpec, frame: MessageConfig, counter: SignalField | None
    ) -> Guard:
        """How the frames of a message are protected."""
        name, rule = frame.protection, RULES[frame.protection]
        if rule.counter is not None and (counter is None or counter.length != rule.counter.bits):
            cure = f"needs a counter of {rule.counter.bits} bits; look at {table}.counter"
            raise self._error(message.name, frame.counter, f"{name} {cure}")
        all_set = 0 if counter is None else (1 << counter.length) - 1
        last = all_set if rule.counter is None else rule.counter.last
        if frame.counter_max is not None:
            if frame.counter_max > last:
                raise self._error(
                    message.name, frame.counter, f"counter_max is beyond its last value, {last}"
                )
            last = frame.counter_max
        if frame.crc is None:
            if name != "pneud":
                raise self._error(message.name, None, f"{name} needs a checksum; look at {table}.crc")
            return Guard(counter_values=last + 1, judged="length" if last == all_set else "call")
        crc = self._plain(message, frame.crc, rule.bits, f"the checksum of {name}")
        nibble = frame.data_id_nibble and self._plain(message, frame.data_id_nibble, 4, "data_id_nibble")
        inline = name == "pneud" and message.length <= 8  # of more it would be no expression to read
        trailing = crc.start == 8 * message.length - (1 if crc.big_endian else 8)
        return Guard(
            crc,
            checksum(name, can_id_of(message), frame.data_ids, frame.data_id_mode),
            last + 1,
            nibble or None,
            frame.data_ids[0] >> 8 if nibble else 0,
            "inline" if inline and trailing and last == all_set else "call",
        )

    def _plain(self, message: MessageSpec, name: str, bits: int, what: str) -> SignalField:
        signal = self._signal(message, name)
        if signal.length != bits or signal.signed or signal.scale != 1 or signal.offset != 0:
            raise self._error(
                message.name, name, f"{what} is unsigned, with {bits} bits, factor 1 and offset 0"
            )
        return self._placed(message, signal, Fraction(1), integer=True)

    def _error(self, message: str, signal: str | None, problem: str) -> DatabaseError:
        where = f"message {message}" if signal is None else f"message {message}, signal {signal}"
        return DatabaseError(f"{self.path}: {where}: {problem}")
