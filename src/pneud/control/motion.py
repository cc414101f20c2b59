"""The [x, v, F] filter: position, velocity and unmatched force from the encoder and the pressures.

A load pushed by the measured force x3 minus an unknown force F that walks at random, seen by an encoder. The
gains are the steady state of the Kalman filter of that model, without dimension (those of v and F are divided
by the true interval and its square), which keeps the filter stable when an interval is longer than planned.
"""

import math
from typing import NamedTuple

MAX_ITERATIONS = 1_000_000  # for the Kalman gains


class MotionFilter(NamedTuple):
    """Gains for position, velocity (times h) and acceleration (times h²)."""

    alpha: float
    beta: float
    gamma: float
    blind_m: float  # half of the encoder's resolution, within which a reading says nothing new
    noise_m: float = 0.0  # what noise explains; beyond it, this is added to the gains:
    more_alpha: float = 0.0
    more_beta: float = 0.0
    more_gamma: float = 0.0


class MotionState(NamedTuple):
    """Estimates at the last sample."""

    x: float  # [m], stroke coordinate
    v: float  # [m/s]
    F: float  # unmatched force against the motion [N]
    x3: float  # [N] at that sample
    innovation: float  # [m]
    unread_s: float = 0.0  # time predicted since the last encoder reading


def triple_pole(omega_rad_s: float, h: float, blind_m: float = 0.0) -> MotionFilter:
    """Gains that put all three poles at exp(−ω h) (an extended-state observer of bandwidth ω)."""
    q = math.exp(-omega_rad_s * h)
    p = 1.0 - q
    return MotionFilter(1.0 - q * q * q, 1.5 * (1.0 + q) * p * p, p * p * p, blind_m)


def quickened(p: MotionFilter, fast: MotionFilter, noise_m: float) -> MotionFilter:
    """A filter that takes what an innovation has beyond `noise_m` with the gains of a faster one.

    A push shows itself as innovations that noise does not explain. The correction is continuous, and lies
    between those of the two filters; each mixture of them is stable if they have a Lyapunov function in
    common, as two triple poles up to 2.5 times apart have.

    Args:
        p: for what lies within.
        fast: for what lies beyond.
        noise_m: the bound, counted from the edge of the blind band [m].
    """
    return p._replace(
        noise_m=noise_m,
        more_alpha=fast.alpha - p.alpha,
        more_beta=fast.beta - p.beta,
        more_gamma=fast.gamma - p.gamma,
    )


def kalman(
    encoder_noise_m: float, force_walk_n_rs: float, M: float, h: float, blind_m: float = 0.0
) -> MotionFilter:
    """Steady-state Kalman gains.

    A force that walks at random and white encoder noise leave one number: how far the walk moves the load in
    a sample, relative to the noise. The Riccati difference equation is iterated to its fixed point.

    Args:
        encoder_noise_m: standard deviation of one reading (resolution/√12 for a quantiser).
        force_walk_n_rs: standard deviation that the force gains in one second [N/√s].
        M: moving mass [kg].
        h: sample time [s].
        blind_m: half of the encoder's resolution, 0 to take every reading at its face value [m].
    """
    # in units of the encoder noise and of h: x += v + a/2, v += a, with a = −F h²/(M noise)
    q = (force_walk_n_rs * math.sqrt(h) * h * h / (M * encoder_noise_m)) ** 2
    # the walk integrated over one sample
    q11, q12, q13, q22, q23, q33 = q / 20.0, q / 8.0, q / 6.0, q / 3.0, q / 2.0, q
    p11, p12, p13, p22, p23, p33 = 1.0, 0.0, 0.0, 1.0, 0.0, 1.0
    alpha = beta = gamma = 0.0
    for _ in range(MAX_ITERATIONS):
        # predict with A = [[1, 1, ½], [0, 1, 1], [0, 0, 1]]
        a11, a12, a13 = p11 + p12 + 0.5 * p13, p12 + p22 + 0.5 * p23, p13 + p23 + 0.5 * p33
        b22, b23 = p22 + p23, p23 + p33
        m11 = a11 + a12 + 0.5 * a13 + q11
        m12 = a12 + a13 + q12
        m13 = a13 + q13
        m22 = b22 + b23 + q22
        m23 = b23 + q23
        m33 = p33 + q33
        s = m11 + 1.0
        g1, g2, g3 = m11 / s, m12 / s, m13 / s
        p11, p12, p13 = m11 - g1 * m11, m12 - g1 * m12, m13 - g1 * m13
        p22, p23, p33 = m22 - g2 * m12, m23 - g2 * m13, m33 - g3 * m13
        done = abs(g1 - alpha) + abs(g2 - beta) + abs(g3 - gamma) <= 1e-14 * (g1 + g2 + g3)
        alpha, beta, gamma = g1, g2, g3
        if done:
            break
    return MotionFilter(alpha, beta, gamma, blind_m)


def at_rest(x: float, x3: float, rod_force_n: float) -> MotionState:
    """The state of a load that stands still at x: the unmatched force balances x3."""
    return MotionState(x, 0.0, x3 - rod_force_n, x3, 0.0, 0.0)


def predict(
    state: MotionState, x3: float, force_step_n: float, rod_force_n: float, M: float, h: float
) -> MotionState:
    """The state h later, x3 having gone in a straight line from its last value to this one.

    Args:
        state: at the last sample.
        x3: now [N].
        force_step_n: what the unmatched force is known to have gained meanwhile [N].
        rod_force_n: of the atmosphere on the rod's side.
        M: moving mass [kg].
        h: time since the last sample [s].
    """
    before = state.x3 - rod_force_n - state.F
    after = x3 - rod_force_n - state.F - force_step_n
    x = state.x + h * (state.v + h * (before / 3.0 + after / 6.0) / M)
    v = state.v + 0.5 * h * (before + after) / M
    return MotionState(x, v, state.F + force_step_n, x3, 0.0, state.unread_s + h)


def correct(state: MotionState, position_m: float, M: float, h: float, p: MotionFilter) -> MotionState:
    """The predicted state after an encoder reading.

    The error has grown since the last reading: over a longer interval it says less about velocity and force.
    Over one shorter than a sample it says no more than over a whole one, or a late tick would be a blow.
    A reading stands for a whole step of the encoder: a prediction within it is left alone, and one outside
    is drawn to its edge. Otherwise each new step would be a blow of half its height to the estimates.
    """
    interval = max(h, state.unread_s)
    innovation = position_m - state.x
    r, more = beyond(innovation, p)
    return MotionState(
        state.x + (p.alpha * r + p.more_alpha * more),
        state.v + (p.beta * r + p.more_beta * more) / interval,
        state.F - M * (p.gamma * r + p.more_gamma * more) / (interval * interval),
        state.x3,
        innovation,
        0.0,
    )


def held(state: MotionState, rod_force_n: float, share: float) -> MotionState:
    """The state of a load that friction holds: what moves it dies away, and no force is out of balance.

    Args:
        state: after a reading.
        rod_force_n: of the atmosphere on the rod's side.
        share: of what is left to go in a tick.
    """
    return MotionState(
        state.x,
        state.v * (1.0 - share),
        state.F + share * (state.x3 - rod_force_n - state.F),
        state.x3,
        state.innovation,
        state.unread_s,
    )


def beyond(innovation_m: float, p: MotionFilter) -> tuple[float, float]:
    """What an innovation has beyond the blind band, and of that beyond the noise [m]."""
    r = innovation_m - max(-p.blind_m, min(p.blind_m, innovation_m))
    return r, r - max(-p.noise_m, min(p.noise_m, r))
