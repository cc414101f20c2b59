"""What CANopen calls things: objects and their types, states, abort codes, emergencies."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

NMT_ID, SYNC_ID, EMCY_ID, HEARTBEAT_ID = 0x000, 0x080, 0x080, 0x700
SDO_ANSWER_ID, SDO_REQUEST_ID = 0x580, 0x600
LSS_REQUEST_ID, LSS_ANSWER_ID = 0x7E5, 0x7E4
INVALID = 1 << 31  # bit of a PDO's identifier: it is not used


class Nmt(IntEnum):
    """State of a node, as its heartbeat has it."""

    BOOT = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class Command(IntEnum):
    """What the master of the network can ask of a node."""

    START = 1
    STOP = 2
    PRE_OPERATIONAL = 128
    RESET = 129
    RESET_COMMUNICATION = 130


class Type(NamedTuple):
    """How a number is written."""

    name: str
    code: int  # in an EDS
    size: int  # bytes
    signed: bool

    def encode(self, value: int) -> bytes:
        """The bytes of a number.

        Raises:
            OverflowError: the type does not hold it.
        """
        return value.to_bytes(self.size, "little", signed=self.signed)

    def decode(self, data: bytes) -> int:
        """The number of bytes; shorter or longer ones are what they are."""
        return int.from_bytes(data, "little", signed=self.signed)


BOOLEAN, I8, I16, I32 = (
    Type("bool", 1, 1, False),
    Type("i8", 2, 1, True),
    Type("i16", 3, 2, True),
    Type("i32", 4, 4, True),
)
U8, U16, U32, I64 = (
    Type("u8", 5, 1, False),
    Type("u16", 6, 2, False),
    Type("u32", 7, 4, False),
    Type("i64", 0x15, 8, True),
)
U64 = Type("u64", 0x1B, 8, False)
TYPES = {t.name: t for t in (BOOLEAN, I8, I16, I32, U8, U16, U32, I64, U64)}
BY_CODE = {t.code: t for t in TYPES.values()}


@dataclass(frozen=True, slots=True)
class Object:
    """One entry of an object dictionary."""

    index: int
    sub: int
    type: Type
    what: str  # in words

    @property
    def address(self) -> str:
        """As people write it."""
        return f"0x{self.index:04X}:{self.sub:02X}"

    def __str__(self) -> str:
        return f"{self.address} {self.what}" if self.what else self.address


DEVICE_TYPE = Object(0x1000, 0, U32, "device type")
DEVICE_NAME = 0x1008
SAVE = Object(0x1010, 1, U32, "store parameters")
SAVE_WORD = int.from_bytes(b"save", "little")
HEARTBEAT = Object(0x1017, 0, U16, "heartbeat producer time")
IDENTITY = tuple(
    Object(0x1018, sub, U32, word) for sub, word in enumerate(("vendor", "product", "revision", "serial"), 1)
)
# encoders (CiA 406), analog inputs (404 and 401)
MEASURING_STEP = Object(0x6005, 1, U32, "measuring step")
POSITION = Object(0x6004, 0, I32, "position value")
ANALOG_EVENTS = Object(0x6423, 0, BOOLEAN, "analog inputs are sent")
# valves (CiA 408)
CONTROL_WORD = Object(0x6040, 0, U16, "control word")
STATUS_WORD = Object(0x6041, 0, U16, "status word")
DEVICE_MODE = Object(0x6042, 0, I8, "device mode")
CONTROL_MODE = Object(0x6043, 0, I8, "control mode")
LOCAL = Object(0x604F, 0, I8, "local")
SETPOINT = Object(0x6300, 1, I16, "setpoint")
ACTUAL_VALUE = Object(0x6301, 1, I16, "actual value")
HOLD_SETPOINT = Object(0x6314, 1, I16, "hold setpoint")
DEAD_BAND = Object(0x6342, 0, I8, "dead-band compensation")


def heartbeat_consumer(sub: int) -> Object:
    """Whose heartbeat a node watches."""
    return Object(0x1016, sub, U32, "heartbeat consumer time")


def field_value(channel: int, *, wide: bool) -> Object:
    """Process value of an analog input (CiA 404), counted from 1."""
    return Object(0x9130 if wide else 0x7130, channel, I32 if wide else I16, f"process value {channel}")


def unit_of(channel: int) -> Object:
    """Its physical unit."""
    return Object(0x6131, channel, U32, f"unit of input {channel}")


def digits_of(channel: int) -> Object:
    """Its decimal digits."""
    return Object(0x6132, channel, U8, f"decimal digits of input {channel}")


def analog_input(channel: int) -> Object:
    """An analog input of an I/O module (CiA 401), counted from 1."""
    return Object(0x6401, channel, I16, f"analog input {channel}")


class Pdo(NamedTuple):
    """A process data object: where it is configured, and which identifier it has of old.

    `number` counts from 1; what a node sends is a TPDO, what it takes an RPDO.
    """

    number: int
    sent: bool

    @property
    def name(self) -> str:
        """As people call it."""
        return f"{'TPDO' if self.sent else 'RPDO'}{self.number}"

    @property
    def parameters(self) -> int:
        """Index of its communication parameters."""
        return (0x1800 if self.sent else 0x1400) + self.number - 1

    @property
    def mapping(self) -> int:
        """Index of its mapping."""
        return (0x1A00 if self.sent else 0x1600) + self.number - 1

    def can_id(self, node: int) -> int:
        """Of the predefined connection set."""
        return (0x180 if self.sent else 0x200) + 0x100 * (self.number - 1) + node

    def cob_id(self) -> Object:
        """Where its identifier stands."""
        return Object(self.parameters, 1, U32, f"{self.name} identifier")

    def transmission(self) -> Object:
        """Where it stands when it is sent, or taken over."""
        return Object(self.parameters, 2, U8, f"{self.name} transmission type")

    def event_timer(self) -> Object:
        """Where it stands how long it may be silent [ms]."""
        return Object(self.parameters, 5, U16, f"{self.name} event timer")

    def entries(self) -> Object:
        """How many objects it carries."""
        return Object(self.mapping, 0, U8, f"{self.name} number of mapped objects")

    def mapped(self, place: int) -> Object:
        """What it carries in a place, from 1."""
        return Object(self.mapping, place, U32, f"{self.name} mapped object {place}")


def mapping_word(o: Object) -> int:
    """An object as a mapping names it."""
    return o.index << 16 | o.sub << 8 | 8 * o.type.size


ABORTS = {
    0x05030000: "the toggle bit has not alternated",
    0x05040000: "the node has waited in vain",
    0x05040001: "the node does not know this command",
    0x06010000: "the object cannot be accessed so",
    0x06010001: "it can only be written",
    0x06010002: "it can only be read",
    0x06020000: "the object does not exist",
    0x06040041: "the object cannot be mapped to a PDO",
    0x06040042: "the PDO would become too long",
    0x06040043: "the parameters do not go together",
    0x06060000: "the node's hardware fails",
    0x06070010: "the length does not match its type",
    0x06070012: "the length is too great for its type",
    0x06070013: "the length is too small for its type",
    0x06090011: "the sub-index does not exist",
    0x06090030: "the value is out of its range",
    0x06090031: "the value is too great",
    0x06090032: "the value is too small",
    0x08000000: "the node gives no reason",
    0x08000020: "the node cannot take or store it",
    0x08000021: "the node is under local control",
    0x08000022: "not in the node's present state",
}
_NO_SUCH_OBJECT, _NO_SUCH_SUB = 0x06020000, 0x06090011
MISSING = frozenset((_NO_SUCH_OBJECT, _NO_SUCH_SUB))
_CURES = {
    _NO_SUCH_OBJECT: "this device, or its firmware, is another than its EDS says",
    _NO_SUCH_SUB: "this device, or its firmware, is another than its EDS says",
    0x06010002: "leave it out, or set it at the device",
    0x06040041: "map another object; see the device's manual",
    0x06040042: "map fewer objects to it",
    0x06070010: "the EDS has another type for it than the device; mend eds, or give the type",
    0x06070012: "the EDS has another type for it than the device; mend eds, or give the type",
    0x06070013: "the EDS has another type for it than the device; mend eds, or give the type",
    0x06090030: "choose a value that the device's manual allows",
    0x06090031: "choose a value that the device's manual allows",
    0x06090032: "choose a value that the device's manual allows",
    0x08000021: "end local control at the device",
    0x08000022: "power-cycle the node, and configure it again",
}


def abort_text(code: int) -> str:
    """Why a node has refused, in words."""
    return f"{ABORTS.get(code, 'the node refuses')} (abort 0x{code:08X})"


def abort_cure(code: int) -> str:
    """What to do about it."""
    return _CURES.get(code, "look the abort code up in the device's manual")


_EMERGENCIES = (  # code, mask
    (0x0000, 0xFF00, "no error any more"),
    (0x8110, 0xFFFF, "CAN overrun: frames were lost"),
    (0x8120, 0xFFFF, "CAN error-passive"),
    (0x8130, 0xFFFF, "a heartbeat or its guarding is lost"),
    (0x8140, 0xFFFF, "recovered from bus-off"),
    (0x8150, 0xFFFF, "another node sends with its identifier"),
    (0x8210, 0xFFFF, "a PDO is too short"),
    (0x8220, 0xFFFF, "a PDO is too long"),
    (0x8240, 0xFFFF, "SYNC has an unexpected length"),
    (0x8250, 0xFFFF, "a PDO with commands has not come in time"),
    (0x1000, 0xFF00, "an error of no kind"),
    (0x2000, 0xF000, "current"),
    (0x3000, 0xF000, "voltage"),
    (0x4000, 0xF000, "temperature"),
    (0x5000, 0xFF00, "hardware of the device"),
    (0x6000, 0xF000, "software of the device"),
    (0x7000, 0xFF00, "an additional module, such as a sensor"),
    (0x8000, 0xF000, "monitoring"),
    (0x9000, 0xFF00, "an external error"),
    (0xF000, 0xFF00, "an additional function"),
    (0xFF00, 0xFF00, "of the device's own kind"),
)


def emergency_text(code: int) -> str:
    """What an emergency (EMCY) says, in words."""
    words = next((text for value, mask, text in _EMERGENCIES if code & mask == value), "unknown")
    return f"EMCY 0x{code:04X}: {words}"
