"""The judge of the axis on rigs that are not as it believes: what it says of courses that are made up."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pneud.config.sections import ConfigError
from pneud.loading import load
from pneud.safety.faults import F
from pneud.signals import State

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))
from hil import strange  # noqa: E402

CONFIG = load("virtual.toml").config
PER_S = 200  # rows of a course
TRACKED_S = 5.0
RAMP_S = 0.4  # of a way without a speed of its own
Floats = NDArray[np.float64]


def left(moves: int = 4, trouble: str = "") -> strange.Run:
    host = {"ticks": 1, "skipped": 0, "lateness_us": None, "late": 0}
    return strange.Run(Path("none"), Path("none"), strange.legs(CONFIG, moves, 3.0), trouble, host)


def course(run: strange.Run) -> tuple[strange.Course, dict[str, list[tuple[int, int]]]]:
    """One that keeps to its reference exactly, and where its legs of each name lie."""
    legs = run.legs
    spans: dict[str, list[tuple[int, int]]] = {}
    target = [np.zeros(round(TRACKED_S * PER_S))]
    speed = [np.ones(round(TRACKED_S * PER_S))]
    states = [np.full(round(TRACKED_S * PER_S), State.TRACKING)]
    gotos, at, count = [], 0.0, len(target[0])
    for leg in legs:
        n, way = round(leg.lasts_s * PER_S), leg.to_mm - at
        ramp_s = abs(way) / leg.speed_mm_s if leg.speed_mm_s else RAMP_S
        t = np.arange(1, n + 1) / PER_S
        target.append(at + way * np.minimum(1.0, t / ramp_s))
        speed.append(np.where(t < ramp_s, way / ramp_s, 0.0))
        states.append(np.where(t < ramp_s, State.MOVING, State.HOLDING))
        gotos.append(count)
        spans.setdefault(leg.name, []).append((count, count + n))
        at, count = leg.to_mm, count + n
    x = np.concatenate(target)
    state = np.concatenate(states)
    return strange.Course(
        np.arange(count) / PER_S, state, x, np.concatenate(speed), x.copy(), 0.0 * x, 0, gotos
    ), spans


def judged(c: strange.Course, run: strange.Run) -> tuple[dict[str, Any], dict[str, float]]:
    """The judgement, and what missed its goal by how much."""
    found = strange.judged(c, run, CONFIG, "made up")
    strange.words([found])
    return found, {goal["what"]: goal["worst_mm"] for goal in found["goals"] if not goal["met"]}


def test_an_axis_that_keeps_to_its_reference_meets_all_goals() -> None:
    run = left()
    found, missed = judged(course(run)[0], run)
    assert (missed, found["met"]) == ({}, True)
    assert [move["settled_s"] for move in found["moves"]] == 4 * [0.0]


@pytest.mark.parametrize(
    ("leg", "what", "limit"),
    [("+10 mm", "moves", 0.5), ("+10 mm", "overshoot", 0.3), ("rest", "rest", 0.05), ("creep", "creep", 0.1)],
)
@pytest.mark.parametrize("times", [0.98, 1.02])
def test_each_goal_is_missed_beyond_its_bound_and_no_sooner(
    leg: str, what: str, limit: float, times: float
) -> None:
    run = left(5)
    c, spans = course(run)
    begin, end = spans[leg][-1]
    off = times * limit
    if what == "moves":  # lags behind
        c.x[begin + 20 : begin + 40] -= off
    elif what == "overshoot":
        c.x[begin + 90 : begin + 95] += off
    elif what == "rest":
        c.x[end - 20] -= off
    else:  # sticks and slips
        c.x[begin:end] += 0.5 * off * np.sign(np.sin(np.arange(end - begin)))
    found, missed = judged(c, run)
    assert missed == ({what: pytest.approx(off)} if times > 1.0 else {})
    assert found["met"] == (times < 1.0)


def test_creeping_is_judged_in_both_directions_and_without_the_breakaway() -> None:
    run = left()
    c, spans = course(run)
    (begin, _), (back, end) = spans["creep"]
    c.x[begin : begin + 40] -= 0.4  # gets going
    found, missed = judged(c, run)
    assert not missed
    assert found["creep"][0]["with_breakaway_mm"] == pytest.approx(0.4)
    c.x[back + 100 : end] -= 0.2
    assert judged(c, run)[1] == {"creep": pytest.approx(0.2)}


def test_an_axis_that_holds_nothing_does_not_rest() -> None:
    run = left()
    c, spans = course(run)
    begin, end = spans["rest"][0]
    c.state[begin:end] = State.TRACKING
    assert judged(c, run)[1] == {"rest": None}


def test_what_is_not_known_is_not_met() -> None:
    run = left()
    c, spans = course(run)
    begin, end = spans["+1 mm"][0]
    c.x[begin:end] = math.nan
    found, missed = judged(c, run)
    assert missed.keys() == {"moves", "overshoot"}
    assert found["moves"][0]["overshoot_mm"] is None


def test_ways_that_were_not_made_are_not_met() -> None:
    run = left()
    c, spans = course(run)
    end = spans["-1 mm"][-1][0]
    t_s, state, target, speed, x, u = (part[:end] for part in c[:6])
    cut = strange.Course(t_s, state, target, speed, x, u, 0, c.gotos[:4])
    assert judged(cut, run)[1].keys() == set(strange.GOALS_MM)
    found, missed = judged(strange.NOTHING, run)
    assert missed == dict.fromkeys(strange.GOALS_MM)
    assert not found["met"]


def test_a_fault_and_a_run_cut_short_miss_though_all_goals_are_met() -> None:
    run = left()
    c, _ = course(run)
    found, missed = judged(c._replace(latched=1 << F.TRACKING_ERROR), run)
    assert (missed, found["faults"], found["met"]) == ({}, ["tracking_error"], False)
    assert not judged(c, left(trouble="goto: refused"))[0]["met"]


def test_a_run_without_a_log_is_a_course_of_nothing() -> None:
    assert strange.course(left()) == strange.NOTHING


def test_a_folder_tells_the_pairs(tmp_path: Path) -> None:
    given = argparse.Namespace(rigs=tmp_path)
    with pytest.raises(ConfigError, match=r"no file is named NAME-truth\.toml"):
        strange.pairs(given)
    for name in ("b", "b-truth", "a", "a-truth", "c"):
        (tmp_path / f"{name}.toml").touch()
    assert strange.pairs(given) == [(tmp_path / f"{n}.toml", str(tmp_path / f"{n}-truth.toml")) for n in "ab"]
    (tmp_path / "d-truth.toml").touch()
    with pytest.raises(ConfigError, match=r"d\.toml, is not beside it"):
        strange.pairs(given)
