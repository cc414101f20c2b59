"""The timing of a recorded run in a few lines."""

from __future__ import annotations

from pneud.report.gather import LoggedRun


def in_words(run: LoggedRun) -> list[str]:
    """What the log says about when things happened; nothing in simulated time."""
    if run.simulated or not run.timing["lateness_ns"].count:
        return []
    ages = ", ".join(f"{s.name.replace('_', ' ')} {s.age.in_words('/')}" for s in run.health.sources)
    return [
        f"recorded timing, µs p50/p99/max: wake-up lateness {run.timing['lateness_ns'].in_words('/')},"
        f" sensor to command {run.timing['latency_ns'].in_words('/')},"
        f" jitter of SYNC {run.health.sync_jitter.in_words('/')}; {run.counted.skipped} ticks skipped",
        f"age of frames when the command was sent: {ages}",
    ]
