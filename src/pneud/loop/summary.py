"""What a run comes to: tracking, command and timing figures, for scripts and for people."""

from __future__ import annotations

import math
from typing import Any

from pneud.bus.inbox import Counts
from pneud.rt.histogram import Histogram
from pneud.safety.faults import names
from pneud.signals import State, Tick

AFTER_S = 5.0


class Tracking:
    """Sums over the ticks from AFTER_S past the join on; keeps no tick."""

    def __init__(self, has_truth: bool) -> None:
        """Sums of nothing.

        Args:
            has_truth: the error is taken against a software plant's true position, else against the encoder.
        """
        self.has_truth = has_truth
        self.count = 0
        self.saturated = 0
        self._square = 0.0
        self._max_m = 0.0
        self._max_v = 0.0
        self._step_v = 0.0
        self._steps = 0
        self._last_v = math.nan

    def add(self, tick: Tick, join_ns: int, truth_m: float) -> None:
        """One tick that follows the reference.

        Args:
            tick: the tick.
            join_ns: the reference's t = 0.
            truth_m: true position at SYNC, NaN where unknown.
        """
        if tick.t_ns - join_ns < AFTER_S * 1e9:
            return
        r, m = tick.reference, tick.measurement
        if self.has_truth:
            # the reference of the sampling instant, taken back to the instant of SYNC
            error = r.position_m - r.velocity_m_s * m.encoder_offset_ns * 1e-9 - truth_m
        else:
            error = r.position_m - m.position_m
        if math.isfinite(error):
            self.count += 1
            self._square += error * error
            self._max_m = max(self._max_m, abs(error))
        v = tick.command.voltage_v
        self.saturated += tick.command.saturated
        self._max_v = max(self._max_v, abs(v))
        if math.isfinite(self._last_v):
            self._step_v += abs(v - self._last_v)
            self._steps += 1
        self._last_v = v

    def tracking_mm(self) -> dict[str, Any] | None:
        """RMS and greatest error; None if the run was too short."""
        if self.count == 0:
            return None
        return {
            "rms": 1e3 * math.sqrt(self._square / self.count),
            "max": 1e3 * self._max_m,
            "after_s": AFTER_S,
            "against": "plant" if self.has_truth else "encoder",
        }

    def command_v(self) -> dict[str, Any] | None:
        """Greatest command and mean step from tick to tick; None if the run was too short."""
        if self._steps == 0:
            return None
        return {"max": self._max_v, "mean_step": self._step_v / self._steps}


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
    *,
    state: int,
    bus: str,
    rate_hz: float,
    ticks: int,
    skipped: int,
    lateness: Histogram | None,
    latency: Histogram | None,
    tracking: Tracking,
    counts: Counts,
    tx: int,
    rx_dropped: int,
    log: str | None,
    log_dropped: int,
    faults: int,
) -> dict[str, Any]:
    """The object that `--json` prints."""
    result = {
        "schema": 1,
        "state": State(state).label,
        "bus": bus,
        "rate_hz": int(rate_hz) if rate_hz == int(rate_hz) else rate_hz,
        "ticks": ticks,
        "skipped": skipped,
        "lateness_us": percentiles_us(lateness) if lateness is not None else None,
        "sensor_to_command_us": percentiles_us(latency) if latency is not None else None,
        "tracking_mm": tracking.tracking_mm(),
        "command_v": tracking.command_v(),
        "saturated_ticks": tracking.saturated,
        "frames": {
            "rx": counts.rx,
            "tx": tx,
            "lost": counts.lost + rx_dropped,
            "crc": counts.crc,
            "stale": counts.stale,
            "late": counts.late,
        },
        "log": log,
        "log_dropped": log_dropped,
        "faults": names(faults),
    }
    cleaned: dict[str, Any] = finite(result)
    return cleaned


def in_words(s: dict[str, Any]) -> str:
    """The same for people, a few lines."""
    lines = [f"{s['state']} on {s['bus']}: {s['ticks']} ticks at {s['rate_hz']:g} Hz, {s['skipped']} skipped"]
    if s["tracking_mm"]:
        t, c = s["tracking_mm"], s["command_v"]
        lines.append(
            f"tracking error {t['rms']:.3f} mm RMS, {t['max']:.3f} mm max (from {t['after_s']:g} s,"
            f" against the {t['against']}); command {c['max']:.2f} V max, {c['mean_step']:.3f} V mean step"
        )
    for key, label in (("lateness_us", "wake-up lateness"), ("sensor_to_command_us", "sensor to command")):
        if s[key]:
            p = s[key]
            lines.append(f"{label} {p['p50']:.0f} µs p50, {p['p99']:.0f} p99, {p['max']:.0f} max")
    f = s["frames"]
    lines.append(
        f"frames {f['rx']} in, {f['tx']} out, {f['lost']} lost, {f['crc']} corrupt, {f['stale']} frozen,"
        f" {f['late']} late"
    )
    if s["faults"]:
        lines.append(f"faults: {', '.join(s['faults'])}")
    if s["log"]:
        lost = f", {s['log_dropped']} records lost" if s["log_dropped"] else ""
        lines.append(f"log {s['log']}{lost}")
    return "\n".join(lines)
