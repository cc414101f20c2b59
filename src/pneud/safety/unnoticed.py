"""What cannot be noticed on a rig: the faults that cannot arise there, for want of somebody who tells.

Data in, data out: `Devices` is what is known of a rig's devices, the rest is what each lack costs.
"""

from collections.abc import Iterator
from typing import NamedTuple

from pneud.safety.faults import F
from pneud.signals import ValveState


class Teller(NamedTuple):
    """The messages of one source."""

    messages: tuple[str, ...]
    uncounted: tuple[str, ...]  # those of them without a counter
    unprotected: tuple[str, ...]  # and without a checksum


class Devices(NamedTuple):
    """What the devices of a rig tell."""

    sync: bool  # they answer SYNC
    follows: bool  # another controller sends it
    encoder: Teller
    pressure: Teller
    valve: Teller
    status: bool  # the encoder says how it is
    second: bool  # there is another one to compare it with
    age: bool  # and how old its readings are
    homed: bool  # the axis finds its reference itself
    supply: bool  # somebody measures it
    applied: bool  # the valve says what it puts out
    states: frozenset[int]  # and in which of these states it is
    nodes: bool  # some are known by their CANopen identifiers
    heartbeats: bool  # and have to send heartbeats
    uncounted_inputs: tuple[str, ...] = ()  # messages with inputs that have no counter
    brake_tells: bool = True  # an input says whether the brake has let go, or there is none


class Unnoticed(NamedTuple):
    """A fault that cannot arise, or only partly."""

    fault: F
    why: str
    wholly: bool = True

    @property
    def name(self) -> str:
        """The fault's name in logs, JSON and on the screen."""
        return self.fault.name.lower()


def unnoticed(d: Devices) -> list[Unnoticed]:
    """The faults that a rig's devices leave unnoticed, in order of the fault table."""
    found: dict[F, Unnoticed] = {}
    for one in (*_of_frames(d), *_of_values(d), *_of_valve(d), *_of_bus(d), *_of_station(d)):
        before = found.setdefault(one.fault, one)
        if one.wholly and not before.wholly:
            found[one.fault] = one
    return [found[fault] for fault in sorted(found)]


def _of_frames(d: Devices) -> Iterator[Unnoticed]:
    """What counters, checksums and SYNC would show."""
    for name, teller, first in (
        ("encoder", d.encoder, F.ENCODER_MISSING),
        ("pressure", d.pressure, F.PRESSURE_MISSING),
        ("valve", d.valve, F.VALVE_MISSING),
    ):
        if not teller.messages:
            for fault in range(first, first + 4):
                yield Unnoticed(F(fault), f"the {name} sends nothing")
            continue
        # missing, corrupt, frozen, late stand in this order in the table
        if teller.unprotected:
            why = f"{_names(teller.unprotected)} without a checksum: only a wrong length shows"
            yield Unnoticed(F(first + 1), why, wholly=False)
        if teller.uncounted:
            why = f"{_names(teller.uncounted)} without a counter"
            yield Unnoticed(F(first + 2), why, wholly=teller.uncounted == teller.messages)
            why += ": what comes a whole tick late looks like an answer in time"
            yield Unnoticed(F(first + 3), why, wholly=False)
        if name == "encoder" and not d.age:
            why = "the encoder tells no age: what was sampled long before it was sent looks like an answer"
            yield Unnoticed(F(first + 3), why, wholly=False)
        if not d.sync:
            told = name == "encoder" and d.age
            why = "bus.sync = false: nobody knows what a frame answers"
            yield Unnoticed(
                F(first + 3), why + (", but an age beyond its range shows" if told else ""), not told
            )


def _of_values(d: Devices) -> Iterator[Unnoticed]:
    """What the sensors would tell."""
    if not d.status:
        yield Unnoticed(F.ENCODER_ERROR, "the encoder has no status", wholly=not d.second)
        yield Unnoticed(F.ENCODER_LOST_REFERENCE, "the encoder has no status")
        if not d.homed:
            yield Unnoticed(F.ENCODER_UNREFERENCED, "the encoder has no status")
    if not d.supply:
        why = "no sensor tells the supply; what the chambers lack shows as saturated or tracking_error"
        yield Unnoticed(F.SUPPLY_PRESSURE, why)
        yield Unnoticed(F.SUPPLY_FALLING, why)


def _of_valve(d: Devices) -> Iterator[Unnoticed]:
    """What the valve would tell."""
    if not d.applied:
        yield Unnoticed(F.VALVE_DISAGREES, "the valve does not tell what it puts out")
        why = "the valve does not tell what it puts out"
        if not d.states:  # the last command that left stands for it
            why += ": only commands that cannot be sent show"
        yield Unnoticed(F.VALVE_ACTIVE, why, wholly=False)
    for fault, states, what in (
        (F.VALVE_TIMED_OUT, (ValveState.TIMED_OUT,), "that it has timed out"),
        (F.VALVE_FAULT, (ValveState.FAULT,), "that it has a fault"),
        (F.VALVE_REBOOTED, (ValveState.BOOT, ValveState.CENTRED), "that it is not enabled"),
    ):
        if d.states.isdisjoint(states):
            # a number that the table of its states does not have is taken for a fault
            wholly = fault != F.VALVE_FAULT or not d.states
            yield Unnoticed(fault, f"the valve does not tell {what}", wholly)
    if ValveState.ENABLED not in d.states:
        yield Unnoticed(F.VALVE_ACTIVE, "the valve does not tell that it is enabled", wholly=False)


def _of_bus(d: Devices) -> Iterator[Unnoticed]:
    """What else would be heard."""
    if d.follows:
        why = "bus.sync = follow: SYNC is another controller's, only valve commands tell"
        yield Unnoticed(F.OTHER_CONTROLLER, why, wholly=False)
    if not d.sync:
        why = "bus.sync = false: whose SYNC it is tells nothing, only valve commands do"
        yield Unnoticed(F.OTHER_CONTROLLER, why, wholly=False)
        yield Unnoticed(F.IDENTIFIER_CLASH, "bus.sync = false: nobody knows how many frames there should be")
    if not d.nodes:
        yield Unnoticed(F.EMERGENCY, "no message has a node, whose EMCY could be heard")
    if not d.heartbeats:
        yield Unnoticed(F.HEARTBEAT_LOST, "no message has heartbeat_timeout_ms")


def _of_station(d: Devices) -> Iterator[Unnoticed]:
    """What inputs and a brake would tell."""
    if d.uncounted_inputs:
        why = f"{_names(d.uncounted_inputs)} without a counter: a node that repeats itself looks alive"
        yield Unnoticed(F.INPUT_LOST, why, wholly=False)
    if not d.brake_tells:
        why = (
            "no input brake_released: a brake that does not let go shows as tracking_error, one that does not"
            " hold in what the load does"
        )
        yield Unnoticed(F.BRAKE_STUCK, why)


def _names(messages: tuple[str, ...]) -> str:
    return ", ".join(messages)
