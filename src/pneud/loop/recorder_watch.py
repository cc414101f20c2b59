"""The loop's side of the recorder: the ring to it, and how it fares."""

from __future__ import annotations

import errno

from pneud.crew import gone
from pneud.log.live.ring import Ring
from pneud.signals import Host

RECORDER_LOST, DISK_FULL = int(Host.RECORDER_LOST), int(Host.DISK_FULL)
CONFIG_CHANGED = int(Host.CONFIG_CHANGED)
_FULL = (errno.ENOSPC, errno.EDQUOT)


class RecorderWatch:
    """What is known of a recorder; it changes slowly, and `look` costs system calls."""

    def __init__(self, ring: Ring, pid: int) -> None:
        self.ring = ring
        self.lost = False
        self.host = 0
        """Bits of `signals.Host`."""
        self._pid = pid
        self._gone = False

    @property
    def begun(self) -> bool:
        """Whether it has begun, or never will: the run itself starts no motion without its log."""
        return not self._pid or self.lost or self.ring.status().heartbeat > 0

    def look(self) -> None:
        """See how it fares."""
        if not self._pid or self._gone:
            return
        status = self.ring.status()
        disk_full = status.failing != 0 and status.error in _FULL
        self._gone = gone(self._pid)
        self.lost = (status.failing != 0 and not disk_full) or self._gone
        self.host = (
            (RECORDER_LOST if self.lost else 0)
            | (DISK_FULL if disk_full else 0)
            | (CONFIG_CHANGED if status.config_changed else 0)
        )
