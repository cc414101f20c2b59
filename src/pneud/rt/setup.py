"""What the loop asks of the machine: real-time scheduling, one CPU, locked memory, no deep sleep, no GC.

Everything is attempted and reported and nothing raises, so that an axis still runs on a machine that refuses,
and says so. Linux only.
"""

import contextlib
import ctypes
import errno
import gc
import os
import resource
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

_PR_SET_TIMERSLACK = 29
_MCL_CURRENT = 1
_MCL_FUTURE = 2
_CAP_IPC_LOCK = 14
_DMA_LATENCY = Path("/dev/cpu_dma_latency")


class Report(NamedTuple):
    """How one attempt went."""

    name: str
    ok: bool  # it is in force
    reason: str  # one line: what is in force, or why not and what helps
    asked: bool = True  # False where the configuration does not want it


_libc = ctypes.CDLL(None, use_errno=True)
_held_open: list[int] = []  # the kernel honours /dev/cpu_dma_latency for as long as it is open


def apply(priority: int, cpu: int | None, lock_memory: bool) -> list[Report]:
    """Attempt everything for the calling thread; to be called after all forks, right before the loop.

    Args:
        priority: of SCHED_FIFO, 1 … 98; 0 leaves the scheduling alone.
        cpu: the only CPU to run on; None leaves the choice to the kernel.
        lock_memory: keep all pages in memory.

    Returns:
        A report each of gc, fifo, affinity, memory, cpu_latency and timer_slack.
    """
    return [
        freeze_gc(),
        _attempt("affinity", lambda: _affinity(cpu)) if cpu is not None else _unasked("affinity", "cpu"),
        _attempt("memory", _lock_memory) if lock_memory else _unasked("memory", "lock_memory"),
        _attempt("cpu_latency", _forbid_deep_sleep),
        _attempt("timer_slack", _timer_slack),
        _attempt("fifo", lambda: _fifo(priority)) if priority > 0 else _unasked("fifo", "priority"),
    ]


def hurry(priority: int) -> None:
    """Have the priority before `apply`: what this process forks does not get it, and goes beside it.

    To lock the memory takes long, and would wait for all that.
    """
    if priority > 0:
        with contextlib.suppress(OSError):  # which `apply` will say
            _fifo(priority)


def leave(cpus: set[int]) -> None:
    """Give back what another program in this process would have of it: scheduling, the CPU, the timer slack.

    Args:
        cpus: that it had before.
    """
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    with contextlib.suppress(OSError):
        os.sched_setaffinity(0, cpus)
    _libc.prctl(_PR_SET_TIMERSLACK, 0, 0, 0, 0)


def cpu_list(text: str) -> tuple[int, ...]:
    """The numbers in a list such as 1,3-5."""
    found: list[int] = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        if first.strip().isdigit():
            found += range(int(first), int(last or first) + 1)
    return tuple(found)


def isolated_cpus(root: Path = Path("/")) -> tuple[int, ...]:
    """CPUs on which the kernel puts nothing by itself; `root` is taken for /."""
    try:
        return cpu_list((root / "sys/devices/system/cpu/isolated").read_text())
    except OSError:
        return ()


def own_cpu(wanted: int | str | None) -> int | None:
    """The CPU that the loop is to have.

    Args:
        wanted: its number; "auto" for the last isolated one, else the last one of several; None for none.
    """
    if not isinstance(wanted, str):
        return wanted
    allowed = sorted(os.sched_getaffinity(0))
    return max(isolated_cpus(), default=allowed[-1] if len(allowed) > 1 else None)


def leave_to_the_loop(cpu: int | None, others: Sequence[int]) -> Report:
    """Take this process, and what it forks from now on, off the loop's CPU; `apply` puts the loop there.

    Args:
        cpu: the loop's; None for none.
        others: the CPUs to use; none given for all but that one.
    """
    if cpu is None:
        return _unasked("others", "cpu")

    def move() -> str:
        rest = set(others) or os.sched_getaffinity(0) - {cpu}
        if not rest:
            raise OSError(errno.EINVAL, f"there is no other CPU than {cpu} for the other processes")
        try:
            os.sched_setaffinity(0, rest)
        except (OSError, ValueError, OverflowError):
            listed = ", ".join(map(str, sorted(rest)))
            raise OSError(errno.EINVAL, f"CPUs {listed} are not available; see realtime.other_cpus") from None
        return f"CPUs {', '.join(map(str, sorted(rest)))}"

    return _attempt("others", move)


def as_text(reports: list[Report]) -> dict[str, str]:
    """Reports as name → sentence, for the log's metadata."""
    return {r.name: ("yes: " if r.ok else "no: ") + r.reason for r in reports}


def freeze_gc() -> Report:
    """Put all that there is out of the collector's sight, and switch the collector off.

    Nothing is collected: a start leaves next to no garbage, and the search for it takes long.
    """
    gc.freeze()
    gc.disable()
    return Report("gc", True, "off, all objects frozen")


def _unasked(name: str, key: str) -> Report:
    return Report(name, False, f"not asked for (realtime.{key})", asked=False)


def _attempt(name: str, action: Callable[[], str]) -> Report:
    """Report of an action that returns what is in force, or raises OSError with why not and what helps."""
    try:
        return Report(name, True, action())
    except OSError as e:
        text = e.strerror or str(e)
        return Report(name, False, " ".join(text.split()))
    except Exception as e:  # an exotic kernel or libc must not keep the axis from running
        return Report(name, False, " ".join(f"{type(e).__name__}: {e}".split()))


def _fifo(priority: int) -> str:
    # children of the loop, should there ever be any, must not inherit its priority
    policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    try:
        os.sched_setscheduler(0, policy, os.sched_param(priority))
    except OSError as e:
        raise OSError(e.errno, _why_no_fifo(e.errno or 0, priority)) from None
    return f"SCHED_FIFO {priority}"


def _why_no_fifo(code: int, priority: int) -> str:
    if code == errno.EINVAL:
        return f"SCHED_FIFO {priority} is not a priority of this kernel; set realtime.priority to 1 … 98"
    if code != errno.EPERM:
        return f"SCHED_FIFO {priority}: {os.strerror(code)}"
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    if limit == resource.RLIM_INFINITY or limit >= priority or os.geteuid() == 0:
        return (
            f"SCHED_FIFO {priority} refused although the limits allow it: the control group has no real-time"
            " time (cpu.rt_runtime_us) or a container withholds CAP_SYS_NICE; grant one or the other"
        )
    return (
        f"SCHED_FIFO {priority} refused: RLIMIT_RTPRIO is {limit}; set LimitRTPRIO=98 in the unit,"
        " or 'rtprio 98' for this user in /etc/security/limits.d"
    )


def _affinity(cpu: int) -> str:
    allowed = sorted(os.sched_getaffinity(0))
    try:
        os.sched_setaffinity(0, {cpu})
    except (OSError, ValueError, OverflowError):
        listed = ", ".join(map(str, allowed))
        raise OSError(
            errno.EINVAL, f"CPU {cpu} is not available; set realtime.cpu to one of {listed}"
        ) from None
    return f"CPU {cpu} only"


def _lock_memory() -> str:
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    unlimited = limit == resource.RLIM_INFINITY or _has_capability(_CAP_IPC_LOCK)
    # under a finite limit MCL_FUTURE would turn later growth into MemoryError, worse than a page fault
    flags = _MCL_CURRENT | _MCL_FUTURE if unlimited else _MCL_CURRENT
    if _libc.mlockall(flags) == 0:
        if unlimited:
            return "all pages locked, present and future"
        return "present pages locked, later ones not; LimitMEMLOCK=infinity in the unit locks them too"
    code = ctypes.get_errno()
    if code in (errno.ENOMEM, errno.EPERM) and not unlimited:
        raise OSError(
            code,
            f"memory not locked: RLIMIT_MEMLOCK is {limit // 1024} KiB; set LimitMEMLOCK=infinity in the"
            " unit, or 'memlock unlimited' for this user in /etc/security/limits.d",
        )
    raise OSError(code, f"memory not locked: {os.strerror(code)}")


def _has_capability(bit: int) -> bool:
    for line in Path("/proc/self/status").read_bytes().splitlines():
        if line.startswith(b"CapEff:"):
            return bool(int(line.split()[1], 16) >> bit & 1)
    return False


def _forbid_deep_sleep() -> str:
    try:
        descriptor = os.open(_DMA_LATENCY, os.O_WRONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        raise OSError(
            errno.ENOENT, f"{_DMA_LATENCY} does not exist: this kernel cannot keep its CPUs awake"
        ) from None
    except OSError as e:
        raise OSError(
            e.errno,
            f"{_DMA_LATENCY}: {os.strerror(e.errno or 0)}; run as root, or give the service's group access"
            ' with a udev rule: KERNEL=="cpu_dma_latency", GROUP="…", MODE="0660"',
        ) from None
    try:
        os.write(descriptor, struct.pack("=i", 0))
    except OSError:
        os.close(descriptor)
        raise
    while _held_open:
        os.close(_held_open.pop())
    _held_open.append(descriptor)
    return f"{_DMA_LATENCY} held at 0 µs"


def _timer_slack() -> str:
    if _libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0) != 0:
        code = ctypes.get_errno()
        raise OSError(code, f"timer slack: {os.strerror(code)}")
    return "timers fire within 1 ns of their time, not 50 µs"
