"""What a log's axis was led to do, and how well: against what its plant and its operator knew."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import pytest

from axis_rig import quick
from pneud.loading import load
from pneud.log.files.naming import create_log
from pneud.log.files.reader import read_log
from pneud.log.files.writer import LogWriter
from pneud.physics.ratings import DENSITY_ANR_KG_M3
from pneud.replay.lockstep import Simulation, header_of
from pneud.replay.motions import Motion, motions
from pneud.replay.moves import Course, moves_of
from pneud.study.closed_loop import supply_flow_kg_s

GOLDEN = Path(__file__).parent / "golden"


@pytest.fixture(scope="module")
def asked() -> list[Motion]:
    return motions(read_log(GOLDEN / "requests.mcap"))


def test_each_request_and_each_state_is_a_motion(asked: list[Motion]) -> None:
    assert [m.kind for m in asked] == ["hold", "goto", "jog", "stop", "hold", "track", "stop"]
    assert all(m.begin_s < m.end_s for m in asked)
    assert all(a.end_s == pytest.approx(b.begin_s) for a, b in pairwise(asked))
    goto = asked[1]
    assert goto.to_m == 0.25
    assert 0.0 < goto.rms_error_m < goto.max_error_m < 1e-3


def test_only_what_is_held_behind_it_can_settle(asked: list[Motion]) -> None:
    stop = asked[3]
    assert stop.settled_s == pytest.approx(stop.end_s + stop.settling_s)
    assert stop.in_position_s > stop.duration_s
    for motion in (asked[1], asked[2], asked[5]):  # another request came before they were through
        assert math.isnan(motion.settling_s)
        assert math.isnan(motion.overshoot_m)


def test_a_move_is_judged_as_its_operator_and_its_plant_do(tmp_path: Path) -> None:
    loaded = load("virtual.toml")
    course = Course(moves_of("440"))
    run = Simulation(loaded, 3.0, 1, quick(), operator=course.ask)
    writer = LogWriter(create_log(tmp_path / "move.mcap"), header_of(loaded))
    flow = []
    for record in run.records():
        course.see(record)
        writer.write(record)
        flow.append(supply_flow_kg_s(run.node.truth().state, run.node.p) / loaded.config.loop.rate_hz)
    assert writer.close()
    found = motions(read_log(tmp_path / "move.mcap"))
    assert [m.kind for m in found] == ["hold", "goto", "hold", "stop"]
    move, (result,) = found[1], course.results
    assert move.in_position_s == pytest.approx(result["in_position_s"], abs=1e-4)
    assert move.overshoot_m == pytest.approx(1e-3 * result["overshoot_mm"], abs=1e-7)
    assert 0.0 <= move.settling_s < move.in_position_s - move.duration_s
    begin, end = round(1e3 * move.begin_s), round(1e3 * move.end_s)
    true_m3 = sum(flow[begin:end]) / DENSITY_ANR_KG_M3
    assert move.air_anr_m3 == pytest.approx(true_m3, rel=0.02)
    assert move.air_energy_j == pytest.approx(true_m3 * 1e5 * math.log(6.0), rel=0.05)
    assert 0.0 < move.work_j < 0.1 * move.air_energy_j


def test_a_log_that_was_never_engaged_has_no_motion(tmp_path: Path) -> None:
    loaded = load("virtual.toml")
    writer = LogWriter(create_log(tmp_path / "idle.mcap"), header_of(loaded))
    for record in Simulation(loaded, 0.05, 1, quick(), requests={}).records():
        writer.write(record)
    assert writer.close()
    assert motions(read_log(tmp_path / "idle.mcap")) == []
