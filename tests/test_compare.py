"""The comparison: what its tables say, and that its claims are computed."""

import json
import math
from typing import Any

import numpy as np
import pytest

from commands import pneud_here as pneud
from pneud.control.homogeneous import feedback
from pneud.loading import load
from pneud.rig.dynamics import advance, initial_state
from pneud.study import comparison as compare_
from pneud.study import comparison_page
from pneud.study.cases import (
    Figures,
    bench_of,
    case,
    figures,
    loads,
    move_of,
    moves,
    recoveries,
    rests,
    sine_of,
    sines,
    spread,
    step_of,
    trace_of,
    tracking,
)
from pneud.study.closed_loop import supply_flow_kg_s
from pneud.study.comparison import LAWS, LawRow, LawTable, as_json, behind, compare, in_words, missed
from pneud.study.tuned import (
    ADRC3,
    ADRC4,
    COMPOSITE_PAPER,
    EXTENDED,
    EXTENDED_TUNED,
    ISMC_PAPER,
    PID_FF,
    setting,
)
from pneud.study.tuner import _moved, course, parts, tune
from shared import once

LOADED = load("virtual.toml")
BENCH = bench_of(LOADED, compiled=False)


def row(law: str, rms: float, most: float, group: str = "sine", settled: float = 0.0) -> LawRow:
    return LawRow(group, "a case", law, 2.0, Figures(rms, most, 0.01, 0.5, settled))


def test_every_group_of_cases_is_there_and_consistent() -> None:
    for members in compare_.every_case(BENCH, 10.0).values():
        for c in members.values():
            assert c.references.shape == (len(c.force_n), 4)
            assert 0.0 <= c.judged[0] < c.judged[1] <= len(c.force_n) * BENCH.controller.h + 1e-9


def test_references_are_consistent_with_their_derivatives() -> None:
    h = BENCH.controller.h
    for r in (sine_of(BENCH, 2.0, 1.0), move_of(BENCH, 0.4, 1.2, 0.5)):
        for i in range(3):
            slope = np.gradient(r[:, i], h)
            # the jerk's own slope steps where a move begins and ends
            assert slope[1:-1] == pytest.approx(r[1:-1, i + 1], abs=5e-3 * np.abs(r[:, i + 1]).max())


def test_a_move_has_the_length_of_its_name() -> None:
    for name, c in moves(BENCH).items():
        length = c.references[-1, 0] - c.references[0, 0]
        assert length * 1e3 == pytest.approx(float(name.split()[1]))


def test_loads_come_and_go_at_peak_speed() -> None:
    h = BENCH.controller.h
    for c in loads(BENCH).values():
        changes = np.nonzero(np.diff(c.force_n))[0] + 1
        assert [k * h for k in changes] == pytest.approx([4.0, 5.0])
        speed = np.abs(c.references[:, 1])
        assert speed[changes] == pytest.approx([speed.max()] * 2, rel=1e-3)


def test_starts_stay_on_the_stroke() -> None:
    for c in recoveries(BENCH).values():
        assert 0.02 <= c.start_m <= 0.98


def test_each_plant_of_the_spread_differs_in_what_its_name_says() -> None:
    own = BENCH.rig
    found = {name: c.rig for name, c in spread(BENCH).items()}
    assert all(rig != own for rig in found.values())
    assert found["mass x 0.5"].plant.cylinder.M == 0.5 * own.plant.cylinder.M
    assert found["friction x 2"].plant.friction.static_n == 2.0 * own.plant.friction.static_n
    assert found["supply 5 bar"].plant.gas.supply_pa == 5e5
    assert found["gas 40 C"].plant.gas.temperature_k == pytest.approx(313.15)
    assert found["gas 40 C"].plant.cylinder.c1 > own.plant.cylinder.c1
    assert found["hose 3 ms"].delay_s == pytest.approx(own.delay_s + 3e-3)
    assert found["DAC 10 bit"].command_step_v == pytest.approx(10.0 / 1024)
    assert found["encoder 10 um"].plant.encoder_resolution_m == pytest.approx(1e-5)
    assert step_of(0) == 0.0


def test_a_delay_of_several_samples_moves_the_plant_as_much_later() -> None:
    c = case(BENCH, move_of(BENCH, 0.01, 0.1, 0.02), (0.2, 0.3), start_error_m=0.02)
    late = c._replace(rig=c.rig._replace(delay_s=c.rig.delay_s + 5e-3))
    runs = [trace_of(BENCH, BENCH.controller, one)[1] for one in (c, late)]
    first = [int(np.nonzero(np.abs(t[:, 2]) > 5e-3)[0][0]) for t in runs]
    assert first[1] - first[0] in range(4, 7)


def test_the_flow_from_the_supply_is_what_a_chamber_of_fixed_volume_gains() -> None:
    plant = BENCH.rig.plant
    c, h = plant.cylinder, 1e-4
    rig = initial_state(plant._replace(initial_x1=c.x_e1 + c.stroke_m))._replace(y=2.0)
    before, kg = rig.p1, 0.0
    for _ in range(500):
        flow = supply_flow_kg_s(rig, plant)
        rig = advance(rig, 2.0, 0.0, 0.0, h, plant)
        kg += 0.5 * h * (flow + supply_flow_kg_s(rig, plant))
    per_pa = c.A1 * rig.x1 / (plant.polytropic_exponent * plant.gas.R * plant.gas.temperature_k)
    assert rig.p1 > before + 1e4
    assert kg == pytest.approx((rig.p1 - before) * per_pa, rel=1e-3)
    assert supply_flow_kg_s(rig._replace(y=0.0), plant) == 0.0


def test_figures_settle_where_the_error_stays_small() -> None:
    c = case(BENCH, move_of(BENCH, 0.01, 0.1, 0.1), (0.2, 0.4), start_error_m=1e-3)
    f = figures(BENCH, setting(EXTENDED, BENCH.controller), c)
    assert f.rms_m <= f.max_m
    assert f.settled_s < 0.2
    weak = BENCH.controller.sliding._replace(gains=feedback(1.0, 1.0, 1.0, 0.9))
    standing = BENCH.controller._replace(sliding=weak)
    assert figures(BENCH, standing, c).settled_s == math.inf


def test_a_law_that_leads_somewhere_is_named() -> None:
    rows = [row(EXTENDED, 2e-5, 9e-5), row(PID_FF, 1e-5, 9.5e-5)]
    found = behind(rows)
    assert [(b.figure, b.law) for b in found] == [("RMS", PID_FF)]
    c = LawTable("x.toml", True, tuple(rows), tuple(found), {})
    assert "PID + FF ahead of extended composite: a case RMS 0.01, 0.02" in in_words(c)


def test_a_tie_is_no_lead_and_a_lost_loop_no_rival() -> None:
    assert len(behind([row(EXTENDED, 1e-5, 1e-4), row(PID_FF, 1e-5, 2e-4)])) == 1
    assert behind([row(EXTENDED, 1e-5, 1e-4), row(PID_FF, math.inf, math.inf)]) == []
    assert behind([row(EXTENDED, 2e-5, 2e-4, "spread"), row(PID_FF, 1e-5, 1e-4, "spread")]) == []
    assert behind([row(PID_FF, 1e-5, 1e-4)]) == []


def test_words_and_json_say_the_same() -> None:
    rows = (row(EXTENDED, 1e-5, 1e-4), row(PID_FF, 2e-5, math.inf, settled=math.inf))
    c = LawTable("x.toml", True, rows, (), missed(list(rows)))
    text, data = in_words(c), as_json(c)
    assert "0.01 / 0.1" in text
    assert "0.02 / lost" in text
    assert "leads all baselines in RMS and maximum in every" in text
    assert "extended composite: none" in text
    assert "PID + FF: 1, first a case: max inf mm" in text
    assert data["missed"][PID_FF] == ("a case: max inf mm (at most 0.15)",)
    assert data["schema"] == 1
    assert data["rows"][1]["max_m"] is None
    assert data["rows"][0]["settled_s"] == 0.0
    json.dumps(data, allow_nan=False)


def test_the_optimiser_finds_a_minimum_and_the_same_one_for_a_seed() -> None:
    def bowl(g: dict[str, float], limit: float) -> float:
        return math.log(g["a"] / 30.0) ** 2 + math.log(g["b"] / 0.2) ** 2

    best, least = tune(bowl, {"a": 10.0, "b": 1.0}, 3, 60, 200)
    assert least < 1e-2
    assert best["a"] == pytest.approx(30.0, rel=0.1)
    assert tune(bowl, {"a": 10.0, "b": 1.0}, 3, 60, 200) == (best, least)


def test_an_exponent_stays_below_one() -> None:
    for log in (-3.0, 0.0, 3.0):
        assert 0.5 <= _moved({"alpha": 0.9}, ["alpha"], np.array([log]))["alpha"] < 1.0
    assert _moved({"alpha": 0.9}, ["alpha"], np.array([0.0]))["alpha"] == pytest.approx(0.9)


def test_each_case_of_the_course_is_judged() -> None:
    f = Figures(1e-4, 1e-3, 0.1, 1.0, math.inf)
    for name in course(BENCH):
        assert all(0.0 < ratio < 100.0 for ratio in parts(name, f))


def test_compare_writes_no_log() -> None:
    done = pneud("sim", "--compare", "-o", "x.mcap")
    assert done.returncode == 2
    assert "--compare writes no log" in done.stderr


def table_of(laws: tuple[str, ...]) -> LawTable:
    rows = [
        row(law, 1e-5 * (i + 1), 1e-4 * (i + 1), group)
        for group in ("sine", "move")
        for i, law in enumerate(laws)
    ]
    return LawTable("x.toml", True, tuple(rows), tuple(behind(rows)), missed(rows))


def cells_of(text: str) -> set[str]:
    rows = (line for line in text.splitlines() if line.startswith("| "))
    return {cell.strip() for line in rows for cell in line.split("|") if not set(cell) <= {"-", " "}}


def test_tables_fold_to_a_width_and_lose_nothing() -> None:
    c = table_of(LAWS)
    whole = in_words(c)
    assert max(map(len, whole.splitlines())) > 120
    for width in (60, 80, 120):
        folded = in_words(c, width)
        assert max(len(line) for line in folded.splitlines() if line.startswith("|")) <= width
        assert cells_of(whole) == cells_of(folded)


def test_the_page_shades_the_best_and_says_who_leads() -> None:
    text = comparison_page.page(table_of((EXTENDED, PID_FF)))
    assert '<span class="grade g0">0.01</span>' in text
    assert '<span class="grade g1">0.02</span>' in text
    assert "the extended composite leads" in text
    text = comparison_page.page(table_of((PID_FF, EXTENDED)))
    assert "a baseline is ahead of the extended composite" in text
    assert "http" not in text


def test_a_rest_of_no_length_is_refused() -> None:
    done = pneud("sim", "--compare", "--duration", "0")
    assert done.returncode == 2
    assert "--duration 0" in done.stderr


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> LawTable:
    return once(tmp_path_factory, "compared", lambda _: compare(LOADED, 10.0, compiled=True))


@pytest.mark.slow
def test_the_extended_composite_keeps_its_own_figures(found: LawTable) -> None:
    mine = {r.case: r.figures for r in found.rows if r.law == EXTENDED}
    assert mine["sine 0.5 Hz"].rms_m < 0.02e-3
    assert mine["sine 0.5 Hz"].max_m < 0.08e-3
    assert all(mine[name].max_m < 0.6e-3 and mine[name].settled_s < 0.3 for name in loads(BENCH))
    assert all(r.figures.rms_m < 0.2e-3 for r in found.rows if (r.group, r.law) == ("spread", EXTENDED))
    assert all(mine[name].rms_m < 0.05e-3 for name in recoveries(BENCH))


@pytest.mark.slow
def test_no_baseline_leads_and_meets_what_is_required(found: LawTable) -> None:
    assert found.missed[EXTENDED] == ()
    leaders = {b.law for b in found.behind}
    assert all(found.missed[law] for law in leaders)


@pytest.mark.slow
def test_the_extended_composite_leads_where_it_is_said_to(found: LawTable) -> None:
    assert not {ISMC_PAPER, COMPOSITE_PAPER} & {b.law for b in found.behind}
    assert {b.case for b in found.behind if b.law == PID_FF} <= {"sine 1 Hz", "sine 2 Hz"}
    assert {b.case for b in found.behind if b.law == ADRC4} <= {"sine 2 Hz"}
    tuned = {b.case for b in found.behind if b.over == EXTENDED_TUNED and b.law in (PID_FF, ADRC3, ADRC4)}
    assert not tuned & {"sine 0.5 Hz", "the paper's", *loads(BENCH)}


@pytest.mark.slow
def test_the_table_has_every_law_in_every_case(found: LawTable) -> None:
    everything = sines(BENCH) | moves(BENCH) | loads(BENCH) | rests(BENCH, 1.0) | recoveries(BENCH)
    everything |= spread(BENCH)
    everything |= {f"rate {hz:g} Hz": tracking(BENCH) for hz in compare_.RATES_HZ}
    assert {(r.case, r.law) for r in found.rows} == {(c, law) for c in everything for law in LAWS}


def test_without_numba_three_cases_are_run(monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[Any] = []

    def instead(*args: Any) -> Figures:
        ran.append(args)
        return Figures(1e-5, 1e-4, 0.0, 0.0, 0.0)

    monkeypatch.setattr(compare_, "figures", instead)
    brief = compare(LOADED, 10.0, compiled=False, laws=(EXTENDED,))
    assert [r.case for r in brief.rows] == ["sine 0.5 Hz", "move 100 mm", "50 N on"]
    assert len(ran) == 3
