"""Functions compiled from the layout of one message: encode, decode, counter, valid and check.

The Python source is generated once, at start-up. Where every signal fills whole bytes it is a single
`struct` call, otherwise shifts and masks on the frame taken as one integer. Nothing that a user wrote gets
into the source.
"""

import math
import struct
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, NoReturn

from pneud.bus import crc8
from pneud.bus.protection import Checksum

_CODES = {8: "b", 16: "h", 32: "i", 64: "q"}
_FLOATS = {32: struct.Struct(">f"), 64: struct.Struct(">d")}
_CRC_BYTES = tuple(bytes((state ^ crc8.FINAL_XOR,)) for state in range(256))


class Code(NamedTuple):
    """What an integer's bits are for the axis, where they are not that themselves."""

    mask: int  # of the bits that say it
    read: dict[int, int]  # number on the wire → number of the axis; empty: they are the same
    unknown: int  # what any other number on the wire is
    write: dict[int, int]  # number of the axis → number on the wire


class SignalField(NamedTuple):
    """Where one number lies in a frame, and what it means.

    `low` and `high` bound the raw value. `scale` and `offset` lead to SI units; they are unused where
    `integer` holds. `floating` says that the raw value is an IEEE 754 number of 32 or 64 bits.
    """

    label: str
    start: int  # as in a DBC: the least significant bit, or the most significant one where big-endian
    length: int
    big_endian: bool
    signed: bool
    integer: bool
    scale: float
    offset: float
    low: float
    high: float
    floating: bool = False
    code: Code | None = None

    def si(self, raw: float) -> float:
        """The value in SI units that a raw value stands for."""
        return raw * self.scale + self.offset


class Guard(NamedTuple):
    """How a message is protected: what its frames have to hold besides values.

    `judged` by their length alone; by pneud's own checksum in the last byte, which is compiled to one
    expression; or by a call.
    """

    crc: SignalField | None = None
    checksum: Checksum | None = None
    counter_values: int = 1  # how many the counter has; 1 where there is none
    nibble: SignalField | None = None  # that always holds `nibble_value`
    nibble_value: int = 0
    judged: Literal["length", "inline", "call"] = "length"


class Functions(NamedTuple):
    """What is compiled for one message."""

    encode: Callable[..., bytes]
    decode: Callable[[bytes], tuple[Any, ...]]
    counter: Callable[[bytes], int]
    valid: Callable[[bytes], bool]
    check: Callable[[bytes], int]


def compile_functions(
    can_id: int,
    length: int,
    fields: Sequence[SignalField | None],
    defaults: Sequence[float | None],
    counter: SignalField | None,
    guard: Guard,
    fixed: tuple[SignalField, int] | None = None,
) -> Functions:
    """The functions of one message.

    Args:
        can_id: identifier; pneud's checksum covers it.
        length: bytes in the frame, 0 … 64.
        fields: in the order of the values; None where there is no such signal: encoding ignores the value.
        defaults: what decoding yields where there is no such signal, and encoding takes where no value is
            given; None for a value that has to be there.
        counter: the running counter, if there is one.
        guard: how it is protected.
        fixed: what else encoding puts into the frame, such as a multiplexer's value.
    """
    inline = guard.judged == "inline"
    body = length - 1 if inline else length
    present = [(f"v{i}", f) for i, f in enumerate(fields) if f is not None]
    placed = present + ([("counter", counter)] if counter is not None else [])
    placed += [("fixed_", fixed[0])] if fixed is not None else []
    placed += [("NIBBLE", guard.nibble)] if guard.nibble is not None else []
    aligned = _struct(placed, body)
    scope: dict[str, Any] = {
        "T": crc8.TABLE,
        "CRC": _CRC_BYTES,
        "refuse": _refusal(fields, counter),
        "from_bytes": int.from_bytes,
        "NIBBLE": guard.nibble_value,
        "checksum": guard.checksum,
    }
    for i, default in enumerate(defaults):
        scope[f"D{i}"] = default
    for bits, packing in _FLOATS.items():
        scope[f"from_float{bits}"], scope[f"to_float{bits}"] = packing.pack, packing.unpack
    for name, f in present:
        if f.code is not None:
            scope[f"R{name}"], scope[f"W{name}"] = f.code.read, f.code.write
    if fixed is not None:
        scope["fixed_"] = fixed[1]
    if aligned is not None:
        scope["pack"] = aligned[0].pack
        scope["unpack"] = struct.Struct(aligned[0].format + ("x" if inline else "")).unpack
    chain = _crc_chain(can_id, body) if inline else None
    byte = _counter_byte(counter)
    counted = f"b{byte}" if inline and byte is not None else "counter_of(data)"
    if guard.crc is not None and not inline:
        scope["rest"], scope["put"] = around(guard.crc, length)
    source = "\n".join(
        (
            *_encode_source(fields, defaults, counter, aligned, placed, body, chain, guard, scope),
            *_decode_source(fields, aligned, present, length),
            *_counter_source(counter, length),
            *_judging_source("valid", length, chain, guard, counter, "True", "False"),
            *_judging_source("check", length, chain, guard, counter, counted, "-1"),
        )
    )
    exec(compile(source, f"<codec of 0x{can_id:03X}>", "exec"), scope)
    return Functions(*(scope[name] for name in ("encode", "decode", "counter_of", "valid", "check")))


def reader(field: SignalField, length: int) -> Callable[[bytes], int]:
    """What reads one integer from the bytes of a message of this length."""
    scope: dict[str, Any] = {"from_bytes": int.from_bytes}
    exec("\n".join(_counter_source(field, length)), scope)
    read: Callable[[bytes], int] = scope["counter_of"]
    return read


def bit_range(length: int, signed: bool) -> tuple[int, int]:
    """Smallest and largest raw value of so many bits."""
    return (-(1 << (length - 1)), (1 << (length - 1)) - 1) if signed else (0, (1 << length) - 1)


def _byte_span(f: SignalField) -> tuple[int, int] | None:
    """First byte and number of bytes, where the field fills whole bytes."""
    if f.length not in _CODES or f.start % 8 != (7 if f.big_endian else 0):
        return None
    return f.start // 8, f.length // 8


def _counter_byte(counter: SignalField | None) -> int | None:
    """Which byte the counter is, where it is a whole one."""
    span = None if counter is None or counter.length != 8 else _byte_span(counter)
    return None if span is None else span[0]


def _struct(placed: list[tuple[str, SignalField]], body: int) -> tuple[struct.Struct, list[str]] | None:
    """A struct for the first `body` bytes and the names in its order, if every field fills whole bytes."""
    orders = {f.big_endian for _, f in placed if f.length > 8}
    if len(orders) > 1:
        return None
    spans = []
    for name, f in placed:
        span = _byte_span(f)
        if span is None:
            return None
        if f.floating:
            code = "f" if f.length == 32 else "d"
        else:
            code = _CODES[f.length] if f.signed else _CODES[f.length].upper()
        spans.append((*span, name, code))
    text, at = (">" if orders == {True} else "<"), 0
    for first, size, _, code in sorted(spans):
        text += "x" * (first - at) + code
        at = first + size
    return struct.Struct(text + "x" * (body - at)), [name for _, _, name, _ in sorted(spans)]


def shift(f: SignalField, length: int) -> int:
    """How far the least significant bit lies above that of the frame taken as one integer."""
    if not f.big_endian:
        return f.start
    from_the_top = f.start // 8 * 8 + 7 - f.start % 8
    return 8 * length - from_the_top - f.length


def _extract(f: SignalField, length: int) -> str:
    word = "m" if f.big_endian else "n"
    text = f"({word} >> {shift(f, length)} & {(1 << f.length) - 1})"
    if f.floating:
        text = f"to_float{f.length}({text}.to_bytes({f.length // 8}, 'big'))[0]"
    elif f.signed:
        sign = 1 << (f.length - 1)
        text = f"(({text} ^ {sign}) - {sign})"
    return text


def _words(fields: Sequence[SignalField]) -> list[str]:
    lines = []
    if any(not f.big_endian for f in fields):
        lines.append("    n = from_bytes(data, 'little')")
    if any(f.big_endian for f in fields):
        lines.append("    m = from_bytes(data, 'big')")
    return lines


def _physical(name: str, f: SignalField, raw: str) -> str:
    if f.code is not None:
        raw = f"{raw} & {f.code.mask}" if f.code.mask else raw
        return f"R{name}.get({raw}, {f.code.unknown})" if f.code.read else raw
    if f.integer:
        return raw
    text = f"{raw} * {f.scale!r}"
    return f"{text} + {f.offset!r}" if f.offset else text


def _decode_source(
    fields: Sequence[SignalField | None],
    aligned: tuple[struct.Struct, list[str]] | None,
    present: list[tuple[str, SignalField]],
    length: int,
) -> list[str]:
    lines = ["def decode(data):"]
    if aligned is not None:
        if aligned[1]:
            lines.append(f"    {', '.join(aligned[1])}, = unpack(data)")
        raw = {name: name for name, _ in present}
    else:
        lines += _words([f for _, f in present])
        raw = {name: _extract(f, length) for name, f in present}
    values = [f"D{i}" if f is None else _physical(f"v{i}", f, raw[f"v{i}"]) for i, f in enumerate(fields)]
    return [*lines, f"    return ({''.join(v + ', ' for v in values)})"]


def _encode_source(
    fields: Sequence[SignalField | None],
    defaults: Sequence[float | None],
    counter: SignalField | None,
    aligned: tuple[struct.Struct, list[str]] | None,
    placed: list[tuple[str, SignalField]],
    body: int,
    chain: str | None,
    guard: Guard,
    scope: dict[str, Any],
) -> list[str]:
    names = [f"v{i}" for i in range(len(fields))]
    given = [
        name if d is None else f"{name}=D{i}" for i, (name, d) in enumerate(zip(names, defaults, strict=True))
    ]
    lines = [f"def encode({', '.join([*given, '*', 'counter' if counter is not None else 'counter=0'])}):"]
    raw, tests = {}, []
    for i, (name, f) in enumerate(placed):
        if f.code is not None and f.code.write:
            raw[name] = f"W{name}[{name}]"
            tests.append(f"{name} in W{name}")
        elif f.integer:
            raw[name] = name
            tests.append(f"{f.low} <= {name} <= {f.high}")
        else:
            raw[name] = f"r{i}" if f.floating else f"round(r{i})"
            lines.append(f"    r{i} = {f'({name} - {f.offset!r})' if f.offset else name} / {f.scale!r}")
            scope[f"L{i}"], scope[f"H{i}"] = bounds(f)
            tests.append(f"L{i} <= r{i} <= H{i}")
    if tests:
        lines.append(f"    if not ({' and '.join(tests)}):")
        lines.append(f"        refuse(({''.join(n + ', ' for n in names)}), counter)")
    if aligned is not None:
        lines.append(f"    data = pack({', '.join(raw[name] for name in aligned[1])})")
    else:
        for word, big in (("n", False), ("m", True)):
            parts = [
                f"({_bits(f, raw[name])} & {(1 << f.length) - 1}) << {shift(f, body)}"
                for name, f in placed
                if f.big_endian is big
            ]
            lines.append(f"    {word} = {' | '.join(parts) or '0'}")
        lines.append(
            f"    data = (n | from_bytes(m.to_bytes({body}, 'big'), 'little')).to_bytes({body}, 'little')"
        )
    if chain is None:
        guarded = "put(data, checksum(rest(data), counter))" if guard.crc is not None else "data"
        return [*lines, f"    return {guarded}"]
    if body:
        lines.append(f"    {''.join(f'b{i}, ' for i in range(body))} = data")
    return [*lines, f"    return data + CRC[{chain}]"]


def _bits(f: SignalField, raw: str) -> str:
    """The bits of a raw value as an integer."""
    return f"from_bytes(from_float{f.length}({raw}), 'big')" if f.floating else raw


def _counter_source(counter: SignalField | None, length: int) -> list[str]:
    if counter is None:
        return ["def counter_of(data):", "    return 0"]
    byte = _counter_byte(counter)
    if byte is not None:
        return ["def counter_of(data):", f"    return data[{byte}]"]
    return ["def counter_of(data):", *_words([counter]), f"    return {_extract(counter, length)}"]


def _judging_source(
    name: str,
    length: int,
    chain: str | None,
    guard: Guard,
    counter: SignalField | None,
    good: str,
    bad: str,
) -> list[str]:
    """A function that yields one expression for a frame as it has to be, else another."""
    lines = [f"def {name}(data):", f"    if len(data) != {length}:", f"        return {bad}"]
    if chain is None:
        if tests := _guard_tests(guard, counter, length):
            good = f"{good} if {' and '.join(tests)} else {bad}"
            lines += _words([f for f in (guard.crc, guard.nibble) if f is not None])
        return [*lines, f"    return {good}"]
    return [
        *lines,
        f"    {''.join(f'b{i}, ' for i in range(length))} = data",
        f"    return {good} if {chain} == b{length - 1} ^ {crc8.FINAL_XOR} else {bad}",
    ]


def _guard_tests(guard: Guard, counter: SignalField | None, length: int) -> list[str]:
    tests = []
    if counter is not None and guard.counter_values < 1 << counter.length:
        tests.append(f"counter_of(data) < {guard.counter_values}")
    if guard.nibble is not None:
        tests.append(f"{_extract(guard.nibble, length)} == NIBBLE")
    if guard.crc is not None:
        tests.append(f"{_extract(guard.crc, length)} == checksum(rest(data), counter_of(data))")
    return tests


def around(f: SignalField, length: int) -> tuple[Callable[[bytes], bytes], Callable[[bytes, int], bytes]]:
    """What is left of a frame without a field, and how its value is put into a frame that has zeros there.

    Whole bytes are left out; a part of a byte counts as zeros.
    """
    order: Literal["big", "little"] = "big" if f.big_endian else "little"
    above, ones = shift(f, length), (1 << f.length) - 1
    span = _byte_span(f)

    def put(data: bytes, value: int) -> bytes:
        return (int.from_bytes(data, order) | value << above).to_bytes(length, order)

    def without(data: bytes) -> bytes:
        return (int.from_bytes(data, order) & ~(ones << above)).to_bytes(length, order)

    if span is None:
        return without, put
    first, last = span[0], sum(span)
    return lambda data: data[:first] + data[last:], put


def _crc_chain(can_id: int, body: int) -> str:
    """An expression for the shift register after the identifier and bytes b0 … b(body−1)."""
    text = str(crc8.identifier_state(can_id))
    for i in range(body):
        text = f"T[{text} ^ b{i}]"
    return text


def bounds(f: SignalField) -> tuple[float, float]:
    """Smallest and largest float that can be encoded, after `round` where it is no floating-point signal."""
    return (f.low, f.high) if f.floating else _rounding_to(f.low, f.high)


def _rounding_to(low: float, high: float) -> tuple[float, float]:
    """Smallest and largest float that `round` takes into [low, high]; ties go to even numbers."""
    least, most = low - 0.5, high + 0.5
    while round(least) < low:
        least = math.nextafter(least, math.inf)
    while round(most) > high:
        most = math.nextafter(most, -math.inf)
    return least, most


def _refusal(
    fields: Sequence[SignalField | None], counter: SignalField | None
) -> Callable[[tuple[float, ...], int], NoReturn]:
    def refuse(values: tuple[float, ...], count: int) -> NoReturn:
        for f, value in zip((*fields, counter), (*values, count), strict=True):
            if f is None:
                continue
            least, most = (f.low, f.high) if f.integer else bounds(f)
            if not least <= (value if f.integer else (value - f.offset) / f.scale) <= most:
                ends = sorted((f.low, f.high) if f.integer else (f.si(f.low), f.si(f.high)))
                raise ValueError(f"{f.label} = {value!r} is outside {ends[0]:.10g} … {ends[1]:.10g}")
        raise ValueError("a value is out of range")

    return refuse
