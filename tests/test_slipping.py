"""Friction that gives way faster than the valve can answer is told."""

from __future__ import annotations

import math

import pytest

from pneud.study.commissioning import slipping
from pneud.study.commissioning.slipping import caution
from pneud.study.identification import parameters as key
from pneud.study.identification.parameters import Estimate

CALM = {
    key.MASS: 1.0, key.COULOMB: 5.0, key.STATIC: 8.0, key.STRIBECK: 0.02, key.VISCOUS: 4.0,
    key.BANDWIDTH: 100.0,
}  # fmt: skip


def found(**other: float) -> dict[str, Estimate]:
    """Estimates, some of them unlike the calm ones, by the names of the module."""
    values = CALM | {getattr(key, name): value for name, value in other.items()}
    return {name: Estimate(value, value, value, None, True) for name, value in values.items()}


@pytest.mark.parametrize(
    "other",
    [{"STATIC": 16.0}, {"STRIBECK": 0.005}, {"MASS": 0.25}, {"BANDWIDTH": 25.0}],
    ids=lambda o: next(iter(o)),
)
def test_a_valve_that_is_too_slow_for_the_friction_is_told(other: dict[str, float]) -> None:
    assert caution(found()) == ""
    assert "in jumps with any gains" in caution(found(**other))


def test_nothing_is_said_of_what_is_not_told() -> None:
    for name in slipping.NEEDED:
        loose = found(STATIC=16.0)
        assert caution(loose)
        assert caution(loose | {name: loose[name]._replace(told=False)}) == ""
        assert caution({other: e for other, e in loose.items() if other != name}) == ""
    assert caution(found(STATIC=16.0, STRIBECK=0.0)) == ""


def test_friction_falls_no_faster_than_its_steepest_slope() -> None:
    static_n, coulomb_n, stribeck_m_s = 8.0, 5.0, 0.02

    def dry_n(v: float) -> float:
        return coulomb_n + (static_n - coulomb_n) * math.exp(-((v / stribeck_m_s) ** 2))

    steps = [(dry_n(1e-5 * i) - dry_n(1e-5 * (i + 1))) / 1e-5 for i in range(10_000)]
    assert slipping.growth_rad_s(static_n, coulomb_n, stribeck_m_s, 0.0, 1.0) == pytest.approx(
        max(steps), rel=1e-4
    )
    assert slipping.growth_rad_s(coulomb_n, coulomb_n, stribeck_m_s, 4.0, 2.0) == -2.0
