"""What a recording is made of."""

from __future__ import annotations

from typing import NamedTuple

from pneud.bus.wire import CAN_EFF_FLAG, CAN_RTR_FLAG
from pneud.signals import Frame

STANDARD, EXTENDED = 0x7FF, 0x1FFFFFFF  # greatest identifiers
SECOND_NS = 1_000_000_000

FD = "a frame of CAN FD, passed over"
XL = "a frame of CAN XL, passed over"
REQUEST = "a request to send (TxRq), which is no frame yet"
NO_IDENTIFIER = "not an identifier of CAN, passed over"


class Passing(NamedTuple):
    """One frame in a recording."""

    frame: Frame  # its stamp is Unix time
    channel: str
    sent: bool | None  # by whoever recorded; None where the recording does not say


def other_kind(can_id: int) -> str:
    """What a frame is, with its flags, where its number alone does not make it the message of that number."""
    if can_id & CAN_RTR_FLAG:
        return "as a request for it (RTR)"
    return "with a 29-bit identifier" if can_id & CAN_EFF_FLAG else ""


def decimal_ns(sign: str, seconds: str, fraction: str | None) -> int:
    """Nanoseconds from the digits of seconds; what is finer is cut off."""
    ns = int(seconds) * SECOND_NS + int((fraction or "0")[:9].ljust(9, "0"))
    return -ns if sign else ns
