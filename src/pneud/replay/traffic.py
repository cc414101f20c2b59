"""Frames as files of the CAN world: candump logs to the nanosecond; python-can writes the rest.

python-can carries times as floating-point seconds, which resolve a quarter of a microsecond today.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypeAlias

from pneud.bus.wire import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_FLAGS, CAN_RTR_FLAG, Fd
from pneud.log.files.naming import LogError
from pneud.replay import asc, blf, candump
from pneud.replay.passing import EXTENDED, SECOND_NS, STANDARD, Passing
from pneud.replay.remarks import Remarks
from pneud.signals import Frame

__all__ = ["FORMATS", "Passing", "read", "write"]

CANDUMP = ".log"
FORMATS = (CANDUMP, ".asc", ".blf")

_CHANNEL = "can0"


def write(path: Path, frames: Iterable[tuple[Frame, bool]], fd: Fd | None = None) -> int:
    """Write frames with Unix stamps, and whether they were sent, in a format of `FORMATS` by the suffix.

    Args:
        path: of the file.
        frames: in their order.
        fd: which of them are frames of CAN FD, apart from those that are too long for others.

    Returns:
        How many.

    Raises:
        OSError: the file cannot be written.
    """
    known = frozenset() if fd is None else fd.ids
    switches = fd is not None and fd.switches
    writer = _write_candump if path.suffix == CANDUMP else _write_other
    return writer(path, ((f, sent, f.can_id in known or len(f.data) > 8) for f, sent in frames), switches)


Kinds: TypeAlias = Iterable[tuple[Frame, bool, bool]]
"""Frames, whether they were sent, and whether they are of CAN FD."""


def _write_candump(path: Path, frames: Kinds, switches: bool) -> int:
    count = 0
    with path.open("w", encoding="ascii") as file:
        for (stamp_ns, can_id, data), sent, flexible in frames:
            seconds, ns = divmod(stamp_ns, SECOND_NS)
            long = can_id & (CAN_EFF_FLAG | CAN_ERR_FLAG)
            name = f"{can_id & (CAN_ERR_FLAG | EXTENDED):08X}" if long else f"{can_id & STANDARD:03X}"
            body = "R" if can_id & CAN_RTR_FLAG else data.hex().upper()
            body = f"#{int(switches)}{body}" if flexible else body
            file.write(f"({seconds:010}.{ns:09}) {_CHANNEL} {name}#{body} {'T' if sent else 'R'}\n")
            count += 1
    return count


def _write_other(path: Path, frames: Kinds, switches: bool) -> int:
    import can  # noqa: PLC0415  (slow to import, and candump logs do without)

    count = 0
    with can.Logger(path) as file:
        for (stamp_ns, can_id, data), sent, flexible in frames:
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
                    is_fd=flexible,
                    bitrate_switch=flexible and switches,
                )
            )
            count += 1
    return count


def read(path: Path, remarks: Remarks | None = None, *, fd: bool = False) -> Iterator[Passing]:
    """The frames of a recording in their order; its suffix is one of `FORMATS`.

    Those of CAN FD are passed over unless `fd`.

    Raises:
        LogError: the file cannot be read, or is no recording.
    """
    remarks = Remarks() if remarks is None else remarks
    suffix = path.suffix.lower()
    try:
        if suffix == CANDUMP:
            yield from candump.read(path, remarks, fd=fd)
        else:
            yield from {".asc": asc.read, ".blf": blf.read}[suffix](path, remarks, fd=fd)
    except OSError as e:
        raise LogError(f"{path}: cannot be read: {e.strerror or e}") from None
