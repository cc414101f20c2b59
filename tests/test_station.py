"""Inputs, outputs and a brake on an axis with its software rig: what they forbid, begin and hold."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from axis_rig import quick
from pneud import resources
from pneud.bus.codec import Codecs, DatabaseError, codecs_from
from pneud.bus.switching import Hearing, Saying
from pneud.bus.wire import CAN_EFF_FLAG
from pneud.compiled.backend import FUNCTIONS, INTERPRETED
from pneud.config.bus_tables import BusConfig
from pneud.config.reading import parse
from pneud.config.sections import ConfigError
from pneud.config.toml import changed_text
from pneud.console import programs
from pneud.console.records import ProgramError
from pneud.control.program import Step
from pneud.loading import Loaded, Together, devices_of, load, load_axes
from pneud.log.files.naming import create_log
from pneud.log.files.reader import LogReader, read_log
from pneud.log.files.writer import LogWriter
from pneud.physics.plant import Board
from pneud.replay.lockstep import Simulation, header_of
from pneud.replay.replaying import replay
from pneud.replay.together import Together as SimulatedTogether
from pneud.rig.station import StationNode
from pneud.rt.folders import cache_folder
from pneud.safety.faults import BLOCKS_ARM, F, names
from pneud.safety.supervisor import is_engaged
from pneud.safety.unnoticed import unnoticed
from pneud.scenario.format import Scenario
from pneud.signals import Answer, Frame, Hold, Record, Request, RequestKind, State
from pure2c import compile_functions
from several import FOLDER, text_of

MS = 1_000_000
INPUTS = {
    "enable": "INPUTS.Enable",
    "start": "INPUTS.Start",
    "part_present": "INPUTS.PartPresent",
    "brake_released": "INPUTS.BrakeReleased",
}
OUTPUTS = {
    "in_position": "OUTPUTS.InPosition",
    "ready": "OUTPUTS.Ready",
    "fault": "OUTPUTS.Fault",
    "brake": "OUTPUTS.Brake",
    "gripper": "OUTPUTS.Gripper",
}
MESSAGES = {"INPUTS": {"counter": "Counter"}, "OUTPUTS": {"counter": "Counter"}}
BRAKE = {"release_s": 0.02, "engage_s": 0.03, "feedback_s": 0.03}
ARM, GOTO = Request(RequestKind.ARM), RequestKind.GOTO
RECORD, RUN = RequestKind.RECORD, RequestKind.RUN


def axis(brake: bool = False, braking: dict[str, Any] | None = None, **more: Any) -> Loaded:
    """The virtual axis with inputs and outputs."""
    inputs, outputs = INPUTS, OUTPUTS
    if not brake:
        inputs = {name: at for name, at in INPUTS.items() if name != "brake_released"}
        outputs = {name: at for name, at in OUTPUTS.items() if name != "brake"}
    bus = {"dbc": "station.dbc", "inputs": inputs, "outputs": outputs, "messages": MESSAGES}
    change: dict[str, Any] = {"bus": bus, "io": {"start": "program"}}
    if brake:
        change["brake"] = BRAKE | (braking or {})
    for key, value in more.items():
        change[key] = change.get(key, {}) | value
    return load("virtual.toml", change=change)


class Run:
    """A simulation whose operator is a test; `now` counts ticks."""

    def __init__(self, loaded: Loaded, how: Any = None, scenario: Scenario | None = None) -> None:
        self.loaded = loaded
        self.asked: list[Request] = []
        self.records: list[Record] = []
        self.simulation = Simulation(
            loaded, 60.0, 0, quick() if how is None else how, operator=self._ask, scenario=scenario
        )
        self._ticks = self.simulation.records()

    def _ask(self, state: int, present: int) -> Request | None:
        return self.asked.pop(0) if self.asked else None

    @property
    def station(self) -> StationNode:
        station = self.simulation.node.station
        assert station is not None
        return station

    def put(self, name: str, on: bool) -> None:
        """Switch an input."""
        bit = self.station.bit_of(name)
        self.station.inputs = self.station.inputs | bit if on else self.station.inputs & ~bit

    def tick(self, *asked: Request) -> Record:
        self.asked += asked
        record = next(self._ticks)
        self.records.append(record)
        return record

    def ticks(self, n: int, *asked: Request) -> list[Record]:
        return [self.tick(*asked if i == 0 else ()) for i in range(n)]

    def until(self, wanted: Callable[[Record], bool], limit: int = 3000) -> Record:
        for _ in range(limit):
            record = self.tick()
            if wanted(record):
                return record
        raise AssertionError(f"not within {limit} ticks: {self.records[-1].tick}")

    def armed(self, request: Request = ARM) -> Record:
        """Armed, as soon as it can be."""
        self.until(lambda r: r.tick.state == State.DISARMED and not r.tick.present & BLOCKS_ARM)
        return self.tick(request)

    def load(self, *steps: Step) -> None:
        for values in ((), *(tuple(map(float, step)) for step in steps)):
            self.tick(Request(RECORD, values))

    def outputs(self) -> set[str]:
        """What the outputs say in the last tick."""
        station = self.records[-1].tick.station
        assert station is not None
        return {name for bit, name in enumerate(self.loaded.config.bus.outputs) if station.outputs >> bit & 1}


def state(wanted: State) -> Callable[[Record], bool]:
    return lambda record: record.tick.state == wanted


def hold(record: Record) -> Hold:
    assert record.tick.station is not None
    return Hold(record.tick.station.brake)


def faults(record: Record) -> list[str]:
    return names(record.tick.present | record.tick.latched)


def whole(loaded: Loaded, *records: dict[str, Any]) -> programs.Compiled:
    tree = {"schema": 1, "record": list(records)}
    return programs.compiled(tree, [programs.facts_of(loaded.config)])


def steps(loaded: Loaded, *records: dict[str, Any]) -> tuple[Step, ...]:
    return whole(loaded, *records).steps[0]


GO, WAIT = {"do": "goto", "to_mm": 470.0}, {"do": "wait", "for_s": 0.02}


# inputs


def test_without_enable_it_is_not_armed_and_says_why() -> None:
    run = Run(axis(plant={"inputs": {"enable": False}}))
    run.until(state(State.DISARMED))
    run.ticks(200)
    assert "enable_off" in faults(run.records[-1])
    assert run.tick(ARM).tick.state == State.DISARMED
    run.put("enable", True)
    assert run.armed().tick.state == State.HOLDING


@pytest.mark.parametrize(("what", "fault"), [("stop", "enable_off"), ("centre", "enable_cut")])
def test_an_enable_that_goes_in_motion_ends_it_and_does_not_arm_again(what: str, fault: str) -> None:
    run = Run(axis(io={"enable_off": what}))
    run.armed()
    run.ticks(100, Request(GOTO, (0.6,)))
    run.put("enable", False)
    ended = run.until(lambda r: r.tick.state != State.MOVING)
    assert ended.tick.state == (State.STOPPING if what == "stop" else State.FAULT)
    assert fault in faults(ended)
    run.until(state(State.FAULT))
    assert "fault" in run.outputs() and "ready" not in run.outputs()
    clear = Request(RequestKind.CLEAR)
    assert run.tick(clear).tick.state == State.FAULT
    run.put("enable", True)
    run.ticks(20)
    assert run.tick(clear).tick.state == State.DISARMED
    assert not any(is_engaged(r.tick.state) for r in run.ticks(50))


def test_inputs_that_fall_silent_are_lost_in_their_time() -> None:
    run = Run(axis(bus={**dict_of_bus(), "input_timeout_ms": 50.0}))
    run.armed()
    run.ticks(20)
    run.station.silent = True
    ticks = run.ticks(61)
    lost = next(n for n, r in enumerate(ticks) if "input_lost" in faults(r))
    assert 40 <= lost <= 51  # the last one came up to 10 ms before
    assert run.records[-1].tick.state == State.STOPPING
    run.until(state(State.FAULT))


def dict_of_bus() -> dict[str, Any]:
    return {
        "dbc": "station.dbc",
        "inputs": {name: at for name, at in INPUTS.items() if name != "brake_released"},
        "outputs": {name: at for name, at in OUTPUTS.items() if name != "brake"},
        "messages": MESSAGES,
    }


def test_inputs_that_have_never_come_keep_it_from_being_armed() -> None:
    run = Run(axis())
    run.station.silent = True
    run.until(state(State.DISARMED))
    assert "input_lost" in faults(run.tick(ARM))
    assert run.records[-1].tick.state == State.DISARMED


def test_a_start_begins_the_loaded_program_once_for_each_time_it_comes_on() -> None:
    loaded = axis()
    run = Run(loaded)
    run.put("start", True)  # it stands, and begins nothing
    run.armed()
    run.load(*steps(loaded, GO, WAIT))
    run.ticks(50)
    assert run.records[-1].tick.progress.stage == 0
    for _ in range(2):
        run.put("start", False)
        run.ticks(15)
        run.put("start", True)
        begun = run.until(lambda r: r.tick.progress.step == 1, 20)
        assert begun.tick.request is None
        run.until(lambda r: r.tick.progress.stage == 2)
        assert all(r.tick.progress.stage == 2 for r in run.ticks(50))
    assert not any("start_refused" in faults(r) for r in run.records)


def test_a_start_that_can_begin_nothing_is_told_for_a_second() -> None:
    loaded = axis()
    run = Run(loaded)
    run.until(state(State.DISARMED))
    run.ticks(60)
    press(run)
    told = run.until(lambda r: "start_refused" in faults(r), 20)
    run.until(lambda r: "start_refused" not in faults(r))
    assert run.records[-1].tick.t_ns - told.tick.t_ns == pytest.approx(1e9, abs=2 * MS)
    run.armed()
    press(run)  # none is loaded
    run.until(lambda r: "start_refused" in faults(r), 20)
    run.load(*steps(loaded, GO, WAIT))
    press(run)
    run.until(lambda r: r.tick.progress.step == 1, 20)
    run.tick(Request(RequestKind.HOLD))
    press(run)  # one that was stopped goes on by a person
    assert all(r.tick.progress.stage == 1 for r in run.ticks(50))
    assert "start_refused" in faults(run.records[-1])


def test_a_start_in_the_middle_of_a_hand_over_begins_nothing_and_is_told() -> None:
    loaded = axis()
    found = whole(loaded, GO, WAIT, GO | {"to_mm": 250.0})
    handed = programs.requests(found, load=True)
    for given in range(1, len(handed)):
        run = Run(loaded)
        run.armed()
        run.load(*found.steps[0])  # one that was whole is not, once another one comes
        for request in handed[:given]:
            run.tick(request)
        press(run)
        run.until(lambda r: "start_refused" in faults(r), 20)
        assert run.tick(Request(RUN, (1.0, 1.0, 0.0))).tick.answer == Answer.NO_PROFILE
        for request in handed[given:]:
            assert run.tick(request).tick.answer == Answer.TAKEN
        assert all(r.tick.progress.stage == 0 for r in run.records)
        press(run)
        run.until(lambda r: r.tick.progress.step == 1, 20)


def test_a_start_in_a_tick_that_takes_a_step_is_refused_and_told() -> None:
    loaded = axis()
    run = Run(loaded)
    run.armed()
    press(run)
    before = run.until(lambda r: "start_refused" in faults(r), 20)
    run.ticks(1200)
    run.put("start", False)
    run.ticks(15)
    run.put("start", True)
    for _ in range(20):  # in one of these it comes on
        for request in programs.requests(whole(loaded, WAIT), load=True):
            run.tick(request)
    assert run.records[-1].tick.progress.stage == 0
    assert "start_refused" in faults(run.records[-1])
    assert run.records[-1].tick.t_ns - before.tick.t_ns > 1.1e9


def test_a_start_begins_nothing_that_its_operator_is_about_to_begin_elsewhere() -> None:
    loaded = axis()
    run = Run(loaded)
    run.armed()
    found = whole(loaded, GO, WAIT, GO | {"to_mm": 250.0})
    for request in programs.requests(found):
        run.tick(request)
    press(run)
    run.until(lambda r: "start_refused" in faults(r), 20)
    assert run.tick(Request(RUN, (3.0, 1.0, 0.0))).tick.answer == Answer.TAKEN
    assert run.until(lambda r: r.tick.progress.step > 0).tick.progress.step == 3


def with_what_others_share() -> Run:
    """Armed, with a program of several axes."""
    loaded = axis()
    run = Run(loaded)
    run.armed()
    run.tick(Request(RECORD, (1.0, 1.0)))
    for step in steps(loaded, WAIT):
        run.tick(Request(RECORD, tuple(map(float, step))))
    return run


def test_an_axis_does_not_go_on_alone_with_what_others_go_through_too() -> None:
    run = with_what_others_share()
    assert run.tick(Request(RUN, (1.0, 1.0, 0.0))).tick.answer == Answer.NO_PROFILE
    assert run.tick(Request(RUN, (1.0, 1.0, 1.0))).tick.answer == Answer.TAKEN
    run.tick(Request(RequestKind.HOLD))
    assert run.tick(Request(RUN, (0.0, 0.0, 0.0))).tick.answer == Answer.NO_PROFILE
    assert run.tick(Request(RUN, (0.0, 0.0, 1.0))).tick.answer == Answer.TAKEN


def test_a_start_begins_nothing_that_other_axes_go_through_too() -> None:
    run = with_what_others_share()
    press(run)
    run.until(lambda r: "start_refused" in faults(r), 20)
    assert run.records[-1].tick.progress.stage == 0


@pytest.mark.parametrize(
    "values", [(0.0, 0.0), (257.0, 0.0), (2.5, 0.0), (3.0, 3.0), (math.nan, 0.0), (3.0, 0.0, 0.0)]
)
def test_steps_that_nobody_can_hand_over_are_not_announced(values: tuple[float, ...]) -> None:
    run = Run(axis())
    run.armed()
    assert run.tick(Request(RECORD, values)).tick.answer == Answer.MALFORMED


def press(run: Run) -> None:
    run.put("start", False)
    run.ticks(15)
    run.put("start", True)


# outputs and programs


def test_a_program_waits_for_an_input_and_puts_out() -> None:
    loaded = axis()
    run = Run(loaded)
    run.armed()
    program = (
        {"do": "output", "output": "gripper", "on": True},
        {"do": "until", "input": "part_present"},
        {"do": "output", "output": "gripper", "on": False},
        WAIT,
    )
    run.load(*steps(loaded, *program))
    run.tick(Request(RUN, (1.0, 1.0, 0.0)))
    run.ticks(50)
    assert "gripper" in run.outputs()
    assert run.records[-1].tick.progress.step == 2
    run.put("part_present", True)
    run.until(lambda r: r.tick.progress.step == 4, 20)
    assert "gripper" not in run.outputs()


def test_outputs_leave_when_they_change_and_every_so_often() -> None:
    run = Run(axis())
    run.armed()
    run.ticks(300)
    out = run.loaded.codecs.switching
    assert out is not None
    can_id = out.outputs[0].codec.can_id
    sent = [(r.tick.t_ns, f.data) for r in run.records for f in r.sent if f.can_id == can_id]
    assert all(b[0] - a[0] <= 20 * MS for a, b in pairwise(sent))
    changes = [
        (r.tick.t_ns, r.tick.station) for a, r in pairwise(run.records) if a.tick.station != r.tick.station
    ]
    outputs_changed = [
        b.tick.t_ns
        for a, b in pairwise(run.records)
        if a.tick.station and b.tick.station and a.tick.station.outputs != b.tick.station.outputs
    ]
    assert changes and outputs_changed
    assert set(outputs_changed) <= {t_ns for t_ns, _ in sent}
    assert "ready" in run.outputs() and "in_position" in run.outputs()
    assert run.station.outputs == out.outputs[0].bits(sent[-1][1])


@pytest.mark.parametrize(
    ("record", "words"),
    [
        ({"do": "until", "input": "door"}, "no input 'door'; there is enable, start"),
        ({"do": "output", "output": "lamp", "on": True}, "no output 'lamp'; there is in_position"),
        ({"do": "output", "output": "ready", "on": True}, "pneud itself puts out 'ready'"),
    ],
)
def test_a_program_names_what_there_is(record: dict[str, Any], words: str) -> None:
    with pytest.raises(ProgramError, match=words):
        steps(axis(), record)


def test_a_program_for_an_axis_without_inputs_says_how_to_get_some() -> None:
    with pytest.raises(ProgramError, match=r"bus\.inputs\.door = "):
        steps(load("virtual.toml"), {"do": "until", "input": "door"})


# the brake


def test_it_lets_go_of_what_the_piston_bears_before_anything_is_led() -> None:
    run = Run(axis(brake=True))
    start_m = run.tick().truth_m
    armed = run.armed(Request(RequestKind.ARM, (1.0,)))
    assert (armed.tick.state, hold(armed)) == (State.TRACKING, Hold.BALANCING)
    free = run.until(lambda r: hold(r) == Hold.RELEASED)
    braked = [r for r in run.records if hold(r) != Hold.RELEASED]
    assert all(r.tick.reference.velocity_m_s == 0.0 for r in braked if is_engaged(r.tick.state))
    assert max(abs(r.truth_m - start_m) for r in braked) < 1e-6
    seen = [hold(r) for a, r in pairwise(run.records) if hold(a) != hold(r)]
    assert seen == [Hold.BALANCING, Hold.RELEASING, Hold.RELEASED]
    told = next(r for r in run.records if hold(r) == Hold.RELEASING)
    assert free.tick.t_ns - told.tick.t_ns >= 20 * MS
    after = run.ticks(1500)
    assert any(r.tick.reference.velocity_m_s != 0.0 for r in after)
    assert all(r.tick.state == State.TRACKING and not r.tick.latched for r in after)


@pytest.mark.parametrize("angle", [90.0, -90.0])
def test_a_hanging_load_neither_falls_nor_jumps(angle: float) -> None:
    run = Run(axis(brake=True, cylinder={"inclination_deg": angle}))
    run.armed()
    run.until(lambda r: hold(r) == Hold.RELEASED)
    released = run.records[-1].truth_m
    assert max(abs(r.truth_m - released) for r in run.ticks(500)) < 2e-3
    assert run.records[-1].tick.state == State.HOLDING


def test_a_stop_ends_only_when_it_holds() -> None:
    run = Run(axis(brake=True))
    run.armed(Request(RequestKind.ARM, (1.0,)))
    run.until(lambda r: hold(r) == Hold.RELEASED)
    run.ticks(700)
    run.tick(Request(RequestKind.DISARM))
    ended = run.until(state(State.DISARMED))
    seen = [hold(r) for a, r in pairwise(run.records) if hold(a) != hold(r)]
    assert seen[-2:] == [Hold.ENGAGING, Hold.ENGAGED]
    begun = next(r for r in run.records if hold(r) == Hold.ENGAGING)
    assert ended.tick.t_ns - begun.tick.t_ns >= 30 * MS
    at_m = ended.truth_m
    assert max(abs(r.truth_m - at_m) for r in run.ticks(200)) < 1e-6


def test_a_fault_that_centres_engages_it_in_the_same_tick() -> None:
    run = Run(axis(brake=True, io={"enable_off": "centre"}))
    run.armed()
    run.until(lambda r: hold(r) == Hold.RELEASED)
    run.ticks(100, Request(GOTO, (0.6,)))
    run.put("enable", False)
    ended = run.until(state(State.FAULT))
    assert hold(ended) == Hold.ENGAGED
    assert "brake" not in run.outputs()


def test_a_motion_waits_for_it_where_it_holds_at_rest() -> None:
    run = Run(axis(brake=True, braking={"at_rest": True}))
    run.armed()
    assert {hold(r) for r in run.ticks(200)} == {Hold.ENGAGED}
    begun = run.tick(Request(GOTO, (0.5,)))
    assert begun.tick.state == State.MOVING
    arrived = run.until(lambda r: r.tick.state == State.HOLDING and hold(r) == Hold.ENGAGED)
    assert abs(arrived.truth_m - 0.5) < 1e-3
    for r in run.records:
        if is_engaged(r.tick.state) and hold(r) != Hold.RELEASED:
            assert r.tick.reference.velocity_m_s == 0.0


def test_a_brake_that_does_not_let_go_is_found() -> None:
    run = Run(axis(brake=True))
    run.station.stuck = 0
    run.armed()
    stuck = run.until(lambda r: "brake_stuck" in faults(r))
    assert stuck.tick.state == State.STOPPING
    run.until(state(State.FAULT))


def test_a_brake_that_does_not_hold_keeps_the_axis_from_being_armed() -> None:
    run = Run(axis(brake=True))
    run.station.stuck = 1
    run.until(lambda r: "brake_stuck" in faults(r))
    assert run.tick(ARM).tick.state == State.DISARMED


def test_a_daemon_that_is_gone_leaves_the_load_to_the_brake() -> None:
    run = Run(axis(brake=True))
    run.armed()
    run.until(lambda r: hold(r) == Hold.RELEASED)
    node, switching = run.simulation.node, run.loaded.codecs.switching
    assert switching is not None
    (message,), begun_ns = switching.inputs, node.now_ns
    released = run.station.bit_of("brake_released")
    told: dict[int, bool] = {}
    for passed_ms in range(5, 300, 5):  # inputs are sent, whoever listens
        for frame in node.poll(begun_ns + passed_ms * MS):
            if frame.can_id == message.codec.can_id:
                told[passed_ms] = bool(message.bits(frame.data) & released)
    assert len(told) >= 28
    engaged_ms = next(passed_ms for passed_ms, free in told.items() if not free)
    assert 100 + 30 - 20 <= engaged_ms <= 100 + 30 + 30
    assert run.station.outputs == 0
    assert run.station.is_clamped(node.now_ns)


def wild(run: Run, rng: random.Random, ticks: int) -> Iterator[Record]:
    """Whatever can be asked and switched."""
    kinds = [
        Request(RequestKind.ARM), Request(RequestKind.ARM, (1.0,)), Request(RequestKind.DISARM),
        Request(RequestKind.CLEAR), Request(RequestKind.STOP), Request(RequestKind.HOLD),
        Request(GOTO, (0.5,)), Request(GOTO, (0.4,)), Request(RequestKind.JOG, (0.1, 200.0)),
        Request(RequestKind.TRACK, (0.0,)), Request(RequestKind.FORCE, (50.0, 0.0, 0.0, 0.0, 0.0, 0.0)),
        Request(RequestKind.PROBE, (0.3, 1.0, 0.003, 0.05, 100.0, 50.0)),
    ]  # fmt: skip
    for n in range(ticks):
        if n % 40 == 0:
            run.asked.append(rng.choice(kinds))
        if n % 170 == 169:
            run.put(rng.choice(["enable", "start", "part_present"]), rng.random() < 0.7)
        if n % 400 == 399:
            run.station.stuck = rng.choice([-1, -1, -1, 0, 1])
            run.station.silent = rng.random() < 0.1
        yield run.tick()


@pytest.mark.parametrize("seed", range(2))
def test_whatever_is_asked_nothing_is_led_while_it_holds(seed: int) -> None:
    rng = random.Random(seed)
    run = Run(axis(brake=True, braking={"at_rest": seed % 2 == 1}))
    holds, engaged_ever = set(), False
    for record in wild(run, rng, 1500):
        tick, station = record.tick, record.tick.station
        assert station is not None
        engaged = is_engaged(tick.state)
        engaged_ever = engaged_ever or engaged
        holds.add(station.brake)
        if not engaged:
            assert station.brake == Hold.ENGAGED
            assert "brake" not in run.outputs()
        elif station.brake in (Hold.ENGAGED, Hold.BALANCING, Hold.RELEASING):
            assert abs(tick.reference.velocity_m_s) < 1e-12
        if "brake" in run.outputs():
            assert engaged
    assert engaged_ever and holds >= {Hold.ENGAGED, Hold.BALANCING, Hold.RELEASING}


# several axes

SHARED = """
[bus.inputs]
enable = "INPUTS.Enable"
"""


def two(folder: Path, more: str) -> Together:
    own = (resources.configs() / "station.dbc").read_text()  # whose identifiers are other nodes' here
    dbc = (FOLDER / "axes.dbc").read_text()
    at = own.index("BO_ 388 ")
    extra = own[at : own.index("BO_ 129 ")].replace("IO_NODE", "VALVE_NODE")
    dbc += extra.replace("BO_ 388 ", "BO_ 400 ").replace("BO_ 516 ", "BO_ 656 ")
    (folder / "axes.dbc").write_text(dbc)
    text = text_of(2)
    at = text.index("\n[[axis]]")
    file = folder / "two.toml"
    file.write_text(text[:at] + SHARED + text[at:] + more)
    return load_axes(file)


def test_one_enable_is_that_of_both_axes(tmp_path: Path) -> None:
    axes = two(tmp_path, "")
    run = SimulatedTogether(axes, 1.0, 0, [quick(), quick()])
    stations = [lane.node.station for lane in run.lanes]
    first, second = stations
    assert first is not None and second is not None and second.speaker is first
    states = []
    for n, records in enumerate(run.records()):
        states.append([State(r.tick.state) for r in records])
        if n == 250:
            assert states[-1] == [State.TRACKING] * 2
            first.inputs = 0
        if n == 400:
            break
    assert all(r.tick.latched >> F.ENABLE_OFF & 1 for r in records)
    assert states[-1] == [State.FAULT] * 2


def test_outputs_are_of_one_axis_alone(tmp_path: Path) -> None:
    assert len(two(tmp_path, "")) == 2
    file = tmp_path / "two.toml"
    outputs = '[bus.outputs]\nready = "OUTPUTS.Ready"\n\n'
    file.write_text(file.read_text().replace("[bus.inputs]", f"{outputs}[bus.inputs]"))
    with pytest.raises(ConfigError, match="0x290 is OUTPUTS of axis a1 and OUTPUTS of axis a2"):
        load_axes(file)


# log, replay, and C


def test_a_log_of_all_of_it_replays_to_the_bit(tmp_path: Path) -> None:
    loaded = axis(brake=True)
    run = Run(loaded)
    run.armed()
    run.load(*steps(loaded, GO, {"do": "output", "output": "gripper", "on": True}, WAIT))
    press(run)
    run.until(lambda r: r.tick.progress.stage == 2)
    run.put("enable", False)
    run.until(state(State.FAULT))
    path = tmp_path / "station.mcap"
    writer = LogWriter(create_log(path), header_of(loaded))
    for record in run.records:
        writer.write(record)
    writer.close()
    found = replay(LogReader([path]))
    assert found.good and found.identical, found
    logged = list(read_log(path))
    assert [t.station for t in logged] == [r.tick.station for r in run.records]


def test_python_and_c_do_the_same() -> None:
    def ticks(how: Any) -> list[Any]:
        run = Run(axis(brake=True), how)
        run.armed(Request(RequestKind.ARM, (1.0,)))
        run.ticks(300)
        run.put("enable", False)
        return [r.tick for r in (*run.records, *run.ticks(200))]

    assert repr(ticks(INTERPRETED)) == repr(ticks(quick()))


def test_ticks_with_inputs_and_a_brake_are_computed_in_c() -> None:
    if quick() is INTERPRETED:
        pytest.skip("no C compiler here")
    left = compile_functions(FUNCTIONS, cache=cache_folder("compiled")).left
    run, before = Run(axis(brake=True)), left()
    run.armed(Request(RequestKind.ARM, (1.0,)))
    run.until(lambda r: hold(r) == Hold.RELEASED)
    run.ticks(300)
    asked = left()[0] - before[0]
    assert asked <= 0.02 * len(run.records), asked


# what cannot be


def change(**tables: Any) -> dict[str, Any]:
    return tables


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ({"io": {"start": "program"}}, "needs an input"),
        ({"brake": {}}, "brake: needs an output"),
        ({"bus": {"outputs": {"brake": "OUTPUTS.Brake"}}}, "is of a brake"),
        ({"bus": {"inputs": {"brake_released": "INPUTS.BrakeReleased"}}}, "is of a brake"),
        ({"bus": {"inputs": {"a-b": "INPUTS.Start"}}}, "letters, digits"),
        ({"bus": {"inputs": {"start": "INPUTS"}}}, "MESSAGE.SIGNAL"),
        ({"bus": {"inputs": {"start": 1.0}}}, "MESSAGE.SIGNAL"),
        ({"bus": {"inputs": {"start": {"signal": "A.B", "unit": "bar"}}}}, "on or off"),
        ({"bus": {"inputs": {"start": {"signal": "A.B", "values": {"0": 2}}}}}, "0 .off. and 1 .on."),
        (
            {"bus": {"outputs": {"lamp": {"signal": "A.B", "values": {"3": 1}}}}},
            "what 0 .off. and 1 .on. are",
        ),
        ({"bus": {"inputs": {f"i{n}": "A.B" for n in range(33)}}}, "32 are the most"),
        ({"bus": {"messages": {"INPUTS": {"counter": "Counter"}}}}, "messages goes with signals"),
        ({"plant": {"inputs": {"door": True}}}, "no input; there is none"),
        (
            {"bus": {"outputs": {"brake": "OUTPUTS.Brake"}}, "brake": {}, "reference": {"join": "at_once"}},
            "cannot wait",
        ),
        (
            {"bus": {"inputs": {"start": "A.B"}, "input_timeout_ms": 2.0}, "loop": {"rate_hz": 500.0}},
            "two ticks",
        ),
    ],
)
def test_what_a_configuration_cannot_say(tables: dict[str, Any], words: str) -> None:
    text = (resources.configs() / "virtual.toml").read_text()
    with pytest.raises(ConfigError, match=words):
        parse(changed_text(text, tables), "x.toml")


OWN = (
    'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: A\n'
    + (resources.configs() / "pneud.dbc").read_text().partition("VALVE_NODE\n\n")[2].partition("CM_ BO_")[0]
)
EXTRA = """
BO_ 2566844672 WIDE: 8 A
 SG_ Word : 7|16@0+ (1,0) [0|0] "" A
 SG_ Half : 16|4@1+ (0.5,0) [0|0] "" A
 SG_ Real : 32|32@1- (1,0) [0|0] "" A
 SG_ Minus : 24|4@1- (1,0) [0|0] "" A

BO_ 700 OUT: 2 A
 SG_ Bits : 0|8@1+ (1,0) [0|0] "" A
 SG_ Code : 8|8@1+ (1,0) [0|0] "" A

SIG_VALTYPE_ 2566844672 Real : 1;
"""


def codecs_of(**tables: Any) -> Codecs:
    bus = BusConfig.model_validate(tables)
    dbc = (OWN + EXTRA).replace("ENCODER_NODE,PRESSURE_NODE,VALVE_NODE", "A")
    return codecs_from(bus, Path("x.dbc"), dbc.encode())


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ({"inputs": {"a": "NONE.Word"}}, "message NONE: not in the database"),
        ({"inputs": {"a": "WIDE.None"}}, "signal None: not in the message"),
        ({"inputs": {"a": "WIDE.Half"}}, "integer with factor 1"),
        ({"inputs": {"a": "WIDE.Real"}}, "unsigned"),
        ({"inputs": {"a": "WIDE.Minus"}}, "unsigned"),
        ({"inputs": {"a": {"signal": "WIDE.Word", "mask": 65536}}}, "too wide for 16 bits"),
        (
            {"inputs": {"a": "WIDE.Word", "b": {"signal": "WIDE.Word", "mask": 1}}},
            "another's; give each its mask",
        ),
        ({"inputs": {"a": "ENCODER.Status"}}, "0x181 is encoder"),
        ({"inputs": {"a": "OUT.Bits"}, "outputs": {"b": "OUT.Code"}}, "0x2BC is OUT"),
    ],
)
def test_what_a_dbc_cannot_carry(tables: dict[str, Any], words: str) -> None:
    with pytest.raises(DatabaseError, match=words):
        codecs_of(**tables)


def test_masks_and_values_of_wide_messages_are_read_and_written() -> None:
    inputs = {
        "low": {"signal": "WIDE.Word", "mask": 1},
        "high": {"signal": "WIDE.Word", "mask": 0x8000},
        "broken": {"signal": "WIDE.Word", "mask": 6, "values": {"0": 1, "2": 0}},
    }
    outputs = {
        "a": {"signal": "OUT.Bits", "mask": 1},
        "b": {"signal": "OUT.Bits", "mask": 12},
        "c": {"signal": "OUT.Code", "values": {"7": 1, "9": 0}},
    }
    switching = codecs_of(inputs=inputs, outputs=outputs).switching
    assert switching is not None
    (heard,), (said,) = switching.inputs, switching.outputs
    assert heard.codec.can_id == 0x18FF0000 | CAN_EFF_FLAG or heard.codec.can_id & CAN_EFF_FLAG
    for raw, wanted in ((0, 4), (1, 5), (0x8000, 6), (2, 0), (4, 0)):
        assert heard.bits(raw.to_bytes(2, "big") + bytes(6)) == wanted
    for bits, data in ((0, b"\x00\x09"), (1, b"\x01\x09"), (2, b"\x0c\x09"), (4, b"\x00\x07")):
        assert said.encode(bits, 0) == data
        assert said.bits(data) == bits


def test_a_hearing_refuses_what_is_not_valid_and_keeps_what_was() -> None:
    switching = axis().codecs.switching
    assert switching is not None
    (message,) = switching.inputs
    hearing, can_id = Hearing(switching.inputs), message.codec.can_id
    assert hearing.heard(5).age_ns > 1 << 60
    hearing.take(Frame(100, can_id, message.encode(1, 7)))
    hearing.take(Frame(200, can_id, message.encode(2, 7)))  # the counter stands still
    hearing.take(Frame(300, can_id, b"\x00"))
    assert (hearing.heard(350)[:2], hearing.stale, hearing.crc) == ((1, 250), 1, 1)
    again = Hearing(switching.inputs)
    again.thaw(hearing.freeze())
    assert again.heard(350)[:2] == (1, 250)


def test_a_saying_is_due_on_change_and_after_its_period() -> None:
    switching = axis().codecs.switching
    assert switching is not None
    saying = Saying(switching.outputs, 20)
    times = [t for t in range(100) if saying.due(1 if t < 50 else 2, t)]
    assert times == [0, 20, 40, 50, 70, 90]


def test_what_is_said_of_outputs_is_counted() -> None:
    switching = axis().codecs.switching
    assert switching is not None
    (message,) = switching.outputs
    saying = Saying((message,), 1)
    said = [data for t in range(5) for _, data in saying.due(1, t)]
    assert said == [message.encode(1, number) for number in range(5)]
    assert len(set(said)) == 5


def test_a_node_forgets_outputs_that_nobody_sends() -> None:
    switching = axis().codecs.switching
    assert switching is not None
    (message,) = switching.outputs
    node = StationNode(switching, Board(timeout_s=1e-6))
    node.hear(Frame(100, message.codec.can_id, message.encode(3, 0)))
    node.hear(Frame(150, message.codec.can_id, b""))
    assert not node.is_clamped(1000)
    assert node.outputs == 3
    node.is_clamped(1101)
    assert node.outputs == 0


def test_check_says_what_nobody_tells() -> None:
    loaded = axis(brake=True)
    assert [one.name for one in unnoticed(devices_of(loaded.config, loaded.codecs))] == ["heartbeat_lost"]
    bus = {
        "dbc": "station.dbc",
        "inputs": {"enable": "INPUTS.Enable"},
        "outputs": {"brake": "OUTPUTS.Brake"},
    }
    blind = load("virtual.toml", change={"bus": bus, "brake": {}})
    found = {one.fault: one.wholly for one in unnoticed(devices_of(blind.config, blind.codecs))}
    assert (found[F.BRAKE_STUCK], found[F.INPUT_LOST]) == (True, False)
