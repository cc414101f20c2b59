"""A program in simulated time: what each of its records comes to, as a table, a picture, and numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import nullcontext
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.style import Style

from pneud.console import programs
from pneud.console.programs import Compiled
from pneud.loading import Loaded, Together
from pneud.log.files.naming import log_path, new_log
from pneud.log.files.writer import LogWriter
from pneud.physics.ratings import DENSITY_ANR_KG_M3
from pneud.replay.lockstep import Simulation, backend_of, header_of
from pneud.replay.motions import AirFlow
from pneud.replay.programming import Passed, Passing, Programming, ProgrammingTogether
from pneud.replay.running import through
from pneud.replay.running_together import run_together
from pneud.signals import Record
from pneud.view.plot import Curve, plot, samples
from pneud.view.progress import Report

LONGEST_S = 1e5
TOLD_TICKS = 100
PICTURE = (72, 10)  # cells
LITRES = 1e3


class DryRun(NamedTuple):
    """What a program came to."""

    summary: dict[str, Any]
    picture: list[str]

    @property
    def good(self) -> bool:
        """It has come to its end, and every position said to be reached was."""
        return bool(self.summary["ended"]) and not self.summary["wrong"]


class _Course:
    """What a picture and the air are made of, tick by tick; of the first round."""

    def __init__(self) -> None:
        self.flow: list[tuple[float, float, float, float]] = []
        self.reference_m: list[float] = []
        self.truth_m: list[float] = []

    def add(self, record: Record) -> None:
        tick = record.tick
        if tick.progress.lap == 0:
            m = tick.measurement
            self.flow.append((tick.estimate.opening_v, m.p1_pa, m.p2_pa, m.supply_pa))
            self.reference_m.append(tick.reference.position_m)
            self.truth_m.append(record.truth_m)


def dry_run(
    loaded: Loaded, found: Compiled, first: int, cycles: int, seed: int, output: Path | None, report: Report
) -> DryRun:
    """Do a program in simulated time.

    Args:
        loaded: the axis.
        found: the program.
        first: record to begin with.
        cycles: rounds.
        seed: of the noise.
        output: for a log; None for none.
        report: told how far it is.

    Raises:
        LogError: the log cannot be written.
        BuildError: the compiled law is required and cannot be had.
        ProgramError: there is no such record.
    """
    steps, rate_hz = found.steps[0], loaded.config.loop.rate_hz
    (asked,) = programs.requests_to_begin(found, first, cycles)
    operator = Programming(asked, steps, loaded.config.plant.sensors.encoder_resolution_m)
    law = backend_of(loaded)
    run = Simulation(loaded, LONGEST_S, seed, law, operator=operator.ask)
    course = _Course()

    def look(number: int, record: Record) -> None:
        operator.see(record)
        course.add(record)
        if number % TOLD_TICKS == 0:
            report(f"round {record.tick.progress.lap + 1}", number / rate_hz, 0.0, "s")

    path = log_path(str(output), loaded.config.name) if output is not None else None
    with new_log(path) if path is not None else nullcontext(-1) as descriptor:
        header = header_of(loaded, seed=str(seed), law=law.name, program=found.name)
        writer = LogWriter(descriptor, header) if path is not None else None
        through(run, rate_hz, writer, look)
        if writer is not None:
            writer.close()
    summary = _summary(loaded, found, operator.passing, course, operator.why, operator.ended)
    summary["log"] = str(path) if path is not None else None
    return DryRun(summary, _picture(course, operator.passing.passed, rate_hz))


def dry_run_together(
    axes: Together, found: Compiled, first: int, cycles: int, seed: int, folder: Path | None, report: Report
) -> dict[str, DryRun]:
    """Do a program of several axes in simulated time.

    Args:
        axes: on one bus, all that the program is for.
        found: as for `dry_run`, likewise the others.
        first: record to begin with.
        cycles: rounds.
        seed: of the noise.
        folder: for the logs; None for none.
        report: told how far it is.

    Returns:
        What it came to for each axis, by its name.
    """
    rate_hz, wanted = axes[0].config.loop.rate_hz, programs.requests_to_begin(found, first, cycles)
    room_m = max(axis.config.plant.sensors.encoder_resolution_m for axis in axes)
    operator, courses = ProgrammingTogether(wanted, found.steps, room_m), [_Course() for _ in axes]

    def see(records: Sequence[Record]) -> bool:
        operator.see(records)
        for course, record in zip(courses, records, strict=True):
            course.add(record)
        return operator.over

    def look(number: int) -> None:
        if number % TOLD_TICKS == 0:
            report("simulating", number / rate_hz, 0.0, "s")

    ran = run_together(axes, LONGEST_S, seed, folder, look, operator.ask, see)
    told = {}
    for axis, passing, course in zip(axes, operator.passing, courses, strict=True):
        summary = _summary(axis, found, passing, course, operator.why, operator.ended)
        summary["log"] = ran[axis.config.name]["log"]
        told[axis.config.name] = DryRun(summary, _picture(course, passing.passed, rate_hz))
    return told


def _summary(
    loaded: Loaded, found: Compiled, passing: Passing, course: _Course, why: str, ended: bool
) -> dict[str, Any]:
    rate_hz = loaded.config.loop.rate_hz
    o, p1, p2, supply = np.asarray(course.flow, dtype=float).reshape(-1, 4).T
    kg = np.nan_to_num(AirFlow(loaded.config).kg_s(o, p1, p2, supply)) / rate_hz
    litres = np.concatenate(([0.0], np.cumsum(kg))) / DENSITY_ANR_KG_M3 * LITRES
    rows, air_l = [], 0.0
    for one in (p for p in passing.passed if p.lap == 0):
        begin, end = round(one.begin_s * rate_hz), round(one.end_s * rate_hz)
        air = float(litres[min(end, len(kg))] - litres[min(begin, len(kg))])
        air_l += air
        rows.append(
            {
                "record": one.record,
                "label": found.records[one.record - 1].get("label"),
                "words": found.words[one.record - 1],
                "begin_s": round(one.begin_s - passing.passed[0].begin_s, 6),
                "took_s": round(one.end_s - one.begin_s, 6),
                "off_mm": _mm(one.off_m),
                "worst_mm": _mm(one.worst_m),
                "air_l": round(air, 4),
            }
        )
    rounds_s = passing.rounds_s()
    whole = passing.passed
    return {
        "schema": 1,
        "program": found.name,
        "ended": ended,
        "why": why or None,
        "wrong": passing.wrong,
        "records": rows,
        "cycles": whole[-1].lap + 1 if whole and ended else (whole[-1].lap if whole else 0),
        "took_s": round(whole[-1].end_s - whole[0].begin_s, 6) if whole else None,
        "cycle_s": {"least": min(rounds_s), "most": max(rounds_s)} if rounds_s else None,
        "worst_mm": _mm(max((one.worst_m for one in whole), default=math.nan)),
        "air_l": round(air_l, 4),
    }


def _mm(metres: float) -> float | None:
    return round(1e3 * metres, 4) if math.isfinite(metres) else None


def in_words(found: DryRun) -> str:
    """The table and the picture."""
    s = found.summary
    lines = [f"{'':3} {'record':34} {'begins':>8} {'takes':>8} {'off':>8} {'worst':>8} {'air':>8}"]
    lines.append(f"{'':3} {'':34} {'s':>8} {'s':>8} {'mm':>8} {'mm':>8} {'l ANR':>8}")
    for row in s["records"]:
        label = f"{row['label']}: " if row["label"] else ""
        off = f"{row['off_mm']:+.3f}" if row["off_mm"] is not None else ""
        lines.append(
            f"{row['record']:3} {label + row['words']:34.34} {row['begin_s']:8.3f} {row['took_s']:8.3f}"
            f" {off:>8} {row['worst_mm']:8.3f} {row['air_l']:8.3f}"
        )
    lines += ["", *found.picture, ""]
    if s["took_s"] is None:
        return "\n".join([*lines, f"not begun: {s['why'] or 'the axis does not arm'}"])
    rounds = f"{s['cycles']} rounds, " if s["cycles"] > 1 else ""
    end = "to its end" if s["ended"] else f"not to its end: {s['why']}"
    lines.append(f"{rounds}{s['took_s']:.3f} s, {s['air_l']:.3f} l of air a round, {end}")
    if s["cycle_s"] is not None:
        lines.append(f"a round takes {s['cycle_s']['least']:.3f} … {s['cycle_s']['most']:.3f} s")
    return "\n".join([*lines, *s["wrong"]])


def _picture(course: _Course, passed: list[Passed], rate_hz: float) -> list[str]:
    """Position (of the first round) over time, and where records begin."""
    first = [one for one in passed if one.lap == 0]
    if not first:
        return []
    width, height = PICTURE
    begin, end = round(first[0].begin_s * rate_hz), round(first[-1].end_s * rate_hz) + 1
    truth_mm = 1e3 * np.asarray(course.truth_m[begin:end])
    if len(truth_mm) < 2:
        return []
    cuts = np.linspace(0, len(truth_mm), samples(width, False) + 1).astype(int)
    parts = [truth_mm[a:b] for a, b in pairwise(cuts.tolist())]
    columns = [(float(part.min()), float(part.max())) if len(part) else None for part in parts]
    low, high = float(truth_mm.min()), float(truth_mm.max())
    rows = plot([Curve(columns, Style())], (low, max(high, low + 1e-3)), PICTURE)
    lines = []
    for number, cells in enumerate(rows):
        scale = {0: f"{high:.1f}", height - 1: f"{low:.1f}"}.get(number, "mm" if number == 1 else "")
        lines.append(f"{scale:>8} │{''.join(text for text, _ in cells).rstrip()}")
    marks, span_s = [" "] * width, first[-1].end_s - first[0].begin_s
    for one in first:
        at = min(width - 1, int((one.begin_s - first[0].begin_s) / max(span_s, 1e-9) * width))
        for place, sign in enumerate(str(one.record)):
            if at + place < width and marks[at + place] == " ":
                marks[at + place] = sign
    lines.append(f"{'':8} └{'─' * width}")
    lines.append(f"{'record':>8}  {''.join(marks).rstrip()}")
    lines.append(f"{'s':>8}  0{f'{span_s:.3f}':>{width - 1}}")
    return lines
