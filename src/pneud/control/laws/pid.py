"""PID with feed-forward: a position loop around a force loop.

Velocity, acceleration, jerk and friction of the reference are fed forward; the force loop goes through the
model's F0 and F1.
"""

from typing import NamedTuple

from pneud.control.laws.open_loop import OpenLoop, cube_root
from pneud.control.laws.situation import Situation, within


class Pid(NamedTuple):
    """Gains."""

    kp: float  # [1/s²]
    ki: float  # [1/s³]
    kd: float  # [1/s]
    kf: float  # of the force loop [1/s]
    reach_m: float  # position error that feedback takes at most, so that large errors are driven home evenly
    quiet_m: float  # the integral rests within this error
    force_max_n: float  # greatest integral


class PidState(NamedTuple):
    """What PID carries from tick to tick."""

    integral_n: float = 0.0


def begin(unmodelled_n: float, g: Pid) -> PidState:
    """The state of a PID that takes over: the integral is the force that is not fed forward."""
    return PidState(within(unmodelled_n, g.force_max_n))


def demand(own: PidState, s: Situation, g: Pid) -> float:
    """Rate of the force [N/s] that closes in on the force which the load needs."""
    goal, friction = s.goal, s.friction
    w1 = within(s.w1, g.reach_m)
    rubbing = friction.now_n + friction.ahead_n
    need = s.M * (goal.acceleration_m_s2 + g.kp * w1 + g.kd * s.w2) + rubbing + own.integral_n
    return s.M * goal.jerk_m_s3 + friction.rate_n_s + g.kf * (need - s.pressures_n) - s.f0 * s.motion.v


def after(own: PidState, s: Situation, Z: float, possible: bool, g: Pid) -> PidState:
    """The state after a demand; the integral stands still while it would drive a saturated valve further."""
    w1 = within(s.w1, g.reach_m)
    integral = own.integral_n
    if abs(w1) > g.quiet_m and (possible or Z * w1 < 0.0):
        integral += s.h * s.M * g.ki * w1
    return PidState(within(integral, g.force_max_n))


def made(values: tuple[float, ...], _h: float) -> Pid:
    """Gains from their values in order."""
    return Pid(*values)


def is_sound(g: Pid) -> bool:
    """Whether each gain is one of its kind (finite)."""
    return min(g.kp, g.kd, g.kf, g.reach_m) > 0.0 and min(g.ki, g.quiet_m, g.force_max_n) >= 0.0


def loop(g: Pid) -> OpenLoop:
    """Kf (s³ + kd s² + kp s + ki)/s⁴, stable where kf (kd kp − ki) > kp²."""
    return OpenLoop(
        hurwitz=g.kf * (g.kd * g.kp - g.ki) > g.kp * g.kp,
        criterion="kf·(kd·kp - ki) > kp²",
        bandwidth_rad_s=cube_root(g.kf * g.kp),
        fastest_rad_s=g.kf,
        numerator=(g.kf, g.kf * g.kd, g.kf * g.kp, g.kf * g.ki),
        denominator=(1.0, 0.0, 0.0, 0.0, 0.0),
    )


def rule(omega_rad_s: float) -> dict[str, float]:
    """Gains that put all four poles of the loop at −ω and its position gain at that of a triple pole."""
    w = omega_rad_s / 4.0 ** (1.0 / 3.0)
    return {"kp": w * w, "ki": 0.25 * w**3, "kd": 1.5 * w, "kf": 4.0 * w}
