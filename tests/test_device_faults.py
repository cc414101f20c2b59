"""The scenarios on other people's devices: what is noticed, what is not, and what is judged then."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from hil import device_faults
from hil.branching import simulated
from hil.device_sets import device_sets

from pneud import resources
from pneud.loading import load
from pneud.replay.lockstep import Simulation, backend_of
from pneud.replay.running import through
from pneud.safety.faults import F
from pneud.safety.unnoticed import Unnoticed
from pneud.scenario import verdict
from pneud.scenario.files import load_scenario
from pneud.scenario.format import Babble
from pneud.scenario.verdict import Observed, judge
from pneud.signals import State

EFFECTS: dict[str, Any] = {
    "onset": True, "speed_m_s": 0.1, "evidence_ms": 0.0, "centred_ms": 40.0, "ticks": 3, "onset_ticks": 3,
    "travel_mm": 90.0, "peak_bar": 4.0, "impact_m_s": 0.0, "engaged": True,
}  # fmt: skip
BLIND = (Unnoticed(F.ENCODER_FROZEN, "no counter"),)
SCENARIO = load_scenario("encoder-frozen")
CONFIG = load("virtual.toml").config


def of(*faults: F) -> int:
    return sum(1 << fault for fault in faults)


@pytest.mark.parametrize(
    ("seen", "change", "problem"),
    [
        (Observed(state=int(State.TRACKING), engaged=True), {}, ""),
        (Observed(0, of(F.ENCODER_STUCK), int(State.FAULT), True), {}, ""),
        (Observed(0, of(F.ENCODER_STUCK), int(State.HOLDING), True), {}, "ended holding, not in fault"),
        (Observed(state=int(State.WAITING)), {}, "ended waiting without a fault, not engaged"),
        (
            Observed(state=int(State.TRACKING), engaged=True),
            {"impact_m_s": 0.2},
            "met an end stop at 0.20 m/s, not 0.05",
        ),
    ],
)
def test_what_cannot_be_noticed_is_judged_by_what_is_safe(
    seen: Observed, change: dict[str, Any], problem: str
) -> None:
    found = judge(SCENARIO, CONFIG, seen, EFFECTS | change, BLIND)
    assert found["unnoticed"] == ["encoder_frozen"]
    assert found["problems"] == ([problem] if problem else [])
    said = verdict.in_words(found)
    assert ("encoder_frozen is not noticed here" in said) == (not problem)


def test_what_can_be_noticed_has_to_be() -> None:
    seen = Observed(0, of(F.ENCODER_STUCK), int(State.FAULT), True)
    assert "no encoder_frozen" in judge(SCENARIO, CONFIG, seen, EFFECTS)["problems"]


def test_what_is_said_to_be_impossible_must_not_be_noticed() -> None:
    seen = Observed(of(F.ENCODER_FROZEN), of(F.ENCODER_FROZEN), int(State.FAULT), True)
    found = judge(SCENARIO, CONFIG, seen, EFFECTS | {"travel_mm": 1.0}, BLIND)
    assert found["problems"] == ["noticed encoder_frozen, which is said to be impossible here"]
    hardly = tuple(one._replace(wholly=False) for one in BLIND)
    assert judge(SCENARIO, CONFIG, seen, EFFECTS | {"travel_mm": 1.0}, hardly)["met"]


def test_a_second_controller_has_the_identifiers_of_the_set(tmp_path: Path) -> None:
    one = device_sets()["extended"]
    axis = load(one.write(tmp_path, "extended"))
    for name, codec in (
        ("other-controller", axis.codecs.sync),
        ("other-commands", axis.codecs.valve_command),
    ):
        (fault,) = device_faults.adapted(load_scenario(name), "extended", axis).fault
        assert isinstance(fault, Babble)
        assert fault.can_id == codec.can_id and codec.valid(bytes.fromhex(fault.data))


def test_heartbeats_are_of_the_message_that_tells_the_position(tmp_path: Path) -> None:
    one = device_sets()["bare"]
    found = device_faults.ready("bare", one, load_scenario("heartbeat-lost"), tmp_path, {})
    assert isinstance(found, device_faults.Ready)
    assert found.axes[0].config.bus.messages["ENC"].heartbeat_timeout_ms == 200.0


def test_a_sample_has_enough_of_each() -> None:
    sets, scenarios = [f"set{n}" for n in range(28)], [f"scenario{n}" for n in range(83)]
    drawn = device_faults.dealt(sets, scenarios, 1)
    times = Counter(scenario for _, some in drawn for scenario in some)
    assert [name for name, _ in drawn] == sets
    assert all(len(set(some)) == len(some) >= device_faults.OF_SET for _, some in drawn)
    assert set(times) == set(scenarios)
    assert min(times.values()) >= device_faults.OF_SCENARIO
    assert sum(times.values()) <= 0.12 * len(sets) * len(scenarios)
    assert drawn == device_faults.dealt(sets, scenarios, 1) != device_faults.dealt(sets, scenarios, 2)


@pytest.mark.slow
def test_what_branches_off_comes_to_what_it_comes_to_alone() -> None:
    axis = load("virtual.toml")
    some = [load_scenario(name) for name in ("encoder-missing", "leak", "link-down", "moving", "queue-full")]
    some = [scenario.model_copy(update={"duration_s": 2.0}) for scenario in some]
    rate_hz, how, blind = axis.config.loop.rate_hz, backend_of(axis), verdict.blind_spots(axis)
    for scenario, branched in zip(some, simulated([axis], some), strict=True):
        run = Simulation(axis, scenario.duration_s, how=how, scenario=scenario)
        seen = through(run, rate_hz).seen
        assert run.engine is not None
        run.engine.settle()
        alone = judge(scenario, axis.config, seen, run.engine.effects.as_dict(), blind)
        assert alone["onset"]
        assert json.loads(json.dumps(alone)) == {k: v for k, v in branched.items() if k != "off_mm"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        *("all-there", "extended", "apart", "no-valve-status", "valve-on-or-off", "bare", "flexible"),
        *device_faults.WHOLE,
    ],
)
def test_the_campaign_finds_what_the_list_leaves(name: str) -> None:
    played = [
        *("encoder-missing", "encoder-frozen", "encoder-error", "pressure-frozen", "supply-lost"),
        *("valve-frozen", "valve-timed-out", "valve-disagrees", "valve-missing", "valve-failure"),
        *("valve-active", "other-commands"),
        *(() if name in device_faults.WHOLE else ("heartbeat-lost", "enable-cut", "link-down")),
    ]
    assert set(played) <= {path.stem for path in resources.scenarios().glob("*.toml")}
    for case in device_faults.of_set((name, played, "sim")):
        assert case["met"], case
        assert "left_out" not in case
