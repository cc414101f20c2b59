"""What a rig may have besides the plain model: play, leaks, heat, a supply that gives way, slip, sensors."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plant_reference import REALISTIC
from pneud.loading import load
from pneud.physics.gas import iso6358, signed_flow
from pneud.physics.plant import Detail, PlantParameters
from pneud.replay.lockstep import Simulation, backend_of
from pneud.rig.damage import UNDAMAGED, advance_damaged
from pneud.rig.detail import Chamber, Hoses, behind_play, breathe, later, rubbing, supplied
from pneud.rig.dynamics import PlantState, advance, initial_state, with_depth
from pneud.rig.sensors import sensed
from pneud.signals import State

P = REALISTIC._replace(polytropic_exponent=1.4)
ALL = {
    "wall_time_s": 0.3,
    "polytropic_exponent": 1.4,
    "valve": {"flow": "iso6358", "critical_ratio": 0.3, "hysteresis_v": 0.02, "leakage": 0.002},
    "supply": {"receiver_m3": 2e-3},
    "hoses": {"volume_1_m3": 5e-6, "volume_2_m3": 5e-6, "delay_s": 1e-3},
    "friction": {"model": "gms", "pressure_share_bar": 0.03, "forward_share": 0.03},
    "sensors": {"pressure_lag_s": 1e-3, "encoder_noise_m": 5e-7, "p1_offset_pa": 300.0},
}
V = 1e-4  # of a chamber [m³]
volts = st.floats(-5.0, 5.0)


def plant(**detail: Any) -> PlantParameters:
    return P._replace(detail=Detail(on=True, **detail))


def held(p: PlantParameters) -> PlantParameters:
    """A piston that nothing moves."""
    return p._replace(cylinder=p.cylinder._replace(M=1e12))


def run(
    p: PlantParameters, seconds: float, command_v: float = 0.0, s: PlantState | None = None
) -> PlantState:
    s = initial_state(p) if s is None else s
    for i in range(round(100 * seconds)):
        s = advance(s, command_v, 0.0, 0.01 * i, 0.01 * (i + 1), p)
    return s


def mass_of(pressure_pa: float) -> float:
    """Of air in V at the temperature of the supply."""
    return pressure_pa * V / (P.gas.R * P.gas.temperature_k)


def test_without_details_it_is_the_plain_rig() -> None:
    a, b = initial_state(P), initial_state(plant())
    for i in range(300):
        t, u = 1e-3 * i, 0.8 * math.sin(0.05 * i)
        a, b = advance(a, u, 20.0, t, t + 1e-3, P), advance(b, u, 20.0, t, t + 1e-3, plant())
    assert abs(a.x1 - 0.45) > 1e-3
    assert a[:8] == pytest.approx(b[:8], rel=1e-6, abs=1e-9)


@given(st.floats(1.1e5, 5.9e5), st.floats(0.2, 5.0), st.floats(280.0, 330.0), st.none() | st.floats(0.2, 0.5))
def test_air_that_flows_has_mass_and_energy(
    pa: float, open_v: float, temperature_k: float, b: float | None
) -> None:
    """qm = A √(k/(R T)) γ P, and it brings cp T of where it comes from."""
    p = plant(wall_s=1e9)
    g = P.gas if b is None else iso6358(P.gas, b, 0.5)
    p, h = p._replace(gas=g, cylinder=p.cylinder._replace(vent=g)), 1e-8
    c = Chamber(pa, pa * V / (g.R * temperature_k), 0.0)
    area = p.cylinder.c1 / (g.k * math.sqrt(g.R * g.k * g.temperature_k)) * open_v
    for fill, empty, into, from_k in (
        (open_v, 0.0, signed_flow(g.supply_pa, pa, g), g.temperature_k),
        (0.0, open_v, -signed_flow(pa, g.atmosphere_pa, g), temperature_k),
    ):
        after = breathe(c, fill, empty, g.supply_pa, V, h, p)
        flow = area * math.sqrt(g.k / (g.R * from_k)) * into
        came_kg = after.mass_kg - c.mass_kg
        assert came_kg == pytest.approx(h * flow, rel=2e-3, abs=1e-14)
        gained_j = (after.pressure_pa - pa) * V / (g.k - 1.0)
        assert gained_j == pytest.approx(came_kg * g.k / (g.k - 1.0) * g.R * from_k, rel=1e-3, abs=1e-9)
        assert after.drawn_kg == (pytest.approx(came_kg) if fill else 0.0)


def test_sealed_air_keeps_its_mass_and_takes_the_walls_temperature() -> None:
    p = plant(wall_s=0.05)
    start = with_depth(PlantState(0.5, 1.0, 3e5, 3e5, 0.0, 0.0, 0.0, 0.0), p)
    fast = advance(start, 0.0, 0.0, 0.0, 1e-3, p)
    assert fast.p1 * fast.x1**1.4 == pytest.approx(3e5 * 0.5**1.4, rel=1e-3)
    later = run(p, 2.0, s=start)
    assert later.x1 != pytest.approx(0.5, abs=1e-3)
    for s in (fast, later):
        assert (s.depth.mass1_kg, s.depth.mass2_kg) == (start.depth.mass1_kg, start.depth.mass2_kg)
    assert later.p1 * later.x1 == pytest.approx(3e5 * 0.5, rel=1e-6)


def test_filled_air_is_hot_until_the_wall_has_cooled_it() -> None:
    p = held(plant(wall_s=0.1))
    filled = run(p, 0.03, 1.0)
    c, g = p.cylinder, p.gas
    at_rest_pa = filled.depth.mass1_kg * g.R * g.temperature_k / (c.A1 * filled.x1)
    assert filled.p1 > 1.005 * at_rest_pa
    closed = run(p, 3.0, 0.0, filled)
    mass_kg = closed.depth.mass1_kg  # the spool needed a moment to close
    assert closed.p1 == pytest.approx(mass_kg * g.R * g.temperature_k / (c.A1 * closed.x1), rel=1e-6)


@pytest.mark.parametrize("out", [0.4, 1.0, 2.5])
def test_leaks_set_the_pressure_at_rest(out: float) -> None:
    """Where as much comes from the supply as goes to the atmosphere."""
    p = held(plant(leak_in_v=1.0, leak_out_v=1.0 * out))
    s = run(p._replace(initial_x1=p.cylinder.x_e1 + 0.01), 0.4)  # chamber 1 is small, and soon at rest
    g = p.gas
    assert signed_flow(g.supply_pa, s.p1, g) == pytest.approx(
        out * signed_flow(s.p1, g.atmosphere_pa, g), rel=0.02
    )


def test_without_air_nothing_moves() -> None:
    p = plant(leak_in_v=0.02, leak_out_v=0.02, wall_s=0.3, play_v=0.01, slips=True, receiver_pa_kg=1e8)
    p = p._replace(gas=p.gas._replace(supply_pa=p.gas.atmosphere_pa), initial_p2_pa=p.gas.atmosphere_pa)
    s = run(p, 0.5)
    assert s.x1 == pytest.approx(0.45, abs=1e-9)
    assert s.p1 == pytest.approx(p.gas.atmosphere_pa, rel=1e-9)


@given(st.lists(volts, min_size=2, max_size=30), st.floats(0.0, 1.0))
def test_play_is_what_a_spool_has_to_take_up(ways: list[float], play: float) -> None:
    at = ways[0]
    for before, spool in pairwise(ways):
        was, at = at, behind_play(at, spool, play)
        assert abs(at - spool) <= play + 1e-12
        assert (at - was) * (spool - before) >= 0.0 or abs(was - before) > play


def test_there_is_a_way_up_and_a_way_back() -> None:
    p = plant(play_v=0.05)
    p = p._replace(valve=p.valve._replace(zeta=2.0))  # without overshoot
    up = run(p, 0.1, 0.5).depth.spool_v
    back = run(p, 0.1, 0.4, run(p, 0.1, 1.0)).depth.spool_v
    assert [up, back] == pytest.approx([0.45, 0.45], abs=1e-6)


def test_hoses_delay_what_flows() -> None:
    d, q, area = Detail(on=True, hose_s=3e-3), Hoses(), 0.0
    for _ in range(1000):
        q = later(q, 1.0, 1e-5, d)
        area += 1e-5 * (1.0 - q.far_v)
    assert q.far_v == pytest.approx(1.0, abs=1e-2)
    assert area == pytest.approx(3e-3, rel=0.02)
    assert later(q, 0.5, 1e-4, Detail(on=True)) == (0.5, 0.5, 0.5)


def test_a_receiver_gives_what_is_drawn_and_the_regulator_fills_it_again() -> None:
    d = Detail(on=True, receiver_pa_kg=4e7, regulator_kg_s_pa=2e-7)
    pa, g, h, drawn_kg_s = P.gas.supply_pa, P.gas, 1e-4, 5e-3
    first = supplied(pa, 1e-6, h, g, d._replace(regulator_kg_s_pa=0.0))
    assert pa - first == pytest.approx(40.0)  # R T/V for each kg
    for _ in range(20_000):
        pa = supplied(pa, drawn_kg_s * h, h, g, d)
    assert g.supply_pa - pa == pytest.approx(drawn_kg_s / 2e-7, rel=0.01)
    for _ in range(20_000):
        pa = supplied(pa, 0.0, h, g, d)
    assert pa == pytest.approx(g.supply_pa, rel=1e-6)


def test_a_supply_gives_way_while_a_chamber_fills() -> None:
    p = held(plant(receiver_pa_kg=4e7, regulator_kg_s_pa=1e-7))
    s = advance(initial_state(p), 5.0, 0.0, 0.0, 0.02, p)
    drawn_kg = s.depth.mass1_kg - initial_state(p).depth.mass1_kg
    assert 0.0 < p.gas.supply_pa - s.depth.supply_pa <= drawn_kg * 4e7
    assert sensed(s, p).supply_pa == s.depth.supply_pa


@given(st.floats(-1.0, 1.0), st.floats(1e5, 6e5), st.floats(-0.1, 0.1), st.floats(-0.5, 0.5))
def test_friction_hangs_on_pressure_and_direction(v: float, pa: float, rise: float, forward: float) -> None:
    f = rubbing(v, pa, P.friction, Detail(rise_1_pa=1e-5 * rise, forward_share=forward))
    share = (1.0 + rise * (pa / 1e5 - 3.0)) * (1.0 + (forward if v > 0.0 else -forward))
    assert f.coulomb_n == pytest.approx(share * P.friction.coulomb_n)
    assert f.sigma0_n_m == P.friction.sigma0_n_m


def test_sensors_lag_behind_and_are_offset() -> None:
    p = plant(pressure_lag_s=2e-3, encoder_lag_s=1e-3, encoder_offset_m=1e-4, p1_offset_pa=500.0)
    s = initial_state(p)
    assert sensed(s, p).p1_pa == s.p1 + 500.0
    seen = []
    for i in range(40):
        s = advance(s, 1.0, 0.0, 1e-3 * i, 1e-3 * (i + 1), p)
        seen.append((s, sensed(s, p)))
    (_, before), (s, now) = seen[-2:]
    assert now.p2_pa == pytest.approx(s.p2 + (before.p2_pa - s.p2) * math.exp(-0.5), rel=1e-3)
    assert now.position_m == pytest.approx(s.x1 - p.cylinder.x_e1 + 1e-4 - 1e-3 * s.v)


@given(
    st.builds(
        Detail,
        on=st.just(True),
        play_v=st.floats(0.0, 0.5),
        leak_in_v=st.floats(0.0, 0.5),
        leak_out_v=st.floats(0.0, 0.5),
        wall_s=st.floats(0.0, 1.0),
        receiver_pa_kg=st.floats(0.0, 1e9),
        regulator_kg_s_pa=st.floats(1e-9, 1e-6),
        slips=st.booleans(),
        rise_1_pa=st.floats(-1e-6, 1e-6),
        forward_share=st.floats(-0.5, 0.5),
        pressure_lag_s=st.floats(0.0, 0.1),
        hose_s=st.floats(0.0, 0.01),
        contact_n_m=st.floats(0.0, 1e7),
        contact_m=st.just(initial_state(P).x1),
        contact_n_s_m=st.floats(0.0, 1e5),
        contact_side=st.sampled_from((-1.0, 1.0)),
    ),
    st.lists(volts, min_size=5, max_size=5),
    st.booleans(),
)
def test_nothing_breaks_a_plant_with_details(d: Detail, ways: list[float], reverse: bool) -> None:
    p = P._replace(detail=d, reverse_flow=reverse)
    s, c = initial_state(p), p.cylinder
    for i, u in enumerate(ways):
        s = advance(s, u, 0.0, 4e-3 * i, 4e-3 * (i + 1), p)
        assert all(math.isfinite(x) for x in (*s[:8], *s.depth[:7], *s.depth.elements))
        assert c.x_e1 <= s.x1 <= c.x_e1 + c.stroke_m
        assert min(s.p1, s.p2, s.depth.mass1_kg, s.depth.mass2_kg) > 0.0


def test_a_leak_of_a_broken_hose_takes_mass_along() -> None:
    p = held(plant(wall_s=0.2))
    burst = UNDAMAGED._replace(leak1=1.0, seized=True)
    s = advance_damaged(initial_state(p), 0.0, 0.0, 0.0, 2.0, p, burst)
    at_rest_kg = p.gas.atmosphere_pa * p.cylinder.A1 * s.x1 / (p.gas.R * p.gas.temperature_k)
    assert s.p1 == pytest.approx(p.gas.atmosphere_pa, rel=1e-3)
    assert s.depth.mass1_kg == pytest.approx(at_rest_kg, rel=0.02)


def test_an_axis_tracks_with_all_of_it() -> None:
    """Sensors, valve, air and seals of the plant by ISO 6358, those of the law by the orifice."""
    axis = load("virtual.toml", change={"plant": ALL})
    records = list(Simulation(axis, 3.5, 1, backend_of(axis)).records())
    tracked = [r for r in records if r.tick.state == State.TRACKING][-500:]
    assert len(tracked) == 500
    assert max(abs(r.tick.reference.position_m - r.truth_m) for r in tracked) < 5e-4
    supplies = [r.tick.measurement.supply_pa for r in tracked]
    assert max(supplies) - min(supplies) > 500.0
