"""Several axes on one bus: whether they can be together there."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

from pneud.bus.codec import Codecs
from pneud.bus.load import overload
from pneud.config.models import Config

Axes = Sequence[tuple[Config, Codecs]]
_EMCY, _HEARTBEAT = 0x080, 0x700
_SERVICES = {_EMCY: "EMCY", _HEARTBEAT: "heartbeat", 0x580: "the SDO answer", 0x600: "the SDO request"}
_ONE = (  # of which there is one for all
    *("loop.rate_hz", "loop.set_deadline", "loop.spin_us"),
    *("bus.channel", "bus.sync", "bus.bitrate_bit_s", "bus.fd", "bus.data_bitrate_bit_s", "realtime"),
)


def identifiers(config: Config, codecs: Codecs) -> dict[int, str]:
    """What each identifier that is an axis's alone is for; messages with inputs may be those of several."""
    found = {answer.codec.can_id: answer.name for answer in codecs.answers}
    found[codecs.valve_command.can_id] = "the command"
    if codecs.switching is not None:
        found |= {message.codec.can_id: message.name for message in codecs.switching.outputs}
    if codecs.load_cell is not None:
        found[codecs.load_cell.codec.can_id] = codecs.load_cell.name
    for device in config.bus.devices:
        if (node := device.node) is not None:
            found |= {_EMCY + node: f"EMCY of node {node}", _HEARTBEAT + node: f"heartbeat of node {node}"}
    for configured in config.bus.nodes:
        found |= {base + configured.id: f"{what} of node {configured.id}" for base, what in _SERVICES.items()}
    return found


def why_not_together(axes: Axes) -> str:
    """Why axes cannot share a bus, in one line; empty where they can.

    They need one rate, one SYNC, identifiers of their own, and a bus that carries the frames of all.
    """
    for (a, a_codecs), (b, b_codecs) in combinations(axes, 2):
        for key in _ONE:
            if (one := _at(a, key)) != (other := _at(b, key)):
                shown = f" ({one} and {other})" if not hasattr(one, "model_fields") else ""
                return f"axes {a.name} and {b.name} differ in {key}{shown}; all on one bus share it"
        if a_codecs.sync.can_id != b_codecs.sync.can_id or a_codecs.sync.length != b_codecs.sync.length:
            return f"axes {a.name} and {b.name} have different SYNC messages; all on one bus share it"
        own, others = identifiers(a, a_codecs), identifiers(b, b_codecs)
        for can_id in sorted(own.keys() & others.keys()):
            return (
                f"0x{can_id:03X} is {own[can_id]} of axis {a.name} and {others[can_id]} of axis {b.name};"
                " give each its own message and node under [axis.bus]"
            )
        for inputs, axis, known in ((a_codecs, a.name, others), (b_codecs, b.name, own)):
            for message in inputs.switching.inputs if inputs.switching is not None else ():
                if message.codec.can_id in known:
                    what = known[message.codec.can_id]
                    shown = f"0x{message.codec.can_id:03X} is {message.name}, inputs of axis {axis}"
                    return f"{shown}, and {what} of the other; give each its own message"
        for name, known in ((b.name, own), (a.name, others)):
            if (sync := a_codecs.sync.can_id) in known:
                return f"0x{sync:03X} is SYNC, and {known[sync]} of an axis beside {name}"
    return overload(axes[0][0], *(codecs for _, codecs in axes))


def _at(config: Config, key: str) -> object:
    value: object = config
    for step in key.split("."):
        value = getattr(value, step)
    return value
