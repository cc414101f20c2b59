"""docs/firmware.md: what a node's firmware has to do, with test vectors that pneud's own codecs compute."""

from __future__ import annotations

from collections.abc import Iterator

from generators.frames import DBC
from generators.tables import HEAD, table
from pneud.bus.codec import Codec, Codecs, load_codecs
from pneud.bus.crc8 import FINAL_XOR, POLYNOMIAL, START, crc8, identifier_state, update
from pneud.bus.lag import AGREE, MOST
from pneud.bus.protection import RULES as BITS
from pneud.bus.protection import checksum
from pneud.config.bus_tables import BusConfig
from pneud.config.protection import DataIdMode, Protection
from pneud.rig.valvenode import ValveNode
from pneud.signals import ValveState

_MS = 1_000_000
_TIMEOUT_S, _U_MAX_V = 0.005, 5.0

_TEXT = """\
# The firmware of a node

{head}

For whoever programs an encoder, pressure or valve node that talks to pneud with the frames of [`configs/pneud.dbc`](frames.md).
Every number on this page comes out of the codecs and the software rig that pneud itself uses, so that firmware which
reproduces it will be understood. A device that is already there, and has no checksum or counter, can be used as it is:
[connect a device](device.md).

## In short

1. Sample when SYNC has been received. Answer it once, as soon as possible: within `loop.set_deadline`, 0.8 of a period.
2. Count each answer: `Counter` goes up by one, and wraps.
3. Put the checksum into the last byte.
4. An answer that is too late for its SYNC is better not sent than sent in the next period.
5. A valve node centres itself when no valid command has come for its time-out, whatever else happens. pneud relies on that for its
   own death.

## The checksum

CRC-8 SAE J1850: polynomial 0x{polynomial:02X}, start value 0x{start:02X}, final xor 0x{final:02X}, neither input nor output reflected.
It goes over the identifier's low byte, its high byte, and then all data bytes but the last, which holds it. So a frame that
turns up under another identifier is not believed.

| bytes | CRC |
|---|---|
{checks}

In C, without a table:

```c
#include <stdint.h>

uint8_t pneud_crc(uint16_t identifier, const uint8_t *data, unsigned bytes)
{{
    uint8_t crc = 0x{start:02X};
    for (unsigned i = 0; i < bytes + 2; i++) {{
        crc ^= i == 0 ? identifier & 0xFF : i == 1 ? identifier >> 8 : data[i - 2];
        for (unsigned bit = 0; bit < 8; bit++)
            crc = crc & 0x80 ? (uint8_t)(crc << 1) ^ 0x{polynomial:02X} : (uint8_t)(crc << 1);
    }}
    return crc ^ 0x{final:02X};
}}
```

`bytes` is the frame's length less one: `frame[7] = pneud_crc(0x181, frame, 7)`.

## Test vectors

Whole frames, byte 0 first. A receiver has to accept each and, SYNC apart, nothing that differs from one in a single bit.

{vectors}

## The counter

* It goes up by one with every frame that is sent under this identifier, and wraps from its last value to 0 (`Counter` of 8 bits: from 255).
  It may start anywhere; a node that boots may begin with 0 again.
* It counts frames, not SYNCs: a SYNC that is not answered is not counted. pneud counts its SYNCs and learns the distance between both
  in {agree} frames; from then on the counter says which SYNC a frame answers, up to {most} periods back, whatever was lost on the way.
* A counter that stands still means that the node repeats itself, and such frames are not used. What CAN itself repeats on the wire is
  no frame of its own.
* `SYNC.Counter` is 1 … 240, as in CANopen, and `VALVE_COMMAND.Sequence` repeats that of the SYNC whose answers led to this command. Neither
  has to be looked at.

[Another rule](#other-rules) may have the counter come round elsewhere: `counter_max` is its last value.

What pneud makes of a node that does otherwise, in every tick, and for how long before it is [a fault](safety.md#faults):

| frame | is | for longer than |
|---|---|---|
| none | missing | `bus.sensor_timeout_ms` |
| of another length, or with a wrong checksum | corrupt, and not used | the same |
| with the counter of the frame before | frozen, and not used | the same |
| that answers an earlier SYNC, by its stamp, its age or its counter | late, and not used | the same |
| more than SYNC asked for | a second device with the same identifier: `identifier_clash` | 8 frames |

## Other rules

A node that protects its frames by a rule of its own keeps it: `protection` names it, `crc` and `counter` the signals, which may lie
anywhere in the frame. The keys belong to [a role](configuration.md#busframesrole), or to [a message](mapping.md) where signals are mapped. The checksum goes over all bytes but its own; of one that is no whole
bytes, its bits count as zeros. What is no CRC notices less: two errors in one column of bits make an XOR right again.

{rules}

The counter is as wide as its signal and wraps from its last value, or from `counter_max`, to 0. AUTOSAR's rules demand theirs:

| rule | counter | `data_id`, which is not in the frame |
|---|---|---|
| `e2e-p01` | 4 bits, 0 … 14 | 16 bits; `data_id_mode`: `both` bytes, the lower one first; `alternating`, the lower one with an even counter, else the higher one; `low`, the lower one only; `nibble`, the lower one and a zero byte, and bits 8 … 11 are in the frame, in the signal `data_id_nibble` |
| `e2e-p02` | 4 bits, 0 … 15 | sixteen of 8 bits, one for each value of the counter |
| `e2e-p05` | 8 bits, 0 … 255 | 16 bits, the lower byte first |

```toml
[bus.frames.encoder]
message = "X25_POSITION"
signals = {{ position_m = "Pos" }}
counter = "Alive"
crc = "Checksum"
protection = "e2e-p01"
data_id = 0x123
```

Frames of eight bytes: the checksum in front, the lower byte first where it has two; behind it the counter in the lower half of a
byte, and with `nibble` 1 in the upper one. `data_id` is 0x123 of profile 1, 1 … 16 of profile 2, 0x1234 of profile 5. Those of
zeros are also what other programs have: the second one of profile 2 is table 6.28 of AUTOSAR's *E2E Protocol Specification* R20-11, and
the Python library [`autosar-e2e`](https://pypi.org/project/autosar-e2e/) tests itself with those of profiles 1 and 5.

{others}

A node that goes by another rule than the configuration, or by other identifiers, takes no command and stays centred: the axis stops with
`valve_rebooted`. What it sends is `corrupt`.

In C, none of it with a table:

```c
#include <stdint.h>

uint8_t crc8(uint8_t polynomial, uint8_t crc, const uint8_t *data, unsigned bytes)
{{
    while (bytes--) {{
        crc ^= *data++;
        for (unsigned bit = 0; bit < 8; bit++)
            crc = crc & 0x80 ? (uint8_t)(crc << 1) ^ polynomial : (uint8_t)(crc << 1);
    }}
    return crc;
}}

uint16_t crc16(uint16_t polynomial, uint16_t crc, const uint8_t *data, unsigned bytes)
{{
    while (bytes--) {{
        crc ^= (uint16_t)(*data++ << 8);
        for (unsigned bit = 0; bit < 8; bit++)
            crc = crc & 0x8000 ? (uint16_t)(crc << 1) ^ polynomial : (uint16_t)(crc << 1);
    }}
    return crc;
}}

/* The checksum of profile 1 in byte 0, both bytes of the identifier taken in. */
uint8_t e2e_p01(uint16_t data_id, const uint8_t *frame, unsigned bytes)
{{
    const uint8_t id[] = {{ data_id & 0xFF, data_id >> 8 }};
    return crc8(0x1D, crc8(0x1D, 0, id, 2), frame + 1, bytes - 1);
}}

/* Of profile 2 in byte 0, the counter in byte 1. */
uint8_t e2e_p02(const uint8_t data_id[16], const uint8_t *frame, unsigned bytes)
{{
    return crc8(0x2F, crc8(0x2F, 0xFF, frame + 1, bytes - 1), data_id + (frame[1] & 15), 1) ^ 0xFF;
}}

/* Of profile 5 in bytes 0 and 1. */
uint16_t e2e_p05(uint16_t data_id, const uint8_t *frame, unsigned bytes)
{{
    const uint8_t id[] = {{ data_id & 0xFF, data_id >> 8 }};
    return crc16(0x1021, crc16(0x1021, 0xFFFF, frame + 2, bytes - 2), id, 2);
}}
```

`pneud map` tells by the frames of a node that is on the bus, or was when it was recorded, which rule it has, and which `data_id`
([connect a device](device.md)).

## Encoder and pressure node

* `Position`, `P1`, `P2` and `Supply` are rounded to the nearest step. They are what was sampled after this SYNC, not a mean of the last
  period: the law aligns what it is told in time, and a filter that it knows nothing of is a delay.
* `Age` is the time from sampling to the hand-over of the frame to the CAN controller, in steps of 10 µs; {older} stands for that and
  more, and such a frame is late. A node that answers at once may leave it 0.
* `Status` bit 0 says that the position has its zero. An encoder that loses it clears the bit, and the valve of an engaged axis is centred. Of
  an incremental one (`encoder.kind`) pneud keeps the zero itself, once [`pneud home`](console.md#verbs) has found the stop: it counts on from
  wherever it started. Bit 2 is an error, and centres the valve at once.

## Valve node

`Voltage` is signed about the valve's centre: 0 is the centre, whatever the amplifier has to put out for it (5 V on a valve of
0 … 10 V). `Applied` is what the DAC puts out at the moment of this SYNC, in the same sense.

A command is *valid* where length, checksum and counter (another one than before) are right and `Enable` is 0 or 1. Everything else
changes nothing, not even the time-out.

| state | | leaves it |
|---|---|---|
| {boot} `boot` | centred | with the first valid command, as from `centred`; pneud begins with `Enable` 0 |
| {centred} `centred` | centred | with a valid command and `Enable` 1, to `enabled` |
| {enabled} `enabled` | puts out `Voltage`, as soon as a command is received | with `Enable` 0, to `centred`; with the time-out, to `timed_out` |
| {timed_out} `timed_out` | centred | with a valid command and `Enable` **0**, to `centred`; `Enable` 1 does not help |
| {fault} `fault` | centred | never |

The time-out is the configuration's `bus.valve_timeout_ms`, five ticks and at least 5 ms on a rig; the node's own has to be the same.

A conversation with the node of the software rig, its time-out {timeout_ms:g} ms:

{trace}

## Try it

`pneud plant --bus socketcan:vcan0` is a whole set of such nodes, to compare with. Firmware on a bench can be heard with the daemon alone, the
supply shut: `pneud --config rig.toml --headless` sends SYNC and centred commands and stays disarmed, `pneud status` names what is
wrong with each node, and the log has every frame with its stamp ([your own rig](rig.md)).
"""


def _hex(data: bytes) -> str:
    return data.hex(" ").upper()


def _checks() -> Iterator[tuple[str, str]]:
    """Check values of the checksum alone."""
    yield '`"123456789"`, in ASCII', f"0x{crc8(b'123456789'):02X}"
    for identifier in (0x181, 0x203):
        said = f"`{_hex(identifier.to_bytes(2, 'little'))}` and seven zero bytes: a frame 0x{identifier:03X} of zeros"
        yield said, f"0x{update(bytes(7), identifier_state(identifier)) ^ FINAL_XOR:02X}"


def _vectors(codecs: Codecs) -> Iterator[tuple[str, str, str]]:
    """Frames and what they say."""

    def row(codec: Codec, said: str, *values: float, counter: int) -> tuple[str, str, str]:
        return f"`{codec.can_id:03X}`", f"`{_hex(codec.encode(*values, counter=counter))}`", said

    yield row(codecs.sync, "SYNC, counter 1", counter=1)
    yield row(codecs.encoder, "position 0.5 m, referenced, counter 0", 0.5, 1, 0.0, counter=0)
    yield row(
        codecs.encoder, "position −1 µm, referenced, age 120 µs, counter 255", -1e-6, 1, 120e-6, counter=255
    )
    yield row(
        codecs.pressure, "3.2 and 2.8 bar, supply 7 bar (absolute), counter 17", 3.2e5, 2.8e5, 7e5, counter=17
    )
    yield row(codecs.valve_status, "0 V, centred, counter 1", 0.0, ValveState.CENTRED, counter=1)
    yield row(codecs.valve_status, "−1.25 V, enabled, counter 2", -1.25, ValveState.ENABLED, counter=2)
    yield row(codecs.valve_command, "0 V, not enabled, SYNC 1, counter 0", 0.0, 0, 1, counter=0)
    yield row(codecs.valve_command, "+1 V, enabled, SYNC 2, counter 1", 1.0, 1, 2, counter=1)
    yield row(codecs.valve_command, "−5 V, enabled, SYNC 240, counter 239", -5.0, 1, 240, counter=239)


RULES: tuple[tuple[Protection, str, str], ...] = (
    (
        "pneud",
        "CRC-8, polynomial 0x1D, start 0xFF, final xor 0xFF",
        "identifier, low byte first (two bytes; four of 29 bits), and data",
    ),
    ("sae-j1850", "the same", "data"),
    ("crc8-h2f", "CRC-8, polynomial 0x2F, start 0xFF, final xor 0xFF", "data"),
    ("crc16-ccitt", "CRC-16, polynomial 0x1021, start 0xFFFF, no final xor", "data"),
    ("xor8", "exclusive or", "data"),
    ("sum8", "sum, its lower 8 bits", "data"),
    ("e2e-p01", "CRC-8, polynomial 0x1D, start 0, no final xor", "`data_id`, and data"),
    ("e2e-p02", "as `crc8-h2f`", "data, and `data_id` of the counter"),
    ("e2e-p05", "as `crc16-ccitt`", "data, and `data_id`"),
)
IDS = {"e2e-p01": (0x123,), "e2e-p02": tuple(range(1, 17)), "e2e-p05": (0x1234,)}
MODES: tuple[DataIdMode, ...] = ("both", "alternating", "low", "nibble")
ZEROS, OTHER = bytes(6), bytes.fromhex("11 22 33 44 55 66")


def _others() -> Iterator[tuple[str, str, str]]:
    """Frames by each rule: of zeros with the counters 0 and 1, and another one."""
    for name, _, _ in RULES:
        for mode in MODES if name == "e2e-p01" else MODES[:1]:
            sums, bits = checksum(name, 0x181, IDS.get(name, ()), mode), BITS[name].bits
            frames = []
            for counter, data in ((0, ZEROS), (1, ZEROS), (14, OTHER)):
                rest = bytes((counter | (0x10 if mode == "nibble" else 0),)) + data[: 7 - bits // 8]
                frames.append(f"`{_hex(sums(rest, counter).to_bytes(bits // 8, 'little') + rest)}`")
            yield f"`{name}`", mode if name == "e2e-p01" else "", "<br>".join(frames)


def _trace(codec: Codec) -> Iterator[tuple[str, str, str, str]]:
    """What a valve node does, step by step."""
    node = ValveNode(codec, _TIMEOUT_S, 16, _U_MAX_V)

    def now(t_ms: float, said: str) -> tuple[str, str, str, str]:
        return f"{t_ms:g}", said, f"`{ValveState(node.state).name.lower()}`", f"{node.output_v:.4g} V"

    def told(t_ms: int, voltage_v: float, enable: int, counter: int, said: str) -> tuple[str, str, str, str]:
        node.command(codec.encode(voltage_v, enable, 1 + t_ms % 240, counter=counter), t_ms * _MS)
        return now(t_ms, said)

    yield now(0, "switched on")
    yield told(1, 0.0, 0, 0, "0 V, `Enable` 0, counter 0")
    yield told(2, 2.5, 1, 1, "2.5 V, `Enable` 1, counter 1")
    wrong = bytearray(codec.encode(4.0, 1, 4, counter=2))
    wrong[0] ^= 1
    node.command(bytes(wrong), 3 * _MS)
    yield now(3, "4 V, `Enable` 1, counter 2, one bit wrong")
    yield told(4, 4.0, 1, 1, "4 V, `Enable` 1, counter 1 again")
    deadline_ms = node.deadline_ns / _MS
    node.expire()
    yield now(deadline_ms, "nothing valid since 2 ms")
    yield told(8, 2.5, 1, 3, "2.5 V, `Enable` 1, counter 3")
    yield told(9, 0.0, 0, 4, "0 V, `Enable` 0, counter 4")
    yield told(10, 1.0, 1, 5, "1 V, `Enable` 1, counter 5")


def text() -> str:
    """The page."""
    codecs = load_codecs(BusConfig(), DBC)
    return _TEXT.format(
        head=HEAD.format(name="firmware"),
        polynomial=POLYNOMIAL,
        start=START,
        final=FINAL_XOR,
        checks="\n".join(f"| {said} | {crc} |" for said, crc in _checks()),
        vectors=table(("identifier", "data", "says"), list(_vectors(codecs))),
        agree=AGREE,
        most=MOST,
        rules=table(("rule", "checksum", "over"), [(f"`{name}`", how, over) for name, how, over in RULES]),
        others=table(("rule", "`data_id_mode`", "frames"), list(_others())),
        older=round(codecs.older_s / 1e-5),
        timeout_ms=_TIMEOUT_S * 1e3,
        trace=table(("ms", "what", "state", "puts out"), list(_trace(codecs.valve_command))),
        **{state.name.lower(): int(state) for state in ValveState},
    )


if __name__ == "__main__":
    print(text(), end="")
