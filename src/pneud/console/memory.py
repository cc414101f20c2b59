"""What a console leaves to the one that is started in its place."""

from __future__ import annotations

import json
import mmap
from typing import Any

_HALF_BYTES = 1 << 18
_LENGTH_BYTES = 8


class Memory:
    """Shared by all that are forked from where it was made; who is killed while it writes spoils nothing."""

    def __init__(self) -> None:
        # the first byte: which half is valid; the second: what is handed over, and not yet all of it
        self._memory = mmap.mmap(-1, mmap.PAGESIZE + 2 * _HALF_BYTES)

    @property
    def half_done(self) -> int:
        """The kind of request that has handed something over in part, and not yet all of it; 0: none."""
        return self._memory[1]

    @half_done.setter
    def half_done(self, kind: int) -> None:
        self._memory[1] = kind

    def keep(self, **what: Any) -> None:
        """Keep each in place of what was kept by its name, as `keep_bytes`; not beside what that has kept."""
        self.keep_bytes(json.dumps({**(self.kept() or {}), **what}).encode())

    def keep_bytes(self, data: bytes) -> None:
        """Keep this in place of what was kept before; too much is not kept, and the former stays."""
        if len(data) > _HALF_BYTES - _LENGTH_BYTES:
            return
        half = 1 if self._memory[0] == 2 else 2
        begin = mmap.PAGESIZE + (half - 1) * _HALF_BYTES
        whole = len(data).to_bytes(_LENGTH_BYTES, "little") + data
        self._memory[begin : begin + len(whole)] = whole
        self._memory[0] = half

    def kept(self) -> dict[str, Any] | None:
        """What was kept last; None where nothing was."""
        data = self.kept_bytes()
        found: dict[str, Any] | None = None if data is None else json.loads(data)
        return found

    def kept_bytes(self) -> bytes | None:
        """As it was kept."""
        half = self._memory[0]
        if not half:
            return None
        begin = mmap.PAGESIZE + (half - 1) * _HALF_BYTES
        end = begin + _LENGTH_BYTES
        length = int.from_bytes(self._memory[begin:end], "little")
        return self._memory[end : end + length]
