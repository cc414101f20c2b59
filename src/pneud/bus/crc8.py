"""CRC-8 SAE J1850: polynomial 0x1D, start 0xFF, final xor 0xFF, not reflected."""

from __future__ import annotations

POLYNOMIAL = 0x1D
START = 0xFF
FINAL_XOR = 0xFF


def _remainder(byte: int) -> int:
    for _ in range(8):
        byte = (byte << 1) ^ POLYNOMIAL if byte & 0x80 else byte << 1
    return byte & 0xFF


TABLE = bytes(_remainder(byte) for byte in range(256))


def update(data: bytes, state: int = START) -> int:
    """The shift register after `data`, before the final xor."""
    for byte in data:
        state = TABLE[state ^ byte]
    return state


def crc8(data: bytes) -> int:
    """The checksum of `data`."""
    return update(data) ^ FINAL_XOR


def identifier_state(can_id: int) -> int:
    """The shift register after an identifier's low and high byte: where the checksum of a frame begins.

    Of a 29-bit one, which has its flag, all four bytes count, the lowest first.
    """
    extended = can_id >> 31
    return update((can_id & 0x1FFF_FFFF).to_bytes(4 if extended else 2, "little"))
