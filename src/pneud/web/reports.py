"""The logs beside the one that is being written, and reports on them: made one at a time, in no hurry."""

from __future__ import annotations

import asyncio
import os
import sys
import tempfile
import time
from collections import OrderedDict
from pathlib import Path
from typing import Any

from pneud.log.files.listing import ListedLog, listed

SHOWN = 100
_KEPT = 8  # reports
_WAITING = 4  # who wants one
_PATIENCE_S = 300.0
_FRESH_S = 5.0  # a list
_NICE = 15


class ReportError(Exception):
    """There is no report; the text is one line for a person."""


class Reports:
    """Of one folder of logs."""

    def __init__(self) -> None:
        self._place = tempfile.TemporaryDirectory(prefix="pneud-web-")
        self._made: OrderedDict[tuple[str, int], Path] = OrderedDict()
        self._one_at_a_time = asyncio.Lock()
        self._waiting = 0
        self._logs: dict[str, ListedLog] = {}
        self._listed_s = -_FRESH_S
        self._folder: Path | None = None

    async def list(self, log: str | None) -> list[dict[str, Any]]:
        """The logs beside one, the newest first."""
        if log is not None and (Path(log).parent != self._folder or self._is_stale()):
            self._folder, self._listed_s = Path(log).parent, time.monotonic()
            found = await asyncio.to_thread(_listed, self._folder)
            self._logs = {one.path.name: one for one in found[:SHOWN]}
        return [
            {
                "name": name,
                "start": one.start_unix_s,
                "length_s": round(one.length_s, 1),
                "bytes": one.bytes,
                "axis": one.axis,
                "closed": one.closed,
            }
            for name, one in self._logs.items()
        ]

    def _is_stale(self) -> bool:
        return time.monotonic() >= self._listed_s + _FRESH_S

    async def page(self, name: str) -> str:
        """The report on a log of the list.

        Raises:
            ReportError: there is no such log, or too many reports are being made, or it cannot be.
        """
        log = self._logs.get(name)
        if log is None:
            raise ReportError("no such log")
        if self._waiting >= _WAITING:
            raise ReportError("others wait for reports; try again")
        self._waiting += 1
        try:
            async with self._one_at_a_time:
                return await self._of(log)
        finally:
            self._waiting -= 1

    async def _of(self, log: ListedLog) -> str:
        try:
            key = (log.path.name, log.path.stat().st_size)
        except OSError:
            raise ReportError("the log is gone") from None
        if key not in self._made:
            path = Path(self._place.name, f"{time.monotonic_ns()}.html")
            await _make(log.path, path)
            self._made[key] = path
            if len(self._made) > _KEPT:
                self._made.popitem(last=False)[1].unlink(missing_ok=True)
        self._made.move_to_end(key)
        return await asyncio.to_thread(self._made[key].read_text, encoding="utf-8")

    def close(self) -> None:
        """Leave no file."""
        self._place.cleanup()


def _listed(folder: Path) -> list[ListedLog]:
    try:
        return listed(folder)
    except OSError:
        return []


async def _make(log: Path, page: Path) -> None:
    command = [sys.executable, "-m", "pneud.cli", "report", str(log), "-o", str(page), "--progress", "off"]
    child = await asyncio.create_subprocess_exec(
        *command,
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
        preexec_fn=lambda: os.nice(_NICE) and None,
    )
    try:
        _, said = await asyncio.wait_for(child.communicate(), _PATIENCE_S)
    except BaseException:
        child.kill()
        raise
    if not page.is_file():  # a log without its end has a report, and status 1
        words = said.decode(errors="replace").strip().splitlines() or ["it cannot be made"]
        raise ReportError(words[-1].removeprefix("pneud: "))
