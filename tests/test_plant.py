"""The plant's dynamics: accuracy, stability, end stops, compiled code; its sensors."""

from __future__ import annotations

import itertools
import math
import random
import statistics

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plant_reference import IDEAL, REALISTIC, feedback, solve
from pneud.physics.cylinder import F1_exhaust, F1_fill, x3_of
from pneud.physics.gas import iso6358
from pneud.physics.plant import PlantParameters
from pneud.rig.dynamics import PlantState, advance, initial_state, step, stroke_position
from pneud.rig.sensors import Noise, PressureSensor, dac_output, quantised
from pneud.study.jit import JitError, jitted

BOTH = pytest.mark.parametrize("p", [REALISTIC, IDEAL], ids=["realistic", "ideal"])


def deviation(p: PlantParameters, seconds: float, steps_per_ms: int = 10) -> float:
    """Largest difference in position from the reference solution, both under one feedback at 1 kHz [m]."""
    p = p._replace(step_s=1e-3 / steps_per_ms)
    mine = true = initial_state(p)
    worst = 0.0
    for i in range(round(seconds * 1000)):
        t = i * 1e-3
        mine = advance(mine, feedback(t, mine, p), 0.0, t, t + 1e-3, p)
        true = solve(true, feedback(t, true, p), 0.0, t, t + 1e-3, p)
        worst = max(worst, abs(mine.x1 - true.x1))
    return worst


@BOTH
def test_position_is_within_a_micrometre_of_a_tight_reference(p: PlantParameters) -> None:
    assert deviation(p, 0.6) < 1e-6


@pytest.mark.slow
@BOTH
def test_position_stays_within_a_micrometre_for_ten_seconds(p: PlantParameters) -> None:
    assert deviation(p, 10.0) < 1e-6


@BOTH
def test_the_error_falls_with_the_square_of_the_step(p: PlantParameters) -> None:
    # a stretch without kinks: sliding, one chamber choked and one not
    start = PlantState(0.5, 0.3, 4.5e5, 3.2e5, 40.0 / 1e5, 0.6, 0.0, 0.0)

    def run(count: int) -> PlantState:
        s, h = start, 0.04 / count
        for i in range(count):
            s = step(s, 0.5, 0.0, i * h, h, p)
        return s

    coarse, fine, truth = run(400), run(800), solve(start, 0.5, 0.0, 0.0, 0.04, p)
    for name in ("x1", "v", "p1", "p2"):
        ratio = (getattr(coarse, name) - getattr(truth, name)) / (getattr(fine, name) - getattr(truth, name))
        assert 3.5 < ratio < 4.6, name


@BOTH
def test_the_initial_state_is_at_rest(p: PlantParameters) -> None:
    s = initial_state(p)
    assert (s.x1, s.v, s.p2) == (0.45, 0.0, 3e5)
    after = advance(s, 0.0, 0.0, 0.0, 1.0, p._replace(disturbance=0))
    assert after.x1 == pytest.approx(0.45, abs=1e-9)
    assert stroke_position(s, p) == pytest.approx(0.45 - 0.0132)


def sound(s: PlantState, p: PlantParameters) -> None:
    c = p.cylinder
    assert all(math.isfinite(value) for value in s[:8])
    assert c.x_e1 <= s.x1 <= c.x_e1 + c.stroke_m
    assert s.p1 > 0.0
    assert s.p2 > 0.0


@BOTH
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_full_travel_with_the_valve_fully_open_ends_calmly_at_the_stop(
    p: PlantParameters, direction: float
) -> None:
    p = p._replace(disturbance=0)
    s = initial_state(p)
    for i in range(3000):
        s = advance(s, 5.0 * direction, 0.0, i * 1e-3, (i + 1) * 1e-3, p)
        sound(s, p)
    c = p.cylinder
    assert s.x1 == (c.x_e1 + c.stroke_m if direction > 0 else c.x_e1)
    assert s.v == 0.0
    filled, emptied = (s.p1, s.p2) if direction > 0 else (s.p2, s.p1)
    assert filled == pytest.approx(p.gas.supply_pa, rel=1e-9)
    assert emptied == pytest.approx(p.gas.atmosphere_pa, rel=1e-9)


@pytest.mark.parametrize("h", [1e-4, 5e-5, 1e-5])
@pytest.mark.parametrize("wall", ["rear", "front"])
def test_pressures_in_the_dead_volumes_do_not_ring(wall: str, h: float) -> None:
    p = IDEAL._replace(disturbance=0, reverse_flow=True)
    c = p.cylinder
    front = wall == "front"
    s = initial_state(p)._replace(x1=c.x_e1 + (c.stroke_m if front else 0.0), p1=3e5, p2=3e5)
    u = -5.0 if not front else 5.0  # press against the wall: the small chamber empties
    for direction in (u, -u):
        start = s._replace(v=0.0)
        pressures = []
        s = start
        for i in range(400):
            s = step(s._replace(x1=start.x1, v=0.0), direction, 0.0, i * h, h, p)
            pressures.append(s.p2 if front else s.p1)
        moves = [b - a for a, b in itertools.pairwise(pressures) if abs(b - a) > 1.0]
        assert all(m > 0 for m in moves) or all(m < 0 for m in moves)


def test_a_stop_takes_energy_and_holds_no_bristles_back() -> None:
    p = REALISTIC
    c = p.cylinder
    s = initial_state(p)._replace(x1=c.x_e1 + 1e-5, v=-1.0, p1=2e5, p2=2.4e5)
    s = step(s, 0.0, 0.0, 0.0, 1e-4, p)
    assert (s.x1, s.v) == (c.x_e1, 0.0)
    held = s.z
    for i in range(1000):
        s = step(s, -5.0, 0.0, i * 1e-4, 1e-4, p)
    assert (s.x1, s.v) == (c.x_e1, 0.0)
    assert s.z == held
    for i in range(5000):
        s = step(s, 5.0, 0.0, i * 1e-4, 1e-4, p)
    assert s.x1 > c.x_e1 + 0.05


@given(
    st.floats(0.15, 0.9), st.floats(1.5e5, 5.5e5), st.floats(1.5e5, 5.5e5), st.floats(-5.0, 5.0),
    st.none() | st.floats(0.15, 0.5), st.floats(0.5, 2.0),
)  # fmt: skip
def test_what_the_law_asks_of_the_valve_is_what_the_plant_does(
    x1: float, p1: float, p2: float, u: float, b: float | None, exhaust: float
) -> None:
    p = IDEAL._replace(cylinder=IDEAL.cylinder._replace(M=1e12, exhaust=exhaust), disturbance=0)
    if b is not None:
        vent = iso6358(p.gas, 0.65 - b, 0.5)
        p = p._replace(gas=iso6358(p.gas, b, 0.5), cylinder=p.cylinder._replace(vent=vent))
    c, h = p.cylinder, 1e-7
    s = PlantState(x1, 0.0, p1, p2, 0.0, 0.0, 0.0, 0.0)
    after = step(s, u, 0.0, 0.0, h, p)
    rate = (x3_of(after.p1, after.p2, c) - x3_of(p1, p2, c)) / h
    f1 = F1_fill if u >= 0.0 else F1_exhaust
    believed = u * f1(x1, p1, p2, p.gas.supply_pa, c, p.gas)
    assert rate == pytest.approx(believed, rel=1e-3, abs=1.0)


@given(st.integers(0, 2**32), st.booleans(), st.booleans(), st.integers(0, 2))
def test_nothing_breaks_the_plant(seed: int, ideal: bool, reverse: bool, disturbance: int) -> None:
    r = random.Random(seed)
    p = (IDEAL if ideal else REALISTIC)._replace(reverse_flow=reverse, disturbance=disturbance)
    if r.random() < 0.5:
        p = p._replace(friction=p.friction._replace(sigma0_n_m=10 ** r.uniform(3, 9), coulomb_n=0.0))
    c = p.cylinder
    s = PlantState(
        c.x_e1 + r.choice((0.0, r.random(), 1.0)) * c.stroke_m, r.uniform(-8, 8),
        10 ** r.uniform(4.0, 6.2), 10 ** r.uniform(4.0, 6.2), 0.0,
        r.uniform(-5, 5), r.uniform(-1e3, 1e3), 0.0,
    )  # fmt: skip
    t = 0.0
    for _ in range(20):
        u, force = r.choice((-5.0, 5.0, 0.0, r.uniform(-5, 5))), r.choice((0.0, r.uniform(-2e3, 2e3)))
        span = r.choice((1e-9, 3e-5, 1e-3, 2.345e-3))
        s = advance(s, u, force, t, t + span, p)
        t += span
        sound(s, p)


def test_without_reverse_flow_a_chamber_above_supply_keeps_its_air() -> None:
    held = PlantState(0.5, 0.0, 7e5, 7e5, 0.0, 0.0, 0.0, 0.0)
    stuck = REALISTIC._replace(disturbance=0)
    for reverse, falls in ((False, False), (True, True)):
        p = stuck._replace(reverse_flow=reverse)
        s = advance(held, 1.0, -(p.cylinder.rod_force_n - 7e5 * 2e-4), 0.0, 5e-3, p)
        assert (s.p1 < 6.99e5) == falls


def test_an_external_force_and_its_sign() -> None:
    pushed = advance(initial_state(REALISTIC), 0.0, 200.0, 0.0, 0.05, REALISTIC)
    assert pushed.x1 < 0.449


def test_splitting_an_interval_changes_little() -> None:
    s = initial_state(REALISTIC)
    whole = advance(s, 1.0, 0.0, 0.0, 1e-2, REALISTIC)
    parts = s
    for a, b in ((0.0, 6.05e-5), (6.05e-5, 4.2e-3), (4.2e-3, 1e-2)):
        parts = advance(parts, 1.0, 0.0, a, b, REALISTIC)
    assert parts.x1 == pytest.approx(whole.x1, abs=1e-8)
    assert advance(s, 1.0, 0.0, 1.0, 1.0, REALISTIC) is s


@pytest.mark.slow
def test_compiled_code_gives_the_same_bits() -> None:
    compiled = jitted(advance)
    assert compiled is jitted(advance)
    r = random.Random(1)
    for p in (REALISTIC, IDEAL):
        a = b = initial_state(p)
        u = 0.0
        for i in range(1000):
            if i % 20 == 0:
                u = r.uniform(-5.0, 5.0) * r.random() ** 3
            a = advance(a, u, 0.0, i * 1e-3, (i + 1) * 1e-3, p)
            b = compiled(b, u, 0.0, i * 1e-3, (i + 1) * 1e-3, p)
            assert a == b
        assert jitted(step)(a, u, 10.0, 1.0, 7e-5, p) == step(a, u, 10.0, 1.0, 7e-5, p)


def test_a_small_compiled_function_gives_the_same_bits() -> None:
    compiled = jitted(quantised)
    assert all(compiled(x * 0.37, 0.1) == quantised(x * 0.37, 0.1) for x in range(-50, 50))


def test_what_cannot_be_compiled_is_named() -> None:
    limit = len("closed over")

    def nested(x: float) -> float:
        return x + limit

    with pytest.raises(JitError, match="closure"):
        jitted(nested)
    with pytest.raises(JitError, match="no plain Python function"):
        jitted(math.sin)


def test_quantisation_rounds_to_the_nearest_and_zero_is_exact() -> None:
    assert quantised(1.26e-6, 1e-6) == 1e-6
    assert quantised(-1.74e-6, 1e-6) == -2e-6
    assert quantised(0.123456789, 0.0) == 0.123456789


@given(st.floats(-20.0, 20.0), st.integers(1, 16))
def test_the_dac_is_within_half_a_step_and_its_codes(v: float, bits: int) -> None:
    lsb = 10.0 / 2**bits
    out = dac_output(v, bits, 5.0)
    assert -5.0 <= out <= 5.0 - lsb
    assert out / lsb == round(out / lsb)
    if -5.0 <= v <= 5.0 - lsb:
        assert abs(out - v) <= lsb / 2 + 1e-12


def test_the_dac_centre_is_exact_and_continuous_output_is_clipped() -> None:
    assert dac_output(0.0, 12, 5.0) == 0.0
    assert dac_output(7.0, 0, 5.0) == 5.0


def test_noise_repeats_with_its_seed_and_has_unit_deviation() -> None:
    a, b, c = Noise(7), Noise(7), Noise(8)
    draws = [a.draw() for _ in range(20_000)]
    assert draws == [b.draw() for _ in range(20_000)]
    assert draws[0] != c.draw()
    assert statistics.fmean(draws) == pytest.approx(0.0, abs=0.03)
    assert statistics.pstdev(draws) == pytest.approx(1.0, abs=0.03)
    assert Noise(0).draw() == 0.757963494141995  # the same on every machine


def test_a_pressure_sensor_stays_in_its_range() -> None:
    sensor = PressureSensor(Noise(1), 100.0, 20.0, 1e6)
    assert sensor.read(2e6) == 1e6
    assert sensor.read(-1e4) == 0.0
    assert sensor.read(3e5) % 20.0 == 0.0
    assert PressureSensor(Noise(1), 0.0, 0.0, 1e6).read(123456.7) == 123456.7
