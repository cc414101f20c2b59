"""When a set of answers is to be expected, and how to wait for it: asleep at first, then looking.

A process that sleeps is woken by the last frame only after tens of microseconds, and its going to sleep and
waking up cost more time of the processor than the short look that takes their place. A look is in vain where
whoever is to answer needs the very processor that is looking; then it is left off for a while.
"""

from __future__ import annotations

MARGIN_NS = 40_000  # how long before a set to be awake: its first frames need no wake-up of their own
STEP_NS = 2_000  # by which a set may come later from tick to tick
LOOK_NS = 60_000  # the longest look
VAIN = 4  # looks in a row without a set
REST_TICKS = 1000  # without a look after so many


class Answers:
    """What is known of the sets that have come so far."""

    __slots__ = ("_rest", "_vain", "arrives_ns")

    def __init__(self) -> None:
        """Nothing is known."""
        self.arrives_ns = 0
        """When the set comes, after SYNC; 0 where that is not known."""
        self._vain = 0
        self._rest = 0

    def doze_ns(self, passed_ns: int) -> int:
        """How long to sleep [ns], so much time after SYNC; nothing to wait for where it is not positive."""
        return self.arrives_ns - MARGIN_NS - passed_ns

    def look_ns(self) -> int:
        """How long to look in this tick [ns], after the sleep; ask once."""
        if not self.arrives_ns:
            return 0
        if self._rest:
            self._rest -= 1
            return 0
        return LOOK_NS

    def came(self, arrived_ns: int, in_vain: bool) -> None:
        """The set is complete.

        Args:
            arrived_ns: when its last frame came, after SYNC.
            in_vain: it was looked for, and came later.
        """
        # early at once, later by and by: most sets find the loop awake
        known = self.arrives_ns
        self.arrives_ns = min(arrived_ns, known + STEP_NS) if known else arrived_ns
        if not in_vain:
            self._vain = 0
            return
        self._vain += 1
        if self._vain == VAIN:
            self._vain, self._rest = 0, REST_TICKS

    def missing(self) -> None:
        """The set is not complete, or came by itself."""
        self.arrives_ns = 0
