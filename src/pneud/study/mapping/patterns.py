"""What frames of one identifier have in common: which bits count them, and which are their checksum."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Literal, NamedTuple

from pneud.bus.dbc_layout import SignalField, around, shift
from pneud.bus.protection import CCITT, E2E_P01, H2F, Crc, checksum
from pneud.config.protection import DataIdMode, Protection

ENOUGH = 16  # different frames before anything is said of them
STEADY = 0.75  # of the steps of a counter are by one: the others are lost frames
AS_STEADY = 0.02  # so much more of them may be missed by what counts further
PLAIN: tuple[Protection, ...] = ("pneud", "sae-j1850", "crc8-h2f", "crc16-ccitt", "xor8", "sum8")


class Place(NamedTuple):
    """Where bits lie in a frame, as a DBC says it."""

    start: int
    length: int
    big_endian: bool = False

    def __str__(self) -> str:
        first = self.start // 8
        if self.length == 8 and self.start % 8 == (7 if self.big_endian else 0):
            return f"byte {first}"
        if self.length == 16 and self.start % 8 == (7 if self.big_endian else 0):
            return f"bytes {first} and {first + 1}{', big-endian' if self.big_endian else ''}"
        return f"{self.length} bits at {self.start}"

    @property
    def field(self) -> SignalField:
        """As a field of a codec."""
        return SignalField("", *self, False, True, 1.0, 0.0, 0, (1 << self.length) - 1)

    def values(self, frames: Sequence[bytes]) -> list[int]:
        """What stands there in frames of one length."""
        order: Literal["big", "little"] = "big" if self.big_endian else "little"
        above, ones = shift(self.field, len(frames[0])), (1 << self.length) - 1
        return [int.from_bytes(data, order) >> above & ones for data in frames]


class Counter(NamedTuple):
    """Bits that count frames."""

    place: Place
    first: int
    last: int  # value before the first one
    wrapped: bool  # it has been seen to begin again there


class Check(NamedTuple):
    """Bits that are a checksum."""

    place: Place
    rule: Protection
    data_id: int | tuple[int, ...] | None = None
    data_id_mode: DataIdMode = "both"


def counter_in(frames: Sequence[bytes], places: Sequence[Place]) -> Counter | None:
    """The place that goes up by one with each frame, if there is one: no wider than what is seen to count."""
    if len(set(frames)) < ENOUGH:
        return None
    found = [(values, place) for place in places if _steady(values := place.values(frames)) > STEADY]
    if not found:
        return None
    # the lower bits of a counter count as well, and so do, nearly, those beside it that seldom change
    best = max(_steady(values) for values, _ in found) - AS_STEADY
    values, place = max(
        (f for f in found if _steady(f[0]) >= best), key=lambda f: (max(f[0]) - min(f[0]), -f[1].length)
    )
    first, last = min(values), max(values)
    wrapped = (last, first) in pairwise(values) and first < 2
    if not wrapped:
        first, last = 0, (1 << place.length) - 1
    return Counter(place, first, last, wrapped)


def _steady(values: list[int]) -> float:
    """Part of the steps that are up by one, or from the last value to the first."""
    last, first = max(values), min(values)
    up = sum(after == before + 1 or (before, after) == (last, first) for before, after in pairwise(values))
    return up / (len(values) - 1) if last - first > 1 else 0.0


def check_in(
    can_id: int, frames: Sequence[bytes], places: Sequence[Place], counter: Counter | None
) -> Check | None:
    """The place and the rule by which all frames agree, if there is one."""
    different = list(dict.fromkeys(frames))
    if len(different) < ENOUGH:
        return None
    for place in sorted(places, key=lambda p: (-p.length, -p.start)):
        if place.length in (8, 16) and (counter is None or not _overlap(place, counter.place)):
            crcs = place.values(different)
            if len(set(crcs)) > 1 and (found := _rule(can_id, place, different, crcs, counter)):
                return found
    return None


def _overlap(a: Place, b: Place) -> bool:
    return not _bits(a).isdisjoint(_bits(b))


def _bits(place: Place) -> set[int]:
    """Numbers of the bits, counted from the least significant of byte 0."""
    if not place.big_endian:
        return set(range(place.start, place.start + place.length))
    top = place.start // 8 * 8 + 7 - place.start % 8  # from the most significant bit of byte 0
    return {n // 8 * 8 + 7 - n % 8 for n in range(top, top + place.length)}


def _rule(
    can_id: int, place: Place, frames: list[bytes], crcs: list[int], counter: Counter | None
) -> Check | None:
    rest, _ = around(place.field, len(frames[0]))
    bodies = [rest(data) for data in frames]
    counts = [0] * len(frames) if counter is None else counter.place.values(frames)
    for name in PLAIN:
        if (place.length == 16) == (name == "crc16-ccitt"):
            rule = checksum(name, can_id)
            if all(rule(body, 0) == crc for body, crc in zip(bodies, crcs, strict=True)):
                return Check(place, name)
    if counter is None:
        return None
    if place.length == 16:
        ids = _ids("behind", CCITT, bodies, crcs)
        return Check(place, "e2e-p05", ids[0]) if len(set(ids)) == 1 and counter.last == 255 else None
    if counter.place.length != 4:
        return None
    return _profile_1(place, bodies, crcs, counts) or _profile_2(place, bodies, crcs, counts)


def _profile_1(place: Place, bodies: list[bytes], crcs: list[int], counts: list[int]) -> Check | None:
    """Two bytes before the others leave the same as one, which is found and does for both modes."""
    ids = _ids("before", E2E_P01, bodies, crcs)
    even = {one for one, count in zip(ids, counts, strict=True) if count % 2 == 0}
    odd = {one for one, count in zip(ids, counts, strict=True) if count % 2}
    if len(even) != 1 or len(odd) != 1:
        return None
    low, high = even.pop(), odd.pop()
    if low == high:
        return Check(place, "e2e-p01", low, "low")
    return Check(place, "e2e-p01", low | high << 8, "alternating")


def _profile_2(place: Place, bodies: list[bytes], crcs: list[int], counts: list[int]) -> Check | None:
    by_count: dict[int, set[int]] = {}
    for count, one in zip(counts, _ids("behind", H2F, bodies, crcs), strict=True):
        by_count.setdefault(count, set()).add(one)
    if len(by_count) < 16 or any(len(ids) > 1 for ids in by_count.values()) or len(bodies) < 2 * ENOUGH:
        return None
    return Check(place, "e2e-p02", tuple(by_count[count].pop() for count in range(16)))


Where = Literal["before", "behind"]


def _ids(where: Where, crc: Crc, bodies: list[bytes], crcs: list[int]) -> list[int]:
    """Which identifier would explain each frame's checksum.

    A checksum is linear: what an identifier adds depends on it and on how many bytes follow, alone.
    """
    size = crc.bits // 8
    adds = _adding(where, crc, 0 if where == "behind" else len(bodies[0]))
    nothing = bytes(size)
    plain = (body + nothing if where == "behind" else nothing + body for body in bodies)
    return [adds[crc(body) ^ found] for body, found in zip(plain, crcs, strict=True)]


@lru_cache(maxsize=64)
def _adding(where: Where, crc: Crc, length: int) -> dict[int, int]:
    """Identifiers by what they add to a checksum."""
    size, zeros = crc.bits // 8, bytes(length)
    base = crc(bytes(size) + zeros)
    found = {}
    for one in range(1 << crc.bits):
        code = one.to_bytes(size, "little")
        found[crc(zeros + code if where == "behind" else code + zeros) ^ base] = one
    return found


def plain_places(length: int) -> Iterator[Place]:
    """Where counters and checksums are usual: bytes, their halves, and pairs of them."""
    for byte in range(length):
        yield Place(8 * byte, 8)
        yield Place(8 * byte, 4)
        yield Place(8 * byte + 4, 4)
        if byte + 1 < length:
            yield Place(8 * byte, 16)
            yield Place(8 * byte + 7, 16, True)
