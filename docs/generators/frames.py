"""docs/frames.md: the frames on the bus, as `pneud.dbc` and the default roles have them."""

from __future__ import annotations

import re
from collections.abc import Iterator

from generators.tables import HEAD, table
from pneud.bus.codec import ROLES
from pneud.bus.database import MessageSpec, Signal, messages
from pneud.bus.wire import wire_time_ns
from pneud.config.bus_tables import FramesConfig
from pneud.resources import configs
from pneud.signals import EncoderStatus, ValveState

DBC = configs() / "pneud.dbc"
BITRATE_BIT_S = 1e6

_TEXT = """\
# Frames

{head}

Classic CAN, 1 Mbit/s, identifiers of 11 bits. What follows is `configs/pneud.dbc`, which comes with pneud; a rig with other devices
brings a DBC of its own and names messages and signals under [`[bus.frames]`](configuration.md#busframesrole):
[connect a device](device.md) does that. What a DBC cannot say, the checksum and who answers what, stands in
[the firmware of a node](firmware.md).

## A tick

1. The controller sends `SYNC`.
2. The three nodes sample when they have received it, and answer: `ENCODER`, `PRESSURE`, `VALVE_STATUS`, in whatever order.
3. When the set is complete, or a part of the period is over (`loop.set_deadline`, 0.8 of it), the controller computes and sends
   `VALVE_COMMAND`: in every tick and every state, with 0 V and `Enable` 0 unless the axis is engaged.

With `bus.sync = false` sensors run free: no SYNC has to be answered, none is sent, and the newest frames count.

Positive voltage fills chamber 1, at the cap end, and moves the piston to larger positions. Position 0 is at the rear end stop.
Pressures are absolute.

## Messages

{messages}

At {mbit:g} Mbit/s the five of a tick take {set_us:.0f} µs of the wire, stuffing of 10 % included: {load:.0f} % of it at 1 kHz. A
configuration that would fill the bus is refused.

## Signals

Bits count from the least significant one of byte 0, and all numbers are little-endian.

{signals}

`Status` has the bits {status}; `State` is {states}.

## What is heard besides

| frame | what becomes of it |
|---|---|
{heard}

`node` and `heartbeat_timeout_ms` of [a role](configuration.md#busframesrole) say whose count. Anything else on the bus is left
alone. Another sender of `SYNC` or `VALVE_COMMAND` is [the fault](safety.md#faults) `other_controller`.

## Carriers

| `--bus` | what | for |
|---|---|---|
| `socketcan:can0` | the rig's interface | the rig |
| `socketcan:vcan0` | SocketCAN without hardware | hardware-in-the-loop where the kernel has it |
| `unixcan:NAME` | frames between processes of one user, over Unix sockets; nothing leaves the machine | laptops, containers, CI |
| `auto` | `vcan0` if it is there and idle, else `unixcan` | the default of `pneud --virtual` |

`unixcan` is an interface of python-can, so that its tools work on it: [several programs on one bus](buses.md). A virtual run never
touches a rig: `pneud --virtual` and `pneud plant` refuse a SocketCAN interface that is no vcan, and a bus that carries SYNC or
valve commands already.
"""


def _kind(signal: Signal) -> str:
    return f"{'i' if signal.signed else 'u'}{signal.length}"


def _si(number: float) -> str:
    return f"{number:.12g}"


def _signals(specs: dict[str, MessageSpec]) -> Iterator[tuple[str, ...]]:
    for role, frame in FramesConfig():
        spec = specs[frame.message]
        values = {signal: value for value, signal in frame.signals.items()}
        for signal in spec.signals:
            value = values.get(signal.name, "")
            needed = "required" if value and ROLES[role][value] is None else ""
            jobs = {frame.counter: "counter", frame.crc: "checksum"}
            yield (
                f"`{spec.name}.{signal.name}`",
                f"{signal.start}",
                _kind(signal),
                _si(signal.scale) if signal.scale != 1 or signal.unit else "",
                signal.unit or "",
                f"`{value}`" if value else jobs.get(signal.name, ""),
                needed,
            )


def _senders() -> dict[str, str]:
    """Who sends which message, by the DBC."""
    return dict(re.findall(r"^BO_ \d+ (\w+): \d+ (\w+)", DBC.read_text(encoding="utf-8"), re.MULTILINE))


def _heard(specs: dict[str, MessageSpec]) -> Iterator[tuple[str, str]]:
    emcy = [f"`{s.name}` 0x{s.can_id:03X}" for s in specs.values() if s.name.startswith("EMCY")]
    beats = [f"`{s.name}` 0x{s.can_id:03X}" for s in specs.values() if s.name.startswith("HEARTBEAT")]
    yield (
        ", ".join(emcy),
        "CANopen emergency of a node: error code (u16), register (u8). Other than 0 is `emergency`",
    )
    yield (
        ", ".join(beats),
        "CANopen NMT state of a node; supervised where a time-out is configured, and only *operational* (5) counts",
    )


def text() -> str:
    """The page."""
    specs = {spec.name: spec for spec in messages(DBC.read_bytes())}
    senders = _senders()
    used = [specs[frame.message] for _, frame in FramesConfig()]
    times = [wire_time_ns(spec.length, BITRATE_BIT_S) * 1e-3 for spec in used]
    rows = [
        (
            f"0x{spec.can_id:03X}",
            f"`{spec.name}`",
            role,
            senders[spec.name].lower().replace("_", " "),
            f"{spec.length}",
            f"{us:.0f} µs",
        )
        for spec, us, (role, _) in zip(used, times, FramesConfig(), strict=True)
    ]
    return _TEXT.format(
        head=HEAD.format(name="frames"),
        messages=table(("identifier", "message", "role", "from", "bytes", "on the wire"), rows),
        mbit=BITRATE_BIT_S * 1e-6,
        set_us=sum(times),
        load=sum(times) / 10.0,
        signals=table(
            ("signal", "first bit", "type", "factor", "unit", "role's value", ""), list(_signals(specs))
        ),
        status=", ".join(f"{bit.value} {(bit.name or '').lower()}" for bit in EncoderStatus),
        states=", ".join(f"{state.value} {state.name.lower()}" for state in ValveState),
        heard="\n".join(f"| {frame} | {what} |" for frame, what in _heard(specs)),
    )


if __name__ == "__main__":
    print(text(), end="")
