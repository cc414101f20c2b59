"""Where the load should be: the tracked motion, and the ways that lead to it and to rest.

A way is a chain of polynomials of degree seven that meet in position, velocity, acceleration and jerk, so
that the jerk which (14) feeds forward never steps. Durations follow from the bounds in closed form, or from
one bisection: there is no search that could fail.

A time-optimal planner (ruckig) would be up to a third faster on short ways, where its jerk steps. It is not
used: steps of jerk are steps of the command, and a replay would hang on the version of a compiled library.
"""

import math
from itertools import pairwise
from typing import NamedTuple

from pneud.signals import Reference

LONGEST_S = 1e7  # of any way
LEAST_S = 0.02  # shortest piece of a way
ROOM = 1.5  # what a motion already has of acceleration and jerk, times this, cannot be forbidden on its way
LEAST_CRUISE_S = 1e-9
LEAST_M = 1e-12  # a way from rest that is shorter is none: it would be what roundings make of it
HALVINGS = 40
MAX_HARDENINGS = 10
SAMPLES = 32
KEPT = 0.92  # of its speed that a motion which brakes may lose while its deceleration ends
LEAST_TIME, TIME_STEP, TIMES = 1.4, 1.07, 22  # of distance over speed: times tried for a piece that brakes
GLANCES = 32  # points of it that are looked at
ROUNDED, BETWEEN = 1.0 + 1e-6, 0.985  # of bounds that are reached exactly, or perhaps between two glances
MOST_OMEGA_RAD_S = 2.0 * math.pi * 20.0  # of a sine


class Sine(NamedTuple):
    """centre + amplitude sin(ω t), in the stroke coordinate."""

    centre_m: float
    amplitude_m: float
    omega_rad_s: float


class Bounds(NamedTuple):
    """What a way may not exceed."""

    speed_m_s: float
    acceleration_m_s2: float
    jerk_m_s3: float


class Shunned(NamedTuple):
    """Speeds between which no short move should peak, and jerks that it should not have.

    At such speeds friction falls faster than anybody sees; such jerks take so much of the valve that little
    is left for friction where it turns round.
    """

    low_m_s: float = 0.0
    high_m_s: float = 0.0  # none are shunned where both are zero
    jerk_m_s3: float = 0.0  # beyond this one; 0: none are


class Septic(NamedTuple):
    """The polynomial Σ c_i (t/T)^i over 0 ≤ t ≤ T."""

    T: float  # [s]
    c0: float  # coefficients [m]
    c1: float
    c2: float
    c3: float
    c4: float
    c5: float
    c6: float
    c7: float


class Way(NamedTuple):
    """Polynomials, one after the other."""

    T: float  # of all together [s]
    pieces: tuple[Septic, ...]


def sine(t: float, p: Sine) -> Reference:
    """The sine and its derivatives at t [s]."""
    w = p.omega_rad_s
    a = p.amplitude_m
    s, c = math.sin(w * t), math.cos(w * t)
    return Reference(p.centre_m + a * s, a * w * c, -a * w * w * s, -a * w * w * w * c)


def rest(position_m: float) -> Reference:
    """Standing still."""
    return Reference(position_m, 0.0, 0.0, 0.0)


def septic(T: float, start: Reference, end: Reference) -> Septic:
    """The polynomial from start to end in T seconds."""
    T2, T3 = T * T, T * T * T
    c0, c1, c2, c3 = (
        start.position_m,
        start.velocity_m_s * T,
        0.5 * start.acceleration_m_s2 * T2,
        start.jerk_m_s3 * T3 / 6.0,
    )
    d0 = end.position_m - (c0 + c1 + c2 + c3)
    d1 = end.velocity_m_s * T - (c1 + 2.0 * c2 + 3.0 * c3)
    d2 = end.acceleration_m_s2 * T2 - (2.0 * c2 + 6.0 * c3)
    d3 = end.jerk_m_s3 * T3 - 6.0 * c3
    return Septic(
        T,
        c0,
        c1,
        c2,
        c3,
        35.0 * d0 - 15.0 * d1 + 2.5 * d2 - d3 / 6.0,
        -84.0 * d0 + 39.0 * d1 - 7.0 * d2 + 0.5 * d3,
        70.0 * d0 - 34.0 * d1 + 6.5 * d2 - 0.5 * d3,
        -20.0 * d0 + 10.0 * d1 - 2.0 * d2 + d3 / 6.0,
    )


def at(t: float, p: Septic) -> Reference:
    """The polynomial and its derivatives at t, clamped to 0 … T."""
    s = min(max(t / p.T, 0.0), 1.0)
    x = p.c0 + s * (p.c1 + s * (p.c2 + s * (p.c3 + s * (p.c4 + s * (p.c5 + s * (p.c6 + s * p.c7))))))
    v = p.c1 + s * (
        2.0 * p.c2
        + s * (3.0 * p.c3 + s * (4.0 * p.c4 + s * (5.0 * p.c5 + s * (6.0 * p.c6 + s * 7.0 * p.c7))))
    )
    a = 2.0 * p.c2 + s * (
        6.0 * p.c3 + s * (12.0 * p.c4 + s * (20.0 * p.c5 + s * (30.0 * p.c6 + s * 42.0 * p.c7)))
    )
    j = 6.0 * p.c3 + s * (24.0 * p.c4 + s * (60.0 * p.c5 + s * (120.0 * p.c6 + s * 210.0 * p.c7)))
    return Reference(x, v / p.T, a / (p.T * p.T), j / (p.T * p.T * p.T))


def position(share: float, p: Septic) -> float:
    """The polynomial's position alone [m], at a share of its time."""
    _, c0, c1, c2, c3, c4, c5, c6, c7 = p
    s = share
    return c0 + s * (c1 + s * (c2 + s * (c3 + s * (c4 + s * (c5 + s * (c6 + s * c7))))))


def way(*pieces: Septic) -> Way:
    """The way along pieces that meet."""
    return Way(sum(p.T for p in pieces), pieces)


def along(t: float, w: Way) -> Reference:
    """The way and its derivatives at t, clamped to 0 … T."""
    for p in w.pieces[:-1]:
        if t < p.T:
            return at(t, p)
        t -= p.T
    return at(t, w.pieces[-1])


def stays(w: Way, low_m: float, high_m: float) -> bool:
    """Whether a way ends, and stays between two positions (looked at in SAMPLES + 1 points of each piece)."""
    inside = all(low_m <= position(i / SAMPLES, p) <= high_m for p in w.pieces for i in range(SAMPLES + 1))
    return inside and w.T <= LONGEST_S


def still(position_m: float) -> Way:
    """The way that does not move."""
    return way(septic(LEAST_S, rest(position_m), rest(position_m)))


def ramp_s(change_m_s: float, bounds: Bounds) -> float:
    """Time in which the speed changes by so much within the bounds.

    The velocity is a quintic: its greatest slope is 15/8, its greatest curvature 10/√3.
    """
    return max(
        1.875 * change_m_s / bounds.acceleration_m_s2,
        math.sqrt(5.7736 * change_m_s / bounds.jerk_m_s3),
        LEAST_S,
    )


def move(start: Reference, end_m: float, bounds: Bounds, hardest: Bounds | None = None) -> Way:
    """The way from any motion to rest at a position.

    Acceleration and jerk go to zero, then the speed changes to that of the cruise and to zero, all within the
    bounds as in `to_rest`. A motion that brakes does not turn meanwhile, and one that has to go on braking to
    stop in time does. One that is too fast for that, too, stops first and comes back; one that is faster than
    the bounds allow slows down to them if the distance lets it.

    Args:
        start: the motion.
        end_m: where it leads.
        bounds: of the way.
        hardest: what a motion may brake with that would have to come back else; as `bounds` without it.
    """
    most = bounds if hardest is None else hardest
    first, x, v = _even(start, bounds, most)
    if not _stops(x, v, end_m, bounds):
        braked = _braked(start, end_m, bounds, most)
        if braked is not None:
            return way(braked)
        sooner, at_m, speed = _even(start, most, most, soon=True)
        for braking in (bounds, most._replace(speed_m_s=bounds.speed_m_s)):
            if _stops(at_m, speed, end_m, braking):
                return _way_on(sooner, at_m, speed, end_m, braking)
        first = (*first, _ramp(x, v, 0.0, bounds))
        x, v = x + 0.5 * v * ramp_s(abs(v), bounds), 0.0
    return _way_on(first, x, v, end_m, bounds)


def _even(
    start: Reference, bounds: Bounds, hardest: Bounds, soon: bool = False
) -> tuple[tuple[Septic, ...], float, float]:
    """The pieces on which acceleration and jerk of a motion end; position and velocity then.

    Args:
        start: the motion.
        bounds: of the piece.
        hardest: likewise, where the motion would turn else.
        soon: as soon as the bounds allow; else somewhat later, at which less has to be reckoned with.
    """
    x, v, a, j = start
    if a == 0.0 and j == 0.0:
        return (), x, v
    T = _ease_s(start, bounds)
    if soon:
        most_a, most_j = _most(start, bounds)
        longest = 6.75 * (most_a - abs(a)) / abs(j) if j != 0.0 else LEAST_S
        T = max(_least_ease_s(a, j, most_j), min(LEAST_S, longest))
    T = max(LEAST_CRUISE_S, min(T, _unturned_s(start, bounds, hardest)))
    ease, eased = _eased(start, T)
    return (ease,), eased.position_m, eased.velocity_m_s


def _stops(x: float, v: float, end_m: float, bounds: Bounds) -> bool:
    """Whether a motion without acceleration can stop ahead at a position."""
    return v * (end_m - x - 0.5 * v * ramp_s(abs(v), bounds)) >= 0.0


def _way_on(first: tuple[Septic, ...], x: float, v: float, end_m: float, bounds: Bounds) -> Way:
    """The way behind these pieces, from a motion without acceleration that can stop ahead."""
    pieces = [*first]
    distance, speed, side = abs(end_m - x), abs(v), math.copysign(1.0, end_m - x)
    top = _cruise(speed, distance, bounds) if speed > 0.0 or distance >= LEAST_M else 0.0
    if top > 0.0:
        if top != speed:
            pieces.append(_ramp(x, side * speed, side * top, bounds))
        cruise_s = (distance - _covered(speed, top, bounds)) / top
        last = ramp_s(top, bounds)
        braking = Reference(end_m - side * 0.5 * top * last, side * top, 0.0, 0.0)
        if cruise_s > LEAST_CRUISE_S:
            begin_m = braking.position_m - side * top * cruise_s
            pieces.append(Septic(cruise_s, begin_m, side * top * cruise_s, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        pieces.append(septic(last, braking, rest(end_m)))
    return way(*pieces) if pieces else still(end_m)


def unhurried(bounds: Bounds, distance_m: float, shunned: Shunned) -> Bounds:
    """The bounds for a move from rest to rest, with less jerk where that or the speed of its peak is shunned.

    It then peaks at the lowest of the speeds. One that gets no further than the bound on speed peaks there.
    """
    if shunned.jerk_m_s3 > 0.0:
        bounds = bounds._replace(jerk_m_s3=min(bounds.jerk_m_s3, shunned.jerk_m_s3))
    top = _cruise(0.0, distance_m, bounds)
    if not shunned.low_m_s < top < min(shunned.high_m_s, bounds.speed_m_s):
        return bounds
    return bounds._replace(jerk_m_s3=5.7736 * shunned.low_m_s**3 / distance_m**2)


def _ramp(x: float, before: float, after: float, bounds: Bounds) -> Septic:
    T = ramp_s(abs(after - before), bounds)
    end = Reference(x + 0.5 * (before + after) * T, after, 0.0, 0.0)
    return septic(T, Reference(x, before, 0.0, 0.0), end)


def _covered(speed: float, top: float, bounds: Bounds) -> float:
    """Distance that it takes to change from a speed to another, and from that to zero."""
    change = 0.5 * (speed + top) * ramp_s(abs(top - speed), bounds) if top != speed else 0.0
    return change + 0.5 * top * ramp_s(top, bounds)


def _cruise(speed: float, distance: float, bounds: Bounds) -> float:
    """The greatest speed on a way of at least the length that stopping takes."""
    most = bounds.speed_m_s
    if speed == 0.0:
        return min(
            most,
            math.sqrt(distance * bounds.acceleration_m_s2 / 1.875),
            math.pow(distance * distance * bounds.jerk_m_s3 / 5.7736, 1.0 / 3.0),
            distance / LEAST_S,
        )
    if _covered(speed, most, bounds) <= distance:
        return most
    low, high = speed, max(speed, most)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        if _covered(speed, middle, bounds) <= distance:
            low = middle
        else:
            high = middle
    return low


def to_rest(start: Reference, bounds: Bounds) -> Way:
    """The way on which a motion comes to rest wherever that leads, about as fast as the bounds allow.

    First acceleration and jerk go to zero, then the velocity. The bounds on acceleration and jerk are kept,
    or `ROOM` times what the motion began with; its speed may still grow while the acceleration ends.
    """
    ease, eased = _eased(start, _ease_s(start, bounds))
    speed = abs(eased.velocity_m_s)
    most_a, most_j = _most(start, bounds)
    T_halt = ramp_s(speed, Bounds(bounds.speed_m_s, most_a, most_j))
    end = rest(eased.position_m + 0.5 * T_halt * eased.velocity_m_s)
    return way(ease, septic(T_halt, eased, end))


def _most(start: Reference, bounds: Bounds) -> tuple[float, float]:
    return (
        max(bounds.acceleration_m_s2, ROOM * abs(start.acceleration_m_s2)),
        max(bounds.jerk_m_s3, ROOM * abs(start.jerk_m_s3)),
    )


def _ease_s(start: Reference, bounds: Bounds) -> float:
    """Time in which acceleration and jerk go to zero."""
    _, _, a, j = start
    most_a, most_j = _most(start, bounds)
    # the acceleration is a cubic: its jerk stays below |j| + 1.5 |a|/T, itself below |a| + 4/27 |j| T
    longest = 6.75 * (most_a - abs(a)) / abs(j) if j != 0.0 else LEAST_S
    return max(1.5 * abs(a) / (most_j - abs(j)), min(LEAST_S, longest))


def _least_ease_s(a: float, j: float, most_j: float) -> float:
    """The least such time by the jerk alone.

    One that takes the acceleration back is greatest, at (1 + c)²/(4 c) |j|, where T = 6 |a|/(|j| (3 + c)).
    """
    J = abs(j)
    if (a > 0.0) != (j > 0.0):
        return 3.0 * abs(a) / (J + most_j + math.sqrt(most_j * (most_j - J)))
    return 1.5 * abs(a) / (most_j - J / 3.0)


def _eased(start: Reference, T: float) -> tuple[Septic, Reference]:
    """The piece on which acceleration and jerk go to zero in a time, and its end."""
    x, v, a, j = start
    eased = Reference(
        x + T * (v + T * (0.35 * a + T * j / 20.0)),
        v + T * (0.5 * a + T * j / 12.0),
        0.0,
        0.0,
    )
    return septic(T, start, eased), eased


def _unturned_s(start: Reference, bounds: Bounds, hardest: Bounds) -> float:
    """Time in which a deceleration has to end so that the motion does not turn, as far as the bounds let it.

    With the cubic of `_eased` a deceleration A whose jerk j takes it back loses A T/2 − j T²/12 of speed.
    """
    _, v, a, j = start
    side = math.copysign(1.0, v)
    A = -side * a
    root = A * A - 4.0 / 3.0 * side * j * KEPT * abs(v)
    if A <= 0.0 or root < 0.0 or v == 0.0:
        return LONGEST_S
    most_j = max(_most(start, bounds)[1], hardest.jerk_m_s3)
    return max(_least_ease_s(a, j, most_j), 4.0 * KEPT * abs(v) / (A + math.sqrt(root)))


def _braked(start: Reference, end_m: float, bounds: Bounds, hardest: Bounds) -> Septic | None:
    """The shortest single piece to rest at a position ahead that does not turn; None where there is none."""
    x, v, _, _ = start
    side = math.copysign(1.0, v)
    ahead_m = side * (end_m - x)
    if not ahead_m > LEAST_CRUISE_S * abs(v) or v == 0.0:
        return None
    most_a, most_j = _most(start, bounds)
    most = Bounds(
        max(abs(v), hardest.speed_m_s),
        max(most_a, hardest.acceleration_m_s2),
        max(most_j, hardest.jerk_m_s3),
    )
    times = [ahead_m / abs(v) * LEAST_TIME * TIME_STEP**i for i in range(TIMES)]
    ramps = _as_ramps(start, end_m, times)
    for T in (*ramps, *times):
        piece = septic(T, start, rest(end_m))
        if _goes_on(piece, side, most, ROUNDED if T in ramps else BETWEEN):
            return piece
    return None


def _as_ramps(start: Reference, end_m: float, times: list[float]) -> list[float]:
    """Time in which a ramp of the velocity, a quintic as in `_ramp`, would stop just there; one at most.

    A motion that is on such a ramp goes on along it.
    """
    x, v, a, j = start

    def beyond_m(T: float) -> float:
        return T * (0.5 * v + T * (0.1 * a + T * j / 120.0)) - (end_m - x)

    for first, last in pairwise(times):
        before, low, high = beyond_m(first), first, last
        if before * beyond_m(last) < 0.0:
            for _ in range(HALVINGS):
                middle = 0.5 * (low + high)
                low, high = (middle, high) if before * beyond_m(middle) > 0.0 else (low, middle)
            return [low]
    return []


def _goes_on(p: Septic, side: float, most: Bounds, share: float) -> bool:
    """Whether a piece that ends at rest never turns, and keeps to a share of the bounds at some points."""
    for i in range(1, GLANCES):
        _, v, a, j = at(p.T * i / GLANCES, p)
        if not 0.0 <= side * v <= ROUNDED * most.speed_m_s:
            return False
        if abs(a) > share * most.acceleration_m_s2 or abs(j) > share * most.jerk_m_s3:
            return False
    return True


def stop(start: Reference, bounds: Bounds, low_m: float, high_m: float) -> Way:
    """`to_rest` between two positions: where it would leave them, it stops harder than the bounds allow.

    A start so fast and so close to the end that the hardest stop leaves them is stopped as hard.
    """
    w = to_rest(start, bounds)
    for _ in range(MAX_HARDENINGS):
        if stays(w, low_m, high_m):
            break
        bounds = Bounds(bounds.speed_m_s, 2.0 * bounds.acceleration_m_s2, 4.0 * bounds.jerk_m_s3)
        w = to_rest(start, bounds)
    return w


def transfer(start: Reference, end: Reference, bounds: Bounds) -> Way:
    """The way from one motion to another: to rest somewhere, then a run-up, which is a stop run backwards.

    Bounds as in `to_rest`.
    """
    ease, halt = to_rest(_reversed(end), bounds).pieces
    middle = _reversed(at(halt.T, halt))
    run = _reversed(at(0.0, halt))
    return way(
        *move(start, middle.position_m, bounds).pieces,
        septic(halt.T, rest(middle.position_m), run),
        septic(ease.T, run, end),
    )


def _reversed(r: Reference) -> Reference:
    return Reference(r.position_m, -r.velocity_m_s, r.acceleration_m_s2, -r.jerk_m_s3)
