"""Hidden truths: what they differ in, and that every one of them is a rig."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from hil import truths
from hypothesis import given, settings
from hypothesis import strategies as st

from pneud.config.conversions import plant_of
from pneud.config.flow import L_S_BAR, conductance_of
from pneud.loading import Loaded, load
from pneud.study.commissioning.truths import RIGS, TWELVE, Truth, drawn, rig_text

CONFIGS = ("virtual.toml", "rig.toml", "paper-case1.toml", "vcan.toml")


def hidden(file: str | Path, seed: int) -> Loaded:
    return load(file, None, drawn(load(file).config, seed))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Path]:
    """The configurations of the twelve, by their rigs."""
    folder = tmp_path_factory.mktemp("rigs")
    for rig in ("virtual", *RIGS):
        (folder / f"{rig}.toml").write_text(rig_text(rig), encoding="utf-8")
    return {rig: folder / f"{rig}.toml" for rig in ("virtual", *RIGS)}


@given(st.sampled_from(CONFIGS), st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_a_truth_can_be_laid_over_any_configuration(file: str, seed: int) -> None:
    loaded = hidden(file, seed)
    plant = plant_of(loaded.config)
    assert plant.detail.on
    assert -0.1 <= plant.valve.centre_v - 0.5 * (edges(loaded)[0] - edges(loaded)[1]) <= 0.1
    assert max(edges(loaded)) <= 0.4
    assert 0.0 <= plant.initial_x1 - plant.cylinder.x_e1 <= plant.cylinder.stroke_m


def edges(loaded: Loaded) -> tuple[float, float]:
    v = loaded.config.plant.valve
    assert v.dead_zone_positive_v is not None
    assert v.dead_zone_negative_v is not None
    return v.dead_zone_positive_v, v.dead_zone_negative_v


def test_a_truth_is_the_same_for_the_same_seed_alone() -> None:
    c = load("virtual.toml").config
    assert drawn(c, 3) == drawn(c, 3) != drawn(c, 4)


def test_the_controller_knows_nothing_of_it() -> None:
    plain, other = load("virtual.toml").config, hidden("virtual.toml", 5).config
    assert other.model_copy(update={"plant": plain.plant}) == plain


@pytest.mark.parametrize("rig", ["virtual", *RIGS])
def test_each_of_the_twelve_differs_in_everything(files: Mapping[str, Path], rig: str) -> None:
    for seed in (t.seed for t in TWELVE if t.rig == rig):
        c = hidden(files[rig], seed).config
        true = plant_of(c)
        k, f, v = c.cylinder, c.control.friction, c.valve
        pairs: list[tuple[Any, Any]] = [
            (true.cylinder.M, k.moving_mass_kg),
            (true.cylinder.x_e1, k.dead_length_1_m),
            (true.cylinder.L - true.cylinder.x_e1 - k.stroke_m, k.dead_length_2_m),
            (true.friction.coulomb_n, f.coulomb_n),
            (true.friction.viscous_n_s_m, f.viscous_n_s_m),
            (true.valve.omega_rad_s / (2.0 * math.pi), v.bandwidth_hz),
        ]
        for one, other in pairs:
            assert abs(one / other - 1.0) > 0.05
        believed = conductance_of(c) / L_S_BAR
        assert abs((c.plant.valve.sonic_conductance_l_s_bar or 0.0) / believed - 1.0) > 0.02


def test_the_twelve_have_all_that_a_rig_may_have(files: Mapping[str, Path]) -> None:
    plants = [plant_of(hidden(files[t.rig], t.seed).config) for t in TWELVE]
    assert len(TWELVE) == len(set(TWELVE)) == 12
    assert len({p.cylinder.A1 for p in plants}) >= 3
    assert any(p.load_n > 5.0 * p.cylinder.M for p in plants)  # upright
    for at_least, count in (
        (4, sum(p.detail.slips for p in plants)),
        (4, sum(not p.detail.slips for p in plants)),
        (6, sum(p.gas.exponent > 0.0 for p in plants)),
        (4, sum(p.detail.wall_s > 0.0 for p in plants)),
        (12, sum(p.detail.leak_in_v > 0.0 and p.detail.play_v > 0.0 for p in plants)),
    ):
        assert count >= at_least
    assert {p.encoder_resolution_m for p in plants} == {5e-6, 10e-6}
    assert {round(p.pressure_resolution_pa, 1) for p in plants} == {244.1}


@pytest.mark.slow
def test_a_truth_that_is_commissioned_is_found() -> None:
    one = truths.case(Truth("virtual", 2))
    assert one.offs
    assert [off for off in one.offs if not off.holds] == []
    inside, told = truths.coverage([one])[""]
    assert inside >= truths.COVERED * told > 0
    assert one.axis_s < truths.AXIS_S
    assert truths.in_words(one)[0].startswith("virtual 2: ")
    assert truths.as_json(one)["flow_off"] == pytest.approx(0.0, abs=truths.WITHIN_FLOW)


@pytest.mark.parametrize("text", ["virtual", "virtual:", "virtual:x", "other:1", ""])
def test_what_names_no_truth_is_refused(text: str) -> None:
    with pytest.raises(ValueError):
        truths.truth_named(text)
