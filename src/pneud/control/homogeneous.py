"""The homogeneous feedback u* of Lemma 2 and equation (19), explicit and implicit.

The explicit form evaluated under a zero-order hold has a limit cycle of amplitude `(h k3/2)^(1/(1−α3))` in
w3. The implicit form solves for the value that w3 takes at the next sample and has none.
"""

import math
from typing import NamedTuple

MAX_ITERATIONS = 100  # never reached in practice: the hardest of 10⁵ random states take about 60
ROUNDING = 4e-16  # residual that is only the rounding of its own terms


class Feedback(NamedTuple):
    """Gains of u* and the exponents of (21), made by `feedback`."""

    k1: float
    k2: float
    k3: float
    a1: float
    a2: float
    a3: float


def feedback(k1: float, k2: float, k3: float, alpha: float) -> Feedback:
    """Gains with the exponents of (21): α1 = α/(3−2α), α2 = α/(2−α), α3 = α."""
    return Feedback(k1, k2, k3, alpha / (3.0 - 2.0 * alpha), alpha / (2.0 - alpha), alpha)


def sig(x: float, a: float) -> float:
    """sig^a(x) = sgn(x) |x|^a."""
    return math.copysign(math.pow(abs(x), a), x)


def explicit_ustar(w1: float, w2: float, w3: float, g: Feedback) -> float:
    """u* of (19) at the present errors [m/s³]."""
    return -(g.k1 * sig(w1, g.a1) + g.k2 * sig(w2, g.a2) + g.k3 * sig(w3, g.a3))


def implicit_w3(w1: float, w2: float, w3: float, h: float, g: Feedback) -> float:
    """The value y of w3 a time h ahead under u* = (y − w3)/h.

    Solves `y + h [k3 sig^α3(y) + k2 sig^α2(w2 + h y) + k1 sig^α1(w1 + h w2 + h² y)] = w3`. The left side
    grows strictly with y, so that there is one root; with S the bracket, it lies between w3 and w3 − h S(w3).
    The three points where a power's slope is infinite are tried first, so that Newton's method works on a
    smooth piece; a step that leaves the bracket is replaced by its middle.

    Args:
        w1: position error [m].
        w2: velocity error [m/s].
        w3: acceleration error [m/s²].
        h: time ahead [s].
        g: gains and exponents.
    """
    b1 = w1 + h * w2
    h2 = h * h
    f, slope, _ = _residual(w3, b1, w2, w3, h, h2, g)
    if f == 0.0:
        return w3
    y = w3 - f / slope
    low, high = (w3 - f, w3) if f > 0.0 else (w3, w3 - f)
    for kink in (0.0, -w2 / h, -b1 / h2):
        if low < kink < high:
            f, _, _ = _residual(kink, b1, w2, w3, h, h2, g)
            if f == 0.0:
                return kink
            if f > 0.0:
                high = kink
            else:
                low = kink
    if not low < y < high:
        y = 0.5 * (low + high)
    for _ in range(MAX_ITERATIONS):
        f, slope, size = _residual(y, b1, w2, w3, h, h2, g)
        if abs(f) <= ROUNDING * size:
            return y
        if f > 0.0:
            high = y
        else:
            low = y
        step = y - f / slope
        if not low < step < high:
            step = 0.5 * (low + high)
        if step in (low, high):
            return step
        y = step
    return y


def _residual(
    y: float, b1: float, b2: float, w3: float, h: float, h2: float, g: Feedback
) -> tuple[float, float, float]:
    # left side minus w3, its slope (without what is infinite), and the sum of its terms' sizes;
    # written out, since it is most of the law's time
    k1, k2, k3, a1, a2, a3 = g
    f, slope, size = y - w3, 1.0, abs(y) + abs(w3)
    e, m = y, abs(y)
    if m > 0.0:
        t = h * k3 * m**a3
        size += t
        slope += a3 * t / m
        f += t if e > 0.0 else -t
    e = b2 + h * y
    m = abs(e)
    if m > 0.0:
        t = h * k2 * m**a2
        size += t
        slope += h * a2 * t / m
        f += t if e > 0.0 else -t
    e = b1 + h2 * y
    m = abs(e)
    if m > 0.0:
        t = h * k1 * m**a1
        size += t
        slope += h2 * a1 * t / m
        f += t if e > 0.0 else -t
    return f, slope, size


def implicit_ustar(w1: float, w2: float, w3: float, h: float, g: Feedback) -> float:
    """u* = (y − w3)/h with y from `implicit_w3` [m/s³]."""
    return (implicit_w3(w1, w2, w3, h, g) - w3) / h
