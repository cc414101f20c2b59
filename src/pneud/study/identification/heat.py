"""How warm the air in the chambers is, by the pressures measured, where its wall takes and gives heat.

Air that is compressed gets warm, what flows in is as warm as the wall, and both come to its temperature at a
rate. So the temperature follows from pressure and volume alone, whatever the valve does.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
RATES_1_S = np.geomspace(0.1, 30.0, 20)  # for which it is computed; in between it is interpolated


def warmth(pressure_pa: Floats, length_m: Floats, k: float, h: float, count: int) -> Floats:
    """Logarithm of the temperature over the wall's in the last ticks of stretches that begin at rest.

    Args:
        pressure_pa: (chamber, stretch, tick), smoothed.
        length_m: of the chambers, their dead lengths included, likewise.
        k: ratio of specific heats.
        h: sample time [s].
        count: how many ticks.

    Returns:
        (stretch, rate, chamber, tick), for each of `RATES_1_S`.
    """
    compressed, grown = np.diff(np.log(pressure_pa)), np.diff(np.log(length_m))
    share = (h / k * RATES_1_S)[:, None, None]
    now = np.zeros((len(RATES_1_S), *compressed.shape[:2]))
    found = np.zeros((*now.shape, count))
    ticks = compressed.shape[2]
    for i in range(ticks):
        # what comes in is as warm as the wall, what goes out as the air
        came = compressed[:, :, i] / k + grown[:, :, i] - share * np.expm1(-now)
        now = now + compressed[:, :, i] + grown[:, :, i] - np.where(came > 0.0, np.exp(now), 1.0) * came
        if i >= ticks - count:
            found[..., i - ticks + count] = now
    return np.moveaxis(found, 2, 0)


def at(warmths: Floats, rate_1_s: Floats) -> Floats:
    """Warmths (window, rate, chamber, tick) at other rates: (rate, chamber, window, tick)."""
    place = np.interp(np.log(np.maximum(rate_1_s, 1e-9)), np.log(RATES_1_S), np.arange(len(RATES_1_S)))
    low = np.minimum(place.astype(int), len(RATES_1_S) - 2)
    part = (place - low)[None, :, None, None]
    found: Floats = (1.0 - part) * warmths[:, low] + part * warmths[:, low + 1]
    return np.moveaxis(found, 0, 2)
