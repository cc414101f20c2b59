"""Functions by their series where a plant's small steps need them: exact to the last digits, and soon done.

Both fall back on libm beyond.
"""

import math
from typing import NamedTuple

NEAR = 1e-3  # what the power's series leaves out is below 1e-18 of it
SHORT = 0.25  # what the decay's leaves out is below 1e-17 of it
_THIRD = 1.0 / 3.0
# of (exp(−x) − 1 + x)/x² = 1/2 − x/6 + x²/24 − …
_C1, _C2, _C3, _C4, _C5 = 1.0 / 6.0, 1.0 / 24.0, 1.0 / 120.0, 1.0 / 720.0, 1.0 / 5040.0
_C6, _C7, _C8, _C9, _C10 = 1.0 / 40320.0, 1.0 / 362880.0, 1.0 / 3628800.0, 1.0 / 39916800.0, 1.0 / 479001600.0


class Power(NamedTuple):
    """An exponent, and the coefficients of its binomial series from the second power on."""

    n: float
    c2: float
    c3: float
    c4: float
    c5: float


def power(n: float) -> Power:
    """The series of (1 + d)ⁿ."""
    c2 = 0.5 * n * (n - 1.0)
    c3 = c2 * (n - 2.0) * _THIRD
    c4 = 0.25 * c3 * (n - 3.0)
    return Power(n, c2, c3, c4, 0.2 * c4 * (n - 4.0))


def raised(d: float, p: Power) -> float:
    """(1 + d)ⁿ for d > −1."""
    if -NEAR < d < NEAR:
        s = d * d
        return (1.0 + p.n * d) + s * ((p.c2 + p.c3 * d) + s * (p.c4 + p.c5 * d))
    return math.pow(1.0 + d, p.n)


def decay(x: float) -> tuple[float, float]:
    """What decays at a rate, over a step: its mean, and how far that has come from 1, over x.

    Args:
        x: rate times step, not negative.

    Returns:
        (1 − exp(−x))/x, and with that (1 − mean)/x; 1 and 1/2 at 0.
    """
    if x < SHORT:
        s = x * x
        last = (_C6 - _C7 * x) + s * ((_C8 - _C9 * x) + s * _C10)
        away = (0.5 - _C1 * x) + s * ((_C2 - _C3 * x) + s * ((_C4 - _C5 * x) + s * last))
        return 1.0 - x * away, away
    mean = -math.expm1(-x) / x
    return mean, (1.0 - mean) / x
