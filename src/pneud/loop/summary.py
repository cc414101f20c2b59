"""What a run has come to, for scripts and for people."""

from __future__ import annotations

import math
from typing import Any

from pneud.bus.inbox import Counts
from pneud.loop.tally import Tally
from pneud.loop.tracking import in_words as tracking_in_words
from pneud.rt.histogram import Histogram
from pneud.safety.faults import names
from pneud.signals import State


def percentiles_us(h: Histogram) -> dict[str, float] | None:
    """The figures of a histogram of nanoseconds."""
    if h.count == 0:
        return None
    p50, p99, p999 = (h.percentile(q) for q in (50.0, 99.0, 99.9))
    return {"p50": p50 / 1e3, "p99": p99 / 1e3, "p999": p999 / 1e3, "max": h.max / 1e3}


def finite(value: Any) -> Any:
    """The value with every number that is not finite replaced by None, as JSON wants it."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def summarise(
    tally: Tally,
    *,
    bus: str,
    rate_hz: float,
    counts: Counts,
    tx: int,
    rx_dropped: int,
    log: str | None,
    log_dropped: int,
) -> dict[str, Any]:
    """The object that `--json` prints."""
    result = {
        "schema": 1,
        "state": State(tally.state).label,
        "bus": bus,
        "rate_hz": int(rate_hz) if rate_hz == int(rate_hz) else rate_hz,
        "ticks": tally.ticks,
        "skipped": tally.skipped,
        "lateness_us": percentiles_us(tally.lateness),
        "sensor_to_command_us": percentiles_us(tally.latency),
        "tracking_mm": tally.tracking.tracking_mm(),
        "command_v": tally.tracking.command_v(),
        "saturated_ticks": tally.saturated,
        "frames": {
            "rx": counts.rx,
            "tx": tx,
            "lost": counts.lost + rx_dropped,
            "crc": counts.crc,
            "stale": counts.stale,
            "late": counts.late,
        },
        "amiss": tally.amiss.all._asdict() | {"corrupt": tally.amiss.corrupt, "frozen": tally.amiss.frozen},
        "odd_readings": {
            "held": tally.odd,
            "confirmed": tally.confirmed,
            "per_1000_ticks": 1e3 * tally.odd / max(1, tally.ticks),
        },
        "log": log,
        "log_dropped": log_dropped,
        "faults": names(tally.ever_latched),
    }
    cleaned: dict[str, Any] = finite(result)
    return cleaned


def in_words(s: dict[str, Any]) -> str:
    """The same for people, a few lines."""
    lines = [f"{s['state']} on {s['bus']}: {s['ticks']} ticks at {s['rate_hz']:g} Hz, {s['skipped']} skipped"]
    lines.append(tracking_in_words(s["tracking_mm"]))
    if c := s["command_v"]:
        lines[-1] += f"; command {c['max']:.2f} V max, {c['mean_step']:.3f} V mean step"
    lines.append(f"saturated {s['saturated_ticks']} ticks")
    for key, label in (("lateness_us", "wake-up lateness"), ("sensor_to_command_us", "sensor to command")):
        if s[key]:
            p = s[key]
            lines.append(f"{label} {p['p50']:.0f} µs p50, {p['p99']:.0f} p99, {p['max']:.0f} max")
    f = s["frames"]
    lines.append(f"frames {f['rx']} in, {f['tx']} out, {f['lost']} lost")
    lines.append("readings amiss: " + ", ".join(f"{count} {kind}" for kind, count in s["amiss"].items()))
    odd = s["odd_readings"]
    if odd["held"]:
        lines.append(
            f"odd readings {odd['held']} held back ({odd['per_1000_ticks']:.3g} per 1000 ticks),"
            f" {odd['confirmed']} of them confirmed by the next"
        )
    if s["faults"]:
        lines.append(f"faults: {', '.join(s['faults'])}")
    if s["log"]:
        lost = f", {s['log_dropped']} records lost" if s["log_dropped"] else ""
        lines.append(f"log {s['log']}{lost}")
    return "\n".join(lines)
