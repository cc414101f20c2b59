"""Set-up of the real-time side, tried in children so that the test run itself stays as it is."""

from __future__ import annotations

import gc
import os
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from pneud.rt import setup
from pneud.rt.setup import Report

NAMES = ["gc", "affinity", "memory", "cpu_latency", "timer_slack", "fifo"]


def in_child(action: Callable[[], object]) -> str:
    """The repr of what an action returns in a forked child; what it raises comes back as text too."""
    readable, writable = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(readable)
        try:
            answer = repr(action())
        except BaseException as e:
            answer = f"RAISED {e!r}"
        os.write(writable, answer.encode())
        os._exit(0)
    os.close(writable)
    with os.fdopen(readable, "rb") as pipe:
        answer = pipe.read().decode()
    os.waitpid(child, 0)
    return answer


def reports_in_child(action: Callable[[], list[Report]]) -> dict[str, Report]:
    reports: list[Report] = eval(in_child(action), {"Report": Report})
    return {r.name: r for r in reports}


def drop_all_rights() -> None:
    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (0, 0))
    if os.geteuid() == 0:
        os.setgroups([])
        os.setgid(65534)
        os.setuid(65534)


def test_every_attempt_is_reported_in_one_line_with_a_reason() -> None:
    """In a small process: to lock the memory of one with all that tests load takes seconds."""
    told = "import os; from pneud.rt import setup; print(setup.apply(80, min(os.sched_getaffinity(0)), True))"
    done = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, check=True)
    reports = {report.name: report for report in eval(done.stdout, {"Report": Report})}
    assert list(reports) == NAMES
    for r in reports.values():
        assert r.asked
        assert r.reason
        assert "\n" not in r.reason


def in_force() -> list[bool]:
    """Apply everything, and see whether each report tells what is so."""
    cpu = min(os.sched_getaffinity(0))
    reports = {r.name: r.ok for r in setup.apply(10, cpu, True)}
    lines = Path("/proc/self/status").read_text().splitlines()
    locked_kib = next(int(line.split()[1]) for line in lines if line.startswith("VmLck"))
    slack_ns = int(Path("/proc/self/timerslack_ns").read_text()) or 1  # a FIFO thread has none at all
    return [
        reports["fifo"] == (os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO),
        reports["affinity"] and os.sched_getaffinity(0) == {cpu},
        reports["gc"] and not gc.isenabled() and gc.get_freeze_count() > 0,
        reports["memory"] == (locked_kib > 0),
        reports["timer_slack"] == (slack_ns == 1),
    ]


def test_what_is_reported_as_in_force_really_is() -> None:
    told = "import test_rt_setup; print(test_rt_setup.in_force())"
    done = subprocess.run(
        [sys.executable, "-c", told], cwd=Path(__file__).parent, capture_output=True, text=True, check=True
    )
    assert done.stdout == "[True, True, True, True, True]\n"


def test_refusals_say_what_helps_and_raise_nothing() -> None:
    def apply() -> list[Report]:
        drop_all_rights()
        return setup.apply(80, None, True)

    reports = reports_in_child(apply)
    assert not reports["fifo"].ok
    assert "LimitRTPRIO" in reports["fifo"].reason
    assert not reports["memory"].ok
    assert "LimitMEMLOCK" in reports["memory"].reason
    assert reports["cpu_latency"].ok or "cpu_dma_latency" in reports["cpu_latency"].reason
    assert reports["gc"].ok


def test_a_cpu_that_is_not_there_is_refused_with_those_that_are() -> None:
    for cpu in (5000, 2**40):
        report = reports_in_child(lambda cpu=cpu: setup.apply(0, cpu, False))["affinity"]  # type: ignore[misc]
        assert not report.ok
        assert f"one of {min(os.sched_getaffinity(0))}" in report.reason


def test_the_loop_has_its_cpu_and_the_others_theirs() -> None:
    first, *others = sorted(os.sched_getaffinity(0))
    if not others:
        pytest.skip("this machine has one CPU")

    def fork_and_apply() -> list[object]:
        moved = setup.leave_to_the_loop(first, ())
        child = in_child(lambda: sorted(os.sched_getaffinity(0)))
        reports = {r.name: r for r in setup.apply(0, first, False)}
        return [moved.ok, child == str(others), reports["affinity"].ok, os.sched_getaffinity(0) == {first}]

    assert in_child(fork_and_apply) == "[True, True, True, True]"
    chosen = in_child(lambda: [setup.leave_to_the_loop(first, others[:1]).reason, os.sched_getaffinity(0)])
    assert chosen == str([f"CPUs {others[0]}", {others[0]}])


def test_others_stay_where_they_are_without_a_cpu_for_the_loop() -> None:
    report = reports_in_child(lambda: [setup.leave_to_the_loop(None, (5000,))])["others"]
    assert (report.ok, report.asked) == (False, False)


def test_cpus_for_the_others_that_are_not_there_are_named() -> None:
    report = reports_in_child(lambda: [setup.leave_to_the_loop(0, (5000,))])["others"]
    assert not report.ok
    assert "5000" in report.reason
    assert "realtime.other_cpus" in report.reason


def test_a_single_cpu_is_not_taken_from_the_others() -> None:
    def alone() -> list[Report]:
        os.sched_setaffinity(0, {0})
        return [setup.leave_to_the_loop(0, ())]

    assert "no other CPU than 0" in reports_in_child(alone)["others"].reason


def test_auto_is_the_last_isolated_cpu_else_the_last_of_several(monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for isolated, allowed in (((2, 3), {0, 1}), ((), {0, 1, 5}), ((), {4})):
        monkeypatch.setattr(setup, "isolated_cpus", lambda isolated=isolated: isolated)
        monkeypatch.setattr(os, "sched_getaffinity", lambda _, allowed=allowed: allowed)
        found.append(setup.own_cpu("auto"))
    assert found == [3, 5, None]
    assert [setup.own_cpu(wanted) for wanted in (7, None)] == [7, None]


def test_an_impossible_priority_is_a_refusal_too() -> None:
    report = reports_in_child(lambda: setup.apply(1000, None, False))["fifo"]
    assert not report.ok
    assert "realtime.priority" in report.reason


def test_what_is_not_asked_for_is_left_alone_and_said() -> None:
    def apply() -> list[Report]:
        reports = setup.apply(0, None, False)
        assert os.sched_getscheduler(0) == os.SCHED_OTHER
        return reports

    reports = reports_in_child(apply)
    assert {n for n, r in reports.items() if not r.asked} == {"fifo", "affinity", "memory"}
    assert not any(r.ok for r in reports.values() if not r.asked)


def test_reports_as_text_tell_yes_from_no() -> None:
    text = setup.as_text([Report("a", True, "fine"), Report("b", False, "no right")])
    assert text == {"a": "yes: fine", "b": "no: no right"}
