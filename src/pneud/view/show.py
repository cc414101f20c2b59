"""What a screen shows and does, whatever draws it: records in, keys in, a picture out."""

from __future__ import annotations

import os
import time
from collections.abc import Callable

from rich.segment import Segment

from pneud.signals import Record
from pneud.view.banner import banner_of
from pneud.view.disk import Disk
from pneud.view.hands import Hands, Leaving, Operator
from pneud.view.history import History
from pneud.view.info import ScreenInfo
from pneud.view.screen import ScreenState, Typed, rows_of

_LIGHT_FROM = 7  # of the sixteen colours, but for dark grey
_DARK_GREY = 8

LogCounts = Callable[[], tuple[int, int, int]]
"""Records written to the log and dropped, and the size of its file."""


class Show:
    """One screen.

    Attributes:
        history: what has come.
        hands: what has been typed.
        snapshot: what there is to show, as of the last `attend`.
    """

    def __init__(
        self,
        poll: Callable[[], list[Record]],
        info: ScreenInfo,
        stop: Callable[[], bool],
        *,
        log_counts: LogCounts | None = None,
        operator: Operator | None = None,
        leaving: Leaving | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin.

        Args:
            poll: all records since the last call.
            info: what they belong to.
            stop: whether it is time to leave; asked often.
            log_counts: of the recorder.
            operator: whom keys ask; none, and there are but keys that look.
            leaving: what `q` does.
            clock: seconds.
        """
        self.history = History(info.sync)
        middle_mm = 500.0 * (info.travel_min_m + info.travel_max_m)
        self.hands = Hands(operator, leaving or Leaving("leave"), middle_mm, is_light())
        self.snapshot = ScreenState(None, info)
        self._poll = poll
        self._info = info
        self._stop = stop
        self._log_counts = log_counts
        self._disk = Disk(info.log_path, info.quota_bytes)
        self._clock = clock
        self._heard_s = clock()

    def attend(self) -> bool:
        """Take what has come; to be called many times a second.

        Returns:
            Whether to go on.
        """
        records, now_s, history, hands = self._poll(), self._clock(), self.history, self.hands
        if records:
            history.add(records)
            self._heard_s = now_s
        history.silent_s = now_s - self._heard_s
        hands.attend(now_s)
        if self._log_counts is not None:
            history.log_written, history.log_dropped, file_bytes = self._log_counts()
            self._disk.look(now_s, file_bytes)
        if (learnt := hands.learnt) is not None:
            self._info = self._info._replace(learnt=learnt)
        if (mileage := hands.mileage) is not None:
            self._info = self._info._replace(mileage=mileage)
        if (others := hands.others) != self._info.others:
            self._info = self._info._replace(others=others)
        keys = banner_of(history.last, self._info, history.silent_s).keys
        typed = Typed(
            prompt=hands.prompt,
            message=hands.message,
            hints=tuple(hands.hints(keys)),
            help=tuple(hands.lines()) if hands.help else (),
            light=hands.light,
        )
        self.snapshot = ScreenState(history.last, self._info, typed, self._disk.in_words())
        return not (hands.over or self._stop())

    def picture(self, size: tuple[int, int], ascii_only: bool) -> list[list[Segment]]:
        """The page as of the last `attend`, as rows of exactly this size."""
        return rows_of(self.snapshot, self.history, size, ascii_only)


def is_light() -> bool:
    """Whether the terminal says that its background is light; most say nothing.

    Asking it would mean to read its answer among keys that command an axis.
    """
    said = os.environ.get("COLORFGBG", "").rpartition(";")[2]
    return said.isdecimal() and int(said) >= _LIGHT_FROM and int(said) != _DARK_GREY


def is_ascii(encoding: str | None) -> bool:
    """Whether a terminal has letters alone; the font of the Linux console has neither dots nor blocks."""
    return os.environ.get("TERM") == "linux" or not (encoding or "").lower().startswith("utf")
