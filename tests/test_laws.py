"""Every law in every way of running: it tracks, compiled or not; gives way without a bump; replays."""

from __future__ import annotations

import math
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from axis_rig import ARM, Rig, ready, twin
from commands import object_of
from commands import pneud_here as pneud
from pneud.compiled.backend import INTERPRETED, compiled, sample
from pneud.config.conversions import axis_of
from pneud.config.models import Config
from pneud.config.reading import parse
from pneud.config.sections import ConfigError
from pneud.control.laws import adrc, pid
from pneud.control.laws.adrc import in_motion
from pneud.control.laws.open_loop import OpenLoop, at, delay_margin
from pneud.control.laws.slot import ADRC, IN_SLOT, PID, SLIDING, Slot
from pneud.control.reference import rest
from pneud.control.step import join, observe, situation, start
from pneud.control.tunables import LAWS, doubts, is_sound, is_stable, names_of, parted, tunables, tuned
from pneud.loading import Loaded, load
from pneud.log.files.naming import create_log
from pneud.log.files.reader import read_log
from pneud.log.files.writer import LogWriter
from pneud.log.format.header import LogHeader
from pneud.physics.valve import opening
from pneud.replay.lockstep import Simulation
from pneud.replay.replaying import replay
from pneud.safety.faults import FAULT_NAMES
from pneud.signals import REQUEST_VALUES, Answer, Request, RequestKind, State, Tick
from pneud.study.linear import designed, doubts_of

GAINS = RequestKind.GAINS
CHOSEN: dict[str, dict[str, Any]] = {
    "composite": {},
    "ismc": {"law": "ismc"},
    "pid": {"law": "pid"},
    "adrc": {"law": "adrc"},
    "adrc-encoder": {"law": "adrc", "adrc": {"observer_rad_s": 220.0}},
}
VALVE = ready().axis.parameters.controller.valve
PAIRS = [
    pytest.param(one, other, marks=[] if "composite" in (one, other) else [pytest.mark.slow])
    for one in CHOSEN
    for other in CHOSEN
    if one != other
]


@cache
def with_law(name: str) -> Loaded:
    return load("virtual.toml", None, {"control": CHOSEN[name]})


@cache
def values(name: str) -> tuple[float, ...]:
    here = with_law(name)
    return tunables(axis_of(here.config, here.codecs.command_lsb_v).controller)


def text_with(**tables: dict[str, Any]) -> str:
    text = load("virtual.toml").text
    for name, table in tables.items():
        text += "\n".join([f"\n[control.{name}]", *(f"{key} = {value}" for key, value in table.items())])
    return text + "\n"


def config_with(law: str, **gains: float) -> Config:
    text = text_with(**{law: gains}).replace('law = "composite"', f'law = "{law}"')
    return parse(text, "axis.toml")


@pytest.mark.parametrize("name", CHOSEN)
def test_each_law_tracks_and_is_disturbed_by_little(name: str) -> None:
    run = Simulation(with_law(name), 4.5, 1, compiled())
    errors = []
    for k, record in enumerate(run.records()):
        run.node.force_ext_n = 30.0 if k >= 3000 else 0.0
        if record.tick.state == State.TRACKING:
            errors.append(record.tick.reference.position_m - record.truth_m)
    error = np.array(errors[1500:])
    assert len(error) > 2500
    assert math.sqrt((error**2).mean()) < 0.2e-3
    assert np.abs(error).max() < 1.5e-3
    assert np.abs(error[-500:]).max() < 0.5e-3


@pytest.mark.parametrize("name", CHOSEN)
def test_each_law_is_the_same_compiled_to_the_last_bit(name: str) -> None:
    here = with_law(name)
    p = axis_of(here.config, here.codecs.command_lsb_v)
    assert sample(compiled(), p) == sample(INTERPRETED, p)
    runs = [Simulation(here, 1.0, 1, how) for how in (INTERPRETED, compiled())]
    assert [repr(r) for r in runs[0].records()] == [repr(r) for r in runs[1].records()]
    assert repr(runs[0].axis.freeze()) == repr(runs[1].axis.freeze())


@cache
def moving(name: str) -> Rig:
    """Tracking with a law, at speed."""
    rig = ready()
    assert rig.tick(GAINS, *values(name)).answer == Answer.TAKEN
    rig.tick(ARM, 1.0)
    rig.ticks(900)
    return rig


def largest_step(ticks: list[Tick]) -> float:
    """Of the opening that is asked of the valve; the way across its dead zone is none."""
    openings = [opening(t.command.voltage_v, VALVE) for t in ticks]
    return max(abs(b - a) for a, b in pairwise(openings))


@pytest.mark.parametrize(("one", "other"), PAIRS)
def test_laws_give_way_to_each_other_without_a_bump(one: str, other: str) -> None:
    rig = twin(moving(one))
    before = rig.ticks(100)
    undisturbed = twin(rig).tick()
    change = rig.tick(GAINS, *values(other))
    assert change.answer == Answer.TAKEN
    assert change.command.law_v == pytest.approx(undisturbed.command.law_v, abs=1e-9)
    begun = rig.axis.state.controller.blend  # type: ignore[union-attr]
    after = [change, *rig.ticks(400)]
    assert tunables(rig.axis.state.law) == values(other)
    assert {t.state for t in after} == {State.TRACKING}
    assert max(abs(t.reference.position_m - t.estimate.position_m) for t in after) < 0.2e-3
    by_itself = max(largest_step(before), largest_step(after[-100:]))
    assert largest_step([before[-1], *after[:20]]) <= 2.0 * by_itself
    assert abs(rig.axis.state.controller.blend) < 0.02 * abs(begun)  # type: ignore[union-attr]


def test_other_gains_of_the_same_law_leave_what_it_has_learnt() -> None:
    rig = twin(moving("adrc-encoder"))
    own = rig.axis.state.controller.own  # type: ignore[union-attr]
    law, k1, *others = values("adrc-encoder")
    assert rig.tick(GAINS, law, 0.9 * k1, *others).answer == Answer.TAKEN
    now = rig.axis.state.controller.own  # type: ignore[union-attr]
    assert now.adrc.f == pytest.approx(own.adrc.f, abs=2.0)
    assert now.adrc.f != 0.0


def test_an_observer_in_motion_begins_where_the_estimates_are() -> None:
    rig = twin(moving("composite"))
    rig.tick(GAINS, *values("adrc-encoder"))
    e, controller = rig.tick().estimate, rig.axis.state.controller
    assert controller is not None
    assert controller.own.adrc.x == pytest.approx(e.position_m, abs=2e-6)
    assert controller.own.adrc.v == pytest.approx(e.velocity_m_s, abs=2e-3)
    assert abs(controller.own.adrc.f) < 50.0


@pytest.mark.parametrize("u", [2.0, -2.0])
def test_an_observer_in_motion_is_carried_back_by_one_sample(u: float) -> None:
    here = with_law("adrc-encoder")
    p = axis_of(here.config, here.codecs.command_lsb_v).controller
    state = start(0.4, 3e5, 3e5, 6e5, p)
    state, e = observe(state, 0.4, True, 3e5, 3e5, 6e5, 0.0, p.h, p)
    e = e._replace(velocity_m_s=0.2, opening_v=u)
    state = join(state, e, rest(0.4), p)
    s = situation(state, e, rest(0.4), p)
    own = adrc.extend(in_motion(s), s, p.slot.adrc)
    assert own.x == pytest.approx(0.4, abs=1e-7)
    assert own.v == pytest.approx(0.2, abs=1e-4)


def test_a_log_with_changes_of_law_and_a_push_replays_from_anywhere(tmp_path: Path) -> None:
    here = load("virtual.toml", None, {"control": {"law": "pid"}})
    asked = {60: Request(ARM, (1.0,))}
    for k, name in enumerate(("adrc-encoder", "composite", "adrc", "ismc", "pid")):
        asked[900 + 150 * k] = Request(GAINS, values(name))
    asked[1700] = Request(GAINS, (*values("adrc"), 0.45, 0.03, 3.0))
    header = LogHeader(
        "virtual", "simulated", 1000.0, "full", here.path.name, here.text, here.dbc.name,
        here.dbc.read_bytes(), FAULT_NAMES, 0, {},
    )  # fmt: skip
    writer = LogWriter(create_log(tmp_path / "laws.mcap"), header)
    run = Simulation(here, 2.2, how=compiled(), requests=asked)
    answers = []
    for number, record in enumerate(run.records(), start=1):
        run.node.force_ext_n = 40.0 if 1000 <= number < 1600 else 0.0
        writer.write(record)
        if record.tick.request is not None:
            answers.append(record.tick.answer)
        if number % 250 == 0:
            writer.snapshot({"axis": run.axis.freeze(), "inbox": run.inbox.freeze()})
    writer.close()
    assert set(answers) == {Answer.TAKEN}
    log = read_log(tmp_path / "laws.mcap")
    for from_s in (0.0, 1.1, 1.9):
        outcome = replay(log, from_s=from_s)
        assert (outcome.identical, outcome.first) == (True, None)
        assert outcome.engaged_ticks > 200
    other = replay(log, load("virtual.toml", None, {"control": {"law": "adrc"}}).config)
    assert other.first is not None  # another law until the first change, and what follows from it
    page = tmp_path / "laws.html"
    assert pneud("report", tmp_path / "laws.mcap", "-o", page).returncode == 0
    assert page.stat().st_size > 10_000


@pytest.mark.parametrize("law", LAWS)
def test_values_of_each_law_fit_into_a_request_with_a_reference(law: str) -> None:
    code = float(LAWS.index(law))
    gains = (code, *map(float, range(1, len(names_of(law)))))
    assert len(gains) + 3 <= REQUEST_VALUES
    assert parted(gains) == (gains, ())
    assert parted((*gains, 0.5, 0.1, 2.0)) == (gains, (0.5, 0.1, 2.0))
    assert parted(gains[:-1]) is None


@pytest.mark.parametrize("found", [(), (6.0, 1.0), (-1.0,), (0.5,)])
def test_values_of_no_law_are_parted_into_nothing(found: tuple[float, ...]) -> None:
    assert parted(found) is None


@pytest.mark.parametrize("name", ["pid", "adrc", "adrc-encoder"])
def test_the_gains_that_a_law_has_by_itself_are_sound_and_stable(name: str) -> None:
    here = with_law(name)
    p = axis_of(here.config, here.codecs.command_lsb_v).controller
    assert is_sound(tunables(p))
    assert is_stable(tunables(p), p)
    assert tuned(tunables(p), p) == p
    assert doubts_of(here.config) == []


def other_values(law: str, **changes: float) -> tuple[float, ...]:
    names = [name.rpartition(".")[2] for name in names_of(law)]
    return tuple(changes.get(n, now) for n, now in zip(names, values(law), strict=True))


@pytest.mark.parametrize(
    "wanted",
    [
        other_values("pid", kp=0.0),
        other_values("pid", ki=-1.0),
        other_values("pid", force_max_n=math.inf),
        other_values("adrc", k2=-1.0),
        other_values("adrc", observer_rad_s=-1e300),
        values("pid")[:-1],
        (*values("pid"), 0.5),
        (*values("adrc"), 0.5, 0.1),
    ],
)
def test_values_that_are_none_are_malformed(wanted: tuple[float, ...]) -> None:
    rig = ready()
    assert rig.tick(GAINS, *wanted).answer == Answer.MALFORMED
    assert rig.axis.state.law.slot.kind == SLIDING


@pytest.mark.parametrize(
    "wanted",
    [
        other_values("pid", ki=1e6),  # not Hurwitz
        other_values("pid", kf=2500.0, kd=800.0, kp=1e5),  # faster than the samples
        other_values("pid", kp=1e300),
        other_values("adrc", k1=1e8),
        other_values("adrc", k1=2e9, k2=5e6, k3=4e3),
        other_values("adrc", k1=4e6, k2=3e5, k3=1500.0),  # than the delay
        other_values("adrc", k2=1e300),
        other_values("adrc", observer_rad_s=2500.0),
    ],
)
def test_gains_that_the_loop_cannot_have_are_unstable(wanted: tuple[float, ...]) -> None:
    rig = ready()
    assert rig.tick(GAINS, *wanted).answer == Answer.UNSTABLE
    assert rig.axis.state.law.slot.kind == SLIDING
    assert rig.axis.failure is None


def settles(loop: OpenLoop, delay_s: float) -> bool:
    """Whether the closed loop has come to rest after a while, the delay being a line of samples."""
    h = 2e-5
    order = len(loop.denominator) - 1
    a = np.array(loop.denominator[1:])
    b = np.concatenate([np.zeros(order - len(loop.numerator)), loop.numerator])
    state, waiting = np.zeros(order), [0.0] * max(1, round(delay_s / h))
    kick, last = 1.0, 0.0
    for k in range(60_000):
        y = float(b @ state)
        waiting.append(kick - y)
        u, kick = waiting.pop(0), 0.0
        state[1:], state[0] = state[1:] + h * state[:-1], state[0] + h * (u - float(a @ state))
        if abs(y) > 1e12:
            return False
        last = max(last, abs(y)) if k > 55_000 else 0.0
    return last < 1e-3


LOOPS = {
    "pid": pid.loop(pid.Pid(2540.0, 32000.0, 75.6, 202.0, 0.01, 0.0, 0.0)),
    "adrc": adrc.loop(adrc.Adrc(373000.0, 15600.0, 216.0, 0.02, 0.0)),
    "adrc-encoder": adrc.loop(adrc.Adrc(373000.0, 15600.0, 216.0, 0.02, 220.0)),
}


@pytest.mark.parametrize("name", LOOPS)
def test_delay_margin_is_where_the_loop_begins_to_grow(name: str) -> None:
    loop = LOOPS[name]
    margin = delay_margin(loop.numerator, loop.denominator)
    assert 1e-3 < margin < 1e-2
    assert settles(loop, 0.85 * margin)
    assert not settles(loop, 1.15 * margin)


def test_a_polynomial_at_a_frequency() -> None:
    assert at((2.0, 3.0, 5.0), 7.0) == (5.0 - 2.0 * 49.0, 21.0)


@given(st.floats(1.0, 200.0))
def test_the_rules_place_the_poles(omega: float) -> None:
    g = pid.Pid(**pid.rule(omega), reach_m=0.0, quiet_m=0.0, force_max_n=0.0)
    assert pid.loop(g).bandwidth_rad_s == pytest.approx(omega)
    w = g.kf / 4.0
    assert [1.0, g.kf, g.kf * g.kd, g.kf * g.kp, g.kf * g.ki] == pytest.approx(np.poly([-w] * 4).tolist())
    a = adrc.Adrc(**adrc.rule(omega), reach_m=0.0, observer_rad_s=0.0)
    assert [1.0, a.k3, a.k2, a.k1] == pytest.approx(np.poly([-omega] * 3).tolist())
    assert adrc.loop(a).hurwitz
    assert pid.loop(g).hurwitz


@given(kp=st.floats(1.0, 1e5), ki=st.floats(0.0, 1e6), kd=st.floats(1.0, 1e3), kf=st.floats(1.0, 1e3))
@settings(max_examples=200)
def test_hurwitz_is_what_the_poles_say(kp: float, ki: float, kd: float, kf: float) -> None:
    loop = pid.loop(pid.Pid(kp, ki, kd, kf, 0.01, 0.0, 0.0))
    largest = np.roots([1.0, *loop.numerator]).real.max()
    if abs(largest) > 1e-3:
        assert loop.hurwitz == (largest < 0.0)


def test_doubts_are_told_a_line_each() -> None:
    law = {entry.name: entry for entry in IN_SLOT}
    wild = adrc.Adrc(2e10, 1e8, 5e3, 0.02, 0.0)
    found = doubts(law["adrc"], wild, 1e-3, 3e-3)
    assert [line.partition(":")[0][:20] for line in found] == [
        "1000 Hz are few for ",
        "1000 Hz are few for ",
        "delay of 3.00 ms nee",
    ]
    assert doubts(law["pid"], pid.Pid(1e4, 1e9, 10.0, 100.0, 0.01, 0.0, 0.0), 1e-3, 3e-3) == [
        "not Hurwitz: needs kf·(kd·kp - ki) > kp²"
    ]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (text_with(pid={"kp": 0.0}), "control.pid.kp = 0.0"),
        (text_with(pid={"kq": 1.0}), "control.pid.kq: unknown key"),
        (text_with(pid={"ki": 1e7}), "control.pid: gains are not Hurwitz: needs kf·(kd·kp - ki) > kp²"),
        (text_with(adrc={"k1": 1e9}), "control.adrc: gains are not Hurwitz: needs k2·k3 > k1"),
        (text_with(adrc={"observer_rad_s": -1.0}), "control.adrc.observer_rad_s = -1.0"),
        (text_with().replace('law = "composite"', 'law = "lqr"'), "control.law = 'lqr'"),
    ],
)
def test_a_configuration_that_is_wrong_is_told_in_one_line(text: str, words: str) -> None:
    with pytest.raises(ConfigError) as e:
        parse(text, "axis.toml")
    assert words in str(e.value)
    assert "\n" not in str(e.value)


@pytest.mark.parametrize("law", ["pid", "adrc"])
def test_check_says_which_law_and_what_is_wrong_with_its_gains(law: str, tmp_path: Path) -> None:
    file = tmp_path / "axis.toml"
    file.write_text(load("virtual.toml").text.replace('law = "composite"', f'law = "{law}"'))
    done = pneud("check", file)
    assert f"law {law}, on auto" in done.stdout
    assert "warning" not in done.stdout
    file.write_text(file.read_text().replace("rate_hz = 1000.0", "rate_hz = 50.0"))
    assert "Hz are few for" in pneud("check", file).stdout


def test_without_prediction_the_margin_has_to_bear_the_whole_delay() -> None:
    fast = config_with("adrc", k1=2.0e6, k2=48000.0, k3=380.0)
    blind = fast.model_copy(update={"control": fast.control.model_copy(update={"predict": False})})
    assert doubts_of(fast) == []
    assert "delay of 3.30 ms needs a margin of 3.30 ms" in doubts_of(blind)[0]


@pytest.mark.parametrize(("law", "omega"), [("pid", 80.0), ("adrc", 72.0)])
def test_design_proposes_what_pneud_takes(law: str, omega: float, tmp_path: Path) -> None:
    done = object_of(pneud("design", "--law", law, "--bandwidth", omega, "--error-mm", 1, "--json"))
    assert done["ok"]
    assert done["warnings"] == []
    assert done["control"]["law"] == law
    assert done["control"][law]["reach_m"] == 0.01
    assert {"pid", "adrc"} & done["control"].keys() == {law}
    assert done["prediction"]["bandwidth_rad_s"] == pytest.approx(omega, rel=1e-3)
    head, rest_ = load("virtual.toml").text.split("[control]", 1)
    file = tmp_path / "axis.toml"
    file.write_text(head + done["toml"] + "\n[reference]" + rest_.split("[reference]", 1)[1])
    assert pneud("check", file).returncode == 0
    text = pneud("design", "--bandwidth", 50, "--error-mm", 1, file).stdout  # its own law
    assert f'law = "{law}"' in text
    assert "margin" in text
    too_fast = pneud("design", "--law", law, "--bandwidth", 900, "--error-mm", 1)
    assert too_fast.returncode == 0
    assert "# warning: " in too_fast.stdout


def test_design_goes_back_to_a_sliding_law_and_knows_no_others() -> None:
    done = object_of(pneud("design", "--law", "ismc", "--bandwidth", 70, "--error-mm", 1, "--json"))
    assert done["control"]["law"] == "ismc"
    refused = pneud("design", "--law", "lqr", "--bandwidth", 70, "--error-mm", 1)
    assert refused.returncode == 2
    assert refused.stderr.strip().endswith("--law lqr: none of composite, ismc, pid, adrc")


def test_a_design_is_of_the_bandwidth_and_rounded() -> None:
    entry = IN_SLOT[0]
    c = designed(load("virtual.toml").config, entry, 80.0, 1e-3)
    assert (c.control.law, c.control.pid.kp, c.control.pid.reach_m) == ("pid", 2540.0, 0.01)
    assert c.control.motion.bandwidth_rad_s == 360.0


def test_kinds_are_those_of_the_table() -> None:
    assert Slot().kind == SLIDING
    assert [entry.kind for entry in IN_SLOT] == [PID, ADRC]
    for entry in IN_SLOT:
        assert isinstance(getattr(Slot(), entry.name), entry.gains)
