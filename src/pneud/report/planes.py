"""What a log says that time does not show: spectrum, friction, flow, pressures, valve, place and period."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pneud.config.conversions import cylinder_of, friction_of, reference_of, valve_of
from pneud.config.flow import gas_of, vent_of
from pneud.config.models import Config
from pneud.log.files.columns import Block
from pneud.physics.valve import opening
from pneud.replay.motions import FlowFactor
from pneud.report.bins import Bins, Spectrum, fine_about_zero
from pneud.report.colours import BLACK, BLUE, GREEN, ORANGE, PINK, RED, SKY
from pneud.report.decimate import Path
from pneud.safety.supervisor import is_engaged
from pneud.signals import State

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_ENGAGED = np.array([is_engaged(state) for state in range(max(State) + 1)])
_LENGTH_S = 4.0  # of a stretch whose spectrum is taken
_RATE_S = 5e-3  # to both sides, over which a rate is taken
_STEADY, _STEADY_V = 0.05, 0.02  # how much a command may change meanwhile
_VOLTS = 2000  # bins of a command
_FINE, _SHOWN = 400, 80  # bins that values are sorted into, and about how many are drawn
_PHASES = 200  # of a period
_ROUND = 0.02  # part of a circle that a reference which joins is off


class Trace(NamedTuple):
    """One line of a plane."""

    label: str
    x: Floats
    y: Floats
    colour: str = BLUE
    kind: str = "line"  # "points", "bars", or "mark": a line all across


class Plane(NamedTuple):
    """One figure that is not over time. Where logs are compared, the first line of each is drawn."""

    name: str
    title: str
    across: str
    up: str
    traces: tuple[Trace, ...]
    note: str = ""
    logarithmic: bool = False


class Sample(NamedTuple):
    """Of a block, what planes are made of."""

    block: Block
    t_s: Floats
    state: NDArray[np.int64]
    error_mm: Floats
    engaged: Bools
    led: Bools  # along a reference that moves


def sample(block: Block, t_s: Floats, state: NDArray[np.int64], error_mm: Floats) -> Sample:
    """A block with what is asked of every tick."""
    engaged = _ENGAGED[np.minimum(state, len(_ENGAGED) - 1)]
    return Sample(block, t_s, state, error_mm, engaged, np.isin(state, (State.TRACKING, State.MOVING)))


class Planes:
    """All of them for one log."""

    def __init__(self, config: Config, buckets: int) -> None:
        self._parts: tuple[Any, ...] = (
            _Error(config),
            _Friction(config),
            _Flow(config),
            _Pressures(config, buckets),
            _Valve(config),
            _Place(config),
            _Period(config),
        )

    def add(self, s: Sample) -> None:
        """Take a block."""
        for part in self._parts:
            part.add(s)

    def planes(self) -> list[Plane]:
        """Those that have something in them."""
        found = (part.plane() for part in self._parts)
        return [plane for plane in found if plane.traces and len(plane.traces[0].x) > 1]


class _Error:
    def __init__(self, config: Config) -> None:
        rate_hz = config.loop.rate_hz
        length = 1 << round(math.log2(_LENGTH_S * rate_hz))
        self._led, self._held = Spectrum(rate_hz, length), Spectrum(rate_hz, length)

    def add(self, s: Sample) -> None:
        self._led.add(s.block.number, 1e3 * s.error_mm, s.led)
        self._held.add(s.block.number, 1e3 * s.error_mm, s.state == State.HOLDING)

    def plane(self) -> Plane:
        traces = [
            Trace(label, *spectrum.density(), colour)
            for label, spectrum, colour in (("led", self._led, BLUE), ("holding", self._held, ORANGE))
        ]
        return Plane(
            "spectrum", "Spectrum of the error", "Hz", "µm/√Hz",
            tuple(t for t in traces if len(t.x)), "amplitude density", True,
        )  # fmt: skip


class _Friction:
    def __init__(self, config: Config) -> None:
        self._bins = Bins(fine_about_zero(config.limits.speed_m_s, _FINE))
        self._friction = friction_of(config.control.friction)

    def add(self, s: Sample) -> None:
        real = s.block.real
        self._bins.add(real("estimate.velocity_m_s")[s.engaged], real("estimate.force_n")[s.engaged])

    def plane(self) -> Plane:
        bins, f = self._bins.merged(_SHOWN), self._friction
        v, mean, spread = bins.x, bins.mean, bins.deviation
        traces = [
            Trace("mean", 1e3 * v, mean, BLUE),
            Trace("mean + deviation", 1e3 * v, mean + spread, SKY),
            Trace("mean − deviation", 1e3 * v, mean - spread, SKY),
        ]
        if f.coulomb_n > 0.0 and len(v):
            w = fine_about_zero(float(np.abs(v).max()), 2 * _SHOWN)
            w = w[(w >= v[0]) & (w <= v[-1])]
            dry = f.coulomb_n + (f.static_n - f.coulomb_n) * np.exp(-((w / f.stribeck_m_s) ** 2))
            model = np.sign(w) * dry + f.viscous_n_s_m * w
            traces.append(Trace("friction as configured", 1e3 * w, model, BLACK))
        return Plane(
            "friction", "Friction map: F̂ over velocity", "mm/s", "N", tuple(traces),
            "while engaged; a load shifts it, inertia that is not known widens it",
        )  # fmt: skip


class _Flow:
    """The opening that explains the rates of the pressures, where the valve stands still."""

    def __init__(self, config: Config) -> None:
        self._cylinder, self._gas, vent = cylinder_of(config), gas_of(config), vent_of(config)
        self._valve = valve_of(config)
        self._supply, self._vent = FlowFactor(self._gas), FlowFactor(vent)
        self._width = max(1, round(_RATE_S * config.loop.rate_hz))
        self._h = 1.0 / config.loop.rate_hz
        self._top, self._bottom = (Bins(fine_about_zero(config.valve.u_max_v, _FINE)) for _ in range(2))

    def add(self, s: Sample) -> None:
        n, real, c, g = self._width, s.block.real, self._cylinder, self._gas
        if len(s.t_s) <= 2 * n:
            return
        inner = slice(n, len(s.t_s) - n)
        u, x3 = real("measurement.applied_v"), real("estimate.x3_n")
        p1, p2, supply = (real(f"measurement.{name}_pa")[inner] for name in ("p1", "p2", "supply"))
        x1 = np.clip(real("estimate.position_m")[inner], 0.0, c.stroke_m) + c.x_e1
        span_s = s.t_s[2 * n :] - s.t_s[: -2 * n]
        rate = (x3[2 * n :] - x3[: -2 * n]) / span_s
        f0 = -g.k * (p1 * c.A1 / x1 + p2 * c.A2 / (c.L - x1))
        rest = c.L - x1
        fill = self._supply.pa(supply, p1) / x1 + c.exhaust * self._vent.pa(p2, g.atmosphere_pa) / rest
        empty = c.exhaust * self._vent.pa(p1, g.atmosphere_pa) / x1 + self._supply.pa(supply, p2) / rest
        f1 = c.c1 * np.where(u[inner] >= 0.0, fill, empty)
        missing = rate - f0 * real("estimate.velocity_m_s")[inner]
        now, change = u[inner], np.abs(u[2 * n :] - u[: -2 * n])
        still = (change <= _STEADY * np.abs(now) + _STEADY_V) & s.engaged[inner]
        still &= np.abs(span_s - 2 * n * self._h) < 0.5 * self._h
        self._top.add(now[still], (missing * f1)[still])
        self._bottom.add(now[still], (f1 * f1)[still])

    def plane(self) -> Plane:
        full_v = self._valve.u_max_v
        top, bottom = self._top.merged(_SHOWN), self._bottom.merged(_SHOWN)
        u = top.x
        traces: tuple[Trace, ...] = ()
        if len(u):
            model = np.array([opening(v, self._valve) for v in u.tolist()])
            traces = (
                Trace("by the rates of the pressures", u, 100 * top.mean / bottom.mean / full_v),
                Trace("as configured", u, 100 * model / full_v, BLACK),
            )
        return Plane(
            "flow", "Flow map: opening over command", "V", "% of the valve", traces,
            "where the command stands still; least squares over both chambers",
        )  # fmt: skip


class _Pressures:
    def __init__(self, config: Config, buckets: int) -> None:
        self._path = Path(max(1, buckets // 8))
        self._cylinder, self._supply_pa = cylinder_of(config), config.gas.supply_pa

    def add(self, s: Sample) -> None:
        real = s.block.real
        p2, p1 = (1e-5 * real(f"measurement.{name}_pa")[s.engaged] for name in ("p2", "p1"))
        self._path.add(s.t_s[s.engaged], p2, p1)

    def plane(self) -> Plane:
        p2, p1 = self._path.points().values.T
        c, ends = self._cylinder, np.array([0.0, 1e-5 * self._supply_pa])
        balance = (ends * c.A2 + 1e-5 * c.rod_force_n) / c.A1
        traces = (Trace("chambers", p2, p1), Trace("in balance", ends, balance, BLACK))
        return Plane(
            "pressure-plane", "Pressure plane", "chamber 2 [bar]", "chamber 1 [bar]", traces,
            "absolute; the load stands without friction where it is in balance",
        )  # fmt: skip


class _Valve:
    def __init__(self, config: Config) -> None:
        self._valve = valve_of(config)
        full_v = config.valve.u_max_v
        self._edges = np.linspace(-full_v, full_v, _VOLTS + 1)
        self._count, self._saturated, self._ticks = np.zeros(_VOLTS), 0, 0

    def add(self, s: Sample) -> None:
        volts = s.block.real("command.voltage_v")[s.engaged]
        self._count += np.histogram(volts, self._edges)[0]
        self._ticks += len(volts)
        self._saturated += int(s.block.ticks["command.saturated"][s.engaged].sum())

    def plane(self) -> Plane:
        used = np.flatnonzero(self._count)
        if not len(used):
            return Plane("valve", "", "", "", ())
        v = self._valve
        low, high = v.centre_v - v.dead_zone_v, v.centre_v + v.dead_zone_v
        first, last = (int(np.searchsorted(self._edges, volts)) for volts in (low, high))
        first, last = min(int(used[0]), first - 1), max(int(used[-1]) + 1, last + 1)
        each = max(1, (last - first) // 80)
        bars = np.add.reduceat(self._count, np.arange(first, last, each))
        bars[-1] -= self._count[last:].sum()
        width = each * (self._edges[1] - self._edges[0])
        x = self._edges[first:last:each] + 0.5 * width
        marks = [
            Trace("dead zone", np.array([volts, volts]), np.array([0.0, 1.0]), RED, "mark")
            for volts in (low, high)
        ]
        marks += [
            Trace("the valve's end", np.array([volts, volts]), np.array([0.0, 1.0]), PINK, "mark")
            for volts in (-v.u_max_v, v.u_max_v)
            if self._edges[first] <= volts + each * width and volts - each * width <= self._edges[last]
        ]
        share = 100.0 * self._saturated / self._ticks
        return Plane(
            "valve", "Valve command, how often", "V", "% of the time",
            (Trace("command", x, 100.0 * bars / self._ticks, BLUE, "bars"), *marks),
            f"while engaged; held back by range or slew in {share:.2g} % of the ticks",
        )  # fmt: skip


class _Place:
    def __init__(self, config: Config) -> None:
        edges = np.linspace(config.limits.travel_min_m, config.limits.travel_max_m, _FINE + 1)
        self._out, self._back = Bins(edges), Bins(edges)

    def add(self, s: Sample) -> None:
        x, v = s.block.real("reference.position_m"), s.block.real("reference.velocity_m_s")
        for bins, way in ((self._out, s.led & (v > 0.0)), (self._back, s.led & (v < 0.0))):
            bins.add(x[way], s.error_mm[way])

    def plane(self) -> Plane:
        traces = []
        for label, whole, colour, faint in (("out", self._out, BLUE, SKY), ("back", self._back, RED, ORANGE)):
            bins = whole.merged(_SHOWN)
            x = 1e3 * bins.x
            traces.append(Trace(f"mean on the way {label}", x, bins.mean, colour))
            for word, extreme in (("least", bins.low), ("greatest", bins.high)):
                traces.append(Trace(f"{word} on the way {label}", x, extreme[bins.kept], faint))
        if not len(traces[0].x):
            traces = traces[3:]
        return Plane("place", "Error over position", "mm", "mm", tuple(traces), "while it is led")


class _Period:
    """The error over the phase of a configured sine, told by the reference alone."""

    def __init__(self, config: Config) -> None:
        self._sine = reference_of(config)
        self._bins = Bins(np.linspace(0.0, 1.0, _PHASES + 1))
        self._now, self._place, self._whole = np.full(_PHASES, np.nan), -1, 0
        self._first: Floats | None = None
        self._last: Floats | None = None

    def add(self, s: Sample) -> None:
        centre_m, amplitude_m, omega = self._sine
        if amplitude_m <= 0.0 or omega <= 0.0:
            return
        real = s.block.real
        y = (real("reference.position_m") - centre_m) / amplitude_m
        x = real("reference.velocity_m_s") / (amplitude_m * omega)
        joined = (s.state == State.TRACKING) & (np.abs(np.hypot(x, y) - 1.0) < _ROUND)
        if not joined.any():
            return
        phase = (np.arctan2(y, x)[joined] / (2.0 * math.pi)) % 1.0
        error = s.error_mm[joined]
        self._bins.add(phase, error)
        place = np.minimum((phase * _PHASES).astype(np.int64), _PHASES - 1)
        wraps = np.flatnonzero(np.diff(place, prepend=self._place) < -_PHASES // 2)
        for part in np.split(np.arange(len(place)), wraps):
            if len(part) and int(place[part[0]]) < self._place - _PHASES // 2:
                self._end()
            self._now[place[part]] = error[part]
            self._place = int(place[part[-1]]) if len(part) else self._place

    def _end(self) -> None:
        if np.isfinite(self._now).mean() > 0.95:
            self._whole += 1
            self._last = self._now
            self._first = self._now if self._first is None else self._first
        self._now = np.full(_PHASES, np.nan)

    def plane(self) -> Plane:
        bins, x = self._bins, 360.0 * self._bins.x
        if self._whole < 2 or self._first is None or self._last is None:
            return Plane("period", "", "", "", ())
        low, high = bins.low[bins.kept], bins.high[bins.kept]
        degrees = 360.0 * (np.arange(_PHASES) + 0.5) / _PHASES
        traces = (
            Trace("mean", x, bins.mean, BLUE),
            Trace("least", x, low, SKY),
            Trace("greatest", x, high, SKY),
            Trace("first period", degrees, self._first, GREEN),
            Trace("last period", degrees, self._last, RED),
        )
        return Plane(
            "period", "Periods overlaid: error over phase", "°", "mm", traces,
            f"{self._whole} whole periods of the configured sine",
        )  # fmt: skip


def together(runs: Sequence[Sequence[Plane]]) -> list[tuple[Plane, list[Plane | None]]]:
    """Planes of the same name of several logs: the first one that there is, and each log's own."""
    names = list(dict.fromkeys(plane.name for planes in runs for plane in planes))
    found = []
    for name in names:
        each = [next((p for p in planes if p.name == name), None) for planes in runs]
        found.append((next(p for p in each if p is not None), each))
    return found
