"""What logs tell of a rig: the parts on made-up data, whole rigs of known truth, and the verb."""

from __future__ import annotations

import json
import math
import random
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from commands import pneud_here
from pneud import resources
from pneud.config.conversions import plant_of
from pneud.config.flow import area_of, gas_of
from pneud.config.models import Config
from pneud.config.sections import ConfigError
from pneud.loading import Loaded, load
from pneud.log.files.naming import LogError, new_log
from pneud.log.files.reader import read_log
from pneud.log.files.writer import LogWriter
from pneud.log.format.header import LogHeader
from pneud.physics.friction import Friction, stribeck
from pneud.physics.gas import flow_factor, gas, subsonic_share
from pneud.physics.valve import Valve, opening
from pneud.replay.lockstep import Simulation, backend_of
from pneud.replay.moves import Course, moves_of
from pneud.rig.dynamics import advance, initial_state
from pneud.safety.faults import FAULT_NAMES
from pneud.study.commissioning.truths import Truth, drawn, rig_text
from pneud.study.identification import (
    chambers,
    comparing,
    estimating,
    explaining,
    forces,
    heat,
    motions,
    table,
    words,
)
from pneud.study.identification import parameters as key
from pneud.study.identification.explaining import Bin
from pneud.study.identification.fitting import Fit, Found, Unknown, fit
from pneud.study.identification.parameters import Estimate
from pneud.study.identification.table import Piece, Table
from shared import once

GOLDEN = Path(__file__).parent / "golden"
C = load("virtual.toml").config
PLANT = plant_of(C)
AIR = gas(1.4, 286.987, 293.0, 101_000.0, 600_000.0)
FRICTION = forces.Slide(
    *(np.array([x]) for x in (15.0, 3.0, 40.0, 0.4, 0.02, 60.0, 1e5, 300.0, 0.0)),
)


def guess(**other: float) -> chambers.Guess:
    """The plant of virtual.toml as a guess."""
    k, v = PLANT.cylinder, PLANT.valve
    true = {
        "flow": key.flow_of_area(area_of(C), AIR),
        "plus_v": v.centre_v + v.dead_zone_v,
        "minus_v": v.centre_v - v.dead_zone_v,
        "bandwidth_hz": v.omega_rad_s / (2.0 * math.pi),
        "delay_s": 6e-4,
        "dead1_m": k.x_e1,
        "dead2_m": k.L - k.stroke_m - k.x_e1,
        "exponent": PLANT.polytropic_exponent,
        "seep": 0.0,
        "seep_out": 0.0,
        "play_v": 0.0,
        "exhaust": 1.0,
        "critical": 0.3,
        "critical_out": 0.3,
        "wall_1_s": 0.0,
    }
    return chambers.Guess(**{name: np.asarray(x) for name, x in {**true, **other}.items()})


def rig() -> chambers.Rig:
    k = PLANT.cylinder
    return chambers.Rig(k.A1, k.A2, k.stroke_m, PLANT.valve.u_max_v, PLANT.valve.zeta, AIR, 1e-3)


# the parts


@given(st.floats(0.0, 1.0), st.floats(0.1, 0.6))
def test_a_share_of_the_choked_flow_is_that_of_the_physics(r: float, b: float) -> None:
    plain, iso = chambers.orifice(AIR), chambers.iso6358(np.asarray(b))
    assert plain(np.array([r]))[0][0] == pytest.approx(flow_factor(r, AIR) / AIR.gamma_choked, abs=2e-3)
    if r < 0.998:
        assert iso(np.array([r]))[0][0] == pytest.approx(subsonic_share(r, b), abs=1e-9)
    for share in (plain, iso):
        value, slope = share(np.array([r]))
        assert 0.0 <= value[0] <= 1.0 + 1e-12
        assert slope[0] <= 1e-12


@given(st.floats(-6.0, 6.0), st.floats(0.0, 0.5), st.floats(0.0, 0.5))
def test_an_opening_is_that_of_the_valve(y: float, plus: float, minus: float) -> None:
    found = chambers.openings(np.array([y]), guess(plus_v=plus, minus_v=-minus), 5.0)
    valve = Valve(5.0, 0.0, 0.7, 0.5 * (plus + minus), 0.5 * (plus - minus))
    assert found[0] == pytest.approx(opening(y, valve) / 5.0, abs=1e-12)


def test_chambers_are_those_of_the_plant() -> None:
    chance = random.Random(1)
    state = initial_state(PLANT)._replace(v=0.05)
    ticks, warm, last = 150, 30, 0.0
    rows: list[tuple[float, ...]] = []
    for k in range(ticks + 1):
        rows.append((state.x1 - PLANT.cylinder.x_e1, state.p1, state.p2, last))
        before, last = last, last if k % 10 else chance.uniform(-1.5, 1.5)
        state = advance(state, before, 0.0, 0.0, 6e-4, PLANT)
        state = advance(state, last, 0.0, 6e-4, 1e-3, PLANT)
    x, p1, p2, u = (np.array(column)[None, :] for column in zip(*rows, strict=True))
    supply = np.full_like(x, AIR.supply_pa)
    after = slice(warm + 1, None)
    behind = np.zeros((1, len(chambers.PLAYS_V)))
    warmth = np.zeros((1, len(heat.RATES_1_S), 2, ticks - warm))
    w = chambers.Windows(
        x, p1[:, after], p2[:, after], p1[:, warm], p2[:, warm], supply, u, behind, warmth, warm
    )
    found = chambers.simulate(w, guess(), rig(), False)[0]
    moved = np.ptp(p1)
    assert moved > 2e4
    assert np.abs(found[0] - w.p1_pa).max() < 0.003 * moved
    assert np.abs(found[1] - w.p2_pa).max() < 0.003 * moved
    leaking = chambers.simulate(w, guess(seep=0.01), rig(), False)[0]
    assert np.abs(leaking - found).max() > 100.0
    apart = chambers.simulate(w, guess(critical_out=0.1), rig(), True)[0]
    assert np.abs(apart - chambers.simulate(w, guess(), rig(), True)[0]).max() > 100.0
    assert (
        np.abs(chambers.spool(w, guess(play_v=0.05), rig()) - chambers.spool(w, guess(), rig())).max() > 0.01
    )
    assert chambers.some(w, 5).x_m.shape == w.x_m.shape


def windows_of(v: Any, h: float = 1e-3) -> forces.Forces:
    """A motion as windows, at a speed, without any forces yet."""
    v = np.atleast_2d(v)
    margin = 20
    count = slice(margin, v.shape[1] - margin)
    none = np.zeros(len(v))
    a = np.gradient(v, h, axis=1)[:, count]
    return forces.Forces(v, a, np.zeros_like(a), np.full_like(a, 3e5), none, none, margin, 3.0, h)


@given(st.floats(0.005, 1.0), st.sampled_from([-1.0, 1.0]), st.booleans())
@settings(max_examples=25)
def test_steady_friction_is_stribecks(speed: float, sign: float, slips: bool) -> None:
    w = windows_of(np.full(3000, sign * speed))
    dry = stribeck(speed, Friction(40.0, 56.0, 0.02, 60.0, 1e5, 300.0))
    assert forces.friction(w, FRICTION, slips)[0, 0, -1] == pytest.approx(
        sign * (dry + 60.0 * speed), rel=1e-3
    )


@pytest.mark.parametrize("slips", [False, True])
def test_friction_may_differ_by_direction(slips: bool) -> None:
    by_way = FRICTION._replace(forward=np.array([0.25]))
    out, back = (
        abs(forces.friction(windows_of(np.full(3000, v)), by_way, slips)[0, 0, -1]) for v in (0.5, -0.5)
    )
    assert out / back == pytest.approx(1.25 / 0.75, rel=1e-3)


def test_forces_at_once_are_those_of_a_sliding_load() -> None:
    v = 0.3 * np.sin(2.0 * np.pi * np.arange(4000) * 1e-3)
    w = windows_of(v)
    w = w._replace(force_n=forces.predicted(w, FRICTION, False)[0])
    found = forces.at_once(w, 0.1)
    assert found == pytest.approx((15.0, 3.0, 40.0, 60.0), rel=0.03)
    assert forces.at_once(w, 1.0) is None


def test_a_loop_of_50_hz_is_told_by_readings_that_are_hardly_smoothed() -> None:
    x = 0.5 + 0.1 * np.sin(2.0 * np.pi * 0.5 * np.arange(500) * 0.02)
    full = np.full_like(x, 3e5)
    w = forces.windows(
        Table(0.02, 0.0, (Piece(x, full, full, full, full),)), forces.Balance(1e-3, 1e-3, 0.0, 1.0)
    )
    assert len(w.v_m_s) > 3
    assert np.isfinite(forces.predicted(w, FRICTION, False)).all()


def test_a_breakaway_is_the_peak_before_motion() -> None:
    v = np.concatenate([np.zeros(500), np.linspace(0.0, 0.1, 100), np.full(400, 0.1)])
    force = np.concatenate([np.linspace(0.0, 50.0, 500), np.linspace(50.0, 40.0, 100), np.full(400, 40.0)])
    none = np.zeros_like(v)
    piece = Piece(0.3 + np.cumsum(v) * 1e-3, 1e3 * force, none, none, none)
    rig = forces.Balance(1e-3, 1e-3, 0.0, 1.0)
    assert forces.breakaways(piece, rig, 1e-3) == pytest.approx([50.0], rel=0.03)
    assert len(forces.breakaways(piece._replace(position_m=none), rig, 1e-3)) == 0


def line(seed: int) -> tuple[Fit, float]:
    """A fit of a slope in noise that hangs together, and the slope."""
    chance = np.random.default_rng(seed)
    t = np.linspace(-1.0, 1.0, 200)
    noise = np.zeros((20, 200))
    for k in range(1, 200):
        noise[:, k] = 0.95 * noise[:, k - 1] + chance.normal(size=20)
    ys = 2.0 * t + noise
    found = fit(
        lambda guesses: guesses[:, :1, None] * t - ys + 0.0 * guesses[:, 1:, None],
        [Unknown("slope", 0.0, 1.0, 10.0, -100.0, 100.0), Unknown("idle", 1.0, 1.0, 2.0, 0.0, 9.0)],
    )
    return found, 2.0


def test_intervals_count_on_residuals_that_hang_together() -> None:
    inside = 0
    for seed in range(60):
        found, true = line(seed)
        slope = found.found(slope=1.0)
        inside += slope.low <= true <= slope.high
    assert inside >= 51


def test_what_no_log_tells_stays_what_was_known() -> None:
    found, _ = line(1)
    idle = found.found(idle=1.0)
    assert not idle.told
    assert idle.value == pytest.approx(1.0, abs=1e-3)
    assert found.told == (True, False)
    assert found.linked() == []


def test_a_bound_holds() -> None:
    t = np.linspace(0.0, 1.0, 50)
    found = fit(
        lambda g: np.broadcast_to(g[:, :1, None] * t + t, (len(g), 5, 50)),
        [Unknown("x", 1.0, 1.0, 1.0, 0.0, 2.0)],
    )
    assert found.x[0] == 0.0


# beside what is known


def test_that_there_is_nothing_of_a_kind_is_told_as_any_value_is() -> None:
    nothing = Found(0.0, -14.0, 14.0, True)
    assert key.estimate(key.DAMPING, nothing, {}) == Estimate(0.0, 0.0, 14.0, None, True)
    assert not key.estimate(key.DAMPING, nothing, {}, more=1.0).told
    assert not key.estimate(key.DAMPING, nothing._replace(told=False), {}).told


def test_a_mass_that_might_be_none_is_not_told() -> None:
    wide = Found(0.7, -0.4, 1.8, True)
    assert not key.estimate(key.MASS, wide, {}).told
    assert key.estimate(key.MASS, wide._replace(low=0.2, high=1.2), {}).told


def estimate(value: float, half: float, configured: float | None = None, told: bool = True) -> Estimate:
    return Estimate(value, value - half, value + half, configured, told)


@pytest.mark.parametrize(
    ("e", "verdict"),
    [
        (estimate(40.0, 1.0, 40.5), "agrees"),
        (estimate(40.0, 1.0, 36.0), "near"),
        (estimate(60.0, 1.0, 36.0), "off"),
        (estimate(60.0, 1.0, 36.0, told=False), "not told"),
        (estimate(60.0, 1.0), "not told"),
    ],
)
def test_a_verdict_is_by_interval_and_tolerance(e: Estimate, verdict: str) -> None:
    (row,) = comparing.rows({key.COULOMB: e}, {})
    assert row.verdict == verdict
    word = {"off": "differs", "not told": "unknown"}.get(verdict, "agrees")
    assert words.verdict([row], []) == word
    assert words.verdict([row], ["pressures"]) == "unexplained"


def test_wear_is_what_has_changed_for_sure() -> None:
    now = {key.COULOMB: estimate(60.0, 2.0, 60.0)}
    for before, worn in (
        (estimate(40.0, 2.0), True),
        (estimate(50.0, 9.0), False),
        (estimate(55.0, 1.0), False),
    ):
        (row,) = comparing.rows(now, {key.COULOMB: before})
        assert row.worn is worn
        assert (words.verdict([row], []) == "worn") is worn
    assert "worn" in words.table(comparing.rows(now, {key.COULOMB: estimate(40.0, 2.0)}))[1]


def test_a_flow_is_bent_where_no_edge_that_lies_elsewhere_explains_it() -> None:
    just_open, wide = Bin(-0.38, -0.0315, -0.0332, 1e-4), Bin(2.0, 0.33, 0.36, 1e-3)
    assert explaining.bent([just_open], 0.002) == []
    assert explaining.bent([just_open, wide], 0.002) == [
        "flow map: at +2.00 V the flow is 8 % less than a straight line has it"
    ]


def test_an_earlier_estimate_comes_back(tmp_path: Path) -> None:
    e = estimate(40.0, 1.0, 36.0)
    path = tmp_path / "before.json"
    path.write_text(json.dumps({"schema": 1, "parameters": {key.COULOMB: comparing.as_json(e), "x": {}}}))
    assert comparing.earlier(path) == ("", {key.COULOMB: e})
    for text in (
        "",
        "[]",
        '{"schema": 2}',
        json.dumps({"schema": 1, "parameters": {key.COULOMB: {"value": "x"}}}),
    ):
        path.write_text(text)
        with pytest.raises(ConfigError, match="not what pneud identify"):
            comparing.earlier(path)


def test_what_was_found_of_another_axis_is_not_compared_with(tmp_path: Path) -> None:
    path = tmp_path / "before.json"
    path.write_text(json.dumps({"schema": 1, "axis": "press", "parameters": {}}))
    assert comparing.earlier(path).axis == "press"
    for same in ("", "press"):
        comparing.check_axis(path, same, "press")
    with pytest.raises(ConfigError, match=r"before.json: is of axis press, the logs are of gate"):
        comparing.check_axis(path, "press", "gate")


def test_every_parameter_has_what_is_said_of_it() -> None:
    assert set(key.FLOORS) == set(key.LACKING) == set(comparing.TOLERANCES)
    assert set(key.configured(C)) <= set(key.FLOORS)
    assert {tells for motion in motions.MOTIONS for tells in motion.tells} <= set(key.FLOORS)
    assert gas_of(C).supply_pa == C.gas.supply_pa


def test_the_encoders_step_is_seen() -> None:
    x = np.round(np.cumsum(np.full(500, 2e-6)) / 1e-5) * 1e-5
    t = Table(1e-3, 0.0, (Piece(x, x, x, x, x),))
    assert forces.encoder_step_m(t) == pytest.approx(1e-5)
    assert forces.encoder_step_m(Table(1e-3, 0.0, (Piece(x * 0, x, x, x, x),))) == 0.0


# the verb


def test_logs_that_are_too_short_are_refused_in_a_line() -> None:
    done = pneud_here("identify", GOLDEN / "composite.mcap")
    assert done.returncode == 2
    assert done.stdout == ""
    assert re.fullmatch(r"pneud: composite.mcap: 1.0 s with complete sets .*\n", done.stderr)


def test_logs_of_several_rates_are_refused() -> None:
    done = pneud_here("identify", GOLDEN / "composite.mcap", GOLDEN / "paper-case1.mcap")
    assert (done.returncode, done.stdout) == (2, "")
    assert "has 100 Hz, composite.mcap 1000 Hz" in done.stderr


def test_a_log_that_is_there_twice_is_refused(tmp_path: Path) -> None:
    copy = tmp_path / "copy.mcap"
    copy.write_bytes((GOLDEN / "composite.mcap").read_bytes())
    done = pneud_here("identify", GOLDEN / "composite.mcap", copy)
    assert (done.returncode, done.stdout) == (2, "")
    assert re.fullmatch(r"pneud: .*copy.mcap: the same is in .*composite.mcap; .*\n", done.stderr)


def of_rig(folder: Path, name: str, **changes: str) -> Path:
    """A log without a tick, whose configuration has some numbers of its own."""
    text = resources.find("virtual.toml").read_text(encoding="utf-8")
    for key_, value in changes.items():
        text = re.sub(rf"(?m)^{key_} = .*", f"{key_} = {value}", text, count=1)
    config = folder / f"{name}.toml"
    config.write_text(text, encoding="utf-8")
    path = folder / f"{name}.mcap"
    with new_log(path) as descriptor:
        LogWriter(descriptor, header(load(config))).close()
    return path


def test_logs_of_several_cylinders_are_refused(tmp_path: Path) -> None:
    logs = [of_rig(tmp_path, "first"), of_rig(tmp_path, "second", piston_area_1_m2="1.0e-3")]
    with pytest.raises(ConfigError, match=r"second\.mcap: has cylinder\.piston_area_1_m2 = 0\.001, first"):
        table.read([read_log(log) for log in logs])
    with pytest.raises(LogError, match="at least 2 s"):  # that holds for both
        table.read([read_log(log) for log in logs], C)


def test_a_configuration_of_another_cylinder_is_refused(tmp_path: Path) -> None:
    cylinder = C.cylinder.model_copy(update={"stroke_m": 0.1})
    with pytest.raises(ConfigError, match=r"--config: is of another cylinder .*stroke_m is 0\.1, and 1 in"):
        table.read([read_log(of_rig(tmp_path, "run"))], C.model_copy(update={"cylinder": cylinder}))


def test_logs_that_were_configured_otherwise_are_named(tmp_path: Path) -> None:
    logs = [read_log(of_rig(tmp_path, "first", moving_mass_kg="7.5")), read_log(of_rig(tmp_path, "second"))]
    assert table.differing(logs) == [(logs[0], (key.MASS,))]
    assert table.differing(logs[1:]) == []


def test_where_there_is_no_place_for_wear_is_said_before_anything_takes_time(tmp_path: Path) -> None:
    done = pneud_here("identify", GOLDEN / "composite.mcap", "--wear", tmp_path / "none" / "wear.jsonl")
    assert (done.returncode, done.stdout) == (2, "")
    assert "there is no folder" in done.stderr


def test_what_is_no_earlier_estimate_is_refused_before_anything_takes_time(tmp_path: Path) -> None:
    done = pneud_here("identify", GOLDEN / "composite.mcap", "--against", tmp_path / "none.json")
    assert done.returncode == 2
    assert "cannot be read" in done.stderr


def header(loaded: Loaded) -> LogHeader:
    """Of a run in simulated time."""
    return LogHeader(
        name=loaded.config.name, bus="simulated", rate_hz=loaded.config.loop.rate_hz, detail="compact",
        config_name=loaded.path.name, config_text=loaded.text, dbc_name=loaded.dbc.name,
        dbc=loaded.dbc.read_bytes(), fault_names=FAULT_NAMES, realtime_offset_ns=0, extra={},
    )  # fmt: skip


def logged(path: Path, config: str, plant: dict[str, Any], seconds: float, places: str) -> Config:
    """A run in simulated time, on a rig that differs from its configuration."""
    loaded = load(config, None, {"plant": plant})
    course = Course(moves_of(places))
    run = Simulation(loaded, seconds, 1, backend_of(loaded), operator=course.ask)
    with new_log(path) as descriptor:
        writer = LogWriter(descriptor, header(loaded))
        for record in run.records():
            course.see(record)
            writer.write(record)
        writer.close()
    return loaded.config


PLACES = "100@500,900@400,300@200,350@30,340@10,345@10,150@500,800@100"
TRUTH = {
    "cylinder": {"moving_mass_kg": 19.0, "load_n": 12.0, "dead_length_1_m": 0.02},
    "valve": {
        "orifice_area_m2": 2.3e-5, "bandwidth_hz": 80.0,
        "dead_zone_positive_v": 0.2, "dead_zone_negative_v": 0.05, "centre_v": 0.04,
    },
    "friction": {"coulomb_n": 55.0, "static_n": 75.0, "viscous_n_s_m": 80.0},
}  # fmt: skip


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a rig of another truth."""

    def made(folder: Path) -> Path:
        logged(folder / "run.mcap", "virtual.toml", TRUTH, 60.0, PLACES)
        return folder / "run.mcap"

    return once(tmp_path_factory, "identify-log", made)


@pytest.fixture(scope="module")
def identified(log: Path, tmp_path_factory: pytest.TempPathFactory) -> estimating.Identified:
    """What is found in it."""
    return once(tmp_path_factory, "identified", lambda _: estimating.identify(*table.read([read_log(log)])))


@pytest.fixture(scope="module")
def found(log: Path, identified: estimating.Identified) -> dict[str, Any]:
    """The same as the verb prints it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(estimating, "identify", lambda *_: identified)
        done = pneud_here("identify", log, "--json")
    assert done.returncode == 1, done.stderr
    whole: dict[str, Any] = json.loads(done.stdout)
    return whole


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "true", "within"),
    [
        (key.AREA, 2.3e-5, 0.05 * 2.3e-5), (key.PLUS, 0.24, 0.015), (key.MINUS, 0.01, 0.015),
        (key.CENTRE, 0.115, 0.015), (key.BANDWIDTH, 80.0, 16.0), (key.DEAD1, 0.02, 0.01),
        (key.DEAD2, 0.0158, 0.01), (key.MASS, 19.0, 0.95), (key.LOAD, 12.0, 3.0),
        (key.COULOMB, 55.0, 5.5), (key.STATIC, 75.0, 15.0), (key.VISCOUS, 80.0, 8.0), (key.SEEP, 0.0, 1e-3),
    ],
)  # fmt: skip
def test_a_truth_is_found(found: dict[str, Any], name: str, true: float, within: float) -> None:
    e = found["parameters"][name]
    assert e["value"] == pytest.approx(true, abs=within)
    assert e["low"] <= true <= e["high"]


@pytest.mark.slow
def test_a_model_that_explains_all_says_so(found: dict[str, Any]) -> None:
    assert found["unexplained"] == []
    assert found["verdict"] == "differs"
    off = {name for name, e in found["parameters"].items() if e["verdict"] == "off"}
    assert {key.PLUS, key.MASS, key.AREA, key.COULOMB} <= off
    assert (found["schema"], found["faults"]) == (1, [])


@pytest.mark.slow
def test_wear_is_told_beside_an_earlier_estimate(
    log: Path,
    identified: estimating.Identified,
    found: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(estimating, "identify", lambda *_: identified)
    before = json.loads(json.dumps(found))
    before["parameters"][key.COULOMB] |= {"value": 30.0, "low": 29.0, "high": 31.0}
    path = tmp_path / "before.json"
    path.write_text(json.dumps(before))
    done = pneud_here("identify", log, "--against", path, "-o", tmp_path / "page.html")
    assert done.returncode == 1
    assert "verdict: worn" in done.stdout
    assert re.search(rf"{key.COULOMB} .*30 worn", done.stdout)
    page = (tmp_path / "page.html").read_text()
    assert page.count("<svg") == 3  # friction, flow, edges
    assert "<script" not in page


COURSES = {
    "small": "30@50,70@50,49@10,50@20,60@200,50@200,60@200,95@100,30@300,85@200,10@300,20@40",
    "upright": "100@60,200@100,199@10,200@20,220@400,200@400,220@400,285@100,90@400,250@200,30@400",
}  # that a controller can follow which knows nothing of its rig


def scripted(bristles: tuple[float, ...], elements: tuple[float, ...], misfits: tuple[float, float]) -> Any:
    """A fit that comes to what is given: stiffness and damping by bristles, by elements, and what is left."""

    def fit_load(
        w: forces.Forces, unknowns: Sequence[Unknown], noise_n: float, fast_m_s: float, slips: bool
    ) -> estimating.Moved:
        found = dict(zip(("stiffness", "damping"), elements if slips else bristles, strict=True))
        x = np.array([found.get(u.key, u.prior) for u in unknowns])
        count = len(unknowns)
        done = Fit(
            tuple(u.key for u in unknowns), x, np.diag((0.01 * x) ** 2), (True,) * count, 2.0,
            np.zeros((1, 1)), np.zeros(count),
        )  # fmt: skip
        return estimating.Moved(done, w, slips, False, w.force_n, misfits[slips])

    return fit_load


@pytest.mark.parametrize(
    ("misfits", "slips", "alike"),
    [
        ((1.0, 0.5), True, False),
        ((0.5, 1.0), False, False),
        ((1.0, 0.95), True, True),
        ((0.95, 1.0), False, True),
    ],
)
def test_intervals_reach_to_what_the_other_kind_of_friction_has_where_it_explains_as_much(
    misfits: tuple[float, float], slips: bool, alike: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estimating, "_fit_load", scripted((1.2e5, 360.0), (2.4e5, 260.0), misfits))
    t = np.arange(12000) * 1e-3
    x = np.asarray(0.5 + 0.1 * np.sin(2.0 * np.pi * 0.5 * t), dtype=np.float64)
    pressed = np.full(len(t), 3e5)
    c = load("virtual.toml").config
    piece = Piece(x, pressed, pressed, pressed, np.zeros(len(t)))
    moved = estimating.of_load(Table(1e-3, 5e-4, (piece,)), c, 100.0)
    assert moved is not None
    stiffness, damping = moved.fit.found(stiffness=1.0), moved.fit.found(damping=1.0)
    assert (moved.slips, moved.other is not None) == (slips, alike)
    assert stiffness.value == (2.4e5 if slips else 1.2e5)
    for other, one in ((1.2e5 if slips else 2.4e5, stiffness), (360.0 if slips else 260.0, damping)):
        assert (one.low <= other <= one.high) is alike


EDGES_V = {Truth("small", 21): 0.37}  # without which a loop cannot be closed


@pytest.mark.slow
@pytest.mark.parametrize("truth", [Truth("small", 6), Truth("small", 21), Truth("upright", 9)])
def test_a_hidden_truth_is_found(truth: Truth, tmp_path: Path) -> None:
    config = tmp_path / "axis.toml"
    text = rig_text(truth.rig)
    if truth in EDGES_V:
        text = re.sub(r"(?m)^dead_zone_v = \S+", f"dead_zone_v = {EDGES_V[truth]}", text)
    config.write_text(text, encoding="utf-8")
    tables = drawn(load(config).config, truth.seed)
    c = logged(tmp_path / "run.mcap", str(config), tables["plant"], 30.0, COURSES[truth.rig])
    found = estimating.identify(*table.read([read_log(tmp_path / "run.mcap")]))
    plant, valve, stroke_m = plant_of(c), c.plant.valve, c.cylinder.stroke_m
    dead2_m = plant.cylinder.L - plant.cylinder.x_e1 - stroke_m
    size = valve.sonic_conductance_l_s_bar
    assert size is not None
    assert found.valved is not None
    assert found.moved is not None
    assert (found.valved.structure.heat, found.moved.slips) == (plant.detail.wall_s > 0.0, plant.detail.slips)
    centre_v, half_v = plant.valve.centre_v, plant.valve.dead_zone_v
    weight_n = key.weight_share(c) * plant.cylinder.M
    inside = 0
    bounds = {
        key.CONDUCTANCE: (size, 0.05 * size), key.CRITICAL: (plant.gas.critical_ratio, 0.05),
        key.PLUS: (centre_v + half_v, 0.015), key.MINUS: (half_v - centre_v, 0.015),
        key.CENTRE: (centre_v, 0.015),
        key.BANDWIDTH: (valve.bandwidth_hz, 0.2 * valve.bandwidth_hz),
        key.DEAD1: (plant.cylinder.x_e1, max(0.1 * plant.cylinder.x_e1, 0.01 * stroke_m)),
        key.DEAD2: (dead2_m, max(0.1 * dead2_m, 0.01 * stroke_m)),
        key.MASS: (plant.cylinder.M, 0.05 * plant.cylinder.M), key.LOAD: (plant.load_n - weight_n, 3.0),
        key.COULOMB: (plant.friction.coulomb_n, 0.1 * plant.friction.coulomb_n),
        key.STATIC: (plant.friction.static_n, 0.2 * plant.friction.static_n),
        key.SEEP: (valve.leakage, 0.001),
    }  # fmt: skip
    for name, (true, within) in bounds.items():
        e = found.parameters[name]
        assert e.value == pytest.approx(true, abs=within), name
        inside += e.low <= true <= e.high
    friction = plant.friction
    bristles = {key.STIFFNESS: friction.sigma0_n_m, key.DAMPING: friction.sigma1_n_s_m}
    told = {name: found.parameters[name] for name in bristles}
    held = sum(told[name].low <= true <= told[name].high for name, true in bristles.items())
    assert held == len(bristles) or truth not in EDGES_V  # whose encoder hides what kind of friction it is
    assert inside + held >= 0.85 * (len(bounds) + len(bristles))
