"""Profiles to track, made outside the loop: from samples, as a chirp, as steps.

A profile is a list of polynomials of degree seven that meet up to the jerk and end at rest. Positions are in
metres of the stroke coordinate, times in seconds.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pneud.console.protocol import MAX_PIECES
from pneud.control.profile import LONGEST_S, MOST_PIECES, ROUNDING, SHORTEST_S, extent, is_inside, meet
from pneud.control.reference import Bounds, Septic, at, move, rest, septic
from pneud.rt.inputs import open_file, read_whole
from pneud.signals import Reference, Request, RequestKind

PIECES_PER_PERIOD = 8  # a polynomial of degree seven over an eighth of a sine is off by 1e-8 of it
Array = npt.NDArray[np.float64]


class ProfileError(Exception):
    """A profile cannot be had; the text is one line for a person."""


def from_samples(times_s: Sequence[float], positions_m: Sequence[float]) -> list[Septic]:
    """The smoothest motion through samples, at rest before and after: least integral of the snap squared.

    Pieces meet in six derivatives. It swings beyond samples that make corners; `check` tells what it reaches.

    Args:
        times_s: strictly rising, at least two; the profile begins at the first.
        positions_m: as many.

    Raises:
        ProfileError: too few or too many samples, not finite, or times that do not rise.
    """
    if len(times_s) != len(positions_m):
        raise ProfileError(f"{len(times_s)} times but {len(positions_m)} positions")
    if not 2 <= len(times_s) <= MOST_PIECES + 1:
        raise ProfileError(f"{len(times_s)} samples; a profile has 2 to {MOST_PIECES + 1}")
    for i, (t, x) in enumerate(zip(times_s, positions_m, strict=True), start=1):
        if not (math.isfinite(t) and math.isfinite(x)):
            raise ProfileError(f"sample {i} is no finite number: t = {t:g} s, x = {x:g} m")
        if i > 1 and not SHORTEST_S <= t - times_s[i - 2] <= LONGEST_S:
            raise ProfileError(
                f"sample {i}: t = {t:g} s must be {SHORTEST_S:g} to {LONGEST_S:g} s after"
                f" the one before it ({times_s[i - 2]:g} s)"
            )
    T = np.diff(np.asarray(times_s, dtype=float))
    knots = _rates(T, np.asarray(positions_m, dtype=float))
    references = [Reference(x, *map(float, rates)) for x, rates in zip(positions_m, knots, strict=True)]
    return [septic(float(t), a, b) for t, a, b in zip(T, references, references[1:], strict=False)]


def _rates(T: Array, x: Array) -> Array:
    """Velocity, acceleration and jerk at every sample, zero at the ends, so that derivatives 4 to 6 meet.

    One block of three equations for each inner sample, solved by elimination from block to block.
    """
    n = len(x)
    rates = np.zeros((n, 3))
    # derivatives 4 to 6 at the beginning and end of a unit piece, by its eight end values
    unit = np.array([_higher(septic(1.0, Reference(*row[:4]), Reference(*row[4:]))) for row in np.eye(8)]).T
    orders, own = np.arange(4, 7), np.arange(4)

    def blocks(t: float) -> tuple[Array, Array]:
        scaled = unit * np.tile(t**own, 2)
        return scaled[:3] / t ** orders[:, None], scaled[3:] / t ** orders[:, None]

    gains, offsets = [np.zeros((3, 3))], [np.zeros(3)]
    for k in range(1, n - 1):
        (_, left), (right, _) = blocks(T[k - 1]), blocks(T[k])
        # left end = right beginning
        before, here, after = left[:, 1:4], left[:, 5:8] - right[:, 1:4], -right[:, 5:8]
        known = right[:, 0] * x[k] + right[:, 4] * x[k + 1] - left[:, 0] * x[k - 1] - left[:, 4] * x[k]
        pivot = here - before @ gains[-1]
        solved = np.linalg.solve(pivot, np.column_stack((after, known - before @ offsets[-1])))
        gains.append(solved[:, :3])
        offsets.append(solved[:, 3])
    for k in range(n - 2, 0, -1):
        rates[k] = offsets[k] - gains[k] @ rates[k + 1]
    return rates


def _higher(p: Septic) -> list[float]:
    c = p[1:]
    begin = [math.factorial(k) * c[k] for k in (4, 5, 6)]
    end = [sum(math.perm(i, k) * c[i] for i in range(k, 8)) for k in (4, 5, 6)]
    return begin + end


def from_csv(file: str | Path) -> list[Septic]:
    """The profile through the samples of a CSV file.

    Two columns; a first line may name them `t_s` and `x_mm` or `x_m`. Without it: seconds and millimetres.

    Raises:
        ProfileError: the file cannot be read, a line is no pair of numbers, or as in `from_samples`.
    """
    try:
        with io.TextIOWrapper(open_file(Path(file)), encoding="utf-8-sig", newline="") as f:
            rows = [(n, row) for n, row in enumerate(csv.reader(f), start=1) if any(map(str.strip, row))]
    except (OSError, UnicodeDecodeError, csv.Error) as e:
        raise ProfileError(f"{file}: cannot be read: {getattr(e, 'strerror', None) or e}") from None
    scale = 1e-3
    if rows and not _is_number(rows[0][1][0]):
        head = tuple(name.strip() for name in rows.pop(0)[1])
        if head not in (("t_s", "x_mm"), ("t_s", "x_m")):
            raise ProfileError(f"{file}: columns are {', '.join(head)}; expected t_s, x_mm or t_s, x_m")
        scale = 1e-3 if head[1] == "x_mm" else 1.0
    times, positions = [], []
    for n, row in rows:
        if len(row) != 2 or not all(map(_is_number, row)):
            raise ProfileError(f"{file}: line {n} is no pair of numbers: {','.join(row)[:60]}")
        times.append(float(row[0]))
        positions.append(scale * float(row[1]))
    try:
        return from_samples(times, positions)
    except ProfileError as e:
        raise ProfileError(f"{file}: {e}") from None


def from_file(path: Path) -> list[Septic]:
    """The profile of a file: samples of a `.csv`, or pieces of a `.json` as `upload` has them.

    Raises:
        ProfileError: neither, or it cannot be used.
    """
    if path.suffix == ".csv":
        return from_csv(path)
    if path.suffix == ".json":
        return _from_json(path)
    raise ProfileError(f"{path}: neither a profile that pneud makes nor a file that ends in .csv or .json")


def _from_json(path: Path) -> list[Septic]:
    """Pieces: a list of [duration, eight coefficients], seconds and metres."""
    try:
        found = json.loads(read_whole(path))
        return [Septic._make(map(float, piece)) for piece in found]
    except OSError as e:
        raise ProfileError(f"{path}: cannot be read: {e.strerror}") from None
    except (ValueError, TypeError, OverflowError, RecursionError) as e:
        raise ProfileError(f"{path}: is no list of pieces [T, c0 … c7]: {e}") from None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def chirp(
    centre_m: float, amplitude_m: float, from_hz: float, to_hz: float, duration_s: float
) -> list[Septic]:
    """A sine whose frequency changes linearly; it swells from rest and fades to it within a period.

    Raises:
        ProfileError: not positive, not finite, too short, or too long for a profile.
    """
    given = {"amplitude": amplitude_m, "frequency": min(from_hz, to_hz), "duration": duration_s}
    for name, value in given.items():
        if not 0.0 < value < math.inf:
            raise ProfileError(f"{name} = {value:g} must be positive")
    if not math.isfinite(centre_m + from_hz + to_hz):
        raise ProfileError("centre and frequencies must be finite")
    if duration_s < 1.0 / from_hz + 1.0 / to_hz:
        raise ProfileError(f"a chirp of {duration_s:g} s is too short for a period of both frequencies")
    count = math.ceil(duration_s * max(from_hz, to_hz) * PIECES_PER_PERIOD)
    if count > MOST_PIECES:
        raise ProfileError(f"a chirp of {count} pieces is too long; a profile has at most {MOST_PIECES}")
    growth = 2.0 * math.pi * (to_hz - from_hz) / duration_s
    swell = septic(1.0 / from_hz, rest(0.0), rest(amplitude_m))
    fade = septic(1.0 / to_hz, rest(amplitude_m), rest(0.0))

    def reference(t: float) -> Reference:
        angle = t * (2.0 * math.pi * from_hz + 0.5 * growth * t)
        rate = 2.0 * math.pi * from_hz + growth * t
        s, c = math.sin(angle), math.cos(angle)
        s1, s2 = c * rate, c * growth - s * rate * rate
        s3 = -3.0 * s * rate * growth - c * rate**3
        e, e1, e2, e3 = at(t, swell) if t < swell.T else at(t - duration_s + fade.T, fade)
        return Reference(
            centre_m + e * s,
            e1 * s + e * s1,
            e2 * s + 2.0 * e1 * s1 + e * s2,
            e3 * s + 3.0 * (e2 * s1 + e1 * s2) + e * s3,
        )

    step = duration_s / count
    knots = [reference(i * step) for i in range(count + 1)]
    return [septic(step, a, b) for a, b in pairwise(knots)]


def steps(positions_m: Sequence[float], dwell_s: float, bounds: Bounds) -> list[Septic]:
    """From each position to the next, as fast as the bounds allow, with a rest at each.

    Raises:
        ProfileError: fewer than two positions, or the rest is too short.
    """
    if len(positions_m) < 2:
        raise ProfileError("steps need at least two positions")
    if not SHORTEST_S <= dwell_s <= LONGEST_S:
        raise ProfileError(f"a rest of {dwell_s:g} s must be {SHORTEST_S:g} to {LONGEST_S:g} s")
    if not all(map(math.isfinite, positions_m)):
        raise ProfileError("positions must be finite")
    pieces = [septic(dwell_s, rest(positions_m[0]), rest(positions_m[0]))]
    for a, b in pairwise(positions_m):
        # a cruise too short for a piece moves nothing
        kept = [p for p in move(rest(a), b, bounds).pieces if p.T >= SHORTEST_S]
        pieces += [*kept, septic(dwell_s, rest(b), rest(b))]
    return pieces


def check(pieces: Sequence[Septic], bounds: Bounds, low_m: float, high_m: float) -> None:
    """See whether the axis will take a profile, as it looks at it itself.

    Raises:
        ProfileError: where and what it exceeds, in one line.
    """
    if not 1 <= len(pieces) <= MOST_PIECES:
        raise ProfileError(f"{len(pieces)} pieces; a profile has 1 to {MOST_PIECES}")
    t = 0.0
    for before, piece in zip((None, *pieces), pieces, strict=False):
        if before is not None and not meet(before, piece):
            raise ProfileError(f"at {t:g} s: position, velocity, acceleration or jerk jumps")
        e = extent(piece)
        for name, value, bound, unit in (
            ("speed", e.speed_m_s, bounds.speed_m_s, "m/s"),
            ("acceleration", e.acceleration_m_s2, bounds.acceleration_m_s2, "m/s²"),
            ("jerk", e.jerk_m_s3, bounds.jerk_m_s3, "m/s³"),
        ):
            if not value <= ROUNDING * bound:
                raise ProfileError(
                    f"from {t:g} to {t + piece.T:g} s: {name} of {value:.4g} {unit},"
                    f" limits.motion allows {bound:g} {unit}"
                )
        if not is_inside(e, low_m, high_m):
            raise ProfileError(
                f"from {t:g} to {t + piece.T:g} s: {1e3 * e.low_m:.4g} … {1e3 * e.high_m:.4g} mm,"
                f" the travel allows {1e3 * low_m:g} … {1e3 * high_m:g} mm"
            )
        t += piece.T


def bounds_in(limits: Mapping[str, float]) -> Bounds:
    """The bounds of speed, acceleration and jerk in the limits that a daemon's status tells."""
    return Bounds(*(limits[key] * 1e-3 for key in ("speed_mm_s", "acceleration_mm_s2", "jerk_mm_s3")))


def uploads(pieces: Sequence[Septic]) -> Iterator[dict[str, Any]]:
    """The fields of the requests that take a profile to a daemon."""
    for begin in range(0, len(pieces), MAX_PIECES):
        end = begin + MAX_PIECES
        some = [list(piece) for piece in pieces[begin:end]]
        yield {"first": begin == 0, "last": end >= len(pieces), "pieces": some}


def requests(pieces: Iterable[Septic]) -> Iterator[Request]:
    """What to ask of the axis, one a tick: empty the profile, upload this one, track it."""
    yield Request(int(RequestKind.PIECE))
    for piece in pieces:
        yield Request(int(RequestKind.PIECE), tuple(piece))
    yield Request(int(RequestKind.TRACK), (1.0,))


def duration_s(pieces: Iterable[Septic]) -> float:
    """How long a profile takes [s]."""
    return sum(piece.T for piece in pieces)


def end_m(pieces: Sequence[Septic]) -> float:
    """Where a profile ends [m]."""
    return at(pieces[-1].T, pieces[-1]).position_m
