"""One file of a log: MCAP with everything in its head that it takes to read it alone."""

from __future__ import annotations

import base64
import contextlib
import fcntl
import json
import os
import time
import zlib

from mcap.records import Metadata

from pneud.log.files.container import Container
from pneud.log.files.output import Output
from pneud.log.format.fingerprint import numeric_fingerprint, versions
from pneud.log.format.framing import DamageError
from pneud.log.format.header import LogHeader
from pneud.log.format.schema import COPY, KEPT, METADATA, SCHEMA, SETUP, topics

CRC = "crc32"  # key of the metadata's checksum, which MCAP has none for
_OWN = frozenset((METADATA, SETUP, KEPT, COPY))  # names of metadata that always has one
CONFIG_TEXT, DBC = "config_text", "dbc_base64"  # keys in the copy of the head


def crc_of_metadata(data: dict[str, str]) -> str:
    """CRC-32 of everything in it but the checksum itself, as eight hexadecimal digits."""
    rest = sorted((key, value) for key, value in data.items() if key != CRC)
    return f"{zlib.crc32(json.dumps(rest).encode()):08x}"


def checked(data: dict[str, str]) -> dict[str, str]:
    """Metadata with its checksum."""
    return {**data, CRC: crc_of_metadata(data)}


def check_intact(found: Metadata, offset: int) -> None:
    """Make sure that metadata is as it was written; that of other programs has no checksum and passes.

    Args:
        found: the metadata.
        offset: where it lies in its file.

    Raises:
        DamageError: its checksum is another one, or missing.
    """
    crc = found.metadata.get(CRC)
    if found.name in _OWN if crc is None else crc != crc_of_metadata(found.metadata):
        raise DamageError(f"damaged at byte {offset}: checksum of metadata")


def head_of(h: LogHeader, more: dict[str, str]) -> dict[str, str]:
    """The metadata on a run."""
    return {
        "schema": str(SCHEMA),
        "name": h.name,
        "bus": h.bus,
        "rate_hz": repr(h.rate_hz),
        "detail": h.detail,
        "config": h.config_name,
        "dbc": h.dbc_name,
        "faults": ",".join(h.fault_names),
        "realtime_offset_ns": str(h.realtime_offset_ns),
        "host": os.uname().nodename,
        "fingerprint": numeric_fingerprint(),
        **versions(),
        **h.extra,
        **more,
    }


class Part:
    """A file that is being written.

    Attributes:
        output: where its bytes go.
    """

    def __init__(self, descriptor: int, header: LogHeader, more: dict[str, str]) -> None:
        """Write the head.

        Args:
            descriptor: of the new file (see `create_log`); closed by `close`.
            header: what the log says about its run.
            more: metadata on this file.
        """
        self.output = Output(descriptor)
        with contextlib.suppress(OSError):  # tells retention that it is being written
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._header = h = header
        self._container = c = Container(self.output, f"pneud {versions().get('pneud', '')}".strip())
        now_ns = time.time_ns()
        c.attach(now_ns, h.config_name, "application/toml", h.config_text.encode())
        c.attach(now_ns, h.dbc_name, "application/vnd.can-dbc", h.dbc)
        self._head = checked(head_of(h, more))
        c.metadata(METADATA, self._head)
        self._channels = {
            t.topic: c.register(t.topic, t.encoding, t.schema, t.schema_encoding, t.descriptors)
            for t in topics(h.detail)
        }
        self.output.settle()

    @property
    def chunk_bytes(self) -> int:
        """Size of the chunk that is open, uncompressed."""
        return self._container.chunk_bytes

    def message(self, topic: str, number: int, log_time_ns: int, data: bytes) -> None:
        """Add a message to the open chunk.

        Args:
            topic: one of `topics`.
            number: of the record that it belongs to.
            log_time_ns: Unix time.
            data: the message.
        """
        self._container.message(self._channels[topic], number & 0xFFFF_FFFF, log_time_ns, data)

    def metadata(self, name: str, data: dict[str, str]) -> None:
        """Add metadata, before the chunk that is open."""
        self._container.metadata(name, checked(data))

    def close_chunk(self) -> None:
        """What comes next goes into another chunk."""
        self._container.close_chunk()

    def finish(self) -> None:
        """Repeat the head, write the index."""
        self.close_chunk()
        h = self._header
        copy = {**self._head, CONFIG_TEXT: h.config_text, DBC: base64.b64encode(h.dbc).decode()}
        self.metadata(COPY, copy)
        self._container.finish()
