"""Records into memory: Python's way and the one in C put what reads the same there, and refuse the same."""

from __future__ import annotations

import math
import mmap
import struct
from enum import IntEnum
from marshal import loads
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from log_samples import WAYS, any_record, bits, tick_at
from pneud.log.live import packing
from pneud.log.live.packing import REFUSALS, drawn, skimmed, unpacked
from pneud.log.live.ring import Ring
from pneud.signals import Record, Timing

BEGIN, ROOM = 8, 16_000
NODES = st.none() | st.floats() | st.integers(-(2**63), 2**63 - 1) | st.binary(max_size=9)
TREES = st.recursive(NODES, lambda parts: st.lists(parts, max_size=6).map(tuple), max_leaves=30)


class Kind(IntEnum):
    ONE = 1


class Real(float):
    """As NumPy's are."""


def packed(way: str, tree: Any, room: int = ROOM) -> bytes | None:
    """What stands in the memory afterwards, or None where it was refused."""
    pack = WAYS[way]
    if pack is None:
        try:
            found = packing.packed(tree)
        except REFUSALS:
            return None
        return found if len(found) <= room else None
    with mmap.mmap(-1, 2 * ROOM) as memory:
        try:
            pack(memory, BEGIN, BEGIN + room, tree)
        except REFUSALS:
            return None
        assert memory[:BEGIN] == bytes(BEGIN)
        assert memory[BEGIN + room :] == bytes(2 * ROOM - BEGIN - room)
        return memory[BEGIN : BEGIN + room]


@pytest.mark.parametrize("way", WAYS)
@given(record=any_record())
@settings(max_examples=30, deadline=None)
def test_a_record_comes_back_to_the_bit(way: str, record: Record) -> None:
    if way == "c" and (record.tick.present | record.tick.latched) >> 63:
        return  # those of 64 bits are left to Python
    found = packed(way, record)
    assert found is not None
    assert bits(unpacked(found)) == bits(record)
    timing = record.timing
    assert bits(skimmed(found)) == bits(
        (record.tick.measurement, timing.lateness_ns, timing.latency_ns, record.tick.command.saturated)
    )
    tick = record.tick
    m = tick.measurement
    places = tick.estimate.position_m, tick.reference.position_m
    values = tick.error_m, *places, m.p1_pa, m.p2_pa, m.supply_pa, tick.command.voltage_v
    assert bits(drawn(found)) == bits((tick.t_ns, *values))


@given(TREES)
def test_all_ways_put_the_same_values(tree: Any) -> None:
    for way in WAYS:
        found = packed(way, tree)
        assert found is not None
        assert bits(loads(found)) == bits(tree)


@given(TREES, st.integers(0, 60))
def test_all_ways_need_the_same_room(tree: Any, room: int) -> None:
    assert len({packed(way, tree, room) is None for way in WAYS}) == 1


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("tree", [("text",), [1.0], ({},), (2**70,), (object(),)])
def test_what_is_in_no_record_is_refused_or_comes_back(way: str, tree: Any) -> None:
    found = packed(way, tree)
    assert found is None or loads(found) == tree


@pytest.mark.parametrize("way", WAYS)
def test_numbers_of_other_classes_are_numbers(way: str) -> None:
    found = packed(way, (Kind.ONE, True, Real(0.1)))
    assert found is not None
    assert bits(loads(found)) == bits((1, 1, 0.1))


@pytest.mark.parametrize("way", WAYS)
def test_not_a_number_keeps_its_bits(way: str) -> None:
    (nan,) = struct.unpack("d", b"\x01\x02\x03\x04\x05\x06\xf8\x7f")
    assert math.isnan(nan)
    found = packed(way, (nan,))
    assert found is not None
    assert struct.pack("d", loads(found)[0]) == struct.pack("d", nan)


@pytest.mark.parametrize("way", WAYS)
def test_a_ring_takes_what_its_way_does_not(way: str) -> None:
    ring = Ring.create(slots=16, pack=WAYS[way])
    reader = ring.reader()
    record = Record(tick_at(1)._replace(present=1 << 63), Timing(0, 0, 0, 0, 0, 0), (), 0, (), 0.0)
    ring.put(record)
    assert reader.drain() == [record]


@pytest.mark.skipif("c" not in WAYS, reason="there is no C compiler")
def test_wrong_arguments_raise_and_do_not_crash() -> None:
    pack = WAYS["c"]
    assert pack is not None
    with mmap.mmap(-1, 4096) as memory:
        good = (memory, 0, 4096, (1,))
        for place, wrong in ((0, b""), (0, None), (1, "0"), (1, -8), (1, 4097), (2, 4097), (2, -1)):
            arguments: list[Any] = list(good)
            arguments[place] = wrong
            with pytest.raises((*REFUSALS, TypeError, BufferError)):
                pack(*arguments)
        with pytest.raises(TypeError):
            pack(memory)  # type: ignore[call-arg]
