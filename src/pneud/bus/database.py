"""What a DBC says, read by `cantools`.

`cantools` takes longer to load than all that a daemon needs besides. So what it made of a DBC can be kept, in
the user's cache, and is found there by the bytes of the DBC, as long as `cantools` and this module stay as
they are.
"""

import hashlib
import io
import json
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from pneud.rt.folders import cache_folder
from pure2c.cache import Cache

_KEPT = 32  # databases that stay
_OWN = Path(__file__).read_bytes()  # of what runs, whatever becomes of the file


class Signal(NamedTuple):
    """One signal, as its line in the DBC has it."""

    name: str
    start: int
    length: int
    big_endian: bool
    signed: bool
    floating: bool
    scale: float  # an int where the DBC has one, here and below
    offset: float
    minimum: float | None
    maximum: float | None
    unit: str | None
    selects: bool = False  # it is the multiplexer of others
    selector: str | None = None  # the multiplexer that it depends on
    selected_by: tuple[int, ...] = ()  # values of that with which it is there


class MessageSpec(NamedTuple):
    """One message."""

    name: str
    can_id: int
    length: int
    extended: bool
    multiplexed: bool
    signals: tuple[Signal, ...]
    fd: bool = False  # its frames are of CAN FD


def messages(dbc: bytes, *, keep: bool = False) -> list[MessageSpec]:
    """The messages of a DBC, by the cache where that is wanted and there is a place for one.

    Raises:
        Exception: it is no usable DBC; what the parser lets through is not only its own errors.
    """
    if not keep:
        return _parsed(dbc)
    name = f"{_key(dbc)}.json"
    with suppress(OSError, ValueError), Cache(cache_folder("databases"), keep=_KEPT) as cache:
        kept = cache.get(name)
        if kept is not None:
            return _unpacked(kept)
    found = _parsed(dbc)
    with suppress(OSError), Cache(cache_folder("databases"), keep=_KEPT) as cache:
        cache.put(name, json.dumps(found).encode())
    return found


def _parsed(dbc: bytes) -> list[MessageSpec]:
    import logging  # noqa: PLC0415 - slow to import, and needed by nothing but this

    import cantools  # noqa: PLC0415
    from cantools.database.can import Database  # noqa: PLC0415

    # what it warns of is nothing, or is said by whoever uses the message
    logging.getLogger("cantools").setLevel(logging.CRITICAL)
    text = io.TextIOWrapper(io.BytesIO(dbc), encoding=_encoding(dbc), errors="replace")
    database = cantools.database.load(text, database_format="dbc")
    assert isinstance(database, Database)
    return [
        MessageSpec(
            m.name,
            m.frame_id,
            m.length,
            m.is_extended_frame,
            m.is_multiplexed(),
            tuple(
                Signal(
                    s.name,
                    s.start,
                    s.length,
                    s.byte_order == "big_endian",
                    s.is_signed,
                    s.is_float,
                    s.scale,
                    s.offset,
                    s.minimum,
                    s.maximum,
                    s.unit,
                    s.is_multiplexer,
                    s.multiplexer_signal,
                    tuple(s.multiplexer_ids or ()),
                )
                for s in m.signals
            ),
            m.is_fd,
        )
        for m in database.messages
    ]


def _encoding(dbc: bytes) -> str:
    """UTF-8 where it is that, with a BOM or without, else what DBC files are by origin."""
    try:
        dbc.decode("utf-8")
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig"


def _key(dbc: bytes) -> str:
    digest = hashlib.sha256(dbc)
    digest.update(_OWN)
    spec = find_spec("cantools")
    if spec is not None and spec.origin is not None:
        found = Path(spec.origin).stat()
        digest.update(f"{spec.origin} {found.st_mtime_ns} {found.st_size}".encode())
    return digest.hexdigest()[:24]


def _unpacked(packed: bytes) -> list[MessageSpec]:
    return [
        MessageSpec._make((*fields, tuple(Signal._make((*s, tuple(by))) for *s, by in signals), fd))
        for *fields, signals, fd in json.loads(packed)
    ]
