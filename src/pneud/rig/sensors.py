"""What the rig's electronics make of the truth: quantisation, noise, the DAC."""

from __future__ import annotations

import random
from typing import NamedTuple

from pneud.physics.plant import PlantParameters
from pneud.rig.dynamics import PlantState, stroke_position


def quantised(value: float, step: float) -> float:
    """The nearest multiple of `step`; the value itself where `step` is 0."""
    return round(value / step) * step if step > 0.0 else value


def dac_output(command_v: float, bits: int, u_max_v: float) -> float:
    """What a DAC of `bits` over ±u_max puts out [V]: two's complement, so +u_max itself is out of reach.

    Args:
        command_v: asked for [V].
        bits: width; 0 for a continuous output.
        u_max_v: full scale [V].
    """
    if bits == 0:
        return max(-u_max_v, min(u_max_v, command_v))
    half = 1 << (bits - 1)
    code = round(command_v / u_max_v * half)
    return max(-half, min(half - 1, code)) * u_max_v / half


class Sensed(NamedTuple):
    """What the sensing elements have come to, before noise and steps."""

    position_m: float  # stroke coordinate
    p1_pa: float
    p2_pa: float
    supply_pa: float


def sensed(s: PlantState, p: PlantParameters) -> Sensed:
    """What there is to be read: the truth, or what lags and offsets make of it."""
    d = p.detail
    if not d.on:
        return Sensed(stroke_position(s, p), s.p1, s.p2, p.gas.supply_pa)
    return Sensed(
        stroke_position(s, p) - d.encoder_lag_s * s.v + d.encoder_offset_m,
        s.depth.shown1_pa + d.p1_offset_pa,
        s.depth.shown2_pa + d.p2_offset_pa,
        s.depth.shown_supply_pa + d.supply_offset_pa,
    )


class Noise:
    """Bell-shaped noise that is the same for a seed on every machine.

    The sum of twelve uniform numbers (standard deviation 1, never beyond 6): additions alone, where Gaussian
    generators take logarithms whose last bit depends on the machine's libm.
    """

    def __init__(self, seed: int) -> None:
        self._uniform = random.Random(seed).random

    def draw(self) -> float:
        """The next number, of mean 0 and standard deviation 1."""
        u = self._uniform
        return u() + u() + u() + u() + u() + u() + u() + u() + u() + u() + u() + u() - 6.0


class PressureSensor:
    """An absolute pressure sensor with noise, resolution and a range [Pa]."""

    def __init__(self, noise: Noise, deviation_pa: float, resolution_pa: float, range_pa: float) -> None:
        self._noise = noise
        self._deviation = deviation_pa
        self._resolution = resolution_pa
        self._range = range_pa

    def read(self, pressure_pa: float) -> float:
        """What the sensor shows [Pa]; beyond its range it shows the range's end."""
        if self._deviation > 0.0:
            pressure_pa += self._deviation * self._noise.draw()
        return max(0.0, min(self._range, quantised(pressure_pa, self._resolution)))
