"""What an axis is: its parameters, and all that it remembers from tick to tick."""

from typing import NamedTuple

from pneud.axis.mileage import Odometer
from pneud.axis.standing import AT_WORK, Expected, Standing
from pneud.control.adaptation import Learnt
from pneud.control.force import NO_PRESS, Press, Pressing
from pneud.control.homing import NOWHERE, Homing, HomingParameters
from pneud.control.leading import NOT_LED, Leading, Led
from pneud.control.plan import IDLE, Plan
from pneud.control.probe import NO_PROBE, Probe
from pneud.control.profile import Profile
from pneud.control.program import NO_RUN, Program, Run
from pneud.control.reference import Bounds, Shunned, Sine, Way
from pneud.control.step import Controller, ControllerState
from pneud.safety import supervisor, watch
from pneud.safety.brake import Brake, BrakeRules
from pneud.safety.checks import Limits
from pneud.safety.output import OutputLimits
from pneud.safety.station import Inputs, Roles

NAN = float("nan")
INSIDE = -1.0  # stands for no position outside: no load is ever so far out [m]


class Gate(NamedTuple):
    """How far readings may lie from what was expected, and how many of them may."""

    noise_m: float  # encoder step and noise
    acceleration_m_s2: float  # of a force that nobody knows of, since the last reading
    speed_m_s: float  # the most that such a force changes at once
    rate: float  # part that a reading has in shares and usual sizes
    share: float  # more odd readings are a fault


class Doubt(NamedTuple):
    """What is held back, and how often readings were odd."""

    innovation_m: float = 0.0  # of an encoder reading that is held back, 0 for none
    encoder_ns: int = 0  # when it was taken
    slack_m: float = 0.0  # that a confirmed one has left for those behind it
    spread_m: float = 0.0  # usual size of an innovation
    encoder_share: float = 0.0  # of odd readings, lately
    p1_pa: float = 0.0  # pressures that are held back
    p2_pa: float = 0.0
    supply_pa: float = 0.0
    pressure_ns: int = -1  # when they were read, −1 for none
    known_supply_pa: float = NAN  # believed last
    pressure_share: float = 0.0


class AxisParameters(NamedTuple):
    """All parameters of an axis."""

    controller: Controller
    output: OutputLimits
    limits: Limits
    gate: Gate
    expected: Expected  # of the load at its target
    reference: Sine
    transfer: Bounds  # of ways that join a reference
    motion: Bounds  # of all other ways
    travel_margin_m: float  # how far from the ends of the travel a way to a position stays
    homing: HomingParameters
    stop_centres: bool  # after a stop that was asked for
    join_at_once: bool  # start on the reference without a transfer
    learnt: Learnt = Learnt()  # in an earlier run: where adaptation starts
    shunned: Shunned = Shunned()  # speeds at which no short way to a position peaks
    leading: Leading = Leading()  # by another axis
    pressing: Pressing = Pressing()
    roles: Roles = Roles()  # of inputs and outputs
    brake: BrakeRules = BrakeRules()


class AxisState(NamedTuple):
    """All state of an axis: freeze it, thaw it, and the same ticks follow."""

    supervisor: supervisor.Supervisor
    controller: ControllerState | None  # None until all sensors have spoken
    t_ns: int  # of the last tick
    sampled_ns: int  # instant that the estimate holds for
    read_ns: int  # instant of the last encoder reading
    started_ns: int  # since when there have been estimates
    plan: Plan  # what the reference is doing
    profile: Profile  # as uploaded
    last_v: float  # last command that left
    limited: int  # 1 where it was less than the law had asked for
    watch: watch.Watch
    law: Controller  # with its present gains
    zero_m: float  # where an incremental encoder shows 0
    referenced: bool  # whether that is known
    homing: Homing
    reference: Sine | None = None  # the configured one, where it has been changed
    standing: Standing = AT_WORK
    doubt: Doubt = Doubt()
    outside_m: float = INSIDE  # innermost position since it has been armed outside its travel
    learnt: Learnt = Learnt()  # up to the last tick, for a controller that starts anew
    probe: Probe = NO_PROBE
    odometer: Odometer = Odometer()
    led: Led = NOT_LED  # by another axis
    program: Program = ()
    run: Run = NO_RUN  # how far the program is
    press: Press = NO_PRESS  # the last one, perhaps under way
    pressed: int = 0  # 1 from then on until the load has come free
    inputs: Inputs = Inputs()
    brake: Brake = Brake()
    balance: Press = NO_PRESS  # by which the piston comes to bear what the brake holds

    @property
    def phase(self) -> int:
        """What the reference is doing."""
        return self.plan.phase

    @property
    def phase_ns(self) -> int:
        """When it began to."""
        return self.plan.since_ns

    @property
    def path(self) -> Way:
        """The way that it goes."""
        return self.plan.path


def switched_on(p: AxisParameters) -> AxisState:
    """The state of an axis that knows nothing yet."""
    return AxisState(
        supervisor=supervisor.INITIAL,
        controller=None,
        t_ns=0,
        sampled_ns=0,
        read_ns=0,
        started_ns=0,
        plan=IDLE,
        profile=(),
        last_v=0.0,
        limited=0,
        watch=watch.INITIAL,
        law=p.controller,
        zero_m=0.0,
        referenced=False,
        homing=NOWHERE,
        learnt=p.learnt,
    )


def learnt_so_far(state: AxisState) -> Learnt:
    """What has been learnt, whether there is a controller or not."""
    if state.controller is None:
        return state.learnt
    return state.controller.learnt


def configured(state: AxisState, p: AxisParameters) -> Sine:
    """The reference that the axis tracks when it is told to."""
    if state.reference is not None:
        return state.reference
    return p.reference
