"""Dead zone, friction and filters changed while the axis runs: refused, taken without a step, replayed."""

from __future__ import annotations

import json
import math
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from axis_rig import ARM, Rig, loaded, ready
from commands import pneud_here
from console_bench import bench
from pneud import resources
from pneud.config.conversions import axis_of, controller_of, model_of
from pneud.config.models import Config
from pneud.config.reading import parse, with_settings
from pneud.config.toml import changed_text
from pneud.console.protocol import ProtocolError
from pneud.console.tuning import MODEL, Tuning, believing, keys, settings_of, values_of
from pneud.control.adaptation import Learnt
from pneud.control.laws.slot import PID
from pneud.control.model import NAMES, Model, is_sound, remodelled
from pneud.control.standstill import CLOSED
from pneud.control.step import Controller, ControllerState, act, change
from pneud.control.tunables import tunables, tuned
from pneud.loading import load
from pneud.log.files.naming import create_log
from pneud.log.files.reader import read_log
from pneud.log.files.writer import LogWriter
from pneud.replay.lockstep import Simulation, backend_of, header_of
from pneud.replay.replaying import _Known, _Tuned, replay
from pneud.replay.running import through
from pneud.signals import Answer, Estimate, Reference, Request, RequestKind, State
from test_control_tuning import changed, states

GAINS, GOTO = RequestKind.GAINS, RequestKind.GOTO
CONFIG = loaded().config
P: Controller = axis_of(CONFIG, loaded().codecs.command_lsb_v).controller
NOW, BELIEVED = tunables(P), model_of(CONFIG)
OTHER = BELIEVED._replace(
    dead_zone_v=0.14, centre_v=0.01, coulomb_n=20.0, static_n=28.0, motion_rad_s=250.0, push_rad_s=400.0
)


def settings_for(m: Model) -> list[str]:
    return [s for name, value in zip(NAMES, m, strict=False) for s in settings_of(f"{name}={value!r}")]


def configured(m: Model) -> Config:
    """The configuration that says so in its file."""
    return with_settings(loaded().text, "x", settings_for(m))


@pytest.mark.parametrize("file", sorted(resources.configs().glob("*.toml")), ids=lambda path: path.stem)
def test_what_follows_from_the_numbers_is_what_follows_from_the_file(file: Path) -> None:
    c = load(file).config
    assert remodelled(model_of(c), controller_of(c)) == controller_of(c)


@pytest.mark.parametrize(
    "change_of",
    [
        {"dead_zone_v": 0.2, "centre_v": -0.05},
        {"hold_v": 0.0},
        {"coulomb_n": 10.0, "static_n": 11.0, "stribeck_m_s": 0.05, "viscous_n_s_m": 0.0},
        {"stiffness_n_m": 1e6, "damping_n_s_m": 10.0},
        {"coulomb_n": 0.0, "static_n": 0.0, "stiffness_n_m": 0.0},
        {"motion_rad_s": 200.0, "push_rad_s": 0.0},
        {"push_rad_s": 600.0, "push_beyond_m": 3e-6, "force_rate_rad_s": 50.0},
    ],
)
def test_a_changed_controller_is_that_of_the_next_start(change_of: dict[str, float]) -> None:
    wanted = BELIEVED._replace(**change_of)
    c = configured(wanted)
    assert model_of(c) == wanted
    assert remodelled(wanted, P) == controller_of(c)
    assert remodelled(BELIEVED, remodelled(wanted, P)) == P


@pytest.mark.parametrize(
    ("change_of", "answer"),
    [
        ({"dead_zone_v": -0.1}, Answer.MALFORMED),
        ({"hold_v": 1.01}, Answer.MALFORMED),
        ({"static_n": 10.0}, Answer.MALFORMED),  # below Coulomb's
        ({"stribeck_m_s": 0.0}, Answer.MALFORMED),
        ({"stiffness_n_m": 0.0}, Answer.MALFORMED),
        ({"motion_rad_s": 5001.0}, Answer.MALFORMED),
        ({"push_rad_s": 2.6 * BELIEVED.motion_rad_s}, Answer.MALFORMED),
        ({"push_rad_s": 0.9 * BELIEVED.motion_rad_s}, Answer.MALFORMED),
        ({"push_beyond_m": -1e-6}, Answer.MALFORMED),
        ({"creep": 0.5}, Answer.MALFORMED),
        ({"centre_v": 5.0}, Answer.MALFORMED),
        ({"viscous_n_s_m": math.nan}, Answer.MALFORMED),
        ({"dead_zone_v": 1.76}, Answer.UNSTABLE),
        ({"static_n": 2000.0}, Answer.UNSTABLE),
    ],
)
def test_what_no_axis_can_have_is_refused(change_of: dict[str, float], answer: Answer) -> None:
    rig = ready()
    assert rig.tick(GAINS, *NOW, *BELIEVED._replace(**change_of)).answer == answer
    assert rig.axis.state.law == P


def test_with_gains_and_a_reference_in_one_request_or_not_at_all() -> None:
    rig = ready()
    sine = (0.45, 0.03, 3.0)
    assert rig.tick(GAINS, *changed(k1=1e6), *sine, *OTHER).answer == Answer.UNSTABLE
    assert rig.tick(GAINS, *NOW, 0.45, 0.9, 3.0, *OTHER).answer == Answer.OUT_OF_TRAVEL
    assert rig.axis.state.law == P
    assert rig.tick(GAINS, *changed(k1=9e4), *sine, *OTHER).answer == Answer.TAKEN
    assert rig.axis.state.law == remodelled(OTHER, tuned(changed(k1=9e4), P))
    assert rig.axis.state.reference is not None
    assert rig.tick(GAINS, *NOW).answer == Answer.TAKEN  # gains alone leave the rest as it is
    assert rig.axis.state.law.friction == OTHER.friction


edges = st.builds(
    lambda zone, centre, hold, dry, rate, w: BELIEVED._replace(
        dead_zone_v=zone, centre_v=centre, hold_v=hold, coulomb_n=dry, static_n=1.3 * dry,
        force_rate_rad_s=rate, motion_rad_s=w, push_rad_s=1.5 * w, standstill=0.0,
    ),
    st.floats(0.11, 0.3), st.floats(-0.1, 0.1), st.floats(0.0, 0.1),
    st.floats(1.0, 60.0), st.floats(0.0, 500.0), st.floats(50.0, 500.0),
)  # fmt: skip


@pytest.mark.slow
@given(
    state=states, old=edges, new=edges, errors=st.tuples(*(st.floats(-x, x) for x in (5e-3, 0.2, 2.0, 50.0)))
)
@settings(max_examples=60, deadline=None)
def test_the_command_of_the_change_is_the_one_without_it(
    state: ControllerState, old: Model, new: Model, errors: tuple[float, ...]
) -> None:
    before, after = remodelled(old, P), remodelled(new, tuned(changed(k1=6e4, k3=80.0), P))
    m, o = state.motion, state.observer
    e = Estimate(m.x, m.v, m.F, m.x3, o.x_hat, o.d_hat, m.innovation, 0.0)
    r = Reference(m.x + errors[0], m.v + errors[1], errors[2], errors[3])
    _, usual = act(state, e, r, before)
    _, bumpless = act(change(state, e, r, before, after), e, r, after)
    valve, most = after.valve, P.valve.u_max_v
    usual_v, now_v = (max(-most, min(most, out.u_v)) for out in (usual, bumpless))
    # within the dead zone that is believed in from now on nothing flows: each place there is as good
    assume(abs(usual_v) < 0.9 * most)  # at its end a valve is open, wherever its centre is
    shut = abs(usual_v - valve.centre_v) <= valve.dead_zone_v + 2.0 * after.sliding.hold_v
    assert now_v == pytest.approx(usual_v, rel=1e-6, abs=2.0 * valve.dead_zone_v if shut else 1e-6)


def moving() -> Rig:
    rig = ready()
    rig.tick(ARM)
    rig.ticks(60)
    rig.tick(GOTO, 0.5, 0.1)
    return rig


@pytest.mark.parametrize(
    "wanted", [OTHER, BELIEVED._replace(dead_zone_v=0.05, coulomb_n=50.0, static_n=60.0)]
)
def test_while_tracking_it_changes_without_a_bump_and_goes_on(wanted: Model) -> None:
    rig = moving()
    ticks = rig.ticks(250)
    usual = max(abs(b.command.voltage_v - a.command.voltage_v) for a, b in pairwise(ticks))
    after = [ticks[-1], rig.tick(GAINS, *NOW, *wanted), *rig.ticks(200)]
    assert after[1].answer == Answer.TAKEN
    assert abs(after[1].command.voltage_v - after[0].command.voltage_v) <= usual
    assert {t.state for t in after} == {State.MOVING}
    assert max(abs(t.error_m) for t in after) <= 3e-3
    assert rig.axis.state.law == remodelled(wanted, P)


@pytest.mark.parametrize("inverts", [False, True])
def test_from_another_law_and_without_inverting_the_dead_zone(inverts: bool) -> None:
    rig = moving()
    rig.tick(GAINS, *tunables(P._replace(slot=P.slot._replace(kind=PID))))
    rig.ticks(150)
    state, e, r = rig.axis.state, rig.tick().estimate, rig.tick().reference
    assert state.controller is not None
    before = state.law._replace(sliding=state.law.sliding._replace(invert_dead_zone=inverts))
    after = remodelled(OTHER, tuned(NOW, before))
    _, usual = act(state.controller, e, r, before)
    _, bumpless = act(change(state.controller, e, r, before, after), e, r, after)
    assert bumpless.u_v == pytest.approx(usual.u_v, rel=1e-6)


def test_a_load_that_stands_stays_where_it_is() -> None:
    rig = moving()

    def stands() -> bool:
        controller = rig.axis.state.controller
        return controller is not None and controller.standstill.mode == CLOSED

    while not stands():
        rig.tick()
    stood_m = rig.node.truth().position_m
    rig.tick(GAINS, *NOW, *BELIEVED._replace(dead_zone_v=0.15, coulomb_n=30.0))
    rig.ticks(100)
    assert rig.node.truth().position_m == pytest.approx(stood_m, abs=2e-5)


@pytest.mark.parametrize("engaged", [False, True])
def test_what_was_learnt_of_what_is_set_is_forgotten(engaged: bool) -> None:
    rig = moving() if engaged else ready()
    learnt = Learnt(edge_plus_v=0.02, edge_minus_v=-0.01, flow=1.1, friction=1.2, stiffness=2.0, mass=1.1)

    def knows() -> Learnt:
        controller = rig.axis.state.controller
        assert controller is not None
        return controller.learnt

    state = rig.axis.state
    assert state.controller is not None
    rig.axis.state = state._replace(controller=state.controller._replace(learnt=learnt))
    rig.tick(GAINS, *NOW, *BELIEVED._replace(dead_zone_v=0.12))
    assert abs(knows().edge_plus_v) < 1e-3 > abs(knows().edge_minus_v)
    assert knows().friction == pytest.approx(1.2, rel=0.02)
    rig.tick(GAINS, *NOW, *BELIEVED._replace(dead_zone_v=0.12, viscous_n_s_m=50.0))
    assert knows().friction == pytest.approx(1.0, rel=0.02)
    assert knows().mass == pytest.approx(1.1, rel=0.02)


def tuned_run(path: Path, m: Model) -> Path:
    """A log in which it is tuned twice on the way."""
    here = load("virtual.toml")
    other = m._replace(hold_v=0.01, damping_n_s_m=2.0 * m.damping_n_s_m)
    requests = {
        60: Request(int(RequestKind.ARM), (1.0,)),
        400: Request(int(GAINS), (*NOW, *m)),
        600: Request(int(GAINS), (*changed(k1=9e4), 0.45, 0.03, 3.0, *other)),
        900: Request(int(RequestKind.SHUTDOWN)),
    }
    writer = LogWriter(create_log(path), header_of(here)._replace(detail="full"))
    tally, _ = through(Simulation(here, 0.9, how=backend_of(here), requests=requests), 1000.0, writer)
    assert not tally.ever_latched
    assert writer.close()
    return path


def test_a_run_that_is_tuned_replays_identical_also_from_its_middle(tmp_path: Path) -> None:
    path = tuned_run(tmp_path / "x.mcap", OTHER)
    asked = [t.request for t in read_log(path) if t.request is not None and t.request.kind == GAINS]
    assert [len(request.values) for request in asked] == [len(NOW) + 15, len(NOW) + 18]
    assert replay(read_log(path)).identical
    assert replay(read_log(path), from_s=0.7).identical


def test_what_if_another_value_leaves_what_was_tuned_in_the_run() -> None:
    c = with_settings(loaded().text, "x", ["control.friction.coulomb_n=20", "control.k1=90000"])
    own, here = _Known(P, BELIEVED), _Known(controller_of(c), model_of(c))
    tuned_in_it = BELIEVED._replace(dead_zone_v=0.14, hold_v=0.001)
    mixed = here.model._replace(dead_zone_v=0.14, hold_v=0.001)
    what_if = _Tuned(here, own)
    for sine in ((), (0.45, 0.03, 3.0)):
        asked = what_if.asked(Request(int(GAINS), (*NOW, *sine, *tuned_in_it)))
        assert asked == Request(int(GAINS), (*tunables(here.law), *sine, *mixed))
    assert what_if.asked(Request(int(GAINS), NOW)) == Request(int(GAINS), tunables(here.law))
    assert what_if.of(remodelled(tuned_in_it, P)) == remodelled(mixed, here.law)
    assert what_if.of(P) == here.law
    as_it_was = _Tuned(here, None)
    assert as_it_was.of(P) == P


@pytest.mark.slow
def test_replay_takes_the_names_of_tune(tmp_path: Path) -> None:
    path = tuned_run(tmp_path / "x.mcap", OTHER)
    by_name, by_key = (
        pneud_here("replay", path, "--json", "--set", setting).stdout
        for setting in ("friction.coulomb_n=30", "control.friction.coulomb_n=30")
    )
    assert by_name == by_key
    assert json.loads(by_name)["mismatches"] > 0
    doubtful = pneud_here("replay", path, "--set", "valve.dead_zone_v=1.0")
    assert "warning: valve.dead_zone_v: a dead zone of 1 of 5 V" in doubtful.stderr


def test_the_names_stand_for_the_numbers_in_their_order() -> None:
    values = values_of(CONFIG)
    assert tuple(values[name] for name in MODEL) == BELIEVED[: len(MODEL)]
    for name in MODEL:
        ((*_, last),) = keys(name)
        assert name.endswith(last)
    assert believing(CONFIG, values) == CONFIG
    none = believing(CONFIG, {**values, "motion.push_bandwidth_rad_s": 0.0})
    assert none.control.motion.push_bandwidth_rad_s is None
    assert settings_of("motion.push_bandwidth_rad_s=0.0") == ["control.motion.push_bandwidth_rad_s=none"]


def test_the_console_takes_them_and_says_what_they_were(tmp_path: Path) -> None:
    with bench(tmp_path) as b:
        client = b.connect()
        told = b.ask(client, "tune_get")["gains"]
        assert told["valve.dead_zone_v"] == BELIEVED.dead_zone_v
        wanted = {"valve.dead_zone_v": 0.14, "friction.coulomb_n": 30.0, "k1": 90000.0}
        changes = b.ask(client, "tune_set", gains=wanted)["changed"]
        assert changes == (
            f"k1 95000 → 90000, valve.dead_zone_v {BELIEVED.dead_zone_v:g} → 0.14,"
            f" friction.coulomb_n {BELIEVED.coulomb_n:g} → 30"
        )
        model = BELIEVED._replace(dead_zone_v=0.14, coulomb_n=30.0)
        assert b.requests == [Request(int(GAINS), (*changed(k1=9e4), *model))]
        b.ask(client, "tune_set", gains={"k1": 95000.0})
        assert b.requests[-1] == Request(int(GAINS), NOW)
        refused = b.ask(client, "tune_set", gains={"friction.coulomb_n": 300.0})["error"]
        assert refused["type"] == "invalid"
        assert "static_n must not lie below coulomb_n" in refused["message"]
        refused = b.ask(client, "tune_set", gains={"motion.push_bandwidth_rad_s": 1.0})["error"]
        assert "push_bandwidth_rad_s needs bandwidth_rad_s" in refused["message"]
        b.answer = lambda _: Answer.UNSTABLE
        refused = b.ask(client, "tune_set", gains={"valve.dead_zone_v": 2.0})["error"]
        assert refused["type"] == "unstable"
        assert b.ask(client, "tune_get")["gains"]["valve.dead_zone_v"] == 0.14


def test_reload_takes_them_but_no_edges_of_a_map() -> None:
    text = loaded().text
    tuning = Tuning(CONFIG, Path("x.toml"), text)
    tuning._in_file = changed_text(
        text, {"control": {"friction": {"coulomb_n": 30.0}}, "valve": {"dead_zone_v": 0.14}}
    )
    plan = tuning.reload()
    model = BELIEVED._replace(dead_zone_v=0.14, coulomb_n=30.0)
    assert plan.requests == (Request(int(GAINS), (*NOW, *model)),)
    assert plan.done is not None
    assert tuning.changed_on_disk()
    assert plan.done()["at_restart"] == []
    assert not tuning.changed_on_disk()
    places = [[-5.0, -1.0], [-0.2, 0.0], [0.3, 0.0], [5.0, 1.0]]
    tuning._in_file = changed_text(text, {"valve": {"map": places, "dead_zone_v": 0.25, "centre_v": None}})
    plan = tuning.reload()
    assert plan.done is not None
    assert set(plan.done()["at_restart"]) >= {"valve.map", "valve.dead_zone_v"}
    assert [r.values[len(NOW) :][:1] for r in plan.requests] == [(0.14,)]


def test_no_edge_of_a_map_is_tuned() -> None:
    places = [[-5.0, -1.0], [-0.2, 0.0], [0.3, 0.0], [5.0, 1.0]]
    valve = {"map": places, "dead_zone_v": 0.25, "centre_v": None}
    c = parse(changed_text(loaded().text, {"valve": valve}), "x")
    tuning = Tuning(c, Path("x.toml"), "")
    with pytest.raises(ProtocolError, match="dead_zone_v must be that of map"):
        tuning.set({"valve.dead_zone_v": 0.1})
    (request,) = tuning.set({"friction.coulomb_n": 30.0}).requests
    law = controller_of(c)
    assert is_sound(Model(*request.values[len(NOW) :]), law)
    assert not is_sound(model_of(c)._replace(centre_v=0.0), law)
