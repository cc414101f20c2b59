"""RMS tracking error of a simulated run, from the plant's true position."""

import math

import pneud
from pneud.signals import State

square, count = 0.0, 0
for record in pneud.simulate("virtual.toml", duration_s=8.0, seed=1):
    tick = record.tick
    if tick.state == State.TRACKING and record.tick.t_ns > 4_000_000_000:
        square += (tick.reference.position_m - record.truth_m) ** 2
        count += 1
print(f"{1e3 * math.sqrt(square / count):.3f} mm RMS over {count} ticks")
