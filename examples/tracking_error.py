"""RMS tracking error of a simulated run, from the plant's true position."""

import math

import pneud

square, count = 0.0, 0
for record in pneud.simulate("virtual.toml", duration_s=8.0, seed=1):
    if record.tick.state_name == "tracking" and record.tick.t_ns > 4_000_000_000:
        square += record.true_error_m**2
        count += 1
print(f"{1e3 * math.sqrt(square / count):.3f} mm RMS over {count} ticks")
