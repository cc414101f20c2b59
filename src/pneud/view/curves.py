"""The four groups of curves: error, position with its reference, pressures on one scale, the valve.

Where the axis presses, the force takes the place of the error.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from rich.style import Style

from pneud.log.live.amiss import NEVER_NS
from pneud.signals import Record, State, ValveState
from pneud.view.history import Column, History, Trace, span_s
from pneud.view.info import ScreenInfo
from pneud.view.palette import Palette
from pneud.view.plot import Curve, Guide, extremes, plot, range_limits, row_at, signed_limits
from pneud.view.text import DIM, LABEL_WIDTH, PLAIN, Rows, duration, length, name_of, number

# no curve is drawn on a finer scale than this, so that noise does not look like motion
_LEAST_ERROR_M = 1e-6
_LEAST_POSITION_M = 1e-3
_LEAST_PRESSURE_PA = 5e4
_LEAST_COMMAND_V = 0.05
_LEAST_FORCE_N = 10.0
_TAGS_WIDTH = 8
_OLD_TICKS = 10  # after so many without it a value is not of now


class Group(NamedTuple):
    """Curves on one scale."""

    name: str
    numbers: tuple[tuple[str, Style], ...]
    curves: tuple[Curve, ...]
    tags: tuple[tuple[str, float, Style], ...]  # name, newest value, style; at the right edge
    limits: tuple[float, float]
    guides: tuple[Guide, ...]
    words: Callable[[float], str]  # for a value on the scale


def curves_of(record: Record, history: History, info: ScreenInfo, look: Palette, columns: int) -> list[Group]:
    """All four; `columns` is how many values each curve has."""
    t_ns = record.tick.t_ns

    def curve(trace: Trace, style: Style, letter: str = "") -> Curve:
        return Curve(trace.columns(t_ns, columns), style, letter)

    h = history
    if record.tick.state == State.PRESSING:
        first = _force(record, info, look, h.wanted.columns(t_ns, columns), h.force.columns(t_ns, columns))
    else:
        first = _error(record, h, look, curve(h.error, look.error))
    return [
        first,
        _position(
            record, look, curve(h.reference, look.reference, "r"), curve(h.position, look.position, "x")
        ),
        _pressures(
            record,
            info,
            look,
            (curve(h.supply, look.supply, "s"), curve(h.p2, look.p2, "2"), curve(h.p1, look.p1, "1")),
        ),
        _valve(record, info, look, curve(h.command, look.command)),
    ]


def _error(record: Record, history: History, look: Palette, curve: Curve) -> Group:
    tick = record.tick
    true = f"true {length(record.true_error_m).strip()}" if math.isfinite(record.truth_m) else ""
    return Group(
        "error",
        (
            (length(tick.error_m).strip(), look.error),
            (f"rms {length(history.error.rms(tick.t_ns), '').strip()}", PLAIN),
            (true, PLAIN),
            (f"curves of {span_s(len(curve.columns)):.0f} s", DIM),
        ),
        (curve,),
        (),
        signed_limits(extremes((curve,)), _LEAST_ERROR_M),
        (Guide(0.0, "─"),),
        _of_length,
    )


def _force(record: Record, info: ScreenInfo, look: Palette, wanted: list[Column], x3: list[Column]) -> Group:
    """The piston's force on the load, and the one that is wanted."""
    tick = record.tick
    rod_n = info.atmosphere_pa * (info.area_1_m2 - info.area_2_m2)
    if not math.isfinite(rod_n):
        rod_n = 0.0
    now_n, wanted_n = tick.estimate.x3_n - rod_n, tick.command.ustar
    own = [None if part is None else (part[0] - rod_n, part[1] - rod_n) for part in x3]
    curves = Curve(wanted, look.reference, "r"), Curve(own, look.position, "f")
    return Group(
        "force",
        (
            (number(now_n, "+.1f", "N"), look.position),
            (f"wanted {number(wanted_n, '+.1f', 'N')}", PLAIN),
            (f"error {number(tick.command.s, '+.1f', 'N')}", PLAIN),
            (f"load bears {number(tick.estimate.force_n, '+.1f', 'N')}", DIM),
        ),
        curves,
        (("ref", wanted_n, look.reference), ("f", now_n, look.position)),
        range_limits(extremes(curves), _LEAST_FORCE_N),
        (),
        lambda newtons: f"{round(newtons, 3):g} N",
    )


def _of_length(metres: float) -> str:
    if abs(metres) < 1e-3:
        return f"{metres * 1e6:+g} µm" if metres else "0"
    return f"{metres * 1e3:+g} mm"


def _position(record: Record, look: Palette, reference: Curve, position: Curve) -> Group:
    e, r = record.tick.estimate, record.tick.reference
    curves = reference, position
    return Group(
        "position",
        (
            (number(e.position_m * 1e3, ".3f", "mm"), look.position),
            (f"reference {number(r.position_m * 1e3, '.3f', 'mm')}", PLAIN),
            (f"velocity {number(e.velocity_m_s * 1e3, '+.1f', 'mm/s')}", PLAIN),
        ),
        curves,
        (("ref", r.position_m, look.reference), ("x", e.position_m, look.position)),
        range_limits(extremes(curves), _LEAST_POSITION_M),
        (),
        lambda metres: f"{round(metres * 1e3, 6):g} mm",
    )


def _old(age_ns: int, info: ScreenInfo, look: Palette) -> tuple[str, Style]:
    """That values are not of now: how old they are."""
    if age_ns * info.rate_hz < _OLD_TICKS * 1e9:
        return "", PLAIN
    return "never heard" if age_ns > NEVER_NS else f"{duration(age_ns)} old", look.bad


def _pressures(record: Record, info: ScreenInfo, look: Palette, curves: tuple[Curve, ...]) -> Group:
    m = record.tick.measurement
    return Group(
        "pressure",
        (
            (f"p1 {number(m.p1_pa * 1e-5, '.3f', 'bar')}", look.p1),
            (f"p2 {number(m.p2_pa * 1e-5, '.3f', 'bar')}", look.p2),
            (f"supply {number(m.supply_pa * 1e-5, '.3f', 'bar')}", PLAIN),
            _old(m.pressure_age_ns, info, look),
        ),
        curves,
        (("sup", m.supply_pa, look.supply), ("p2", m.p2_pa, look.p2), ("p1", m.p1_pa, look.p1)),
        range_limits(extremes(curves), _LEAST_PRESSURE_PA),
        (),
        lambda pa: f"{round(pa * 1e-5, 6):g} bar",
    )


def _valve(record: Record, info: ScreenInfo, look: Palette, curve: Curve) -> Group:
    m, c = record.tick.measurement, record.tick.command
    valve = {ValveState.ENABLED: look.good, ValveState.TIMED_OUT: look.bad, ValveState.FAULT: look.bad}
    old = _old(m.valve_age_ns, info, look)
    low, high = zone_of(info)
    zone = f"zone {1e3 * low:+.0f} {1e3 * high:+.0f} mV" if high > low else ""
    return Group(
        "valve",
        (
            (number(c.voltage_v, "+.3f", "V"), look.bad if c.saturated else look.command),
            (f"applied {number(m.applied_v, '+.3f', 'V')}", PLAIN),
            old,
            (
                name_of(ValveState, m.valve_state),
                DIM if old[0] else valve.get(m.valve_state, look.warn),  # type: ignore[call-overload]
            ),
            (zone, DIM),
        ),
        (curve,),
        (),
        signed_limits(extremes((curve,)), _LEAST_COMMAND_V),
        (Guide(0.0, "─"), *(Guide(edge, "┄") for edge in (low, high) if edge)),
        lambda volts: f"{volts:+g} V" if volts else "0",
    )


def zone_of(info: ScreenInfo) -> tuple[float, float]:
    """Both edges of the dead zone [V]: as learnt, else as configured."""
    learnt = info.learnt or {}

    def edge(name: str) -> float:
        return float(learnt[name]["value"]) if name in learnt else info.dead_zone_v

    return -edge("dead_zone_negative_v"), edge("dead_zone_positive_v")


def curve_width(width: int) -> int:
    """Cells of a curve on a page of a width."""
    return max(width - LABEL_WIDTH - _TAGS_WIDTH, 1)


def draw(rows: Rows, group: Group, height: int) -> None:
    """The numbers, and the curves in so many rows, with the scale at their left and names at their right."""
    rows.title(group.name, *group.numbers)
    width = curve_width(rows.width)
    if height < 1:
        return
    lines = plot(group.curves, group.limits, (width, height), group.guides, rows.ascii_only)
    scale = _scale(group, height)
    tags = _tags(group, height)
    for row, cells in enumerate(lines):
        rows.row()
        rows.put(f"{scale.get(row, '')} ".rjust(LABEL_WIDTH), DIM, LABEL_WIDTH)
        for text, style in cells:
            rows.put(text, style)
        for name, style in tags.get(row, ()):
            rows.put(f" {name}", style)


def _scale(group: Group, height: int) -> dict[int, str]:
    """What stands beside which row."""
    low, high = group.limits
    if height == 1:
        if low == -high:
            return {0: f"±{group.words(high).lstrip('+')}"}
        return {0: "-".join(group.words(end).partition(" ")[0] for end in group.limits)}
    middle = height // 2
    found = {0: group.words(high), height - 1: group.words(low)}
    if low == -high and height >= 5 and row_at(0.0, group.limits, height) == middle:
        found[middle] = "0"
    return found


def _tags(group: Group, height: int) -> dict[int, list[tuple[str, Style]]]:
    found: dict[int, list[tuple[str, Style]]] = {}
    for name, value, style in group.tags:
        if math.isfinite(value):
            row = found.setdefault(row_at(value, group.limits, height), [])
            if sum(len(other) + 1 for other, _ in row) + len(name) + 1 <= _TAGS_WIDTH:
                row.insert(0, (name, style))
    return found
