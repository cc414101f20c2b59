"""One file of a log: MCAP with everything in its head that it takes to read it alone."""

from __future__ import annotations

import base64
import contextlib
import fcntl
import json
import os
import time
import zlib
from typing import TYPE_CHECKING

from mcap.records import Metadata

from pneud.log.files.container import Container, message_head
from pneud.log.files.saving import LogOutput
from pneud.log.format.fingerprint import numeric_fingerprint, versions
from pneud.log.format.framing import DamageError
from pneud.log.format.header import LogHeader
from pneud.log.format.meanings import SCHEMA
from pneud.log.format.schema import COPY, KEPT, METADATA, SETUP, topics

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

CRC = "crc32"  # key of the metadata's checksum, which MCAP has none for
_OWN = frozenset((METADATA, SETUP, KEPT, COPY))  # names of metadata that always has one
_SEQUENCES = 1 << 32  # that messages count to
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


class LogPart:
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
        self.output = LogOutput(descriptor)
        with contextlib.suppress(OSError):  # tells retention that it is being written
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._header = h = header
        self._file = f = Container(self.output, f"pneud {versions().get('pneud', '')}".strip())
        now_ns = time.time_ns()
        f.attach(now_ns, h.config_name, "application/toml", h.config_text.encode())
        f.attach(now_ns, h.dbc_name, "application/vnd.can-dbc", h.dbc)
        self._head = checked(head_of(h, more))
        f.metadata(METADATA, self._head)
        self._channels = {
            t.topic: f.channel(t.topic, t.encoding, t.schema, t.schema_encoding, t.descriptors)
            for t in topics(h.detail)
        }
        self.output.settle()

    @property
    def chunk_bytes(self) -> int:
        """Size of the messages of the open chunk, uncompressed."""
        return self._file.chunk_bytes

    def message(self, topic: str, number: int, log_time_ns: int, data: bytes) -> None:
        """Add a message to the open chunk."""
        self._file.message(self._channels[topic], number % _SEQUENCES, log_time_ns, data)

    def head_of_message(self, topic: str, length: int) -> bytes:
        """What a message begins with, whose number and times are 0."""
        return message_head(self._channels[topic], 0, 0, length)

    def messages(self, topic: str, log_times_ns: NDArray[np.uint64], rows: NDArray[np.uint8]) -> None:
        """Add messages of one length, each with its head, to the open chunk."""
        self._file.messages(self._channels[topic], log_times_ns, rows)

    def metadata(self, name: str, data: dict[str, str]) -> None:
        """Add metadata, before the chunk that is open."""
        self._file.metadata(name, checked(data))

    def close_chunk(self) -> None:
        """What comes next goes into another chunk."""
        self._file.close_chunk()

    def finish(self) -> None:
        """Repeat the head, write the index."""
        self.close_chunk()
        h = self._header
        copy = {**self._head, CONFIG_TEXT: h.config_text, DBC: base64.b64encode(h.dbc).decode()}
        self.metadata(COPY, copy)
        self._file.finish()
