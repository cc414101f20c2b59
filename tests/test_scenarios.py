"""Scenarios: the files that come with pneud, the engine that plays them, damage to the plant, the verdict."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import ValidationError

from commands import pneud_here as pneud
from plant_reference import REALISTIC
from pneud import resources
from pneud.bus.codec import Codecs, load_codecs
from pneud.bus.wire import CAN_ERR_FLAG
from pneud.config.bus_tables import BusConfig
from pneud.config.reading import parse
from pneud.config.sections import ConfigError
from pneud.config.toml import toml_text
from pneud.loading import load
from pneud.replay.lockstep import Simulation, backend_of
from pneud.rig.damage import UNDAMAGED, advance_damaged
from pneud.rig.dynamics import PlantState, advance, initial_state
from pneud.safety.fault_row import Reaction
from pneud.safety.faults import FAULT_NAMES, TABLE
from pneud.scenario import verdict
from pneud.scenario.engine import Engine
from pneud.scenario.files import load_scenario
from pneud.scenario.format import BUS, MACHINE, NODES, PLANT, STATION, Scenario
from pneud.signals import Frame, State, ValveState

FILES = sorted(path.stem for path in resources.scenarios().glob("*.toml"))
CODECS: Codecs = load_codecs(BusConfig(), resources.find("pneud.dbc"))
MS = 1_000_000
QUIET = REALISTIC._replace(pressure_noise_pa=0.0)

# Rows that nothing outside of the control process provokes. Each has unit tests.
FROM_WITHIN = {
    "not_finite": "the bus carries integers only, and no law that is in force divides by what may be zero",
    "command_range": "the output chain would have to be wrong",
    "internal": "the program would have to be wrong",
    "config_changed": "a scenario does not write into the files of its user",
    "operator_lost": "takes an operator who jogs and goes away: the tests of the console have one",
    "homing_failed": "takes an operator who homes: the tests of the axis have one",
    "unproven": "takes a bus on which air can be: a test of commissioning has it",
    "skew": "takes two axes that carry one load: their tests have them",
    "sync_lost": "takes another daemon, whose SYNC ends: a test has two on one bus",
    "led_beyond": "takes an axis that follows another: their tests have them",
    **dict.fromkeys(
        ("force_window", "force_speed", "force_timeout", "force_direction"),
        "takes a load that is to press: the tests of pressing have them",
    ),
    "program": "takes a program that does not fit the axis: the tests of programs have it",
    "program_late": "takes a program that waits for what does not come: the tests of programs have it",
    "disk_full": "takes a file system of its own: the campaign has a case for it",
}


def scenarios() -> list[Scenario]:
    return [load_scenario(name) for name in FILES]


def test_every_scenario_loads_and_names_faults_of_the_table() -> None:
    for name, scenario in zip(FILES, scenarios(), strict=True):
        assert scenario.name == name
        assert scenario.description.endswith(".")
        verdict.check_names(scenario)
        load(scenario.config, None, scenario.change)


def test_every_row_of_the_fault_table_has_a_scenario_that_provokes_it() -> None:
    provoked = {name for scenario in scenarios() for name in scenario.expect.faults}
    without = set(FAULT_NAMES) - provoked - FROM_WITHIN.keys()
    assert not without, f"write a scenario for {', '.join(sorted(without))} in hil/scenarios"
    assert not provoked & FROM_WITHIN.keys(), "these have a scenario after all: take them out of FROM_WITHIN"
    assert FROM_WITHIN.keys() <= set(FAULT_NAMES)


def test_a_scenario_expects_the_reaction_of_the_table() -> None:
    strength = {
        "none": 0, "warn": 1, "no_arm": 2, "stop": 3, "centre": 4,
        Reaction.LIMIT: 1, Reaction.WARN: 1, Reaction.NO_ARM: 2, Reaction.STOP: 3, Reaction.CENTRE: 4,
    }  # fmt: skip
    reactions = {fault.name: fault.reaction for fault in TABLE}
    for scenario in scenarios():
        expect = scenario.expect
        if expect.faults:
            strongest = max(strength[reactions[name]] for name in expect.faults)
            assert strength[expect.reaction] == strongest, scenario.name


def test_every_kind_of_fault_is_in_a_scenario() -> None:
    kinds = {
        kind
        for cls in get_args(BUS | NODES | STATION | PLANT | MACHINE)
        for kind in get_args(cls.model_fields["kind"].annotation)
    }
    assert kinds == {fault.kind for scenario in scenarios() for fault in scenario.fault}


# --- the file ---------------------------------------------------------------------------------------------

GOOD: dict[str, Any] = {
    "schema": 1,
    "name": "x",
    "description": "A test.",
    "fault": [{"kind": "drop", "frames": ["encoder"], "since": "start"}],
    "expect": {"reaction": "none"},
}


def scenario(fault: dict[str, Any], **expect: Any) -> Scenario:
    faults = [{"since": "start", "at_s": 0.01} | fault]
    return Scenario.model_validate(GOOD | {"fault": faults, "expect": {"reaction": "none"} | expect})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"fault": []}, "fault"),
        ({"colour": "red"}, "colour: unknown key"),
        ({"fault": [{"kind": "drop", "frames": ["encoder"], "befor": 1}]}, "befor: unknown key"),
        ({"fault": [{"kind": "dropp"}]}, "dropp"),
        ({"fault": [{"kind": "drop", "frames": ["brake"]}]}, "brake"),
        ({"expect": {"reaction": "centre"}}, "names no fault"),
        ({"expect": {"reaction": "none", "travel_mm": 30.0}}, "needs a reason"),
        ({"fault": [{"kind": "babble", "can_id": 1}]}, "either load or per_period"),
        (
            {"fault": [{"kind": "drift", "signal": "p1_pa", "alternate": True}]},
            "only an offset can alternate",
        ),
    ],
)
def test_what_is_wrong_in_a_file_is_said_in_one_line(
    change: dict[str, Any], words: str, tmp_path: Any
) -> None:
    file = tmp_path / "x.toml"
    data = GOOD | change
    faults = "".join(f"\n[[fault]]\n{toml_text(fault)}" for fault in data.pop("fault"))
    file.write_text(toml_text(data) + (faults or "\n"))
    done = pneud("sim", "--scenario", file)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    assert words in done.stderr or (not faults and "fault: missing" in done.stderr)


def test_a_scenario_that_is_nowhere_is_said_in_one_line() -> None:
    done = pneud("sim", "--scenario", "no-such-thing")
    assert (done.returncode, done.stdout) == (2, "")
    assert "no-such-thing: no such scenario" in done.stderr


def test_a_fault_that_is_not_in_the_table_is_a_mistake() -> None:
    with pytest.raises(ConfigError, match="bad_luck"):
        verdict.check_names(scenario({"kind": "seized"}, also=("bad_luck",)))


def test_a_scenario_that_takes_a_machine_is_not_simulated() -> None:
    done = pneud("sim", "--scenario", "recorder-killed")
    assert done.returncode == 2
    assert "takes a real machine" in done.stderr


def test_what_a_scenario_changes_stands_in_the_text_that_goes_into_the_log() -> None:
    changed = load(
        "virtual.toml", None, {"limits": {"tracking_error_m": 0.4}, "bus": {"channel": 'a"b'[0:0] or "auto"}}
    )
    assert changed.config.limits.tracking_error_m == 0.4
    assert parse(changed.text, "again") == changed.config
    assert load("virtual.toml").config.limits.tracking_error_m != 0.4


def test_the_example_of_the_documentation_is_a_scenario(tmp_path: Path) -> None:
    page = Path(__file__).parent.parent / "docs" / "hil.md"
    file = tmp_path / "example.toml"
    file.write_text(page.read_text().partition("```toml")[2].partition("\n")[2].partition("```")[0])
    example = load_scenario(file)
    verdict.check_names(example)
    load(example.config, None, example.change)
    done = pneud("check", file)
    assert (done.returncode, done.stdout) == (
        0,
        f"{file}: fine\nscenario hose-and-sensor on virtual: leak, silence → centre\n",
    )


# --- the engine -------------------------------------------------------------------------------------------


class Talk:
    """A controller's half of the conversation with an engine's node."""

    def __init__(self, played: Scenario, machine: Any = None) -> None:
        self.orders: list[int] = []
        self.engine = Engine(played, QUIET, CODECS, 1, 1000.0, self.orders.append)
        self.node = self.engine.node
        self.count = 0

    def tick(self, volts: float = 0.0, enable: int = 1) -> list[Frame]:
        t_ns = self.count * MS
        frames = self.node.poll(t_ns)
        self.node.on_frame(Frame(t_ns, 0x080, CODECS.sync.encode(counter=self.count % 240 + 1)))
        frames += self.node.poll(t_ns + 700_000)
        data = CODECS.valve_command.encode(volts, enable, 1, counter=self.count % 256)
        self.node.on_frame(Frame(t_ns + 700_000, 0x203, data))
        self.count += 1
        return frames

    def ticks(self, n: int, volts: float = 0.0) -> list[list[Frame]]:
        return [self.tick(volts) for _ in range(n)]


def after(
    fault: dict[str, Any], n: int = 10, volts: float = 0.0, **expect: Any
) -> tuple[Talk, list[list[Frame]]]:
    """Ten healthy ticks, then `n` with the fault."""
    talk = Talk(scenario(fault, **expect))
    healthy = talk.ticks(10, volts)
    assert all([f.can_id for f in frames] == [0x181, 0x182, 0x183] for frames in healthy)
    return talk, talk.ticks(n, volts)


def ids(frames: list[Frame]) -> list[int]:
    return [frame.can_id for frame in frames]


def of(can_id: int, ticks: list[list[Frame]]) -> list[Frame]:
    return [frame for frames in ticks for frame in frames if frame.can_id == can_id]


def test_frames_are_dropped_doubled_and_given_back() -> None:
    _, ticks = after({"kind": "drop", "frames": ["encoder"], "for_s": 0.005})
    assert [ids(frames).count(0x181) for frames in ticks] == [0] * 5 + [1] * 5
    _, ticks = after({"kind": "duplicate", "frames": ["pressure"]})
    assert all(ids(frames) == [0x181, 0x182, 0x182, 0x183] for frames in ticks)
    _, ticks = after({"kind": "drop", "frames": ["encoder"], "every": 3, "phase": 1})
    assert [ids(frames).count(0x181) for frames in ticks] == [1, 0, 1, 1, 0, 1, 1, 0, 1, 1]
    _, ticks = after({"kind": "drop", "frames": ["encoder"], "every": 3, "keep": True})
    assert [ids(frames).count(0x181) for frames in ticks] == [1, 0, 0, 1, 0, 0, 1, 0, 0, 1]


def test_chance_is_the_same_for_a_seed() -> None:
    fault = {"kind": "drop", "frames": ["encoder"], "probability": 0.5}
    first, again = (len(of(0x181, after(fault, 60)[1])) for _ in range(2))
    assert first == again
    assert 15 < first < 45


def test_frames_are_corrupted_frozen_reordered_and_late() -> None:
    _, ticks = after({"kind": "corrupt", "frames": ["encoder"]})
    assert not any(CODECS.encoder.valid(frame.data) for frame in of(0x181, ticks))
    _, ticks = after({"kind": "freeze", "frames": ["encoder"]})
    assert {CODECS.encoder.counter(frame.data) for frame in of(0x181, ticks)} == {9}
    _, ticks = after({"kind": "reorder", "frames": ["encoder"]})
    assert [CODECS.encoder.counter(f.data) for f in of(0x181, ticks)] == [
        11,
        10,
        13,
        12,
        15,
        14,
        17,
        16,
        19,
        18,
    ]
    _, ticks = after({"kind": "delay", "frames": ["valve_status"], "delay_periods": 0.5})
    assert all(frame.stamp_ns % MS > 900_000 for frame in of(0x183, ticks[:-1]))


def test_values_are_misreported_with_a_valid_checksum() -> None:
    def positions(**fault: Any) -> list[float]:
        _, ticks = after({"signal": "position_m"} | fault)
        frames = of(0x181, ticks)
        assert all(CODECS.encoder.valid(frame.data) for frame in frames)
        return [CODECS.encoder.decode(frame.data)[0] for frame in frames]

    true = positions(kind="offset", value=0.0)
    assert positions(kind="offset", value=0.003) == pytest.approx([x + 0.003 for x in true])
    assert positions(kind="scale", value=1.1) == pytest.approx([1.1 * x for x in true], abs=1e-6)
    assert positions(kind="set", value=0.25) == [0.25] * 10
    drift = positions(kind="drift", value=1.0)
    assert drift[9] - drift[0] == pytest.approx(0.009, abs=1e-5)
    assert positions(kind="set", value=1e6) == []
    _, ticks = after({"kind": "set", "signal": "encoder_status", "value": 5.0})
    assert {CODECS.encoder.decode(frame.data)[1] for frame in of(0x181, ticks)} == {5}


def test_some_values_are_misreported_and_one_way_or_the_other() -> None:
    def positions(**fault: Any) -> list[float]:
        offset = {"kind": "offset", "signal": "position_m", "value": 1e-3}
        return [CODECS.encoder.decode(f.data)[0] for f in of(0x181, after(offset | fault)[1])]

    true = positions(value=0.0)
    off = [round(1e3 * (x - y)) for x, y in zip(positions(alternate=True), true, strict=True)]
    assert off == [1, -1] * 5
    off = [round(1e3 * (x - y)) for x, y in zip(positions(every=4, phase=1), true, strict=True)]
    assert off == [0, 1, 0, 0] * 2 + [0, 1]


def test_sets_come_late_by_whole_periods_and_all_at_once() -> None:
    late = {"kind": "delay", "frames": ["encoder", "valve_status"], "delay_periods": 2.0, "after_sync": 0.5}
    _, ticks = after(late | {"for_s": 0.001})
    assert [len(frames) for frames in ticks[:4]] == [1, 3, 5, 3]
    assert [f.stamp_ns for f in ticks[2] if f.stamp_ns % MS == MS // 2] == [12 * MS + MS // 2] * 2


def test_nodes_that_skip_a_sync_do_not_count_it() -> None:
    _, ticks = after({"kind": "skip", "nodes": ["encoder", "valve"], "every": 4})
    counters = {
        can_id: [codec.counter(frame.data) for frame in of(can_id, ticks)]
        for can_id, codec in ((0x181, CODECS.encoder), (0x182, CODECS.pressure), (0x183, CODECS.valve_status))
    }
    assert [0x181 in ids(frames) for frames in ticks] == [False, True, True, True] * 2 + [False, True]
    assert counters == {0x181: list(range(10, 17)), 0x182: list(range(10, 20)), 0x183: list(range(10, 17))}


def test_a_value_that_is_stuck_stays_while_its_counter_goes_on() -> None:
    _, ticks = after({"kind": "stuck", "signal": "p1_pa"}, volts=3.0)
    frames = of(0x182, ticks)
    assert len({CODECS.pressure.decode(frame.data)[0] for frame in frames}) == 1
    assert [CODECS.pressure.counter(frame.data) for frame in frames] == list(range(10, 20))


def test_nodes_fall_silent_reboot_and_report() -> None:
    _, ticks = after({"kind": "silence", "nodes": ["encoder", "valve"]})
    assert all(ids(frames) == [0x182] for frames in ticks)
    talk, ticks = after({"kind": "reboot", "node": "valve", "for_s": 0.004}, volts=1.0)
    assert [0x183 in ids(frames) for frames in ticks] == [False] * 4 + [True] * 6
    assert 0x703 in ids(ticks[4])
    states = [CODECS.valve_status.decode(frame.data)[1] for frame in of(0x183, ticks)]
    assert states[0] == ValveState.BOOT
    assert CODECS.valve_status.counter(of(0x183, ticks)[0].data) == 0
    _, ticks = after({"kind": "emcy", "node": "pressure", "code": 0x5000})
    assert [frame.data[:2] for frame in of(0x082, ticks)] == [b"\x00\x50"]
    talk, ticks = after({"kind": "valve_failure", "for_s": 0.005}, volts=1.0)
    assert CODECS.valve_status.decode(of(0x183, ticks)[0].data) == (0.0, ValveState.FAULT)
    assert talk.node.valve.state == ValveState.ENABLED
    _, ticks = after({"kind": "heartbeat", "node": "encoder", "every_ms": 4.0})
    assert len(of(0x701, ticks)) == 3


def test_the_controllers_controller_leaves_the_bus_and_is_back() -> None:
    _, ticks = after({"kind": "bus_off", "of": "controller", "for_s": 0.005})
    errors = [
        frame.can_id & 0x1FFFFFFF for frames in ticks for frame in frames if frame.can_id & CAN_ERR_FLAG
    ]
    assert errors == [0x40, 0x100]
    assert [0x181 in ids(frames) for frames in ticks] == [False] * 5 + [True] * 5
    _, ticks = after({"kind": "bus_off", "of": "encoder"})
    assert all(ids(frames) == [0x182, 0x183] for frames in ticks)


def test_a_babbler_takes_the_bus_from_all_others_and_error_frames_take_no_time() -> None:
    _, ticks = after({"kind": "babble", "can_id": 1, "load": 1.0})
    assert len(of(1, ticks)) >= 70
    assert not of(0x181, ticks[1:])
    _, ticks = after({"kind": "babble", "can_id": 0x7FF, "load": 1.0})
    assert len(of(0x181, ticks)) == 10
    _, ticks = after({"kind": "error_frames", "error_class": 4, "controller_status": 0x20, "per_period": 2})
    errors = of(CAN_ERR_FLAG | 4, ticks)
    assert len(errors) >= 18
    assert {frame.data[1] for frame in errors} == {0x20}
    assert len(of(0x181, ticks)) == 10


def test_somebody_elses_sync_and_commands_are_heard_by_the_nodes() -> None:
    data = CODECS.valve_command.encode(2.0, 1, 1, counter=77).hex()
    talk, ticks = after({"kind": "babble", "can_id": 0x203, "per_period": 1, "data": data}, 1)
    assert 0x203 in ids(ticks[0])
    assert talk.node.valve.output_v == pytest.approx(2.0, abs=0.01)
    _, ticks = after({"kind": "babble", "can_id": 0x080, "per_period": 1, "data": "01"})
    assert len(of(0x181, ticks)) > 10


def test_a_fault_begins_when_its_condition_holds_and_the_machine_is_told() -> None:
    talk = Talk(scenario({"kind": "kill", "who": "recorder", "when": {"velocity_above_m_s": 0.02}}))
    for _ in range(300):
        talk.tick(2.0)
        if talk.orders:
            break
    assert talk.orders == [0]
    assert talk.engine.effects.onset_m_s > 0.02
    held = Talk(scenario({"kind": "seized", "when": {"position_above_m": 0.9}}))
    held.ticks(30)
    assert held.engine.effects.onset_ns < 0
    assert held.engine.effects.as_dict()["onset"] is False


def test_without_an_active_fault_the_rig_is_the_healthy_one_to_the_bit() -> None:
    def run(fault: dict[str, Any]) -> PlantState:
        talk = Talk(scenario(fault))
        talk.ticks(30, 1.0)
        return talk.node.state

    later = run({"kind": "seized", "at_s": 99.0})
    assert later == run({"kind": "leak", "chamber": 1, "size": 1.0, "since": "armed", "at_s": 99.0})
    assert later == run({"kind": "friction", "factor": 1.0})


@pytest.mark.parametrize(
    ("fault", "holds"),
    [
        ({"kind": "supply", "supply_pa": 2e5}, lambda n: n.p.gas.supply_pa == 2e5),
        ({"kind": "supply", "supply_pa": 2e5, "ramp_s": 0.1}, lambda n: 5.5e5 < n.p.gas.supply_pa < 5.9e5),
        ({"kind": "mass", "factor": 0.5}, lambda n: n.p.cylinder.M == 0.5 * QUIET.cylinder.M),
        (
            {"kind": "friction", "factor": 5.0},
            lambda n: n.p.friction.static_n == 5.0 * QUIET.friction.static_n,
        ),
        ({"kind": "force", "force_n": 100.0}, lambda n: n.force_ext_n == -100.0),
        ({"kind": "force", "force_n": 100.0, "frequency_hz": 50.0}, lambda n: -100.0 < n.force_ext_n < 100.0),
        ({"kind": "seized"}, lambda n: n.state.v == pytest.approx(0.0, abs=1e-6)),
        ({"kind": "valve_stuck", "opening_percent": -100.0}, lambda n: n.state.y < -2.0),
        ({"kind": "leak", "chamber": 1, "size": 4.0}, lambda n: n.state.p1 < 2.7e5),
        ({"kind": "leak", "chamber": 2, "size": 4.0}, lambda n: n.state.p2 < 2.9e5),
    ],
)
def test_the_plant_is_damaged_and_mended(fault: dict[str, Any], holds: Any) -> None:
    talk, _ = after(fault | {"for_s": 0.0101})
    assert holds(talk.node)
    talk.ticks(5)
    assert (talk.node.p, talk.node.force_ext_n) == (QUIET, 0.0)


def test_a_leak_empties_a_chamber_to_the_atmosphere_and_no_further() -> None:
    start = initial_state(QUIET)
    burst = UNDAMAGED._replace(leak1=4.0, seized=True)
    state = advance_damaged(start, 0.0, 0.0, 0.0, 2.0, QUIET, burst)
    assert state.p1 == pytest.approx(QUIET.gas.atmosphere_pa, rel=1e-3)
    assert state.x1 == pytest.approx(start.x1)
    assert state.p2 == pytest.approx(start.p2)
    assert advance_damaged(start, 2.0, 5.0, 0.0, 0.01, QUIET, UNDAMAGED) == advance(
        start, 2.0, 5.0, 0.0, 0.01, QUIET
    )


def test_a_small_hole_lets_out_what_st_venant_and_wantzel_say() -> None:
    start = initial_state(QUIET)
    size, h = 1e-3, 1e-3
    c, g = QUIET.cylinder, QUIET.gas
    state = advance_damaged(start, 0.0, 0.0, 0.0, h, QUIET, UNDAMAGED._replace(leak2=size, seized=True))
    rate = QUIET.polytropic_exponent / g.k * c.c1 * QUIET.valve.u_max_v * size / (c.A2 * (c.L - start.x1))
    assert start.p2 / g.atmosphere_pa > 1.0 / g.critical_ratio  # choked
    assert state.p2 - start.p2 == pytest.approx(-rate * g.gamma_choked * start.p2 * h, rel=1e-3)


# --- the verdict ------------------------------------------------------------------------------------------


def simulated(name: str, config: str | None = None) -> dict[str, Any]:
    played = load_scenario(name)
    loaded = load(config or played.config, None, played.change)
    run = Simulation(loaded, played.duration_s, 0, backend_of(loaded), scenario=played)
    seen = verdict.Observed()
    for record in run.records():
        if not run.shut:
            seen = seen.then(record.tick)
    assert run.engine is not None
    run.engine.settle()
    return verdict.judge(played, loaded.config, seen, run.engine.effects.as_dict())


def test_the_verdict_of_a_simulated_run_is_printed() -> None:
    done = pneud("sim", "--scenario", "encoder-error")
    assert done.returncode == 1
    assert "scenario encoder-error: centre as expected (encoder_error), 0 V 0.5 ms after" in done.stdout
    result = json.loads(pneud("sim", "--scenario", "valve-active", "--json").stdout)["scenario"]
    assert (result["met"], result["faults"], result["engaged"]) == (True, ["valve_active"], False)


EFFECTS = {
    "onset": True, "speed_m_s": 0.1, "evidence_ms": 0.0, "centred_ms": 1.0, "ticks": 2, "onset_ticks": 2,
    "travel_mm": 5.0, "peak_bar": 4.0, "impact_m_s": 0.0, "engaged": True,
}  # fmt: skip
CENTRED = verdict.Observed(1, 1, int(State.FAULT), True)


@pytest.mark.parametrize(
    ("expect", "seen", "effects", "problem"),
    [
        ({}, CENTRED, {}, None),
        ({}, CENTRED, {"onset": False}, "never began"),
        ({}, CENTRED._replace(present=0, latched=0), {}, "no encoder_missing"),
        ({}, CENTRED._replace(latched=3), {}, "unexpected encoder_corrupt"),
        ({"also": ["encoder_corrupt"]}, CENTRED._replace(latched=3), {}, None),
        ({}, CENTRED._replace(state=int(State.TRACKING)), {}, "ended tracking"),
        ({}, CENTRED, {"centred_ms": None}, "no 0 V"),
        ({}, CENTRED, {"ticks": None}, "before there was evidence"),
        ({}, CENTRED, {"ticks": 3}, "in tick 3 of the evidence, not 2"),
        ({"after": "sensor_timeout"}, CENTRED, {"ticks": 51}, None),
        ({"after": "sensor_timeout"}, CENTRED, {"ticks": 52}, "not 51"),
        ({"after": "valve_timeout"}, CENTRED, {"ticks": 52}, None),
        ({"within_ms": 0.5}, CENTRED, {}, "0 V after 1.0 ms"),
        ({}, CENTRED, {"travel_mm": 21.0}, "21.0 mm of travel"),
        ({}, CENTRED, {"impact_m_s": 0.1}, "end stop at 0.10 m/s"),
        ({"reaction": "stop"}, CENTRED, {}, "no controlled stop"),
        ({"reaction": "no_arm"}, CENTRED._replace(latched=0), {}, "it armed"),
        ({"reaction": "warn"}, CENTRED._replace(latched=0), {}, "not engaged"),
        ({"reaction": "warn"}, verdict.Observed(1, 0, int(State.TRACKING), True), {}, None),
    ],
)
def test_the_verdict_says_what_was_not_as_expected(
    expect: dict[str, Any], seen: verdict.Observed, effects: dict[str, Any], problem: str | None
) -> None:
    played = scenario({"kind": "seized"}, **({"reaction": "centre", "faults": ["encoder_missing"]} | expect))
    result = verdict.judge(played, load("virtual.toml").config, seen, EFFECTS | effects)
    assert result["met"] is (problem is None), result["problems"]
    assert problem is None or any(problem in words for words in result["problems"])
    assert ("not as expected" in verdict.in_words(result)) is (problem is not None)


# --- the campaign in simulated time -----------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", [s.name for s in scenarios() if not s.needs_machine])
def test_the_axis_does_what_the_scenario_expects(name: str) -> None:
    result = simulated(name)
    assert result["met"], verdict.in_words(result)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        s.name
        for s in scenarios()
        if "time-out of 50 ms" in s.expect.reason and "bus" not in s.change and not s.needs_machine
    ],
)
def test_with_the_rigs_time_outs_the_travel_is_that_of_any_fault(name: str) -> None:
    result = simulated(name, "rig.toml")
    assert result["travel_mm"] <= 20.0, verdict.in_words(result)
    assert math.isfinite(result["peak_bar"])


def test_a_scenario_is_validated_by_pydantic() -> None:
    with pytest.raises(ValidationError):
        scenario({"kind": "leak", "chamber": 3, "size": 1.0})
