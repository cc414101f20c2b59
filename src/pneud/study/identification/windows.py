"""Pieces of a log of equal length, those that tell most, smoothed where they are an input."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from pneud.config.conversions import valve_of
from pneud.config.models import Config
from pneud.physics.valve import spool_transition
from pneud.study.identification import heat
from pneud.study.identification.chambers import PLAYS_V, WARM_S, Windows
from pneud.study.identification.table import Piece, Table

Floats = NDArray[np.float64]
WINDOW_S = 0.4
MOST = 80  # windows
ENDS = 1e-3  # of the stroke, where a load bounces
BEFORE_S = 4.0  # a window, that tells how warm the air is
POSITION_S, START_S, SUPPLY_S = 0.002, 0.0015, 0.02  # widths of smoothing (standard deviations)


class Smooth(NamedTuple):
    """A piece with its inputs smoothed."""

    piece: Piece
    x_m: Floats
    p1_pa: Floats
    p2_pa: Floats
    supply_pa: Floats


def smoothed(values: Floats, width: float) -> Floats:
    """Without delay, by a bell of `width` samples; by none, where that is 0."""
    if not width:
        return values
    found: Floats = gaussian_filter1d(values, width, mode="nearest", truncate=4.0, axis=-1)
    return found


def chamber_windows(t: Table, c: Config, dead_m: tuple[float, float], most: int = MOST) -> Windows:
    """Windows for the chambers; each begins with some ticks in which the spool finds its place.

    Args:
        t: the table.
        c: what is configured.
        dead_m: dead lengths, as far as they are known: for the warmth of the air.
        most: windows.
    """
    warm, ticks = max(2, round(WARM_S / t.h)), max(20, round(WINDOW_S / t.h))
    found = []
    for piece in t.pieces:
        s = Smooth(
            piece,
            smoothed(piece.position_m, POSITION_S / t.h),
            smoothed(piece.p1_pa, START_S / t.h),
            smoothed(piece.p2_pa, START_S / t.h),
            smoothed(piece.supply_pa, SUPPLY_S / t.h),
        )
        found += [(s, begin) for begin in range(0, len(s.x_m) - warm - ticks - 1, ticks)]
    ends = (ENDS * c.cylinder.stroke_m, (1.0 - ENDS) * c.cylinder.stroke_m)
    found = [
        (s, begin) for s, begin in found if _is_calm(s.x_m[begin + warm : begin + warm + ticks], *ends)
    ] or found
    kept = chosen([_told(s, begin + warm, ticks) for s, begin in found], most)

    def cut(name: str, smooth: bool) -> Floats:
        each = ((s if smooth else s.piece, begin) for s, begin in (found[i] for i in kept))
        return np.array([getattr(of, name)[begin : begin + warm + ticks + 1] for of, begin in each])

    starts = [(s, begin + warm) for s, begin in (found[i] for i in kept)]
    return Windows(
        x_m=cut("x_m", True),
        p1_pa=cut("p1_pa", False)[:, warm + 1 :],
        p2_pa=cut("p2_pa", False)[:, warm + 1 :],
        p1_start_pa=np.array([s.p1_pa[at] for s, at in starts]),
        p2_start_pa=np.array([s.p2_pa[at] for s, at in starts]),
        supply_pa=cut("supply_pa", True),
        applied_v=cut("applied_v", False),
        behind=_behind([(s, begin) for s, begin in (found[i] for i in kept)], t.h, c),
        warmth=_warmth(starts, ticks, t.h, c, dead_m),
        warm=warm,
    )


def _stretches(values: list[Floats], ends: list[int], ticks: int) -> Floats:
    """The ticks before an end, of each; as at the beginning where there are fewer."""
    found = []
    for of, end in zip(values, ends, strict=True):
        begin = max(0, end - ticks)
        found.append(np.pad(of[begin:end], (ticks - end + begin, 0), mode="edge"))
    return np.array(found)


def _warmth(
    starts: list[tuple[Smooth, int]], ticks: int, h: float, c: Config, dead_m: tuple[float, float]
) -> Floats:
    """Of the air in both chambers, for several rates of the wall, by what was before."""
    stroke_m, ends = c.cylinder.stroke_m, [at + ticks for _, at in starts]
    p1, p2, x = (
        _stretches([getattr(s, name) for s, _ in starts], ends, ticks + round(BEFORE_S / h))
        for name in ("p1_pa", "p2_pa", "x_m")
    )
    inside = np.clip(x, 0.0, stroke_m)
    lengths = np.array([inside + dead_m[0], stroke_m - inside + dead_m[1]])
    return heat.warmth(np.array([p1, p2]), lengths, c.gas.heat_capacity_ratio, h, ticks)


def _behind(starts: list[tuple[Smooth, int]], h: float, c: Config) -> Floats:
    """Where in their play the edges have been left by the commands before: (window, play), −1 to 1.

    A spool goes beyond a command that comes at once, so that its way counts.
    """
    u = _stretches([s.piece.applied_v for s, _ in starts], [at + 1 for _, at in starts], round(BEFORE_S / h))
    half = spool_transition(0.5 * h, valve_of(c))
    e, rate = np.zeros(len(u)), np.zeros(len(u))
    felt = np.repeat(u[:, :1], len(PLAYS_V), axis=1)
    for k in range(1, u.shape[1]):
        e = e + u[:, k - 1] - u[:, k]
        for _ in range(2):
            e, rate = half.ee * e + half.er * rate, half.re * e + half.rr * rate
            at = (u[:, k] + e)[:, None]
            felt = np.clip(felt, at - PLAYS_V, at + PLAYS_V)
    found: Floats = np.clip((felt - u[:, -1:]) / PLAYS_V, -1.0, 1.0)
    return found


def _is_calm(x_m: Floats, low_m: float, high_m: float) -> bool:
    """Whether a load moves between the ends, or stands at one of them."""
    least_m, most_m = float(x_m.min()), float(x_m.max())
    return (low_m < least_m and most_m < high_m) or most_m < low_m or least_m > high_m


def _told(s: Smooth, at: int, ticks: int) -> float:
    """How much happens in a window: span of the pressures and, as one compresses them, of the position."""
    span = slice(at, at + ticks, 8)
    return float(np.ptp(s.p1_pa[span]) + np.ptp(s.p2_pa[span]) + 1e6 * np.ptp(s.x_m[span]))


def chosen(told: list[float], most: int) -> list[int]:
    """Which windows: all; or half of them those that tell most, the others evenly from the rest."""
    if len(told) <= most:
        return list(range(len(told)))
    order = np.argsort(told)[::-1]
    best, rest = order[: most // 2], np.sort(order[most // 2 :])
    others = rest[np.linspace(0, len(rest) - 1, most - most // 2).astype(int)]
    return sorted({*best.tolist(), *others.tolist()})
