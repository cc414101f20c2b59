"""`pneud bench`: samples, ratios, report and page from made-up turns; the law in C; each contestant, shortly.

Nothing here asserts how long anything took.
"""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from commands import object_of, pneud, pneud_here
from pneud.bench import chart, contestants, rates
from pneud.bench.contestants import AbsentError, TrackScript
from pneud.bench.disturbances import DISTURBANCES, Disturb, cpus_busy
from pneud.bench.law_cost import Law, LawState, begin, header, law_of, reference, tick
from pneud.bench.sample import Sample, Samples, from_object, process_state, ratio_of_turns
from pneud.bench.tables import as_object, in_words
from pneud.config.sections import ConfigError
from pneud.loading import Loaded, load
from pneud.log.files.reader import read_log
from pneud.verbs.bench import Contestant, bench
from pure2c import TranslationError
from pure2c.to_c import Translator

MACHINE = {"kernel": "Linux", "cpu_model": "A CPU", "cpus": [0, 1], "hypervisor": "", "load": 0.5}
SETTING = {"rate_hz": 1000.0, "scheduling": "SCHED_FIFO 80", "bus": "unixcan", "pairs": 2, "turn_s": 1.0}


def sample(lateness_us: list[int], **more: object) -> Sample:
    values = [us * 1000 for us in lateness_us]
    return Sample({"lateness": values, "wakeup": values}, len(lateness_us))._replace(**more)  # type: ignore[arg-type]


def series(name: str, *turns: list[int]) -> Samples:
    one = Samples(name, f"what {name} is")
    for number, turn in enumerate(turns):
        one.add(sample(turn), number)
    return one


@pytest.fixture
def track(tmp_path: Path) -> TrackScript:
    axis = load("virtual.toml")
    return TrackScript(axis, axis.path, None, 0, None, tmp_path)


# Samples


def test_a_series_tells_when_the_first_ticks_came() -> None:
    one = Samples("x", "")
    assert one.as_object()["first_tick_ms"] is None
    for turn, start_ns in enumerate((3_000_000, 8_000_000, 4_000_000)):
        one.add(sample([10], start_ns=start_ns), turn)
    found = one.as_object()["first_tick_ms"]
    assert found == pytest.approx({"median": 4.0, "least": 3.0, "greatest": 8.0})


def test_a_series_counts_all_values_of_all_turns() -> None:
    one = Samples("x", "")
    one.add(
        sample([10, 20], skipped=1, cpu_s={"loop": 0.25}, elapsed_s=1.0, page_faults=3, switches=(2, 0)), 0
    )
    one.add(
        sample([30, 40], skipped=2, cpu_s={"loop": 0.25}, elapsed_s=1.0, page_faults=1, switches=(2, 4)), 1
    )
    found = one.as_object()
    assert (found["turns"], found["ticks"], found["skipped"]) == (2, 4, 3)
    assert found["lateness_us"]["max"] == 40.0
    assert found["latency_us"] is None
    assert found["cpu_percent"] == {"loop": 25.0}
    assert found["cpu_us_per_tick"] == pytest.approx(125_000.0)
    assert found["page_faults"] == 4
    assert found["switches_per_tick"] == {"voluntary": 1.0, "involuntary": 1.0}


def test_ratios_are_those_of_turns_that_followed_each_other() -> None:
    ours, theirs = series("pneud", [20], [30], [40]), Samples("x", "")
    theirs.add(sample([10]), 0)
    theirs.add(sample([10]), 2)  # it missed turn 1
    found = ratio_of_turns(ours, theirs, "lateness")
    assert found is not None
    assert found["pairs"] == 2
    assert found["p50"]["median"] == pytest.approx(3.0)
    assert (found["p50"]["least"], found["p50"]["greatest"]) == (pytest.approx(2.0), pytest.approx(4.0))


def test_without_common_turns_there_is_no_ratio() -> None:
    ours, theirs = series("pneud", [20]), Samples("x", "")
    theirs.add(sample([10]), 5)
    assert ratio_of_turns(ours, theirs, "lateness") is None
    assert ratio_of_turns(ours, series("y", [10]), "own") is None


def test_an_object_becomes_a_sample() -> None:
    found = from_object(
        {"lateness_ns": [1, 2], "ticks": 2, "skipped": 0, "elapsed_s": 0.1, "cpu_s": {}, "switches": [3, 4]}
    )
    assert found.durations_ns["lateness"] == [1, 2]
    assert found.durations_ns["own"] == ()
    assert found.switches == (3, 4)
    assert found.page_faults is None


def test_cyclictests_counts_become_durations() -> None:
    thread = {"histogram": {"5": 2, "7": 1}, "max": 250_000, "cycles": 4}
    found = contestants.cyclictest_sample(json.dumps({"thread": {"0": thread}}), 7)
    assert found.durations_ns["lateness"] == [5500, 5500, 7500, 250_000_000], "one lies beyond the histogram"
    assert (found.ticks, found.skipped) == (4, 1 + 35_714), "whole periods of 7 µs"


def test_a_process_is_read_whatever_its_name(tmp_path: Path) -> None:
    folder = tmp_path / "7"
    folder.mkdir()
    words = ["S", *map(str, range(4, 53))]  # each word is its own field number
    words[17] = "1"
    (folder / "stat").write_text(f"7 (a) b ) {' '.join(words)}")
    (folder / "status").write_text("Name:\tx\nvoluntary_ctxt_switches:\t5\nnonvoluntary_ctxt_switches:\t6\n")
    found = process_state(7, tmp_path)
    assert found[1:] == (10 + 12, 5, 6)
    assert found.cpu_s > 0.0
    (folder / "schedstat").write_text("1500000000 1 2")
    assert process_state(7, tmp_path).cpu_s == 1.5


# Report and page


def report() -> dict[str, object]:
    ours, other = series("pneud", [20, 30], [25, 35]), series("cyclictest", [10, 10], [12, 12])
    ours.notes.append("faults: deadline")
    return as_object({"pneud": ours, "cyclictest": other}, {"c": "no compiler"}, MACHINE, SETTING)


def test_the_report_is_json_and_has_everything_by_name() -> None:
    found = json.loads(json.dumps(report(), allow_nan=False))
    assert found["schema"] == 1
    assert list(found["contestants"]) == ["pneud", "cyclictest"]
    assert found["pneud_over"]["cyclictest"]["lateness"]["pairs"] == 2
    assert found["missing"] == {"c": "no compiler"}
    for name in ("pneud", "cyclictest"):
        assert sum(count for _, _, count in found["wakeup_histograms_ns"][name]) == 4


def test_the_words_name_whoever_is_missing_and_what_was_odd() -> None:
    words = in_words(report())
    assert "without c: no compiler" in words
    assert "pneud: faults: deadline" in words
    assert "cyclictest: what cyclictest is" in words
    assert "pneud over cyclictest, wake-up" in words
    assert "ticks skipped: pneud 0, cyclictest 0" in words
    assert max(len(line) for line in words.splitlines()) < 120


def test_the_page_stands_alone_and_shows_every_histogram() -> None:
    found = report()
    page = chart.page(found, "a < b")
    assert "a &lt; b" in page
    assert "http" not in page
    drawing = ET.fromstring(page[page.index("<svg") : page.index("</svg>") + 6])
    lines = [path.get("d", "") for path in drawing.iter("path") if path.get("fill") == "none"]
    assert len(lines) == 2
    assert {text.text for text in drawing.iter("text")} >= {"pneud", "cyclictest", "10", "100 %"}
    for path in lines:
        numbers = [
            float(part.strip("MVH"))
            for part in path.replace("M", " ").replace("V", " ").replace("H", " ").split()
        ]
        assert all(0.0 <= number <= 900.0 for number in numbers)


def test_an_empty_page_is_drawn_too() -> None:
    assert "nothing was measured" in chart.svg({})
    assert "<svg" in chart.svg({"one": [[1000, 1000, 5]]})


@given(st.lists(st.tuples(st.integers(0, 10**9), st.integers(1, 10**6)), min_size=1, max_size=20))
def test_columns_hold_all_values(values: list[tuple[int, int]]) -> None:
    shares = chart.columns([(ns, ns, count) for ns, count in values])
    assert math.isclose(sum(shares.values()), 1.0)


# The highest rate


@pytest.mark.parametrize("limit_hz", [*rates.RATES_HZ, 0.0])
def test_the_highest_rate_is_the_last_one_held(limit_hz: float, track: TrackScript) -> None:
    def turn(_: TrackScript, rate_hz: float, __: float) -> Sample:
        if rate_hz > limit_hz and rate_hz > 3000:
            raise AbsentError("too fast to start")
        return Sample({}, 1000, skipped=0 if rate_hz <= limit_hz else 100)

    assert rates.highest(turn, track, 1.0) == (limit_hz or None)


def test_who_cannot_start_at_any_rate_says_why(track: TrackScript) -> None:
    def turn(_: TrackScript, rate_hz: float, __: float) -> Sample:
        raise AbsentError("out of order")

    with pytest.raises(AbsentError, match="out of order"):
        rates.highest(turn, track, 1.0)


def test_one_pause_of_the_host_does_not_decide(track: TrackScript) -> None:
    tried: list[float] = []

    def turn(_: TrackScript, rate_hz: float, __: float) -> Sample:
        tried.append(rate_hz)
        return Sample({}, 1000, skipped=100 if tried.count(rate_hz) == 1 else 0)

    assert rates.highest(turn, track, 1.0) == rates.RATES_HZ[-1]


@pytest.mark.parametrize(
    ("found", "holds"),
    [
        (Sample({}, 10_000), True),
        (Sample({}, 10_000, skipped=20), True),
        (Sample({}, 10_000, skipped=21), False),
        (Sample({}, 10_000, incomplete=101), False),
        (Sample({}, 10_000, note="faults: deadline"), False),
        (Sample({}, 0), False),
    ],
)
def test_a_rate_is_held_when_hardly_a_tick_is_missing(found: Sample, holds: bool) -> None:
    assert rates.held(found) is holds


@pytest.mark.parametrize("name", ["virtual.toml", "rig.toml", "paper-case1.toml"])
def test_a_bus_without_time_is_the_same_axis_otherwise(name: str, tmp_path: Path) -> None:
    axis = load(name)
    quick = rates.without_bus_time(TrackScript(axis, axis.path, None, 0, None, tmp_path))
    config = quick.axis.config
    assert config.plant.bitrate_bit_s == config.bus.bitrate_bit_s == math.inf
    same = axis.config.model_copy(
        update={
            "plant": axis.config.plant.model_copy(update={"bitrate_bit_s": math.inf}),
            "bus": axis.config.bus.model_copy(update={"bitrate_bit_s": math.inf, "dbc": config.bus.dbc}),
        }
    )
    assert config == same
    assert load(quick.config_file).config == config


# The law in C


def needs_compiler() -> str:
    compiler = shutil.which("cc")
    assert compiler is not None, "these tests need a C compiler: apt install gcc libc6-dev"
    return compiler


def measurements(p: Law) -> list[tuple[float, ...]]:
    """Position, pressures, supply, applied command, time of a load that follows, but not quite."""
    random = Random(1)
    c = p.controller.cylinder
    rows: list[tuple[float, ...]] = []
    for n in range(600):
        t_s = n * p.controller.h
        position_m = reference(0.45, t_s, p).position_m + 2e-5 * math.sin(0.05 * n)
        p2_pa = 3e5 + 5e3 * math.sin(0.013 * n) + random.uniform(-50.0, 50.0)
        p1_pa = (c.rod_force_n + p2_pa * c.A2 + 0.5 * math.sin(0.03 * n)) / c.A1
        rows.append((position_m, p1_pa, p2_pa, 6e5 + 1e3 * math.sin(0.1 * n), 0.3 * math.sin(0.02 * n), t_s))
    return rows


@pytest.mark.slow
@pytest.mark.parametrize("name", ["virtual.toml", "paper-case1.toml"])
def test_the_c_program_computes_the_laws_commands_to_the_bit(name: str, tmp_path: Path) -> None:
    needs_compiler()
    axis = load(name)
    p = law_of(axis)
    rows = measurements(p)
    state: LawState | None = None
    wanted = []
    for position_m, p1_pa, p2_pa, supply_pa, applied_v, t_s in rows:
        state = state or begin(position_m, p1_pa, p2_pa, supply_pa, p)
        state = tick(state, position_m, p1_pa, p2_pa, supply_pa, applied_v, t_s, p)
        wanted.append(state.command_v)
    program = tmp_path / "loop"
    contestants.build(program, axis)
    lines = "".join(" ".join(map(repr, row)) + "\n" for row in rows)
    done = subprocess.run([program, "law"], input=lines, capture_output=True, text=True, check=True)
    assert [float(line) for line in done.stdout.split()] == wanted
    assert len(set(wanted)) > 200, "the law had something to do"


class Pair(NamedTuple):
    a: float
    n: int


def inner(x: float, scale: float = 2.0) -> tuple[float, Pair]:
    return scale * x, Pair(x, round(x))


def outer(x: float, p: Pair, long: bool) -> Pair:
    total, steps = 0.0, 0
    low, high = (x, p.a) if x < p.a else (p.a, x)
    for value in (low, high, -1.0):
        if value in (low, -1.0):
            continue
        total += value
    for _ in range(5):
        total += 0.25
        steps += 1 << 2
        if not -100.0 < total < 100.0:
            break
    doubled, pair = inner(x)
    while steps > 10:
        steps -= 3
    total += doubled**2 / 3 if long and x != 0.0 else max(pair.a, p.a, -x)
    return Pair(a=total + inner(x, 0.5)[1].n, n=steps)


def run_c(function: Callable[..., Pair], calls: str, folder: Path) -> list[list[float]]:
    c = Translator()
    c.function(function, "f")
    source = folder / "f.c"
    printing = "Pair r; " + "".join(
        f'r = {call}; printf("%.17g %ld\\n", r.a, r.n); ' for call in calls.splitlines()
    )
    source.write_text(f"{c.text()}\n#include <stdio.h>\nint main(void) {{ {printing} return 0; }}\n")
    program = folder / "f"
    subprocess.run([needs_compiler(), "-ffp-contract=off", "-o", program, source, "-lm"], check=True)
    text = subprocess.run([program], capture_output=True, text=True, check=True).stdout
    return [[float(word) for word in line.split()] for line in text.splitlines()]


def test_translated_functions_return_what_the_originals_do(tmp_path: Path) -> None:
    cases = [
        (x, Pair(a, n), long)
        for x in (-7.5, 0.0, 0.3, 2.5, 1e3)
        for a, n in ((1.0, 2), (-3.25, 0))
        for long in (True, False)
    ]
    calls = "\n".join(f"f({x.hex()}, (Pair){{{p.a.hex()}, {p.n}}}, {int(long)})" for x, p, long in cases)
    assert run_c(outer, calls, tmp_path) == [list(outer(*case)) for case in cases]


def with_a_list(x: float) -> float:
    return [x][0]


def with_a_string(x: float) -> float:
    return float("1")


def with_another_type(x: float) -> float:
    y = x
    y = Pair(x, 1)  # type: ignore[assignment]
    return 2.0 * y


@pytest.mark.parametrize("function", [with_a_list, with_a_string, with_another_type])
def test_what_has_no_counterpart_in_c_is_named(function: Callable[..., float]) -> None:
    with pytest.raises(TranslationError, match=function.__name__):
        Translator().function(function)


def test_constants_keep_every_bit() -> None:
    c = Translator()
    assert float.fromhex(c.literal(0.1)) == 0.1
    assert (c.literal(math.inf), c.literal(-math.inf), c.literal(math.nan)) == (
        "INFINITY",
        "-INFINITY",
        "NAN",
    )
    assert c.literal(Pair(1, True)) == "{0x1.0000000000000p+0, 1L}"


def test_the_header_names_where_it_comes_from() -> None:
    assert header(load("virtual.toml")).startswith("/* The law of virtual.toml")


# Contestants


def test_a_log_yields_the_durations_of_its_ticks(tmp_path: Path) -> None:
    log = tmp_path / "x.mcap"
    assert pneud_here("sim", "virtual.toml", "--duration", "0.3", "-o", log).returncode in (0, 1)
    found = contestants.sample_of_log(log, 100, 200)
    assert found.ticks == 200
    assert len(found.durations_ns["lateness"]) == 200
    assert set(found.durations_ns["latency"]) == {100_000}
    assert set(found.durations_ns["wakeup"]) == {0}
    assert len(found.durations_ns["wakeup"]) >= 199, "nothing takes too long there"
    assert found.durations_ns["own"] == [], "a simulation measures no hand-over"
    assert found.incomplete == found.skipped == 0
    assert found.start_ns is None
    first_ns = next(iter(read_log(log))).t_ns
    assert contestants.sample_of_log(log, 100, 200, first_ns - 7).start_ns == 7


def test_contestants_that_cannot_start_say_why(track: TrackScript, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: None)
    with pytest.raises(AbsentError, match="rt-tests"):
        contestants.cyclictest(track, 1000.0, 0.1)
    with pytest.raises(AbsentError, match="gcc"):
        contestants.c_program(track, 1000.0, 0.1)
    with pytest.raises(AbsentError, match="--rate 1: "):
        contestants.pneud(track, 1.0, 0.1)


def test_a_compiler_that_fails_is_named(track: TrackScript, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: "/bin/false")
    with pytest.raises(AbsentError, match="cannot be compiled"):
        contestants.c_program(track, 1000.0, 0.1)


def test_another_database_is_not_for_the_c_program(track: TrackScript, tmp_path: Path) -> None:
    dbc = tmp_path / "own.dbc"
    dbc.write_text(track.axis.dbc.read_text() + "\n")
    axis: Loaded = track.axis._replace(dbc=dbc)
    with pytest.raises(AbsentError, match=r"speaks pneud\.dbc only, not own\.dbc"):
        contestants.c_program(track._replace(axis=axis), 1000.0, 0.1)


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("name", ["empty", "notifier", "c_program", "pneud"])
def test_every_contestant_yields_a_sample(name: str, track: TrackScript) -> None:
    found = getattr(contestants, name)(track, 200.0, 0.5)
    assert found.ticks == 100
    assert len(found.durations_ns["lateness"]) == 100
    assert 80 <= len(found.durations_ns["wakeup"]) <= 100, "nearly all of them slept"
    assert found.cpu_s["loop"] > 0.0
    assert found.page_faults is not None
    assert found.switches is not None
    if name != "empty":
        latency, own = found.durations_ns["latency"], found.durations_ns["own"]
        assert 80 <= len(latency) <= 100, "nearly all ticks had a complete set"
        assert len(own) >= 80
        assert min(latency) > 0
    if name == "pneud":
        assert found.start_ns > 0
        assert set(found.cpu_s) == {"loop", "recorder", "console", "plant"}
        parts = [found.durations_ns[part] for part in ("read", "cycle", "write", "record")]
        assert [sum(values) for values in zip(*parts, strict=True)] == found.durations_ns["own"]


# The verb


def turns_of(*counts: int) -> Contestant:
    """Somebody whose turns are made up: so many wake-ups each, then none any more."""
    left = iter(counts)

    def turn(_: TrackScript, rate_hz: float, seconds: float) -> Sample:
        try:
            return sample([10] * next(left))
        except StopIteration:
            raise AbsentError("had enough") from None

    return Contestant("made up", turn, False)


def measured(field: Mapping[str, Contestant] | None = None, **options: Any) -> int:
    """The exit status of a benchmark of these contestants."""
    with pytest.MonkeyPatch.context() as m:
        if field is not None:
            m.setattr("pneud.verbs.bench.CONTESTANTS", field)
        all_options: dict[str, Any] = {"bus": "unixcan:x", "pairs": 3, "rate_s": 0.0, "json": True} | options
        return bench(**all_options)


@pytest.mark.slow
def test_whoever_cannot_go_on_is_missing_and_the_rest_works(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    page = tmp_path / "bench.html"
    field = {"cyclictest": turns_of(), "pneud": turns_of(5, 5, 5), "empty": turns_of(5)}
    assert measured(field, output=page, turn_s=0.01) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["missing"] == {"cyclictest": "had enough", "empty": "had enough"}
    assert {name: one["turns"] for name, one in found["contestants"].items()} == {"pneud": 3, "empty": 1}
    assert found["pneud_over"]["empty"]["lateness"]["pairs"] == 1
    assert found["setting"]["pairs"] == 3
    assert "</html>" in page.read_text()


def test_without_pneud_itself_the_answer_is_no(capsys: pytest.CaptureFixture[str]) -> None:
    assert measured({"pneud": turns_of(), "empty": turns_of(5, 5, 5)}, json=False) == 1
    assert "without pneud: had enough" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"pairs": 0}, "--pairs 0"),
        ({"rate_s": -1.0}, "--rate-seconds"),
        ({"output": Path("/nowhere/at/all.html")}, "there is no folder"),
        ({"config": "nowhere.toml"}, r"nowhere\.toml"),
        ({"bus": "can0"}, "none of auto"),
        ({"turn_s": 0.0}, "--turn 0"),
        ({"rate_hz": 1.0}, "--rate 1"),
        ({"disturb": True, "output": Path("x.html")}, "--output"),
    ],
)
def test_what_cannot_be_measured_is_refused_at_once(changes: dict[str, object], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        measured({"pneud": turns_of()}, **changes)


@pytest.mark.slow
def test_disturbances_are_compared_with_quiet_turns(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(_: TrackScript, rate_hz: float, seconds: float, disturb: Disturb | None = None) -> Sample:
        return Sample(
            {"own": [200_000 if disturb is cpus_busy else 100_000] * 10}, 10, int(disturb is not None)
        )

    monkeypatch.setattr(contestants, "pneud", run)
    assert measured(disturb=True) == 0
    found = json.loads(capsys.readouterr().out)["disturbances"]
    assert set(found) == {"recorder", "disk", "console", "cpu"}
    for name, one in found.items():
        expected = 2.0 if name == "cpu" else 1.0
        assert one["own_over_quiet"]["p99"]["median"] == pytest.approx(expected, rel=0.02)
        assert one["own_over_quiet"]["pairs"] == 3
        assert (one["quiet"]["skipped"], one["disturbed"]["skipped"]) == (0, 3)
    assert measured(disturb=True, json=False) == 0
    assert "0 → 3" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("name", DISTURBANCES)
def test_the_loop_misses_no_command_however_it_is_disturbed(name: str, track: TrackScript) -> None:
    found = contestants.pneud(track, 200.0, 0.8, DISTURBANCES[name])
    assert (found.ticks, found.note) == (160, "")
    assert found.skipped <= 3, "but for what the machine itself does"


def test_a_usage_error_is_one_line() -> None:
    done = pneud_here("bench", "--pairs", "0")
    assert (done.returncode, done.stdout) == (2, "")
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.slow
@pytest.mark.realtime
def test_bench_as_its_user_runs_it(tmp_path: Path) -> None:
    page = tmp_path / "bench.html"
    done = pneud("bench", "--pairs", 1, "--rate-seconds", 0, "--json", "-o", page)
    assert done.returncode == 0, done.stderr
    found = object_of(done)
    assert {"pneud", "empty", "notifier", "c"} <= set(found["contestants"])
    assert set(found["contestants"]) | set(found["missing"]) == {
        "cyclictest",
        "pneud",
        "empty",
        "notifier",
        "c",
    }
    for name in ("pneud", "notifier", "c"):
        one = found["contestants"][name]
        assert one["ticks"] == 1000
        p = one["latency_us"]
        assert 0.0 < p["p50"] <= p["p99"] <= p["max"]
    assert "<svg" in page.read_text()
