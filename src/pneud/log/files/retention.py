"""Which parts of logs go when they fill their quota: the oldest, but those around a fault last of all."""

from __future__ import annotations

import contextlib
import fcntl
import os
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Footer, MetadataIndex, Statistics, SummaryOffset

from pneud.log.files.naming import LogError
from pneud.log.files.part import check_intact
from pneud.log.format import framing
from pneud.log.format.header import Rotation
from pneud.log.format.schema import KEPT, METADATA

_FOOTER_BYTES = 9 + 20 + len(framing.MAGIC)


class PartInfo(NamedTuple):
    """A part as retention sees it; times are Unix nanoseconds."""

    path: Path
    size: int
    name: str  # of the axis
    run: str
    number: int
    start_ns: int
    end_ns: int
    kept: tuple[tuple[int, int], ...]  # times around a fault in this part


def part_info(path: Path) -> PartInfo | None:
    """What retention needs to know of a file; None if it is no log that pneud can read."""
    try:
        with framing.open_mcap(path) as file:
            size = os.fstat(file.fileno()).st_size
            head = next(
                (m for p in framing.pieces(file, skip_chunks=True) if (m := _metadata(p, METADATA))), None
            )
            if head is None or "run" not in head:
                return None
            found = _from_index(file, size)
            start_ns, end_ns, kept = _from_chunks(file) if found is None else found
        spans = tuple((int(k["from_ns"]), int(k["until_ns"])) for k in kept)
        return PartInfo(path, size, head["name"], head["run"], int(head["part"]), start_ns, end_ns, spans)
    except (LogError, framing.DamageError, OSError, KeyError, ValueError):
        return None


def _metadata(piece: framing.Piece, name: str) -> dict[str, str] | None:
    if piece.opcode != Opcode.METADATA:
        return None
    found = framing.metadata(piece)
    if found.name != name:
        return None
    check_intact(found, piece.offset)
    return found.metadata


def _from_index(file: IO[bytes], size: int) -> tuple[int, int, list[dict[str, str]]] | None:
    """First time, last time and marks of a file that was finished, without reading all of it."""
    try:
        file.seek(max(0, size - _FOOTER_BYTES))
        tail = file.read(_FOOTER_BYTES)
        if tail[-len(framing.MAGIC) :] != framing.MAGIC or tail[0] != Opcode.FOOTER:
            return None
        footer = Footer.read(framing.stream(tail[9:]))
        start_ns = end_ns = 0
        kept = []
        file.seek(footer.summary_offset_start)
        groups = [
            SummaryOffset.read(framing.stream(piece.body))
            for piece in framing.pieces(file)
            if piece.opcode == Opcode.SUMMARY_OFFSET
        ]
        for group in groups:
            if group.group_opcode not in (Opcode.STATISTICS, Opcode.METADATA_INDEX):
                continue
            for piece in _group(file, group):
                if piece.opcode == Opcode.STATISTICS:
                    statistics = Statistics.read(framing.stream(piece.body))
                    start_ns, end_ns = statistics.message_start_time, statistics.message_end_time
                else:
                    index = MetadataIndex.read(framing.stream(piece.body))
                    if index.name == KEPT:
                        file.seek(index.offset)
                        mark = _metadata(next(framing.pieces(file)), KEPT)
                        if mark is None:
                            return None
                        kept.append(mark)
    except (*framing.NONSENSE, framing.DamageError):
        return None
    return start_ns, end_ns, kept


def _group(file: IO[bytes], group: SummaryOffset) -> list[framing.Piece]:
    found = []
    file.seek(group.group_start)
    for piece in framing.pieces(file):
        if piece.offset >= group.group_start + group.group_length:
            break
        found.append(piece)
    return found


def _from_chunks(file: IO[bytes]) -> tuple[int, int, list[dict[str, str]]]:
    """As `_from_index`, of a file that ends anywhere."""
    start_ns = end_ns = 0
    kept = []
    file.seek(len(framing.MAGIC))
    try:
        for piece in framing.pieces(file, skip_chunks=True):
            if piece.opcode not in framing.KNOWN:
                raise framing.DamageError
            if piece.opcode == Opcode.CHUNK:
                first, end_ns = framing.SPAN.unpack(piece.body)
                start_ns = start_ns or first
            elif (mark := _metadata(piece, KEPT)) is not None:
                kept.append(mark)
    except framing.CutShortError:
        pass
    except framing.DamageError:  # a fault may be marked in what cannot be read
        kept.append({"from_ns": str(start_ns), "until_ns": str(end_ns)})
    return start_ns, end_ns, kept


def protected(parts: Iterable[PartInfo]) -> set[Path]:
    """The parts that reach into a time around a fault of their run."""
    parts = list(parts)
    spans: dict[str, list[tuple[int, int]]] = {}
    for part in parts:
        spans.setdefault(part.run, []).extend(part.kept)
    return {
        part.path
        for part in parts
        if any(part.start_ns <= until and start <= part.end_ns for start, until in spans[part.run])
    }


def victims(parts: Iterable[PartInfo], quota_bytes: int) -> Iterator[PartInfo]:
    """The finished parts to delete, in turn: the oldest first, those around a fault only after all others."""
    parts = list(parts)
    spared = protected(parts)
    total = sum(part.size for part in parts)
    for part in sorted(parts, key=lambda p: (p.path in spared, p.start_ns, p.number)):
        if total <= quota_bytes:
            return
        yield part
        total -= part.size


def candidates(current: Path, rotation: Rotation) -> list[PartInfo]:
    """The finished parts that count against the quota of the one being written."""
    own = part_info(current)
    if own is None:
        return []
    infos = (part_info(path) for path in sorted(current.parent.glob("*.mcap")) if path != current)
    return [
        i for i in infos if i is not None and i.name == own.name and (rotation.folder or i.run == own.run)
    ]


def tidy(current: Path, rotation: Rotation) -> list[str]:
    """Delete what is too much.

    Returns:
        What was deleted, in words.
    """
    if sum(path.stat().st_size for path in current.parent.glob("*.mcap")) <= _left(rotation):
        return []
    words = []
    parts = candidates(current, rotation)
    spared = protected(parts)
    for part in victims(parts, _left(rotation)):
        if _delete(part.path):
            fault = ", though it holds a fault" if part.path in spared else ""
            words.append(f"deleted {part.path.name} to keep the quota{fault}")
    return words


def _left(rotation: Rotation) -> int:
    return max(0, rotation.quota_bytes - rotation.part_bytes)


def _delete(path: Path) -> bool:
    """Delete a part, unless it is being written; which its writer says by a lock."""
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink()
    except OSError:
        return False
    return True


class Tidying:
    """Tidies beside the writing, since it reads many files."""

    def __init__(self, rotation: Rotation) -> None:
        self._rotation = rotation
        self._thread: threading.Thread | None = None
        self._words: list[str] = []

    def start(self, current: Path) -> None:
        """Begin; nothing where it is still at work."""
        if self._thread is None or not self._thread.is_alive():
            self._thread = threading.Thread(target=self._run, args=(current,), daemon=True)
            self._thread.start()

    def _run(self, current: Path) -> None:
        with contextlib.suppress(OSError):  # of a folder that is gone
            self._words.extend(tidy(current, self._rotation))

    def done(self) -> list[str]:
        """What has been done since the last time, in words."""
        return [self._words.pop(0) for _ in range(len(self._words))]

    def join(self) -> None:
        """Wait for it."""
        if self._thread is not None:
            self._thread.join()
