"""Frames as files of the CAN world: candump logs to the nanosecond, the rest through python-can.

python-can carries times as floating-point seconds, which resolve a quarter of a microsecond today.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from pneud.bus.wire import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_FLAGS, CAN_RTR_FLAG
from pneud.log.files.naming import LogError
from pneud.rt.outputs import replacing
from pneud.signals import Frame

CANDUMP = ".log"
FORMATS = (CANDUMP, ".asc", ".blf")

_S = 1_000_000_000
_LINE = re.compile(
    r"\((\d+)\.(\d{1,9})\)\s+(\S+)\s+([0-9A-Fa-f]{3,8})#(?:(R)[0-8]?|([0-9A-Fa-f]{0,16}))(?:\s+([RT]))?\s*$"
)
_CHANNEL = "can0"
_STANDARD, _EXTENDED = 0x7FF, 0x1FFFFFFF


class Passing(NamedTuple):
    """One frame in a recording."""

    frame: Frame  # its stamp is Unix time
    channel: str
    sent: bool | None  # by whoever recorded; None where the recording does not say


def write(path: Path, frames: Iterable[tuple[Frame, bool]]) -> int:
    """Write frames in their order.

    Args:
        path: its suffix is one of `FORMATS`.
        frames: with Unix stamps, and whether they were sent.

    Returns:
        How many.

    Raises:
        OSError: the file cannot be written.
    """
    with replacing(path) as beside:
        return _write_candump(beside, frames) if path.suffix == CANDUMP else _write_other(beside, frames)


def _write_candump(path: Path, frames: Iterable[tuple[Frame, bool]]) -> int:
    count = 0
    with path.open("w", encoding="ascii") as file:
        for (stamp_ns, can_id, data), sent in frames:
            seconds, ns = divmod(stamp_ns, _S)
            long = can_id & (CAN_EFF_FLAG | CAN_ERR_FLAG)
            name = f"{can_id & (CAN_ERR_FLAG | _EXTENDED):08X}" if long else f"{can_id & _STANDARD:03X}"
            body = "R" if can_id & CAN_RTR_FLAG else data.hex().upper()
            file.write(f"({seconds:010}.{ns:09}) {_CHANNEL} {name}#{body} {'T' if sent else 'R'}\n")
            count += 1
    return count


def _write_other(path: Path, frames: Iterable[tuple[Frame, bool]]) -> int:
    import can  # noqa: PLC0415  (slow to import, and candump logs do without)

    count = 0
    with can.Logger(path) as file:
        for (stamp_ns, can_id, data), sent in frames:
            file.on_message_received(
                can.Message(
                    timestamp=stamp_ns / 1e9,
                    arbitration_id=can_id & ~CAN_FLAGS,
                    is_extended_id=bool(can_id & CAN_EFF_FLAG),
                    is_remote_frame=bool(can_id & CAN_RTR_FLAG),
                    is_error_frame=bool(can_id & CAN_ERR_FLAG),
                    is_rx=not sent,
                    dlc=len(data),
                    data=data,
                    channel=0,
                )
            )
            count += 1
    return count


def read(path: Path) -> Iterator[Passing]:
    """The classic frames of a recording in their order; frames of CAN FD are passed over.

    Raises:
        LogError: the file cannot be read, or is no recording.
    """
    try:
        yield from _read_candump(path) if path.suffix == CANDUMP else _read_other(path)
    except OSError as e:
        raise LogError(f"{path}: cannot be read: {e.strerror or e}") from None


def _read_candump(path: Path) -> Iterator[Passing]:
    with path.open(encoding="ascii", errors="replace") as file:
        for number, line in enumerate(file, start=1):
            found = _LINE.match(line)
            if found is None:
                if not line.strip() or "##" in line:  # CAN FD
                    continue
                raise LogError(f"{path}, line {number}: not a line of a candump log (candump -l, candump -L)")
            seconds, fraction, channel, name, remote, body, direction = found.groups()
            can_id = int(name, 16)
            if len(name) > 3 and not can_id & CAN_ERR_FLAG:
                can_id |= CAN_EFF_FLAG
            if remote:
                can_id |= CAN_RTR_FLAG
            stamp_ns = int(seconds) * _S + int(fraction.ljust(9, "0"))
            frame = Frame(stamp_ns, can_id, bytes.fromhex(body or ""))
            yield Passing(frame, channel, None if direction is None else direction == "T")


def _read_other(path: Path) -> Iterator[Passing]:
    import can  # noqa: PLC0415

    try:
        # an .asc counts from its head's date, of which other formats know nothing
        options = {"relative_timestamp": False} if path.suffix == ".asc" else {}
        with can.LogReader(path, **options) as messages:
            for m in messages:
                if m.is_fd:
                    continue
                can_id = m.arbitration_id & (_EXTENDED if m.is_extended_id else _STANDARD)
                can_id |= CAN_EFF_FLAG if m.is_extended_id else 0
                can_id |= CAN_RTR_FLAG if m.is_remote_frame else 0
                can_id |= CAN_ERR_FLAG if m.is_error_frame else 0
                frame = Frame(round(m.timestamp * 1e9), can_id, bytes(m.data))
                yield Passing(frame, str(m.channel), not m.is_rx)
    except OSError:
        raise
    except Exception as e:  # each format has errors of its own
        raise LogError(f"{path}: not a recording that python-can reads: {' '.join(str(e).split())}") from None
