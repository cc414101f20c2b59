"""A plant that differs from what the controller believes, by one file; loads that nobody pushes with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from axis_rig import quick
from pneud import resources
from pneud.config.conversions import axis_of, plant_of
from pneud.config.flow import L_S_BAR, area_of, conductance_of
from pneud.config.learnt import start_of, values_learnt
from pneud.config.models import Config, CylinderConfig, GasConfig, ValveConfig
from pneud.config.plant import PlantCylinderConfig, PlantGasConfig, PlantValveConfig
from pneud.config.reading import load_config, parse
from pneud.config.sections import ConfigError
from pneud.loading import load
from pneud.physics.plant import Detail, PlantParameters
from pneud.physics.valve import opening
from pneud.replay.lockstep import Simulation
from pneud.rig.dynamics import advance, initial_state
from pneud.signals import State
from pneud.study.plausibility import findings

GOOD = (resources.configs() / "virtual.toml").read_text()
KNOWN = load_config("virtual.toml")
LSB_V = 0.001
CYLINDER, GAS, VALVE = "cylinder", "gas", "valve"
# the plant's parameters that hang on a key: those of its table, and those that are made of them
MOVED = {
    CYLINDER: {"cylinder", "initial_x1", "load_n"},
    GAS: {"gas", "cylinder", "polytropic_exponent"},
    VALVE: {"valve", "cylinder", "valve_timeout_s"},
}
KEYS = [
    *((CYLINDER, key) for key in PlantCylinderConfig.model_fields),
    *((GAS, key) for key in PlantGasConfig.model_fields),
    *((VALVE, key) for key in ("orifice_area_m2", "u_max_v", "timeout_ms", "centre_v")),
    *((VALVE, key) for key in ("dead_zone_positive_v", "dead_zone_negative_v")),
]


def told(**plant: dict[str, Any]) -> Config:
    data = KNOWN.model_dump(by_alias=True)
    for table, values in plant.items():
        data["plant"][table].update(values)
    return Config.model_validate(data)


def differing(p: PlantParameters, q: PlantParameters) -> set[str]:
    return {name for name in p._fields if getattr(p, name) != getattr(q, name)}


@given(st.sampled_from(KEYS), st.floats(0.75, 0.99))
def test_a_key_of_the_plant_changes_what_hangs_on_it_and_nothing_of_the_controller(
    where: tuple[str, str], factor: float
) -> None:
    table, key = where
    believed = getattr(getattr(KNOWN, table), key, None)
    value = factor * believed if believed else factor * {"timeout_ms": 50.0}.get(key, 0.1)
    c = told(**{table: {key: value}})
    changed = differing(plant_of(c), plant_of(KNOWN))
    assert changed
    assert changed <= MOVED[table]
    assert axis_of(c, LSB_V) == axis_of(KNOWN, LSB_V)


@pytest.mark.parametrize(
    ("believed", "true"),
    [(CylinderConfig, PlantCylinderConfig), (GasConfig, PlantGasConfig), (ValveConfig, PlantValveConfig)],
)
def test_every_key_of_the_controllers_rig_can_differ_within_the_same_bounds(believed: Any, true: Any) -> None:
    for key in believed.model_fields:
        schemas = (model.model_json_schema()["properties"][key] for model in (believed, true))
        one, other = ({**s, **s.get("anyOf", [{}])[0]} for s in schemas)
        bounds = ("exclusiveMinimum", "minimum", "exclusiveMaximum", "maximum", "type")
        assert [one.get(b) for b in bounds] == [other.get(b) for b in bounds], key


def test_the_same_keys_as_the_controllers_make_the_same_plant() -> None:
    same = {table: getattr(KNOWN, table).model_dump() for table in (CYLINDER, GAS, VALVE)}
    assert plant_of(told(**same)) == plant_of(KNOWN)


def test_the_other_keys_of_the_controller_that_the_plant_uses_can_differ() -> None:
    c = told(sensors={"encoder_kind": "incremental"})
    changed = differing(plant_of(c), plant_of(KNOWN))
    assert changed == {"encoder_zero_m", "encoder_referenced"}
    assert axis_of(c, LSB_V) == axis_of(KNOWN, LSB_V)


def rated(**valve: Any) -> Config:
    """The controller's valve by another rating."""
    data = KNOWN.model_dump(by_alias=True)
    data["valve"] = {**data["valve"], "orifice_area_m2": None, **valve}
    return Config.model_validate(data)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("nominal_flow_l_min", 1424.0), ("sonic_conductance_l_s_bar", 5.6), ("kv_m3_h", 1.21)),
        ("cv", 1.4),
    ],
)
@pytest.mark.parametrize("flow", ["orifice", "iso6358"])
def test_a_valve_by_any_rating_of_its_sheet_is_about_the_same(key: str, value: float, flow: str) -> None:
    area_m2 = area_of(KNOWN)
    c = rated(**{key: value, "flow": flow})
    assert area_of(c) == pytest.approx(area_m2, rel=0.01)
    assert conductance_of(c) / L_S_BAR == pytest.approx(5.6, rel=0.01)
    assert plant_of(c).cylinder.c1 == pytest.approx(plant_of(KNOWN).cylinder.c1, rel=0.01)
    assert plant_of(told(valve={key: value})).cylinder == plant_of(rated(**{key: value})).cylinder


def test_a_valve_has_one_rating() -> None:
    for ratings in ({}, {"cv": 1.0, "kv_m3_h": 1.0}):
        with pytest.raises(ValueError, match="give one of orifice_area_m2"):
            rated(**ratings)
    with pytest.raises(ValueError, match="at most"):
        told(valve={"cv": 1.0, "kv_m3_h": 1.0})


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("flow", "orifice"), ("critical_ratio", 0.4), ("exponent", 0.55)),
        *(("exhaust_ratio", 0.8), ("exhaust_critical_ratio", 0.2)),
    ],
)
def test_how_air_flows_in_the_plant_is_its_own_business(key: str, value: Any) -> None:
    believed = rated(sonic_conductance_l_s_bar=5.6, flow="iso6358")
    data = believed.model_dump(by_alias=True)
    data["plant"]["valve"][key] = value
    c = Config.model_validate(data)
    changed = differing(plant_of(c), plant_of(believed))
    assert changed
    assert changed <= {"gas", "cylinder"}
    assert plant_of(c).cylinder.c1 == plant_of(believed).cylinder.c1
    assert axis_of(c, LSB_V) == axis_of(believed, LSB_V)


DETAILS: dict[str, tuple[dict[str, dict[str, Any]], Any]] = {
    "play_v": ({"valve": {"hysteresis_v": 0.04}}, 0.02),
    "leak_in_v": ({"valve": {"leakage": 0.01, "leakage_exhaust": 0.0}}, 0.05),
    "leak_out_v": ({"valve": {"leakage_exhaust": 0.02}}, 0.1),
    "wall_s": ({"": {"wall_time_s": 0.3, "polytropic_exponent": None}}, 0.3),
    "receiver_pa_kg": ({"supply": {"receiver_m3": 1e-3}}, 286.987 * 293.0 / 1e-3),
    "slips": ({"friction": {"model": "gms"}}, True),
    "rise_1_pa": ({"friction": {"pressure_share_bar": 0.03}}, 3e-7),
    "forward_share": ({"friction": {"forward_share": -0.05}}, -0.05),
    "pressure_lag_s": ({"sensors": {"pressure_lag_s": 1e-3}}, 1e-3),
    "encoder_lag_s": ({"sensors": {"encoder_lag_s": 1e-4}}, 1e-4),
    "encoder_noise_m": ({"sensors": {"encoder_noise_m": 1e-6}}, 1e-6),
    "encoder_offset_m": ({"sensors": {"encoder_offset_m": 1e-3}}, 1e-3),
    "p1_offset_pa": ({"sensors": {"p1_offset_pa": 500.0}}, 500.0),
    "p2_offset_pa": ({"sensors": {"p2_offset_pa": -500.0}}, -500.0),
    "hose_s": ({"hoses": {"delay_s": 2e-3}}, 2e-3),
    "supply_offset_pa": ({"sensors": {"supply_offset_pa": 1000.0}}, 1000.0),
}


def with_plant(tables: dict[str, dict[str, Any]]) -> Config:
    data = KNOWN.model_dump(by_alias=True)
    for table, values in tables.items():
        (data["plant"][table] if table else data["plant"]).update(values)
    return Config.model_validate(data)


@pytest.mark.parametrize("of", DETAILS)
def test_a_key_of_a_detail_changes_that_and_nothing_else(of: str) -> None:
    tables, value = DETAILS[of]
    c = with_plant(tables)
    changed = differing(plant_of(c), plant_of(KNOWN))
    assert changed - {"polytropic_exponent"} == {"detail"}
    found, plain = plant_of(c).detail, plant_of(KNOWN).detail
    assert getattr(found, of) == pytest.approx(value)
    assert {f for f in found._fields if getattr(found, f) != getattr(plain, f)} - {"regulator_kg_s_pa"} == {
        "on",
        of,
    }
    assert axis_of(c, LSB_V) == axis_of(KNOWN, LSB_V)


def test_every_detail_has_a_key() -> None:
    contact = {
        "contact_m",
        "contact_n_m",
        "contact_n_s_m",
        "contact_side",
    }  # as the tests of pressing have it
    assert {*DETAILS, *contact, "on", "regulator_kg_s_pa"} == set(Detail._fields)
    c = with_plant({"supply": {"receiver_m3": 1e-3, "regulator_l_min_bar": 600.0}})
    assert plant_of(c).detail.regulator_kg_s_pa * 1e5 == pytest.approx(0.01 * 1.185)  # 10 l/s ANR


@pytest.mark.parametrize(
    ("tables", "key"),
    [
        ({"valve": {"hysteresis_v": 0.4}}, "plant.valve.hysteresis_v"),
        ({"valve": {"leakage_exhaust": 0.1}}, "plant.valve.leakage"),
        ({"supply": {"receiver_m3": 1e-3, "regulator_l_min_bar": 200.0}}, "plant.supply.regulator_l_min_bar"),
    ],
)
def test_a_detail_that_few_rigs_have_is_a_warning(tables: dict[str, Any], key: str) -> None:
    assert [(f.key, f.is_error) for f in findings(with_plant(tables), LSB_V, 40.0)] == [(key, False)]


def test_hoses_are_volumes_that_the_controller_does_not_know_of() -> None:
    c = with_plant({"hoses": {"volume_1_m3": 1e-5, "volume_2_m3": 2e-5}})
    p, q = plant_of(c), plant_of(KNOWN)
    assert differing(p, q) == {"cylinder", "initial_x1"}
    assert (p.cylinder.x_e1 - q.cylinder.x_e1) * q.cylinder.A1 == pytest.approx(1e-5)
    assert pytest.approx(1e-5 / q.cylinder.A1 + 2e-5 / q.cylinder.A2) == p.cylinder.L - q.cylinder.L
    assert axis_of(c, LSB_V) == axis_of(KNOWN, LSB_V)


def test_pressures_may_be_told_in_bits() -> None:
    c = with_plant({"sensors": {"pressure_resolution_pa": 0.0, "pressure_bits": 12}})
    assert plant_of(c).pressure_resolution_pa == pytest.approx(244.1, abs=0.1)


@pytest.mark.parametrize(
    ("tables", "says"),
    [
        ({"sensors": {"pressure_resolution_pa": 20.0, "pressure_bits": 12}}, "pressure_bits"),
        ({"": {"wall_time_s": 0.3, "polytropic_exponent": 1.3}}, "wall_time_s"),
        ({"valve": {"map": ((-5.0, -1.0), (5.0, 1.0)), "centre_v": 0.1}}, "edges and centre of its own"),
        ({"valve": {"map": ((-4.0, -1.0), (4.0, 1.0)), "dead_zone_v": 0.0}}, "end to end of u_max_v"),
    ],
)
def test_what_says_the_same_twice_is_refused(tables: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        with_plant(tables)


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.floats(-0.5, 0.5))
def test_edges_of_the_dead_zone_are_where_the_file_has_them(plus: float, minus: float, centre: float) -> None:
    valve = {"dead_zone_positive_v": plus, "dead_zone_negative_v": minus, "centre_v": centre}
    v = plant_of(told(valve=valve)).valve
    for inside, sign in ((centre + plus - 1e-6, 1.0), (centre - minus + 1e-6, -1.0)):
        assert opening(inside, v) * sign <= 1e-12
        assert opening(inside + 2e-6 * sign, v) * sign > 0.0


def test_the_load_stands_where_it_starts_whatever_the_dead_length() -> None:
    c = told(cylinder={"dead_length_1_m": 0.03})
    p, q = plant_of(c), plant_of(KNOWN)
    assert p.initial_x1 - p.cylinder.x_e1 == pytest.approx(q.initial_x1 - q.cylinder.x_e1)


@pytest.mark.parametrize(
    "plant", [{"gas": {"supply_pa": 90_000.0}}, {"cylinder": {"stroke_m": 0.3}}], ids=["supply", "stroke"]
)
def test_a_plant_that_cannot_be_is_refused(plant: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="plant"):
        told(**plant)
    with pytest.raises(ConfigError, match="virtual"):
        parse(GOOD + "\n[plant.gas]\nsupply_pa = 90000.0\n", "virtual.toml")


@pytest.mark.parametrize(
    ("plant", "key"),
    [
        ({"cylinder": {"moving_mass_kg": 150.0}}, "plant.cylinder.moving_mass_kg"),
        ({"valve": {"orifice_area_m2": 2.8e-6}}, "plant.valve.orifice_area_m2"),
        ({"valve": {"cv": 0.1}}, "plant.valve.cv"),
        ({"valve": {"dead_zone_positive_v": 2.0, "dead_zone_negative_v": 1.0}}, "plant.valve.dead_zone_v"),
        ({"cylinder": {"load_n": 450.0}}, "plant.cylinder.load_n"),
    ],
)
def test_a_plant_that_few_rigs_have_is_a_warning_at_its_key(plant: dict[str, Any], key: str) -> None:
    assert findings(KNOWN, LSB_V, 40.0) == []
    assert [(f.key, f.is_error) for f in findings(told(**plant), LSB_V, 40.0)] == [(key, False)]


def test_the_end_of_the_travel_is_a_place_within_it() -> None:
    """0.001 + (0.052 − 0.001) is beyond 0.052 by rounding, and arming is refused nowhere."""
    data = KNOWN.model_dump(by_alias=True)
    data["cylinder"]["stroke_m"], data["plant"]["initial_x1_m"] = 0.053, 0.04
    data["reference"] |= {"effective_centre_m": 0.0397, "amplitude_m": 0.002}
    data["limits"] |= {"travel_min_m": 0.001, "travel_max_m": 0.052}
    assert findings(Config.model_validate(data), LSB_V, 40.0) == []


def upright(**cylinder: float) -> Config:
    data = KNOWN.model_dump(by_alias=True)
    data["cylinder"].update(cylinder)
    return Config.model_validate(data)


def test_what_no_piston_can_lift_is_an_error() -> None:
    found = findings(upright(inclination_deg=90.0, moving_mass_kg=80.0), LSB_V, 40.0)
    assert ("cylinder.inclination_deg", True) in [(f.key, f.is_error) for f in found]


@pytest.mark.parametrize("degrees", [-90.0, -30.0, 30.0, 90.0])
def test_a_plant_on_a_slope_rests_where_it_starts_and_its_weight_is_borne(degrees: float) -> None:
    c = upright(inclination_deg=degrees, load_n=10.0)
    p = plant_of(c)
    state = initial_state(p)
    k = p.cylinder
    borne_n = state.p1 * k.A1 - state.p2 * k.A2 - k.rod_force_n
    sine = {90.0: 1.0, 30.0: 0.5, -30.0: -0.5, -90.0: -1.0}[degrees]
    assert borne_n == pytest.approx(10.0 + 15.0 * 9.80665 * sine)
    later = advance(state, 0.0, 0.0, 0.0, 0.2, p)
    assert later.x1 == pytest.approx(state.x1, abs=1e-9)


def test_a_configured_load_is_where_adaptation_starts() -> None:
    c = upright(inclination_deg=90.0, load_n=5.0)
    load_n = 5.0 + 15.0 * 9.80665
    assert start_of(c).load_n == pytest.approx(load_n)
    told_of_it = values_learnt(start_of(c), c)["load_n"]
    assert told_of_it["value"] == told_of_it["configured"] == pytest.approx(load_n, rel=1e-5)
    assert start_of(KNOWN).load_n == 0.0


def written(tmp_path: Path, plant: str, *changes: tuple[str, str]) -> Path:
    text = GOOD
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    file = tmp_path / "virtual.toml"
    file.write_text(text + plant)
    return file


STANDS = ("moving_mass_kg = 15.0", "moving_mass_kg = 15.0\ninclination_deg = 90.0")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plant", "changes"),
    [
        ("", (STANDS,)),
        ("\n[plant.cylinder]\ninclination_deg = 90.0\n", ()),
        ("\n[plant.cylinder]\nmoving_mass_kg = 18.0\nload_n = -30.0\n", (STANDS,)),
        ("\n[plant.gas]\nsupply_pa = 550_000.0\n[plant.cylinder]\ndead_length_1_m = 0.02\n", ()),
    ],
    ids=["upright", "nobody told", "other load", "supply and dead length"],
)
def test_an_axis_arms_and_holds(tmp_path: Path, plant: str, changes: tuple[tuple[str, str], ...]) -> None:
    file = written(tmp_path, plant, *changes, ("amplitude_m = 0.05", "amplitude_m = 0.0"))
    run = Simulation(load(file), 3.0, how=quick())
    tracked = [r for r in run.records() if r.tick.state == State.TRACKING]
    errors_m = [abs(r.tick.reference.position_m - r.truth_m) for r in tracked[2000:]]
    assert len(errors_m) > 500
    assert max(errors_m) < 2e-4
