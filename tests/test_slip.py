"""Maxwell elements that slip: what they hold, what they cost, and that they remember."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pneud.physics.friction import Friction, stribeck
from pneud.physics.slip import K1, K2, K3, K4, Elements, grip, slip

SEALS = Friction(40.0, 55.0, 0.02, 60.0, 1e5, 300.0)
H = 1e-4


def carried(
    force_n: float, seconds: float, v: float = 0.0, z: Elements | None = None
) -> tuple[float, Elements]:
    z, a = z or Elements(), 0.0
    for _ in range(round(seconds / H)):
        mean, z = slip(v, z, v + 0.5 * H * a, force_n, 15.0, H, SEALS)
        a, v = (2.0 * mean - 2.0 * v) / H, 2.0 * mean - v
    return v, z


def stored_j(z: Elements, f: Friction) -> float:
    return 0.5 * f.sigma0_n_m * sum(k * x * x for k, x in zip((K1, K2, K3, K4), z, strict=True))


@given(
    st.floats(-5.0, 5.0),
    st.floats(-1e-3, 1e-3),
    st.floats(1e2, 1e9),
    st.floats(0.0, 1e5),
    st.floats(0.05, 100),
)
def test_slipping_takes_energy_whatever_the_stiffness(
    v: float, z: float, sigma0: float, sigma1: float, mass: float
) -> None:
    f = SEALS._replace(sigma0_n_m=sigma0, sigma1_n_s_m=sigma1)
    _, e = slip(0.0, Elements(z, z, z, z), 0.0, 0.0, 1e12, H, f)  # no further than they are held
    energy = 0.5 * mass * v * v + stored_j(e, f)
    for _ in range(50):
        mean, e = slip(v, e, v, 0.0, mass, H, f)
        v = 2.0 * mean - v
        now = 0.5 * mass * v * v + stored_j(e, f)
        assert now <= energy * (1.0 + 1e-9) + 1e-12
        energy = now


@pytest.mark.parametrize("v", [0.1, 0.3, -0.15])
def test_what_slides_on_is_braked_by_friction_alone(v: float) -> None:
    e, a = Elements(), 0.0
    for _ in range(1000):
        _, e = slip(v, e, v, 0.0, 1e12, H, SEALS)
    while abs(v) > 0.06:
        mean, e = slip(v, e, v + 0.5 * H * a, 0.0, 15.0, H, SEALS)
        a, v = (2.0 * mean - 2.0 * v) / H, 2.0 * mean - v
        assert abs(15.0 * a) == pytest.approx(
            stribeck(mean, SEALS) + SEALS.viscous_n_s_m * abs(mean), rel=0.01
        )


@pytest.mark.parametrize("v", [0.005, 0.05, -0.3])
def test_steady_sliding_is_as_stribeck_says(v: float) -> None:
    e = Elements()
    for _ in range(6000):
        _, e = slip(v, e, v, 0.0, 1e12, H, SEALS)
    dry = stribeck(v, SEALS)
    assert grip(e, 0.0, dry, SEALS.sigma0_n_m).force_n == pytest.approx(math.copysign(dry, v))


def test_a_load_is_held_up_to_static_friction() -> None:
    v, e = carried(38.0, 3.0)
    assert abs(v) < 1e-8
    assert grip(e, 0.0, 55.0, SEALS.sigma0_n_m).force_n == pytest.approx(38.0, rel=1e-4)
    assert carried(60.0, 1.0)[0] > 0.05


def test_it_gives_way_one_element_after_another() -> None:
    stiffness = [
        grip(Elements(), x + 1e-9, 55.0, 1e5).force_n - grip(Elements(), x, 55.0, 1e5).force_n
        for x in (1e-5, 3e-4, 6e-4, 1.2e-3, 3e-3)
    ]
    assert stiffness == sorted(stiffness, reverse=True)
    assert stiffness[0] == pytest.approx(1e-4)
    assert stiffness[-1] == 0.0


def test_without_dry_friction_there_is_nothing_to_bend() -> None:
    f = SEALS._replace(coulomb_n=0.0, static_n=0.0)
    mean, e = slip(1.0, Elements(1e-4), 1.0, 0.0, 15.0, H, f)
    assert e == Elements()
    assert mean == pytest.approx(1.0 / (1.0 + 0.5 * H / 15.0 * 60.0))
