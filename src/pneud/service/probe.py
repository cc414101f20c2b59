"""What a machine can and cannot do in real time, and what helps: facts in, findings out, worst first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import NamedTuple

from pneud.rt.setup import Report
from pneud.service.machine import HRTIMER_RESOLUTION_S, Facts

FAST_CLOCKS = ("tsc", "arch_sys_counter", "kvm-clock", "hyperv_clocksource_tsc_page", "xen")
SLOW_CLOCK_NS = 500.0  # a tick reads the clock about eight times
QUEUE_LENGTH = 32  # the kernel's own default for CAN is 10
LOG_BYTES_PER_TICK = 0.6e9 / 3.6e6
LEAST_LOG_S = 3600.0
STEAL = 0.001
RT_SHARE = 0.5


class Grade(IntEnum):
    """How bad it is; the worst first."""

    LACK = 0  # the configuration requires it and it is not there
    WARNING = 1  # it works, but later or less surely than it could
    OK = 2

    @property
    def label(self) -> str:
        """As written in texts and JSON."""
        return self.name.lower()


class Finding(NamedTuple):
    """One answer; `cure` is empty where there is nothing to do."""

    name: str
    level: Grade
    found: str
    reason: str  # why it matters
    cure: str


class Wanted(NamedTuple):
    """What a configuration asks of the machine."""

    priority: int
    cpu: int | None
    lock_memory: bool
    required: bool  # the axis must not arm without real-time scheduling
    interface: str | None  # of SocketCAN; None for a bus without
    rate_hz: float


def examine(facts: Facts, reports: Sequence[Report], wanted: Wanted) -> list[Finding]:
    """All findings, the worst first."""
    found = [*_granted(reports, wanted), *_kernel(facts), *_cpus(facts, wanted), *_time_taken(facts)]
    found += [*_bus(facts, wanted), *_surroundings(facts, wanted)]
    return worst_first(found)


def worst_first(findings: Sequence[Finding]) -> list[Finding]:
    """Findings by level, otherwise as they came."""
    return sorted(findings, key=lambda finding: finding.level)


def judged(ok: bool, name: str, found: str, reason: str, cure: str, bad: Grade = Grade.WARNING) -> Finding:
    """A finding that is good or bad; nothing is to be done about a good one."""
    return Finding(name, Grade.OK, found, reason, "") if ok else Finding(name, bad, found, reason, cure)


_GRANTS = {
    "fifo": ("scheduling", "without real-time scheduling any other process delays a tick by milliseconds"),
    "affinity": ("affinity", "a loop that changes its CPU starts with cold caches"),
    "memory": ("locked memory", "a page that has been put away costs a tick milliseconds"),
    "cpu_latency": ("idle states", "a CPU in deep sleep wakes up 50 to 200 µs late"),
    "timer_slack": ("timer slack", "without real-time scheduling timers are put off by 50 µs"),
}


def _granted(reports: Sequence[Report], wanted: Wanted) -> Iterator[Finding]:
    for report in reports:
        if report.name not in _GRANTS or not report.asked:
            continue
        name, reason = _GRANTS[report.name]
        demanded = wanted.required and report.name in ("fifo", "memory")
        bad = Grade.LACK if demanded or report.name == "affinity" else Grade.WARNING
        found, _, cure = report.reason.partition("; ") if not report.ok else (report.reason, "", "")
        yield judged(report.ok, name, found, reason, cure or "see docs/timing.md", bad)
    if wanted.priority > 0 and "fifo" not in [report.name for report in reports]:
        bad = Grade.LACK if wanted.required else Grade.WARNING
        yield Finding("scheduling", bad, "could not be tried", _GRANTS["fifo"][1], "try again")
    if wanted.required and wanted.priority == 0:
        yield Finding(
            "scheduling",
            Grade.LACK,
            "realtime.priority is 0",
            _GRANTS["fifo"][1],
            "set realtime.priority to 1 … 98, or realtime.required to false",
        )


_MODELS = {
    "rt": "PREEMPT_RT: nearly everything can be interrupted",
    "full": "full preemption",
    "lazy": "lazy preemption",
    "voluntary": "voluntary preemption only",
    "none": "no preemption within the kernel",
    "dynamic": "PREEMPT_DYNAMIC; the mode in force does not show",
}


def _kernel(f: Facts) -> Iterator[Finding]:
    yield judged(
        f.preemption == "rt",
        "preemption",
        _MODELS.get(f.preemption, "the kernel's model is unknown"),
        "what the kernel does for others is not put aside for the loop",
        "install a PREEMPT_RT kernel (Debian: linux-image-rt-amd64), or at least boot with preempt=full",
    )
    share = f.rt_runtime
    if share is not None:
        yield judged(
            share >= RT_SHARE,
            "real-time share",
            f"real-time tasks may take {100 * share:g} % of a CPU",
            "beyond it they are stopped for the rest of each period; it saves a machine whose loop runs wild",
            "sysctl kernel.sched_rt_runtime_us=950000",
        )
    if f.group_rt_runtime_us is not None:
        yield judged(
            f.group_rt_runtime_us != 0,
            "group's real-time share",
            f"the control group has {f.group_rt_runtime_us} µs of real-time in each period",
            "a kernel with RT_GROUP_SCHED refuses real-time scheduling in a group without",
            "write 950000 to cpu.rt_runtime_us of it and of those above it, or boot with rt_group_sched=0",
        )


def _cpus(f: Facts, wanted: Wanted) -> Iterator[Finding]:
    yield judged(
        len(f.cpus) > 1,
        "CPUs",
        f"{len(f.cpus)} for this process ({f.cpu_model})",
        "the loop, the recorder and the screen share one",
        "give the machine or the container a second CPU",
    )
    if wanted.cpu is not None:
        isolated, found = wanted.cpu in f.isolated, f"CPU {wanted.cpu} is the loop's"
        n = wanted.cpu
        cure = f"boot with isolcpus=managed_irq,domain,{n} nohz_full={n} rcu_nocbs={n}"
    else:
        isolated, found = False, "the loop is not pinned to a CPU"
        cure = f"set realtime.cpu, best to an isolated one ({', '.join(map(str, f.isolated)) or 'none is'})"
    if len(f.cpus) > 1:
        yield judged(
            isolated,
            "isolation",
            f"{found}, {'isolated' if isolated else 'shared with everything else'}",
            "interrupts and other processes on the loop's CPU delay it and cool its caches",
            cure,
        )
    slow = [governor for governor in f.governors if governor != "performance"]
    yield judged(
        not slow,
        "frequency",
        f"governor {', '.join(f.governors)}" if f.governors else "no governor: firmware or host decides",
        "a CPU that saves power runs an idle loop at its lowest frequency",
        "cpupower frequency-set -g performance",
    )
    throttled = f.thermal_throttles or 0
    yield judged(
        throttled == 0,
        "temperature",
        f"throttled {throttled} times since boot" if f.thermal_throttles is not None else "no counter",
        "a CPU that is too hot stops for milliseconds",
        "mend the cooling; look again under load",
    )


def _time_taken(f: Facts) -> Iterator[Finding]:
    yield judged(
        not f.hypervisor,
        "hypervisor",
        f.hypervisor or "none",
        "the host takes its CPUs away whenever it likes",
        "run a rig on hardware; if it must be a guest, pin its CPUs and give them to nobody else",
    )
    if f.stolen is not None:
        yield judged(
            f.stolen < STEAL,
            "stolen time",
            f"{100 * f.stolen:.2g} % of the time since boot",
            "the loop stands still while the host runs somebody else",
            "give the guest CPUs of its own on the host",
        )
    quota = "no limit" if f.quota_cpus is None else f"limited to {f.quota_cpus:g} CPUs"
    count = f", stopped {f.quota_throttles} times" if f.quota_throttles else ""
    yield judged(
        f.quota_cpus is None and not f.quota_throttles,
        "CPU quota",
        f"{quota}{count}",
        "a control group that has used up its quota stands still, and the recorder with it",
        "lift CPUQuota= of the unit or --cpus of the container",
    )
    yield judged(
        f.clock_source in FAST_CLOCKS and f.clock_ns < SLOW_CLOCK_NS,
        "clock source",
        f"{f.clock_source or 'unknown'}, {f.clock_ns:.0f} ns a reading",
        "every tick reads the clock about eight times",
        "dmesg says why the CPU's own counter was not taken; where it is sound: clocksource=tsc tsc=reliable",
    )
    yield judged(
        f.timer_resolution_s <= HRTIMER_RESOLUTION_S,
        "timers",
        f"resolution {f.timer_resolution_s * 1e9:g} ns",
        "without high-resolution timers every wake-up is rounded to the kernel's tick",
        "boot without highres=off; build the kernel with CONFIG_HIGH_RES_TIMERS",
        Grade.LACK,
    )


def _bus(f: Facts, wanted: Wanted) -> Iterator[Finding]:
    name = wanted.interface
    yield judged(
        not f.af_can,
        "SocketCAN",
        f"no sockets of AF_CAN: {f.af_can}" if f.af_can else "AF_CAN",
        "the rig's bus" if name else "without it a virtual run uses unixcan, which has no bus of its own",
        "modprobe can_raw; in a container on the host; this kernel may have been built without CONFIG_CAN",
        Grade.LACK if name else Grade.WARNING,
    )
    if not name:
        return
    found = f.interface
    if found is None or not found.is_can:
        what = "there is none of that name" if found is None else "is no CAN interface"
        cure = f"ip link show type can; name the right one: bus.channel = socketcan:IF, not {name}"
        yield Finding("interface", Grade.LACK, f"{name}: {what}", "the rig's bus", cure)
        return
    yield judged(
        found.up,
        "interface",
        f"{name} is {'up' if found.up else 'down'}",
        "the rig's bus",
        f"ip link set {name} up type can bitrate 1000000 restart-ms 100 berr-reporting on",
        Grade.LACK,
    )
    yield judged(
        found.queue_length >= QUEUE_LENGTH,
        "transmit queue",
        f"{name} has room for {found.queue_length} frames",
        "a short one refuses frames (ENOBUFS) as soon as the bus is busy",
        f"ip link set {name} txqueuelen 128",
    )


def _surroundings(f: Facts, wanted: Wanted) -> Iterator[Finding]:
    yield judged(
        f.log_writable,
        "log folder",
        "can be written to" if f.log_writable else "cannot be written to",
        "every run writes a log",
        "choose another with --log or STATE_DIRECTORY",
        Grade.LACK,
    )
    if f.log_free_bytes is not None:
        lasts_s = f.log_free_bytes / (LOG_BYTES_PER_TICK * wanted.rate_hz)
        yield judged(
            lasts_s >= LEAST_LOG_S,
            "disk space",
            f"{f.log_free_bytes / 1e9:.3g} GB, about {lasts_s / 3600:.3g} h of log at {wanted.rate_hz:g} Hz",
            "the loop outlives a full disk, the log does not",
            "remove old logs, or choose another folder with --log",
        )
    yield judged(
        not f.debug_build,
        "Python",
        f.python + (", a debug build" if f.debug_build else ""),
        "a debug build is several times slower",
        "install a release build of Python",
    )
    busy = f.load is not None and f.load > len(f.cpus)
    yield judged(
        not busy,
        "load",
        "unknown" if f.load is None else f"{f.load:g} on {len(f.cpus)} CPUs",
        "others keep caches and kernel busy while the loop wants them",
        "move them elsewhere, or measure when they are done",
    )
    yield from _tools(f)


_PACKAGES = {"cyclictest": "rt-tests", "cc": "gcc", "ip": "iproute2", "candump": "can-utils"}
_USES = "cyclictest and a C compiler give `pneud bench` its references, ip and candump are for the bus"


def _tools(f: Facts) -> Iterator[Finding]:
    missing = [tool for tool in _PACKAGES if tool not in f.tools]
    yield judged(
        not missing,
        "tools",
        f"without {', '.join(missing)}" if missing else ", ".join(f.tools),
        _USES,
        f"apt install {' '.join(_PACKAGES[tool] for tool in missing)}",
    )
