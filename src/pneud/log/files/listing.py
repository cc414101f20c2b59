"""What logs there are in a folder, told from their heads and the heads of their chunks."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode

from pneud.log.files.naming import LogError
from pneud.log.files.reader import LogReader
from pneud.log.format.framing import SPAN, DamageError, first_ns, open_mcap, pieces


class ListedLog(NamedTuple):
    """A log, of one file or of parts."""

    path: Path  # of the first part
    parts: int
    axis: str
    bus: str
    rate_hz: float
    start_unix_s: float  # of the first message; 0 where there is none
    length_s: float
    bytes: int
    closed: bool  # it has its end; one that is still being written, or was cut short, has none


def listed(folder: Path) -> list[ListedLog]:
    """The logs in a folder, the newest first; what cannot be read as a log is left out."""
    runs: dict[str, list[LogReader]] = {}
    for path in folder.glob("*.mcap"):
        with suppress(LogError):
            log = LogReader([path])
            runs.setdefault(log.metadata.get("run") or str(path), []).append(log)
    return sorted(map(_listed, runs.values()), key=lambda found: found.start_unix_s, reverse=True)


def _listed(logs: Iterable[LogReader]) -> ListedLog:
    parts = sorted(logs, key=lambda log: int(log.metadata.get("part", "1")))
    first, spans = parts[0], [_span(log.path) for log in parts]
    start_ns, end_ns = spans[0][0], max(end for _, end, _ in spans)
    return ListedLog(
        path=first.path,
        parts=len(parts),
        axis=first.metadata.get("name", ""),
        bus=first.metadata.get("bus", ""),
        rate_hz=first.rate_hz,
        start_unix_s=start_ns * 1e-9,
        length_s=max(0, end_ns - start_ns) * 1e-9,
        bytes=sum(log.path.stat().st_size for log in parts),
        closed=all(closed for *_, closed in spans),
    )


def length_s(paths: Iterable[Path]) -> float:
    """From the first message of some files to the last [s]; 0 where there is none."""
    spans = [_span(path) for path in paths]
    begun_ns = min((start for start, *_ in spans if start), default=0)
    return max(0, max((end for _, end, _ in spans), default=0) - begun_ns) * 1e-9


def _span(path: Path) -> tuple[int, int, bool]:
    """Unix times of the first and the last message [ns], and whether the file has its end."""
    start_ns = end_ns = 0
    with open_mcap(path) as file:
        try:
            for piece in pieces(file, skip_chunks=True):
                if (found_ns := first_ns(piece)) is not None:
                    start_ns = start_ns or found_ns
                    last_ns = SPAN.unpack_from(piece.body)[1] if piece.opcode == Opcode.CHUNK else found_ns
                    end_ns = max(end_ns, last_ns)
        except DamageError:
            return start_ns, end_ns, False
    return start_ns, end_ns, True
