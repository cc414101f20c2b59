"""Which SYNC a frame answers, as the counters tell.

A node counts one per answer and the controller one per SYNC: as long as every SYNC is answered, the two keep
their distance, modulo what the node's counter holds, and whatever gets lost on the way. So a frame whose
counter lags behind answers an earlier SYNC, whatever its stamp says.

Two things look alike: a node that has missed a SYNC did not count it, and lags from then on though it answers
at once; one that has fallen a period behind lags as much and answers too late for good. The stricter of the
two holds until something decides:

* a frame comes that does not lag: the node has caught up, and the distance stands;
* the encoder's values lie where the load was, or where it is, as far as that differs;
* nothing does in `AGREE` frames, or in `FEW` while the source's time-out is running out: then the load has as
  good as stood still, or it is a source that may be so old, and the new distance is the node's own.

One that was found late stays so for long enough to be named as a fault; then its distance is learned as well.
A counter that is ahead, or further behind than a node may be late, is no late one: the node has started anew,
or counts otherwise. Its frames count by their stamps until as many as before have agreed again; those of one
that never agree always do. A counter of few bits comes round: it can tell half of what it counts from a lag,
and takes the rest for being ahead.
"""

import math
from typing import NamedTuple

MOST = 8  # periods that a frame is late
AGREE, FEW = 8, 3  # frames in a row; where time is running out
PROMPT, UNTOLD, LATE = 1, 0, -1  # what a frame that lags says of itself
VERDICT = 2  # so much of it, added up, decides
PATIENCE, NAMED = 0.7, 2.0  # time-outs: until a source that lags is believed, and one that was found late

TELLING_M = 30e-6  # from where the load was to where it is: encoder's steps and noise are less
TIMES = 4.0  # and so many times what a straight line may be off
ACCELERATION_M_S2 = 2.0  # that two speeds need not show
_NEAR = 0.3  # of the way between the two places

Reading = tuple[int, float]
"""When the load was where: SYNC [ns], position [m]."""
UNREAD: tuple[Reading, Reading, Reading] = ((0, math.nan), (0, math.nan), (0, math.nan))


class LagState(NamedTuple):
    """What is known of a source's counter between two ticks."""

    offset: int = 0
    agreed: int = 0
    shift: int = 0
    run: int = 0
    votes: int = 0


class Lag:
    """One source's counter beside the number of SYNCs.

    Attributes:
        offset: from the number of SYNCs to the counter.
        agreed: frames in a row that had it; it is believed from `AGREE` on.
        open: it is not believed yet, or frames lag behind it.
    """

    __slots__ = (
        *("_most", "_named_ns", "_patience_ns", "_run", "_shift", "_values", "_votes"),
        *("agreed", "offset", "open"),
    )

    def __init__(self, values: int, timeout_ns: int) -> None:
        """Nothing is known.

        Args:
            values: how many the counter has.
            timeout_ns: after which a source is a fault that has not been fresh.
        """
        self._values = values
        self._most = min(MOST, (values - 1) >> 1)
        self._patience_ns, self._named_ns = round(PATIENCE * timeout_ns), round(NAMED * timeout_ns)
        self.thaw(LagState())

    def freeze(self) -> LagState:
        """Between two ticks."""
        return LagState(self.offset, self.agreed, self._shift, self._run, self._votes)

    def thaw(self, state: LagState) -> None:
        """Go on from there."""
        self.offset, self.agreed, self._shift, self._run, self._votes = state
        self.open = self.agreed < AGREE or self._shift > 0

    def behind(self, counter: int, syncs: int) -> int:
        """By how many SYNCs a frame lags; 0 where it does not, or where that is not known."""
        lag = (self.offset + syncs - counter) % self._values
        if self.agreed >= AGREE and 0 < lag <= self._most:
            return lag
        if lag:
            self.offset = (counter - syncs) % self._values
            self.agreed = 0
        self.agreed = min(AGREE, self.agreed + 1)
        self._shift = 0
        self.open = self.agreed < AGREE
        return 0

    def older(self, counter: int, newest: int) -> bool:
        """Whether a frame that lags was sent before one that has come."""
        return 0 < (newest - counter) % self._values <= self._most

    def late(self, lag: int, says: int, waited_ns: int) -> bool:
        """Whether a frame that lags is late, as far as is known by now.

        Args:
            lag: by so many SYNCs.
            says: of itself, `PROMPT`, `UNTOLD` or `LATE`.
            waited_ns: since the source was last fresh.
        """
        if lag != self._shift:
            self._shift, self._run, self._votes, self.open = lag, 0, 0, True
        found = self._votes <= -VERDICT
        if not found:
            self._run += 1
            self._votes += says
            found = self._votes <= -VERDICT
        if found:
            over = waited_ns > self._named_ns
        else:
            enough = FEW if waited_ns > self._patience_ns else AGREE
            over = self._votes >= VERDICT or self._run >= enough
        if over:
            self.offset = (self.offset - lag) % self._values
            self._shift = 0
            self.open = False
        return not over


def told_by(readings: tuple[Reading, Reading, Reading], position_m: float, t_ns: int, before_ns: int) -> int:
    """Whether a position was read at this SYNC or at an earlier one, by those that were read before.

    Args:
        readings: the last three that were in time, the newest last.
        position_m: of the frame in question.
        t_ns: this SYNC.
        before_ns: the last one.

    Returns:
        `PROMPT`, `LATE`, or `UNTOLD`.
    """
    (t0_ns, x0_m), (t1_ns, x1_m), (t2_ns, x2_m) = readings
    if not t0_ns < t1_ns < t2_ns < t_ns:
        return UNTOLD
    h, ahead_s = 1e-9 * (t2_ns - t1_ns), 1e-9 * (t_ns - t2_ns)
    v = (x2_m - x1_m) / h
    change = abs(v - (x1_m - x0_m) / (1e-9 * (t1_ns - t0_ns)))
    may_be_off_m = 0.5 * max(ACCELERATION_M_S2, change / h) * ahead_s * (ahead_s + h)
    way_m = 1e-9 * v * (t_ns - before_ns)
    if not abs(way_m) > TELLING_M + TIMES * may_be_off_m:
        return UNTOLD
    back = (x2_m + v * ahead_s - position_m) / way_m
    if back > 1.0 - _NEAR:
        return LATE
    return PROMPT if abs(back) < _NEAR else UNTOLD
