"""A log as numpy columns; usage: python examples/log_to_numpy.py LOG.mcap."""

import sys

import numpy as np

import pneud

if len(sys.argv) != 2:
    sys.exit(__doc__)
log = pneud.read_log(sys.argv[1])
ticks = list(log)
error_mm = 1e3 * np.array([tick.error_m for tick in ticks])
command_v = np.array([tick.command.voltage_v for tick in ticks])
print(f"{len(ticks)} ticks over {ticks[-1].t_s:.1f} s on {log.metadata['bus']}")
print(f"error {np.sqrt(np.nanmean(error_mm**2)):.3f} mm RMS, command up to {np.abs(command_v).max():.2f} V")
if log.truncated:
    print(f"cut short: {log.damage}")
