"""One console for several axes: who is meant, what is asked in one tick, and that all do it or none."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from console_bench import COMMANDS, at_once
from log_samples import tick_at
from pneud import crew
from pneud.console import handoff
from pneud.console.beside import Beside
from pneud.console.commands import AxisDesk
from pneud.console.facts import RunFacts
from pneud.console.protocol import VERBS, Error, ProtocolError, parse
from pneud.console.server import Server
from pneud.console.status_reply import StatusWatch
from pneud.console.together import meant
from pneud.control.reference import Bounds, move, rest
from pneud.control.together import alike
from pneud.loading import load_axes
from pneud.log.live.ring import Ring
from pneud.loop.company import Asking, Company
from pneud.safety.faults import F
from pneud.signals import (
    Answer,
    Progress,
    Record,
    Reference,
    Request,
    RequestKind,
    Stage,
    State,
    Tick,
    Timing,
)

NAMES = ("x", "y")
ALL = {"stop", "disarm", "arm", "clear", "hold", "mark", "restart"}  # where no axis is named
TIMING = Timing(0, 0, 0, 0, 0, 0)


class Bench:
    """The console, its client and the loop's end, in one thread."""

    def __init__(self, folder: Path) -> None:
        path = folder / "s"
        listener = socket.socket(socket.AF_UNIX)
        listener.bind(str(path))
        listener.listen(4)
        ours, loops = crew.pair()
        self.asking = Asking(handoff.SharedEnd(loops), len(NAMES))
        self.rings = [Ring.create(slots=64) for _ in NAMES]
        desks = [
            AxisDesk(
                RunFacts(axis.config, axis.path, axis.text, "bus", "", f"/tmp/{axis.config.name}.mcap"),
                ring,
                StatusWatch(ring),
            )
            for axis, ring in zip(load_axes("two-axes.toml"), self.rings, strict=True)
        ]
        self.said: list[str] = []
        self.server = Server(
            listener,
            ours,
            desks,
            lambda _, words: self.said.append(words),
            files=Beside(lambda: None, lambda: 0.0, at_once),
            name="two",
        )
        self.client = socket.socket(socket.AF_UNIX)
        self.client.connect(str(path))
        self.client.settimeout(0.0)
        self.ticks = [tick(State.DISARMED) for _ in NAMES]
        self.taken: list[dict[str, Request]] = []  # by tick
        self.refuses: dict[str, tuple[Answer, int]] = {}  # in the tick itself

    def stands(self, *at_m: float) -> None:
        """Both hold, where they are said to."""
        for n, x in enumerate(at_m):
            reference = Reference(x, 0.0, 0.0, 0.0)
            self.ticks[n] = tick(State.HOLDING)._replace(reference=reference)
            self.rings[n].put(Record(self.ticks[n], TIMING, (), 0, (), x))

    def loop(self) -> None:
        """One tick of the loop."""
        self.asking.look(self.ticks)
        asked = {name: end.take() for name, end in zip(NAMES, self.asking.ends, strict=True)}
        self.taken += [found] if (found := {n: r for n, r in asked.items() if r is not None}) else []
        for n, (name, end) in enumerate(zip(NAMES, self.asking.ends, strict=True)):
            if asked[name] is not None:
                answer, present = self.refuses.get(name, (Answer.TAKEN, 0))
                end.answer(self.ticks[n]._replace(answer=int(answer), present=present))

    def ask(self, verb: str, **fields: Any) -> dict[str, Any]:
        (reply,) = self.say(verb, **fields)
        return reply

    def say(self, verb: str, **fields: Any) -> list[dict[str, Any]]:
        self.client.sendall(json.dumps({"v": 1, "id": 1, "verb": verb, **fields}).encode() + b"\n")
        return self.turns()

    def turns(self) -> list[dict[str, Any]]:
        """What the client is told in some turns of the server."""
        for _ in range(6):
            self.server.step(0.0)
            self.loop()
        try:
            lines = self.client.recv(1 << 20).splitlines()
        except BlockingIOError:
            return []
        return [json.loads(line) for line in lines]


class Unarmed:
    """A lane that the run itself is still to arm."""

    touched, told, waits = 0, None, False

    def __init__(self, now: Tick) -> None:
        self.turn: Any = SimpleNamespace(tick=now)


def test_axes_that_are_asked_together_do_not_arm_by_themselves_meanwhile() -> None:
    ours, loops = crew.pair()
    asking = Asking(handoff.SharedEnd(loops), len(NAMES))
    lanes: list[Any] = [Unarmed(tick(State.DISARMED)) for _ in NAMES]
    company = Company(lanes, [axis.config for axis in load_axes("two-axes.toml")], asking)
    assert company.look()
    company.after()
    handoff.send_all(ours, 1, dict.fromkeys((0, 1), Request(RequestKind.RESTART)))
    assert not company.look(), "one might arm, and the other one end"
    for end in asking.ends:
        end.take()
        end.answer(lanes[0].turn.tick._replace(answer=int(Answer.TAKEN)))
    assert company.look()
    ours.close()


def tick(state: State, present: int = 0) -> Tick:
    return tick_at(1)._replace(state=int(state), present=present, answer=0)


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Bench]:
    b = Bench(tmp_path)
    yield b
    b.client.close()
    b.server.close()


def test_what_could_move_something_has_to_name_it(desk: Bench) -> None:
    desk.stands(0.4, 0.4)
    for verb in sorted(set(VERBS) - ALL - {"status", "observe", "goto_all"}):
        reply = desk.ask(verb, **COMMANDS.get(verb, {}))
        assert reply["error"]["message"] == f"{verb} names no axis; give one of x, y"
    assert desk.taken == []


@pytest.mark.parametrize("verb", sorted(ALL - {"restart", "arm"}))
def test_what_ends_a_motion_is_for_all(desk: Bench, verb: str) -> None:
    desk.stands(0.4, 0.4)
    reply = desk.ask(verb, **COMMANDS.get(verb, {}))
    assert reply["axes"] == ["x", "y"]
    kind = RequestKind[verb.upper()]
    assert desk.taken == [{"x": Request(kind), "y": Request(kind)}]


def test_a_stop_is_for_all_whatever_it_names(desk: Bench) -> None:
    desk.stands(0.4, 0.4)
    for name in ("y", "nobody"):
        assert desk.ask("stop", axis=name)["axes"] == ["x", "y"]
        assert desk.taken.pop() == dict.fromkeys(NAMES, Request(RequestKind.STOP))
    desk.refuses["x"] = (Answer.WRONG_STATE, 0)  # nothing to stop there
    assert desk.ask("stop")["ok"]


def test_a_named_axis_is_the_only_one_that_is_asked(desk: Bench) -> None:
    desk.stands(0.4, 0.4)
    reply = desk.ask("goto", axis="y", x_mm=300)
    assert (reply["axis"], "axes" in reply) == ("y", False)
    assert [list(found) for found in desk.taken] == [["y"]]
    assert any(words.endswith("y: goto 300 mm → taken") for words in desk.said)
    assert desk.ask("status", axis="y")["order"]["words"] == "goto 300 mm"
    assert desk.ask("status", axis="x")["order"] is None
    assert desk.ask("status", axis="x")["others"] == {"y": "holding"}
    reply = desk.ask("status")
    assert (reply["schema"], reply["name"]) == (1, "two")
    found = reply["axes"]
    assert {name: one["name"] for name, one in found.items()} == {"x": "x", "y": "y"}
    assert desk.ask("goto", axis="z", x_mm=300)["error"]["message"] == "no axis 'z'; there is x, y"


def test_all_arm_in_one_tick(desk: Bench) -> None:
    assert desk.ask("arm")["axes"] == ["x", "y"]
    assert desk.taken == [dict.fromkeys(NAMES, Request(RequestKind.ARM))]


def test_none_arms_where_one_cannot_and_it_is_named_with_its_faults(desk: Bench) -> None:
    desk.ticks[1] = tick(State.DISARMED, 1 << F.SUPPLY_PRESSURE)
    reply = desk.ask("arm")
    assert reply["axis"] == "y"
    assert [fault["name"] for fault in reply["error"]["faults"]] == ["supply_pressure"]
    assert desk.taken == []


def test_all_arm_without_a_movement_test_only_where_that_is_asked_for(desk: Bench) -> None:
    desk.ticks[1] = tick(State.DISARMED, 1 << F.UNPROVEN)
    assert [fault["name"] for fault in desk.ask("arm")["error"]["faults"]] == ["unproven"]
    assert desk.taken == []
    assert desk.ask("arm", unproven=True)["ok"]
    desk.ticks[1] = tick(State.DISARMED, 1 << F.UNPROVEN | 1 << F.SUPPLY_PRESSURE)
    assert not desk.ask("arm", unproven=True)["ok"]


def test_who_has_armed_is_centred_where_another_refuses_only_then(desk: Bench) -> None:
    desk.refuses["y"] = (Answer.BLOCKED, 1 << F.SUPPLY_PRESSURE)
    reply = desk.ask("arm")
    assert (reply["ok"], reply["axis"]) == (False, "y")
    arm, centre = Request(RequestKind.ARM), Request(RequestKind.CENTRE)
    assert desk.taken == [{"x": arm, "y": arm}, {"x": centre}]


def test_a_gantry_is_armed_by_either_half_and_led_by_the_one_that_leads() -> None:
    halves: Any = [SimpleNamespace(name="x1", carried_by=""), SimpleNamespace(name="x2", carried_by="x1")]

    def whose(verb: str, axis: str, **fields: Any) -> tuple[int, ...]:
        return meant(
            halves, parse(json.dumps({"v": 1, "id": 1, "verb": verb, "axis": axis, **fields}).encode())
        )

    assert whose("arm", "x1") == whose("arm", "x2") == (0, 1)
    assert whose("goto", "x1", x_mm=100) == (0,)
    with pytest.raises(ProtocolError, match="goto: x2 is carried with x1, as a gantry; ask x1") as refused:
        whose("goto", "x2", x_mm=100)
    assert (refused.value.kind, refused.value.more) == (Error.INVALID, {"axis": "x2"})


def test_going_together_is_one_law_of_time(desk: Bench) -> None:
    desk.stands(0.4, 0.4)
    assert desk.ask("goto_all", axes={"x": 500, "y": 350})["axes"] == ["x", "y"]
    ((x, y),) = ([r.values for r in found.values()] for found in desk.taken)
    assert (x[0], y[0]) == pytest.approx((0.5, 0.35))
    assert y[1:] == pytest.approx([0.5 * bound for bound in x[1:]])


@pytest.mark.parametrize(
    ("axes", "kind", "says"),
    [
        ({"x": 500, "z": 1}, "invalid", "no axis 'z'; there is x, y"),
        ({"x": 500, "y": 5000}, "out_of_travel", "5000 mm lies outside the travel"),
    ],
)
def test_all_go_or_none(desk: Bench, axes: dict[str, float], kind: str, says: str) -> None:
    desk.stands(0.4, 0.4)
    error = desk.ask("goto_all", axes=axes)["error"]
    assert error["type"] == kind
    assert says in error["message"]
    assert desk.taken == []


def test_who_does_not_hold_keeps_all_from_going(desk: Bench) -> None:
    desk.stands(0.4)
    reply = desk.ask("goto_all", axes={"x": 500, "y": 300})
    assert (reply["axis"], reply["error"]["type"]) == ("y", "wrong_state")
    desk.stands(0.4, 0.4)
    desk.refuses["y"] = (Answer.BEYOND_LIMITS, 0)
    assert desk.ask("goto_all", axes={"x": 500, "y": 300})["axis"] == "y"
    assert desk.taken[-1] == {"x": Request(RequestKind.HOLD)}


def test_what_all_go_through_is_handed_over_as_theirs_and_goes_on_with_all(desk: Bench) -> None:
    desk.stands(0.4, 0.4)
    tree = {"schema": 1, "record": [{"do": "wait", "for_s": 1.0}]}
    assert desk.ask("run", program=tree)["records"] == 1
    first, step, begun = desk.taken
    assert first == dict.fromkeys(NAMES, Request(RequestKind.RECORD, (1.0, 1.0)))
    assert begun == dict.fromkeys(NAMES, Request(RequestKind.RUN, (1.0, 1.0, 1.0)))
    error = desk.ask("run", axis="x")["error"]
    assert "x and y go through their program together: leave out the axis" in error["message"]
    assert desk.taken == [first, step, begun]


def test_what_one_has_left_for_another_program_is_not_gone_on_with_by_all(desk: Bench) -> None:
    desk.stands(0.4, 0.4)
    tree = {"schema": 1, "record": [{"do": "wait", "for_s": 1.0}]}
    for fields in ({}, {"axis": "x"}):
        assert desk.ask("run", program=tree, **fields)["ok"]
    before = list(desk.taken)
    assert "run names no axis" in desk.ask("run")["error"]["message"]
    assert desk.taken == before


def test_where_one_goes_through_a_program_no_other_loses_its_own(desk: Bench) -> None:
    desk.stands(0.4, 0.4)
    desk.ticks[0] = desk.ticks[0]._replace(program=Progress(1, 0, int(Stage.UNDER_WAY), 0))
    error = desk.ask("run", program={"schema": 1, "record": [{"do": "wait", "for_s": 1.0}]})["error"]
    assert (error["type"], desk.taken) == ("wrong_state", [])


def going(desk: Bench, name: str, x: float) -> None:
    n = NAMES.index(name)
    desk.ticks[n] = tick(State.MOVING)._replace(reference=Reference(x, 0.1, 0.0, 0.0))
    desk.rings[n].put(Record(desk.ticks[n], TIMING, (), 0, (), x))


def test_who_moves_comes_to_rest_before_all_set_out(desk: Bench) -> None:
    desk.stands(0.4, 0.4)
    going(desk, "y", 0.39)
    assert desk.say("goto_all", axes={"x": 500, "y": 350}) == []
    assert desk.taken == [{"y": Request(RequestKind.HOLD)}]
    desk.stands(0.4, 0.38)
    (reply,) = desk.turns()
    assert (reply["ok"], reply["axes"]) == (True, ["x", "y"])
    assert {name: r.kind for name, r in desk.taken[-1].items()} == dict.fromkeys(NAMES, RequestKind.GOTO)
    assert desk.taken[-1]["y"].values[1] == pytest.approx(0.3 * desk.taken[-1]["x"].values[1])


@pytest.mark.parametrize(("verb", "fields"), [("stop", {}), ("goto", {"axis": "x", "x_mm": 300})])
def test_another_command_comes_before_what_waits_for_axes_to_stand(
    desk: Bench, verb: str, fields: dict[str, Any]
) -> None:
    desk.stands(0.4, 0.4)
    going(desk, "y", 0.39)
    desk.say("goto_all", axes={"x": 500, "y": 350})
    replies = desk.say(verb, **fields)
    assert [reply["ok"] for reply in replies] == [False, True]
    assert replies[0]["error"]["type"] == "displaced"
    desk.stands(0.4, 0.38)
    assert desk.turns() == []
    assert RequestKind.GOTO not in {r.kind for r in desk.taken[0].values()}


def test_who_does_not_come_to_rest_is_named(desk: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pneud.console.setting_out.PATIENCE_S", 0.0)
    desk.stands(0.4, 0.4)
    going(desk, "y", 0.39)
    replies = [*desk.say("goto_all", axes={"x": 500, "y": 350}), *desk.turns()]
    assert [reply["error"]["message"] for reply in replies] == ["goto: y has not come to rest within 0 s"]


def test_who_has_gone_sets_nothing_out(desk: Bench) -> None:
    desk.stands(0.4, 0.4)
    going(desk, "y", 0.39)
    desk.say("goto_all", axes={"x": 500, "y": 350})
    desk.client.close()
    desk.server.step(0.0)
    desk.stands(0.4, 0.38)
    for _ in range(6):
        desk.server.step(0.0)
        desk.loop()
    assert desk.taken == [{"y": Request(RequestKind.HOLD)}]


LENGTHS = st.floats(1e-6, 2.0)
BOUNDS = st.builds(Bounds, st.floats(0.01, 3.0), st.floats(0.1, 30.0), st.floats(1.0, 1000.0))


@given(st.lists(st.tuples(LENGTHS, BOUNDS), min_size=2, max_size=5))
def test_moves_that_are_alike_take_the_same_time_within_the_limits_of_all(
    ways: list[tuple[float, Bounds]],
) -> None:
    found = alike([way_m for way_m, _ in ways], [b for _, b in ways])
    assert all(
        one <= most
        for kept, (_, b) in zip(found, ways, strict=True)
        for one, most in zip(kept, b, strict=True)
    )
    moves = [move(rest(0.0), way_m, kept) for (way_m, _), kept in zip(ways, found, strict=True)]
    if any(bound <= 1.001e-6 for kept in found for bound in kept):
        return  # with so little, whoever has hardly any way is there before
    assert [one.T for one in moves] == pytest.approx([moves[0].T] * len(moves), rel=1e-6)
    alone = max(move(rest(0.0), way_m, b).T for way_m, b in ways)
    assert alone * (1.0 - 1e-6) <= moves[0].T


def test_who_is_there_already_waits_for_nobody() -> None:
    b = Bounds(0.5, 5.0, 100.0)
    assert alike([0.3, 0.0], [b, b])[0] == b
    assert alike([0.0, 0.0], [b, b]) == [b, b]
