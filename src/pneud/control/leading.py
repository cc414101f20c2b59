"""A reference that another axis gives: followed with a scale and an offset, or carried with it by one load.

Each axis is told once a tick where the other one's reference, and its load, were in the tick before. What is
told is carried on to the present by its derivatives. A way of its own leads from where the reference was to
the other one's: a move of the difference between both, which ends at zero. Of a gantry's two axes one leads
and the other follows its reference; how far one load is ahead of the other shifts both references, so that
the one ahead waits and the other hurries.

Pure; SI, each axis in its own stroke coordinate.
"""

import math
from typing import NamedTuple

from pneud.control.reference import Bounds, Way, along, move, ramp_s, still
from pneud.signals import Reference, Told

NAN = math.nan
AT_REST_NS = 50_000_000  # so long after the reference has come to rest the shift of a gantry is held
LONGEST_NS = 250_000_000  # what was told longer ago is not carried on
CREEP_M_S, CREEP_M_S2 = 2e-5, 2e-3  # a shift that goes no faster may be held without a jolt

# how an axis follows
ALONE, REFERENCE, POSITION, GANTRY = 0, 1, 2, 3
LEADS = 4  # it does not, but is the other half of a gantry


class Leading(NamedTuple):
    """How an axis is led by another one."""

    how: int = ALONE
    scale: float = 1.0
    offset_m: float = 0.0  # own position where the other is at 0; of a gantry that is square
    bandwidth_rad_s: float = 50.0  # of what is made of a measured position, or of a gantry's shift
    skew_m: float = 0.0  # a gantry's loads may be so far apart
    coupling: float = 0.0  # part of that by which each reference is shifted
    low_m: float = 0.0  # positions that may be led to
    high_m: float = 0.0
    speed_m_s: float = 0.0  # and how fast


class Led(NamedTuple):
    """What is remembered of being led."""

    since_ns: int = -1  # when the way to the other one's reference began, −1 before
    path: Way = still(0.0)  # of the difference to it
    at_ns: int = -1  # instant of what follows; −1 for none
    x: float = 0.0  # of the other's measured position, or of a gantry's shift, smoothed
    v: float = 0.0
    a: float = 0.0
    j: float = 0.0
    still_ns: int = -1  # since when the reference has been at rest
    last: Reference = Reference(0.0, 0.0, 0.0, 0.0)  # where it was led, before any shift
    last_ns: int = 0


NOT_LED = Led()


class Guided(NamedTuple):
    """Where an axis is led in a tick."""

    led: Led
    reference: Reference
    at_rest: bool
    lost: bool  # nobody leads any more
    beyond: bool  # it would lead where the axis may not go


def carried(r: Reference, t: float) -> Reference:
    """A reference some time later, as far as its derivatives tell."""
    x, v, a, j = r
    return Reference(
        x + t * (v + t * (0.5 * a + t * j / 6.0)),
        v + t * (a + 0.5 * t * j),
        a + t * j,
        j,
    )


def smoothed(s: Led, x: float, v: float, t: float, w: float) -> Led:
    """A filter of the fourth order after a time t in which what it follows is x + v (time − t).

    All four poles lie at −w: it follows a constant speed without lag and does not swing; exact for any step.
    """
    e0, e1 = s.x - (x - v * t), s.v - v
    c1 = e1 + w * e0
    c2 = 0.5 * (s.a + w * (2.0 * e1 + w * e0))
    c3 = (s.j + w * (3.0 * s.a + w * (3.0 * e1 + w * e0))) / 6.0
    p0 = e0 + t * (c1 + t * (c2 + t * c3))
    p1 = c1 + t * (2.0 * c2 + 3.0 * t * c3)
    p2 = 2.0 * c2 + 6.0 * t * c3
    p3 = 6.0 * c3
    decay = math.exp(-w * t)
    return s._replace(
        x=x + decay * p0,
        v=v + decay * (p1 - w * p0),
        a=decay * (p2 - w * (2.0 * p1 - w * p0)),
        j=decay * (p3 - w * (3.0 * p2 - w * (3.0 * p1 - w * p0))),
    )


def is_told(told: Told | None, now_ns: int, how: int) -> bool:
    """Whether the other axis has said, lately enough, what is needed of it."""
    if told is None or not 0 <= now_ns - told.t_ns <= LONGEST_NS:
        return False
    if how == POSITION:
        return math.isfinite(told.measured_m + told.measured_m_s)
    return math.isfinite(told.position_m + told.velocity_m_s + told.acceleration_m_s2 + told.jerk_m_s3)


def towards(led: Led, told: Told, now_ns: int, p: Leading) -> tuple[Led, Reference]:
    """What the other axis's motion means here, at an instant.

    Args:
        led: what is remembered.
        told: valid, as from `is_told`.
        now_ns: the instant.
        p: parameters.
    """
    t = (now_ns - told.t_ns) * 1e-9
    k = p.scale
    if p.how == POSITION:
        x = p.offset_m + k * (told.measured_m + t * told.measured_m_s)
        v = k * told.measured_m_s
        if led.at_ns < 0:
            led = led._replace(at_ns=now_ns, x=x, v=v, a=0.0, j=0.0)
        else:
            led = smoothed(led, x, v, (now_ns - led.at_ns) * 1e-9, p.bandwidth_rad_s)._replace(at_ns=now_ns)
        return led, Reference(led.x, led.v, led.a, led.j)
    there = carried(Reference(told.position_m, told.velocity_m_s, told.acceleration_m_s2, told.jerk_m_s3), t)
    return led, Reference(
        p.offset_m + k * there.position_m,
        k * there.velocity_m_s,
        k * there.acceleration_m_s2,
        k * there.jerk_m_s3,
    )


def follow(
    led: Led, path: Way, since_ns: int, told: Told | None, now_ns: int, bounds: Bounds, p: Leading
) -> Guided:
    """Where an axis is led that follows another one.

    Until the first word of that one it goes the way that it was on, which ends at rest.

    Args:
        led: what is remembered.
        path: the way until then.
        since_ns: when that began.
        told: what the other axis has said.
        now_ns: instant of the reference.
        bounds: of the way to the other one's reference.
        p: parameters.
    """
    if not is_told(told, now_ns, p.how):
        if led.since_ns < 0:
            return Guided(led, along((now_ns - since_ns) * 1e-9, path), False, False, False)
        return Guided(led, carried(led.last, (now_ns - led.last_ns) * 1e-9), False, True, False)
    assert told is not None
    led, r = towards(led, told, now_ns, p)
    if led.since_ns < 0:
        led = begun(led, along((now_ns - since_ns) * 1e-9, path), r, now_ns, bounds)
    t = (now_ns - led.since_ns) * 1e-9
    if t < led.path.T:  # exactly nothing is left of it then
        left = along(t, led.path)
        r = Reference(
            r.position_m + left.position_m,
            r.velocity_m_s + left.velocity_m_s,
            r.acceleration_m_s2 + left.acceleration_m_s2,
            r.jerk_m_s3 + left.jerk_m_s3,
        )
    v = r.velocity_m_s
    # who leads by a reference brakes in time; a hand need not
    end_m = r.position_m + (0.5 * v * ramp_s(abs(v), bounds) if p.how == POSITION else 0.0)
    beyond = not p.low_m <= end_m <= p.high_m or abs(v) > p.speed_m_s
    led = led._replace(still_ns=still_since(led.still_ns, r, now_ns), last=r, last_ns=now_ns)
    return Guided(led, r, is_at_rest(led, now_ns), False, beyond)


def anew(led: Led, p: Leading) -> Led:
    """What is remembered where an axis is to be led from now on; a gantry's shift stays."""
    return led._replace(since_ns=-1, still_ns=-1) if p.how >= GANTRY else NOT_LED


def begun(led: Led, own: Reference, there: Reference, now_ns: int, bounds: Bounds) -> Led:
    """The way of the difference between two references to zero."""
    difference = Reference(
        own.position_m - there.position_m,
        own.velocity_m_s - there.velocity_m_s,
        own.acceleration_m_s2 - there.acceleration_m_s2,
        own.jerk_m_s3 - there.jerk_m_s3,
    )
    return led._replace(since_ns=now_ns, path=move(difference, 0.0, bounds))


def still_since(before_ns: int, r: Reference, now_ns: int) -> int:
    """Since when a reference has been at rest, −1 where it is not."""
    if r.velocity_m_s != 0.0 or r.acceleration_m_s2 != 0.0 or r.jerk_m_s3 != 0.0:
        return -1
    return before_ns if before_ns >= 0 else now_ns


def is_at_rest(led: Led, now_ns: int) -> bool:
    """Whether the reference has been at rest for so long that the load is, too."""
    return led.still_ns >= 0 and now_ns - led.still_ns >= AT_REST_NS


def skew_m(told: Told | None, position_m: float, now_ns: int, p: Leading) -> float:
    """How far a gantry's own load is ahead of being square with the other; NaN if nobody knows [m]."""
    if told is None or not 0 <= now_ns - told.t_ns <= LONGEST_NS:
        return NAN
    t = (now_ns - told.t_ns) * 1e-9
    return position_m - (p.offset_m + told.measured_m + t * told.measured_m_s)


def shifted(led: Led, r: Reference, skew: float, now_ns: int, p: Leading) -> Led:
    """How far a gantry's reference is shifted against its skew, and what else is to be remembered.

    Where the reference has come to rest, and the shift nearly so, it is held: what gives way to every breath
    would never come to rest.

    Args:
        led: what is remembered; `x` … `j` are the shift.
        r: the reference without it.
        skew: how far the own load is ahead [m]; NaN where nobody knows.
        now_ns: instant of the reference.
        p: parameters.
    """
    led = led._replace(still_ns=still_since(led.still_ns, r, now_ns))
    goal = -p.coupling * skew if math.isfinite(skew) else led.x
    if is_at_rest(led, now_ns) and abs(led.v) <= CREEP_M_S and abs(led.a) <= CREEP_M_S2:
        led = led._replace(v=0.0, a=0.0, j=0.0)
    elif led.at_ns >= 0 and now_ns > led.at_ns:
        led = smoothed(led, goal, 0.0, (now_ns - led.at_ns) * 1e-9, p.bandwidth_rad_s)
    return led._replace(at_ns=now_ns)


def aim(r: Reference, led: Led, p: Leading) -> Reference:
    """What the load has to follow: a gantry's reference with its shift."""
    if p.how < GANTRY:
        return r
    x, v, a, j = r
    return Reference(x + led.x, v + led.v, a + led.a, j + led.j)
