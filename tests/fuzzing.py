"""Input that nobody would send, arbitrary and nearly right: frames, messages, configurations, DBCs, logs."""

from __future__ import annotations

import json
import random
import re
from collections.abc import Iterator

from console_bench import COMMANDS, LOOKS, message
from pneud.bus.codec import Codec, Codecs
from pneud.bus.wire import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG
from pneud.console.protocol import VERBS, ProtocolError, parse

Bare = tuple[int, bytes]  # identifier with its flags, data

_NUMBERS = (
    "0",
    "-1",
    "1e308",
    "-1e-308",
    "nan",
    "inf",
    "1e400",
    "0x10",
    "1_0",
    "99999999999999999999",
    "0.1",
)
_WORDS = ('""', '"x"', "true", "[]", "{}", "[1, [2]]", "1979-05-27", "'''", '"\\u0000"', '"../../etc/passwd"')
_DBC_WORDS = (
    "BO_ 1 X: 8 V", ' SG_ A : 0|8@1+ (1,0) [0|0] "" V', "BO_ 385 ENCODER: 8 V", "CM_", "VAL_", "(0,0)", "@0-",
    "SIG_VALTYPE_ 385 Position : 1;", "m0", "M", "|64@1+", "0|0@1+", "(nan,inf)", '"m"', "-1", "BU_:", "8",
)  # fmt: skip
_DIGITS = (
    b"0",
    b"-1",
    b"99999999999999999999999",
    b"1e9",
    b"7FF",
    b"800",
    b"00",
    b"4294967296",
    b"-0",
    b"x",
    b"1.5",
)
_ODDITIES = (
    b"\0",
    b"\xff",
    "µ".encode(),
    b"\xb5",
    b"#",
    b"##",
    b"R",
    b"//",
    b"\t",
    b"(",
    b" ",
    b"\x1b",
    b"Rx",
    b"_B",
)
_SIZES = (0, 1, 15, 16, 31, 32, 47, 49, 64, 4096, 1 << 20, (1 << 31) - 1, 1 << 31, (1 << 32) - 1)


def frames(codecs: Codecs, seed: int) -> Iterator[Bare]:
    """Frames without end; `own` ones among them, such as SYNC, so not for a bus that must go on running."""
    rng = random.Random(seed)
    roles = _roles(codecs)
    while True:
        kind = rng.random()
        if kind < 0.25:
            yield rng.choice((rng.getrandbits(32), rng.getrandbits(11))), rng.randbytes(rng.randrange(9))
        elif kind < 0.35:
            node, code = rng.choice((1, 2, 3, rng.randrange(128))), rng.choice((0, rng.getrandbits(16)))
            if rng.random() < 0.5:
                yield 0x080 + node, (code.to_bytes(2, "little") + rng.randbytes(6))[: rng.randrange(9)]
            else:
                state = bytes((rng.choice((0, 4, 5, 127, rng.randrange(256))),))
                yield 0x700 + node, state[: rng.randrange(2)]
        elif kind < 0.45:
            classes = rng.choice((0x4, 0x40, 0x100, 0x88, rng.getrandbits(29)))
            yield CAN_ERR_FLAG | classes, rng.randbytes(rng.choice((8, 8, 8, rng.randrange(9))))
        else:
            yield _of_role(rng, rng.choice(roles))


def strangers(codecs: Codecs, seed: int) -> Iterator[Bare]:
    """Frames without end under identifiers that mean nothing to an axis; some look like those that do."""
    rng = random.Random(seed)
    roles = _roles(codecs)
    ours = {codec.can_id for codec in roles}
    while True:
        can_id = rng.choice((rng.getrandbits(11), rng.getrandbits(29) | CAN_EFF_FLAG))
        if can_id not in ours and not 0x080 <= can_id < 0x100 and not 0x700 <= can_id < 0x780:
            codec = rng.choice(roles)
            yield can_id, rng.choice((_encoded(rng, codec) or b"", rng.randbytes(rng.randrange(9))))


def _roles(codecs: Codecs) -> tuple[Codec, ...]:
    return codecs.encoder, codecs.pressure, codecs.valve_status, codecs.valve_command, codecs.sync


def _of_role(rng: random.Random, codec: Codec) -> Bare:
    """A frame of ours: right, or with its bits, its length or its flags wrong."""
    data = rng.randbytes(codec.length)
    if rng.random() < 0.7:  # values that may even be possible, with the right checksum
        data = _encoded(rng, codec) or data
    kind = rng.random()
    if kind < 0.2 and data:
        bit = rng.randrange(8 * len(data))
        data = (int.from_bytes(data, "little") ^ 1 << bit).to_bytes(len(data), "little")
    elif kind < 0.3:
        data = data[: rng.randrange(len(data) + 1)]
    can_id = codec.can_id
    if kind > 0.95:
        can_id |= rng.choice((CAN_EFF_FLAG, CAN_RTR_FLAG, CAN_ERR_FLAG))
    return can_id, data


def _encoded(rng: random.Random, codec: Codec) -> bytes | None:
    decoded = codec.decode(rng.randbytes(codec.length))
    near = [
        value * rng.choice((0.0, 1e-3, 1.0, 1.0)) if isinstance(value, float) else value for value in decoded
    ]
    try:
        return codec.encode(*near, counter=rng.getrandbits(8) % codec.counter_values)
    except ValueError:
        return None


def hostile(dice: random.Random) -> bytes:
    """A line, or what is meant to be mistaken for one."""
    verb = dice.choice([verb for verb in VERBS if verb not in LOOKS])
    fields = {**message(verb), **COMMANDS.get(verb, {})}
    match dice.randrange(7):
        case 0:
            return dice.randbytes(dice.randrange(300))
        case 1:
            return json.dumps(fields).encode()[: dice.randrange(40)]
        case 2:
            fields[dice.choice(list(fields))] = dice.choice(
                [None, "", [], {}, -1, True, 1e308, 10**400, "\ud800"]
            )
        case 3:
            fields["x_mm"] = dice.choice([-1e9, 1e5, float("nan"), float("-inf")])
        case 4:
            return b'{"v":1,"id":1,"verb":"' + dice.randbytes(20) + b'"}'
        case 5:
            return b"[" * dice.randrange(300) + json.dumps(fields).encode("utf-16")
        case 6:
            fields[dice.choice("abc")] = 1
    return json.dumps(fields).encode()


def well_formed(line: bytes) -> bool:
    try:
        parse(line)
    except ProtocolError:
        return False
    return True


def configuration(text: str, rng: random.Random) -> bytes:
    """A configuration with something wrong somewhere, or no configuration at all."""
    if rng.random() < 0.1:
        return rng.randbytes(rng.randrange(400))
    lines = text.splitlines()
    for _ in range(rng.choice((1, 1, 1, 3, 10))):
        n = rng.randrange(len(lines))
        kind = rng.randrange(6)
        if kind == 0:
            lines[n] = re.sub(r"=.*", lambda _: f"= {rng.choice(_NUMBERS + _WORDS)}", lines[n])
        elif kind == 1:
            lines.insert(n, lines[rng.randrange(len(lines))])
        elif kind == 2 and len(lines) > 1:
            del lines[n]
        elif kind == 3:
            lines[n] = re.sub(r"^\w+", lambda _: f"k{rng.randrange(100)}", lines[n])
        elif kind == 4:
            lines[n] = re.sub(
                r"[\d.]+", lambda m: f"{rng.choice(('-', ''))}{m[0]}{rng.choice('e0.9')}", lines[n]
            )
        else:
            lines.insert(n, rng.choice(("[limits]", "[a.b]", "[[x]]", "[", "=", "x", "\t", "]", '"')))
    return _damaged("\n".join(lines).encode(), rng, 0.1)


def database(text: str, rng: random.Random) -> bytes:
    """A DBC with something wrong somewhere, or no DBC at all."""
    if rng.random() < 0.1:
        return rng.randbytes(rng.randrange(400))
    words = re.split(r"(\s+)", text)
    for _ in range(rng.choice((1, 1, 2, 10))):
        n = rng.randrange(len(words))
        kind = rng.randrange(4)
        if kind == 0:
            words[n] = rng.choice(_DBC_WORDS)
        elif kind == 1 and len(words) > 1:
            del words[n]
        elif kind == 2:
            words.insert(n, words[rng.randrange(len(words))])
        else:
            words[n] = re.sub(r"\d+", lambda _: str(rng.choice((0, 1, 7, 8, 63, 64, 65, 2048))), words[n])
    return _damaged("".join(words).encode(), rng, 0.1)


def log(data: bytes, rng: random.Random) -> bytes:
    """A log that was cut off, has flipped bits or foreign bytes in it, or is none at all."""
    if rng.random() < 0.05:
        return rng.randbytes(rng.randrange(4000))
    if rng.random() < 0.3:
        data = data[: rng.randrange(len(data))]
    return _damaged(data, rng, 0.9)


def lines(data: bytes, rng: random.Random) -> bytes:
    """A text as others find it: lines lost, doubled, elsewhere, with something wrong in them, cut short."""
    rows = data.splitlines(keepends=True)
    for _ in range(rng.choice((1, 1, 2, 5, 20))):
        if not rows:
            break
        n = rng.randrange(len(rows))
        row = rows[n]
        match rng.randrange(10):
            case 0:
                del rows[n : n + rng.choice((1, 1, 10))]
            case 1:
                rows[n:n] = rows[rng.randrange(len(rows)) :][: rng.choice((1, 1, 10))]
            case 2:
                rows[n] = re.sub(rb"\d+", lambda _: rng.choice(_DIGITS), row, count=rng.choice((1, 2, 9)))
            case 3:
                words = row.split(b" ")
                rng.shuffle(words)
                rows[n] = b" ".join(words)
            case 4:
                at = rng.randrange(len(row) + 1)
                rows[n] = row[:at] + rng.choice(_ODDITIES) + row[at + rng.randrange(3) :]
            case 5:
                rows[n] = row[: rng.randrange(len(row) + 1)] + rng.choice((b"", b"\n"))
            case 6:
                rows.insert(n, rng.choice(_ODDITIES) * rng.choice((1, 50, 2000)) + b"\n")
            case 7:
                rows[n] = rng.randbytes(rng.randrange(60)) + b"\n"
            case 8:
                rows[n] = row.replace(b"\n", rng.choice((b"\r\n", b"\r", b"\0", b"")))
            case 9:
                other = rng.randrange(len(rows))
                rows[n], rows[other] = rows[other], row
    whole = b"".join(rows)
    match rng.randrange(12):
        case 0:
            return whole[: rng.randrange(len(whole) + 1)]
        case 1:
            return rng.choice((b"\xef\xbb\xbf", b"\xff\xfe", b"\0" * 9)) + whole
        case 2:
            return whole + bytes(rng.choice((1, 500, 70_000)))
    return _damaged(whole, rng, 0.2)


def binary(data: bytes, rng: random.Random) -> bytes:
    """Bytes as others find them: some wrong, some lost, some doubled, some zero, cut short."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 3))):
        at = rng.randrange(len(changed) + 1)
        size = rng.choice((1, 8, 48, 500, rng.randrange(1, 2000)))
        match rng.randrange(6):
            case 0:
                del changed[at : at + size]
            case 1:
                changed[at:at] = changed[rng.randrange(len(changed) + 1) :][:size]
            case 2:
                changed[at : at + size] = bytes(len(changed[at : at + size]))
            case 3:
                changed[at : at + 4] = rng.choice(_SIZES).to_bytes(4, "little")
            case 4:
                del changed[at:]
            case 5:
                return _damaged(bytes(changed), rng, 1.0)
    return bytes(changed)


def _damaged(data: bytes, rng: random.Random, likely: float) -> bytes:
    changed = bytearray(data)
    if changed and rng.random() < likely:
        for _ in range(rng.choice((1, 1, 5, 100))):
            at = rng.randrange(len(changed))
            kind = rng.randrange(4)
            if kind < 2:
                changed[at] ^= 1 << rng.randrange(8)
            elif kind == 2:
                changed[at : at + rng.randrange(20)] = rng.randbytes(rng.randrange(20))
            else:
                changed[at : at + 8] = rng.choice((bytes(8), b"\xff" * 8))
            if not changed:
                break
    return bytes(changed)
