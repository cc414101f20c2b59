"""Gains for a law and a bandwidth, with what they will do and what is wrong with them."""

from __future__ import annotations

from typing import NamedTuple

from pneud.config.conversions import gains_of
from pneud.config.models import Config
from pneud.control.tunables import LAWS as EVERY_LAW
from pneud.control.tunables import in_slot, is_hurwitz
from pneud.study import gains, linear

LAWS = (*dict.fromkeys(law.partition("-")[0] for law in EVERY_LAW),)


class Proposal(NamedTuple):
    """A design."""

    config: Config
    prediction: gains.Prediction | linear.LinearPrediction
    doubts: list[str]
    sound: bool  # gains that pneud takes


def propose(c: Config, law: str, omega_rad_s: float, error_m: float, alpha: float) -> Proposal:
    """The gains of a law for a bandwidth.

    Args:
        c: the configuration that they are for.
        law: one of LAWS.
        omega_rad_s: bandwidth.
        error_m: position error at which the bandwidth is that.
        alpha: exponent of the sliding laws.
    """
    entry = in_slot(law)
    if entry is not None:
        c = linear.designed(c, entry, omega_rad_s, error_m)
        return Proposal(c, linear.predict(c, entry), linear.warnings(c, entry), True)
    c = gains.designed(c, omega_rad_s, error_m, alpha)
    c = c.model_copy(update={"control": c.control.model_copy(update={"law": law})})
    p = gains.predict(c, error_m)
    return Proposal(c, p, gains.warnings(c, p), is_hurwitz(gains_of(c)))
