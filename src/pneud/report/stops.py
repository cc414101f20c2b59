"""Faults as a log has them: when each was seen and latched, and how far the load went until it stood."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pneud.config.conversions import expected_of
from pneud.config.models import Config
from pneud.log.files.columns import Block
from pneud.report.spans import Span
from pneud.safety.supervisor import is_engaged
from pneud.signals import State

Floats = NDArray[np.float64]

LOOKED_S = 3.0  # behind a fault for when the load stands
_SMOOTH_S = 0.01  # over which its speed is taken
NAN = math.nan


class Stop(NamedTuple):
    """What became of an engaged axis that a fault took hold of."""

    t_s: float
    latched: int  # bits that came with it
    speed_m_s: float  # at that moment
    time_s: float  # until it stood for good; NaN: not within `LOOKED_S`
    distance_m: float  # to where it stood
    farthest_m: float  # on its way


class Stops:
    """Finds the stops of a log."""

    def __init__(self, config: Config) -> None:
        self._rest_m_s, self._rate_hz = expected_of(config).velocity_m_s, config.loop.rate_hz
        self._latched, self._state = 0, -1
        self._begun: tuple[float, int] | None = None
        self._t: list[Floats] = []
        self._x: list[Floats] = []
        self._done: list[Stop] = []

    def add(self, block: Block, t_s: Floats, position_m: Floats) -> None:
        """Take a block; positions are the true ones where somebody tells, else estimates."""
        (_, word), (first, more) = block.faults("latched")
        latched: NDArray[Any] = word.astype(object) | more.astype(object) << first if block.more else word
        state = block.ticks["state"]
        cuts = np.flatnonzero(latched[1:] != latched[:-1]) + 1
        if len(latched) and int(latched[0]) != self._latched:
            cuts = np.append(0, cuts)
        first = 0
        for cut in cuts.tolist():
            before = int(latched[cut - 1]) if cut else self._latched
            came = int(latched[cut]) & ~before
            was = int(state[cut - 1]) if cut else self._state
            if came and was >= 0 and is_engaged(was) and was != State.STOPPING:
                self._keep(t_s[first:cut], position_m[first:cut])
                self._end()
                self._begun, first = (float(t_s[cut]), came), cut
        self._keep(t_s[first:], position_m[first:])
        if len(latched):
            self._latched, self._state = int(latched[-1]), int(state[-1])

    def _keep(self, t_s: Floats, x_m: Floats) -> None:
        if self._begun is None or not len(t_s):
            return
        near = t_s < self._begun[0] + LOOKED_S
        self._t.append(t_s[near])
        self._x.append(x_m[near])
        if not near.all():
            self._end()

    def _end(self) -> None:
        if self._begun is not None and sum(map(len, self._t)) > 1:
            self._done.append(self._judged(*self._begun, np.concatenate(self._t), np.concatenate(self._x)))
        self._begun = None
        self._t, self._x = [], []

    def _judged(self, begun_s: float, latched: int, t_s: Floats, x_m: Floats) -> Stop:
        n = min(len(t_s) - 1, max(1, round(_SMOOTH_S * self._rate_hz)))
        speed = np.abs(x_m[n:] - x_m[:-n]) / (t_s[n:] - t_s[:-n])
        fast = np.flatnonzero(~(speed <= self._rest_m_s))
        stood = 0 if not len(fast) else int(fast[-1]) + n // 2 + 1
        whole = not len(fast) or int(fast[-1]) < len(speed) - 1
        way = np.abs(x_m - x_m[0])
        return Stop(
            begun_s,
            latched,
            float(speed[0]),
            float(t_s[stood] - begun_s) if whole else NAN,
            float(way[stood]) if whole else NAN,
            float(np.nanmax(way)) if np.isfinite(way).any() else NAN,
        )

    def finish(self) -> list[Stop]:
        """Those of the whole log."""
        self._end()
        return self._done


class Seen(NamedTuple):
    """A fault while it was seen or held the axis."""

    bit: int
    seen_s: float  # first present; NaN where it was latched at once
    latched_s: float  # NaN: it was not
    cleared_s: float  # NaN: not in this log
    stop: Stop | None


def seen(
    present: dict[int, list[Span]], latched: dict[int, list[Span]], stops: list[Stop], end_s: float
) -> list[Seen]:
    """The faults that were latched, in the order of their moments."""
    found = []
    for bit, spans in latched.items():
        for span in spans:
            shown = [s for s in present.get(bit, ()) if s.begin_s <= span.begin_s <= s.end_s]
            stop = next((s for s in stops if s.latched >> bit & 1 and abs(s.t_s - span.begin_s) < 1e-6), None)
            found.append(
                Seen(
                    bit,
                    shown[-1].begin_s if shown else NAN,
                    span.begin_s,
                    span.end_s if span.end_s < end_s else NAN,
                    stop,
                )
            )
    return sorted(found, key=lambda one: one.latched_s)
