"""What becomes of estimates: the configuration, the rig that gains are tried on, the gains, and the page."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pneud.config.conversions import plant_of, valve_of
from pneud.config.models import Config
from pneud.config.sections import ConfigError
from pneud.loading import load
from pneud.study import fastest, judging, trial
from pneud.study.commissioning import gains
from pneud.study.commissioning import page as pages
from pneud.study.commissioning.estimated import believed, changed, encoder_step_m, rig
from pneud.study.commissioning.gains import SPREADS, Chosen, choose, spread, with_sine
from pneud.study.commissioning.verification import Verified
from pneud.study.identification import parameters as key
from pneud.study.identification.comparing import rows
from pneud.study.identification.estimating import Identified
from pneud.study.identification.parameters import Estimate
from pneud.study.identification.table import Piece, Table
from pneud.study.judging import NOMINAL, WHOLE, Figure, Judged, Lengths, Task

STEP_M, NOISE_PA = 5e-6, 120.0


def told(value: float, part: float = 0.05) -> Estimate:
    return Estimate(value, value - part * abs(value), value + part * abs(value), None, True)


FOUND = {
    key.CONDUCTANCE: told(4.4),
    key.CRITICAL: told(0.3),
    key.PLUS: told(0.3),
    key.MINUS: told(-0.05),
    key.HALF: told(0.125),
    key.CENTRE: told(0.175),
    key.BANDWIDTH: told(80.0),
    key.MASS: told(20.0),
    key.LOAD: told(-30.0),
    key.COULOMB: told(50.0),
    key.STATIC: told(49.0),
    key.STIFFNESS: Estimate(2e5, 1e3, 9e6, 1e5, False),
    key.DAMPING: told(300.0, 0.5),
    key.SEEP: told(0.002),
    key.EXPONENT: told(1.25),
}


@pytest.fixture(scope="module")
def virtual() -> Config:
    return load("virtual.toml").config


@pytest.fixture(scope="module")
def found(virtual: Config) -> Config:
    c = changed(virtual, believed(FOUND, STEP_M, virtual))
    return changed(c, rig(FOUND, STEP_M, NOISE_PA, c))


def test_the_controller_believes_what_is_told(virtual: Config, found: Config) -> None:
    v, k, f = found.valve, found.cylinder, found.control.friction
    assert (v.flow, v.sonic_conductance_l_s_bar, v.critical_ratio, v.orifice_area_m2) == (
        "iso6358", 4.4, 0.3, None,
    )  # fmt: skip
    assert (v.dead_zone_v, v.centre_v, v.bandwidth_hz) == (0.125, 0.175, 80.0)
    assert (k.moving_mass_kg, k.load_n) == (20.0, -30.0)
    assert (f.coulomb_n, f.static_n) == (50.0, 50.0)  # never below
    assert f.bristle_stiffness_n_m == virtual.control.friction.bristle_stiffness_n_m
    assert found.control.motion.encoder_resolution_m == STEP_M
    assert found.reference == virtual.reference


def test_the_rig_that_is_tried_is_the_one_that_is_believed_in(found: Config) -> None:
    plant = plant_of(found)
    assert plant.valve == valve_of(found)
    assert (plant.cylinder.M, plant.load_n, plant.polytropic_exponent) == (20.0, -30.0, 1.25)
    assert (plant.encoder_resolution_m, plant.pressure_noise_pa) == (STEP_M, NOISE_PA)
    assert plant.detail.leak_in_v == pytest.approx(0.002 * 5.0)
    assert not plant.detail.slips


def test_the_rig_may_slip_and_keep_its_heat(virtual: Config) -> None:
    warm = {key.WALL: told(0.3), key.SEEP: told(0.001), key.SEEP_OUT: told(0.002)}
    plant = plant_of(changed(virtual, rig(warm, STEP_M, NOISE_PA, virtual, slips=True)))
    assert plant.detail.slips
    assert plant.detail.wall_s == 0.3
    assert (plant.detail.leak_in_v, plant.detail.leak_out_v) == pytest.approx((0.005, 0.01))


def test_a_valve_that_overlaps_nothing_has_no_dead_zone(virtual: Config) -> None:
    values = believed({key.PLUS: told(-0.01), key.MINUS: told(-0.03)}, 0.0, virtual)
    assert (values[key.HALF], values[key.CENTRE]) == (0.0, 0.01)
    assert changed(virtual, values).valve.dead_zone_v == 0.0


def test_what_cannot_be_is_said(virtual: Config) -> None:
    with pytest.raises(ConfigError, match="moving_mass_kg"):
        changed(virtual, {key.MASS: -1.0})


@pytest.mark.parametrize("step_m", [5e-6, 10e-6, 4.88e-6])
def test_the_step_of_an_encoder_shows_in_its_readings(step_m: float) -> None:
    at_m = 0.4 + 1e-3 * np.sin(np.arange(2000) / 300.0)
    shown = np.round(np.round(at_m / step_m) * step_m, 6)
    nothing = np.zeros(len(shown))
    table = Table(1e-3, 5e-4, (Piece(shown, nothing, nothing, nothing, nothing),))
    assert encoder_step_m(table) == pytest.approx(step_m, abs=0.5e-6)
    bridged = shown.copy()
    bridged[1000:1003] += 4e-9
    pieces = (table.pieces[0]._replace(position_m=bridged),)
    assert encoder_step_m(table._replace(pieces=pieces)) == pytest.approx(step_m, abs=0.5e-6)


def test_the_spread_has_both_ends_of_each_interval(found: Config) -> None:
    plants = spread(plant_of(found), FOUND)
    assert len(plants) == 3 + 2 * len(SPREADS)
    masses = sorted({p.cylinder.M for p in plants.values()})
    assert masses == pytest.approx([19.0, 20.0, 21.0])
    stiffest = max(p.friction.sigma0_n_m for p in plants.values())
    assert stiffest == pytest.approx(4.0 * plant_of(found).friction.sigma0_n_m)
    assert plants["all high"].valve.dead_zone_v == pytest.approx(0.125 * 1.05)


def test_the_sine_is_that_of_the_verification_or_a_quicker_one(virtual: Config) -> None:
    r = with_sine(virtual).reference
    assert (r.amplitude_m, r.frequency_hz) == (0.1, 0.5)
    quick = virtual.reference.model_copy(update={"frequency_hz": 1.0, "amplitude_m": 0.05})
    assert with_sine(virtual.model_copy(update={"reference": quick})).reference == quick


def sessions(missed: float, calm: float) -> judging.Judge:
    """Judged without a run: faster than `missed` does not hold, slower than `calm` neither."""

    def judge(many: list[Task]) -> object:
        for task in many:
            omega = task.axis.controller.sliding.gains.k1 ** (1.0 / 3.0)
            bad = omega > missed or omega < calm
            yield Judged(task.case, (Figure("sine", "rms_m", 2e-4 if bad else 1e-6, 1e-4),))

    return judge  # type: ignore[return-value]


def test_gains_stay_where_nothing_can_be_tried(found: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trial, "compiled", lambda: (trial.trial, "no compiler"))
    chosen = choose(found, FOUND, 0.0)
    assert chosen.values(found) == {}
    assert "no compiler" in chosen.doubts[0]
    assert not chosen.holds
    assert pages.gains(chosen).startswith("gains: kept; nothing can be tried")


@pytest.mark.slow
@pytest.mark.parametrize(("missed", "kept"), [(60.0, False), (1.0, True)])
def test_gains_are_the_fastest_that_hold(
    found: Config, monkeypatch: pytest.MonkeyPatch, missed: float, kept: bool
) -> None:
    tried: list[tuple[Lengths, int]] = []

    class Judges:
        def __enter__(self) -> judging.Judge:
            judge = sessions(missed, 0.0)

            def counted(many: list[Task]) -> object:
                tried.append((many[0].course.lengths, len(many)))
                return judge(many)

            return counted  # type: ignore[return-value]

        def __exit__(self, *_: object) -> None: ...

    monkeypatch.setattr(judging, "judges", lambda _processes: Judges())
    chosen = choose(found, FOUND, 0.0)
    assert chosen.holds is not kept
    assert {count for lengths, count in tried if lengths == WHOLE} == {len(spread(plant_of(found), FOUND))}
    assert max(count for lengths, count in tried if lengths != WHOLE) == 3
    values = chosen.values(found)
    assert all(name.startswith("control.") for name in values)
    if not kept:
        assert changed(found, values).control == chosen.config.control
        assert "[control.motion]" in chosen.toml
        assert chosen.bandwidth_rad_s is not None


def test_the_page_shows_before_and_after() -> None:
    before = Verified((Figure("sine", "rms_m", 2e-4, 5e-5),), "tracking_error")
    after = Verified((Figure("sine", "rms_m", 2e-5, 5e-5), Figure("1 mm", "in_position_s", math.inf, 0.4)))
    assert pages.beside(before, after) == [
        ("sine: RMS [mm]", "0.05", "0.2*", "0.02"),
        ("1 mm: in position after [s]", "0.40", pages.NONE, "never*"),
    ]
    nothing = Identified({key.MASS: told(20.0)}, [], [], NOISE_PA, None, None)
    text = pages.page(
        "virtual <1>", ["verdict: improved"], rows(nothing.parameters, {}), nothing,
        load("virtual.toml").config, before, after,
    )  # fmt: skip
    assert "virtual &lt;1&gt;" in text
    assert text.count("<table>") == 2
    assert text.count("<tr class=off>") == 1
    assert "ended by tracking_error" in pages.verdict(before)
    assert "never" in pages.verdict(after)
    chosen = Chosen(load("virtual.toml").config, None, (Judged(NOMINAL, after.figures),), ())
    assert pages.gains(chosen) == "gains: kept; 1 of 2 figures do not hold, on 1 rigs within the intervals"


@pytest.mark.slow
def test_gains_for_the_packaged_axis_hold(virtual: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    """The search made short: two bandwidths, and the spread of one parameter."""
    monkeypatch.setattr(fastest, "SLOWEST_RAD_S", 80.0)
    monkeypatch.setattr(fastest, "CUTS", 0)
    monkeypatch.setattr(gains, "SPREADS", SPREADS[:1])
    c = virtual
    exact = {
        key.MASS: told(15.0, 0.02), key.HALF: told(0.1, 0.05), key.BANDWIDTH: told(100.0),
        key.COULOMB: told(40.0), key.STATIC: told(55.0), key.AREA: told(2.8274e-5, 0.02),
        key.STIFFNESS: told(1e5, 0.2), key.VISCOUS: told(60.0),
    }  # fmt: skip
    c = changed(c, believed(exact, 1e-6, c))
    chosen = choose(changed(c, rig(exact, 1e-6, NOISE_PA, c)), exact, 0.0)
    assert not [f for j in chosen.judged if j.case == NOMINAL for f in j.missed if f.part == "sine"]
    assert len(chosen.judged) == 5
