"""Colours of lines, of states, and of logs that are compared."""

from __future__ import annotations

import colorsys

from pneud.signals import State

# Okabe and Ito's, which everybody can tell apart; a page has lighter ones for each where it is dark
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")
BLUE, RED, GREEN, PINK, SKY, ORANGE, BLACK = COLOURS
STATE_COLOURS = {
    State.STARTING: "#cccccc",
    State.WAITING: "#b8b8b8",
    State.DISARMED: "#999999",
    State.TRACKING: "#009e73",
    State.MOVING: "#56b4e9",
    State.HOLDING: "#0072b2",
    State.HOMING: "#cc79a7",
    State.STOPPING: "#e69f00",
    State.FAULT: "#d55e00",
    State.PROBING: "#f0e442",
    State.PRESSING: "#7a5195",
}


def colours_of(count: int) -> list[str]:
    """So many colours: those above while they last, else as many hues as it takes, light and deep in turn."""
    if count <= len(COLOURS):
        return list(COLOURS[:count])
    found = []
    for i in range(count):
        red, green, blue = colorsys.hls_to_rgb(i / count, (0.38, 0.52, 0.62)[i % 3], (0.85, 0.65)[i % 2])
        found.append(f"#{round(255 * red):02x}{round(255 * green):02x}{round(255 * blue):02x}")
    return found
