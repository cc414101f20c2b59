"""Recordings of one short run as the programs of the CAN world write them."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path

import can

from pneud.bus.wire import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_FLAGS, CAN_RTR_FLAG
from pneud.signals import Frame

Recorded = list[tuple[Frame, bool]]  # with Unix stamps, and whether the controller sent it

ASC_HEAD = (
    "date Tue Nov 14 22:13:20.123 2023\n"
    "base hex  timestamps {}\n"
    "internal events logged\n"
    "// version 9.0.0\n"
    "Begin Triggerblock Tue Nov 14 22:13:20.123 2023\n"
    "   0.000000 Start of measurement\n"
)


def message(frame: Frame, sent: bool) -> can.Message:
    """As python-can has it."""
    return can.Message(
        timestamp=frame.stamp_ns / 1e9,
        arbitration_id=frame.can_id & ~CAN_FLAGS,
        is_extended_id=bool(frame.can_id & CAN_EFF_FLAG),
        is_remote_frame=bool(frame.can_id & CAN_RTR_FLAG),
        is_error_frame=bool(frame.can_id & CAN_ERR_FLAG),
        is_rx=not sent,
        dlc=len(frame.data),
        data=frame.data,
        channel=0,
    )


def can_logger(path: Path, frames: Recorded) -> None:
    """What `python -m can.logger` writes while it listens: every frame is received."""
    with can.Logger(path) as file:
        for frame, _ in frames:
            file.on_message_received(message(frame, False))


def candump(path: Path, frames: Recorded, way: Callable[[bool], str] = lambda _: "") -> None:
    """What `candump -l` writes; `way` says what stands for the direction."""
    lines = (
        f"({f.stamp_ns // 10**9}.{f.stamp_ns // 1000 % 10**6:06}) can0 {f.can_id:03X}#{f.data.hex().upper()}"
        f"{way(sent)}\n"
        for f, sent in frames
    )
    path.write_text("".join(lines))


def vector_asc(
    path: Path, frames: Recorded, *, relative: bool = False, requests: bool = False, offset_s: float = 0.0
) -> None:
    """What Vector's tools write, with events of other kinds among the frames.

    Args:
        path: where to.
        frames: what was on the bus.
        relative: stamps count from the line before.
        requests: a line that asks for it comes before every frame that was sent.
        offset_s: added to all stamps.
    """
    start_ns = 1_700_000_000_123_000_000
    lines = [ASC_HEAD.format("relative" if relative else "absolute")]
    last_ns = start_ns

    def line(stamp_ns: int, text: str) -> None:
        nonlocal last_ns
        stamp_s = (stamp_ns - (last_ns if relative else start_ns)) / 1e9 + offset_s
        last_ns = stamp_ns
        lines.append(f"{stamp_s:11.6f} {text}\n")

    for n, (f, sent) in enumerate(frames):
        stamp_ns = max(f.stamp_ns // 1000 * 1000, last_ns if relative else 0)
        if n % 100 == 0:
            line(stamp_ns, "1  Statistic: D 0 R 0 XD 0 XR 0 E 0 O 0 B 0.00%")
            line(stamp_ns, "CAN 1 Status:chip status error active")
        if requests and sent:
            line(stamp_ns, f"1  {f.can_id:<15X} TxRq d {len(f.data)} {f.data.hex(' ').upper()}")
        way = "Tx  " if sent else "Rx  "
        tail = "  Length = 242000 BitCount = 125 ID = 385"
        line(stamp_ns, f"1  {f.can_id:<15X} {way} d {len(f.data)} {f.data.hex(' ').upper()}{tail}")
    lines.append("End TriggerBlock\n")
    path.write_text("".join(lines))


def blf_object(kind: int, content: bytes, stamp_ns: int = 0, size: int | None = None) -> bytes:
    """An object of a BLF with its padding."""
    length = 32 + len(content)
    head = struct.pack("<4sHHLL", b"LOBJ", 32, 1, length if size is None else size, kind)
    return head + struct.pack("<LHHQ", 2, 0, 0, stamp_ns) + content + bytes(length % 4)


def blf_frame(frame: Frame, start_ns: int = 0, size: int | None = None) -> bytes:
    """A received classic frame as an object."""
    content = struct.pack("<HBBL8s", 1, 0, len(frame.data), frame.can_id, frame.data)
    return blf_object(1, content, frame.stamp_ns - start_ns, size)


def blf(objects: Iterable[bytes], *, count: int = 0, containers: int = 3, level: int = 6) -> bytes:
    """A BLF file: the objects as one stream, cut into containers anywhere."""
    stream = b"".join(objects)
    step = max(1, -(-len(stream) // containers))
    parts = []
    for at in range(0, len(stream), step):
        piece = stream[at : at + step]
        packed = zlib.compress(piece, level) if level else piece
        size = 32 + len(packed)
        parts.append(struct.pack("<4sHHLL", b"LOBJ", 16, 1, size, 10))
        parts.append(struct.pack("<H6xL4x", 2 if level else 0, len(piece)) + packed + bytes(size % 4))
    body = b"".join(parts)
    began = (2023, 11, 2, 14, 22, 13, 20, 0)
    head = struct.pack(
        "<4sL8BQQLL16H", b"LOGG", 144, *bytes(8), 144 + len(body), 144, count, 0, *began, *began
    )
    return head.ljust(144, b"\0") + body
