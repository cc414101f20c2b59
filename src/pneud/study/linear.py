"""Gains of the linear laws (PID, ADRC) for a bandwidth, and what they will do."""

from __future__ import annotations

from typing import Any, NamedTuple

from pneud.config.conversions import command_delay_s, lead_s, slot_of, valve_of
from pneud.config.models import Config
from pneud.control.laws.slot import Entry
from pneud.control.tunables import LEAST_MARGIN, delay_margin_of, doubts, in_slot
from pneud.study import gains

REACH_PER_ERROR = 10.0  # errors so much larger are driven home evenly


class LinearPrediction(NamedTuple):
    """What gains will do."""

    bandwidth_rad_s: float  # of the triple pole with the same gain for the position
    acceleration_noise_m_s2: float  # standard deviation of x3/M, from the pressures
    delay_s: float  # from sample to effect, with half a sample of hold
    delay_margin_s: float


def designed(c: Config, law: Entry, omega_rad_s: float, error_m: float) -> Config:
    """The configuration with a law and its gains by rule, rounded to four digits.

    Filters as for the sliding law; feedback reaches as far as ten times the error. Nothing is checked: see
    `warnings`.
    """
    own = {name: gains.rounded(value) for name, value in law.rule(omega_rad_s).items()}
    table = getattr(c.control, law.name).model_copy(
        update={**own, "reach_m": gains.rounded(REACH_PER_ERROR * error_m)}
    )
    return gains.with_filters(c, omega_rad_s, {"law": law.name, law.name: table}, omega_rad_s**3)


def predict(c: Config, law: Entry) -> LinearPrediction:
    """What the gains of a law in a configuration will do."""
    loop = law.loop(_gains(c, law))
    return LinearPrediction(
        loop.bandwidth_rad_s, gains.acceleration_noise(c), _delay_s(c), delay_margin_of(loop)
    )


def warnings(c: Config, law: Entry) -> list[str]:
    """What is wrong with the gains of a law in a configuration, a line each."""
    share = LEAST_MARGIN if c.control.predict else 1.0
    return doubts(law, _gains(c, law), 1.0 / c.loop.rate_hz, _delay_s(c), share)


def doubts_of(c: Config) -> list[str]:
    """What is wrong with the gains of whichever law a configuration has."""
    law = in_slot(c.control.law)
    return gains.warnings(c, gains.predict(c)) if law is None else warnings(c, law)


def _gains(c: Config, law: Entry) -> Any:
    return getattr(slot_of(c.control, 1.0 / c.loop.rate_hz), law.name)


def _delay_s(c: Config) -> float:
    h = 1.0 / c.loop.rate_hz
    return lead_s(min(command_delay_s(c.bus), h), valve_of(c)) + 0.5 * h
