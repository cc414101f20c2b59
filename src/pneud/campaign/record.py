"""What of a campaign is done: a file that only grows, a line for each finished chunk.

A line is there whole or not at all: it carries a checksum, and is on the disk before the next one. Whatever
is killed, and whenever, the runs of all whole lines are done, and no others.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pneud import __version__
from pneud.campaign.rows import Rows
from pneud.campaign.unit import Cell

NAME = "runs.jsonl"
_CUT_HEAD = re.compile(rb'[0-9a-f]{0,8}|[0-9a-f]{8} (\{("c[^\n]*)?)?')  # of a record that has just been begun
Span = tuple[int, int]
"""Runs from the first number to before the second one."""


class RecordError(Exception):
    """A folder cannot take a campaign; one line for a person.

    Args:
        text: the line.
        exit_code: 2 where another one is meant, 3 where the machine refuses.
    """

    def __init__(self, text: str, exit_code: int = 2) -> None:
        super().__init__(text)
        self.exit_code = exit_code


class Chunk(NamedTuple):
    """Runs that one worker has done, one after the other."""

    begin: int
    end: int
    rows: list[list[Cell]]
    cost_s: float  # of all of them
    fingerprint: str  # how the worker's mathematics rounds


class Record:
    """The file in a folder, which nobody else may write meanwhile.

    Args:
        folder: made where it is missing.
        digest: of the plan.
        columns: of the rows.

    Raises:
        RecordError: the folder has another campaign, or somebody is at work in it.
        OSError: it cannot be written.
    """

    def __init__(self, folder: Path, digest: str, columns: Sequence[str]) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.path = folder / NAME
        self._file = self.path.open("a+b", buffering=0)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._file.close()
            raise RecordError(f"{folder}: somebody is at work in it; end that, or wait for it") from None
        head = {"campaign": digest, "columns": list(columns), "pneud": __version__}
        try:
            self._begin(folder, head)
        except BaseException:
            self._file.close()
            raise

    def _begin(self, folder: Path, head: dict[str, Any]) -> None:
        first, whole = None, 0
        for line, end in _whole_lines(self.path):
            first = first or line
            whole = end
        if first is None and not _CUT_HEAD.fullmatch(self.path.read_bytes()):
            raise RecordError(f"{self.path}: is no record of a campaign; name another folder with -o")
        # what a kill has cut off would stand before the next line
        self._file.truncate(whole)
        if first is None:
            self._write(head)
        elif {**first, "pneud": ""} != {**head, "pneud": ""}:
            raise RecordError(
                f"{folder}: holds another campaign, or this one before its file was changed;"
                " name another folder with -o, or remove it"
            )
        elif first["pneud"] != __version__:
            raise RecordError(
                f"{folder}: was begun by pneud {first['pneud']}, whose rows may differ;"
                " name another folder with -o, or remove it"
            )

    def add(self, chunk: Chunk) -> None:
        """Have the disk keep a chunk.

        Raises:
            OSError: it does not.
        """
        self._write(chunk._asdict())

    def _write(self, told: dict[str, Any]) -> None:
        text = json.dumps(told, separators=(",", ":"), allow_nan=False).encode()
        try:
            left = b"%08x %s\n" % (zlib.crc32(text), text)
            while left:
                left = left[os.write(self._file.fileno(), left) :]
            os.fsync(self._file.fileno())
        except OSError as e:
            raise OSError(e.errno, e.strerror, str(self.path)) from None

    def chunks(self) -> Iterator[Chunk]:
        """All that are done, in the order in which they were; of runs that are done twice, both."""
        for number, (line, _) in enumerate(_whole_lines(self.path)):
            if number:
                yield Chunk(**line)

    def close(self) -> None:
        """Let others write."""
        self._file.close()


def _whole_lines(path: Path) -> Iterator[tuple[dict[str, Any], int]]:
    """The lines that are as they were written, each with where it ends."""
    end = 0
    with path.open("rb") as file:
        for line in file:
            end += len(line)
            told, space, text = line.rstrip(b"\n").partition(b" ")
            if line.endswith(b"\n") and space and told == b"%08x" % zlib.crc32(text):
                yield json.loads(text), end


def missing(done: Sequence[Span], total: int) -> list[Span]:
    """The spans of 0 … total that no chunk has."""
    found, at = [], 0
    for begin, end in sorted(done):
        if begin >= total:
            break
        if begin > at:
            found.append((at, begin))
        at = max(at, end)
    if at < total:
        found.append((at, total))
    return found


def rows_of(record: Record, columns: Mapping[str, type], total: int) -> Rows:
    """All rows in the order of their numbers, each once.

    Args:
        record: with all of them.
        columns: of the rows, in the order in which they are kept, and the kind of value in each.
        total: how many there are.

    Raises:
        RecordError: one is missing.
    """
    rows = Rows(columns, total)
    for chunk in record.chunks():
        for number, cells in enumerate(chunk.rows, chunk.begin):
            if number < total:
                rows.put(number, cells)
    if rows.missing:
        raise RecordError(f"{record.path}: {rows.missing} runs are missing", 3)
    return rows
