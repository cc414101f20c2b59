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
from mcap.writer import Writer

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
_UNBOUNDED = 1 << 62
MESSAGE_BYTES = 31  # of a message's head
_SEQUENCE = 0xFFFF_FFFF  # to which messages are counted
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
        chunk_bytes: size of the chunk that is open, uncompressed.
    """

    def __init__(self, descriptor: int, header: LogHeader, more: dict[str, str]) -> None:
        """Write the head.

        Args:
            descriptor: of the new file (see `create_log`); closed by `close`.
            header: what the log says about its run.
            more: metadata on this file.
        """
        self.output = LogOutput(descriptor)
        self.chunk_bytes = 0
        with contextlib.suppress(OSError):  # tells retention that it is being written
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._header = h = header
        # It would close a chunk between a tick and its frames: chunks are closed here.
        self._writer = w = Writer(self.output, chunk_size=_UNBOUNDED)  # type: ignore[arg-type]
        w.start(library=f"pneud {versions().get('pneud', '')}".strip())
        now_ns = time.time_ns()
        for name, kind, data in (
            (h.config_name, "application/toml", h.config_text.encode()),
            (h.dbc_name, "application/vnd.can-dbc", h.dbc),
        ):
            w.add_attachment(now_ns, now_ns, name, kind, data)
        self._head = checked(head_of(h, more))
        w.add_metadata(METADATA, self._head)
        self._channels: dict[str, int] = {}
        for t in topics(h.detail):
            schema = w.register_schema(t.schema, t.schema_encoding, t.descriptors)
            self._channels[t.topic] = w.register_channel(t.topic, t.encoding, schema)
        self.output.settle()

    def message(self, topic: str, number: int, log_time_ns: int, data: bytes) -> None:
        """Add a message to the open chunk."""
        self.chunk_bytes += len(data) + MESSAGE_BYTES
        sequence = number & _SEQUENCE
        self._writer.add_message(self._channels[topic], log_time_ns, data, log_time_ns, sequence)

    def messages(
        self, topic: str, number: int, log_times_ns: NDArray[np.uint64], rows: NDArray[np.uint8]
    ) -> None:
        """Add messages of one length to the open chunk.

        Args:
            topic: of all of them.
            number: of the first one.
            log_times_ns: of each.
            rows: their bytes.
        """
        count, length = rows.shape
        self.chunk_bytes += count * (length + MESSAGE_BYTES)
        add, channel, data = self._writer.add_message, self._channels[topic], rows.tobytes()
        for i, time_ns in enumerate(log_times_ns.tolist()):
            add(channel, time_ns, data[i * length : (i + 1) * length], time_ns, number + i & _SEQUENCE)

    def metadata(self, name: str, data: dict[str, str]) -> None:
        """Add metadata, before the chunk that is open."""
        self._writer.add_metadata(name, checked(data))

    def close_chunk(self) -> None:
        """What comes next goes into another chunk."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        self.chunk_bytes = 0

    def finish(self) -> None:
        """Repeat the head, write the index."""
        self.close_chunk()
        h = self._header
        copy = {**self._head, CONFIG_TEXT: h.config_text, DBC: base64.b64encode(h.dbc).decode()}
        self.metadata(COPY, copy)
        self._writer.finish()  # type: ignore[no-untyped-call]
