"""Control and status word of a CiA 408 valve.

*Disabled is not centre*: a disabled valve goes to a fail-safe position that depends on the valve as it was
ordered. So a valve is centred in HOLD, with its hold setpoint at 0, and DISABLED counts as a fault: what the
load does then, nobody here knows.
"""

from __future__ import annotations

from enum import IntEnum

from pneud.config.nodes import ACTIVE_WORD, HOLD_WORD, STATES
from pneud.signals import ValveState

READY_BIT, LOCAL_BIT = 8, 16  # of the status word
RESET_BIT = 8  # of the control word: its rising edge ends a fault
RESET_WORD = HOLD_WORD | RESET_BIT


class Status(IntEnum):
    """States of the device, as bits 0 … 3 of the status word have them."""

    NOT_READY = 0  # or a fault in INIT
    INIT = READY_BIT
    DISABLED = READY_BIT | 1
    HOLD = READY_BIT | HOLD_WORD
    ACTIVE = READY_BIT | ACTIVE_WORD
    FAULT_DISABLED = 1
    FAULT_HOLD = HOLD_WORD
    FAULT_REACTION = ACTIVE_WORD


_WRITTEN = {state: bits for bits, state in reversed(STATES.items())}


def valve_state(status: int) -> int:
    """State of the valve, by its status word."""
    return STATES.get(status & 31, int(ValveState.FAULT))


def status_of(state: int) -> int:
    """Status word of a valve in a state."""
    return _WRITTEN[state]
