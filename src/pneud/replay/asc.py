"""Vector's text recordings (.asc), read line by line.

What python-can makes of them is not enough here: it takes stamps that are relative to the line before for
absolute ones, requests to send (TxRq) for frames, and drops what has a negative stamp.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

from pneud.bus.wire import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, FD_LENGTHS
from pneud.replay.passing import (
    EXTENDED,
    FD,
    NO_IDENTIFIER,
    REQUEST,
    SECOND_NS,
    STANDARD,
    XL,
    Passing,
    decimal_ns,
)
from pneud.replay.remarks import Remarks
from pneud.replay.text_lines import CUT, Line, lines
from pneud.signals import Frame

_STAMPED = re.compile(r"(-?)(\d{1,20})(?:\.(\d+))?\s+(\S.*)", re.ASCII)
_BASE = re.compile(r"base\s+(hex|dec)(?:\s+timestamps\s+(absolute|relative))?", re.IGNORECASE)
_DATE = re.compile(r"(?:date|begin\s+triggerblock)\b(.*)", re.IGNORECASE)
_WHEN = re.compile(
    r"\s+\S+\s+(\S+)\s+(\d+)\s+(\d+):(\d+):(\d+)(?:\.(\d{1,6}))?(?:\s+([ap])m)?\s+(\d{4})",
    re.ASCII | re.IGNORECASE,
)
_MONTHS = {
    "jan": 1, "feb": 2, "mar": 3, "apr": 4, "may": 5, "jun": 6, "jul": 7, "aug": 8, "sep": 9, "oct": 10,
    "nov": 11, "dec": 12, "mär": 3, "mrz": 3, "mai": 5, "okt": 10, "dez": 12,
}  # fmt: skip
_HEAD = re.compile(
    r"//.*|(?:no\s+)?internal\s+events\s+logged|(?:begin|end)\s+triggerblock|date|previous\s+log\s+file.*",
    re.IGNORECASE,
)
_EVENT = re.compile(r"//.*|start of measurement|can \d+ status.*|log .*|comment.*", re.IGNORECASE)

_OTHER = "an event that is no frame of a CAN bus"
_NO_DATE = "not a date"
_FOREIGN = "not a line of an .asc, passed over"
_UNLIKE = "not a frame, passed over"
_NAMED = "a message by its name instead of its number, passed over"
_MARKER = "GMGroup:"
_EDL, _REMOTE = 0x1000, 0x10  # flags of CANFD lines: a frame of CAN FD, a frame that is asked for


class _UnreadableError(Exception):
    """A line is not the frame that it should be; the text says why."""


def read(path: Path, remarks: Remarks, *, fd: bool = False) -> Iterator[Passing]:
    """The frames of a recording in their order; those of CAN FD only where they are wanted.

    Raises:
        OSError: the file cannot be read.
        LogError: it is UTF-16.
    """
    state = _State(remarks, fd)
    for line in lines(path, remarks):
        try:
            passing = state.take(line)
            if not line.whole and passing is not None and line.text[-2] == " ":
                raise _UnreadableError(CUT)  # half a byte, perhaps
        except _UnreadableError as e:
            remarks.add(str(e) if line.whole else CUT, line.place)
        else:
            if passing is not None:
                yield passing


class _State:
    """What the lines so far say about those that follow."""

    def __init__(self, remarks: Remarks, fd: bool) -> None:
        self._remarks = remarks
        self._takes_fd = fd
        self._base = 16
        self._relative = False
        self._date_ns: int | None = None  # to count from, unless the stamps just go on
        self._origin_ns = 0
        self._stamp_ns: int | None = None  # of the last line

    def take(self, line: Line) -> Passing | None:
        """The frame of a line, if it is one."""
        stamped = _STAMPED.fullmatch(line.text)
        if stamped is None:
            self._head(line)
            return None
        sign, seconds, fraction, rest = stamped.groups()
        time_ns = self._time_ns(decimal_ns(sign, seconds, fraction))
        return self._event(line, time_ns, rest.split())

    def _head(self, line: Line) -> None:
        if (base := _BASE.fullmatch(line.text)) is not None:
            self._base = 10 if base[1].lower() == "dec" else 16
            self._relative = (base[2] or "").lower() == "relative"
        elif (date := _DATE.match(line.text)) is not None and date[1].strip():
            found_ns = _unix_ns(date[1])
            if found_ns is None:
                self._remarks.add(_NO_DATE, line.place, partial=False)
            else:
                self._date_ns = found_ns
        elif not _HEAD.fullmatch(line.text):
            raise _UnreadableError(_FOREIGN)

    def _time_ns(self, stamp_ns: int) -> int:
        last_ns = self._stamp_ns
        # a later block has the date of its trigger, while its stamps count from the first one's
        if self._date_ns is not None and (last_ns is None or self._relative or stamp_ns <= last_ns):
            self._origin_ns = self._date_ns
            self._date_ns = None
        self._stamp_ns = stamp_ns
        if self._relative:
            self._origin_ns += stamp_ns
            return self._origin_ns
        return self._origin_ns + stamp_ns

    def _event(self, line: Line, time_ns: int, words: list[str]) -> Passing | None:
        kind = words[0].upper()
        if kind == "CANFD":
            return self._fd(line, time_ns, words[1:])
        if kind == "CANXL":
            raise _UnreadableError(XL)
        if not (kind.isascii() and kind.isdecimal()):
            if not _EVENT.fullmatch(" ".join(words)):
                self._remarks.add(_OTHER, line.place, partial=False)
            return None
        what = words[1].lower() if len(words) > 1 else ""
        if what.startswith(("statistic", "overloadframe")):
            return None
        channel = _channel(kind)
        if what == "j1939tp" or _MARKER in words:  # made of frames that stand by themselves, or of none
            self._remarks.add(_OTHER, line.place, partial=False)
            return None
        if what.startswith("errorframe"):
            return Passing(Frame(time_ns, CAN_ERR_FLAG, b""), channel, False)
        return self._classic(line, time_ns, channel, words[1:])

    def _classic(self, line: Line, time_ns: int, channel: str, words: list[str]) -> Passing | None:
        if len(words) < 3:
            raise _UnreadableError(_UNLIKE)
        name, direction, kind = words[0], words[1].lower(), words[2].lower()
        if direction == "txrq":
            self._remarks.add(REQUEST, line.place, partial=False)
            return None
        if direction not in ("rx", "tx") or kind not in ("d", "r"):
            raise _UnreadableError(_UNLIKE)
        can_id, data = self._identifier(name), b""
        if kind == "r":
            can_id |= CAN_RTR_FLAG
        else:
            data = self._data(words[4:], min(self._number(words[3:4]), 8))
        return Passing(Frame(time_ns, can_id, data), channel, direction == "tx")

    def _fd(self, line: Line, time_ns: int, words: list[str]) -> Passing | None:
        """A line for buses that carry CAN FD; the frame may be a classic one all the same."""
        try:
            channel, direction, name, *rest = words
            if not rest[0].isdecimal():  # its name in a database
                rest = rest[1:]
            length = int(rest[3])
            flags = int(rest[4 + length + 2], 16)
        except (ValueError, IndexError):
            raise _UnreadableError(FD) from None
        if not channel.isdecimal() or (flags & _EDL and not self._takes_fd):
            raise _UnreadableError(FD)
        if flags & _EDL:
            return self._flexible(line, time_ns, _channel(channel), direction.lower(), name, length, rest[4:])
        kind = "r" if flags & _REMOTE else "d"
        return self._classic(
            line, time_ns, _channel(channel), [name, direction, kind, rest[3], *rest[4 : 4 + length]]
        )

    def _flexible(
        self,
        line: Line,
        time_ns: int,
        channel: str,
        direction: str,
        name: str,
        length: int,
        data: list[str],
    ) -> Passing | None:
        if direction == "txrq":
            self._remarks.add(REQUEST, line.place, partial=False)
            return None
        if direction not in ("rx", "tx") or length not in FD_LENGTHS:
            raise _UnreadableError(_UNLIKE)
        frame = Frame(time_ns, self._identifier(name), self._data(data, length))
        return Passing(frame, channel, direction == "tx")

    def _identifier(self, name: str) -> int:
        extended = name[-1] in "xX"
        can_id = self._number([name[:-1] if extended else name], _NAMED)
        if can_id > (EXTENDED if extended else STANDARD):
            raise _UnreadableError(NO_IDENTIFIER)
        return can_id | (CAN_EFF_FLAG if extended else 0)

    def _data(self, words: list[str], length: int) -> bytes:
        try:
            data = bytes([self._number([word]) for word in words[:length]])
        except ValueError:
            raise _UnreadableError(_UNLIKE) from None
        if len(data) < length:
            raise _UnreadableError(_UNLIKE)
        return data

    def _number(self, words: list[str], otherwise: str = _UNLIKE) -> int:
        if len(words) != 1 or not (words[0].isascii() and words[0].isalnum() and len(words[0]) < 12):
            raise _UnreadableError(otherwise)
        try:
            return int(words[0], self._base)
        except ValueError:
            raise _UnreadableError(otherwise) from None


def _channel(digits: str) -> str:
    """The channel as python-can numbers it: from 0."""
    return str(int(digits[:9]) - 1)


def _unix_ns(text: str) -> int | None:
    """What a date says, in local time; None where it says nothing."""
    found = _WHEN.fullmatch(text)
    month = None if found is None else _MONTHS.get(found[1].lower().rstrip("."))
    if found is None or month is None:
        return None
    day, hour, minute, second = map(int, found.groups()[1:5])
    if found[7]:
        hour = hour % 12 + (12 if found[7] in "pP" else 0)
    fraction = found[6] or "0"  # python-can writes the milliseconds without leading zeros
    us = int(fraction) * 1000 if len(fraction) <= 3 else int(fraction.ljust(6, "0"))
    try:
        whole = datetime(int(found[8]), month, day, hour, minute, second)
        return round(whole.timestamp()) * SECOND_NS + us * 1000
    except (ValueError, OverflowError, OSError):
        return None
