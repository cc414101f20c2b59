"""RMS tracking error of a simulated run, from the plant's true position."""

import math

import pneud

square, count = 0.0, 0
for record in pneud.simulate("virtual.toml", duration_s=8.0, seed=1):
    if record.state_name == "tracking" and record.t_s > 3.0:
        square += record.true_error_m**2
        count += 1
print(f"{1e3 * math.sqrt(square / count):.3f} mm RMS over {count} ticks")
