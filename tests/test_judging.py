"""Gains are judged by what people do, on rigs unlike the model, and the fastest that hold are found."""

from __future__ import annotations

import json
import math
import multiprocessing
import signal
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from commands import object_of, pneud, pneud_here
from pneud import resources
from pneud.config.conversions import axis_of, hold_v, plant_of
from pneud.config.models import Config
from pneud.loading import Loaded, load
from pneud.study import fastest, gains, judging, judging_words, trial
from pneud.study.fastest import Tried, first_look, rounded
from pneud.study.judging import NOMINAL, Figure, Judged, Lengths
from pneud.study.proposing import Proposal
from pneud.verbs.design import design

VIRTUAL = load("virtual.toml")
SHORT = Lengths(2.0, 1.0, 4.0)
SMALL = {  # a cylinder of 25 mm bore and 200 mm stroke, and virtual.toml's thresholds
    "name": "small",
    "cylinder": {
        "piston_area_1_m2": 0.00049087,
        "piston_area_2_m2": 0.00041233,
        "stroke_m": 0.2,
        "dead_length_1_m": 0.02,
        "dead_length_2_m": 0.02,
        "moving_mass_kg": 3.0,
    },
    "valve": {"orifice_area_m2": 6.903e-06, "bandwidth_hz": 125.0},
    "control": {"friction": {"coulomb_n": 14.7, "static_n": 22.1, "viscous_n_s_m": 14.7}},
    "reference": {"effective_centre_m": 0.12, "amplitude_m": 0.04},
    "limits": {"travel_min_m": 0.004, "travel_max_m": 0.196},
    "plant": {
        "initial_x1_m": 0.11,
        "valve": {"bandwidth_hz": 125.0},
        "friction": {
            "coulomb_n": 14.7,
            "static_n": 22.1,
            "stribeck_speed_m_s": 0.023,
            "viscous_n_s_m": 14.7,
            "bristle_stiffness_n_m": 0.9e5,
        },
        "sensors": {"encoder_resolution_m": 5e-6},
    },
}


@pytest.fixture(scope="module")
def small() -> Loaded:
    return load("virtual.toml", None, SMALL)


def written(loaded: Loaded, folder: Path) -> Path:
    (folder / "pneud.dbc").write_bytes((resources.configs() / "pneud.dbc").read_bytes())
    file = folder / "small.toml"
    file.write_text(loaded.text)
    return file


# thresholds


def test_thresholds_follow_from_the_rig_and_are_not_copied(small: Loaded) -> None:
    copied = small.config.control
    assert (copied.dead_zone_hold_v, copied.motion.push_beyond_m) == (0.034, 4e-6)
    c = gains.designed(small.config, 75.0, 1e-3, 0.923)
    law = c.control
    assert law.motion.encoder_resolution_m == 5e-6  # what [plant.sensors] says
    assert law.motion.push_beyond_m == pytest.approx(gains.push_beyond_m(c, 5e-6, 337.5), rel=1e-3)
    assert law.motion.push_beyond_m >= 7.5e-6  # two whole steps, half of one blind
    k = axis_of(c, VIRTUAL.codecs.command_lsb_v).controller.cylinder
    assert law.dead_zone_hold_v == pytest.approx(k.M * law.k1 * 5e-6 / k.F1_nominal, rel=1e-3)
    assert hold_v(c, k) == pytest.approx(law.dead_zone_hold_v, rel=1e-3)  # and so it is in force
    assert 0.0 < law.dead_zone_hold_v < 0.1 * copied.dead_zone_hold_v


def test_a_valve_without_a_dead_zone_needs_no_hold(small: Loaded) -> None:
    valve = small.config.valve.model_copy(update={"dead_zone_v": 0.0})
    c = gains.designed(small.config.model_copy(update={"valve": valve}), 75.0, 1e-3, 0.923)
    assert c.control.dead_zone_hold_v == 0.0


def test_more_friction_for_its_mass_and_a_slower_filter_explain_larger_innovations() -> None:
    c = VIRTUAL.config
    light = c.model_copy(update={"cylinder": c.cylinder.model_copy(update={"moving_mass_kg": 5.0})})
    one = gains.push_beyond_m(c, 1e-6, 300.0)
    assert gains.push_beyond_m(light, 1e-6, 300.0) == pytest.approx(3.0 * one)
    assert gains.push_beyond_m(c, 1e-6, 150.0) == pytest.approx(4.0 * one)
    assert gains.push_beyond_m(c, 1e-5, 300.0) == pytest.approx(1.5e-5)


def test_what_a_filter_errs_by_after_a_step_of_acceleration_is_found_on_the_filter() -> None:
    omega, h = 100.0, 1e-5
    x = v = a = most = 0.0  # errors of position, velocity, acceleration
    for _ in range(10_000):
        x, v, a = x + h * (v - 3 * omega * x), v + h * (a + 1.0 - 3 * omega**2 * x), a - h * omega**3 * x
        most = max(most, x)
    assert most == pytest.approx(gains.FILTERED_STEP / omega**2, rel=0.01)


def test_the_filter_is_slower_where_noise_would_move_the_command() -> None:
    c = VIRTUAL.config
    calm, noisy = (gains.designed(c, omega, 1e-3, 0.923).control.motion for omega in (70.0, 100.0))
    assert calm.bandwidth_rad_s == pytest.approx(4.5 * 70.0)
    assert noisy.bandwidth_rad_s == pytest.approx(3.0 * 100.0)


@given(st.floats(5.0, 300.0), st.floats(1e-5, 1e-2), st.floats(0.1, 10.0), st.floats(0.6, 0.99))
def test_error_and_bandwidth_of_the_homogeneous_law_are_one_parameter(
    omega: float, error_m: float, by: float, alpha: float
) -> None:
    power = (1.0 - alpha) / (3.0 - 2.0 * alpha)
    one = gains.scaled_gains(omega, error_m, alpha)
    other = gains.scaled_gains(omega * by**-power, by * error_m, alpha)
    assert other == pytest.approx(one)


# sessions


def test_each_plant_differs_in_one_thing() -> None:
    true = plant_of(VIRTUAL.config)
    found = judging.plants(true)
    assert found.pop(NOMINAL) == true
    assert len(found) == 12
    for name, p in found.items():
        assert sum(a != b for a, b in zip(p, true, strict=True)) == 1, name
    assert found["dead zone x0"].valve.dead_zone_v == 0.0
    assert found["mass x2"].cylinder.M == 2.0 * true.cylinder.M
    assert found["valve x0.5"].valve.omega_rad_s == 0.5 * true.valve.omega_rad_s
    assert found["bristles 20e5 N/m"].friction.sigma0_n_m == 20e5
    assert "bristles 1e5 N/m" not in found  # those it has
    ideal = plant_of(load("paper-case1.toml").config)
    assert not any("friction" in name or "bristles" in name for name in judging.plants(ideal))


def test_who_judges_just_ends_when_told_to_whatever_its_parent_does_on_a_signal() -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    def led(ready: Any) -> None:
        signal.signal(signal.SIGTERM, interrupt)  # as the parent has it
        judging._led()
        ready.set()
        signal.pause()

    forked = multiprocessing.get_context("fork")
    ready = forked.Event()
    process = forked.Process(target=led, args=(ready,))
    process.start()
    assert ready.wait(30.0)
    process.terminate()
    process.join()
    assert process.exitcode == -signal.SIGTERM


def test_a_session_goes_through_all_that_people_do_and_elsewhere_limits_are_wider() -> None:
    course = judging.course_of(VIRTUAL.config, SHORT)
    tasks = judging.tasks(
        VIRTUAL.config, VIRTUAL.codecs.command_lsb_v, course, (NOMINAL, "dead zone x0", "no such rig")
    )
    with judging.judges(1) as judge:
        nominal, other = judge(tasks)
    with judging.judges(2) as judge:
        assert {j.case: j for j in judge(tasks)} == {j.case: j for j in (nominal, other)}
    parts = list(dict.fromkeys(f.part for f in nominal.figures))
    assert parts == ["sine", "rest", "1 mm", "10 mm", "push", "return"]
    assert "return" not in {f.part for f in other.figures}
    for a, b in zip(nominal.figures, other.figures, strict=False):
        assert (a.part, a.what) == (b.part, b.what)
        assert b.limit == a.limit * (1.0 if a.part == "sine" else 2.0)
    values = {(f.part, f.what): f.value for f in nominal.figures}
    assert values["sine", "rms_m"] < 5e-5
    assert values["sine", "rms_m"] < values["sine", "max_m"]
    assert 1e-4 < values["push", "max_m"] < 6e-4
    assert values["return", "rms_m"] < 5e-5


def test_a_short_travel_has_no_long_steps_and_a_reference_at_rest_gets_a_sine() -> None:
    c = VIRTUAL.config
    limits = c.limits.model_copy(update={"travel_min_m": 0.47, "travel_max_m": 0.5})
    short = c.model_copy(update={"limits": limits})
    assert max(map(abs, judging.course_of(short, SHORT).steps_m)) == 1e-3
    still = c.model_copy(update={"reference": c.reference.model_copy(update={"amplitude_m": 0.0})})
    task = judging.tasks(still, 5e-4, judging.course_of(still, SHORT))[0]
    assert task.axis.reference.amplitude_m == pytest.approx(0.05)


def test_a_figure_that_never_comes_to_an_end_does_not_hold() -> None:
    never, held, over = (Figure("push", "in_position_s", v, 1.0) for v in (math.inf, 1.0, 2.0))
    assert (never.ratio, held.ratio, over.ratio) == (judging.WORST_RATIO, 1.0, 2.0)
    judged = Judged("x", (held, over, never))
    assert judged.worst == never
    assert judged.missed == (over, never)
    assert judged.excess == pytest.approx(math.log(20.0))


# the search


PREDICTED = gains.predict(VIRTUAL.config)
LATE = PREDICTED._replace(delay_margin_s=0.49 * PREDICTED.delay_s)


def by_bandwidth(late_from: float = math.inf) -> fastest.Propose:
    def made(omega: float) -> Proposal:
        c = VIRTUAL.config.model_copy(update={"name": f"w{omega:g}"})
        return Proposal(c, LATE if omega >= late_from else PREDICTED, ["hm"], True)

    return made


def judge_of(low: float, high: float) -> fastest.JudgeAll:
    """Rigs of which one is too slow below a bandwidth, one restless above another."""

    def judge(p: Proposal, _: Lengths) -> tuple[Judged, ...]:
        omega = float(p.config.name[1:])
        return (
            Judged(NOMINAL, (Figure("sine", "rms_m", low / omega, 1.0),)),
            Judged("stiff", (Figure("rest", "max_m", omega / high, 1.0),)),
        )

    return judge


def test_the_fastest_that_holds_is_found_and_what_limits_it() -> None:
    best, faster = fastest.fastest(by_bandwidth(), judge_of(30.0, 120.0), 1e-3)
    assert best.missed == 0
    assert 110.0 < best.bandwidth_rad_s <= 120.0
    assert faster is not None
    assert 120.0 < faster.bandwidth_rad_s < 130.0
    assert [j.case for j in faster.judged if j.missed] == ["stiff"]


def test_gains_that_hold_only_briefly_give_way_to_slower_ones() -> None:
    brief, whole = judge_of(30.0, 150.0), judge_of(30.0, 60.0)
    best, faster = fastest.fastest(
        by_bandwidth(), lambda p, n: (whole if n == judging.WHOLE else brief)(p, n), 1e-3
    )
    assert best.missed == 0
    assert 40.0 < best.bandwidth_rad_s <= 60.0
    assert faster is not None
    assert faster.missed > 0


def test_where_none_holds_the_one_that_misses_least_is_found() -> None:
    best, _ = fastest.fastest(by_bandwidth(), judge_of(100.0, 50.0), 1e-3)
    assert best.missed > 0
    assert 45.0 < best.bandwidth_rad_s < 110.0


def test_gains_without_a_margin_for_the_delay_are_not_looked_at_where_others_have_one() -> None:
    assert max(first_look(by_bandwidth(100.0), 1e-3)) < 100.0
    assert len(first_look(by_bandwidth(0.0), 1e-3)) == len(first_look(by_bandwidth(), 1e-3)) > 5
    best, faster = fastest.fastest(by_bandwidth(100.0), judge_of(10.0, 1000.0), 1e-3)
    assert (best.bandwidth_rad_s, faster) == (max(first_look(by_bandwidth(100.0), 1e-3)), None)


def test_gains_that_do_not_come_back_come_last() -> None:
    p = by_bandwidth()(50.0)
    lost = Tried(50.0, p, (Judged(NOMINAL, (Figure("return", "rms_m", math.inf, 1e-4),)),))
    poor = Tried(50.0, p, (Judged(NOMINAL, (Figure("sine", "rms_m", 1.0, 1e-4),) * 5),))
    assert poor.rank < lost.rank
    assert rounded(82.6462) == 82.6


# the verb


def test_the_table_has_the_worst_first_and_a_star_where_it_does_not_hold() -> None:
    def judged(case: str, *over_m: float) -> Judged:
        return Judged(case, tuple(Figure("1 mm", "overshoot_m", v, 5e-5) for v in over_m))

    many = [judged(NOMINAL, 4e-5), judged("mass x2", 1.2e-4), *(judged(f"x{i}", 1e-5) for i in range(9))]
    lines = judging_words.lines(many, False)
    assert "on 11 rigs, worst first: 1 of 11 figures do not hold" in lines[0]
    assert next(line for line in lines[3:] if "mass" in line or NOMINAL in line).split() == [
        "mass",
        "x2",
        "120*",
    ]
    assert "3 more" in lines[-1]
    assert any("\x1b[1;31m120*" in line for line in judging_words.lines(many, True))
    assert judging_words.told(many[1].worst) == "1 mm: overshoot 120 µm (at most 50 µm)"


def test_laws_stand_beside_each_other_and_one_that_leads_is_named() -> None:
    def judged(sine_m: float, rest_m: float) -> tuple[Judged, ...]:
        figures = Figure("sine", "rms_m", sine_m, 5e-5), Figure("rest", "max_m", rest_m, 15e-6)
        return Judged(NOMINAL, figures), Judged("mass x2", figures)

    lines = judging_words.beside({"composite 75": judged(1e-5, 2e-5), "pid 75": judged(4e-5, 1e-5)})
    assert lines[1].split() == ["sine:", "RMS", "[mm]", "0.01", "→", "0.01", "0.04", "→", "0.04"]
    assert lines[-1] == "pid 75 leads composite 75 at the worst in: rest largest error"


def test_without_a_compiler_a_short_list_is_judged_with_one_line_of_warning(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], small: Loaded, tmp_path: Path
) -> None:
    run = trial.compiled()[0]
    monkeypatch.setattr(trial, "compiled", lambda: (run, "no cc"))
    monkeypatch.setattr(judging, "BRIEF", SHORT)
    status = design("60", str(written(small, tmp_path)), simulate=True, json=True)
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert err == "pneud: this is slow and brief, since nothing can be compiled: no cc\n"
    assert {j["case"] for j in found["judged"]} == set(judging.SHORT)
    assert found["ok"] is (status == 0) is all(f["holds"] for j in found["judged"] for f in j["figures"])


def test_a_bandwidth_is_a_number_or_auto() -> None:
    done = pneud_here("design", "--bandwidth", "fast")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.strip().endswith("--bandwidth fast: neither a number nor auto")


def test_without_an_error_the_bandwidth_is_that_of_a_thousandth_of_the_stroke() -> None:
    found = object_of(pneud_here("design", "--bandwidth", 70, "--json"))
    assert found["prediction"]["error_m"] == pytest.approx(1e-3)
    assert found["judged"] == []


@pytest.mark.slow
def test_the_fastest_gains_for_a_small_cylinder(small: Loaded, tmp_path: Path) -> None:
    file = written(small, tmp_path)
    done = pneud("design", file, "--bandwidth", "auto", "--json", timeout=300)
    assert done.stderr == ""  # a bar is for a terminal
    found = object_of(done)
    assert done.returncode == (0 if found["ok"] else 1)
    assert len(found["judged"]) == len(judging.plants(plant_of(small.config)))
    missed = [f for j in found["judged"] for f in j["figures"] if not f["holds"]]
    assert found["ok"] is not any(missed)
    assert len(missed) < 25
    assert 40.0 < found["bandwidth_rad_s"] < 300.0
    sine = found["judged"][0]["figures"][0]
    assert (sine["part"], sine["what"]) == ("sine", "rms_m")
    assert all(j["figures"][0]["value"] < 1e-4 for j in found["judged"])
    control = tomllib.loads(found["toml"])["control"]
    assert control == found["control"]
    assert control["motion"]["encoder_resolution_m"] == 5e-6
    tables = tomllib.loads(small.text) | {"control": control}
    assert Config.model_validate(tables).control.k1 == control["k1"]


@pytest.mark.slow
def test_all_laws_are_tried_beside_each_other() -> None:
    done = pneud("design", "--bandwidth", 75, "--compare", timeout=120)
    assert tomllib.loads(done.stdout)["control"]["law"] == "composite"
    for law in ("ismc", "pid", "adrc"):
        assert f"# {law} 75 leads composite 75 at the worst in: " in done.stdout
