"""The frames of configured nodes, as the DBC that everything else reads."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from typing import NamedTuple

from pneud.canopen import objects
from pneud.canopen.objects import Object, Pdo
from pneud.config.models import Config
from pneud.config.nodes import SIGNALS, NodeConfig, Role

UNITS = {"Pa": 0x00220000, "hPa": 0x02220000, "kPa": 0x03220000, "mbar": 0xFD4E0000, "bar": 0x004E0000}
"""Of CiA 303-2: prefix, numerator."""
_PA = {"Pa": 1, "hPa": 100, "kPa": 1000, "mbar": 100, "bar": 100_000}
_MOST_RAW = 32767
_STATE_BITS, _ENABLE_BITS = 5, 4  # of status and control word, as far as they are used


class Carried(NamedTuple):
    """One object in a PDO, and the signal that it is."""

    object: Object
    signal: str = ""  # none: it is carried along
    bits: int = 0  # of it that are used; 0: all
    factor: Fraction = Fraction(1)
    offset: Fraction = Fraction(0)
    unit: str = ""
    most_v: float = 0.0  # either way; 0: all that it can carry


class Message(NamedTuple):
    """One PDO of a node."""

    node: int
    pdo: Pdo
    name: str
    carried: tuple[Carried, ...]

    @property
    def can_id(self) -> int:
        """Its identifier."""
        return self.pdo.can_id(self.node)

    @property
    def length(self) -> int:
        """Its bytes."""
        return sum(c.object.type.size for c in self.carried)


def messages_of(node: NodeConfig, u_max_v: float) -> tuple[Message, ...]:
    """The PDOs of a node: what it sends in every tick, and what a valve is sent.

    Args:
        node: its configuration.
        u_max_v: the valve's full command [V].
    """
    if node.profile == "valve408":
        return _of_valve(node, u_max_v)
    found, channel = [], 0
    for number, (name, roles) in enumerate(node.sent().items(), node.carrier):
        carried = tuple(_channel(node, channel + n, role) for n, role in enumerate(roles, 1))
        found.append(Message(node.id, Pdo(number, True), name, carried))
        channel += len(roles)
    return tuple(found)


def _of_valve(node: NodeConfig, u_max_v: float) -> tuple[Message, ...]:
    volt = _exact(u_max_v) / node.full_scale
    # half a step more, which a rounded factor may take away
    most_v = float(volt * (node.full_scale + Fraction(1, 2)))
    status = Carried(objects.STATUS_WORD, "State", _STATE_BITS)
    actual = Carried(objects.ACTUAL_VALUE, "Applied", 0, volt, unit="V", most_v=most_v)
    control = Carried(objects.CONTROL_WORD, "Enable", _ENABLE_BITS)
    setpoint = Carried(objects.SETPOINT, "Voltage", 0, volt, unit="V", most_v=most_v)
    (sent,) = node.sent()
    return (
        Message(node.id, Pdo(node.carrier, True), sent, (status, actual)),
        Message(node.id, Pdo(1, False), node.command, (control, setpoint)),
    )


def _channel(node: NodeConfig, number: int, role: Role) -> Carried:
    signal = SIGNALS.get(role, "")
    if node.profile == "encoder406":
        return Carried(objects.POSITION, signal, 0, _exact(node.step_m), unit="m")
    if node.profile == "analog404":
        factor = Fraction(_PA[node.unit], 10**node.digits)
        return Carried(objects.field_value(number, wide=node.wide), signal, 0, factor, unit="Pa")
    low, high = map(_exact, node.range_pa)
    return Carried(objects.analog_input(number), signal, 0, (high - low) / _MOST_RAW, low, "Pa")


def _exact(value: float) -> Fraction:
    return Fraction(str(value))


def dbc_of(config: Config) -> str:
    """The DBC of a configuration's nodes; the same nodes give the same text.

    Names are those of `config.nodes`: SYNC, and a message for each PDO in use.
    """
    u_max_v = config.valve.u_max_v
    lines = ['VERSION "pneud nodes 1"', "", "NS_ :", "", "BS_:", ""]
    lines += [f"BU_: CONTROLLER {' '.join(f'NODE{node.id}' for node in config.bus.nodes)}", ""]
    lines += [f"BO_ {objects.SYNC_ID} SYNC: 0 CONTROLLER", ""]
    for node in config.bus.nodes:
        for message in messages_of(node, u_max_v):
            lines += [*_lines(message), ""]
    return "\n".join(lines)


def _lines(message: Message) -> Iterator[str]:
    sender, hearer = f"NODE{message.node}", "CONTROLLER"
    if not message.pdo.sent:
        sender, hearer = hearer, sender
    yield f"BO_ {message.can_id} {message.name}: {message.length} {sender}"
    start = 0
    for c in message.carried:
        kind = c.object.type
        if c.signal:
            bits = c.bits or 8 * kind.size
            sign = "-" if kind.signed else "+"
            scaling = f"({float(c.factor)!r},{float(c.offset)!r})" if c.unit else "(1,0)"
            bound = f"[{-c.most_v!r}|{c.most_v!r}]" if c.most_v else "[0|0]"
            yield f' SG_ {c.signal} : {start}|{bits}@1{sign} {scaling} {bound} "{c.unit}" {hearer}'
        start += 8 * kind.size
