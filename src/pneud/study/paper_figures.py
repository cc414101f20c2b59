"""The paper's Figures 3–8 and those that show how it converges, as PNG; needs matplotlib."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pneud.control.homogeneous import feedback
from pneud.control.reference import sine
from pneud.rt.extras import require
from pneud.study.convergence import Convergence, Settling, chain
from pneud.study.ideal import E3, ED, W1, W2, X1, U, V
from pneud.study.paper import PICTURED, Reproduction
from pneud.study.reproduction import CASES, COMPOSITE, ISMC, NAMES, Setting, Trace, paper_loop

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHOWN_S = 10.0
DPI = 110
COLOURS = {COMPOSITE: "#1f5fa8", ISMC: "#d9730d"}
WIDTH = 1.2
GREY = "#777777"


class Picture(NamedTuple):
    """One figure."""

    name: str  # of its file, without suffix
    title: str
    png: bytes


def pictures(found: Reproduction) -> list[Picture]:
    """All figures, those of the paper first.

    Raises:
        ExtraError: matplotlib is missing.
    """
    require("figures", "plots")
    drawn = []
    for h_s, form in PICTURED:
        for case in CASES:
            traces = {
                s.law: t for s, t in found.traces.items() if (s.case, s.h_s, s.form) == (case, h_s, form)
            }
            number = 3 if case == 1 else 6
            under = f"Case {case}, h = {h_s * 1e3:g} ms, {form}"
            suffix = f"{h_s * 1e3:g}ms-{form}"
            for i, what, draw, height in (
                (0, "position, velocity and their errors", _tracking, 6.0),
                (1, "observer errors", _observer, 3.2),
                (2, "control input", _command, 3.0),
            ):
                name, title = f"figure-{number + i}-{suffix}", f"Figure {number + i}: {what}. {under}"
                drawn.append(_picture(name, title, found.start, height, draw, traces, h_s))
    title = "Position error on a log axis, implicit forms, without reverse flow"
    drawn.append(_picture("error-log", title, found.start, 3.8, _errors, found.traces))
    title = "Finite-time or exponential: the chain (13) and the closed loop"
    under = "left: the chain from w = (50 mm, 0, 0); right: time until |w1| stays below 1/1000 of its start"
    drawn.append(_picture("settling", title, under, 4.0, _settling, found.convergence))
    title = "Explicit and implicit u* on the chain (13), h = 10 ms"
    drawn.append(_picture("limit-cycle", title, "from w = (50 mm, 0.157 m/s, 0)", 3.4, _limit_cycle))
    return drawn


def _picture(
    name: str, title: str, under: str, height: float, draw: Callable[..., None], *args: Any
) -> Picture:
    from matplotlib.figure import Figure as New  # noqa: PLC0415

    figure = New(figsize=(9.5, height), layout="constrained")
    figure.suptitle(f"{title}\n{under}", fontsize=9)
    draw(figure, *args)
    for axes in figure.axes:
        axes.grid(color="#dddddd", linewidth=0.5)
        axes.tick_params(labelsize=8)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": "pneud"})
    return Picture(name, title, buffer.getvalue())


def _shown(trace: Trace, h_s: float) -> tuple[Trace, Trace]:
    part = trace[: round(SHOWN_S / h_s)]
    t: Trace = h_s * np.arange(len(part), dtype=np.float64)
    return t, part


def _label(axes: Axes, y: str, x: str = "t [s]") -> None:
    axes.set_ylabel(y, fontsize=8)
    axes.set_xlabel(x, fontsize=8)


def _tracking(figure: Figure, traces: dict[str, Trace], h_s: float) -> None:
    grid = figure.subplots(2, 2).flat
    loop = paper_loop(1)
    first = next(iter(traces.values()))
    t, _ = _shown(first, h_s)
    reference = [sine(float(x), loop.reference) for x in t]
    panels = (
        ("(a) x1 [m]", X1, [r.position_m for r in reference]),
        ("(b) velocity [m/s]", V, [r.velocity_m_s for r in reference]),
        ("(c) position error w1 [m]", W1, None),
        ("(d) velocity error w2 [m/s]", W2, None),
    )
    for axes, (y, column, wanted) in zip(grid, panels, strict=True):
        for law, trace in traces.items():
            t, part = _shown(trace, h_s)
            axes.plot(t, part[:, column], color=COLOURS[law], linewidth=WIDTH, label=NAMES[law])
        if wanted is not None:
            axes.plot(t, wanted, "--", color=GREY, linewidth=WIDTH, label="reference")
        _label(axes, y)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=7, loc="outside lower center", ncols=3)


def _observer(figure: Figure, traces: dict[str, Trace], h_s: float) -> None:
    left, right = figure.subplots(1, 2)
    t, part = _shown(traces[COMPOSITE], h_s)
    for axes, column, y in ((left, E3, "(a) e3 [N]"), (right, ED, "(b) e_d [N/s]")):
        axes.plot(t, part[:, column], color=COLOURS[COMPOSITE], linewidth=WIDTH)
        _label(axes, y)


def _command(figure: Figure, traces: dict[str, Trace], h_s: float) -> None:
    axes = figure.subplots()
    for law, trace in traces.items():
        t, part = _shown(trace, h_s)
        axes.step(t, part[:, U], where="post", color=COLOURS[law], linewidth=WIDTH, label=NAMES[law])
    _label(axes, "u [V]")
    figure.legend(fontsize=7, loc="outside lower center", ncols=2)


def _errors(figure: Figure, traces: dict[Setting, Trace]) -> None:
    for axes, case in zip(figure.subplots(1, 2), CASES, strict=True):
        for s, trace in traces.items():
            if s.case == case and s.form == "implicit":
                t = np.arange(len(trace)) * s.h_s
                style = "-" if s.h_s < 0.01 else ":"
                error = np.maximum(np.abs(trace[:, W1]), 1e-12)
                keep = t <= 1.5 * SHOWN_S
                axes.semilogy(
                    t[keep],
                    error[keep],
                    style,
                    color=COLOURS[s.law],
                    linewidth=WIDTH,
                    label=f"{NAMES[s.law]}, {s.h_s * 1e3:g} ms",
                )
        axes.set_title(f"Case {case}", fontsize=9)
        axes.set_ylim(1e-10, 1.0)
        _label(axes, "|w1| [m]")
        axes.legend(fontsize=7, loc="upper right")


def _settling(figure: Figure, c: Convergence) -> None:
    left, right = figure.subplots(1, 2)
    colours = ("#1f5fa8", "#d9730d", "#777777")
    for (alpha, error), colour in zip(c.decay, colours, strict=True):
        t = np.arange(len(error)) * 1e-4
        kind = "linear" if alpha == 1.0 else "homogeneous"
        left.semilogy(
            t[::50],
            np.maximum(error[::50], 1e-16),
            color=colour,
            linewidth=WIDTH,
            label=f"α = {alpha:g}, {kind}",
        )
    left.set_ylim(1e-14, 1.0)
    _label(left, "|w1| [m]")
    left.legend(fontsize=7, loc="lower left")
    for s, colour, marker in zip(c.settling, (*colours, "#1f5fa8"), ("o", "s", "^", "x"), strict=True):
        right.loglog(s.starts_m, s.times_s, marker, color=colour, markersize=5, label=_settling_label(s))
        starts = np.array(s.starts_m)
        fit = np.exp(np.mean(np.log(s.times_s)) + s.predicted * (np.log(starts) - np.mean(np.log(starts))))
        right.loglog(starts, fit, color=colour, linewidth=0.8)
    right.set_yticks([1, 2, 3, 5, 10], labels=["1", "2", "3", "5", "10"])
    right.minorticks_off()
    right.set_ylim(1.0, 14.0)
    _label(right, "settling time [s] (lines: predicted slope)", "initial error [m]")
    right.legend(fontsize=7, loc="lower right")


def _settling_label(s: Settling) -> str:
    return f"{s.what}, α = {s.alpha:g}: slope {s.exponent:.4f}"


def _limit_cycle(figure: Figure) -> None:
    left, right = figure.subplots(1, 2)
    g, h_s = paper_loop(1).sliding.gains, 0.01
    amplitude = (0.5 * h_s * g.k3) ** (1.0 / (1.0 - g.a3))
    gains = feedback(g.k1, g.k2, g.k3, g.a3)
    for implicit, colour in ((False, "#b3261e"), (True, "#1f5fa8")):
        trace = chain((0.05, 0.157, 0.0), h_s, 15.0, gains, implicit)
        t = np.arange(len(trace)) * h_s
        label = "implicit" if implicit else "explicit"
        left.plot(t[-30:], trace[-30:, 2], ".-", color=colour, linewidth=WIDTH, label=label)
        right.semilogy(t, np.maximum(np.abs(trace[:, 2]), 1e-18), color=colour, linewidth=WIDTH, label=label)
    for axes in (left, right):
        axes.axhline(
            amplitude,
            linestyle="--",
            color=GREY,
            linewidth=0.8,
            label=f"(h k3/2)^(1/(1−α3)) = {amplitude:.1f}",
        )
    left.axhline(-amplitude, linestyle="--", color=GREY, linewidth=0.8)
    _label(left, "w3 [m/s²]")
    _label(right, "|w3| [m/s²]")
    right.legend(fontsize=7, loc="upper right")
    right.set_ylim(1e-18, 1e8)
