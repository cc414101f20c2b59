"""Two courses of an axis as a picture; needs matplotlib."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from pneud.replay.differences import Point
from pneud.rt.outputs import replacing

DPI = 120
SIZE = (10.0, 10.0)
PANELS: tuple[tuple[str, Callable[[Point, int], float]], ...] = (
    ("tracking error [mm]", lambda p, i: 1e3 * p.error_m[i]),
    ("velocity [m/s]", lambda p, i: p.velocity_m_s[i]),
    ("unmatched force [N]", lambda p, i: p.force_n[i]),
    ("command [V]", lambda p, i: p.voltage_v[i]),
)


def write(points: Sequence[Point], names: tuple[str, str], path: Path) -> None:
    """Draw both courses over time, and the difference of the commands.

    Raises:
        OSError: the file cannot be written.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415  (an extra)

    figure = Figure(figsize=SIZE, layout="constrained")
    axes = figure.subplots(len(PANELS) + 1, 1, sharex=True)
    times = [p.t_s for p in points]
    for ax, (label, value) in zip(axes, PANELS, strict=False):
        for i, name in enumerate(names):
            ax.plot(times, [value(p, i) for p in points], label=name, linewidth=1.0 - 0.3 * i)
        ax.set_ylabel(label)
        ax.grid(alpha=0.3)
    axes[0].legend(loc="upper right")
    axes[-1].plot(times, [p.voltage_v[1] - p.voltage_v[0] for p in points], linewidth=0.8, color="k")
    axes[-1].set_ylabel("difference of the commands [V]")
    axes[-1].set_xlabel("time [s]")
    axes[-1].grid(alpha=0.3)
    with replacing(path) as beside:
        figure.savefig(beside, dpi=DPI, metadata={"Software": "pneud"})
