"""What the processes of a daemon have used of the machine; looked at where somebody asks for it."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from typing import Any

from pneud.rt.processes import children_of, counters_of

_AGAIN_S = 1.0  # what is asked for sooner has the same answer
LOOP = "loop"


class Processes:
    """Those of a daemon, but for the recorders, of which each axis has its own."""

    def __init__(
        self,
        daemon: int,
        recorders: Callable[[], Collection[int]],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin.

        Args:
            daemon: its process id.
            recorders: theirs.
            clock: [s].
        """
        self._daemon = daemon
        self._recorders = recorders
        self._clock = clock
        self._looked_s = -_AGAIN_S
        self._found: list[dict[str, Any]] = []

    def counters(self) -> list[dict[str, Any]]:
        """Of the loop, its children and theirs, by name; of several of one name, the first one."""
        now_s = self._clock()
        if now_s - self._looked_s >= _AGAIN_S:
            self._looked_s = now_s
            self._found = list(self._look())
        return self._found

    def _look(self) -> Collection[dict[str, Any]]:
        recorders = self._recorders()
        found: dict[str, dict[str, Any]] = {}
        children = [child for child in children_of(self._daemon) if child not in recorders]
        inner = [child for parent in children for child in children_of(parent)]
        loop = counters_of(self._daemon, LOOP)
        for counted in (loop, *map(counters_of, (*children, *inner))):
            if counted is not None:
                found.setdefault(counted["name"], counted)
        return found.values()
