"""When a set of answers is to be expected, and how to wait for it: asleep at first, then looking.

A process that sleeps is woken by the last frame only after tens of microseconds, and its going to sleep and
waking up cost no less time of the processor than the short look that takes their place. A look is in vain
where whoever is to answer needs the very processor that is looking; then it is left off for a while.
"""

from __future__ import annotations

MARGIN_NS = 60_000  # how long before a set to be awake: to wake up late, and to rehearse, takes half of it
STEP_NS = 2_000  # by which a set may come later from tick to tick
LOOK_NS = 120_000  # the longest look; it ends when the set is there
VAIN = 4  # looks in a row without a set
REST_TICKS = 1000  # without a look after so many


class Answers:
    """What is known of the sets that have come so far; in every tick `look_ns`, then `came` or `missing`."""

    __slots__ = ("_deadline_ns", "_looked", "_rest", "_vain", "arrives_ns")

    def __init__(self, deadline_ns: int) -> None:
        """Nothing is known.

        Args:
            deadline_ns: after SYNC; no set comes later, whatever its stamps say.
        """
        self.arrives_ns = 0
        """When the set comes, after SYNC; 0 where that is not known."""
        self._deadline_ns = deadline_ns
        self._looked = False
        self._vain = 0
        self._rest = 0

    def doze_ns(self, passed_ns: int) -> int:
        """How long to sleep [ns], so much time after SYNC; nothing to wait for where it is not positive."""
        return self.arrives_ns - MARGIN_NS - passed_ns

    def look_ns(self) -> int:
        """How long to look in this tick [ns], after the sleep."""
        self._looked = self.arrives_ns > 0 and not self._rest
        if self._rest:
            self._rest -= 1
        return LOOK_NS if self._looked else 0

    def came(self, arrived_ns: int, in_vain: bool) -> None:
        """The set is complete.

        Args:
            arrived_ns: when its last frame came, after SYNC, by its stamp.
            in_vain: it came after the look.
        """
        if not 0 < arrived_ns <= self._deadline_ns:
            self.missing()  # the wall clock was set meanwhile
            return
        # early at once, later by and by: most sets find the loop awake
        known = self.arrives_ns
        self.arrives_ns = min(arrived_ns, known + STEP_NS) if known else arrived_ns
        self._count(in_vain)

    def missing(self) -> None:
        """The set is not complete, or came by itself."""
        self.arrives_ns = 0
        self._count(in_vain=True)

    def _count(self, in_vain: bool) -> None:
        if not self._looked:
            return
        self._vain = self._vain + 1 if in_vain else 0
        if self._vain == VAIN:
            self._vain, self._rest = 0, REST_TICKS
