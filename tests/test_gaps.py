"""Frames that do not come for a few ticks: the axis predicts, and does not strike when they are back."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import pytest

from pneud.loading import load
from pneud.replay.lockstep import Simulation, backend_of
from pneud.signals import Frame, State

LOADED = load("virtual.toml")
ENCODER, PRESSURE, STATUS = 0x181, 0x182, 0x183


def worst(silent: Sequence[int], first: int, ticks: int) -> tuple[float, float]:
    """Greatest error [m] and command [V] from a gap's begin to 0.2 s after it."""
    run = Simulation(LOADED, 1.3, how=backend_of(LOADED))
    count = 0

    def hook(frame: Frame, outgoing: bool) -> Sequence[Frame]:
        return () if outgoing and first <= count < first + ticks and frame.can_id in silent else (frame,)

    run.node.hook = hook
    error_m = command_v = 0.0
    for record in run.records():
        tick = record.tick
        if first <= count < first + ticks + 200:
            assert tick.state == State.TRACKING
            error_m = max(error_m, abs(tick.estimate.position_m - record.truth_m))
            error_m = max(error_m, abs(tick.reference.position_m - record.truth_m))
            command_v = max(command_v, abs(tick.command.voltage_v))
        count += 1
    return error_m, command_v


@cache
def quiet() -> tuple[float, float]:
    return worst([], 1000, 0)


@pytest.mark.parametrize(
    "silent",
    [[ENCODER], [PRESSURE], [STATUS], [ENCODER, PRESSURE, STATUS]],
    ids=["encoder", "pressure", "valve", "all"],
)
def test_eight_ticks_of_silence_in_motion_are_bridged(silent: list[int]) -> None:
    quiet_error_m, quiet_v = quiet()
    error_m, command_v = worst(silent, 1000, 8)
    assert error_m < quiet_error_m + 100e-6
    assert command_v < quiet_v + 1.0
