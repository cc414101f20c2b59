"""Laws and gains that may be changed while the axis runs: order, what they must keep, how they are taken.

The values begin with the code of a law, an index of LAWS; the gains of that law follow. Never limits: what
protects the axis is not for tuning.
"""

from __future__ import annotations

from pneud.control.homogeneous import Feedback, feedback
from pneud.control.laws.open_loop import OpenLoop
from pneud.control.laws.open_loop import delay_margin as margin_of
from pneud.control.laws.slot import IN_SLOT, SLIDING, Entry, Slot
from pneud.control.step import Controller

TUNABLE = ("law", "k1", "k2", "k3", "alpha", "eta_m_s3", "lambda0", "lambda1", "gain_n_s2")  # sliding laws
SLIDING_LAWS = ("composite-implicit", "composite-explicit", "ismc-implicit", "ismc-explicit")
LAWS = (*SLIDING_LAWS, *(law.name for law in IN_SLOT))  # by their code

MOST_H_OMEGA = 1.0  # twice the bandwidth gains a third of the error above it, more than half below it
ERROR_M = 1e-3  # position error at which the homogeneous feedback is linearised
LEAST_MARGIN = 0.5  # delay margin over delay; with less, all hangs on the prediction
MOST_H_K3 = 2.0  # an explicit form grows without bound from here on


def in_slot(law: str) -> Entry | None:
    """The law of that name in the slot; None where it is a sliding law."""
    return next((entry for entry in IN_SLOT if entry.name == law), None)


def names_of(law: str) -> tuple[str, ...]:
    """Names of the values that belong to a law, in their order."""
    entry = in_slot(law)
    return TUNABLE if entry is None else ("law", *(f"{law}.{name}" for name in entry.tunable))


def parted(values: tuple[float, ...]) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
    """The values that belong to the law which the first one names, and what follows; None for no such law."""
    if not values or values[0] not in range(len(LAWS)):
        return None
    count = len(names_of(LAWS[int(values[0])]))
    return (values[:count], values[count:]) if len(values) >= count else None


def tunables(p: Controller) -> tuple[float, ...]:
    """The present values."""
    entry = _of(p.slot)
    if entry is not None:
        own = getattr(p.slot, entry.name)
        return (float(LAWS.index(entry.name)), *own[: len(entry.tunable)])
    g, observer = p.sliding.gains, p.observer
    code = 2 * (not p.sliding.compensate_d) + (not p.sliding.implicit)
    alpha = g.a3
    return (
        float(code),
        g.k1,
        g.k2,
        g.k3,
        alpha,
        p.sliding.eta,
        observer.lambda0,
        observer.lambda1,
        observer.L,
    )


def is_sound(values: tuple[float, ...]) -> bool:
    """Whether each value is one of its kind (as many as the law has, finite)."""
    entry = in_slot(LAWS[int(values[0])])
    if entry is not None:
        return entry.is_sound(entry.gains(*values[1:]))
    _, k1, k2, k3, alpha, eta, lambda0, lambda1, gain = values
    return min(k1, k2, k3, lambda0, lambda1, gain) > 0.0 and 0.5 < alpha <= 1.0 and eta >= 0.0


def is_stable(values: tuple[float, ...], p: Controller) -> bool:
    """Whether the loop can have sound values: Lemma 2, and what sample rate and delay can carry.

    Hurwitz gains; an observer that follows a disturbance as fast as its gain says (λ1 > 1); h ω within
    MOST_H_OMEGA; a delay margin of LEAST_MARGIN of the delay; h k3 below MOST_H_K3 for an explicit form.
    """
    entry = in_slot(LAWS[int(values[0])])
    if entry is not None:
        return not doubts(entry, entry.gains(*values[1:]), p.h, delay_of(p))
    law, k1, k2, k3, alpha, _, _, lambda1, _ = values
    g = feedback(k1, k2, k3, alpha)
    return (
        is_hurwitz(g)
        and lambda1 > 1.0
        and p.h * bandwidth(g, ERROR_M) <= MOST_H_OMEGA
        and delay_margin(g, ERROR_M) >= LEAST_MARGIN * delay_of(p)
        and (law % 2.0 == 0.0 or p.h * k3 < MOST_H_K3)
    )


def tuned(values: tuple[float, ...], p: Controller) -> Controller:
    """The controller with stable values; the gains of other laws stay."""
    entry = in_slot(LAWS[int(values[0])])
    if entry is not None:
        slot = p.slot._replace(kind=entry.kind, **{entry.name: entry.made(values[1:], p.h)})
        return p._replace(slot=slot, sliding=p.sliding._replace(compensate_d=False))
    law, k1, k2, k3, alpha, eta, lambda0, lambda1, gain = values
    sliding = p.sliding._replace(
        gains=feedback(k1, k2, k3, alpha), eta=eta, implicit=law % 2.0 == 0.0, compensate_d=law < 2.0
    )
    observer = p.observer._replace(lambda0=lambda0, lambda1=lambda1, L=gain)
    return p._replace(sliding=sliding, observer=observer, slot=p.slot._replace(kind=SLIDING))


def _of(slot: Slot) -> Entry | None:
    return next((entry for entry in IN_SLOT if entry.kind == slot.kind), None)


def delay_of(p: Controller) -> float:
    """Time [s] from a sample to its command's effect, with half a sample of hold."""
    return max(p.lead_s, p.delay_s) + 0.5 * p.h


def delay_margin_of(loop: OpenLoop) -> float:
    """Dead time [s] at which a loop loses its phase margin; zero where it is unstable without any."""
    return margin_of(loop.numerator, loop.denominator) if loop.hurwitz else 0.0


def doubts(
    law: Entry, gains: tuple[float, ...], h: float, delay_s: float, share: float = LEAST_MARGIN
) -> list[str]:
    """What of a law of the slot the loop cannot have, a line each.

    Args:
        law: which law.
        gains: its gains.
        h: sample time [s].
        delay_s: from a sample to its command's effect, with half a sample of hold.
        share: least delay margin over that delay.
    """
    loop = law.loop(gains)
    margin_s = delay_margin_of(loop)
    omega = loop.bandwidth_rad_s
    found = []
    if not loop.hurwitz:
        found.append(f"not Hurwitz: needs {loop.criterion}")
    if not h * omega <= MOST_H_OMEGA:
        found.append(
            f"{1.0 / h:g} Hz are few for {omega:.0f} rad/s (h ω = {h * omega:.2g},"
            f" above {MOST_H_OMEGA:g} little is gained); take a higher rate"
        )
    if not h * loop.fastest_rad_s < MOST_H_K3:
        found.append(f"{1.0 / h:g} Hz are few for a gain of {loop.fastest_rad_s:.4g} /s; take a higher rate")
    if loop.hurwitz and margin_s < share * delay_s:
        found.append(
            f"delay of {1e3 * delay_s:.2f} ms needs a margin of {1e3 * share * delay_s:.2f} ms,"
            f" and has one of {1e3 * margin_s:.2f} ms; take less bandwidth"
        )
    return found


def is_hurwitz(g: Feedback) -> bool:
    """Lemma 2: k2 k3 > k1."""
    return g.k2 * g.k3 > g.k1


def bandwidth(g: Feedback, error_m: float) -> float:
    """ω [rad/s] of the linear loop with the same position gain at an error."""
    return float((g.k1 * error_m ** (g.a1 - 1.0)) ** (1.0 / 3.0))


def linearised(g: Feedback, error_m: float) -> tuple[float, float, float]:
    """Gains of a linear feedback with equal terms at errors A, ωA, ω²A [1/s³, 1/s², 1/s]."""
    w = bandwidth(g, error_m)
    return (
        w**3,
        g.k2 * (w * error_m) ** (g.a2 - 1.0),
        g.k3 * (w * w * error_m) ** (g.a3 - 1.0),
    )


def delay_margin(g: Feedback, error_m: float) -> float:
    """Dead time [s] at which the linearised loop (g3 s² + g2 s + g1)/s³ loses its phase margin.

    For a triple pole it is 0.407/ω. Zero where the loop is unstable without any.
    """
    g1, g2, g3 = linearised(g, error_m)
    return margin_of((g3, g2, g1), (1.0, 0.0, 0.0, 0.0)) if g2 * g3 > g1 else 0.0
