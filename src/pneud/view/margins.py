"""How much is left of travel, speed, supply and force: bars, with the worst of the last seconds marked."""

from __future__ import annotations

import math
from typing import NamedTuple

from pneud.signals import Record
from pneud.view.history import History
from pneud.view.info import ScreenInfo
from pneud.view.palette import Palette
from pneud.view.plot import bar
from pneud.view.text import BOLD, DIM, Rows, number

_LOOK, _BAD = 0.7, 0.9  # of what is allowed


class Margin(NamedTuple):
    """One of them."""

    name: str
    used: float  # 0 … 1 of what is allowed; NaN where nobody knows
    worst: float  # likewise, of the last seconds
    left: str  # in words


def margins_of(record: Record, history: History, info: ScreenInfo) -> list[Margin]:
    """Speed, supply and force; travel is a bar of its own."""
    tick = record.tick
    t_ns, e, m = tick.t_ns, tick.estimate, tick.measurement
    slow, fast = history.velocity.lately(t_ns)
    speed = info.speed_m_s
    pushes, pulls = _forces(m.supply_pa, info)
    weak, strong = history.force.lately(t_ns)
    low, high = history.supply.lately(t_ns)
    force = _used_force(e.x3_n, pushes, pulls)
    most = pushes if e.x3_n >= 0.0 else pulls
    room = min(m.supply_pa - info.supply_min_pa, info.supply_max_pa - m.supply_pa)
    return [
        Margin(
            "speed",
            abs(e.velocity_m_s) / speed,
            max(abs(slow), abs(fast)) / speed,
            number((speed - abs(e.velocity_m_s)) * 1e3, ".0f", "mm/s"),
        ),
        Margin(
            "supply",
            _used_supply(m.supply_pa, info),
            max(_used_supply(low, info), _used_supply(high, info)),
            number(room * 1e-5, ".2f", "bar"),
        ),
        Margin(
            "force",
            force,
            max(_used_force(weak, pushes, pulls), _used_force(strong, pushes, pulls)),
            number(abs(most) - abs(e.x3_n), ".0f", "N"),
        ),
    ]


def _forces(supply_pa: float, info: ScreenInfo) -> tuple[float, float]:
    """The most that the supply pushes and pulls with [N], the one chamber full and the other one empty."""
    a1, a2, outside = info.area_1_m2, info.area_2_m2, info.atmosphere_pa
    return supply_pa * a1 - outside * a2, outside * a1 - supply_pa * a2


def _used_force(force_n: float, pushes: float, pulls: float) -> float:
    most = pushes if force_n >= 0.0 else pulls
    return force_n / most if math.isfinite(most) and most else math.nan


def _used_supply(pa: float, info: ScreenInfo) -> float:
    half = 0.5 * (info.supply_max_pa - info.supply_min_pa)
    return abs(pa - info.supply_min_pa - half) / half if half > 0.0 else math.nan


def draw(rows: Rows, record: Record, history: History, info: ScreenInfo, look: Palette) -> None:
    """A row with the load in its travel, and one with the bars."""
    _travel(rows, record, history, info, look)
    margins = margins_of(record, history, info)
    cell = rows.width // len(margins)
    rows.row()
    for margin in margins:
        rows.put(margin.name, DIM, 7)
        n = max(cell - 7 - 12, 1)
        style = look.bad if margin.used > _BAD else look.warn if margin.used > _LOOK else look.good
        rows.put(bar(margin.used, margin.worst, n, rows.ascii_only), style)
        rows.put(f" {margin.left}", width=12)


def _travel(rows: Rows, record: Record, history: History, info: ScreenInfo, look: Palette) -> None:
    tick = record.tick
    position, reference = tick.estimate.position_m, tick.reference.position_m
    low, high = info.travel_min_m, info.travel_max_m
    left, right = f"{low * 1e3:.0f} ├", f"┤ {high * 1e3:.0f} mm"
    room = f"  {number(min(position - low, high - position) * 1e3, '.0f', 'mm')} left"
    rows.row()
    rows.put("travel", DIM, 7)
    rows.put(left, DIM)
    n = max(rows.room - len(right) - len(room), 1)
    cells = ["─"] * n

    def at(metres: float) -> int:
        return min(n - 1, int(max(0.0, min(1.0, (metres - low) / (high - low))) * n))

    been = history.position.lately(tick.t_ns)
    if all(map(math.isfinite, been)):
        for i in range(at(been[0]), at(been[1]) + 1):
            cells[i] = "═"
    for value, mark in ((reference, "│"), (position, "●")):
        if math.isfinite(value):
            cells[at(value)] = mark
    inside = not math.isfinite(position) or low <= position <= high
    rows.put("".join(cells), BOLD if inside else look.bad)
    rows.put(right, DIM)
    rows.right(room)
