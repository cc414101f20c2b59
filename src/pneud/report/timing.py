"""The timing of a recorded run in a few lines."""

from __future__ import annotations

from pneud.report.gather import Run
from pneud.report.spread import Spread


def in_words(run: Run) -> list[str]:
    """What the log says about when things happened; nothing in simulated time."""
    if run.simulated or not run.timing["lateness_ns"].count:
        return []
    ages = ", ".join(f"{s.name.replace('_', ' ')} {_figures(s.age)}" for s in run.health.sources)
    return [
        f"recorded timing, µs p50/p99/max: wake-up lateness {_figures(run.timing['lateness_ns'])},"
        f" sensor to command {_figures(run.timing['latency_ns'])},"
        f" jitter of SYNC {_figures(run.health.sync_jitter)}; {run.skipped} ticks skipped",
        f"age of frames when the command was sent: {ages}",
    ]


def _figures(spread: Spread) -> str:
    if not spread.count:
        return "–"
    return "/".join(f"{spread.percentile_ns(q) / 1e3:.0f}" for q in (50, 99, 100))
