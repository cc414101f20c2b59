"""How long the disk of a log lasts at the rate at which it is written."""

from __future__ import annotations

import math
import os
from pathlib import Path

_LOOK_S = 2.0
_LEAST_S = 5.0  # of writing, before a rate is one


class Disk:
    """Watches the disk of one log.

    Attributes:
        left_s: until it is full; NaN as long as nobody knows.
        kept_s: what a quota keeps of the log before its oldest part goes; NaN without one.
    """

    def __init__(self, log_path: str, quota_bytes: float = 0.0) -> None:
        self.left_s = self.kept_s = math.nan
        self._folder = Path(log_path).parent
        self._quota = quota_bytes
        self._file_bytes = self._written = 0
        self._first_s = math.nan
        self._look_s = -math.inf

    def look(self, now_s: float, file_bytes: int) -> None:
        """Take how large the log's file is; a smaller one is the next part."""
        if math.isnan(self._first_s):
            self._first_s, self._file_bytes = now_s, file_bytes
        self._written += max(0, file_bytes - self._file_bytes)
        self._file_bytes = file_bytes
        passed = now_s - self._first_s
        if now_s < self._look_s + _LOOK_S or passed < _LEAST_S or not self._written:
            return
        self._look_s = now_s
        rate = self._written / passed
        try:
            there = os.statvfs(self._folder)
        except OSError:  # somebody else's folder
            self.left_s = math.nan
        else:
            self.left_s = there.f_bavail * there.f_frsize / rate
        self.kept_s = self._quota / rate if self._quota else math.nan

    def in_words(self) -> tuple[str, bool]:
        """For the screen, and whether it is little."""
        if math.isfinite(self.kept_s) and not self.kept_s > self.left_s:
            return f"keeps {_long(self.kept_s)}", False
        if not math.isfinite(self.left_s):
            return "-", False
        return f"lasts {_long(self.left_s)}", self.left_s < 24 * 3600.0


def _long(seconds: float) -> str:
    hours = seconds / 3600.0
    return f"{hours:.1f} h" if hours < 100.0 else f"{hours / 24.0:,.0f} days"
