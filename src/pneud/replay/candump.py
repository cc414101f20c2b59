"""Logs of candump (-l, -L) and of python-can, read line by line."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from pneud.bus.wire import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG
from pneud.replay.passing import EXTENDED, FD, NO_IDENTIFIER, STANDARD, XL, Passing, decimal_ns
from pneud.replay.remarks import Remarks
from pneud.replay.text_lines import CUT, lines
from pneud.signals import Frame

_BEGINNING = r"\((-?)(\d{1,20})(?:\.(\d+))?\)\s+(\S+)\s+([0-9A-F]{3,8})#"
# behind the data, a DLC above 8 may stand; a frame that is asked for may have its length there
_LINE = re.compile(
    _BEGINNING + r"(?:(R)[0-8]?|((?:[0-9A-F]{2}){0,8}))(?:_[9A-F])?(?:\s+([RT]))?", re.ASCII | re.IGNORECASE
)
_FD = re.compile(_BEGINNING + r"#", re.ASCII | re.IGNORECASE)
_FD_LINE = re.compile(
    _BEGINNING + r"#[0-9A-F]()((?:[0-9A-F]{2}){0,64})(?:\s+([RT]))?", re.ASCII | re.IGNORECASE
)
_XL = re.compile(_BEGINNING + r"[0-9A-F]{2}:", re.ASCII | re.IGNORECASE)
_COMMENT = "a comment"
_FOREIGN = "not a line of a candump log (candump -l, candump -L), passed over"


def read(path: Path, remarks: Remarks, *, fd: bool = False) -> Iterator[Passing]:
    """The frames of a log in their order; those of CAN FD only where they are wanted.

    Raises:
        OSError: the file cannot be read.
        LogError: it is UTF-16.
    """
    for line in lines(path, remarks):
        found = _LINE.fullmatch(line.text) or (fd and _FD_LINE.fullmatch(line.text)) or None
        if found is None:
            if _FD.match(line.text):
                remarks.add(FD, line.place)
            elif _XL.match(line.text):
                remarks.add(XL, line.place)
            elif line.text.startswith(("#", "//")):
                remarks.add(_COMMENT, line.place, partial=False)
            else:
                remarks.add(_FOREIGN if line.whole else CUT, line.place)
            continue
        sign, seconds, fraction, channel, name, remote, body, direction = found.groups()
        can_id = int(name, 16)
        if can_id > (STANDARD if len(name) == 3 else EXTENDED | CAN_ERR_FLAG):
            remarks.add(NO_IDENTIFIER, line.place)
            continue
        if len(name) > 3 and not can_id & CAN_ERR_FLAG:
            can_id |= CAN_EFF_FLAG
        if remote:
            can_id |= CAN_RTR_FLAG
        frame = Frame(decimal_ns(sign, seconds, fraction), can_id, bytes.fromhex(body or ""))
        yield Passing(frame, channel, None if direction is None else direction in "Tt")
