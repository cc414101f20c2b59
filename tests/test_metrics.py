"""Metrics: what a status has as numbers, in both dialects, and what is shipped to watch them with."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import threading
from pathlib import Path
from typing import Any

import pytest

from console_bench import Bench, bench
from log_samples import tick_at
from pneud import resources
from pneud.log.live.ring import FrameTotals, Kept, Since
from pneud.rt.processes import children_of, counters_of
from pneud.safety.faults import F
from pneud.signals import Mileage, Record, State, Timing
from pneud.web.metrics import families, text_of

SHIPPED = resources.configs() / "monitoring"
PROMTOOL = shutil.which("promtool")
LATENESS_NS = (4_000, 30_000, 30_000, 3_000_000)


@pytest.fixture
def status(tmp_path: Path) -> dict[str, Any]:
    with bench(tmp_path) as b:
        return filled(b)


def filled(b: Bench) -> dict[str, Any]:
    """The status of an axis that has a fault, has come too late and was held back."""
    for number, late_ns in enumerate(LATENESS_NS, 1):
        tick = tick_at(number)._replace(state=int(State.FAULT), latched=1 << F.TRAVEL)
        tick = tick._replace(command=tick.command._replace(saturated=1))
        b.ring.put(Record(tick, Timing(late_ns, 0, 0, 0, 250_000, 0), (), 0, (), 0.0))
    b.ring.set_since(Since(Mileage(1), 1e9, Kept.KEPT))
    b.ring.set_status(b.ring.status()._replace(pid=os.getpid()))
    for _ in range(2):
        b.watch.poll()
    return b.ask(b.connect(), "status")


def samples(text: str) -> dict[str, float]:
    lines = (line for line in text.splitlines() if not line.startswith("#"))
    return {name: float(value) for name, _, value in (line.rpartition(" ") for line in lines)}


@pytest.mark.parametrize("openmetrics", [False, True])
def test_a_status_becomes_numbers_in_si(status: dict[str, Any], openmetrics: bool) -> None:
    found = samples(text_of([status], openmetrics))

    def value(name: str, labels: str = "") -> float:
        return found[f'pneud_{name}{{axis="virtual"{labels}}}']

    assert value("up") == 1.0
    assert value("state", ',state="fault"') == 1.0
    assert value("state", ',state="holding"') == 0.0
    assert value("fault_latched", ',fault="travel"') == 1.0
    assert value("position_meters") == pytest.approx(status["position_mm"] * 1e-3)
    assert value("pressure_pascals", ',place="p1"') == pytest.approx(status["pressures_bar"]["p1"] * 1e5)
    assert value("ticks_total") == value("ticks_saturated_total") == len(LATENESS_NS)
    assert value("lateness_seconds_bucket", ',le="5e-06"') == 1.0
    assert value("lateness_seconds_bucket", ',le="5e-05"') == 3.0
    assert value("lateness_seconds_bucket", ',le="+Inf"') == value("lateness_seconds_count") == 4.0
    assert value("lateness_seconds_sum") == pytest.approx(sum(LATENESS_NS) * 1e-9)
    assert value("sensor_to_command_seconds_bucket", ',le="0.0005"') == 4.0


def test_what_nobody_knows_has_no_sample(tmp_path: Path) -> None:
    with bench(tmp_path) as b:
        text = text_of([b.ask(b.connect(), "status")])
    assert "nan" not in text.lower()
    assert "pneud_position_meters{" not in text
    assert samples(text_of([])) == {"pneud_up": 0.0}


def test_names_follow_the_conventions(status: dict[str, Any]) -> None:
    for family in families(status):
        assert re.fullmatch(r"[a-z0-9_]+", family.name)
        assert not re.search(r"_(total|us|ms|mm|bar|mb)$", family.name), "units of SI, and _total is added"
        assert not family.words.endswith(".")
    text = text_of([status], openmetrics=True)
    assert text.endswith("# EOF\n")
    assert text.count("# EOF") == 1
    for name, unit in re.findall(r"^# UNIT (\S+) (\S+)$", text, re.MULTILINE):
        assert name.endswith(f"_{unit}")
    assert "# TYPE pneud_ticks counter" in text
    assert "# TYPE pneud_ticks_total counter" in text_of([status])


def test_several_axes_are_told_apart_in_one_piece(status: dict[str, Any]) -> None:
    text = text_of([status, {**status, "name": "second"}])
    assert text.count('# TYPE pneud_up gauge\npneud_up{axis="virtual"} 1\npneud_up{axis="second"} 1\n') == 1
    assert text.count("# TYPE pneud_lateness_seconds histogram") == 1


def test_labels_are_escaped(status: dict[str, Any]) -> None:
    assert 'bus="a\\"b\\\\c\\nd"' in text_of([{**status, "bus": 'a"b\\c\nd'}])


@pytest.mark.parametrize("name", ["alerts.yml", "dashboard.json"])
def test_what_is_shipped_names_metrics_that_exist(status: dict[str, Any], name: str) -> None:
    there = {line.partition("{")[0] for line in samples(text_of([status]))}
    named = set(re.findall(r"\bpneud_[a-z_]+\b", (SHIPPED / name).read_text()))
    assert len(named) > 8
    assert named <= there


def test_the_dashboard_is_one() -> None:
    board = json.loads((SHIPPED / "dashboard.json").read_text())
    panels = board["panels"]
    assert len({panel["id"] for panel in panels}) == len(panels)
    taken = [(g["x"] + i, g["y"] + k) for g in (p["gridPos"] for p in panels)
             for i in range(g["w"]) for k in range(g["h"])]  # fmt: skip
    assert len(set(taken)) == len(taken)
    assert all(panel["title"] and panel["targets"] for panel in panels)


def promtool(*words: str, text: str = "") -> subprocess.CompletedProcess[str]:
    if PROMTOOL is None:
        pytest.skip("no promtool here: apt install prometheus")
    return subprocess.run(
        [PROMTOOL, *words], input=text, capture_output=True, text=True, timeout=30, check=False
    )


def test_prometheus_takes_rules_and_metrics(status: dict[str, Any]) -> None:
    rules = promtool("check", "rules", str(SHIPPED / "alerts.yml"))
    assert rules.returncode == 0, rules.stderr
    metrics = promtool("check", "metrics", text=text_of([status]))
    assert (metrics.returncode, metrics.stdout + metrics.stderr) == (0, "")


def test_prometheus_takes_every_expression_of_the_dashboard(tmp_path: Path) -> None:
    board = json.loads((SHIPPED / "dashboard.json").read_text())
    asked = [target["expr"] for panel in board["panels"] for target in panel["targets"]]
    plain = [e.replace("$__rate_interval", "1m").replace("$axis", ".*") for e in asked]
    assert not any("$" in expression for expression in plain)
    rules = [{"record": f"x{n}", "expr": expression} for n, expression in enumerate(plain)]
    file = tmp_path / "dashboard.yml"
    file.write_text(json.dumps({"groups": [{"name": "dashboard", "rules": rules}]}))
    done = promtool("check", "rules", str(file))
    assert done.returncode == 0, done.stderr


def test_an_axis_says_what_it_has_done_and_every_process_what_it_has_used(tmp_path: Path) -> None:
    with bench(tmp_path) as b:
        b.ring.set_since(Since(Mileage(10, 2.0, 0.01, 30.0, 9.0), 1e9, Kept.KEPT))
        b.ring.set_frames(FrameTotals(3000, 2000, 5, 1, 0, 2))
        b.ring.set_mileage(Mileage(5, 1.0, 0.02, 10.0, 4.0))
        b.ring.set_status(b.ring.status()._replace(pid=os.getpid()))
        found = samples(text_of([b.ask(b.connect(), "status")]))
    axis = 'axis="virtual"'
    assert found[f"pneud_strokes_total{{{axis}}}"] == 15.0
    assert found[f"pneud_travel_meters_total{{{axis}}}"] == 3.0
    assert found[f"pneud_air_cubic_meters_total{{{axis}}}"] == pytest.approx(0.03)
    assert found[f"pneud_engaged_seconds_total{{{axis}}}"] == pytest.approx(40.0, abs=0.01)
    assert found[f"pneud_hardest_stop_meters_per_second_squared{{{axis}}}"] == 9.0
    assert found[f'pneud_frames_total{{{axis},way="received"}}'] == 3000.0
    assert found[f'pneud_frames_amiss_total{{{axis},kind="lost"}}'] == 5.0
    assert found[f"pneud_mileage_kept{{{axis}}}"] == 1.0
    own = [name for name in found if "pneud_process_" in name]
    kinds = {name.partition("{")[0].removeprefix("pneud_process_") for name in own}
    assert kinds == {"cpu_seconds_total", "waited_seconds_total", "context_switches_total",
                     "page_faults_total", "resident_memory_bytes", "threads"}  # fmt: skip


def test_a_process_is_counted_as_linux_counts_it() -> None:
    before = counters_of(os.getpid(), "me")
    assert before is not None
    begun = os.times()
    while os.times().user < begun.user + 0.03:
        pass
    now = counters_of(os.getpid())
    assert now is not None
    assert (before["name"], before["pid"]) == ("me", os.getpid())
    assert now["threads"] >= threading.active_count()
    assert now["user_s"] == pytest.approx(os.times().user, abs=0.02)
    assert now["resident_bytes"] > 10_000_000
    assert now["page_faults"]["minor"] > 0
    assert counters_of(2**22 + 1) is None


def test_odd_names_and_old_kernels_are_no_obstacle(tmp_path: Path) -> None:
    folder = tmp_path / "7"
    folder.mkdir()
    numbers = " ".join(map(str, range(3, 52)))
    (folder / "stat").write_text(f"7 (pneud-a) b (c) S {numbers}")
    (folder / "status").write_text("voluntary_ctxt_switches:\t5\nnonvoluntary_ctxt_switches:\t6\n")
    found = counters_of(7, proc=tmp_path)
    assert found is not None
    assert (found["name"], found["waited_s"]) == ("a) b (c", None)
    assert found["switches"] == {"voluntary": 5, "involuntary": 6}
    assert children_of(7, tmp_path) == []


def quiet_then_told(
    name: str, before: str, then: str, labels: dict[str, str], words: dict[str, str]
) -> list[dict[str, Any]]:
    """Of an alert that is a warning: there is none at first, and one later."""
    labels = {key: value for key, value in labels.items() if key != "fault"} | {"severity": "warning"}
    told = [{"exp_labels": labels, "exp_annotations": words}]
    return [
        {"eval_time": before, "alertname": name, "exp_alerts": []},
        {"eval_time": then, "alertname": name, "exp_alerts": told},
    ]


def test_alerts_come_when_they_should(tmp_path: Path) -> None:
    series = [
        ('pneud_fault_latched{axis="a",fault="travel"}', "0x5 1x15"),
        ('pneud_ticks_saturated_total{axis="a"}', "0+30000x30"),
        ('pneud_ticks_total{axis="a"}', "0+60000x30"),
        ('pneud_process_waited_seconds_total{axis="a",process="loop"}', "0+0.6x8 4.8+6x22"),
        ('pneud_process_waited_seconds_total{axis="a",process="recorder"}', "0+30x30"),
        ('pneud_mileage_kept{axis="a"}', "1x5 0x25"),
    ]
    labels = {"severity": "critical", "axis": "a", "fault": "travel"}
    test = {
        "rule_files": [str(SHIPPED / "alerts.yml")],
        "tests": [{
            "interval": "1m",
            "input_series": [{"series": name, "values": values} for name, values in series],
            "alert_rule_test": [
                {"eval_time": "4m", "alertname": "PneudFault", "exp_alerts": []},
                {"eval_time": "10m", "alertname": "PneudFault", "exp_alerts": [{
                    "exp_labels": labels,
                    "exp_annotations": {"summary": "a: fault travel",
                                        "description": "pneud status has the cause and its cure"},
                }]},
                *quiet_then_told("PneudLoopWaits", "8m", "25m", labels | {"process": "loop"}, {
                    "summary": "a: others have the loop's processor 10% of the time",
                    "description": "realtime.cpu and other_cpus keep them apart; pneud doctor"}),
                *quiet_then_told("PneudMileageNotKept", "7m", "12m", labels, {
                    "summary": "a: what the axis does is not kept",
                    "description": "disk full or read-only, or another daemon with an axis of that name;"
                                   " pneud status"}),
            ],
        }],
    }  # fmt: skip
    file = tmp_path / "test.yml"
    file.write_text(json.dumps(test))  # which is YAML, too
    done = promtool("test", "rules", str(file))
    assert done.returncode == 0, done.stdout + done.stderr
