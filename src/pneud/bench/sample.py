"""What one turn of one contestant yields, and what many of them come to."""

from __future__ import annotations

import os
import resource
import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from pneud.loop.summary import percentiles_us
from pneud.rt.histogram import Histogram

QUANTITIES = ("lateness", "wakeup", "latency", "own", "read", "cycle", "write", "record")
"""Durations of a tick [ns].

lateness: begun after the ideal grid. wakeup: the same, of ticks that had slept until then (others are late
because the one before took too long). latency: newest sensor frame's kernel stamp → command sent. own: that
stamp → command sent and record handed over, without deliberate sleeps; read, cycle, write, record are parts.
"""


class Sample(NamedTuple):
    """One turn."""

    durations_ns: Mapping[str, Sequence[int]]  # by names of QUANTITIES; empty where it has none of that kind
    ticks: int
    skipped: int = 0
    incomplete: int = 0  # ticks without a complete set of measurements
    elapsed_s: float = 0.0
    cpu_s: Mapping[str, float] = {}  # CPU time by process, during elapsed_s
    page_faults: int | None = None  # in the loop's process
    switches: tuple[int, int] | None = None  # voluntary, involuntary
    note: str = ""  # what was odd
    start_ns: int | None = None  # from the start of the process to its first tick


def from_object(data: Mapping[str, Any]) -> Sample:
    """A sample from the object that a contestant's process prints."""
    switches = data.get("switches")
    return Sample(
        {name: data.get(f"{name}_ns", ()) for name in QUANTITIES},
        data["ticks"],
        data["skipped"],
        data.get("incomplete", 0),
        data["elapsed_s"],
        data["cpu_s"],
        data.get("page_faults"),
        (switches[0], switches[1]) if switches else None,
    )


class Usage:
    """What this process has used since the object was made."""

    def __init__(self) -> None:
        self._start_s = time.monotonic()
        self._before = resource.getrusage(resource.RUSAGE_SELF)

    def as_object(self) -> dict[str, Any]:
        """The fields of a sample's object that tell it."""
        a, b = self._before, resource.getrusage(resource.RUSAGE_SELF)
        return {
            "elapsed_s": time.monotonic() - self._start_s,
            "cpu_s": {"loop": b.ru_utime + b.ru_stime - a.ru_utime - a.ru_stime},
            "page_faults": b.ru_minflt + b.ru_majflt - a.ru_minflt - a.ru_majflt,
            "switches": [b.ru_nvcsw - a.ru_nvcsw, b.ru_nivcsw - a.ru_nivcsw],
        }


class ProcessState(NamedTuple):
    """A process as /proc has it."""

    cpu_s: float
    page_faults: int
    voluntary: int
    involuntary: int


def process_state(pid: int, proc: Path = Path("/proc")) -> ProcessState:
    """What a process has used so far, all threads.

    CPU time comes from schedstat (nanoseconds, but of one thread) where that will do, else from stat.

    Raises:
        OSError: it has gone.
    """
    folder = proc / str(pid)
    # the name in parentheses may hold anything
    words = (folder / "stat").read_text().rpartition(")")[2].split()
    cpu_s = (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
    threads = int(words[17])
    if threads == 1 and (folder / "schedstat").exists():
        cpu_s = int((folder / "schedstat").read_text().split()[0]) * 1e-9
    switches = {
        line.partition(":")[0]: int(line.split()[1])
        for line in (folder / "status").read_text().splitlines()
        if "ctxt_switches" in line
    }
    return ProcessState(
        cpu_s,
        int(words[7]) + int(words[9]),
        switches["voluntary_ctxt_switches"],
        switches["nonvoluntary_ctxt_switches"],
    )


@dataclass
class Samples:
    """All turns of one contestant."""

    name: str
    what: str  # what it is, in a sentence
    histograms: dict[str, Histogram] = field(default_factory=dict)
    turns_us: dict[str, list[tuple[float, float]]] = field(default_factory=dict)  # (p50, p99) of each turn
    turn_numbers: list[int] = field(default_factory=list)
    ticks: int = 0
    skipped: int = 0
    incomplete: int = 0
    elapsed_s: float = 0.0
    cpu_s: dict[str, float] = field(default_factory=dict)
    page_faults: int | None = None
    switches: tuple[int, int] | None = None
    highest_rate_hz: float | None = None
    notes: list[str] = field(default_factory=list)
    starts_ns: list[int] = field(default_factory=list)

    def add(self, sample: Sample, turn: int) -> None:
        """Take one turn in."""
        self.turn_numbers.append(turn)
        for name, values in sample.durations_ns.items():
            if not values:
                continue
            one = Histogram()
            for value in values:
                one.add(value)
            self.histograms.setdefault(name, Histogram()).merge(one)
            p50, p99 = one.percentiles((50.0, 99.0))
            self.turns_us.setdefault(name, []).append((p50 / 1e3, p99 / 1e3))
        self.ticks += sample.ticks
        self.skipped += sample.skipped
        self.incomplete += sample.incomplete
        self.elapsed_s += sample.elapsed_s
        for process, seconds in sample.cpu_s.items():
            self.cpu_s[process] = self.cpu_s.get(process, 0.0) + seconds
        if sample.page_faults is not None:
            self.page_faults = (self.page_faults or 0) + sample.page_faults
        if sample.switches is not None:
            had = self.switches or (0, 0)
            self.switches = (had[0] + sample.switches[0], had[1] + sample.switches[1])
        if sample.start_ns is not None:
            self.starts_ns.append(sample.start_ns)
        if sample.note and sample.note not in self.notes:
            self.notes.append(sample.note)

    def as_object(self) -> dict[str, Any]:
        """What it came to, for JSON."""
        per_tick = 1.0 / self.ticks if self.ticks else 0.0
        loop_s = self.cpu_s.get("loop")
        ticks_seen_s = self.elapsed_s or 1.0
        return {
            "what": self.what,
            "turns": len(self.turn_numbers),
            "ticks": self.ticks,
            "skipped": self.skipped,
            "incomplete": self.incomplete,
            "overrun": self._count("lateness") - self._count("wakeup"),
            **{f"{name}_us": self._figures(name) if name in self.histograms else None for name in QUANTITIES},
            "cpu_percent": {name: 100.0 * s / ticks_seen_s for name, s in self.cpu_s.items()},
            "cpu_us_per_tick": 1e6 * loop_s * per_tick if loop_s is not None else None,
            "page_faults": self.page_faults,
            "switches_per_tick": (
                {"voluntary": self.switches[0] * per_tick, "involuntary": self.switches[1] * per_tick}
                if self.switches is not None
                else None
            ),
            "first_tick_ms": (
                {
                    "median": statistics.median(self.starts_ns) * 1e-6,
                    "least": min(self.starts_ns) * 1e-6,
                    "greatest": max(self.starts_ns) * 1e-6,
                }
                if self.starts_ns
                else None
            ),
            "highest_rate_hz": self.highest_rate_hz,
            "notes": self.notes,
        }

    def _count(self, name: str) -> int:
        return self.histograms[name].count if name in self.histograms else 0

    def _figures(self, name: str) -> dict[str, Any]:
        turns = self.turns_us[name]
        return {
            **(percentiles_us(self.histograms[name]) or {}),
            "median_of_turns": {
                "p50": statistics.median(p50 for p50, _ in turns),
                "p99": statistics.median(p99 for _, p99 in turns),
            },
        }


def ratio_of_turns(ours: Samples, theirs: Samples, name: str) -> dict[str, Any] | None:
    """How the p50 and p99 of turns compare that followed each other: median, quartiles, extremes.

    Returns:
        None where there is no turn that both have taken.
    """
    pairs = [
        (a, b)
        for number, a in zip(ours.turn_numbers, ours.turns_us.get(name, []), strict=False)
        for other, b in zip(theirs.turn_numbers, theirs.turns_us.get(name, []), strict=False)
        if number == other and min(b) > 0.0
    ]
    if not pairs:
        return None
    found: dict[str, Any] = {"pairs": len(pairs)}
    for index, quantile in enumerate(("p50", "p99")):
        ratios = sorted(a[index] / b[index] for a, b in pairs)
        n = len(ratios)
        found[quantile] = {
            "median": statistics.median(ratios),
            "lower_quartile": ratios[n // 4],
            "upper_quartile": ratios[min(n - 1, 3 * n // 4)],
            "least": ratios[0],
            "greatest": ratios[-1],
        }
    return found
