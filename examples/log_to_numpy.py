"""A log as numpy columns; usage: python examples/log_to_numpy.py LOG.mcap."""

import sys

import numpy as np

import pneud

if len(sys.argv) != 2:
    sys.exit(__doc__)
log = pneud.read_log(sys.argv[1])
found = log.columns("t_s", "error_m", "command.voltage_v")
error_mm, command_v = 1e3 * found["error_m"], found["command.voltage_v"]
print(f"{len(error_mm)} ticks over {found['t_s'][-1]:.1f} s on {log.metadata['bus']}")
print(f"error {np.sqrt(np.nanmean(error_mm**2)):.3f} mm RMS, command up to {np.abs(command_v).max():.2f} V")
if log.truncated:
    print(f"cut short: {log.damage}")
