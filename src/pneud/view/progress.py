"""How far long work has come, on standard error: a bar on a terminal, a line of JSON a second, or nothing."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple, TypeVar

Report = Callable[[str, float, float, str], None]
"""Is told what is being done, how much of it is, of how much (0 where nobody knows), and in what unit."""

SHORT_S = 0.5  # what is over by then needs no bar
REDRAW_S = 0.1
LINE_S = 1.0

T = TypeVar("T")


class Seen(NamedTuple):
    """How far a part of the work is."""

    what: str
    done: float
    total: float | None
    unit: str
    per_s: float

    @property
    def left_s(self) -> float | None:
        """How long it will take; None where nobody knows."""
        return (self.total - self.done) / self.per_s if self.total and self.per_s > 0.0 else None


def silent(what: str, done: float, total: float, unit: str) -> None:
    """Tells nobody."""


def each(many: Iterable[T], report: Report, what: str, total: int, unit: str) -> Iterator[T]:
    """Of many things one after the other, telling how many there have been."""
    report(what, 0, total, unit)
    for number, one in enumerate(many, 1):
        yield one
        report(what, number, total, unit)


@contextmanager
def progress(how: str) -> Iterator[Report]:
    """Whom long work tells how far it is; what a bar has drawn is gone with the end of the block.

    Args:
        how: "auto" for a bar if standard error is a terminal, "json", or "off".
    """
    if how == "json":
        yield _Watch(_line, LINE_S, LINE_S).report
    elif how == "auto" and os.isatty(2):
        bar = _Bar()
        try:
            yield _Watch(bar.draw, SHORT_S, REDRAW_S).report
        finally:
            bar.wipe()
    else:
        yield silent


class _Watch:
    """Draws now and then what it is told; no thread does, since much of what is long forks."""

    def __init__(self, draw: Callable[[Seen], None], first_s: float, every_s: float) -> None:
        self._draw = draw
        self._every_s = every_s
        self._due_s = time.monotonic() + first_s
        self._what, self._done, self._began, self._began_s = "", 0.0, 0.0, 0.0

    def report(self, what: str, done: float, total: float, unit: str) -> None:
        now_s = time.monotonic()
        if what != self._what or done < self._done:
            self._what, self._began, self._began_s = what, done, now_s
        self._done = done
        if now_s < self._due_s:
            return
        self._due_s = now_s + self._every_s
        per_s = (done - self._began) / max(now_s - self._began_s, 1e-9)
        self._draw(Seen(what, done, total or None, unit, per_s))


def _line(seen: Seen) -> None:
    share = seen.done / seen.total if seen.total else None
    print(json.dumps({"progress": share, **seen._asdict(), "left_s": seen.left_s}), file=sys.stderr)


class _Bar:
    """A bar with rate and rest."""

    def __init__(self) -> None:
        self._bar: Any = None

    def draw(self, seen: Seen) -> None:
        """Draw it anew, for the first time where there is none."""
        if self._bar is None:
            from rich.console import Console  # noqa: PLC0415 - slow to load, and only for a terminal
            from rich.progress import BarColumn, Progress, TextColumn  # noqa: PLC0415

            columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[words]}"))
            self._bar = Progress(
                *columns,
                console=Console(stderr=True),
                transient=True,
                auto_refresh=False,
                redirect_stdout=False,
                redirect_stderr=False,
            )
            self._bar.add_task("", words="")
            self._bar.start()
        self._bar.update(
            0, description=seen.what, completed=seen.done, total=seen.total, words=in_words(seen)
        )
        self._bar.refresh()

    def wipe(self) -> None:
        """Leave the terminal as it was."""
        if self._bar is not None:
            self._bar.stop()


def in_words(seen: Seen) -> str:
    """How much, how fast and how long to go: "12/45 MB, 3.1 MB/s, 11 s left"."""
    whole = f"/{seen.total:.3g}" if seen.total else ""
    words = f"{seen.done:.3g}{whole} {seen.unit}, {seen.per_s:.2g} {seen.unit}/s"
    return words if seen.left_s is None else f"{words}, {seen.left_s:.0f} s left"
