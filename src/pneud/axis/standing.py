"""How an axis stands at its target: in position, or hunting about it.

Both are asked only where the reference has come to its end. What goes to and fro then, the error or the
command, is a limit cycle; its period tells what it most likely comes from.
"""

from typing import NamedTuple

from pneud.signals import Hunting

ENCODER, VALVE, FRICTION = int(Hunting.ENCODER), int(Hunting.VALVE), int(Hunting.FRICTION)
LASTING_NS = 1_000_000_000  # less is the ringing of a move or a push
TURNS = 5  # of the error on end
OVER = 0.6  # part of the mean step of the command below which it hunts no longer
READINGS = 5.0  # ticks: turns that follow each other sooner answer single readings


class Expected(NamedTuple):
    """What counts as in position, and what as hunting."""

    tolerance_m: float  # in position: error
    velocity_m_s: float  # and speed
    time_ns: int  # for so long
    swing_m: float  # hunting: the error goes to and fro by more
    longest_ns: int  # and turns at least so often
    step_v: float  # or the command's mean step from tick to tick is more
    share: float  # that one step has in the mean
    fast_ns: int  # turns that follow each other sooner are too fast for friction
    period_ns: int  # of the ticks


class Standing(NamedTuple):
    """What is remembered of an axis that stands at its target."""

    since_ns: int = -1  # when it came there, −1 where it has not
    within_ns: int = -1  # since when error and speed are within the tolerance, −1 where they are not
    in_position: int = 0
    hunting: int = 0  # a `Hunting`
    extreme_m: float = 0.0  # of the error since its last turn
    rising: int = 1  # 0 where the error falls
    turns: int = 0  # of the error, one soon after the other
    first_ns: int = 0  # of these
    turned_ns: int = 0  # the last one
    step_v: float = 0.0  # mean step of the command
    last_step_v: float = 0.0
    reversals: float = 0.0  # share of ticks in which the command turns


AT_WORK = Standing()


def judge(
    s: Standing,
    t_ns: int,
    error_m: float,
    velocity_m_s: float,
    step_v: float,
    measured: bool,
    p: Expected,
) -> Standing:
    """What is known after a tick at the target.

    In position is said of a load that has been read: in a tick without a reading neither that nor its time
    begins. What has begun goes on as long as the estimate stays within the tolerances, so that time counts
    from reading to reading.

    Args:
        s: before it.
        t_ns: of the tick.
        error_m: reference minus estimate.
        velocity_m_s: estimated.
        step_v: of the command since the last tick.
        measured: the estimate is of a reading of this tick.
        p: parameters.
    """
    since_ns = s.since_ns if s.since_ns >= 0 else t_ns
    within_ns, in_position = -1, 0
    if abs(error_m) <= p.tolerance_m and abs(velocity_m_s) <= p.velocity_m_s:
        within_ns, in_position = s.within_ns, s.in_position
        if measured:
            within_ns = s.within_ns if s.within_ns >= 0 else t_ns
            in_position = 1 if t_ns - within_ns >= p.time_ns else 0
    extreme_m, rising, turns, first_ns, turned_ns = s.extreme_m, s.rising, s.turns, s.first_ns, s.turned_ns
    if s.since_ns < 0:
        extreme_m = error_m
    ahead_m = error_m - extreme_m if rising else extreme_m - error_m
    if ahead_m >= 0.0:
        extreme_m = error_m
    elif ahead_m < -p.swing_m:
        first_ns = first_ns if turns else t_ns
        extreme_m, rising, turns, turned_ns = error_m, 1 - rising, turns + 1, t_ns
    if turns and t_ns - turned_ns > p.longest_ns:
        turns = 0
    turn = 1.0 if step_v * s.last_step_v < 0.0 else 0.0
    mean_v = s.step_v + p.share * (abs(step_v) - s.step_v)
    reversals = s.reversals + p.share * (turn - s.reversals)
    half_ns = (turned_ns - first_ns) / (turns - 1) if turns > 1 else 0.0
    swings = turns >= TURNS and turned_ns - first_ns >= LASTING_NS
    hunting = 0
    if mean_v > (OVER * p.step_v if s.hunting else p.step_v) and t_ns - since_ns >= LASTING_NS:
        hunting = s.hunting if s.hunting else cause(p.period_ns / max(reversals, 1e-9), p)
    elif swings and t_ns - turned_ns <= LASTING_NS + 2.0 * half_ns:
        hunting = s.hunting if s.hunting else cause(half_ns, p)
    return Standing(
        since_ns,
        within_ns,
        in_position,
        hunting,
        extreme_m,
        rising,
        turns,
        first_ns,
        turned_ns,
        mean_v,
        step_v if step_v != 0.0 else s.last_step_v,
        reversals,
    )


def cause(half_ns: float, p: Expected) -> int:
    """What a limit cycle most likely comes from, by half its period."""
    if half_ns < READINGS * p.period_ns:
        return ENCODER
    return VALVE if half_ns < p.fast_ns else FRICTION
