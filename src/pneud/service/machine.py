"""What this machine is: the facts that decide how punctual a loop on it can be, read but not judged.

Everything comes from files below a root folder or from functions that can be replaced, so that any machine
can be made up. What cannot be read is None or empty; nothing raises. Linux only.
"""

from __future__ import annotations

import gzip
import os
import pickle
import platform
import re
import shutil
import socket
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from pneud import crew
from pneud.rt import setup
from pneud.rt.setup import isolated_cpus

HRTIMER_RESOLUTION_S = 1e-6  # without high-resolution timers the clock tells 1 ms or more
TOOLS = ("cyclictest", "cc", "ip", "candump")


class InterfaceFacts(NamedTuple):
    """A network interface."""

    name: str
    is_can: bool
    up: bool
    queue_length: int


class Facts(NamedTuple):
    """A machine."""

    kernel: str
    preemption: str  # "rt", "full", "lazy", "voluntary", "none", "dynamic" (mode unknown) or ""
    cpu_model: str
    cpus: tuple[int, ...]  # those this process may use
    isolated: tuple[int, ...]
    governors: tuple[str, ...]  # in use; none where the frequency is not this kernel's business
    clock_source: str
    clock_ns: float  # what reading the clock costs
    timer_resolution_s: float
    hypervisor: str  # empty on hardware
    stolen: float | None  # part of the time since boot that the host kept for itself
    thermal_throttles: int | None  # since boot, all CPUs
    quota_cpus: float | None  # CPU time the control group may use; None without a limit
    quota_throttles: int | None
    load: float | None  # of the last minute
    rt_runtime: float | None  # part of the time that real-time tasks may take
    group_rt_runtime_us: int | None  # of this control group; None where the kernel does not ration it
    af_can: str  # empty where sockets of AF_CAN can be had, else why not
    interface: InterfaceFacts | None  # the one asked for, if it is there
    log_free_bytes: int | None
    log_writable: bool
    python: str
    debug_build: bool
    tools: tuple[str, ...]  # of TOOLS, those that are there


def try_af_can() -> str:
    """Why there are no sockets of AF_CAN; empty where there are."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (OSError, AttributeError) as e:
        return str(getattr(e, "strerror", None) or e)
    return ""


def read(
    interface: str | None,
    log_folder: Path,
    *,
    root: Path = Path("/"),
    af_can: Callable[[], str] = try_af_can,
    which: Callable[[str], str | None] = shutil.which,
) -> Facts:
    """The facts of this machine, an interface that is wanted, and a folder for logs, which need not exist."""
    cpu = root / "sys/devices/system/cpu"
    info = _text(root / "proc/cpuinfo")
    there = next((p for p in (log_folder, *log_folder.parents) if p.is_dir()), None)
    quota, throttles = _quota(root)
    return Facts(
        kernel=f"{platform.system()} {platform.release()} {platform.machine()}",
        preemption=preemption(
            _text(root / "sys/kernel/realtime"),
            _text(root / "proc/version"),
            _text(root / "sys/kernel/debug/sched/preempt"),
            _text(root / "proc/cmdline"),
            _kernel_config(root),
        ),
        cpu_model=_field(info, "model name") or platform.processor() or platform.machine(),
        cpus=tuple(sorted(os.sched_getaffinity(0))),
        isolated=isolated_cpus(root),
        governors=tuple(sorted({_text(p) for p in cpu.glob("cpu[0-9]*/cpufreq/scaling_governor")} - {""})),
        clock_source=_text(root / "sys/devices/system/clocksource/clocksource0/current_clocksource"),
        clock_ns=_clock_cost_ns(),
        timer_resolution_s=time.clock_getres(time.CLOCK_MONOTONIC),
        hypervisor=_hypervisor(root, info),
        stolen=_stolen(_text(root / "proc/stat")),
        thermal_throttles=_thermal(cpu),
        quota_cpus=quota,
        quota_throttles=throttles,
        load=_number(_text(root / "proc/loadavg").split()),
        rt_runtime=_rt_runtime(root),
        group_rt_runtime_us=_group_rt_runtime(root),
        af_can=af_can(),
        interface=_interface(root, interface),
        log_free_bytes=shutil.disk_usage(there).free if there is not None else None,
        log_writable=there is not None and os.access(there, os.W_OK | os.X_OK),
        python=f"{platform.python_implementation()} {platform.python_version()}",
        debug_build=hasattr(sys, "gettotalrefcount"),
        tools=tuple(tool for tool in TOOLS if which(tool)),
    )


def attempt(priority: int, cpu: int | None, lock_memory: bool) -> list[setup.Report]:
    """What `setup.apply` would get, tried in a child so that this process stays as it is."""
    readable, writable = os.pipe()

    def main() -> None:
        os.write(writable, pickle.dumps(setup.apply(priority, cpu, lock_memory)))

    child = crew.fork(main, keep=(writable,))
    os.close(writable)
    with os.fdopen(readable, "rb") as pipe:
        data = pipe.read()
    os.waitpid(child, 0)
    reports: list[setup.Report] = pickle.loads(data) if data else []
    return reports


def preemption(realtime: str, version: str, debug: str, cmdline: str, config: str) -> str:
    """The kernel's preemption model.

    Args:
        realtime: /sys/kernel/realtime.
        version: /proc/version.
        debug: /sys/kernel/debug/sched/preempt, where root may look: the mode in force in brackets.
        cmdline: of the kernel.
        config: of the kernel, where it is known.

    Returns:
        rt, full, lazy, voluntary, none, dynamic (a mode chosen at boot that does not show), or nothing.
    """
    if realtime == "1" or "PREEMPT_RT" in version:
        return "rt"
    chosen = re.search(r"\((\w+)\)", debug) or re.search(r"\bpreempt=(\w+)", cmdline)
    if chosen:
        return chosen[1]
    for mode in ("LAZY", "VOLUNTARY", "NONE"):
        if f"\nCONFIG_PREEMPT_{mode}=y" in "\n" + config:
            return mode.lower()
    if "\nCONFIG_PREEMPT=y" in "\n" + config:
        return "full"
    if "PREEMPT_DYNAMIC" in version:
        return "dynamic"
    return "full" if re.search(r"\bPREEMPT\b", version) else ""


def _text(path: Path) -> str:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""


def _field(text: str, name: str) -> str:
    found = re.search(rf"^{name}\s*:\s*(.+)$", text, re.MULTILINE)
    return found[1].strip() if found else ""


def _number(words: Sequence[str]) -> float | None:
    try:
        return float(words[0])
    except (IndexError, ValueError):
        return None


def _kernel_config(root: Path) -> str:
    try:
        return gzip.decompress((root / "proc/config.gz").read_bytes()).decode()
    except (OSError, EOFError):
        return _text(root / f"boot/config-{platform.release()}")


def _clock_cost_ns(readings: int = 2000) -> float:
    """What one reading of the clock costs, loop around it included; the best of a few."""
    best = float("inf")
    clock = time.monotonic_ns
    for _ in range(5):
        before = clock()
        for _ in range(readings // 5):
            clock()
        best = min(best, (clock() - before) / (readings // 5))
    return best


def _hypervisor(root: Path, cpuinfo: str) -> str:
    named = _text(root / "sys/hypervisor/type")
    product = _text(root / "sys/class/dmi/id/product_name")
    if named:
        return named
    if "hypervisor" in _field(cpuinfo, "flags").split():
        return product or "a virtual machine"
    return product if re.search(r"virtual|kvm|qemu|vmware|firecracker", product, re.IGNORECASE) else ""


def _stolen(stat: str) -> float | None:
    words = stat.split("\n", 1)[0].split()
    if len(words) < 9 or words[0] != "cpu":
        return None
    ticks = [int(word) for word in words[1:9]]
    return ticks[7] / sum(ticks) if sum(ticks) else None


def _thermal(cpu: Path) -> int | None:
    counts = [_text(p) for p in cpu.glob("cpu[0-9]*/thermal_throttle/core_throttle_count")]
    return sum(int(count) for count in counts if count.isdigit()) if counts else None


def _groups(root: Path) -> list[Path]:
    """Folders of this process's CPU control group, version 2 and version 1."""
    folders = []
    for line in _text(root / "proc/self/cgroup").splitlines():
        number, controllers, path = [*line.split(":", 2), "", ""][:3]
        if number == "0" or "cpu" in controllers.split(","):
            name = "" if number == "0" else "cpu"
            mounted = [root / "sys/fs/cgroup" / name] + ([root / "sys/fs/cgroup/cpu,cpuacct"] if name else [])
            folders += [folder / path.lstrip("/") for folder in mounted]
    return folders


def _quota(root: Path) -> tuple[float | None, int | None]:
    cpus, throttles = None, None
    for folder in _groups(root):
        words = _text(folder / "cpu.max").split()
        if not words:
            words = [_text(folder / "cpu.cfs_quota_us"), _text(folder / "cpu.cfs_period_us")]
        if len(words) == 2 and words[0].isdigit() and words[1].isdigit():
            cpus = int(words[0]) / int(words[1])
        found = re.search(r"^nr_throttled (\d+)", _text(folder / "cpu.stat"), re.MULTILINE)
        if found:
            throttles = int(found[1])
    return cpus, throttles


def _rt_runtime(root: Path) -> float | None:
    runtime = _number([_text(root / "proc/sys/kernel/sched_rt_runtime_us")])
    period = _number([_text(root / "proc/sys/kernel/sched_rt_period_us")])
    if runtime is None or not period:
        return None
    return 1.0 if runtime < 0 else runtime / period


def _group_rt_runtime(root: Path) -> int | None:
    found = [_number([_text(folder / "cpu.rt_runtime_us")]) for folder in _groups(root)]
    known = [int(runtime) for runtime in found if runtime is not None]
    return known[0] if known else None


def _interface(root: Path, name: str | None) -> InterfaceFacts | None:
    folder = root / "sys/class/net" / (name or "")
    kind = _text(folder / "type")
    if not name or not kind:
        return None
    flags = int(_text(folder / "flags") or "0", 16)
    length = _text(folder / "tx_queue_len")
    return InterfaceFacts(name, kind == "280", bool(flags & 1), int(length) if length.isdigit() else 0)
