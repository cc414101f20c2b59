"""The figures of a report as PNG; needs matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pneud.report.colours import COLOURS, STATE_COLOURS, colours_of
from pneud.report.figures import FIGURES, line, offsets_s
from pneud.report.gather import LoggedRun
from pneud.report.planes import Plane, Trace, together
from pneud.rt.outputs import replacing
from pneud.signals import State

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DPI = 120
SIZE = (10.0, 3.2)


def write(runs: Sequence[LoggedRun], stem: Path) -> list[Path]:
    """Draw every figure into a file of its own.

    Returns:
        The files.

    Raises:
        OSError: one cannot be written.
    """
    from matplotlib.figure import Figure as New  # noqa: PLC0415

    shifts, colours = offsets_s(runs), colours_of(len(runs))
    written = []

    def save(figure: New, name: str) -> None:
        path = stem.with_name(f"{stem.name}-{name}.png")
        with replacing(path) as beside:
            figure.savefig(beside, dpi=DPI, metadata={"Software": "pneud"})
        written.append(path)

    for f in FIGURES:
        figure = New(figsize=SIZE, layout="constrained")
        axes = figure.subplots()
        for number, (run, shift) in enumerate(zip(runs, shifts, strict=True)):
            for series in f.series if len(runs) == 1 else f.series[:1]:
                values = line(run, series.column)
                if values is not None:
                    colour = series.colour if len(runs) == 1 else colours[number]
                    label = series.label if len(runs) == 1 else run.name
                    axes.plot(run.series.t_s - shift, values, color=colour, linewidth=0.9, label=label)
        _finish(axes, f.title, f"{f.unit}", "s")
        save(figure, f.name)

    figure = New(figsize=(5.5, 5.0), layout="constrained")
    axes = figure.subplots()
    for number, run in enumerate(runs):
        error, speed = run.phase.values.T
        axes.plot(error, speed, color=colours[number], linewidth=0.6, label=run.name)
    _finish(axes, "Phase plot", "velocity error [mm/s]", "position error [mm]")
    save(figure, "phase")

    for plane, each in together([run.planes for run in runs]):
        figure = New(figsize=(6.5, 4.2), layout="constrained")
        _plane(figure.subplots(), plane, each, runs)
        save(figure, plane.name)

    rows = sum(1 + len(run.present) for run in runs)
    figure = New(figsize=(SIZE[0], 1.2 + 0.25 * rows), layout="constrained")
    _timeline(figure.subplots(), runs, shifts)
    save(figure, "timeline")
    return written


def _plane(axes: Axes, plane: Plane, each: Sequence[Plane | None], runs: Sequence[LoggedRun]) -> None:
    if len(runs) == 1:
        for trace in plane.traces:
            _trace(axes, trace, trace.label, trace.colour)
    else:
        for own, run, colour in zip(each, runs, colours_of(len(runs)), strict=True):
            if own is not None:
                _trace(axes, own.traces[0], run.name, colour)
    if plane.logarithmic:
        axes.set_xscale("log")
        axes.set_yscale("log")
    _finish(axes, plane.title, plane.up, plane.across)


def _timeline(axes: Axes, runs: Sequence[LoggedRun], shifts: Sequence[float]) -> None:
    rows = [
        (run, shift, bit) for run, shift in zip(runs, shifts, strict=True) for bit in (None, *run.present)
    ]
    for y, (run, shift, bit) in enumerate(reversed(rows)):
        if bit is None:
            for value in sorted({span.value for span in run.states}):
                state = State(value - 1)
                bars = [(s.begin_s - shift, s.end_s - s.begin_s) for s in run.states if s.value == value]
                axes.broken_barh(bars, (y - 0.4, 0.8), color=STATE_COLOURS[state], label=state.label)
        else:
            for spans, height, colour in (
                (run.present[bit], 0.8, "#f4c7a8"),
                (run.latched.get(bit, []), 0.4, COLOURS[1]),
            ):
                axes.broken_barh(
                    [(s.begin_s - shift, s.end_s - s.begin_s) for s in spans],
                    (y - 0.5 * height, height),
                    color=colour,
                )
    names = [run.name if bit is None else run.fault_name(bit) for run, _, bit in reversed(rows)]
    axes.set_yticks(range(len(rows)), names)
    _finish(axes, "States and faults", "", "s")


def _trace(axes: Axes, trace: Trace, label: str, colour: str) -> None:
    if trace.kind == "mark":
        axes.axvline(float(trace.x[0]), color=colour, linestyle="--", linewidth=1.0, label=label)
    elif trace.kind == "bars":
        axes.bar(trace.x, trace.y, width=0.9 * (trace.x[1] - trace.x[0]), color=colour, label=label)
    else:
        axes.plot(trace.x, trace.y, color=colour, linewidth=0.9, label=label)


def _finish(axes: Axes, title: str, y: str, x: str) -> None:
    axes.set_title(title, fontsize=10, loc="left")
    axes.set_xlabel(x, fontsize=8)
    axes.set_ylabel(y, fontsize=8)
    axes.tick_params(labelsize=8)
    axes.grid(color="#dddddd", linewidth=0.5)
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        one_each = dict(zip(labels, handles, strict=True))
        axes.legend(
            list(one_each.values()), list(one_each), fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0)
        )
