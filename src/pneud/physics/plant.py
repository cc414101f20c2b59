"""Parameters of the software rig, plain numbers."""

from __future__ import annotations

from typing import NamedTuple

from pneud.physics.cylinder import Cylinder
from pneud.physics.friction import Friction
from pneud.physics.gas import Gas
from pneud.physics.valve import Valve


class Wiring(NamedTuple):
    """How valve, sensors and hoses are connected; positions are shown from where the load is at first."""

    swapped_hoses: bool = False
    exchanged_pressures: bool = False
    encoder_scale: float = 1.0  # negative for one that counts the other way
    dead_pressure: int = 0  # number of the chamber whose sensor is dead, 0 for none
    valve_unplugged: bool = False


class PlantParameters(NamedTuple):
    """The true plant, which the controller's model may well differ from."""

    gas: Gas
    cylinder: Cylinder  # rod_force_n is 0 where the ideal plant has none
    valve: Valve
    friction: Friction  # all zero for the ideal plant
    polytropic_exponent: float
    reverse_flow: bool  # flow from a chamber above supply back into the supply
    step_s: float  # longest integration step
    initial_x1: float
    initial_p2_pa: float
    disturbance: int  # 0 none, 1 constant, 2 time-varying: the paper's d1, d2 on the chamber pressures
    dac_bits: int  # 0 for a continuous output
    valve_timeout_s: float
    encoder_resolution_m: float  # 0 for exact sensors
    pressure_resolution_pa: float
    pressure_noise_pa: float  # standard deviation
    bitrate_bit_s: float  # inf switches the bus timing off
    encoder_zero_m: float  # stroke position at which the encoder shows 0
    encoder_referenced: bool  # it says that it knows where it is
    node_delay_s: float  # from the end of SYNC to hand-over of the answers
    load_n: float = 0.0  # constant force against positive motion, the weight's part included
    wiring: Wiring = Wiring()
