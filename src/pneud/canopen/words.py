"""Control and status word of a CiA 408 valve, in place of Enable and State.

*Disabled is not centre*: a disabled valve goes to a fail-safe position that depends on the valve as it was
ordered. So a valve is centred in HOLD, with its hold setpoint at 0, and DISABLED counts as a fault: what the
load does then, nobody here knows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from enum import IntEnum
from typing import Any

from pneud.bus.codec import Codecs
from pneud.config.models import BusConfig
from pneud.signals import ValveState

DISABLED_BIT, HOLD_BIT, ACTIVE_BIT, READY_BIT, LOCAL_BIT = 1, 2, 4, 8, 16
RESET_BIT = READY_BIT  # of the control word: its rising edge ends a fault
HOLD_WORD = DISABLED_BIT | HOLD_BIT
ACTIVE_WORD = HOLD_WORD | ACTIVE_BIT
RESET_WORD = HOLD_WORD | RESET_BIT


class Status(IntEnum):
    """States of the device, as bits 0 … 3 of the status word have them."""

    NOT_READY = 0  # or a fault in INIT
    INIT = READY_BIT
    DISABLED = READY_BIT | DISABLED_BIT
    HOLD = READY_BIT | HOLD_WORD
    ACTIVE = READY_BIT | ACTIVE_WORD
    FAULT_DISABLED = DISABLED_BIT
    FAULT_HOLD = HOLD_WORD
    FAULT_REACTION = ACTIVE_WORD


_STATES: dict[int, ValveState] = {
    Status.NOT_READY: ValveState.BOOT,
    Status.INIT: ValveState.BOOT,
    Status.HOLD: ValveState.CENTRED,
    Status.ACTIVE: ValveState.ENABLED,
}
_FAULT = int(ValveState.FAULT)
# by bits 0 … 4: a valve under local control obeys nobody here, as one in fault
_BY_BITS = (*(int(_STATES.get(bits, ValveState.FAULT)) for bits in range(LOCAL_BIT)), *(_FAULT,) * LOCAL_BIT)
_STATUSES = {
    ValveState.BOOT: Status.INIT,
    ValveState.CENTRED: Status.HOLD,
    ValveState.ENABLED: Status.ACTIVE,
    ValveState.TIMED_OUT: Status.FAULT_HOLD,
    ValveState.FAULT: Status.FAULT_DISABLED,
}


def valve_state(status: int) -> int:
    """State of the valve, by its status word."""
    return _BY_BITS[status & 31]


def status_of(state: int) -> int:
    """Status word of a valve in a state."""
    return int(_STATUSES[ValveState(state)])


def control_of(enable: int) -> int:
    """Control word: follow the setpoint, or hold."""
    return ACTIVE_WORD if enable else HOLD_WORD


def enable_of(control: int) -> int:
    """Enable, of a control word; 2 for one that neither holds nor enables."""
    bits = control & ACTIVE_WORD
    return 1 if bits == ACTIVE_WORD else 0 if bits == HOLD_WORD else 2


def speak(codecs: Codecs, bus: BusConfig) -> Codecs:
    """The codecs of an axis whose valve takes these words, where it does."""
    if not any(node.profile == "valve408" for node in bus.nodes):
        return codecs
    status, command = codecs.valve_status, codecs.valve_command
    return replace(
        codecs,
        valve_status=replace(status, decode=_stated(status.decode), encode=_stating(status.encode)),
        valve_command=replace(command, decode=_enabled(command.decode), encode=_enabling(command.encode)),
    )


def _stated(decode: Callable[[bytes], tuple[Any, ...]]) -> Callable[[bytes], tuple[Any, ...]]:
    def decoded(data: bytes) -> tuple[Any, ...]:
        applied_v, status = decode(data)
        return applied_v, _BY_BITS[status]

    return decoded


def _stating(encode: Callable[..., bytes]) -> Callable[..., bytes]:
    def encoded(applied_v: float, state: int, *, counter: int = 0) -> bytes:
        return encode(applied_v, status_of(state), counter=counter)

    return encoded


def _enabled(decode: Callable[[bytes], tuple[Any, ...]]) -> Callable[[bytes], tuple[Any, ...]]:
    def decoded(data: bytes) -> tuple[Any, ...]:
        voltage_v, control, sequence = decode(data)
        return voltage_v, enable_of(control), sequence

    return decoded


def _enabling(encode: Callable[..., bytes]) -> Callable[..., bytes]:
    def encoded(voltage_v: float, enable: int, sequence: int = 0, *, counter: int = 0) -> bytes:
        return encode(voltage_v, control_of(enable), sequence, counter=counter)

    return encoded
