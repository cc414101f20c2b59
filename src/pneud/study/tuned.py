"""The laws that are compared, with the gains that `pneud.study.tuner` found for them."""

from __future__ import annotations

import math
from collections.abc import Mapping

from pneud.control.homogeneous import feedback
from pneud.control.laws import adrc
from pneud.control.laws.pid import Pid
from pneud.control.laws.slot import ADRC, PID, Slot
from pneud.control.model import MOST_PUSH_RATIO
from pneud.control.motion import quickened, triple_pole
from pneud.control.step import Controller
from pneud.rig.damage import scaled

PID_FF, ADRC4, ADRC3, ISMC, COMPOSITE = "PID + FF", "ADRC, ESO 4", "ADRC, ESO 3", "ISMC", "composite"
ISMC_PAPER, COMPOSITE_PAPER = "ISMC, paper's gains", "composite, paper's gains"
EXTENDED, EXTENDED_TUNED = "extended composite", "extended, tuned alike"

GAINS: dict[str, dict[str, float]] = {
    PID_FF: {
        "kp": 7476.0, "ki": 343100.0, "kd": 146.2, "kf": 150.6, "reach": 0.007962, "hold": 0.002916,
        "bw": 497.2, "push": 994.4,
    },
    ADRC4: {"k1": 651800.0, "k2": 16300.0, "k3": 299.8, "reach": 0.01222, "hold": 0.08291, "eso": 203.4},
    ADRC3: {
        "k1": 564400.0, "k2": 14270.0, "k3": 121.5, "reach": 0.02515, "hold": 0.01903, "bw": 373.7,
        "push": 373.7, "rate": 991.8,
    },
    ISMC: {
        "k1": 92010.0, "k2": 29640.0, "k3": 55.33, "alpha": 0.6127, "eta": 3.8, "hold": 0.008954,
        "bw": 160.1, "push": 160.1,
    },
    COMPOSITE: {
        "k1": 79720.0, "k2": 30290.0, "k3": 429.4, "alpha": 0.5331, "eta": 81.21, "hold": 0.01101,
        "bw": 995.4, "push": 995.4, "L": 941.7,
    },
    EXTENDED_TUNED: {
        "k1": 111500.0, "k2": 7883.0, "k3": 162.6, "alpha": 0.8956, "eta": 0.2175, "L": 1909.0,
        "hold": 0.07267, "bw": 277.1, "push": 692.8, "rate": 566.2,
    },
}  # fmt: skip


def setting(name: str, base: Controller, gains: Mapping[str, float] | None = None) -> Controller:
    """The controller with a law and its tuned gains, or others.

    Every law shares the plant's model, prediction, motion filter, dead-zone inverse and friction feed-forward
    of `base`, the extended composite as configured.

    Args:
        name: of the law.
        base: the controller as configured.
        gains: other gains than those in `GAINS`.
    """
    if name == EXTENDED:
        return base
    s, h = base.sliding, base.h
    if name in (ISMC_PAPER, COMPOSITE_PAPER):
        ismc = name == ISMC_PAPER
        paper = feedback(200.0, 500.0, 400.0, 0.9) if ismc else feedback(220.0, 450.0, 350.0, 0.8)
        s = s._replace(gains=paper, eta=20.0, compensate_d=not ismc, implicit=True)
        observer = base.observer._replace(lambda0=10.0, lambda1=5.0, L=5.0)
        return without_force(base)._replace(sliding=s, observer=observer)
    g = GAINS[name] if gains is None else gains
    s = s._replace(hold_v=g["hold"])
    base = base._replace(sliding=s)
    if "bw" in g:
        slow = triple_pole(g["bw"], h, base.motion.blind_m)
        fast = triple_pole(max(1.0, min(MOST_PUSH_RATIO, g["push"] / g["bw"])) * g["bw"], h)
        base = base._replace(motion=quickened(slow, fast, base.motion.noise_m))
    if "rate" in g:
        base = base._replace(force_rate_gain=1.0 - math.exp(-g["rate"] * h))
    if "L" in g:
        base = base._replace(observer=base.observer._replace(L=g["L"]))
    if name in (ISMC, COMPOSITE, EXTENDED_TUNED):
        powers = feedback(g["k1"], g["k2"], g["k3"], g["alpha"])
        base = base._replace(sliding=s._replace(gains=powers, eta=g["eta"], compensate_d=name != ISMC))
        return base if name == EXTENDED_TUNED else without_force(base)
    base = base._replace(sliding=s._replace(compensate_d=False), use_x3_hat=False)
    if name == PID_FF:
        pid = Pid(g["kp"], g["ki"], g["kd"], g["kf"], g["reach"], 20e-6, 200.0)
        return base._replace(slot=Slot(PID, pid=pid))
    made = adrc.made((g["k1"], g["k2"], g["k3"], g["reach"], g.get("eso", 0.0)), h)
    return base._replace(slot=Slot(ADRC, adrc=made))


def without_force(base: Controller) -> Controller:
    """The controller without what the paper does not have: F̂, its rate, and friction fed forward."""
    return base._replace(use_force=False, force_rate_gain=0.0, friction=scaled(base.friction, 0.0))
