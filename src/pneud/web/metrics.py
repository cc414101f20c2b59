"""A status as metrics: Prometheus's text, which node exporter reads from files, and OpenMetrics.

Units are those of SI, names as both have them; what a status does not know has no sample. Counters begin with
the run, and again with the next one, but for what an axis does in its life.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from pneud import __version__
from pneud.safety.faults import FAULT_NAMES
from pneud.signals import Hold, Hunting, State

TEXT = "text/plain; version=0.0.4; charset=utf-8"
OPENMETRICS = "application/openmetrics-text; version=1.0.0; charset=utf-8"

Sample = tuple[dict[str, str], float]


class Family(NamedTuple):
    """Metrics of one name."""

    name: str  # of counters without _total
    kind: str  # gauge, counter or histogram
    words: str  # a sentence
    samples: list[tuple[str, dict[str, str], float]]  # behind the name, labels, value


def families(status: Mapping[str, Any] | None) -> list[Family]:
    """All metrics of a status; None where no daemon answers."""
    up = _gauge("up", "Whether a daemon answers", [({}, float(status is not None))])
    if status is None:
        return [up]
    return [up, *chain.from_iterable(group(status) for group in GROUPS.values())]


def text_of(statuses: Sequence[Mapping[str, Any]], openmetrics: bool = False) -> str:
    """The text of all metrics.

    Args:
        statuses: of each axis, as the console tells it; none where no daemon answers.
        openmetrics: in that dialect, else in Prometheus's.
    """
    lines: dict[str, list[str]] = {}  # by families, each in one piece
    for status in statuses or (None,):
        axis = {} if status is None else {"axis": str(status["name"])}
        for family in families(status):
            total = "_total" if family.kind == "counter" else ""
            name = f"pneud_{family.name}"
            found = lines.setdefault(name, _head(name if openmetrics else name + total, family, openmetrics))
            found += [
                f"{name}{total}{behind}{_labels({**axis, **labels})} {_number(value)}"
                for behind, labels, value in family.samples
                if not math.isnan(value)
            ]
    return "\n".join([*chain.from_iterable(lines.values()), *["# EOF"] * openmetrics]) + "\n"


def _head(name: str, family: Family, openmetrics: bool) -> list[str]:
    unit = _UNITS.search(name) if openmetrics else None
    return [
        f"# HELP {name} {family.words}.",
        *([f"# UNIT {name} {unit[1]}"] if unit else []),
        f"# TYPE {name} {family.kind}",
    ]


_UNITS = re.compile(
    r"_(seconds|meters|meters_per_second|meters_per_second_squared|cubic_meters|pascals|volts|bytes|ratio)$"
)


def _labels(labels: Mapping[str, str]) -> str:
    escapes = str.maketrans({"\\": r"\\", '"': r"\"", "\n": r"\n"})
    inner = ",".join(f'{name}="{value.translate(escapes)}"' for name, value in labels.items())
    return f"{{{inner}}}" if inner else ""


def _number(value: float) -> str:
    return "+Inf" if value == math.inf else f"{value:.12g}"


def _gauge(name: str, words: str, samples: list[Sample]) -> Family:
    return Family(name, "gauge", words, [("", *sample) for sample in samples])


def _counter(name: str, words: str, samples: list[Sample]) -> Family:
    return Family(name, "counter", words, [("", *sample) for sample in samples])


def _value(value: Any, factor: float = 1.0) -> list[Sample]:
    return [({}, math.nan if value is None else float(value) * factor)]


def _info(s: Mapping[str, Any]) -> Iterator[Family]:
    yield _gauge("info", "What runs", [({"bus": str(s["bus"]), "version": __version__}, 1.0)])


def _state(s: Mapping[str, Any]) -> Iterator[Family]:
    states = [({"state": one.label}, float(s["state"] == one.label)) for one in State]
    yield _gauge("state", "1 for the state in which the axis is", states)
    found = {fault["name"]: fault for fault in s["faults"]}
    for kind, words in (("present", "there now"), ("latched", "held until they are cleared")):
        samples = [({"fault": f}, float(found.get(f, {}).get(kind, False))) for f in FAULT_NAMES]
        yield _gauge(f"fault_{kind}", f"1 for faults that are {words}", samples)
    yield _gauge("in_position", "1 where the load is in position", _value(s["in_position"]))
    cause = (s["hunting"] or {}).get("cause")
    hunting = [({"cause": one.label}, float(one.label == cause)) for one in Hunting if one]
    yield _gauge("hunting", "1 where the load swings at its target, by cause", hunting)
    station = s.get("station")
    if station is not None:
        for what in ("input", "output"):
            samples = [({what: name}, float(on)) for name, on in station[f"{what}s"].items()]
            yield _gauge(what, f"1 for {what}s that are on", samples)
        if station["brake"]:
            brake = [({"hold": one.label}, float(station["brake"] == one.label)) for one in Hold if one]
            yield _gauge("brake", "1 for what the brake does", brake)
    yield _gauge("commanded", "1 while somebody holds the lease", _value(s["lease"] is not None))
    yield _gauge(
        "config_changed", "1 where the file is no longer what was loaded", _value(s["config_changed"])
    )


def _load(s: Mapping[str, Any]) -> Iterator[Family]:
    for name, key, words in (
        ("position_meters", "position_mm", "Position of the load"),
        ("reference_meters", "reference_mm", "Where it is led"),
        ("error_meters", "error_mm", "Reference less position"),
        ("velocity_meters_per_second", "velocity_mm_s", "Speed of the load"),
    ):
        yield _gauge(name, words, _value(s[key], 1e-3))
    bar = s["pressures_bar"] or {}
    pressures = [({"place": place}, _value(bar.get(place), 1e5)[0][1]) for place in ("p1", "p2", "supply")]
    yield _gauge("pressure_pascals", "Absolute pressures of the chambers and the supply", pressures)
    yield _gauge("command_volts", "Voltage of the valve as commanded", _value(s["command_v"]))


def _timing(s: Mapping[str, Any]) -> Iterator[Family]:
    yield _counter("ticks", "Ticks of the loop", _value(s["ticks"]))
    yield _counter("ticks_skipped", "Ticks that the loop came too late for", _value(s["skipped"]))
    yield _counter("ticks_saturated", "Ticks in which the command was held back", _value(s.get("saturated")))
    yield _gauge("tick_period_seconds", "From one tick to the next", _value(1.0 / s["rate_hz"]))
    yield _gauge("silent_seconds", "Since the newest tick", _value(s["silent_s"]))
    for name, words in (
        ("lateness", "How late ticks began"),
        ("sensor_to_command", "From the newest frame of a sensor to the command"),
    ):
        h = s.get("histograms", {}).get(name)
        if h:
            buckets = [*zip(h["le_us"], h["count"], strict=True), (math.inf, h["all"])]
            samples = [("_bucket", {"le": _number(le * 1e-6)}, float(n)) for le, n in buckets]
            samples += [("_sum", {}, h["sum_us"] * 1e-6), ("_count", {}, float(h["all"]))]
            yield Family(f"{name}_seconds", "histogram", words, samples)


def _readings(s: Mapping[str, Any]) -> Iterator[Family]:
    amiss = [({"kind": kind}, float(count)) for kind, count in s["amiss"].items()]
    yield _counter("readings_amiss", "Readings that ticks had to go without", amiss)
    frames = s["frames"]
    ways = [({"way": way}, float(frames[key])) for way, key in (("received", "rx"), ("sent", "tx"))]
    yield _counter("frames", "Frames on the bus", ways)
    bad = (("lost", "lost"), ("corrupt", "crc"), ("frozen", "stale"), ("late", "late"))
    samples = [({"kind": kind}, float(frames[key])) for kind, key in bad]
    yield _counter("frames_amiss", "Frames that did not come, or could not be used", samples)
    because = [({"cause": cause}, float(n)) for cause, n in s.get("amiss_because", {}).items()]
    yield _counter("readings_refused", "Readings missing because their frames were bad", because)


def _log(s: Mapping[str, Any]) -> Iterator[Family]:
    yield _counter("log_records", "Records that the log has taken", _value(s["log_written"]))
    yield _counter("log_records_lost", "Records that are not in the log", _value(s["log_dropped"]))
    yield _gauge("log_failing", "1 where the recorder tells of an error", _value(s["log_error"] is not None))
    yield _gauge("log_size_bytes", "Size of the log's file", _value(s.get("log_bytes")))
    try:
        disk = os.statvfs(Path(s["log"]).parent)
    except OSError:
        return
    yield _gauge("log_disk_free_bytes", "Left on the log's disk", _value(disk.f_bavail * disk.f_frsize))
    yield _gauge("log_disk_size_bytes", "Size of the log's disk", _value(disk.f_blocks * disk.f_frsize))


def _mileage(s: Mapping[str, Any]) -> Iterator[Family]:
    done = s["mileage"]
    for name, key, factor, words in (
        ("strokes", "strokes", 1.0, "Times that the load has turned, in the life of the axis"),
        ("travel_meters", "travel_m", 1.0, "Way of the load to and fro, in the life of the axis"),
        (
            "air_cubic_meters",
            "air_normal_l",
            1e-3,
            "Air from the supply as volume of the reference atmosphere, in the life of the axis",
        ),
        ("engaged_seconds", "engaged_h", 3600.0, "Time that the axis was engaged, in its life"),
    ):
        yield _counter(name, words, _value(done[key], factor))
    name, words = "hardest_stop_meters_per_second_squared", "Greatest deceleration in the life of the axis"
    yield _gauge(name, words, _value(done["hardest_stop_m_s2"]))
    yield _gauge(
        "mileage_kept",
        "1 where that outlives the run",
        _value(None if done["kept"] == "no" else done["kept"] == "kept"),
    )


def _processes(s: Mapping[str, Any]) -> Iterator[Family]:
    each = [({"process": str(p["name"])}, p) for p in s["processes"]]
    for name, keys, label, words in (
        ("cpu_seconds", {"user": "user_s", "system": "system_s"}, "mode", "Time of a processor"),
        ("waited_seconds", {"": "waited_s"}, "", "Time in which others had the processor"),
    ):
        samples = [
            ({**of, **({label: value} if label else {})}, _value(p[key])[0][1])
            for of, p in each
            for value, key in keys.items()
        ]
        yield _counter(f"process_{name}", words, samples)
    for name, key, words in (
        ("context_switches", "switches", "Times that another one got the processor"),
        ("page_faults", "page_faults", "Times that memory was not at hand"),
    ):
        samples = [({**of, "kind": kind}, float(n)) for of, p in each for kind, n in p[key].items()]
        yield _counter(f"process_{name}", words, samples)
    for name, key, words in (
        ("resident_memory_bytes", "resident_bytes", "Memory"),
        ("threads", "threads", "Threads"),
    ):
        yield _gauge(f"process_{name}", words, [(of, float(p[key])) for of, p in each])


GROUPS: dict[str, Callable[[Mapping[str, Any]], Iterator[Family]]] = {
    "info": _info,
    "state": _state,
    "load": _load,
    "timing": _timing,
    "readings": _readings,
    "log": _log,
    "mileage": _mileage,
    "processes": _processes,
}
"""All metrics of a status, by what they are about."""
