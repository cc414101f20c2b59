"""What the rig's electronics make of the truth: quantisation, noise, the DAC."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING, Any, NamedTuple

from pneud.physics.plant import PlantParameters
from pneud.rig.dynamics import PlantState, stroke_position

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


def quantised(value: float, step: float) -> float:
    """The nearest multiple of `step`; the value itself where `step` is 0."""
    return round(value / step) * step if step > 0.0 else value


def read_out(pressure_pa: float, resolution_pa: float, range_pa: float) -> float:
    """What a pressure sensor makes of a pressure [Pa]."""
    return max(0.0, min(range_pa, quantised(pressure_pa, resolution_pa)))


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
        self._random = random.Random(seed)
        self._uniform = self._random.random

    def draw(self) -> float:
        """The next number, of mean 0 and standard deviation 1."""
        u = self._uniform
        return u() + u() + u() + u() + u() + u() + u() + u() + u() + u() + u() + u() - 6.0

    def draw_many(self, count: int) -> NDArray[np.float64]:
        """The next numbers, those that `draw` would give one after another."""
        import numpy as np  # noqa: PLC0415 - for simulations alone

        version, (*keys, place), gauss = self._random.getstate()
        same: Any = np.random.RandomState()
        same.set_state(("MT19937", np.array(keys, dtype=np.uint32), place))
        each = same.random_sample((count, 12))
        found: NDArray[np.float64] = each[:, 0].copy()
        for i in range(1, 12):
            found += each[:, i]
        _, new_keys, new_place, *_ = same.get_state()
        self._random.setstate((version, (*new_keys.tolist(), new_place), gauss))
        return found - 6.0

    def state(self) -> Any:
        """To come back to by `restore`."""
        return self._random.getstate()

    def restore(self, state: Any) -> None:
        """Go on from a state."""
        self._random.setstate(state)


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
        return read_out(pressure_pa, self._resolution, self._range)
