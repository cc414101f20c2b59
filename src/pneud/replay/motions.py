"""What a log's axis was led to do, one motion after another, with the figures that people judge a drive by.

A motion is a stretch in one state: a move (`goto`), a `jog`, a `hold`, a `track` of the configured reference,
an uploaded `profile`, a `stop`, a halt on the way (`halt`), `home`, `probe`, `force`. A request for another
one begins another one. How a motion settles is seen in the hold behind it; how a force does, in itself.

Air is what the model has flow from the supply: the opening that the valve is believed to have had, and the
measured pressures, by the configured valve. Rates of pressures would tell without a model, but their noise is
greater than the flow of an axis that stands. Volumes are those of the reference atmosphere (ANR, ISO 8778:
100 kPa, 20 °C, 65 % humidity); leaks of closed edges are left out.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pneud.config.conversions import cylinder_of, expected_of
from pneud.config.flow import gas_of
from pneud.config.models import Config
from pneud.config.reading import parse
from pneud.loading import at_rate
from pneud.log.files.columns import Block, blocks
from pneud.log.files.reader import LogReader
from pneud.physics.gas import Gas, flow_factor
from pneud.physics.ratings import DENSITY_ANR_KG_M3
from pneud.signals import (
    Answer,
    Reference,
    Request,
    RequestKind,
    State,
    error_m,
    state_name,
    true_error_m,
)

Floats = NDArray[np.float64]

LOOKED_S = 5.0  # into the hold behind a motion for when it settles: what moves it later is something else
AT_S = 0.1  # at the end of pressing, over which its force is taken
NAN = math.nan

_KINDS = {
    State.TRACKING: "track",
    State.MOVING: "halt",
    State.HOLDING: "hold",
    State.HOMING: "home",
    State.STOPPING: "stop",
    State.PROBING: "probe",
    State.PRESSING: "force",
}
_DIRECTED = ("goto", "jog", "halt")  # come from one side to where they end, as a stop does
_GRID = 4096


class Motion(NamedTuple):
    """One motion; SI, times from the log's first tick, positions in the stroke coordinate.

    The error is against the true position where a software plant tells it, else against the estimate. NaN
    stands where there is nothing to tell.
    """

    kind: str
    begin_s: float
    end_s: float  # the reference has come to its end, or something else has begun
    from_m: float  # where the load was
    to_m: float  # what was asked for, else where the reference ended
    rms_error_m: float
    max_error_m: float
    overshoot_m: float  # beyond where it went, the hold behind it included
    settling_s: float  # from `end_s` until the load stays within `in_position.tolerance_m`
    in_position_s: float  # from `begin_s` until the axis said so
    peak_speed_m_s: float
    air_anr_m3: float  # from the supply; 1e-3 is a normal litre
    air_energy_j: float  # what that air could have done, had it expanded to the atmosphere at its temperature
    work_j: float  # of the piston on load, friction and mass while it drives
    to_n: float = NAN  # force of the piston that was asked for
    at_n: float = NAN  # and that was there at the end
    beyond_n: float = NAN  # further than was asked for, at most
    mean_step_v: float = NAN  # of the command, from tick to tick
    saturated_ticks: int = 0  # in which the law asked for more than it got
    supply_min_pa: float = NAN
    ended_in: str = ""  # the state behind it; nothing where the log ends with it

    @property
    def duration_s(self) -> float:
        """How long it took the reference."""
        return self.end_s - self.begin_s

    @property
    def settled_s(self) -> float:
        """When it had settled, from the log's first tick."""
        return self.end_s + self.settling_s


class FlowFactor:
    """γ·P of a gas for arrays, by a table."""

    def __init__(self, gas: Gas) -> None:
        self._ratios = np.linspace(0.0, 1.0, _GRID + 1)
        self._factors = np.array([flow_factor(r, gas) for r in self._ratios.tolist()])

    def pa(self, upstream_pa: Floats, downstream_pa: Any) -> Floats:
        """As `gas.signed_flow`, 0 where the flow would run backwards [Pa]."""
        ratio = downstream_pa / np.maximum(upstream_pa, 1.0)
        flow: Floats = upstream_pa * np.interp(ratio, self._ratios, self._factors)
        return flow


class AirFlow:
    """Flow from the supply, for arrays."""

    def __init__(self, config: Config) -> None:
        self._gas, self.cylinder = gas_of(config), cylinder_of(config)
        self._factor = FlowFactor(self._gas)

    def kg_s(self, opening_v: Floats, p1_pa: Floats, p2_pa: Floats, supply_pa: Floats) -> Floats:
        """Mass flow from the supply at an effective opening; what flows back into it is not counted."""
        g, filled_pa = self._gas, np.where(opening_v > 0.0, p1_pa, p2_pa)
        flow = self._factor.pa(supply_pa, filled_pa) / (g.k * g.R * g.temperature_k)
        return np.abs(opening_v) * self.cylinder.c1 * flow

    def joule_per_kg(self, supply_pa: Floats) -> Floats:
        """What air of that pressure can do at most, by R T ln(p/p0)."""
        g = self._gas
        found: Floats = g.R * g.temperature_k * np.log(np.maximum(supply_pa / g.atmosphere_pa, 1.0))
        return found


class _Open:
    """A motion that goes on, or whose settling is still looked at."""

    def __init__(self, kind: str, begin_s: float, from_m: float, to_m: float, to_n: float = NAN) -> None:
        self.kind, self.begin_s, self.from_m, self.to_m = kind, begin_s, from_m, to_m
        self.asked = not math.isnan(to_m)
        self.to_n, self.from_n, self.at_n = to_n, NAN, NAN
        self.beyond_n = 0.0 if not math.isnan(to_n) else NAN
        self.end_s = self.last_s = begin_s
        self.count = self.ticks = 0
        self.square = self.max_m = self.speed_m_s = self.air_kg = self.energy_j = self.work_j = 0.0
        self.beyond_m = -math.inf
        self.low_m = self.high_m = from_m
        self.step_v, self.saturated, self.supply_pa, self.last_v = 0.0, 0, math.inf, NAN
        self.ended_in = ""
        self.tail_s = self.in_position_s = NAN  # how far it was looked at; when the axis said so
        self.outside_s = -math.inf  # last tick out of tolerance

    def finish(self) -> Motion:
        held = not math.isnan(self.tail_s)
        over_m = NAN
        if self.count and (held if self.kind in _DIRECTED else self.kind == "stop"):
            over_m = max(0.0, self.high_m - self.to_m if self.to_m > self.from_m else self.to_m - self.low_m)
        return Motion(
            self.kind, self.begin_s, self.end_s, self.from_m, self.to_m,
            math.sqrt(self.square / self.count) if self.count else NAN,
            self.max_m if self.count else NAN,
            over_m,
            max(0.0, self.outside_s - self.end_s) if held and self.outside_s < self.tail_s else NAN,
            self.in_position_s - self.begin_s,
            self.speed_m_s, self.air_kg / DENSITY_ANR_KG_M3, self.energy_j, self.work_j,
            self.to_n, self.at_n, self.beyond_n,
            self.step_v / (self.ticks - 1) if self.ticks > 1 else NAN,
            self.saturated,
            self.supply_pa if math.isfinite(self.supply_pa) else NAN,
            self.ended_in,
        )  # fmt: skip


class _Columns(NamedTuple):
    """Of a block, what motions are made of."""

    t_s: Floats
    dt_s: Floats  # to the next tick
    error_m: Floats
    position_m: Floats
    speed_m_s: Floats
    reference_m: Floats
    air_kg: Floats
    energy_j: Floats
    work_j: Floats
    in_position: NDArray[np.bool_]
    force_n: Floats  # of the piston
    voltage_v: Floats
    saturated: NDArray[np.int64]
    supply_pa: Floats


class Motions:
    """Takes a log block by block and keeps no ticks."""

    def __init__(self, config: Config) -> None:
        self.air = AirFlow(config)
        self._tolerance_m = expected_of(config).tolerance_m
        self._period_s = 1.0 / config.loop.rate_hz
        self._done: list[Motion] = []
        self._now: _Open | None = None  # goes on
        self._before: _Open | None = None  # settles in the hold that goes on
        self._place = 0  # of it, in what is done
        self._state = -1
        self._jog_m_s = 0.0
        self._has_truth = False

    def add(self, block: Block, t_s: Floats) -> None:
        """Take the ticks of a block, at these times from the log's first tick."""
        states = block.ticks["state"].astype(np.int64)
        columns = self._columns(block, t_s)
        answers = block.ticks["answer"]
        taken = {i: r for i, r in block.requests if answers[i] == Answer.TAKEN}
        cuts = set(np.flatnonzero(np.diff(states, prepend=self._state)).tolist())
        begins = sorted(cuts | {i for i, request in taken.items() if self._redirects(request)} | {0})
        for begin, end in zip(begins, [*begins[1:], len(t_s)], strict=True):
            state, request = int(states[begin]), taken.get(begin)
            if begin in cuts or (request is not None and self._redirects(request)):
                self._begin(state, request, columns, begin)
            self._go_on(columns, begin, end)
        if len(t_s):
            self._state = int(states[-1])

    def finish(self) -> list[Motion]:
        """All motions in their order; the last one as far as it went."""
        self._end()
        self._put_away()
        return self._done

    def _columns(self, block: Block, t_s: Floats) -> _Columns:
        real = block.real
        reference = Reference._make(real(f"reference.{name}") for name in Reference._fields)
        truth, position = real("truth_m"), real("estimate.position_m")
        self._has_truth = self._has_truth or bool(np.isfinite(truth).any())
        error = error_m(reference, position)
        if self._has_truth:
            position = truth
            error = true_error_m(reference, block.ticks["measurement.encoder_offset_ns"], truth)
        dt_s = np.diff(t_s, append=t_s[-1] + self._period_s)
        speed, supply = real("estimate.velocity_m_s"), real("measurement.supply_pa")
        pressures = real("measurement.p1_pa"), real("measurement.p2_pa"), supply
        air_kg = self.air.kg_s(real("estimate.opening_v"), *pressures) * dt_s
        force = real("estimate.x3_n") - self.air.cylinder.rod_force_n
        return _Columns(
            t_s, dt_s, error, position, speed, real("reference.position_m"), air_kg,
            air_kg * self.air.joule_per_kg(supply), np.maximum(force * speed, 0.0) * dt_s,
            block.ticks["in_position"] != 0, force,
            real("command.voltage_v"), block.ticks["command.saturated"].astype(np.int64), supply,
        )  # fmt: skip

    def _redirects(self, request: Request) -> bool:
        """Whether another motion begins, be the state the same."""
        if request.kind == RequestKind.JOG:
            return request.values[0] not in (0.0, self._jog_m_s)  # else it renews a lease, or ends the jog
        return request.kind in (RequestKind.GOTO, RequestKind.TRACK, RequestKind.FORCE)

    def _begin(self, state: int, request: Request | None, c: _Columns, at: int) -> None:
        settles = state == State.HOLDING
        self._end(settles, state_name(state))
        self._jog_m_s = 0.0
        kind, to_m = _KINDS.get(State(state) if 0 <= state < len(State) else State.FAULT, ""), NAN
        if request is not None and request.kind == RequestKind.GOTO:
            kind, to_m = "goto", request.values[0]
        elif request is not None and request.kind == RequestKind.JOG and state == State.MOVING:
            kind, self._jog_m_s = "jog", request.values[0]
        elif request is not None and request == Request(RequestKind.TRACK, (1.0,)):
            kind = "profile"
        to_n = NAN
        if request is not None and request.kind == RequestKind.FORCE and state == State.PRESSING:
            to_n = request.values[0]
        if kind:
            self._now = _Open(kind, float(c.t_s[at]), float(c.position_m[at]), to_m, to_n)

    def _end(self, settles: bool = False, into: str = "") -> None:
        """What was going on is over; how it settles is looked at in a hold behind it."""
        self._put_away()
        ended, self._now = self._now, None
        if ended is None:
            return
        ended.ended_in = into
        if settles and ended.kind not in ("hold", "force"):
            self._before = ended
            self._place = len(self._done)
        self._done.append(ended.finish())

    def _put_away(self) -> None:
        if self._before is not None:
            self._done[self._place] = self._before.finish()
        self._before = None

    def _go_on(self, c: _Columns, begin: int, end: int) -> None:
        m = self._now
        if m is None:
            return
        c = _Columns._make(column[begin:end] for column in c)
        error = c.error_m[np.isfinite(c.error_m)]
        if len(error):
            m.count += len(error)
            m.square += float(error @ error)
            m.max_m = max(m.max_m, float(np.abs(error).max()))
        m.speed_m_s = max(m.speed_m_s, float(np.abs(c.speed_m_s).max()))
        m.air_kg += float(np.nansum(c.air_kg))
        m.energy_j += float(np.nansum(c.energy_j))
        m.work_j += float(np.nansum(c.work_j))
        m.end_s = float(c.t_s[-1] + c.dt_s[-1])
        _count(m, c)
        _stretch(m, c.position_m)
        if not m.asked and not math.isnan(c.reference_m[-1]):
            m.to_m = float(c.reference_m[-1])
        if m.kind == "force":
            _pressed(m, c)
        if self._before is not None:
            self._settle(self._before, c)

    def _settle(self, m: _Open, c: _Columns) -> None:
        said = np.flatnonzero(c.in_position)
        if math.isnan(m.in_position_s) and len(said):
            m.in_position_s = float(c.t_s[said[0]])
        near = c.t_s < m.end_s + LOOKED_S
        if not near.any():
            return
        t_s, x_m = c.t_s[near], c.position_m[near]
        _stretch(m, x_m)
        outside = np.flatnonzero(np.abs(x_m - m.to_m) > self._tolerance_m)
        if len(outside):
            m.outside_s = float(t_s[outside[-1]] + self._period_s)
        m.tail_s = float(t_s[-1])


def _count(m: _Open, c: _Columns) -> None:
    """What the command did, and the supply."""
    m.ticks += len(c.t_s)
    m.step_v += float(np.nansum(np.abs(np.diff(c.voltage_v, prepend=m.last_v))))
    m.last_v = float(c.voltage_v[-1])
    m.saturated += int(c.saturated.sum())
    m.supply_pa = float(np.fmin.reduce(c.supply_pa, initial=m.supply_pa))


def _pressed(m: _Open, c: _Columns) -> None:
    """What a force comes to: it ends in the mean over a while, and says itself when it is reached."""
    said = np.flatnonzero(c.in_position)
    if math.isnan(m.in_position_s) and len(said):
        m.in_position_s = float(c.t_s[said[0]])
    if math.isnan(m.from_n):
        m.from_n = float(c.force_n[0])
    m.at_n = float(c.force_n[c.t_s >= c.t_s[-1] - AT_S].mean())
    beyond = c.force_n - m.to_n if m.to_n >= m.from_n else m.to_n - c.force_n
    m.beyond_n = max(m.beyond_n, float(beyond.max())) if not math.isnan(m.to_n) else NAN


def _stretch(m: _Open, position_m: Floats) -> None:
    m.low_m = float(np.fmin.reduce(position_m, initial=m.low_m))
    m.high_m = float(np.fmax.reduce(position_m, initial=m.high_m))


def motions(log: LogReader) -> list[Motion]:
    """The motions of a log.

    Args:
        log: the log; its `truncated`, `damage` and `missing` are valid afterwards.

    Raises:
        ConfigError: the configuration in the log cannot be used by this version.
    """
    config = at_rate(parse(log.config_text, f"{log.path}:{log.config_name}"), log.rate_hz)
    found, first_ns = Motions(config), None
    for block in blocks(log, frames=False):
        if len(block.number):
            t_ns: Any = block.ticks["t_ns"]
            first_ns = int(t_ns[0]) if first_ns is None else first_ns
            found.add(block, (t_ns - first_ns) * 1e-9)
    return found.finish()
