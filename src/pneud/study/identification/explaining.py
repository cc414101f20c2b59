"""Whether the model can explain the rig: what is left of pressures and forces, and where it is left."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from pneud.config.flow import gas_of
from pneud.config.models import Config
from pneud.study.identification import chambers, heat
from pneud.study.identification.estimating import Moved, Valved

Floats = NDArray[np.float64]
NOISES = 4.0  # times the sensors' noise, and
SUPPLY_SHARE = (
    1e-3  # this share of the supply: RMS of pressures that is left, at most, where all is explained
)
FORCE_SHARE = 0.06  # of Coulomb friction: RMS of forces
STEP_SHARE, MOST_BY_STEP = (
    0.3,
    0.15,
)  # standard deviation of a step; share of Coulomb friction that it explains
SURE = 4.0  # standard deviations of a mean
BENT, ROUGH = 0.05, 0.1  # deviation of a flow, and of a friction in shares of Coulomb's, that is worth a word
NEAR_V = 0.01  # of command, which an edge may lie elsewhere by: more than all else where it has just opened
BY_PRESSURE = 0.015  # share of Coulomb friction that a bar more adds, worth a word
FEWEST = 4  # windows in a bin
SLIDES_M_S, LEAST_SLIDING, LEAST_BAR = (
    0.02,
    50,
    0.1,
)  # ticks of a window, and spread of the pressures, for that
RATE_S, STEADY_S, STEADY = 0.003, 0.012, 0.2  # rates are taken over; the valve has not moved before by more


class Bin(NamedTuple):
    """A point of a map: where, what was measured and what the model has, how sure."""

    at: float
    measured: float
    model: float
    deviation: float  # of the measured mean


def unexplained(valved: Valved | None, moved: Moved | None, noise_pa: float, c: Config) -> list[str]:
    """What the model cannot explain, in words; none where it explains all."""
    found = []
    if valved is not None:
        least = max(NOISES * noise_pa, SUPPLY_SHARE * c.gas.supply_pa)
        if valved.misfit_pa > least:
            found.append(
                f"pressures: {1e-3 * valved.misfit_pa:.2f} kPa RMS are left after a window of"
                f" {valved.seconds:.1f} s, noise explains {1e-3 * noise_pa:.2f} kPa"
            )
        found += bent(flow_map(valved, c), NEAR_V / valved.rig.u_max_v)
    if moved is not None:
        coulomb = max(float(moved.fit.x[2]), 1e-9)
        if moved.misfit_n > _explained_n(moved, coulomb, noise_pa, c):
            found.append(
                f"forces: {moved.misfit_n:.2g} N RMS are left, of {coulomb:.3g} N of Coulomb friction"
            )
        found += _rough(friction_map(moved), coulomb)
        found += _by_pressure(moved, coulomb)
    return found


def _explained_n(moved: Moved, coulomb_n: float, noise_pa: float, c: Config) -> float:
    """RMS of forces that may be left: by the model, the sensors, an encoder's step that bends bristles."""
    stiffness = float(moved.fit.x[moved.fit.keys.index("stiffness")])
    by_step = min(STEP_SHARE * stiffness * moved.step_m, MOST_BY_STEP * coulomb_n)
    return math.hypot(max(FORCE_SHARE * coulomb_n, noise_pa * c.cylinder.piston_area_1_m2), by_step)


def bent(bins: Sequence[Bin], near: float) -> list[str]:
    """Where the flow is another one than a straight line has it, in words.

    Args:
        bins: from `flow_map`.
        near: relative opening that does not count.
    """
    off = [
        (abs(b.measured / b.model - 1.0), b)
        for b in bins
        if abs(b.measured - b.model) > max(SURE * b.deviation, BENT * abs(b.model), near)
    ]
    if not off:
        return []
    share, b = max(off)
    more = "more" if b.measured / b.model > 1.0 else "less"
    return [f"flow map: at {b.at:+.2f} V the flow is {100 * share:.0f} % {more} than a straight line has it"]


def _rough(bins: list[Bin], coulomb_n: float) -> list[str]:
    off = [
        (abs(b.measured - b.model) / coulomb_n, b)
        for b in bins
        if abs(b.measured - b.model) > max(SURE * b.deviation, ROUGH * coulomb_n)
    ]
    if not off:
        return []
    _, b = max(off)
    return [f"friction map: {b.measured:.3g} N at {b.at:+.3g} m/s, the model has {b.model:.3g} N"]


def _by_pressure(moved: Moved, coulomb_n: float) -> list[str]:
    """Whether friction grows with the pressure in the chambers."""
    w = moved.windows
    v = w.sliding_m_s
    slides = np.abs(v) > SLIDES_M_S
    rows = [i for i in range(len(v)) if slides[i].sum() > LEAST_SLIDING]
    if len(rows) < 2 * FEWEST:
        return []
    bar = np.array([1e-5 * w.mean_pa[i][slides[i]].mean() for i in rows])
    more = np.array([(np.sign(v[i]) * moved.left_n[i])[slides[i]].mean() for i in rows])
    spread = bar - bar.mean()
    square = float((spread**2).sum())
    if square < len(rows) * LEAST_BAR**2:
        return []
    slope = float((spread * more).sum() / square)
    sure = float(np.std(more - more.mean() - slope * spread)) / math.sqrt(square)
    if abs(slope) < max(SURE * sure, BY_PRESSURE * coulomb_n):
        return []
    return [f"friction: {slope / coulomb_n:+.1%} of Coulomb's for each bar in the chambers"]


def friction_map(moved: Moved) -> list[Bin]:
    """Friction over speed, both ways, by what the force has beyond mass and load."""
    w = moved.windows
    v = w.sliding_m_s
    mass, load = float(moved.fit.x[0]), float(moved.fit.x[1])
    measured = w.force_n - mass * w.a_m_s2 - load
    return _binned(v, measured, measured - moved.left_n, _spans(2e-3, float(np.abs(v).max(initial=0.0)), 8))


def flow_map(valved: Valved, c: Config, spans: Sequence[tuple[float, float]] = ()) -> list[Bin]:
    """Relative opening over the spool's position, by the rates of the pressures where it stands still.

    Args:
        valved: the fit.
        c: the configuration.
        spans: of the spool [V], from one point to the next; by default up to its end.
    """
    w, g, rig, gas = valved.windows, valved.guess, valved.rig, gas_of(c)
    width = max(1, round(RATE_S / rig.h))
    inner = slice(width, w.p1_pa.shape[1] - width)
    y = chambers.spool(w, g, rig)
    still = _moved(y, max(width, round(STEADY_S / rig.h)))[:, inner] < STEADY * np.abs(y[:, inner])
    y, x = y[:, inner], w.x_m[:, w.warm + 1 :]
    iso, orifice = valved.structure.iso, chambers.orifice(gas)
    inwards = chambers.iso6358(g.critical) if iso else orifice
    outwards = chambers.iso6358(g.critical_out) if iso else orifice
    supply = w.supply_pa[:, w.warm + 1 :][:, inner]
    warmth = heat.at(w.warmth, np.array([g.wall_1_s]))[0][:, :, inner]
    sums, weights = np.zeros_like(y), np.zeros_like(y)
    for p, area, length, sign, warm in (
        (w.p1_pa, rig.area1_m2, x + g.dead1_m, 1.0, warmth[0]),
        (w.p2_pa, rig.area2_m2, rig.stroke_m + g.dead2_m - x, -1.0, warmth[1]),
    ):
        here = p[:, inner]
        cooled = -np.expm1(-warm) * g.wall_1_s * here
        flows = area * (
            (_rate(p, width, rig.h) + cooled) * length[:, inner] / g.exponent
            + here * _rate(length, width, rig.h)
        )
        came = g.flow * through(here, supply, inwards)
        left = g.flow * g.exhaust * through(here, np.asarray(gas.atmosphere_pa), outwards)
        most = np.where(sign * y > 0.0, came, left)
        flows = flows - g.seep * came - g.seep_out * left
        sums += flows * most  # the opening by least squares over both chambers
        weights += most * most
    good = still & (weights > 0.1 * weights.max(initial=0.0))
    opening = np.where(good, np.sign(y) * sums / np.where(good, weights, 1.0), math.nan)
    return _binned(y, opening, chambers.openings(y, g, rig.u_max_v), spans or _spans(0.3, rig.u_max_v, 8))


def through(here: Floats, other: Floats, share: chambers.Share) -> Floats:
    """Flow into a chamber through an edge that is open to the end, relative to its size [Pa]."""
    high = np.maximum(here, other)
    found: Floats = np.copysign(high * share(np.minimum(here, other) / high)[0], other - here)
    return found


def _rate(values: Floats, width: int, h: float) -> Floats:
    found: Floats = (values[:, 2 * width :] - values[:, : -2 * width]) / (2.0 * width * h)
    return found


def _moved(y: Floats, width: int) -> Floats:
    """How far the spool has moved within `width` ticks either way."""
    found: Floats = maximum_filter1d(y, 2 * width + 1, axis=1) - minimum_filter1d(y, 2 * width + 1, axis=1)
    return found


def _spans(least: float, most: float, count: int) -> list[tuple[float, float]]:
    """Bins on either side of zero, each wider than the one before."""
    edges = np.geomspace(least, max(most, 2.0 * least), count + 1).tolist()
    return [(-b, -a) for a, b in pairwise(edges)][::-1] + list(pairwise(edges))


def _binned(at: Floats, measured: Floats, model: Floats, spans: Sequence[tuple[float, float]]) -> list[Bin]:
    found = []
    for low, high in spans:
        inside = (at >= low) & (at < high) & np.isfinite(measured)
        rows = [i for i in range(len(at)) if inside[i].sum() >= 10]
        if len(rows) < FEWEST:
            continue
        means = np.array([(measured[i][inside[i]] - model[i][inside[i]]).mean() for i in rows])
        rows_at = at[inside]
        expected = float(model[inside].mean())
        off = float(means.mean())
        deviation = float(means.std(ddof=1) / math.sqrt(len(rows)))
        found.append(Bin(float(rows_at.mean()), expected + off, expected, deviation))
    return found
