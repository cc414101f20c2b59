"""How devices protect their frames: rules for checksum and counter, by name.

A rule says what the checksum of a frame has to be, of the bytes without it and of the counter in them. Where
checksum and counter lie, the DBC says.
"""

from collections.abc import Callable, Sequence
from functools import cached_property, reduce
from operator import xor
from typing import NamedTuple, TypeAlias

from pneud.bus import crc8
from pneud.config.protection import DataIdMode, Protection

Checksum: TypeAlias = Callable[[bytes, int], int]
"""What the checksum of a frame has to be, of its bytes without it and its counter."""


class Crc:
    """A cyclic redundancy check that reflects nothing, 8 or 16 bits wide."""

    def __init__(self, bits: int, polynomial: int, start: int, final_xor: int) -> None:
        self.bits, self.start, self.final_xor = bits, start, final_xor
        self._polynomial, self._mask = polynomial, (1 << bits) - 1

    @cached_property
    def _table(self) -> tuple[int, ...]:
        return tuple(self._remainder(byte << (self.bits - 8)) for byte in range(256))

    def _remainder(self, state: int) -> int:
        top = 1 << (self.bits - 1)
        for _ in range(8):
            state = (state << 1) ^ self._polynomial if state & top else state << 1
        return state & self._mask

    def __call__(self, data: bytes) -> int:
        """The checksum of `data`."""
        state, table, above, mask = self.start, self._table, self.bits - 8, self._mask
        for byte in data:
            state = table[state >> above ^ byte] ^ state << 8 & mask
        return state ^ self.final_xor


J1850 = Crc(8, 0x1D, 0xFF, 0xFF)
H2F = Crc(8, 0x2F, 0xFF, 0xFF)
CCITT = Crc(16, 0x1021, 0xFFFF, 0)
E2E_P01 = Crc(8, 0x1D, 0, 0)  # AUTOSAR takes start and final xor of J1850 back


class Counter(NamedTuple):
    """What a rule demands of the counter."""

    bits: int
    last: int  # its greatest value; 0 follows


class Rule(NamedTuple):
    """What there is to know of a rule before a frame is looked at."""

    bits: int  # of the checksum
    counter: Counter | None = None  # any where none is demanded


RULES: dict[Protection, Rule] = {
    "pneud": Rule(8),
    "sae-j1850": Rule(8),
    "crc8-h2f": Rule(8),
    "crc16-ccitt": Rule(16),
    "xor8": Rule(8),
    "sum8": Rule(8),
    "e2e-p01": Rule(8, Counter(4, 14)),
    "e2e-p02": Rule(8, Counter(4, 15)),
    "e2e-p05": Rule(16, Counter(8, 255)),
}


def checksum(
    name: Protection, can_id: int, data_ids: Sequence[int] = (), mode: DataIdMode = "both"
) -> Checksum:
    """The rule for one message.

    Args:
        name: of the rule.
        can_id: of the message.
        data_ids: as many as the rule takes.
        mode: how profile 1 takes its one in.
    """
    match name:
        case "pneud":
            start = crc8.identifier_state(can_id)
            return lambda rest, _: crc8.update(rest, start) ^ crc8.FINAL_XOR
        case "sae-j1850":
            return lambda rest, _: J1850(rest)
        case "crc8-h2f":
            return lambda rest, _: H2F(rest)
        case "crc16-ccitt":
            return lambda rest, _: CCITT(rest)
        case "xor8":
            return lambda rest, _: reduce(xor, rest, 0)
        case "sum8":
            return lambda rest, _: sum(rest) & 0xFF
        case "e2e-p01":
            even, odd = _heads(data_ids[0], mode)
            return lambda rest, counter: E2E_P01((odd if counter & 1 else even) + rest)
        case "e2e-p02":
            return lambda rest, counter: H2F(rest + bytes((data_ids[counter & 15],)))
        case "e2e-p05":
            tail = data_ids[0].to_bytes(2, "little")
            return lambda rest, _: CCITT(rest + tail)


def _heads(data_id: int, mode: DataIdMode) -> tuple[bytes, bytes]:
    """What profile 1 puts before the bytes of a frame, where its counter is even and where it is odd."""
    low, high = bytes((data_id & 0xFF,)), bytes((data_id >> 8,))
    match mode:
        case "both":
            return low + high, low + high
        case "alternating":
            return low, high
        case "low":
            return low, low
        case "nibble":  # the lower half of the high byte is in the frame
            return low + b"\0", low + b"\0"
