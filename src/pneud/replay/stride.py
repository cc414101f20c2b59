"""A tick of axis, bus and rig as one pure function, for ticks in which nothing is out of the ordinary.

It does what frames, nodes and inbox do where every answer comes in time and nobody asks for anything: values
are rounded as their frames round them, and the plant goes on from one frame's end to the next. Compiled, it
is done as often as one likes without coming back to Python.
"""

from __future__ import annotations

from typing import NamedTuple

from pneud.axis.cycle import AxisParameters, AxisState, cycle
from pneud.physics.plant import PlantParameters
from pneud.rig.dynamics import PlantState, advance, stroke_position
from pneud.rig.sensors import dac_output, quantised, read_out, sensed
from pneud.safety.faults import BLOCKS_ARM
from pneud.safety.supervisor import DISARMED, FAULT
from pneud.signals import ALL_SOURCES, Command, Estimate, Measurement, Reference

CENTRED, ENABLED = 1, 2  # of `ValveState`


class Noise(NamedTuple):
    """What the sensors of one tick are off by, in standard deviations."""

    encoder: float
    p1: float
    p2: float
    supply: float


class Signal(NamedTuple):
    """How a value goes over the bus: as an integer, times a step, from an offset."""

    step: float
    offset: float
    low: float  # smallest number that rounds to one that can be sent
    high: float


class Line(NamedTuple):
    """When frames end on the bus, and what they carry; times of a tick count from its SYNC."""

    waits: int  # the axis is asked to arm as soon as it can
    epoch_ns: int  # the rig's time began
    period_ns: int
    sync_ns: int  # SYNC has been heard
    command_ns: int  # the command has been heard
    offset_ns: int  # what the axis takes for the instant of the sample
    status: int  # of the encoder
    position: Signal
    p1: Signal
    p2: Signal
    supply: Signal
    applied: Signal
    command: Signal


class Between(NamedTuple):
    """Axis and rig between two ticks."""

    axis: AxisState
    rig: PlantState
    rig_ns: int  # until when the rig has been integrated
    t_ns: int  # the last tick's SYNC
    output_v: float  # of the valve's DAC
    valve: int  # its state
    coming_v: float  # the command that is on its way
    enable: int
    state: int  # of the axis
    present: int


class Raw(NamedTuple):
    """What the frames of a tick carry."""

    position: int
    p1: int
    p2: int
    supply: int
    applied: int
    valve: int
    command: int


class Row(NamedTuple):
    """A tick as numbers."""

    t_ns: int
    measurement: Measurement
    estimate: Estimate
    reference: Reference
    command: Command
    state: int
    present: int
    latched: int
    answer: int
    in_position: int
    hunting: int
    truth_m: float
    raw: Raw


def raw_of(value: float, s: Signal) -> int:
    """The integer that a frame carries."""
    steps = (value - s.offset) / s.step
    assert s.low <= steps <= s.high
    return round(steps)


def value_of(raw: int, s: Signal) -> float:
    """What is made of it again."""
    return raw * s.step + s.offset


def seconds(t_ns: int, line: Line) -> float:
    """The rig's own time [s]."""
    return (t_ns - line.epoch_ns) * 1e-9


def read(pressure_pa: float, noise: float, range_pa: float, plant: PlantParameters) -> float:
    """What a pressure sensor shows [Pa]."""
    noisy_pa = pressure_pa + plant.pressure_noise_pa * noise
    return read_out(noisy_pa, plant.pressure_resolution_pa, range_pa)


def stride(
    s: Between,
    noise: Noise,
    p: AxisParameters,
    plant: PlantParameters,
    line: Line,
    force_n: float,
    range_pa: float,
) -> tuple[Between, Row]:
    """One tick.

    Args:
        s: after the last one.
        noise: of this tick's readings.
        p: the axis.
        plant: the rig.
        line: the bus.
        force_n: external force on the load, against positive motion.
        range_pa: full scale of the pressure sensors.

    Raises:
        AssertionError: something is out of the ordinary.
    """
    assert s.state != FAULT
    assert line.waits == 0 or s.state != DISARMED or (s.present & BLOCKS_ARM) != 0
    t_ns, heard_ns = s.t_ns + line.period_ns, s.t_ns + line.command_ns
    at_s, next_s = seconds(heard_ns, line), seconds(t_ns, line)
    rig = advance(s.rig, s.output_v, force_n, seconds(s.rig_ns, line), at_s, plant)
    output_v, valve = 0.0, CENTRED
    if s.enable != 0:
        output_v, valve = dac_output(s.coming_v, plant.dac_bits, plant.valve.u_max_v), ENABLED
    rig = advance(rig, output_v, force_n, at_s, next_s, plant)
    truth_m = stroke_position(rig, plant)
    sampled_ns = t_ns + line.sync_ns
    rig = advance(rig, output_v, force_n, next_s, seconds(sampled_ns, line), plant)

    there = sensed(rig, plant)
    shown_m = there.position_m - plant.encoder_zero_m
    if plant.detail.encoder_noise_m > 0.0:
        shown_m += plant.detail.encoder_noise_m * noise.encoder
    position = raw_of(quantised(shown_m, plant.encoder_resolution_m), line.position)
    p1 = raw_of(read(there.p1_pa, noise.p1, range_pa, plant), line.p1)
    p2 = raw_of(read(there.p2_pa, noise.p2, range_pa, plant), line.p2)
    supply = raw_of(read(there.supply_pa, noise.supply, range_pa, plant), line.supply)
    applied = raw_of(output_v, line.applied)
    measurement = Measurement(
        t_ns,
        ALL_SOURCES,
        value_of(position, line.position),
        value_of(p1, line.p1),
        value_of(p2, line.p2),
        value_of(supply, line.supply),
        value_of(applied, line.applied),
        line.status,
        valve,
        0,
        0,
        0,
        0,
        0,
        0,
        line.offset_ns,
        0,
        0,
    )
    axis, tick = cycle(s.axis, measurement, None, t_ns, p, None, None)
    assert tick.program is None
    assert tick.station is None
    assert tick.weighed is None
    command = raw_of(tick.command.voltage_v, line.command)
    row = Row(
        t_ns,
        tick.measurement,
        tick.estimate,
        tick.reference,
        tick.command,
        tick.state,
        tick.present,
        tick.latched,
        tick.answer,
        tick.in_position,
        tick.hunting,
        truth_m,
        Raw(position, p1, p2, supply, applied, valve, command),
    )
    coming_v, enable = value_of(command, line.command), tick.command.enable
    after = Between(axis, rig, sampled_ns, t_ns, output_v, valve, coming_v, enable, tick.state, tick.present)
    return after, row
