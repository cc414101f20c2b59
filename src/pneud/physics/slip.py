"""Friction of piston and rod seals: Maxwell elements that slip one after another, with a Stribeck curve.

The generalised Maxwell slip model in the limit of elements that slip at once. Reversed on its way, it
remembers where it came from, which bristles of one kind do not.
"""

from typing import NamedTuple

from pneud.physics.friction import NO_FRICTION_N, Friction, stribeck

K1, K2, K3, K4 = 8.0 / 15.0, 4.0 / 15.0, 2.0 / 15.0, 1.0 / 15.0  # shares of the stiffness
ROUNDS = 20  # of Newton's method at most; two or three are usual
EXACT = 1e-12  # of a velocity


class Elements(NamedTuple):
    """Deflections of the elements [m], the stiffest first; each bears a quarter of the friction."""

    z1: float = 0.0
    z2: float = 0.0
    z3: float = 0.0
    z4: float = 0.0


UNBENT = Elements()


class Grip(NamedTuple):
    """What the elements do against a displacement."""

    force_n: float
    slope_n_m: float
    stick: float  # part of them that does not slip


def held(z: float, most: float) -> float:
    """A deflection that is no more than friction bears."""
    return most if z > most else -most if z < -most else z


def grip(z: Elements, move_m: float, dry_n: float, sigma0_n_m: float) -> Grip:
    """Force of the elements once they have been moved, its slope, and how many of them stick."""
    force = slope = stick = 0.0
    quarter = 0.25 * dry_n
    for z_i, share in ((z.z1, K1), (z.z2, K2), (z.z3, K3), (z.z4, K4)):
        k = share * sigma0_n_m
        bent = k * (z_i + move_m)
        force += held(bent, quarter)
        if abs(bent) < quarter:
            slope += k
            stick += 0.25
    return Grip(force, slope, stick)


def slip(
    v: float, z: Elements, guess: float, force_n: float, mass_kg: float, h: float, f: Friction
) -> tuple[float, Elements]:
    """Mean velocity [m/s] over a step and the elements at its end, under a force held constant.

    As `friction.slide`: the implicit midpoint rule, stable for any stiffness; what it does not store is lost.

    Args:
        v: velocity at the start [m/s].
        z: the elements at the start.
        guess: velocity expected in the middle of the step [m/s].
        force_n: mean of all other forces over the step [N].
        mass_kg: moving mass.
        h: step [s].
        f: parameters; the stiffness is that of all elements together, the damping that of those that stick.
    """
    gain, half = 0.5 * h / mass_kg, 0.5 * h
    dry = stribeck(guess, f)
    if f.sigma0_n_m <= 0.0 or dry < NO_FRICTION_N:
        return (v + gain * force_n) / (1.0 + gain * f.viscous_n_s_m), UNBENT
    # what slides on is no element that sticks, though its friction may just have grown
    damping = f.viscous_n_s_m + f.sigma1_n_s_m * grip(z, half * guess, dry, f.sigma0_n_m).stick
    free, inertia = v + gain * force_n, 1.0 + gain * damping
    low, high = (free - 1.1 * gain * dry) / inertia, (free + 1.1 * gain * dry) / inertia
    mean = max(low, min(high, guess))
    for _ in range(ROUNDS):
        g = grip(z, half * mean, dry, f.sigma0_n_m)
        over = mean * inertia + gain * g.force_n - free
        if abs(over) <= EXACT * (abs(free) + gain * dry):
            break
        if over > 0.0:
            high = mean
        else:
            low = mean
        mean -= over / (inertia + gain * half * g.slope_n_m)
        if not low < mean < high:
            mean = 0.5 * (low + high)
    move, most = h * mean, 0.25 * dry / f.sigma0_n_m
    return mean, Elements(
        held(z.z1 + move, most / K1),
        held(z.z2 + move, most / K2),
        held(z.z3 + move, most / K3),
        held(z.z4 + move, most / K4),
    )
