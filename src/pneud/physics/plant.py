"""Parameters of the software rig, plain numbers."""

from typing import NamedTuple

from pneud.physics.cylinder import Cylinder
from pneud.physics.friction import Friction
from pneud.physics.gas import Gas
from pneud.physics.valve import Valve


class Detail(NamedTuple):
    """What a plant may have besides: all of it is looked at only where it is on."""

    on: bool = False
    play_v: float = 0.0  # half of the spool's hysteresis
    leak_in_v: float = 0.0  # opening of the closed edges from the supply
    leak_out_v: float = 0.0  # and of those to the atmosphere
    wall_s: float = 0.0  # time constant in which the air takes the wall's temperature; 0: never
    receiver_pa_kg: float = 0.0  # what the supply falls by with what is drawn; 0: it is constant
    regulator_kg_s_pa: float = 0.0  # what flows after for each Pa below its pressure
    slips: bool = False  # Maxwell elements in place of LuGre's bristles
    rise_1_pa: float = 0.0  # share more of friction for each Pa of mean pressure above FRICTION_AT_PA
    forward_share: float = 0.0  # of friction more on the way out, and less on the way back
    pressure_lag_s: float = 0.0  # of the pressure sensors
    encoder_lag_s: float = 0.0
    encoder_noise_m: float = 0.0  # standard deviation
    encoder_offset_m: float = 0.0
    p1_offset_pa: float = 0.0
    p2_offset_pa: float = 0.0
    supply_offset_pa: float = 0.0
    hose_s: float = 0.0  # from the valve's opening to the flow into the chamber
    contact_n_m: float = 0.0  # stiffness of what the load runs against; 0: nothing is there
    contact_m: float = 0.0  # where that begins, effective coordinate
    contact_n_s_m: float = 0.0  # its damping
    contact_side: float = 1.0  # in front of the load; −1: behind it


class Wiring(NamedTuple):
    """How valve, sensors and hoses are connected; positions are shown from where the load is at first."""

    swapped_hoses: bool = False
    exchanged_pressures: bool = False
    encoder_scale: float = 1.0  # negative for one that counts the other way
    dead_pressure: int = 0  # number of the chamber whose sensor is dead, 0 for none
    valve_unplugged: bool = False


class BeamParameters(NamedTuple):
    """A beam between the pistons of two axes, as one of them says."""

    axis: str  # name of the other one
    stiffness_n_m: float
    damping_n_s_m: float


class Board(NamedTuple):
    """The nodes of inputs and outputs; bits as the configuration names these."""

    inputs: int = 0  # that are on at first
    period_s: float = 0.01  # inputs are sent so often
    timeout_s: float = 0.1  # outputs are off after so long without a message
    brake: int = 0  # output of the brake, 0 for none
    feedback: int = 0  # input that says that it has let go
    frees: bool = True  # the output lets go of the load; else it holds the load
    release_s: float = 0.0
    engage_s: float = 0.0


FRICTION_AT_PA = 3e5  # mean pressure of the chambers at which friction is as its parameters say


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
    node_delay_s: float  # from the end of SYNC, or from sampling, to hand-over of the answers
    free_s: float = 0.0  # the nodes sample so often by themselves; 0: when they hear SYNC
    load_n: float = 0.0  # constant force against positive motion, the weight's part included
    detail: Detail = Detail()
    wiring: Wiring = Wiring()
    free_jitter_s: float = 0.0  # by about so much what they have sampled by themselves leaves late
    board: Board = Board()
