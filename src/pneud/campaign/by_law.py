"""A run of law and plant alone, compiled as one function: no frames, no checks, and so many times as fast."""

from __future__ import annotations

import math

from pneud.axis.state import AxisParameters
from pneud.axis.stops import soft_limits
from pneud.campaign.parts import MovePart, Parts, PushPart, RestPart, SinePart, finite
from pneud.control.reference import move, rest, sine, still, transfer, unhurried
from pneud.physics.plant import PlantParameters
from pneud.physics.ratings import DENSITY_ANR_KG_M3
from pneud.signals import Reference
from pneud.study.going import Going
from pneud.study.trial import Verdict


class RunError(Exception):
    """A run cannot be done, or has come to nothing; one line for a person."""

    exit_code = 1


def play(
    axis: AxisParameters, plant: PlantParameters, parts: Parts, tolerance_m: float, seed: int
) -> dict[str, float | None]:
    """The figures of all parts.

    Args:
        axis: controller, reference and limits.
        plant: the plant; the load begins where it says.
        parts: what is done.
        tolerance_m: error that counts as in position.
        seed: of the sensors' noise.

    Raises:
        RunError: a move leads out of the travel, or the loop has run away.
    """
    run = _Run(axis, plant, tolerance_m, seed)
    found: dict[str, float | None] = {}
    for part in parts:
        match part:
            case SinePart():
                figures = run.sine(part)
            case RestPart():
                figures = run.rest(part)
            case MovePart():
                figures = run.move(part)
            case PushPart():
                figures = run.push(part)
        if figures["rms_m"] is None:
            raise RunError(f"{part.name}: the loop has run away")
        found |= {f"{part.name}_{figure}": value for figure, value in figures.items()}
    return found


def aim_m(part: MovePart, stands_m: float, axis: AxisParameters) -> float:
    """Where a move leads [m].

    Raises:
        RunError: it is not where an axis may be asked to go.
    """
    to_m = 1e-3 * part.to_mm if part.to_mm is not None else stands_m + 1e-3 * (part.by_mm or 0.0)
    low_m, high_m = soft_limits(axis)
    if not low_m <= to_m <= high_m:
        raise RunError(
            f"{part.name}: leads to {1e3 * to_m:g} mm; may be {1e3 * low_m:g} … {1e3 * high_m:g} mm"
        )
    return to_m


class _Run:
    """A run that goes on from part to part."""

    def __init__(self, axis: AxisParameters, plant: PlantParameters, tolerance_m: float, seed: int) -> None:
        self._axis, self._h = axis, axis.controller.h
        self._at_m = plant.initial_x1 - plant.cylinder.x_e1
        self._going = Going(self._at_m, axis.controller, plant, tolerance_m, seed)
        self._sine_s: float | None = None  # how far along the sine it is, where it is on one

    @property
    def _now(self) -> Reference:
        s = self._axis.reference
        return rest(self._at_m) if self._sine_s is None else sine(self._sine_s, s)

    def sine(self, part: SinePart) -> dict[str, float | None]:
        s = self._axis.reference
        way = transfer(self._now, sine(0.0, s), self._axis.transfer)
        v = self._going.go(way, part.seconds, part.learn_s, s)
        self._sine_s = part.seconds
        return self._figures(part.seconds - part.learn_s, v)

    def rest(self, part: RestPart) -> dict[str, float | None]:
        way = still(self._at_m)
        if self._sine_s is not None:
            self._at_m = self._axis.reference.centre_m
            way = move(self._now, self._at_m, self._axis.motion)
        v = self._going.go(way, part.seconds, part.settle_s)
        self._sine_s = None
        return self._figures(part.seconds - part.settle_s, v)

    def move(self, part: MovePart) -> dict[str, float | None]:
        axis, now = self._axis, self._now
        from_m = axis.reference.centre_m if self._sine_s is not None else self._at_m
        to_m = aim_m(part, from_m, axis)
        bounds = axis.motion
        if self._sine_s is None:
            bounds = unhurried(bounds, abs(to_m - from_m), axis.shunned)
        way = move(now, to_m, bounds)
        v = self._going.go(way, part.seconds)
        beyond_m = v.high_m - to_m if to_m > now.position_m else to_m - v.low_m
        self._at_m, self._sine_s = to_m, None
        over = {"settled_s": self._settled_s(v), "overshoot_m": finite(max(0.0, beyond_m))}
        return self._figures(way.T + part.seconds, v) | over

    def push(self, part: PushPart) -> dict[str, float | None]:
        way = still(self._at_m)
        on = self._going.go(way, part.seconds, force_n=part.force_n)
        off = self._going.go(way, part.back_s)
        longest: tuple[float | None, ...] = (self._settled_s(on), self._settled_s(off))
        found = self._figures(part.seconds, on), self._figures(part.back_s, off)
        settled = None if None in longest else max(x for x in longest if x is not None)
        return _both(*found, part.seconds, part.back_s) | {"settled_s": settled}

    def _settled_s(self, v: Verdict) -> float | None:
        return v.outside * self._h if v.outside >= 0 else None

    def _figures(self, judged_s: float, v: Verdict) -> dict[str, float | None]:
        return {
            "rms_m": finite(v.rms_m),
            "max_m": finite(v.max_m),
            "chatter_v": finite(v.step_v),
            "saturated": v.saturated / max(1, round(judged_s / self._h)),
            "air_nl": finite(1e3 * v.air_kg / DENSITY_ANR_KG_M3),
        }


def _both(
    one: dict[str, float | None], other: dict[str, float | None], one_s: float, other_s: float
) -> dict[str, float | None]:
    """The figures of two spans together; None where one of them has none."""
    if None in (*one.values(), *other.values()):
        return dict.fromkeys(one)
    whole_s = one_s + other_s

    def mean(name: str) -> float:
        return ((one[name] or 0.0) * one_s + (other[name] or 0.0) * other_s) / whole_s

    squares = ((one["rms_m"] or 0.0) ** 2 * one_s + (other["rms_m"] or 0.0) ** 2 * other_s) / whole_s
    return {
        "rms_m": math.sqrt(squares),
        "max_m": max(one["max_m"] or 0.0, other["max_m"] or 0.0),
        "chatter_v": mean("chatter_v"),
        "saturated": mean("saturated"),
        "air_nl": (one["air_nl"] or 0.0) + (other["air_nl"] or 0.0),
    }
