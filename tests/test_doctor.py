"""`pneud doctor`: each finding on a machine made up for it, what decides the exit status, what is printed."""

from __future__ import annotations

import gzip
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from commands import object_of, pneud
from pneud.loading import load
from pneud.rt import setup
from pneud.rt.setup import Report
from pneud.service import machine
from pneud.service.examination import diagnose, wanted_by
from pneud.service.machine import Facts, InterfaceFacts
from pneud.service.probe import Finding, Grade, Wanted, examine

FACTS = Facts(
    kernel="Linux 6.1 x86_64",
    preemption="rt",
    cpu_model="A CPU",
    cpus=(0, 1, 2, 3),
    isolated=(3,),
    governors=("performance",),
    clock_source="tsc",
    clock_ns=50.0,
    timer_resolution_s=1e-9,
    hypervisor="",
    stolen=0.0,
    thermal_throttles=0,
    quota_cpus=None,
    quota_throttles=0,
    load=0.1,
    rt_runtime=0.95,
    group_rt_runtime_us=None,
    af_can="",
    interface=InterfaceFacts("can0", True, True, 128),
    log_free_bytes=100_000_000_000,
    log_writable=True,
    python="CPython 3.11.7",
    debug_build=False,
    tools=("cyclictest", "cc", "ip", "candump"),
)
WANTED = Wanted(80, 3, True, True, "can0", 1000.0)
GRANTED = [
    Report(name, True, "granted")
    for name in ("gc", "affinity", "memory", "cpu_latency", "timer_slack", "fifo")
]


def refused(name: str, reason: str = "refused; a cure") -> list[Report]:
    return [Report(name, False, reason) if report.name == name else report for report in GRANTED]


def by_name(findings: list[Finding]) -> dict[str, Finding]:
    return {finding.name: finding for finding in findings}


def test_a_machine_made_for_it_has_nothing_to_be_cured() -> None:
    findings = examine(FACTS, GRANTED, WANTED)
    assert {finding.level for finding in findings} == {Grade.OK}
    assert not any(finding.cure for finding in findings)
    assert len(findings) == len(by_name(findings)) > 15


FAULTS: list[tuple[str, Grade, str, dict[str, Any]]] = [
    ("preemption", Grade.WARNING, "no preemption", {"preemption": "none"}),
    ("preemption", Grade.WARNING, "unknown", {"preemption": ""}),
    ("real-time share", Grade.WARNING, "10 %", {"rt_runtime": 0.1}),
    ("group's real-time share", Grade.WARNING, "0 µs", {"group_rt_runtime_us": 0}),
    ("CPUs", Grade.WARNING, "1 for", {"cpus": (0,)}),
    ("isolation", Grade.WARNING, "shared", {"isolated": (2,)}),
    ("frequency", Grade.WARNING, "powersave", {"governors": ("performance", "powersave")}),
    ("temperature", Grade.WARNING, "7 times", {"thermal_throttles": 7}),
    ("hypervisor", Grade.WARNING, "KVM", {"hypervisor": "KVM"}),
    ("stolen time", Grade.WARNING, "2 %", {"stolen": 0.02}),
    ("CPU quota", Grade.WARNING, "1.5 CPUs", {"quota_cpus": 1.5}),
    ("CPU quota", Grade.WARNING, "stopped 9 times", {"quota_throttles": 9}),
    ("clock source", Grade.WARNING, "hpet", {"clock_source": "hpet"}),
    ("clock source", Grade.WARNING, "900 ns", {"clock_ns": 900.0}),
    ("timers", Grade.LACK, "4e+06 ns", {"timer_resolution_s": 4e-3}),
    ("SocketCAN", Grade.LACK, "no such family", {"af_can": "no such family"}),
    ("interface", Grade.LACK, "none of that name", {"interface": None}),
    ("interface", Grade.LACK, "no CAN", {"interface": InterfaceFacts("can0", False, True, 1000)}),
    ("interface", Grade.LACK, "down", {"interface": InterfaceFacts("can0", True, False, 128)}),
    ("transmit queue", Grade.WARNING, "10 frames", {"interface": InterfaceFacts("can0", True, True, 10)}),
    ("log folder", Grade.LACK, "cannot", {"log_writable": False}),
    ("disk space", Grade.WARNING, "0.1 GB", {"log_free_bytes": 100_000_000}),
    ("Python", Grade.WARNING, "debug build", {"debug_build": True}),
    ("load", Grade.WARNING, "9", {"load": 9.0}),
    ("tools", Grade.WARNING, "cyclictest, candump", {"tools": ("cc", "ip")}),
]


@pytest.mark.parametrize(
    ("name", "level", "says", "changes"), FAULTS, ids=[f"{f[0]}: {f[2]}" for f in FAULTS]
)
def test_each_fault_of_a_machine_is_one_finding_with_reason_and_cure(
    name: str, level: Grade, says: str, changes: dict[str, Any]
) -> None:
    findings = examine(FACTS._replace(**changes), GRANTED, WANTED)
    bad = [finding for finding in findings if finding.level != Grade.OK]
    assert [finding.name for finding in bad] == [name]
    assert bad[0].level == level
    assert says in bad[0].found
    assert bad[0].reason
    assert bad[0].cure
    assert findings[0] is bad[0], "the worst comes first"


@pytest.mark.parametrize(
    ("report", "name", "level"),
    [
        ("fifo", "scheduling", Grade.LACK),
        ("memory", "locked memory", Grade.LACK),
        ("affinity", "affinity", Grade.LACK),
        ("cpu_latency", "idle states", Grade.WARNING),
        ("timer_slack", "timer slack", Grade.WARNING),
    ],
)
def test_what_the_system_refuses_is_a_finding_with_its_own_cure(report: str, name: str, level: Grade) -> None:
    (bad,) = [f for f in examine(FACTS, refused(report), WANTED) if f.level != Grade.OK]
    assert bad == Finding(name, level, "refused", bad.reason, "a cure")


def test_without_required_a_refusal_is_a_warning() -> None:
    wanted = WANTED._replace(required=False)
    for report in ("fifo", "memory"):
        (bad,) = [f for f in examine(FACTS, refused(report), wanted) if f.level != Grade.OK]
        assert bad.level == Grade.WARNING


def test_what_was_not_asked_for_is_no_finding() -> None:
    reports = [Report("memory", False, "not asked for", asked=False), *GRANTED[3:]]
    assert "locked memory" not in by_name(examine(FACTS, reports, WANTED))


def test_required_real_time_without_a_priority_is_a_lack() -> None:
    unasked = [Report("fifo", False, "not asked for", asked=False)]
    found = by_name(examine(FACTS, unasked, WANTED._replace(priority=0)))
    assert found["scheduling"].level == Grade.LACK


def test_a_machine_that_cannot_be_asked_is_not_fine() -> None:
    assert by_name(examine(FACTS, [], WANTED))["scheduling"].level == Grade.LACK


def test_a_virtual_bus_needs_no_interface() -> None:
    facts = FACTS._replace(af_can="no such family", interface=None)
    found = by_name(examine(facts, GRANTED, WANTED._replace(interface=None)))
    assert found["SocketCAN"].level == Grade.WARNING
    assert "interface" not in found


def test_an_unpinned_loop_is_told_which_cpus_are_isolated() -> None:
    found = by_name(examine(FACTS, GRANTED, WANTED._replace(cpu=None)))
    assert found["isolation"].level == Grade.WARNING
    assert "(3)" in found["isolation"].cure


@pytest.mark.parametrize(
    ("realtime", "version", "debug", "cmdline", "config", "model"),
    [
        ("1", "", "", "", "", "rt"),
        ("", "Linux 6.1 #1 SMP PREEMPT_RT", "", "", "", "rt"),
        ("", "#1 SMP PREEMPT_DYNAMIC", "none voluntary (full)", "", "", "full"),
        ("", "#1 SMP PREEMPT_DYNAMIC", "", "quiet preempt=voluntary", "", "voluntary"),
        ("", "#1 SMP PREEMPT_DYNAMIC", "", "quiet", "CONFIG_PREEMPT_BUILD=y\nCONFIG_PREEMPT_NONE=y", "none"),
        ("", "#1 SMP PREEMPT_DYNAMIC", "", "quiet", "CONFIG_PREEMPT=y", "full"),
        ("", "#1 SMP PREEMPT_DYNAMIC", "", "quiet", "", "dynamic"),
        ("", "#1 SMP PREEMPT", "", "", "", "full"),
        ("", "#1 SMP", "", "", "", ""),
    ],
)
def test_preemption_model(
    realtime: str, version: str, debug: str, cmdline: str, config: str, model: str
) -> None:
    assert machine.preemption(realtime, version, debug, cmdline, config) == model


def test_lists_of_cpus() -> None:
    assert setup.cpu_list("1,3-5,8") == (1, 3, 4, 5, 8)
    assert setup.cpu_list("") == ()


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """The files of a made-up machine."""
    files = {
        "proc/version": "Linux #1 SMP PREEMPT_DYNAMIC",
        "proc/cpuinfo": "model name\t: Made-up 9000\nflags\t\t: fpu hypervisor sse",
        "proc/stat": "cpu  10 0 20 60 0 0 0 10 0 0\ncpu0 1 2 3",
        "proc/loadavg": "1.50 1.00 0.50 1/100 1234",
        "proc/self/cgroup": "3:cpu,cpuacct:/unit\n0::/unit",
        "proc/sys/kernel/sched_rt_runtime_us": "-1",
        "proc/sys/kernel/sched_rt_period_us": "1000000",
        "sys/devices/system/cpu/isolated": "2-3",
        "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor": "powersave",
        "sys/devices/system/cpu/cpu0/thermal_throttle/core_throttle_count": "3",
        "sys/devices/system/cpu/cpu1/thermal_throttle/core_throttle_count": "4",
        "sys/devices/system/clocksource/clocksource0/current_clocksource": "hpet",
        "sys/class/dmi/id/product_name": "KVM machine",
        "sys/fs/cgroup/unit/cpu.max": "150000 100000",
        "sys/fs/cgroup/unit/cpu.stat": "nr_periods 5\nnr_throttled 2",
        "sys/fs/cgroup/cpu/unit/cpu.rt_runtime_us": "0",
        "sys/class/net/can0/type": "280",
        "sys/class/net/can0/flags": "0x40080",
        "sys/class/net/can0/tx_queue_len": "10",
        "logs/here": "",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text + "\n")
    (tmp_path / "proc/config.gz").write_bytes(gzip.compress(b"CONFIG_X=y\nCONFIG_PREEMPT_VOLUNTARY=y\n"))
    return tmp_path


def test_facts_are_read_from_the_files_of_the_machine(root: Path) -> None:
    facts = machine.read(
        "can0",
        root / "logs" / "not" / "yet",
        root=root,
        af_can=lambda: "",
        which=lambda name: name if name == "ip" else None,
    )
    assert facts.preemption == "voluntary"
    assert facts.cpu_model == "Made-up 9000"
    assert facts.isolated == (2, 3)
    assert facts.governors == ("powersave",)
    assert facts.clock_source == "hpet"
    assert facts.hypervisor == "KVM machine"
    assert facts.stolen == pytest.approx(0.1)
    assert facts.thermal_throttles == 7
    assert (facts.quota_cpus, facts.quota_throttles) == (1.5, 2)
    assert facts.load == 1.5
    assert facts.rt_runtime == 1.0
    assert facts.group_rt_runtime_us == 0
    assert facts.interface == InterfaceFacts("can0", True, False, 10)
    assert facts.log_writable
    assert facts.tools == ("ip",)
    assert facts.clock_ns > 0


def test_a_machine_that_tells_nothing_is_read_all_the_same(tmp_path: Path) -> None:
    facts = machine.read("can0", tmp_path, root=tmp_path / "empty", af_can=lambda: "no", which=lambda _: None)
    assert facts.interface is None
    assert facts.stolen is facts.quota_cpus is facts.load is facts.rt_runtime is None
    assert facts.preemption == facts.hypervisor == facts.clock_source == ""
    assert examine(facts, GRANTED, WANTED)


def answers(facts: Facts, reports: list[Report]) -> dict[str, Callable[..., Any]]:
    return {"read": lambda interface, folder: facts, "attempt": lambda *_: reports}


def test_exit_is_0_only_where_everything_required_is_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert diagnose("rig.toml", False, **answers(FACTS, GRANTED)) == 0
    assert "all that axis rig requires is there; 1 warning" in capsys.readouterr().out
    assert diagnose("rig.toml", False, **answers(FACTS, refused("fifo"))) == 1
    out = capsys.readouterr().out
    assert out.splitlines()[1].startswith("lack scheduling: refused")
    assert "cure a cure" in out
    assert "lacks 1 of what axis rig requires" in out
    assert "\x1b" not in out, "plain text where there is no terminal"
    assert diagnose("virtual.toml", False, **answers(FACTS, refused("fifo"))) == 0


def test_the_object_carries_machine_and_findings(capsys: pytest.CaptureFixture[str]) -> None:
    assert diagnose("rig.toml", True, **answers(FACTS._replace(interface=None), GRANTED)) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["schema"] == 1
    assert found["ok"] is False
    assert found["machine"]["cpu_model"] == "A CPU"
    assert found["findings"][0] | {"reason": "", "cure": ""} == {
        "name": "interface",
        "level": "lack",
        "found": "can0: there is none of that name",
        "reason": "",
        "cure": "",
    }


def test_what_a_configuration_wants() -> None:
    cpu = setup.own_cpu("auto")
    assert wanted_by(load("rig.toml").config) == Wanted(80, cpu, True, True, "can0", 1000.0)
    assert wanted_by(load("virtual.toml").config).interface is None


def test_doctor_on_this_machine() -> None:
    done = pneud("doctor", "--json")
    found = object_of(done)
    assert done.returncode == (0 if found["ok"] else 1)
    levels = [finding["level"] for finding in found["findings"]]
    assert levels == sorted(levels, key=["lack", "warning", "ok"].index)
    assert {"scheduling", "clock source", "SocketCAN", "tools"} <= {f["name"] for f in found["findings"]}


def test_doctor_of_a_missing_configuration_is_a_usage_error() -> None:
    done = pneud("doctor", "nowhere.toml")
    assert (done.returncode, done.stdout) == (2, "")


def test_the_attempt_leaves_this_process_as_it_is() -> None:
    """In a small process: to lock the memory of one with all that tests load takes seconds."""
    told = """if True:
        import gc, os
        from pneud.service import machine
        look = lambda: (os.sched_getscheduler(0), os.sched_getaffinity(0), gc.isenabled())
        before = look()
        print(machine.attempt(1, min(os.sched_getaffinity(0)), True)[0].name, look() == before)
    """
    done = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, check=True)
    assert done.stdout == "gc True\n"
