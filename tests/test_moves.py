"""Moves in simulated time: asked for in turn, measured, and replayed."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from axis_rig import quick
from pneud.compiled.backend import INTERPRETED
from pneud.config.conversions import cylinder_of
from pneud.config.sections import ConfigError
from pneud.control.reference import rest
from pneud.loading import load
from pneud.log.files.reader import LogReader
from pneud.replay import following
from pneud.replay.following import Following
from pneud.replay.lockstep import Simulation
from pneud.replay.moves import Course, Move, MovesError, Push, in_words, moves_of, steps_of
from pneud.signals import (
    Answer,
    Record,
    Request,
    RequestKind,
    State,
)
from pneud.verbs import VerbError
from pneud.verbs.replay import replay
from pneud.verbs.sim import sim


def test_a_text_is_a_list_of_moves_in_millimetres() -> None:
    assert moves_of("100,250@300,-1.5") == [Move(0.1), Move(0.25, 0.3), Move(-0.0015)]


def test_forces_stand_among_the_moves() -> None:
    assert steps_of("100,200N,-50.5N@1000") == [Move(0.1), Push(200.0), Push(-50.5, 1000.0)]
    for text in ("N", "200N1", "200N@", "200N@-1", "200N@1@2", "nanN"):
        with pytest.raises(MovesError, match=r"a force is NN or NN@N_S|a move is"):
            steps_of(text)


def test_a_force_is_pressed_until_it_has_been_there_for_a_while() -> None:
    loaded = load("virtual.toml", change={"plant": {"contact": {"position_m": 0.44, "stiffness_n_m": 3e4}}})
    rod_n = cylinder_of(loaded.config).rod_force_n
    course = Course(steps_of("438,150N,435"), rod_n)
    run = Simulation(loaded, 9.0, how=quick(), operator=course.ask)
    for record in run.records():
        course.see(record)
    assert course.good
    pressed = course.results[1]
    assert pressed["at_n"] == pytest.approx(150.0, abs=2.0)
    assert 440.0 < pressed["at_mm"] < 446.0
    assert "force 150 N: reached after" in in_words(course.results)
    assert "force 9 N: not reached" in in_words([{"to_n": 9.0, "reached_s": None, "at_n": None}])


@pytest.mark.parametrize("text", ["", "x", "1,", "1@2@3", "1@0", "1@-3", "nan", "inf", "1@inf", "1;2"])
def test_no_list_of_moves(text: str) -> None:
    with pytest.raises(MovesError) as e:
        moves_of(text)
    assert e.value.exit_code == 2
    assert "\n" not in str(e.value)


@pytest.fixture(scope="module")
def template() -> Record:
    run = Simulation(load("virtual.toml"), 0.01, how=INTERPRETED)
    return list(run.records())[-1]


def ticked(template: Record, t_s: float, state: State, **changes: object) -> Record:
    truth_m = changes.pop("truth_m", template.truth_m)
    changes = {"request": None, "latched": 0, **changes}
    tick = template.tick._replace(t_ns=round(t_s * 1e9), state=int(state), **changes)  # type: ignore[arg-type]
    return template._replace(tick=tick, truth_m=truth_m)  # type: ignore[arg-type]


def armed(moves: str) -> Course:
    course = Course(moves_of(moves))
    assert course.ask(State.WAITING, 0) is None
    assert course.ask(State.DISARMED, 0) == Request(RequestKind.ARM)
    return course


def test_the_next_move_waits_until_the_load_has_been_there_for_a_while(template: Record) -> None:
    course = armed("100,50")
    first = course.ask(State.HOLDING, 0)
    assert first == Request(RequestKind.GOTO, (0.1, 0.0))
    taken = {"request": first, "answer": int(Answer.TAKEN)}
    course.see(ticked(template, 1.0, State.MOVING, truth_m=0.02, **taken))
    course.see(ticked(template, 1.5, State.MOVING, truth_m=0.103))
    assert course.ask(State.HOLDING, 0) is None
    for i in range(6):
        course.see(ticked(template, 2.0 + 0.1 * i, State.HOLDING, truth_m=0.0999, in_position=1))
        assert (course.ask(State.HOLDING, 0) is None) == (i < 5)
    assert course.results[0] == {"to_mm": 100.0, "in_position_s": 1.0, "error_mm": 0.1, "overshoot_mm": 3.0}
    assert not course.good


def test_a_load_that_does_not_come_is_waited_for_and_told(template: Record) -> None:
    course = armed("100")
    request = course.ask(State.HOLDING, 0)
    course.see(ticked(template, 1.0, State.MOVING, request=request, answer=int(Answer.TAKEN), truth_m=0.02))
    course.see(ticked(template, 2.0, State.HOLDING, truth_m=0.09))
    course.see(ticked(template, 6.9, State.HOLDING, truth_m=0.09))
    before = course.over
    course.see(ticked(template, 7.1, State.HOLDING, truth_m=0.09))
    assert (before, course.over) == (False, True)
    assert not course.good
    assert in_words(course.results) == "goto 100 mm: not reached, error 10.000 mm"


@pytest.mark.parametrize("state", [State.FAULT, State.HOLDING])
def test_a_refusal_and_a_fault_end_it_with_one_shutdown(template: Record, state: State) -> None:
    course = armed("100,50")
    request = course.ask(State.HOLDING, 0)
    course.see(ticked(template, 1.0, state, request=request, answer=int(Answer.OUT_OF_TRAVEL)))
    assert course.over
    assert course.ask(state, 0) == Request(RequestKind.SHUTDOWN)
    assert course.ask(state, 0) is None
    assert [r["to_mm"] for r in course.results] == [100.0, 50.0]


@pytest.mark.parametrize("options", [{"laws": True}, {"scenario_file": "babble"}])
def test_moves_go_with_neither_comparison_nor_scenario(options: dict[str, object]) -> None:
    with pytest.raises((VerbError, ConfigError), match="--goto"):
        sim("virtual.toml", goto="100", **options)  # type: ignore[arg-type]
    with pytest.raises((VerbError, ConfigError), match="--track"):
        sim("virtual.toml", track="chirp", **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("track", "says"),
    [
        ("chirps", "neither a profile that pneud makes nor a file"),
        ("lacking.csv", "cannot be read"),
        ("steps:100", "at least two"),
        ("steps:100,2000", "the travel allows 21"),
        ("steps:100,x", "a move is MM"),
    ],
)
def test_a_profile_that_cannot_be_followed_is_refused_in_a_line(track: str, says: str) -> None:
    with pytest.raises((VerbError, MovesError), match=says):
        sim("virtual.toml", track=track)


def test_a_profile_ends_with_one_shutdown_and_is_measured(template: Record) -> None:
    way = Following([Request(RequestKind.TRACK, (1.0,))], 3.0)
    assert way.ask(State.WAITING, 0) is None
    assert way.ask(State.DISARMED, 0) == Request(RequestKind.ARM)
    assert way.ask(State.DISARMED, 0) is None
    assert way.ask(State.HOLDING, 0) == Request(RequestKind.TRACK, (1.0,))
    for i, error_m in enumerate((1e-5, -3e-5)):
        way.see(ticked(template, 1.0 + i, State.TRACKING, truth_m=0.43 - error_m, reference=rest(0.43)))
    way.see(ticked(template, 3.0, State.HOLDING))
    way.see(ticked(template, 4.0, State.STOPPING))
    assert way.good
    assert way.results["rms_mm"] == pytest.approx(1e-2 * math.sqrt(5.0))
    assert "followed to its end, error 0.022 mm RMS, 0.030 mm max" in following.in_words(way.results)
    assert way.ask(State.HOLDING, 0) == Request(RequestKind.SHUTDOWN)
    assert way.ask(State.HOLDING, 0) is None


@pytest.mark.parametrize("state", [State.FAULT, State.HOLDING])
def test_a_profile_that_is_refused_or_ends_in_a_fault_is_not_followed(template: Record, state: State) -> None:
    way = Following([Request(RequestKind.TRACK, (1.0,))], 3.0)
    way.ask(State.DISARMED, 0)
    request = way.ask(State.HOLDING, 0)
    way.see(ticked(template, 1.0, state, request=request, answer=int(Answer.NO_PROFILE)))
    assert (way.over, way.good, way.results["rms_mm"]) == (True, False, None)
    assert "refused: no profile" in following.in_words(way.results)


@pytest.mark.slow
@pytest.mark.parametrize("track", ["chirp", "steps:430,440,441", "way.csv"])
def test_an_axis_follows_a_profile(
    tmp_path: Path, track: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "way.csv").write_text("t_s,x_mm\n0,430\n1,450\n2,425\n")
    monkeypatch.chdir(tmp_path)
    assert sim("virtual.toml", track=track, json=True) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["state"] == "holding"
    assert found["profile"]["followed"]
    assert found["profile"]["max_mm"] < 0.2


@pytest.mark.slow
def test_an_axis_goes_there_the_same_each_time_and_its_log_replays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found, ticks = [], []
    for name in ("a", "b"):
        log = tmp_path / f"{name}.mcap"
        assert sim("virtual.toml", log, goto="430,460@60", json=True) == 0
        found.append(json.loads(capsys.readouterr().out))
        ticks.append([logged.check for logged in LogReader([log])])
    assert len(ticks[0]) > 1500
    assert ticks[0] == ticks[1]
    assert found[0]["moves"] == found[1]["moves"]
    assert [m["to_mm"] for m in found[0]["moves"]] == [430.0, 460.0]
    for move in found[0]["moves"]:
        assert abs(move["error_mm"]) < 0.03
        assert math.isfinite(move["in_position_s"])
    assert found[0]["moves"][1]["in_position_s"] > 0.5  # 30 mm at 60 mm/s
    assert replay([str(tmp_path / "a.mcap")]) == 0
