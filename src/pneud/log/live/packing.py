"""Numbers of a record into shared memory, where a `struct` says; `pack.c` beside this file is `pack` in C."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from itertools import chain
from mmap import mmap
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

SOURCE = Path(__file__).with_name("pack.c")
_PLACE = struct.Struct("=BBH")


class Layout(NamedTuple):
    """Where values go."""

    whole: struct.Struct
    places: bytes  # code, size and offset of each value, for the C


Pack: TypeAlias = Callable[[mmap, int, struct.Struct, bytes, tuple[tuple[Any, ...], ...]], None]
"""`pack`, or its twin in C."""

REFUSALS = (struct.error, ValueError, TypeError, OverflowError)
"""What `pack` raises for values that have no room in their places, or are too few or too many."""


def layout(text: str) -> Layout:
    """The layout of a format of `struct` with the codes d, q, Q, I, H, s and p, natively aligned."""
    places, before = b"", ""
    for count, code in re.findall(r"(\d*)([a-zA-Z])", text):
        for one in [count + code] if code in "spx" else [code] * int(count or 1):
            before += one
            size = struct.calcsize(one)
            if code != "x":
                places += _PLACE.pack(ord(code), size, struct.calcsize(before) - size)
    return Layout(struct.Struct(text), places)


def pack(
    memory: mmap, offset: int, whole: struct.Struct, _places: bytes, parts: tuple[tuple[Any, ...], ...], /
) -> None:
    """Put values into memory.

    Args:
        memory: where to.
        offset: first byte of the layout.
        whole: as in a `Layout`.
        _places: likewise; the C needs it.
        parts: tuples of values, one after the other.

    Raises:
        one of `REFUSALS`; some values may be there then.
    """
    whole.pack_into(memory, offset, *chain.from_iterable(parts))
