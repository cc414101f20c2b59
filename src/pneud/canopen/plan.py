"""What a node is configured to: values to be found, values to be written and read back, in order."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from pneud import resources
from pneud.canopen import objects
from pneud.canopen.eds import Eds, EdsError, read_eds
from pneud.canopen.frames import UNITS, Message, messages_of
from pneud.canopen.objects import INVALID, TYPES, U32, Object, Pdo
from pneud.config.models import Config
from pneud.config.nodes import NodeConfig

PDOS = 4  # of the predefined connection set, each way
SYNC, EVENT = 1, 255  # transmission types: with every SYNC; at once
BY_BUS = 1  # device mode of a valve: the setpoint comes by the bus
_PROFILE = {"encoder406": 406, "analog404": 404, "analog401": 401, "valve408": 408}


class Step(NamedTuple):
    """One value: written, where it is not only to be found, and read back."""

    object: Object
    value: int
    write: bool = True
    mask: int = -1  # of what is compared
    cure: str = ""  # where it is another
    may_lack: bool = False  # a node without the object is told of and goes on
    why: str = ""


class Plan(NamedTuple):
    """All that a node is configured to."""

    node: NodeConfig
    messages: tuple[Message, ...]
    steps: tuple[Step, ...]
    eds: Eds

    @property
    def name(self) -> str:
        """As people are told of it."""
        return f"node {self.node.id} ({self.node.profile})"


def plans_of(config: Config, beside: Path | None = None) -> tuple[Plan, ...]:
    """The plans of all nodes, in the order in which they are started.

    Args:
        config: of the axis.
        beside: folder of its file, for EDS that are named in it.

    Raises:
        EdsError: an EDS cannot be used.
    """
    return tuple(plan_of(node, config, _eds(node, beside)) for node in config.bus.nodes)


def _eds(node: NodeConfig, beside: Path | None) -> Eds:
    try:
        return read_eds(resources.find(node.eds or f"{node.profile}.eds", beside))
    except FileNotFoundError as e:
        raise EdsError(f"node {node.id}: eds: {e}") from None


def plan_of(node: NodeConfig, config: Config, eds: Eds) -> Plan:
    """The plan of one node.

    Raises:
        EdsError: a value has no type, or none that holds it.
    """
    messages = messages_of(node, config.valve.u_max_v)
    steps = (
        *_device(node),
        *_liveness(node),
        *_pdos(node, messages, eds, round(config.bus.valve_timeout_ms)),
        *_of_profile(node, compensated=config.control.compensate_dead_zone),
        *_own(node, eds),
    )
    typed = tuple(step._replace(object=eds.typed(step.object)) for step in steps)
    for step in typed:
        try:
            step.object.type.encode(step.value)
        except OverflowError:
            o = step.object
            raise EdsError(f"node {node.id}, {o}: {step.value} does not fit its type {o.type.name}") from None
    return Plan(node, messages, typed, eds)


def _device(node: NodeConfig) -> Iterator[Step]:
    number = _PROFILE[node.profile]
    cure = f"no CiA {number} device, or in its bootloader: power-cycle it, load its firmware, or mend id"
    yield Step(objects.DEVICE_TYPE, number, write=False, mask=0xFFFF, cure=cure)
    for o in objects.IDENTITY:
        value = getattr(node.identity, o.what)
        if value is not None:
            cure = "the hardware was exchanged: pneud nodes keep takes it, then make the movement test"
            yield Step(o, value, write=False, cure=cure)


def _liveness(node: NodeConfig) -> Iterator[Step]:
    yield Step(objects.HEARTBEAT, node.heartbeat_ms, why="pneud notices the loss of it")
    for sub, watch in enumerate(node.watches, 1):
        value = watch.node << 16 | watch.timeout_ms
        yield Step(objects.heartbeat_consumer(sub), value, why=f"it notices the loss of node {watch.node}")


def _pdos(node: NodeConfig, messages: tuple[Message, ...], eds: Eds, valve_ms: int) -> Iterator[Step]:
    used = {message.pdo: message for message in messages}
    for sent in (True, False):
        for pdo in (Pdo(number, sent) for number in range(1, PDOS + 1)):
            if pdo not in used and eds.has(pdo.cob_id()):
                yield _identifier(
                    pdo, node.id, off=True, why="it would flood the bus, or take what is not meant"
                )
    for pdo, message in used.items():
        yield _identifier(pdo, node.id, off=True, why="it is changed")
        if pdo.sent:
            yield Step(pdo.transmission(), SYNC, why="it is sampled and sent with every SYNC")
        else:
            yield Step(pdo.transmission(), EVENT, why="a command acts at once")
            if node.deadline:
                cure = (
                    "say deadline = false if this valve cannot watch its commands, and give it another watch"
                )
                why = "it goes to hold by itself when commands stop"
                yield Step(pdo.event_timer(), valve_ms, cure=cure, why=why)
        yield Step(pdo.entries(), 0)
        for place, carried in enumerate(message.carried, 1):
            yield Step(pdo.mapped(place), objects.mapping_word(carried.object), why=carried.object.what)
        yield Step(pdo.entries(), len(message.carried))
        yield _identifier(pdo, node.id, off=False, why="it is used")


def _identifier(pdo: Pdo, node: int, *, off: bool, why: str) -> Step:
    # a device may have a bit more in it, which says that the PDO cannot be asked for
    return Step(pdo.cob_id(), pdo.can_id(node) | (INVALID if off else 0), mask=INVALID | 0x7FF, why=why)


def _of_profile(node: NodeConfig, *, compensated: bool) -> Iterator[Step]:
    match node.profile:
        case "encoder406":
            yield Step(
                objects.MEASURING_STEP, round(node.step_m / 1e-8), why=f"{node.step_m * 1e6:g} µm a count"
            )
        case "analog404":
            for channel in range(1, len(node.filled) + 1):
                yield Step(objects.unit_of(channel), UNITS[node.unit], why=node.unit)
                yield Step(objects.digits_of(channel), node.digits)
        case "analog401":
            yield Step(objects.ANALOG_EVENTS, 1)
        case _:
            yield Step(objects.LOCAL, 0, write=False, may_lack=True, cure="end local control at the valve")
            yield Step(objects.DEVICE_MODE, BY_BUS, why="setpoints come by the bus")
            yield Step(objects.CONTROL_MODE, node.control_mode, why="control mode of the spool")
            yield Step(objects.HOLD_SETPOINT, 0, why="HOLD is centre: disabled is not")
            if node.dead_band == "off":
                why = (
                    "pneud makes up for the dead band" if compensated else "nobody makes up for the dead band"
                )
                yield Step(objects.DEAD_BAND, 0, may_lack=True, why=why)


def _own(node: NodeConfig, eds: Eds) -> Iterator[Step]:
    for given in node.write:
        o = Object(given.index, given.sub, U32, "")
        if given.type is not None:
            yield Step(replace(o, type=TYPES[given.type]), given.value, why="write")
        elif eds.has(o):
            entry = eds.entries[o.index, o.sub]
            yield Step(entry.object, given.value, why="write")
        else:
            raise EdsError(f"node {node.id}, {o.address}: {eds.name} has no such object; give its type")
