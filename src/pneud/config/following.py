"""Axes of which one is led by another: whether their configurations allow it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from pneud.config.models import Config, FollowConfig

ROUNDING = 1.0 + 1e-9


def why_not_led(configs: Sequence[Config]) -> str:
    """Why an axis cannot be led as it says, in one line; empty where all can.

    What leads by its reference may not lead anybody beyond limits of his own.
    """
    by_name = {config.name: config for config in configs}
    gantries: set[str] = set()
    for config in configs:
        follow = config.reference.follow
        if follow is None or follow.leads:
            continue
        where = f"axis {config.name}: reference.follow"
        leader = by_name.get(follow.axis)
        if follow.axis == config.name or leader is None:
            others = ", ".join(name for name in by_name if name != config.name) or "none"
            return f"{where}.axis = {follow.axis!r} is no other axis of this daemon; there is {others}"
        led = leader.reference.follow
        if led is not None and not led.leads:
            return f"{where}.axis = {follow.axis!r} follows {led.axis} itself; follow that one"
        if follow.skew_m is not None:
            if leader.name in gantries:
                return f"{where}: {leader.name} is in a gantry with another axis already"
            gantries.add(leader.name)
        for why in _beyond(config, leader, follow):
            return f"{where}: {why}"
    return ""


def _beyond(config: Config, leader: Config, follow: FollowConfig) -> Iterator[str]:
    """Which of an axis's limits what leads it by its reference could exceed."""
    if follow.of == "position":
        return
    limits = config.limits
    ends = sorted(follow.offset_m + follow.scale * end for end in _travel(leader))
    low, high = (
        max(config.limits.travel_min_m, 0.0),
        min(config.limits.travel_max_m, config.cylinder.stroke_m),
    )
    if ends[0] < low / ROUNDING - 1e-9 or ends[1] > high * ROUNDING + 1e-9:
        yield (
            f"{leader.name}'s travel leads to {1e3 * ends[0]:g} … {1e3 * ends[1]:g} mm, beyond the own"
            f" {1e3 * low:g} … {1e3 * high:g} mm; narrow limits.travel of {leader.name}"
        )
    most, own = leader.limits, limits.motion
    peak_m_s = 2.0 * math.pi * leader.reference.frequency_hz * leader.reference.amplitude_m
    for key, tracked in (("speed_m_s", peak_m_s), ("acceleration_m_s2", 0.0), ("jerk_m_s3", 0.0)):
        fastest = max(getattr(most.motion, key), getattr(most.transfer, key), tracked)
        if abs(follow.scale) * fastest > getattr(own, key) * ROUNDING:
            yield (
                f"{leader.name} leads with {abs(follow.scale) * fastest:g} of {key}, above the own"
                f" limits.motion.{key} = {getattr(own, key):g}; lower {leader.name}'s, or raise this one"
            )


def _travel(config: Config) -> tuple[float, float]:
    """Positions between which an axis may be sent [m]."""
    limits = config.limits
    low, high = max(limits.travel_min_m, 0.0), min(limits.travel_max_m, config.cylinder.stroke_m)
    return low + limits.motion.margin_m, high - limits.motion.margin_m
