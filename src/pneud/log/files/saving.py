"""A file that a failing disk holds nobody up with: what it will not take is kept and tried again."""

from __future__ import annotations

import errno
import os
import threading

FAILED = -1


class LogOutput:
    """What a log is written into: kept until the disk has taken it.

    Attributes:
        error: errno of the last failure, `FAILED` for one without, 0 for none.
    """

    def __init__(self, descriptor: int) -> None:
        """Write to a descriptor, which `close` closes."""
        self._descriptor = descriptor
        self._pending = bytearray()
        self._size = 0
        self._sync: threading.Thread | None = None
        self.error = 0

    def write(self, data: bytes) -> int:
        """Take everything; `settle` writes, at a moment of the caller's choosing."""
        self._pending += data
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        """Bytes taken so far."""
        return self._size

    def flush(self) -> None:
        """Nothing: see `settle`."""

    @property
    def settled_bytes(self) -> int:
        """Bytes that the file has taken."""
        return self._size - len(self._pending)

    def settle(self) -> bool:
        """Try to write everything; False if the disk will not take it."""
        try:
            while self._pending:
                written = os.write(self._descriptor, self._pending)
                del self._pending[:written]
        except OSError as e:
            self.error = e.errno or FAILED
            return False
        return True

    def is_removed(self) -> bool:
        """Whether the file has lost its last name, so that nobody will find it; that is an error."""
        if os.fstat(self._descriptor).st_nlink:
            return False
        self.error = errno.ENOENT
        return True

    def start_sync(self) -> None:
        """Have the disk keep what was written; a slow one must not hold up the reading of the ring."""
        if self._sync is None or not self._sync.is_alive():
            self._sync = threading.Thread(target=self.sync, daemon=True)
            self._sync.start()

    def sync(self) -> bool:
        """Wait until the disk keeps what was written; False if it does not."""
        try:
            os.fdatasync(self._descriptor)
        except OSError as e:
            if e.errno != errno.EINVAL:  # a pipe or a device has nothing to sync
                self.error = e.errno or FAILED
                return False
        return True

    def close(self) -> bool:
        """Wait until the disk keeps all of it, and close the file; False if it does not, or has lost it."""
        if self._sync is not None:
            self._sync.join()
        kept = self.sync()
        kept = not self.is_removed() and kept  # by now: that may have taken seconds
        os.close(self._descriptor)
        return kept
