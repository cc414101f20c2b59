"""When a sensor that runs free has sampled, by a beat that it keeps and its frames do not.

A device that samples by its own clock does so at equal distances; what it has sampled waits for its turn at
the controller and on the wire, so that frames come later than they could, by more or less, and never earlier.
The ones that come with the least delay tell the beat, and the beat tells the instant of all: the lower
envelope of what is seen, carried on by the period.

What is common to all frames of a source, its least delay, cannot be told from stamps; a device says it (age).
Pure; times in nanoseconds.
"""

import math
from typing import NamedTuple

FIRST, LONGEST = 8, 64  # periods over which the least delay is looked for: at first, and in the long run
EARLY = 0.05  # of a period: what is earlier by more is a very late frame of the sample before
DRIFT = 0.002  # a device's period is found within so much of what it is said to be
SHARE = 0.25  # of what the beat was found to be off in, that goes into the period


class CadenceState(NamedTuple):
    """What is known of a beat between two frames."""

    beat_ns: int = 0  # when the newest sample was taken, with the least delay
    period_ns: float = 0.0  # 0: nothing has come yet
    least_ns: int = 0  # the least delay behind the beat in this window
    beats: int = 0  # of this window so far
    window: int = FIRST
    moved_ns: int = 0  # by how much early frames have moved the beat in it


class Cadence:
    """The beat of one source."""

    __slots__ = ("_nominal_ns", "state")

    def __init__(self, period_ns: float) -> None:
        """Nothing has come.

        Args:
            period_ns: between two samples, as the device is said to have it.
        """
        self._nominal_ns = period_ns
        self.state = CadenceState()

    def instant(self, stamp_ns: int) -> int:
        """When the sample of a frame was taken, as far as is known, from when it seems to have been."""
        self.state = state = heard(self.state, stamp_ns, self._nominal_ns)
        return state.beat_ns


def heard(s: CadenceState, stamp_ns: int, nominal_ns: float) -> CadenceState:
    """What is known after one more frame.

    Args:
        s: before it.
        stamp_ns: when it came, less the age that it tells.
        nominal_ns: the period, as the device is said to have it.
    """
    beat_ns, period_ns, least_ns, beats, window, moved_ns = s
    apart = stamp_ns - beat_ns
    if period_ns == 0.0 or not 0 <= apart + period_ns * EARLY < LONGEST * period_ns:
        # the first one, the first after a silence, or the clock was set
        known = nominal_ns if period_ns == 0.0 else period_ns
        return CadenceState(stamp_ns, known, LONGEST * round(nominal_ns))
    count = math.floor(apart / period_ns + EARLY)
    beat_ns += round(count * period_ns)
    late_ns = stamp_ns - beat_ns
    if late_ns < 0:
        beat_ns, moved_ns, late_ns = stamp_ns, moved_ns + late_ns, 0
    least_ns, beats = min(least_ns, late_ns), beats + count
    if beats < window:
        return CadenceState(beat_ns, period_ns, least_ns, beats, window, moved_ns)
    if window == LONGEST:
        period_ns += SHARE * (moved_ns + least_ns) / beats
        period_ns = min(max(period_ns, (1.0 - DRIFT) * nominal_ns), (1.0 + DRIFT) * nominal_ns)
    return CadenceState(
        beat_ns + least_ns, period_ns, LONGEST * round(nominal_ns), 0, min(2 * window, LONGEST)
    )
