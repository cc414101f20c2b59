"""Lines of a text that someone else wrote: in UTF-8 or cp1252, with a BOM, cut short, with NULs in it."""

from __future__ import annotations

import codecs
from collections.abc import Iterator
from io import TextIOWrapper
from pathlib import Path
from typing import NamedTuple

from pneud.log.files.naming import LogError
from pneud.replay.remarks import Remarks
from pneud.rt.inputs import open_file

CUT = "cut short where the file ends, passed over"
_NULS = "NUL bytes, as a loss of power leaves them, passed over"
_BLANK = b"\0 \t\r\n"
_LONGEST = 1 << 16  # bytes; what is longer is no line


class Line(NamedTuple):
    """One line."""

    number: int
    text: str  # without white space about it; never empty
    whole: bool  # it ends with a newline

    @property
    def place(self) -> str:
        """In words."""
        return f"line {self.number}"


def lines(path: Path, remarks: Remarks) -> Iterator[Line]:
    """The lines that are not empty.

    Raises:
        OSError: the file cannot be read.
        LogError: it is UTF-16.
    """
    with open_file(path) as file, TextIOWrapper(file, "latin-1") as text:  # a lone CR ends a line as well

        def readline() -> bytes:
            return text.readline(_LONGEST).encode("latin-1")

        number = 0
        while piece := readline():
            number += 1
            if number == 1:
                if piece.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
                    raise LogError(f"{path}: is UTF-16; save it as UTF-8")
                piece = piece.removeprefix(codecs.BOM_UTF8)
            has_nuls = b"\0" in (piece[:1], piece[-1:])
            line = piece.strip(_BLANK)
            while not piece.endswith(b"\n") and (more := readline()):
                piece = more
                if len(line) < _LONGEST:
                    line += piece.strip(_BLANK)
            if has_nuls:
                remarks.add(_NULS, f"line {number}")
            if said := _text(line).strip():
                yield Line(number, said, piece.endswith(b"\n"))


def _text(line: bytes) -> str:
    try:
        return line.decode()
    except UnicodeDecodeError:
        return line.decode("cp1252", errors="replace")
