"""The valve's edges from slow openings alone, before anything else is known of a rig.

What flows into both chambers, by their pressures, grows with the opening beyond an edge, and some leaks
through edges that are shut. Flow and volumes, which are not known yet, are but the scale of both.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pneud.config.conversions import valve_of
from pneud.config.flow import area_of, gas_of
from pneud.config.models import Config
from pneud.study.identification import chambers
from pneud.study.identification import parameters as key
from pneud.study.identification.explaining import through
from pneud.study.identification.parameters import Estimate
from pneud.study.identification.table import Piece, Table
from pneud.study.identification.windows import smoothed

Floats = NDArray[np.float64]
EXPONENT = 1.2  # of air that keeps some of its heat
SMOOTHED_S, RATE_S = 0.003, 0.006  # width; rates are taken over
FASTEST_V_S = 1.0  # of a command that is slow
BIN_V, FEWEST = 0.005, 3  # of the command; of which an edge has so many on its far side
WIDEST_V = 1.0  # where no edge lies further from 0 V
LIKELY = 2.0  # times the least squares for a point still to be as good


class Flows(NamedTuple):
    """What flows into both chambers and what could, relative to a valve that is open: (chamber, tick)."""

    applied_v: Floats
    into: Floats
    fills: Floats  # from the supply
    empties: Floats  # to the atmosphere, negative


def edges(t: Table, c: Config) -> dict[str, Estimate]:
    """Half of the dead zone and its centre [V], with generous intervals; nothing where no edge is passed."""
    pieces = [_flows(p, t.h, c) for p in t.pieces if len(p.position_m) * t.h > 10.0 * RATE_S]
    if not pieces:
        return {}
    w = Flows._make(np.concatenate(parts, axis=-1) for parts in zip(*pieces, strict=True))
    place = np.round(w.applied_v / BIN_V).astype(int)
    bins, which, counts = np.unique(place, return_inverse=True, return_counts=True)
    if len(bins) < 2 * FEWEST:
        return {}
    grid = BIN_V * np.arange(bins[FEWEST - 1], bins[-FEWEST] + 1)
    squares = _squares(w, grid, 1.0 / np.sqrt(counts[which]))
    if not np.isfinite(squares).any():
        return {}
    minus, plus = np.unravel_index(np.argmin(squares), squares.shape)
    good_minus, good_plus = np.nonzero(squares <= LIKELY * squares[minus, plus])
    config = key.configured(c)

    def told(name: str, of_minus: float, of_plus: float) -> Estimate:
        value = of_minus * grid[minus] + of_plus * grid[plus]
        values = of_minus * grid[good_minus] + of_plus * grid[good_plus]
        low, high = float(values.min()) - BIN_V, float(values.max()) + BIN_V
        return Estimate(float(value), low, high, config.get(name), True)

    return {key.HALF: told(key.HALF, -0.5, 0.5), key.CENTRE: told(key.CENTRE, 0.5, 0.5)}


def _squares(w: Flows, grid: Floats, weight: Floats) -> Floats:
    """What is left of the flows for each pair of edges, (minus, plus); infinite where none can be so."""
    beyond_v = w.applied_v - grid[:, None]

    def columns(opening: Floats, one: Floats, two: Floats) -> Floats:
        return np.concatenate([weight * opening * one, weight * opening * two], axis=-1)

    plus = columns(np.maximum(beyond_v, 0.0), w.fills[0], w.empties[1])
    minus = columns(np.maximum(-beyond_v, 0.0), w.empties[0], w.fills[1])
    whole = np.ones((1, len(w.applied_v)))
    leaks = np.concatenate([columns(whole, *w.fills), columns(whole, *w.empties)])
    into = columns(whole, *w.into)[0]
    count = len(grid)
    square = np.empty((count, count, 4, 4))
    square[..., 0, 0], square[..., 1, 1] = (minus**2).sum(axis=1)[:, None], (plus**2).sum(axis=1)
    square[..., 0, 1] = square[..., 1, 0] = minus @ plus.T
    square[..., 0, 2:] = square[..., 2:, 0] = (minus @ leaks.T)[:, None]
    square[..., 1, 2:] = square[..., 2:, 1] = plus @ leaks.T
    square[..., 2:, 2:] = leaks @ leaks.T
    along = np.empty((count, count, 4))
    along[..., 0], along[..., 1], along[..., 2:] = (minus @ into)[:, None], plus @ into, leaks @ into
    few = 1e-9 * np.trace(square, axis1=-2, axis2=-1)[..., None, None] * np.eye(4)
    slopes = np.linalg.solve(square + few, along[..., None])[..., 0]
    left = into @ into - (slopes * along).sum(axis=-1)
    possible = (slopes[..., 0] > 0.0) & (slopes[..., 1] > 0.0) & (grid[:, None] <= grid)
    return np.where(possible, left, np.inf)


def _flows(p: Piece, h: float, c: Config) -> Flows:
    """Where the command changes slowly."""
    k, gas, v = c.cylinder, gas_of(c), valve_of(c)
    width, rate = SMOOTHED_S / h, max(1, round(RATE_S / h))
    late = 0 if v.omega_rad_s == 0.0 else round(2.0 * v.zeta / v.omega_rad_s / h)
    inner = slice(rate, len(p.position_m) - rate)
    u = np.concatenate([np.full(late, p.applied_v[0]), p.applied_v])[: len(p.applied_v)]
    slow = (np.abs(_rate(u, rate, h)) < FASTEST_V_S) & (np.abs(u[inner]) < WIDEST_V)
    x = smoothed(np.clip(p.position_m, 0.0, k.stroke_m), width)
    share, supply = chambers.orifice(gas), p.supply_pa[inner]
    scale = 1.0 / (key.flow_of_area(area_of(c), gas) * gas.supply_pa)
    into, fills, empties = [], [], []
    for pressure, area, length in (
        (p.p1_pa, k.piston_area_1_m2, x + k.dead_length_1_m),
        (p.p2_pa, k.piston_area_2_m2, k.stroke_m - x + k.dead_length_2_m),
    ):
        pa = smoothed(pressure, width)
        here = pa[inner]
        flow = area * (_rate(pa, rate, h) * length[inner] / EXPONENT + here * _rate(length, rate, h))
        into.append(scale * flow)
        fills.append(through(here, supply, share) / gas.supply_pa)
        empties.append(through(here, np.asarray(gas.atmosphere_pa), share) / gas.supply_pa)
    return Flows(u[inner][slow], *(np.array(rows)[:, slow] for rows in (into, fills, empties)))


def _rate(values: Floats, width: int, h: float) -> Floats:
    found: Floats = (values[2 * width :] - values[: -2 * width]) / (2.0 * width * h)
    return found
