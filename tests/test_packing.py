"""Numbers into shared memory: Python's way and the one in C put the same bytes there, and refuse the same."""

from __future__ import annotations

import math
import mmap
import shutil
import struct
from enum import IntEnum
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneud.log.live import packing
from pneud.log.live.packing import REFUSALS, Pack, layout
from pneud.rt.folders import cache_folder
from pure2c import load_source

if shutil.which("cc") is None:  # the loop goes without, too
    WAYS: dict[str, Pack] = {"python": packing.pack}
else:
    WAYS = {"python": packing.pack, "c": load_source(packing.SOURCE, cache=cache_folder("compiled")).pack}

OFFSET = 8
VALUES = {
    "d": st.floats(),
    "q": st.integers(-(2**63), 2**63 - 1),
    "Q": st.integers(0, 2**64 - 1),
    "I": st.integers(0, 2**32 - 1),
    "H": st.integers(0, 2**16 - 1),
    "7s": st.binary(max_size=9),
    "9p": st.binary(max_size=10),
    "3x": st.none(),
}
WILD = st.one_of(st.integers(-(2**70), 2**70), st.floats(), st.binary(max_size=3), st.none(), st.text())


class Kind(IntEnum):
    ONE = 1


def packed(way: Pack, text: str, parts: tuple[tuple[Any, ...], ...]) -> bytes | None:
    """The memory afterwards, or None where it was refused."""
    with mmap.mmap(-1, 4096) as memory:
        try:
            way(memory, OFFSET, *layout(text), parts)
        except REFUSALS:
            return None
        return memory[:]


@st.composite
def proper(draw: st.DrawFn) -> tuple[str, tuple[tuple[Any, ...], ...]]:
    codes = draw(st.lists(st.sampled_from(sorted(VALUES)), max_size=30))
    values = [draw(VALUES[code]) for code in codes if code != "3x"]
    cut = draw(st.integers(0, len(values)))
    return "".join(codes), (tuple(values[:cut]), (), tuple(values[cut:]))


@given(proper())
def test_both_ways_put_the_same(case: tuple[str, tuple[tuple[Any, ...], ...]]) -> None:
    text, parts = case
    found = {name: packed(way, text, parts) for name, way in WAYS.items()}
    assert None not in found.values()
    assert len(set(found.values())) == 1
    values = [value for part in parts for value in part]
    back = struct.Struct(text).unpack_from(found["python"] or b"", OFFSET)
    assert len(back) == len(values)


@given(st.lists(st.sampled_from(sorted(VALUES)), max_size=5), st.lists(WILD, max_size=6))
def test_both_ways_refuse_the_same(codes: list[str], values: list[Any]) -> None:
    found = {name: packed(way, "".join(codes), (tuple(values),)) for name, way in WAYS.items()}
    assert len(set(found.values())) == 1


@pytest.mark.parametrize("way", WAYS)
def test_members_of_enumerations_and_booleans_are_numbers(way: str) -> None:
    found = packed(WAYS[way], "qIHd", ((Kind.ONE, True, False), (1,)))
    assert found is not None
    assert struct.unpack_from("qIHd", found, OFFSET) == (1, 1, 0, 1.0)


@pytest.mark.parametrize("way", WAYS)
def test_not_a_number_keeps_its_bits(way: str) -> None:
    (nan,) = struct.unpack("d", b"\x01\x02\x03\x04\x05\x06\xf8\x7f")
    assert math.isnan(nan)
    found = packed(WAYS[way], "d", ((nan,),))
    assert found is not None
    assert found[OFFSET : OFFSET + 8] == struct.pack("d", nan)


@pytest.mark.parametrize("way", WAYS)
def test_what_lies_beyond_the_memory_is_refused(way: str) -> None:
    with mmap.mmap(-1, 4096) as memory, pytest.raises(REFUSALS):
        WAYS[way](memory, 4092, *layout("q"), ((1,),))


@pytest.mark.skipif("c" not in WAYS, reason="there is no C compiler")
def test_wrong_arguments_raise_and_do_not_crash() -> None:
    whole, places = layout("q")
    with mmap.mmap(-1, 4096) as memory:
        good = (memory, 0, whole, places, ((1,),))
        for place, wrong in ((0, b""), (0, None), (1, "0"), (1, -8), (3, []), (4, [(1,)]), (4, (1,))):
            arguments: list[Any] = list(good)
            arguments[place] = wrong
            with pytest.raises((*REFUSALS, BufferError)):
                WAYS["c"](*arguments)
        with pytest.raises(TypeError):
            WAYS["c"](memory)  # type: ignore[call-arg]
