"""The reproduction of the paper: its loop, its figures, and how its verdicts come about."""

from __future__ import annotations

import json
import math
import re
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from commands import no_json, pneud, pneud_here
from pneud.control.homogeneous import feedback
from pneud.physics.cylinder import F1_FLOOR, F1_exhaust, F1_fill
from pneud.rig.dynamics import initial_state
from pneud.study.claims import (
    DOES_NOT,
    HOLDS,
    ONLY_WHEN,
    Bound,
    Instance,
    bounds,
    claims,
    conditions,
    in_words,
    judged,
)
from pneud.study.convergence import Convergence, LimitCycle, Settling, Start, Unmatched
from pneud.study.ideal import (
    COLUMNS,
    E3,
    ED,
    P2,
    SQUARE,
    W1,
    W2,
    W3,
    WORST,
    S,
    U,
    f1_pair,
    run_chain,
    run_ideal,
)
from pneud.study.paper import Reproduction, as_json
from pneud.study.paper_figures import Picture
from pneud.study.paper_page import page, words
from pneud.study.reproduction import (
    COMPOSITE,
    ISMC,
    ISMC_GAINS,
    PaperRow,
    Setting,
    Trace,
    ablation_settings,
    fast,
    loop_of,
    main_settings,
    orifice_settings,
    paper_loop,
    settled,
)
from shared import once

IMPLICIT_10_MS = Setting(1, COMPOSITE, True, 0.01, "implicit", "implicit", False, False)


def traced(s: Setting, duration_s: float) -> Trace:
    """A short run, not compiled."""
    loop = loop_of(s)
    trace = np.full((round(duration_s / s.h_s), COLUMNS), np.nan)
    run_ideal(initial_state(loop.plant), loop, 0.0, trace)
    return trace


# --- the loop -------------------------------------------------------------------------------------------


def test_the_cases_are_the_papers() -> None:
    first, second = paper_loop(1), paper_loop(2)
    assert (first.sliding.gains.k1, first.sliding.gains.k2, first.sliding.gains.k3) == (220.0, 450.0, 350.0)
    assert second.sliding.gains.k3 == 360.0
    assert (first.sliding.gains.a1, first.sliding.gains.a2) == pytest.approx((4 / 7, 2 / 3))
    assert (ISMC_GAINS.a1, ISMC_GAINS.a2, ISMC_GAINS.a3) == pytest.approx((3 / 4, 9 / 11, 9 / 10))
    assert (first.observer.L, second.observer.L) == (5.0, 500.0)
    assert first.reference.centre_m == pytest.approx(0.5)
    assert first.plant.cylinder.rod_force_n == 0.0
    assert first.plant.step_s <= 1e-4


def test_a_run_begins_on_its_sliding_surface_with_the_initial_errors_of_the_paper() -> None:
    first = traced(IMPLICIT_10_MS, 0.05)[0]
    assert first[W1] == pytest.approx(0.05)
    assert first[W2] == pytest.approx(0.05 * math.pi)
    assert first[W3] == pytest.approx(0.0, abs=1e-9)
    assert first[S] == 0.0
    assert first[E3] == 0.0
    assert first[ED] == pytest.approx(-2e5 * 2e-4)  # d̂(0) = 0, d = A1 d1 − A2 d2
    assert first[P2] == 3e5


def test_explicit_form_at_10_ms_runs_away_where_the_implicit_follows() -> None:
    implicit = traced(IMPLICIT_10_MS, 1.5)
    explicit = traced(IMPLICIT_10_MS._replace(form="explicit", observer="explicit"), 1.5)
    assert np.abs(explicit[20:, U]).mean() > 4.0
    assert np.abs(explicit[-1, W1]) > 0.15
    assert np.abs(implicit[20:, U]).mean() < 0.3
    assert np.abs(implicit[-1, W1]) < 0.09


@pytest.mark.parametrize("observer", ["implicit", "matched"])
def test_the_observer_finds_the_disturbance_of_case_2_at_once(observer: str) -> None:
    s = Setting(2, COMPOSITE, True, 0.001, "implicit", observer, False, False)
    trace = traced(s, 0.15)
    assert np.abs(trace[100:, ED]).max() < 1.0 < np.abs(trace[0, ED])
    assert np.abs(trace[100:, E3]).max() < 0.01


def test_errors_between_the_samples_are_seen() -> None:
    trace = traced(IMPLICIT_10_MS, 0.3)
    ends = np.abs(trace[1:, W1])
    assert (trace[:-1, WORST] >= np.maximum(ends, np.abs(trace[:-1, W1])) - 1e-15).all()
    assert (trace[:, SQUARE] <= trace[:, WORST] ** 2 * (1 + 1e-12)).all()
    assert (trace[:, SQUARE] > 0.0).all()


@given(st.floats(0.02, 1.0), st.floats(1.1e5, 5.9e5), st.floats(1.1e5, 5.9e5))
def test_below_supply_pressure_both_orifices_are_the_same(x1: float, p1: float, p2: float) -> None:
    plant = paper_loop(1).plant
    c, g = plant.cylinder, plant.gas
    both = F1_fill(x1, p1, p2, g.supply_pa, c, g), F1_exhaust(x1, p1, p2, g.supply_pa, c, g)
    assert f1_pair(x1, p1, p2, True, c, g) == both
    assert f1_pair(x1, p1, p2, False, c, g) == pytest.approx(both, rel=1e-12)


def test_above_supply_pressure_only_the_signed_orifice_loses_authority() -> None:
    plant = paper_loop(1).plant
    c, g = plant.cylinder, plant.gas
    signed = f1_pair(0.5, 7e5, 8.5e5, True, c, g)
    clipped = f1_pair(0.5, 7e5, 8.5e5, False, c, g)
    assert signed[0] < clipped[0]
    assert signed[1] < clipped[1]
    assert min(signed) >= F1_FLOOR * c.F1_nominal


def test_limit_cycle_of_the_explicit_chain_is_the_predicted_one_and_the_implicit_has_none() -> None:
    g = paper_loop(1).sliding.gains
    for implicit, (least, most) in ((False, (16.2, 16.6)), (True, (0.0, 1e-9))):
        trace = np.zeros((2000, 3))
        run_chain(0.05, 0.157, 0.0, 0.01, g, implicit, trace)
        assert least <= np.abs(trace[1000:, 2]).max() <= most
    assert (0.5 * 0.01 * g.k3) ** (1 / (1 - g.a3)) == pytest.approx(16.41, abs=0.01)


def test_settling_time_of_the_chain_grows_with_the_start_as_homogeneity_says() -> None:
    h = 1e-3
    for alpha, power in ((0.8, 1 / 7), (1.0, 0.0)):
        times = []
        for start in (0.01, 0.1):
            trace = np.zeros((7500, 3))
            run_chain(start, 0.0, 0.0, h, feedback(220.0, 450.0, 350.0, alpha), True, trace)
            time = settled(trace[:, 0], 0.02 * start, h)
            assert time is not None
            times.append(time)
        assert times[1] / times[0] == pytest.approx(10**power, rel=0.01)


# --- figures of merit -----------------------------------------------------------------------------------


def test_settled_is_for_good_and_early_enough() -> None:
    values = np.array([5.0, 0.0, 3.0, 0.5, -0.5, 0.1])
    assert settled(values, 1.0, 0.1) == pytest.approx(0.3)
    assert settled(values, 1.0, 0.1, latest_s=0.2) is None
    assert settled(values, 9.0, 0.1) == 0.0
    assert settled(values, 0.05, 0.1) is None
    assert settled(np.array([0.0, math.nan]), 1.0, 0.1) is None


def test_every_combination_is_run_once() -> None:
    settings = main_settings()
    assert len(set(settings)) == len(settings) == 48
    assert all(s.reverse_flow == s.reverse_model for s in settings)
    assert all(s.compensated == (s.law == COMPOSITE) for s in settings)
    assert (len(set(ablation_settings())), len(set(orifice_settings()))) == (32, 16)


# --- verdicts -------------------------------------------------------------------------------------------

instances_of_three = st.dictionaries(
    st.tuples(st.sampled_from("ab"), st.sampled_from("cde"), st.sampled_from("fg")),
    st.booleans(),
    min_size=1,
).map(lambda found: [Instance(c, holds) for c, holds in found.items()])


@given(instances_of_three)
def test_conditions_cover_exactly_what_holds(instances: list[Instance]) -> None:
    found = conditions(instances)
    for x in instances:
        assert any(all(x.circumstances[i] == value for i, value in c) for c in found) == x.holds


def test_conditions_are_put_plainly() -> None:
    instances = [
        Instance((law, h, flow), law == "implicit" and (h == "1 ms" or flow == "no flow"))
        for law in ("explicit", "implicit")
        for h in ("10 ms", "1 ms")
        for flow in ("flow", "no flow")
    ]
    found = in_words(conditions(instances)).split("; or ")
    assert sorted(found) == ["implicit, 1 ms", "implicit, no flow"]


def test_conditions_that_differ_in_one_circumstance_are_drawn_together() -> None:
    assert in_words([((0, "a"), (1, "x")), ((0, "b"), (1, "x"))]) == "a or b, x"
    assert in_words([((0, "a"), (1, "x")), ((0, "b"), (1, "y"))]) == "a, x; or b, y"


@pytest.mark.parametrize(
    ("held", "verdict", "when"),
    [((True, True), HOLDS, ""), ((False, False), DOES_NOT, ""), ((True, False), ONLY_WHEN, "here")],
)
def test_a_verdict_follows_the_runs(held: tuple[bool, bool], verdict: str, when: str) -> None:
    instances = [Instance((place,), x) for place, x in zip(("here", "there"), held, strict=True)]
    c = judged("claim", "where", "criterion", instances, "detail")
    assert (c.verdict, c.when) == (verdict, when)


def test_a_bound_is_not_met_by_nan() -> None:
    assert Bound("x", "mm", 1.0, 0.9, False).met
    assert not Bound("x", "mm", 1.0, 1.1, False).met
    assert not Bound("x", "mm", 1.0, math.nan, False).met
    assert not Bound("x", "mm", 1.0, math.nan, True).met


def row(s: Setting, **changes: Any) -> PaperRow:
    """A run in which all is well."""
    return PaperRow(s, 5.0, 6.0, 1e-7, 2e-7, 1.0, 0.1, 0.2, 0.01, 0.0, 8e5)._replace(**changes)


def convergence(exponent: float = 1 / 7) -> Convergence:
    settling = Settling("chain", 0.8, 1e-4, (0.1, 1.0), (1.0, math.nan), (), exponent, 1 / 7)
    return Convergence(
        settling=(settling._replace(times_s=(1.0, 1.4)),) * 3 + (settling,),
        limit_cycles=(LimitCycle(350.0, 0.8, 0.01, 16.4, 16.41, 1e-12),),
        starts=(Start(0.1, 5.0), Start(0.9, None)),
        unmatched=(Unmatched(1.0, 0.001, 0.05, 0.051, False, 0.0),),
        decay=(),
    )


def verdicts(main: list[PaperRow], ablation: list[PaperRow], c: Convergence) -> dict[str, tuple[str, str]]:
    return {
        f"{x.claim} / {x.where}": (x.verdict, x.when)
        for x in claims(main, ablation, c)
        if x.claim != "it does so because of the disturbance observer"
    }


def test_verdicts_are_computed_from_the_figures() -> None:
    def failing(s: Setting) -> PaperRow:
        bad = s.form == "explicit" and s.h_s == 0.01
        worse = {"coarse_s": 7.0, "rms_m": 3e-7} if s.law == ISMC else {}
        return row(s, rms_m=0.25, coarse_s=None, fine_s=None) if bad else row(s, **worse)

    ablation = [row(s) for s in ablation_settings()]
    fine = verdicts([row(s) for s in main_settings()], ablation, convergence())
    mixed = verdicts([failing(s) for s in main_settings()], ablation, convergence(0.05))
    tracking = "the tracking errors converge to zero in finite time / Theorem 3, Figures 3 and 6"
    sampling = "the law works at the sampling time of 0.01 s / Section 5"
    faster = "the composite law converges faster than ISMC / Section 5, Figures 3 and 6"
    chain = "u* stabilises the chain (13) in finite time / Lemma 2"
    assert fine[tracking] == fine[sampling] == fine[chain] == (HOLDS, "")
    assert fine[faster] == (DOES_NOT, "")
    assert mixed[tracking][0] == ONLY_WHEN
    assert set(mixed[tracking][1].split("; or ")) == {"implicit law", "h = 1 ms"}
    assert mixed[sampling] == (ONLY_WHEN, "implicit law")
    assert mixed[faster][0] == ONLY_WHEN
    assert mixed[chain] == (DOES_NOT, "")
    loop = "the closed loop's settling time is that of a finite-time law / Theorem 3"
    assert fine[loop] == (DOES_NOT, "")  # one of its times is NaN
    assert fine["the closed loop is globally finite-time stable / Theorem 3"] == (ONLY_WHEN, "x1(0) = 0.1 m")
    assert fine["nice robustness against external disturbances, of any kind / Remark 4"] == (DOES_NOT, "")


def test_one_bad_run_breaks_its_bound_only() -> None:
    bad = IMPLICIT_10_MS._replace(reverse_flow=True, reverse_model=True)
    rows = [
        row(s, rms_m=1e-3 if s == bad else 0.2 if s.form == "explicit" else 1e-7) for s in main_settings()
    ]
    broken = [b.what for b in bounds(rows, convergence()) if not b.met]
    assert len(broken) == 1
    assert "10 ms, with reverse flow" in broken[0]


# --- what is written ------------------------------------------------------------------------------------


def reproduction() -> Reproduction:
    main = tuple(row(s) for s in main_settings())
    c = convergence()
    return Reproduction(
        "x1(0) = <0.45> m",
        main,
        (row(ablation_settings()[0], coarse_s=None),),
        (),
        c,
        tuple(claims(main, [row(s) for s in ablation_settings()], c)),
        tuple(bounds(main, c)),
        {},
    )


def loads(text: str) -> list[str]:
    """Everything an HTML page would fetch from elsewhere."""
    return [
        x
        for x in re.findall(r"""(?:src|href|data)\s*=\s*['"]?([^'" >]+)|url\(([^)]*)\)|@import""", text)
        if not x[0].startswith(("data:", "#"))  # a place in the page itself
    ]


def test_page_needs_nothing_beside_it_and_is_escaped() -> None:
    text = page(reproduction(), [Picture("a", "it's <a>", b"\x89PNG")])
    assert loads("<img src='http://a/b.png'>")
    assert not loads(text)
    assert "<script" not in text
    assert "<link" not in text
    assert "data:image/png;base64,iVBORw==" in text
    assert "x1(0) = &lt;0.45&gt; m" in text
    assert "it&#x27;s &lt;a&gt;" in text


def test_words_give_every_claim_and_bound() -> None:
    found = reproduction()
    text = words(found)
    for c in found.claims:
        assert c.claim in text
    assert text.count(" met") + text.count("NOT MET") >= len(found.bounds)
    assert "never" in text


def test_json_has_no_nan() -> None:
    found = as_json(reproduction())
    read = json.loads(json.dumps(found), parse_constant=no_json)
    assert read["schema"] == 1
    assert read["settling"][-1]["times_s"] == [1.0, None]
    assert len(read["runs"]) == 48
    assert read["runs"][0]["case"] == 1
    assert read["good"] is False


def test_a_folder_that_cannot_be_made_is_said_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    done = pneud_here("reproduce", "-o", tmp_path / "file")
    assert (done.returncode, done.stdout) == (2, "")
    assert len(done.stderr.splitlines()) == 1
    assert str(tmp_path / "file") in done.stderr


# --- the whole ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    def made(folder: Path) -> tuple[Path, dict[str, Any]]:
        done = pneud("reproduce", "-o", folder / "new", "--json", timeout=600)
        assert done.returncode == 0, done.stderr
        found: dict[str, Any] = json.loads(done.stdout, parse_constant=no_json)
        return folder / "new", found

    return once(tmp_path_factory, "reproduced", made)


def rows_of(found: dict[str, Any], **wanted: Any) -> list[dict[str, Any]]:
    rows = [r for r in found["runs"] if all(r[k] == v for k, v in wanted.items())]
    assert rows
    return rows


@pytest.mark.slow
@pytest.mark.parametrize(
    ("h_s", "reverse", "limit_m"),
    [(0.01, False, 0.06e-3), (0.001, False, 0.5e-6), (0.01, True, 0.15e-3), (0.001, True, 10e-6)],
)
def test_implicit_composite_law_reaches_its_figures(
    whole: tuple[Path, dict[str, Any]], h_s: float, reverse: bool, limit_m: float
) -> None:
    for observer in ("implicit", "matched"):
        rows = rows_of(
            whole[1],
            law=COMPOSITE,
            form="implicit",
            observer=observer,
            h_s=h_s,
            reverse_flow=reverse,
        )
        assert {r["case"] for r in rows} == {1, 2}
        assert all(r["rms_m"] <= limit_m for r in rows)


@pytest.mark.slow
def test_explicit_law_fails_at_10_ms_and_tracks_at_1_ms(whole: tuple[Path, dict[str, Any]]) -> None:
    failed = rows_of(whole[1], form="explicit", h_s=0.01)
    assert all(r["rms_m"] > 0.2 and r["coarse_s"] is None for r in failed)
    assert all(r["rms_m"] < 2e-6 for r in rows_of(whole[1], form="explicit", h_s=0.001, law=COMPOSITE))


@pytest.mark.slow
def test_figures_of_chain_and_unmatched_force_are_as_predicted(whole: tuple[Path, dict[str, Any]]) -> None:
    found = whole[1]
    assert found["good"] is True
    assert all(b["met"] for b in found["bounds"])
    for x in found["limit_cycles"]:
        assert x["amplitude_m_s2"] == pytest.approx(x["predicted_m_s2"], rel=0.01)
        assert x["implicit_m_s2"] < 1e-9
    for x in found["settling"]:
        assert x["exponent"] == pytest.approx(x["predicted"], abs=0.01)
    for x in found["unmatched"]:
        assert x["at_stop"] or x["error_m"] == pytest.approx(x["predicted_m"], rel=0.01)
    verdict = {c["claim"]: c["verdict"] for c in found["claims"]}
    assert verdict["u* stabilises the chain (13) in finite time"] == HOLDS
    assert verdict["the law works at the sampling time of 0.01 s"] == ONLY_WHEN
    assert verdict["nice robustness against external disturbances, of any kind"] == DOES_NOT


@pytest.mark.slow
def test_law_must_believe_in_the_plants_orifice(whole: tuple[Path, dict[str, Any]]) -> None:
    rows = {(r["case"], r["h_s"], r["reverse_flow"], r["reverse_model"]): r for r in whole[1]["orifice"]}
    for case, h_s, plant, model in rows:
        if plant != model:
            assert rows[case, h_s, plant, model]["rms_m"] > 5 * rows[case, h_s, plant, plant]["rms_m"]


@pytest.mark.slow
def test_figures_are_valid_png_and_the_page_holds_them(whole: tuple[Path, dict[str, Any]]) -> None:
    folder, found = whole
    assert found["page"] == str(folder / "paper.html")
    text = (folder / "paper.html").read_text(encoding="utf-8")
    assert not loads(text)
    files = sorted(folder.glob("*.png"))
    for number in range(3, 9):
        assert {f"figure-{number}-{x}.png" for x in ("10ms-implicit", "1ms-implicit", "10ms-explicit")} <= {
            f.name for f in files
        }
    assert {"error-log.png", "settling.png", "limit-cycle.png"} <= {f.name for f in files}
    assert text.count("data:image/png;base64,") == len(files)
    for file in files:
        width, height, pixels = decoded(file.read_bytes())
        assert width > 600
        assert height > 200
        assert len(set(pixels[:: max(1, len(pixels) // 20_000)])) > 3  # not blank


def decoded(png: bytes) -> tuple[int, int, bytes]:
    """Size and filtered pixels of a PNG whose every chunk is checked."""
    assert png[:8] == b"\x89PNG\r\n\x1a\n"
    at, data, kinds = 8, b"", []
    width = height = 0
    while at < len(png):
        (size,) = struct.unpack_from(">I", png, at)
        kind, body = png[at + 4 : at + 8], png[at + 8 : at + 8 + size]
        assert struct.unpack_from(">I", png, at + 8 + size)[0] == zlib.crc32(kind + body)
        if kind == b"IHDR":
            width, height = struct.unpack_from(">II", body)
        if kind == b"IDAT":
            data += body
        kinds.append(kind)
        at += 12 + size
    assert kinds[-1] == b"IEND"
    return width, height, zlib.decompress(data)


@pytest.mark.slow
def test_compiled_runs_are_those_of_the_interpreter_to_the_bit() -> None:
    for s in (
        IMPLICIT_10_MS,
        Setting(2, ISMC, False, 0.01, "explicit", "explicit", True, True),
        Setting(2, COMPOSITE, True, 0.01, "implicit", "matched", True, False),
    ):
        plain, compiled = traced(s, 3.0), np.zeros((300, COLUMNS))
        fast(run_ideal)(initial_state(loop_of(s).plant), loop_of(s), 0.0, compiled)
        assert (plain == compiled).all()
