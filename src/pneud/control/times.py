"""When a time is over that somebody has asked for: in the tick that is nearest to its end.

Ticks are off by microseconds either way, and by that a time of whole periods would take one more of them, or
not. What protects, such as how long a fault has to last or a brake takes, is never cut short so.
"""


def over_ns(time_s: float, period_ns: int) -> int:
    """How long a time has to have gone on in the tick in which it is over [ns].

    Args:
        time_s: that was asked for.
        period_ns: of the ticks.
    """
    half_ns = round(0.5 * period_ns - 0.25)  # rounded down, without //, of which there is no counterpart in C
    return max(0, round(time_s * 1e9) - half_ns)
