"""What a process has used of the machine, as Linux counts it."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

PROC = Path("/proc")
_PREFIX = "pneud-"  # of the names of children
_UTIME, _MINFLT, _MAJFLT, _THREADS, _RSS = 11, 7, 9, 17, 21  # behind the name, which may have anything in it


def children_of(pid: int, proc: Path = PROC) -> list[int]:
    """The children of a process; none where the kernel does not tell."""
    try:
        return [int(child) for child in (proc / f"{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


def with_own(found: Sequence[Mapping[str, Any]], name: str) -> list[Mapping[str, Any]]:
    """Statuses, the first one with this process among its `processes`.

    Args:
        found: of the axes of a daemon.
        name: what this process is called there.
    """
    own = counters_of(os.getpid(), name)
    if not found or own is None:
        return [*found]
    first, *others = found
    return [{**first, "processes": [*first["processes"], own]}, *others]


def counters_of(pid: int, name: str = "", proc: Path = PROC) -> dict[str, Any] | None:
    """What a process has used so far.

    Args:
        pid: the process.
        name: what to call it; its own name if empty.
        proc: where Linux tells it.

    Returns:
        `name`, `pid`, times [s], switches and page faults, `threads`, and memory. `waited_s` (ready to run,
        and others ran) and the switches are those of its first thread. None where it has gone, or is not
        shown.
    """
    folder = proc / str(pid)
    try:
        own, _, behind = (folder / "stat").read_text(errors="replace").partition("(")[2].rpartition(") ")
        status = dict(line.split(":", 1) for line in (folder / "status").read_text().splitlines())
        waited_ns = _waited_ns(folder)
        fields = behind.split()
        tick_s = 1.0 / os.sysconf("SC_CLK_TCK")
        return {
            "name": name or own.removeprefix(_PREFIX),
            "pid": pid,
            "user_s": round(int(fields[_UTIME]) * tick_s, 3),
            "system_s": round(int(fields[_UTIME + 1]) * tick_s, 3),
            "waited_s": None if waited_ns is None else round(waited_ns * 1e-9, 6),
            "switches": {
                "voluntary": int(status["voluntary_ctxt_switches"]),
                "involuntary": int(status["nonvoluntary_ctxt_switches"]),
            },
            "page_faults": {"minor": int(fields[_MINFLT]), "major": int(fields[_MAJFLT])},
            "threads": int(fields[_THREADS]),
            "resident_bytes": int(fields[_RSS]) * os.sysconf("SC_PAGE_SIZE"),
        }
    except (OSError, ValueError, IndexError, KeyError):
        return None


def _waited_ns(folder: Path) -> int | None:
    """None where the kernel does not count it."""
    try:
        return int((folder / "schedstat").read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return None
