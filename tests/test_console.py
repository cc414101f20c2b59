"""The console: who may ask, what reaches the loop, and what nobody can do to it."""

from __future__ import annotations

import json
import os
import random
import re
import socket
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from console_bench import COMMANDS, LOOKS, PIECE, Bench, bench, message
from fuzzing import hostile, well_formed
from log_samples import noisy, tick_at
from pneud import crew, resources
from pneud.console import handoff, server
from pneud.console.commands import AxisDesk
from pneud.console.connected import BOUNDS
from pneud.console.lease import Lease
from pneud.console.line_stream import MAX_LINE
from pneud.console.memory import Memory
from pneud.console.peer import Peer, may_command
from pneud.console.protocol import VERBS, Error, ProtocolError, parse
from pneud.safety.faults import F
from pneud.signals import HUNTING_CURES, Answer, Hunting, Record, Request, RequestKind, State, Timing
from pneud.verbs.status import in_words


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Bench]:
    with bench(tmp_path) as b:
        yield b


# the lease


def test_one_commands_at_a_time_and_only_for_as_long_as_it_goes_on() -> None:
    lease: Lease[str] = Lease(2.0)
    assert lease.take("a", 0.0)
    assert not lease.take("b", 1.9)
    assert lease.take("a", 1.9)
    assert lease.holder(3.8) == "a"
    assert lease.left_s(3.8) == pytest.approx(0.1)
    assert lease.take("b", 3.9)
    assert lease.take("a", 4.0, by_force=True)
    lease.drop("b")
    assert lease.holder(5.0) == "a"
    lease.drop("a")
    assert (lease.holder(5.0), lease.left_s(5.0)) == (None, 0.0)


def test_a_second_client_is_told_who_commands(desk: Bench) -> None:
    one, two = desk.connect(), desk.connect()
    assert desk.ask(one, "goto", x_mm=100)["ok"]
    refusal = desk.ask(two, "goto", x_mm=200)
    assert refusal["error"]["type"] == "busy"
    assert refusal["error"]["pid"] == os.getpid()
    assert desk.ask(two, "status")["lease"] == {"uid": os.geteuid(), "pid": os.getpid(), "left_s": 2.0}
    desk.now_s += 2.1
    assert desk.ask(two, "goto", x_mm=200)["ok"]
    assert desk.error(one, "hold") == "busy"
    two.close()
    desk.turn()
    assert desk.ask(one, "hold")["ok"]
    assert [r.values[0] for r in desk.requests if r.kind == RequestKind.GOTO] == [0.1, 0.2]


@pytest.mark.parametrize("verb", ["stop", "disarm"])
def test_whoever_stops_needs_no_lease_and_takes_it(desk: Bench, verb: str) -> None:
    one, two = desk.connect(), desk.connect()
    assert desk.ask(one, "jog", velocity_mm_s=20)["ok"]
    assert desk.ask(two, verb)["ok"]
    assert desk.error(one, "jog", velocity_mm_s=20) == "busy"
    assert [r.kind for r in desk.requests] == [RequestKind.JOG, RequestKind[verb.upper()]]


def test_that_an_upload_is_half_done_is_kept_until_it_is_whole(desk: Bench) -> None:
    axis: Any = desk.server._desks[0]
    axis._memory = memory = Memory()
    client = desk.connect()
    desk.ask(client, "upload", first=True, last=False, pieces=[PIECE])
    assert memory.half_done == RequestKind.PIECE
    desk.ask(client, "upload", first=False, last=True, pieces=[PIECE])
    assert memory.half_done == 0


def remembering(desk: Bench) -> tuple[Memory, Any]:
    """The desk has a memory; and what makes the desk of the next console, which has the same."""
    axis: Any = desk.server._desks[0]
    memory = axis._memory = axis._tuning._memory = Memory()
    return memory, lambda: AxisDesk(axis._run, desk.ring, desk.watch, memory)


def test_gains_that_a_console_dies_over_are_put_back_by_the_next(desk: Bench) -> None:
    memory, another = remembering(desk)
    client = desk.connect()
    before = desk.ask(client, "tune_get")["gains"]
    assert desk.ask(client, "tune_set", gains={"k1": 90000.0})["ok"]
    assert memory.half_done == 0
    desk.answer = lambda _: None  # yet: they are on their way
    desk.tell(client, message("tune_set", gains={"k1": 80000.0, "reference.amplitude_m": 0.03}))
    assert desk.requests[-1].values[1] == 80000.0
    left = another().left_half_done()
    (back,) = left.requests
    assert (back.kind, back.values[1]) == (RequestKind.GAINS, 90000.0)
    assert before["reference.amplitude_m"] in back.values


def test_gains_of_which_nobody_knows_whether_they_were_taken_are_put_back(desk: Bench) -> None:
    client = desk.connect()
    desk.answer = lambda _: None
    desk.tell(client, message("tune_set", gains={"k1": 90000.0}))
    desk.now_s += 1.1
    desk.turn()
    (reply,) = desk.replies(client)
    assert reply["error"]["type"] == "silent"
    desk.answer = lambda _: Answer.TAKEN
    desk.turn()
    assert [request.values[1] for request in desk.requests] == [90000.0, 95000.0]
    assert desk.ask(client, "tune_get")["gains"]["k1"] == 95000.0


def test_the_next_console_knows_the_program(desk: Bench) -> None:
    _, another = remembering(desk)
    assert another().shares() == ()
    assert desk.ask(desk.connect(), "run", program={**PROGRAM, "name": "known"})["ok"]
    told = another()._of_program({"record": 1})
    assert (told["name"], told["of"], told["words"]) == ("known", 1, "wait 1 s")
    assert another().shares() == ("virtual",)


def test_a_run_that_could_not_begin_is_not_left_for(desk: Bench) -> None:
    axis: Any = desk.server._desks[0]
    axis._run = axis._run._replace(log_is_given=False, hindrance=lambda: "rig.toml: no such file")
    error = desk.ask(desk.connect(), "restart")["error"]
    assert (error["type"], error["message"]) == ("configuration", "restart: rig.toml: no such file")
    assert desk.requests == []


def test_what_the_loop_did_last_is_told_though_it_has_ended(desk: Bench) -> None:
    """A loop that begins anew is gone before a console that had no turn meanwhile has heard of it."""
    client = desk.connect()
    client.sendall(json.dumps(message("arm")).encode() + b"\n")
    for _ in range(3):
        desk.server.step(0.0)
    assert desk.loop.take() is not None
    desk.loop.answer(tick_at(1)._replace(answer=Answer.TAKEN))
    desk.server.close()
    desk.server.close = lambda: None  # type: ignore[method-assign]
    assert [reply["ok"] for reply in desk.replies(client)] == [True]


def test_no_file_is_read_for_a_restart_of_an_engaged_axis(desk: Bench) -> None:
    axis: Any = desk.server._desks[0]
    read: list[str] = []

    def hindrance() -> str:
        read.append("it")
        return ""

    axis._run = axis._run._replace(log_is_given=False, hindrance=hindrance)
    record = next(noisy(1))
    desk.ring.put(record._replace(tick=record.tick._replace(state=int(State.MOVING))))
    error = desk.ask(desk.connect(), "restart")["error"]
    assert (error["type"], error["message"]) == ("wrong_state", "restart: not while the axis is moving")
    assert (read, desk.requests) == ([], [])
    desk.ring.put(record._replace(tick=record.tick._replace(state=int(State.DISARMED))))
    assert desk.ask(desk.connect(), "restart")["ok"]
    assert read == ["it"]


def test_a_stop_goes_before_all_that_waits(desk: Bench) -> None:
    one, two = desk.connect(), desk.connect()
    desk.answer = lambda _: None
    desk.tell(one, message("upload", first=True, pieces=[PIECE] * 20), message("track", what="profile"))
    desk.answer = lambda _: Answer.TAKEN
    assert desk.tell(two, message("stop")) == []  # the piece under way has not been answered
    desk.loop.answer(tick_at(1)._replace(answer=Answer.TAKEN, state=int(State.HOLDING)))
    desk.turn()
    assert desk.replies(two)[0]["ok"]
    assert [r["error"]["type"] for r in desk.replies(one)] == ["displaced", "displaced"]
    assert [r.kind for r in desk.requests] == [RequestKind.PIECE, RequestKind.STOP, RequestKind.PIECE], (
        "what had been uploaded is undone, behind the stop"
    )


def test_a_jog_ends_when_its_client_has_gone(desk: Bench) -> None:
    one = desk.connect()
    desk.ask(one, "jog", velocity_mm_s=-20.0)
    one.close()
    desk.turn()
    assert desk.requests == [Request(RequestKind.JOG, (-0.02, 300.0)), Request(RequestKind.HOLD)]
    assert "has gone while jogging: hold → taken" in desk.said[-1]


@pytest.mark.parametrize(("verb", "what"), [("goto", {"x_mm": 100.0}), ("track", {"what": "profile"})])
def test_a_motion_that_is_attended_ends_when_its_client_has_gone(
    desk: Bench, verb: str, what: dict[str, Any]
) -> None:
    one, two = desk.connect(), desk.connect()
    desk.ask(one, verb, **what, attended=True)
    two.close()
    desk.turn()
    assert len(desk.requests) == 1
    one.close()
    desk.turn()
    assert [r.kind for r in desk.requests] == [RequestKind[verb.upper()], RequestKind.HOLD]
    assert "has gone while moving: hold → taken" in desk.said[-1]


@pytest.mark.parametrize("verb", ["arm", "stop"])
def test_of_what_a_client_has_asked_that_has_gone_only_stops_are_done(desk: Bench, verb: str) -> None:
    one = desk.connect()
    one.sendall(json.dumps(message(verb)).encode() + b"\n")
    one.close()  # the console stood still meanwhile, or was not there
    desk.turn()
    assert [r.kind for r in desk.requests] == ([RequestKind.STOP] if verb == "stop" else [])
    assert desk.said[0].endswith("stop → taken" if verb == "stop" else "arm → late")
    assert not desk.server._clients


@pytest.mark.parametrize("verb", ["arm", "upload", "stop"])
def test_who_goes_right_before_the_request_is_handed_over_is_not_served_but_for_stops(
    desk: Bench, monkeypatch: pytest.MonkeyPatch, verb: str
) -> None:
    one = desk.connect()

    def go() -> None:  # behind the last look at what has come
        if desk.server._jobs:
            one.close()

    monkeypatch.setattr(desk.server._files, "go_on", go)
    desk.tell_unheard(one, message(verb, **COMMANDS.get(verb, {})), *[message("status")] * 8)
    assert [r.kind for r in desk.requests] == ([RequestKind.STOP] if verb == "stop" else [])
    if verb != "stop":
        assert any(words.endswith("→ late") for words in desk.said)


def test_who_goes_between_two_parts_of_a_request_has_it_undone(desk: Bench) -> None:
    one = desk.connect()
    desk.answer = lambda request: None if request.values else Answer.TAKEN
    desk.tell(one, message("upload", first=True, pieces=[PIECE] * 3))
    desk.loop.answer(tick_at(1)._replace(answer=Answer.TAKEN, state=int(State.HOLDING)))
    one.close()
    desk.turn()
    assert [len(request.values) for request in desk.requests] == [0, 9, 0], "it is empty again"


def test_a_client_that_goes_in_peace_stops_nothing(desk: Bench) -> None:
    one = desk.connect()
    desk.ask(one, "jog", velocity_mm_s=20)
    desk.ask(one, "goto", x_mm=100)
    one.close()
    desk.turn()
    assert [r.kind for r in desk.requests] == [RequestKind.JOG, RequestKind.GOTO]


# who may


def test_root_the_daemons_user_and_the_group_may_command() -> None:
    assert may_command(Peer(1, 0, frozenset()), None)
    assert may_command(Peer(1, os.geteuid(), frozenset()), 77)
    assert may_command(Peer(1, 54321, frozenset((5, 77))), 77)
    assert not may_command(Peer(1, 54321, frozenset((5,))), 77)
    assert not may_command(Peer(1, 54321, frozenset((5,))), None)


def test_a_wrong_user_may_look_but_not_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "peer_of", lambda _: Peer(4711, 54321, frozenset((54321,))))
    with bench(tmp_path) as b:
        client = b.connect()
        for verb in VERBS:
            reply = b.ask(client, verb, **COMMANDS.get(verb, {}))
            assert reply["ok"] is (verb in LOOKS), verb
            assert reply["ok"] or reply["error"]["type"] == "read_only"
        assert b.requests == []
        assert any(words == "uid 54321 pid 4711: goto → read_only" for words in b.said)


def test_who_asked_to_observe_does_not_command_any_more(desk: Bench) -> None:
    client = desk.connect()
    assert desk.ask(client, "hold")["ok"]
    assert desk.ask(client, "observe")["ok"]
    assert desk.error(client, "hold") == "read_only"
    assert desk.ask(client, "status")["ok"]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become somebody else")
def test_the_kernel_says_who_asks() -> None:
    with tempfile.TemporaryDirectory() as folder, bench(Path(folder)) as b:
        Path(folder).chmod(0o755)
        b.path.chmod(0o666)
        child = os.fork()
        if not child:
            status = 1
            try:
                os.setgroups([])
                os.setresgid(65534, 65534, 65534)
                os.setresuid(65534, 65534, 65534)
                client = b.connect()
                client.settimeout(20)
                client.sendall(json.dumps(message("stop")).encode() + b"\n")
                status = b'"read_only"' not in client.recv(4096)
            finally:
                os._exit(status)
        while not (ended := os.waitpid(child, os.WNOHANG))[0]:
            b.turn()
        assert os.waitstatus_to_exitcode(ended[1]) == 0
        assert b.requests == []


# what reaches the loop


def test_requests_reach_the_loop_in_its_units_and_the_log_with_their_author(desk: Bench) -> None:
    client = desk.connect()
    asked: tuple[tuple[str, dict[str, Any]], ...] = (
        ("arm", {}),
        ("goto", {"x_mm": 120.0, "speed_mm_s": 50, "jerk_mm_s3": 4000}),
        ("jog", {"velocity_mm_s": -20, "lease_s": 0.2}),
        ("force", {"force_n": -50, "low_mm": 100, "high_mm": 300, "timeout_s": 2}),
        ("hold", {}),
        ("track", {"what": "reference"}),
        ("upload", {"first": True, "pieces": [PIECE]}),
        ("track", {"what": "profile"}),
        ("stop", {}),
        ("clear", {}),
        ("home", {}),
        ("mark", {"text": "oil\nchanged"}),
        ("disarm", {}),
    )
    for verb, fields in asked:
        reply = desk.ask(client, verb, **fields)
        assert (reply["ok"], reply["state"]) == (True, "holding"), reply
    kind = RequestKind
    assert desk.requests == [
        Request(kind.ARM),
        Request(kind.GOTO, (0.12, 0.05, 0.0, 4.0)),
        Request(kind.JOG, (-0.02, 200.0)),
        Request(kind.FORCE, (-50.0, 0.0, 0.1, 0.3, 0.0, 2.0)),
        Request(kind.HOLD),
        Request(kind.TRACK, (0.0,)),
        Request(kind.PIECE),
        Request(kind.PIECE, tuple(PIECE)),
        Request(kind.TRACK, (1.0,)),
        *(Request(k) for k in (kind.STOP, kind.CLEAR, kind.HOME, kind.MARK, kind.DISARM)),
    ]
    who = f"uid {os.geteuid()} pid {os.getpid()}: "
    assert desk.said[1] == who + "goto 120 mm speed 50 jerk 4000 → taken"
    assert desk.said[-2] == who + "mark oil?changed → taken"


@pytest.mark.parametrize(
    ("fields", "kind"),
    [
        ({"force_n": 1000}, "beyond_limits"),
        ({"force_n": -500}, "beyond_limits"),
        ({"force_n": 50, "speed_mm_s": 5000}, "beyond_limits"),
        ({"force_n": 50, "low_mm": 100}, "invalid"),
        ({"force_n": 50, "low_mm": 300, "high_mm": 100}, "out_of_travel"),
        ({"force_n": 50, "low_mm": 300, "high_mm": 2000}, "out_of_travel"),
    ],
)
def test_a_force_that_cannot_be_is_refused_by_the_console(
    desk: Bench, fields: dict[str, Any], kind: str
) -> None:
    assert desk.error(desk.connect(), "force", **fields) == kind
    assert desk.requests == []


def test_a_jog_that_is_only_renewed_is_one_command_in_the_log(desk: Bench) -> None:
    client = desk.connect()
    for _ in range(5):
        desk.ask(client, "jog", velocity_mm_s=10)
    desk.ask(client, "jog", velocity_mm_s=20)
    assert [words.partition(": ")[2] for words in desk.said] == ["jog 10 mm/s → taken", "jog 20 mm/s → taken"]
    assert len(desk.requests) == 6


@pytest.mark.parametrize(("x_mm", "nearest_mm"), [(-5, 21.0), (20.999, 21.0), (980, 979.0), (1e6, 979.0)])
def test_a_target_outside_the_travel_is_refused_with_the_nearest_allowed(
    desk: Bench, x_mm: float, nearest_mm: float
) -> None:
    error = desk.ask(desk.connect(), "goto", x_mm=x_mm)["error"]
    assert (error["type"], error["nearest_mm"]) == ("out_of_travel", nearest_mm)
    assert f"nearest allowed is {nearest_mm:g} mm" in error["message"]
    assert desk.requests == []


def test_faster_than_the_limits_is_refused(desk: Bench) -> None:
    client = desk.connect()
    assert desk.error(client, "jog", velocity_mm_s=-2001) == "beyond_limits"
    assert desk.error(client, "goto", x_mm=100, speed_mm_s=2001) == "beyond_limits"
    assert desk.requests == []


@pytest.mark.parametrize("answer", [a for a in Answer if a > Answer.TAKEN])
def test_every_refusal_of_the_axis_has_a_type_and_words(desk: Bench, answer: Answer) -> None:
    desk.answer = lambda _: answer
    desk.present = 1 << F.ENCODER_MISSING
    reply = desk.ask(desk.connect(), "clear")
    assert reply["error"]["type"] == answer.name.lower()
    assert reply["error"]["state"] == "holding"
    assert reply["error"]["message"].startswith("clear: ")
    if answer == Answer.BLOCKED:
        assert [f["name"] for f in reply["error"]["faults"]] == ["encoder_missing"]
        assert "check the node's power" in reply["error"]["message"]


@pytest.mark.parametrize("verb", ["jog", "tune_set", "upload"])
def test_a_value_that_nothing_can_have_is_told_in_words(desk: Bench, verb: str) -> None:
    desk.answer = lambda _: Answer.MALFORMED
    error = desk.ask(desk.connect(), verb, **COMMANDS[verb])["error"]
    assert error["type"] == "malformed"
    assert re.search(r": (a value is too small, |one of them does not meet )", error["message"])


@pytest.mark.parametrize(
    ("verb", "named"),
    [("arm", ["encoder_unreferenced", "moving"]), ("home", ["moving"]), ("hold", [])],
)
def test_only_faults_that_forbid_what_is_asked_are_named(desk: Bench, verb: str, named: list[str]) -> None:
    desk.answer = lambda _: Answer.BLOCKED
    desk.present = 1 << F.ENCODER_UNREFERENCED | 1 << F.MOVING
    error = desk.ask(desk.connect(), verb)["error"]
    assert [f["name"] for f in error["faults"]] == named


def test_a_refused_piece_ends_the_upload(desk: Bench) -> None:
    desk.answer = lambda r: Answer.MALFORMED if r.values[:1] == (0.7,) else Answer.TAKEN
    pieces = [PIECE, [0.7, *PIECE[1:]], PIECE]
    reply = desk.ask(desk.connect(), "upload", first=True, pieces=pieces)
    assert reply["error"]["type"] == "malformed"
    desk.turn()
    assert [r.values for r in desk.requests[3:]] == [()], "what was uploaded before it is gone"


def test_what_was_sent_behind_a_refused_piece_is_no_upload(desk: Bench) -> None:
    desk.answer = lambda r: Answer.MALFORMED if r.values[:1] == (0.7,) else Answer.TAKEN
    client, bad = desk.connect(), [0.7, *PIECE[1:]]
    desk.tell(
        client,
        message("upload", first=True, last=False, pieces=[PIECE]),
        message("upload", first=False, last=False, pieces=[bad]),
        message("upload", first=False, last=True, pieces=[PIECE]),
        message("track", what="profile"),
    )
    for _ in range(12):
        desk.turn()
    assert [r.values for r in desk.requests] == [(), tuple(PIECE), tuple(bad), (), (1.0,)]


@pytest.mark.parametrize("whose", ["nobody's", "its own, whole", "another's"])
def test_a_rest_without_its_beginning_is_refused_and_takes_nothing_away(desk: Bench, whose: str) -> None:
    client = desk.connect()
    if whose != "nobody's":
        assert desk.ask(client, "upload", first=True, last=whose != "another's", pieces=[PIECE])["ok"]
    if whose == "another's":
        desk.now_s += 100.0  # its lease is over
        client = desk.connect()
    before = len(desk.requests)
    reply = desk.ask(client, "upload", first=False, last=True, pieces=[PIECE])
    assert reply["error"] == {"type": "invalid", "message": "the upload has not begun, or was refused"}
    assert len(desk.requests) == before


def test_an_upload_whose_client_goes_leaves_nothing(desk: Bench) -> None:
    client = desk.connect()
    assert desk.ask(client, "upload", first=True, last=False, pieces=[PIECE])["ok"]
    client.close()
    desk.turn()
    desk.turn()
    assert [r.values for r in desk.requests] == [(), tuple(PIECE), ()]


PROGRAM = {"schema": 1, "record": [{"do": "wait", "for_s": 1.0}]}
HALVES: dict[str, tuple[Request, dict[str, Any]]] = {
    "upload": (Request(RequestKind.PIECE), {"first": True, "pieces": [PIECE]}),
    "run": (Request(RequestKind.RECORD, (1.0, 2.0)), {"program": PROGRAM}),
}


@pytest.mark.parametrize("verb", HALVES)
def test_what_is_handed_over_in_part_when_its_client_goes_is_undone(desk: Bench, verb: str) -> None:
    (first, fields), client = HALVES[verb], desk.connect()
    desk.answer = lambda _: None  # yet: the first part is on its way
    desk.tell(client, message(verb, **fields))
    client.close()
    desk.turn()
    desk.answer = lambda _: Answer.TAKEN
    desk.loop.answer(tick_at(1)._replace(answer=Answer.TAKEN, state=int(State.HOLDING)))
    desk.turn()
    assert desk.requests == [first, Request(first.kind)], "begun, and emptied"


def test_a_profile_is_not_followed_before_all_of_it_is_there(desk: Bench) -> None:
    client, other = desk.connect(), desk.connect()
    assert desk.ask(client, "upload", first=True, last=False, pieces=[PIECE])["ok"]
    assert desk.error(client, "track", what="profile") == "no_profile"
    desk.now_s += 100.0
    assert desk.error(other, "track", what="profile") == "no_profile"
    desk.now_s += 100.0
    assert desk.ask(client, "upload", first=False, pieces=[PIECE])["ok"]
    assert desk.ask(client, "track", what="profile")["ok"]


@pytest.mark.parametrize("verb", HALVES)
def test_what_was_refused_from_the_beginning_leaves_the_next_console_nothing_to_undo(
    desk: Bench, verb: str
) -> None:
    axis: Any = desk.server._desks[0]
    axis._memory = memory = Memory()
    client, fields = desk.connect(), HALVES[verb][1]
    assert desk.ask(client, "upload", first=True, last=False, pieces=[PIECE])["ok"]
    desk.answer = lambda _: Answer.WRONG_STATE
    assert desk.error(client, "run", program=PROGRAM) == "wrong_state"
    assert memory.half_done == RequestKind.PIECE
    desk.answer = lambda _: Answer.TAKEN
    assert desk.ask(client, "upload", first=False, pieces=[PIECE])["ok"]
    desk.answer = lambda _: Answer.WRONG_STATE
    assert desk.error(client, verb, **fields) == "wrong_state"
    assert memory.half_done == 0


@pytest.mark.parametrize("verb", HALVES)
def test_what_was_refused_from_the_beginning_takes_nothing_of_anothers_away(desk: Bench, verb: str) -> None:
    first, fields = HALVES[verb]
    desk.answer = lambda _: Answer.WRONG_STATE
    assert desk.error(desk.connect(), verb, **fields) == "wrong_state"
    desk.turn()
    assert desk.requests == [first]


def test_an_upload_that_is_left_for_a_program_is_undone(desk: Bench) -> None:
    client = desk.connect()
    desk.ask(client, "upload", first=True, last=False, pieces=[PIECE])
    desk.tell(client, message("run", program=PROGRAM))
    desk.turn()
    assert desk.requests[-1] == Request(RequestKind.PIECE)
    assert desk.error(client, "upload", first=False, last=True, pieces=[PIECE]) == "invalid"


def test_an_upload_of_several_messages_is_whole_with_its_last(desk: Bench) -> None:
    client = desk.connect()
    assert desk.ask(client, "upload", first=True, last=False, pieces=[PIECE])["ok"]
    assert desk.ask(client, "upload", first=False, last=True, pieces=[PIECE])["ok"]
    client.close()
    desk.turn()
    desk.turn()
    assert [r.values for r in desk.requests] == [(), tuple(PIECE), tuple(PIECE)]


def test_every_reply_and_refusal_names_its_axis(desk: Bench) -> None:
    client = desk.connect()
    for verb, fields in (("status", {}), ("hold", {}), ("goto", {"x_mm": -5.0}), ("nonsense", {})):
        assert desk.ask(client, verb, **fields)["axis"] == "virtual"


def test_a_silent_loop_is_reported_and_what_it_missed_does_not_happen_later(desk: Bench) -> None:
    client = desk.connect()
    client.sendall(json.dumps(message("goto", x_mm=100)).encode() + b"\n")
    for _ in range(3):
        desk.server.step(0.0)
    desk.now_s += 1.1
    desk.server.step(0.0)
    assert desk.replies(client)[0]["error"]["type"] == "silent"
    time.sleep(handoff.LATE_NS * 1e-9)
    desk.turn()
    assert desk.requests == []
    assert desk.ask(client, "goto", x_mm=200)["ok"]
    assert [r.values[0] for r in desk.requests] == [0.2]


def test_a_disk_that_stalls_holds_up_nobody(tmp_path: Path) -> None:
    file = tmp_path / "axis.toml"
    text = (resources.configs() / "virtual.toml").read_text()
    file.write_text(text)
    with bench(tmp_path, config=file, slow_files=True) as b:
        looking, commanding = b.connect(), b.connect()

        def send(client: socket.socket, verb: str) -> None:
            client.sendall(json.dumps(message(verb)).encode() + b"\n")
            b.turn()

        def comes(client: socket.socket) -> dict[str, Any]:
            deadline = time.monotonic() + 10.0
            while not (found := b.replies(client)):
                assert time.monotonic() < deadline, "no reply"
                b.turn(1, 0.01)
            (reply,) = found
            return reply

        send(looking, "status")
        assert comes(looking)["config_changed"] is False
        file.unlink()
        os.mkfifo(file)
        assert b.tell(looking, message("status")) == b.tell(commanding, message("tune_reload")) == []
        assert b.ask(commanding, "stop")["ok"]
        b.now_s += 0.25
        assert comes(looking)["config_changed"] is False, "as far as is known"
        assert b.tell(commanding, message("tune_get"))[0]["ok"]
        b.now_s += 3.0
        error = comes(commanding)["error"]
        assert error["type"] == "configuration"
        assert "cannot be read within 3 s; nothing has been taken" in error["message"]
        file.write_text(text.replace("k1 = 95000.0", "k1 = 91000.0"))  # whoever reads goes on
        file.unlink()
        file.write_text(text.replace("k1 = 95000.0", "k1 = 90000.0"))
        send(looking, "status")
        assert comes(looking)["config_changed"] is True
        send(commanding, "tune_reload")
        assert comes(commanding)["changed"] == "k1 95000 → 90000"


def test_a_signal_asks_without_a_client_and_every_refusal_is_told(tmp_path: Path) -> None:
    file = tmp_path / "axis.toml"
    text = (resources.configs() / "virtual.toml").read_text()
    file.write_text(text)
    told: list[str] = []

    def hang_up(text: str) -> list[str]:
        """What is told to who sent the signal."""
        file.write_text(text)
        told.clear()
        b.server.ask(
            parse(json.dumps(message("tune_reload")).encode()), "SIGHUP", lambda e: told.append(str(e))
        )
        b.turn()
        return told

    with bench(tmp_path, config=file) as b:
        assert hang_up(text.replace('detail = "compact"', 'detail = "full"')) == []
        assert (
            b.said[-1] == "SIGHUP: tune from the file: nothing to change (at the next start only: log.detail)"
        )
        wide = text.replace("amplitude_m = 0.05", "amplitude_m = 0.4")
        b.answer = lambda _: Answer.OUT_OF_TRAVEL
        words = "tune from the file: reference.amplitude_m 0.05 → 0.4"
        assert hang_up(wide) == [f"{words}: the way leaves the travel 20 … 980 mm"]
        assert b.said[-1] == f"SIGHUP: {words} → out_of_travel"
        b.answer = lambda _: Answer.TAKEN
        assert hang_up(wide) == []
        assert b.said[-1] == f"SIGHUP: {words} → taken"
        (other,) = hang_up(wide.replace("travel_max_m = 0.98", "travel_max_m = 0.97"))
        assert "limits.travel_max_m changed, and limits change at a restart only" in other
        (beyond,) = hang_up(text.replace("amplitude_m = 0.05", "amplitude_m = 0.6"))
        assert "beyond limits.travel" in beyond
        assert b.ask(b.connect(), "tune_get")["gains"]["reference.amplitude_m"] == 0.4
    assert len(b.requests) == 2


def test_late_requests_are_turned_away_but_for_stops() -> None:
    ours, loops = crew.pair()
    loop = handoff.LoopEnd(loops, late_ns=-1)
    assert handoff.send(ours, 7, Request(RequestKind.GOTO, (0.1, 0.0, 0.0, 0.0)))
    assert handoff.send(ours, 8, Request(RequestKind.STOP))
    assert loop.take() is None
    assert handoff.receive(ours) == (7, handoff.LATE, 0, 0, 0)
    assert loop.take() == Request(RequestKind.STOP)
    ours.close()
    assert loop.take() is None
    loop.answer(tick_at(1))
    assert loop.take() is None
    loop.close()


def test_what_a_console_has_asked_that_is_gone_is_turned_away_but_for_stops() -> None:
    ours, loops = crew.pair()
    gone = 0
    loop = handoff.SharedEnd(loops, consoles_gone=lambda: gone)
    for console, kind in ((0, RequestKind.HOME), (0, RequestKind.STOP), (1, RequestKind.HOME)):
        assert handoff.send(ours, 7 + console, Request(kind), console)
    gone = 1
    assert loop.take_all() == {}
    assert handoff.receive(ours) == (7, handoff.LATE, 0, 0, 0)
    assert loop.take_all() == {0: Request(RequestKind.STOP)}
    assert loop.take_all() == {0: Request(RequestKind.HOME)}
    gone, _ = 257, handoff.send(ours, 9, Request(RequestKind.HOME), 257)
    assert loop.take() == Request(RequestKind.HOME)
    ours.close()
    loop.close()


def test_without_a_loop_the_console_is_over(desk: Bench) -> None:
    desk.loop_socket.close()
    desk.server.step(0.0)
    assert desk.server.over


# status


def test_status_has_what_an_operator_needs(desk: Bench) -> None:
    client = desk.connect()
    empty = desk.ask(client, "status")
    assert (empty["state"], empty["position_mm"], empty["lateness_us"]) == ("starting", None, None)
    bits = (1 << F.ENCODER_MISSING) | 1 << F.MOVING
    for n in range(4):
        tick = tick_at(n * 1_000_000)._replace(
            state=int(State.FAULT), present=bits, latched=1 << F.ENCODER_MISSING
        )
        desk.ring.put(Record(tick, Timing(21_000, 1, 1, 1, 84_000, 1), (), 0, (), 0.0))
    desk.watch.poll()
    desk.watch.poll()
    found = desk.ask(client, "status")
    assert (found["state"], found["ticks"], found["skipped"], found["schema"]) == ("fault", 4, 0, 1)
    assert found["lateness_us"] == {"p50": 21.0, "p99": 21.0, "p999": 21.0, "max": 21.0}
    assert [(f["name"], f["latched"], f["present"]) for f in found["faults"]] == [
        ("encoder_missing", True, True),
        ("moving", False, True),
    ]
    assert found["faults"][1]["cure"] == "wait until it stands still"
    assert found["position_mm"] == pytest.approx(1e3 * tick.estimate.position_m, abs=1e-6)
    assert found["log"] == "/tmp/x.mcap"
    assert found["silent_s"] > 1.0  # the last record is from long ago
    assert found["config_changed"] is False


def test_status_tells_how_the_load_stands_at_its_target(desk: Bench) -> None:
    client = desk.connect()
    assert not desk.ask(client, "status")["in_position"]
    for n, (in_position, hunting) in enumerate(((1, 0), (0, int(Hunting.VALVE)))):
        tick = tick_at(n)._replace(in_position=in_position, hunting=hunting)
        desk.ring.put(Record(tick, Timing(21_000, 1, 1, 1, 84_000, 1), (), 0, (), 0.0))
        found = desk.ask(client, "status")
        assert found["in_position"] == bool(in_position)
        words = "\n".join(in_words(found))
        assert (", in position" in words, "hunting (valve): check valve.bandwidth_hz" in words) == (
            bool(in_position),
            bool(hunting),
        )
    assert found["hunting"] == {"cause": "valve", "cure": HUNTING_CURES[Hunting.VALVE]}


def test_the_journal_has_a_line_when_the_log_is_lost_and_when_it_goes_on(
    desk: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    told = []
    for n, bits in enumerate((0, F.MOVING, F.DISK_FULL, F.DISK_FULL, 0, F.RECORDER_LOST, F.RECORDER_LOST)):
        tick = tick_at(n * 1_000_000)._replace(present=1 << bits if bits else 0)
        desk.ring.put(Record(tick, Timing(21_000, 1, 1, 1, 84_000, 1), (), 0, (), 0.0))
        desk.watch.poll()
        told.append(capsys.readouterr().err)
    full, over, lost = told.pop(2), told.pop(3), told.pop(3)
    assert full.startswith("pneud: disk_full: the log's disk or its quota is full")
    assert full.endswith("; make room on the disk; it is logged again from then on\n")
    assert over == "pneud: disk_full is over: the log goes on\n"
    assert lost.startswith("pneud: recorder_lost: the recorder process is gone")
    assert told == [""] * 4


# hostility


def test_bytes_may_come_in_any_pieces(desk: Bench) -> None:
    client = desk.connect()
    for byte in json.dumps(message("hold")).encode() + b"\r\n\n \n":
        client.sendall(bytes((byte,)))
        desk.turn(1)
    desk.turn()
    assert [r["ok"] for r in desk.replies(client)] == [True]


@pytest.mark.parametrize("line", [b"[1]", b"7", b"null"])
def test_what_is_no_object_is_no_request(line: bytes) -> None:
    with pytest.raises(ProtocolError, match=r"^a request is one JSON object$"):
        parse(line)


def test_a_line_that_is_too_long_ends_the_connection(desk: Bench) -> None:
    client = desk.connect()
    replies = []
    for _ in range(4):
        client.sendall(b"x" * (MAX_LINE // 2))
        desk.turn()
        replies += desk.replies(client)
        if replies:
            break
    assert [r["error"]["type"] for r in replies] == ["too_long"]
    with pytest.raises(BrokenPipeError):
        client.sendall(b"x")
    assert desk.ask(desk.connect(), "status")["ok"]


def test_a_flood_is_slowed_down_and_keeps_nobody_else_waiting(desk: Bench) -> None:
    flooder, other = desk.connect(), desk.connect()
    flooder.sendall(b"rubbish\n" * 1000)
    desk.turn(70)
    assert len(desk.replies(flooder)) == BOUNDS.burst
    assert desk.ask(other, "stop")["ok"]
    desk.now_s += 1.0
    desk.turn(40)
    assert len(desk.replies(flooder)) == BOUNDS.rate_hz


@pytest.mark.parametrize("line", [message("status"), message("tune_get"), "rubbish"])
def test_however_many_ask_for_whatever_they_like_a_stop_waits_for_a_few_lines_of_each(
    desk: Bench, line: dict[str, Any] | str
) -> None:
    flooders, other = [desk.connect() for _ in range(20)], desk.connect()
    desk.turn()
    for one in flooders:
        one.sendall(b"\n".join([json.dumps(line).encode()] * 100) + b"\n")
    other.sendall(json.dumps(message("stop")).encode() + b"\n")
    desk.turn(2)
    assert [request.kind for request in desk.requests] == [RequestKind.STOP]
    assert sum(len(desk.replies(one)) for one in flooders) <= 2 * 4 * len(flooders)
    for _ in range(20):
        desk.turn(10)
    assert all(desk.replies(one) for one in flooders), "and they are served, too"


def test_a_turn_does_not_wait_where_a_client_has_sent_more_than_was_taken(
    desk: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    client, selector, waits = desk.connect(), desk.server._selector, list[float]()
    select = selector.select

    def watched(timeout: float | None = None) -> list[Any]:
        found = select(0.0)
        waits.extend([timeout] if timeout and not found else [])
        return found

    monkeypatch.setattr(selector, "select", watched)
    client.sendall(b"".join(json.dumps(message("status")).encode() + b"\n" for _ in range(30)))
    replies = 0
    while replies < 30:
        desk.server.step(1.0)
        replies += len(desk.replies(client))
        assert waits == []
    desk.server.step(1.0)
    desk.server.step(1.0)
    assert waits, "it does, with nothing to do"


def test_who_does_not_read_is_dropped(desk: Bench) -> None:
    deaf = desk.connect()
    line = json.dumps(message("status")).encode() + b"\n"
    for _ in range(400):
        try:
            deaf.send(line)
        except OSError:
            break
        desk.now_s += 0.02
        desk.server.step(0.0)
    assert all(len(c.unsent) <= BOUNDS.unsent_bytes for c in desk.server._clients)
    assert desk.ask(desk.connect(), "status")["ok"]
    desk.now_s += 6.0
    desk.turn()
    assert any("does not read" in words for words in desk.said)
    assert len(desk.server._clients) == 1


def test_a_hundred_clients_displace_the_idle_ones_but_not_the_one_that_commands(desk: Bench) -> None:
    commander = desk.connect()
    assert desk.ask(commander, "hold")["ok"]
    crowd = []
    for _ in range(100):
        desk.now_s += 0.001
        crowd.append(desk.connect())
        desk.turn(1)
    assert desk.ask(commander, "hold")["ok"]
    assert desk.ask(crowd[-1], "status")["ok"]
    assert desk.replies(crowd[0])[0]["error"]["type"] == "displaced"
    assert len(desk.server._clients) == BOUNDS.clients


def test_mistakes_are_logged_once_a_second_with_their_number(desk: Bench) -> None:
    client = desk.connect()
    desk.tell(client, b"rubbish\n" * 50)
    desk.turn(10)
    assert len(desk.said) == 1
    desk.now_s += 1.1
    desk.turn(1)
    assert len(desk.said) == 2
    assert desk.said[1].endswith("refused 49 more")


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)
FIELDS = st.sampled_from(
    ["x_mm", "velocity_mm_s", "lease_s", "what", "pieces", "first", "gains", "text", "speed_mm_s", "v", "id"]
)
ALMOST = st.builds(
    lambda verb, more: {"v": 1, "id": 1, "verb": verb, **more},
    st.sampled_from([verb for verb in VERBS if verb not in LOOKS]) | st.text(max_size=5),
    st.dictionaries(FIELDS, JSON, min_size=1, max_size=3),
)
HOSTILE = (
    st.binary(max_size=60)
    | st.builds(lambda v: json.dumps(v).encode(), JSON | ALMOST)
    | st.builds(lambda v, cut: json.dumps(v).encode()[:cut], ALMOST, st.integers(0, 60))
    | st.sampled_from(
        [b"[" * 20_000, b"\xff\xfe{}", b'{"v":1,"id":1,"verb":"\\ud800"}', b"\0" * 100, b"{" * 99]
    )
)


@settings(deadline=None, max_examples=60)
@given(st.lists(HOSTILE, min_size=1, max_size=8))
def test_whatever_comes_nothing_malformed_reaches_the_loop(lines: list[bytes]) -> None:
    with tempfile.TemporaryDirectory() as folder, bench(Path(folder)) as b:
        client = b.connect()
        sent = b"\n".join(lines) + b"\n"
        replies = b.tell(client, sent)
        good = [line for line in sent.split(b"\n") if well_formed(line)]
        assert len(b.requests) <= sum(len(line) for line in good)
        assert bool(b.requests) <= bool(good)
        assert all(isinstance(r["ok"], bool) and (r["ok"] or r["error"]["message"]) for r in replies)
        assert b.ask(b.connect(), "status")["ok"]


@pytest.mark.slow
def test_a_hundred_thousand_hostile_messages_ask_nothing_of_the_loop(tmp_path: Path) -> None:
    dice = random.Random(1)
    with bench(tmp_path, BOUNDS._replace(rate_hz=1e9, burst=1e9)) as b:
        client, sent, answered, wellformed = b.connect(), 0, 0, 0
        while sent < 100_000:
            lines = [hostile(dice) for _ in range(50)]
            wellformed += sum(well_formed(part) for line in lines for part in line.split(b"\n"))
            b.now_s += 0.01
            replies = b.tell(client, b"\n".join(lines) + b"\n")
            b.turn(50)  # of which each takes a few lines
            replies += b.replies(client)
            assert all(r["ok"] is False for r in replies if r["id"] is None)
            sent += len(lines)
            answered += len(replies)
        assert b.error(b.connect(), "goto", x_mm=1e5) == "out_of_travel"
        assert answered > 0.9 * sent
        assert len(b.requests) <= wellformed
        assert len(b.said) < 0.1 * sent + wellformed


# the document


def test_the_documented_conversation_takes_place(desk: Bench) -> None:
    text = (Path(__file__).parent.parent / "docs" / "protocol.md").read_text()
    (block,) = (b for b in text.split("```")[1::2] if "\n> " in b)
    client = desk.connect()
    seen = set()
    for asked, expected in zip(*(iter(block.strip().splitlines()),) * 2, strict=True):
        assert (asked[:2], expected[:2]) == ("> ", "< ")
        (reply,) = desk.tell(client, asked[2:].encode() + b"\n")
        wanted = json.loads(expected[2:])
        if not wanted["ok"]:
            assert wanted.pop("error").items() <= reply["error"].items()
        assert wanted.items() <= reply.items()
        if asked.startswith("> {"):
            seen.add(json.loads(asked[2:])["verb"])
    assert seen == set(VERBS)
    documented = set(re.findall(r"`(\w+)`", text[text.index("| error |") : text.index("Up to 32 clients")]))
    kinds = {e.value for e in Error} | {a.name.lower() for a in Answer if a > Answer.TAKEN}
    assert documented == kinds
