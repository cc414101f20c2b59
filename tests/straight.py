"""The axis and the software rig without a bus between them: quick, where frames are not what is tested."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

from axis_rig import quick
from pneud.axis.cycle import Axis
from pneud.config import conversions
from pneud.loading import Loaded
from pneud.physics.plant import PlantParameters
from pneud.rig.dynamics import PlantState, initial_state, stroke_position
from pneud.rig.node import PRESSURE_RANGE_PA
from pneud.rig.sensors import Noise, PressureSensor, dac_output, quantised, sensed
from pneud.signals import ALL_SOURCES, EncoderStatus, Measurement, Request, Tick, ValveState

COMMAND_S = 0.75e-3  # from sampling until the command acts


class Moment(NamedTuple):
    """A tick, and what was true at its sampling."""

    tick: Tick
    place_m: float
    speed_m_s: float


def played(
    loaded: Loaded, operator: Callable[[int, int], Request | None], most_s: float, seed: int = 0
) -> Iterator[Moment]:
    """What comes of an operator's requests; every frame of the rig arrives, and in time.

    Args:
        loaded: the axis, and the rig.
        operator: (state, faults present) of the last tick → request.
        most_s: how long at most.
        seed: of the sensors' noise.
    """
    p, backend = conversions.plant_of(loaded.config), quick()
    axis: Axis = backend.axis(conversions.axis_of(loaded.config, loaded.codecs.command_lsb_v))
    noise = Noise(seed)
    read = PressureSensor(noise, p.pressure_noise_pa, p.pressure_resolution_pa, PRESSURE_RANGE_PA).read
    h, w, applied_v, enabled = 1.0 / loaded.config.loop.rate_hz, p.wiring, 0.0, False
    s, state, present = initial_state(p), 0, 0
    for i in range(round(most_s / h)):
        m = measured(s, p, read, round((i + 1) * h * 1e9), applied_v, enabled)
        tick = axis.cycle(m, operator(state, present), m.t_ns)
        state, present = tick.state, tick.present
        yield Moment(tick, stroke_position(s, p), s.v)
        for until_s, command_v in ((COMMAND_S, applied_v), (h, tick.command.voltage_v)):
            applied_v = dac_output(command_v, p.dac_bits, p.valve.u_max_v)
            true_v = 0.0 if w.valve_unplugged else -applied_v if w.swapped_hoses else applied_v
            from_s = i * h + (0.0 if until_s == COMMAND_S else COMMAND_S)
            s = backend.advance(s, true_v, 0.0, from_s, i * h + until_s, p)
        enabled = tick.command.enable == 1


def measured(
    s: PlantState,
    p: PlantParameters,
    read: Callable[[float], float],
    t_ns: int,
    applied_v: float,
    enabled: bool,
) -> Measurement:
    """What the nodes would say."""
    true, w, start_m = sensed(s, p), p.wiring, p.initial_x1 - p.cylinder.x_e1
    chambers = [true.p1_pa, true.p2_pa]
    if w.dead_pressure:
        chambers[w.dead_pressure - 1] = p.gas.atmosphere_pa
    p1_pa, p2_pa = reversed(chambers) if w.exchanged_pressures else chambers
    return Measurement(
        t_ns,
        ALL_SOURCES,
        quantised(start_m + w.encoder_scale * (true.position_m - start_m), p.encoder_resolution_m),
        read(p1_pa),
        read(p2_pa),
        read(true.supply_pa),
        applied_v,
        int(EncoderStatus.REFERENCED),
        int(ValveState.ENABLED if enabled else ValveState.CENTRED),
        *(0, 0, 0, 0, 0, 0, 0, 0, 0),
    )
