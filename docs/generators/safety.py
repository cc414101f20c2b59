"""The document of the safety layer, `docs/safety.md`, made from the fault table."""

from __future__ import annotations

from pneud.axis.stops import AWAY, GENTLE, SLIP_M
from pneud.canopen.words import Status, valve_state
from pneud.safety.checks import (
    LEAVING_TICKS,
    MOVING_M_S,
    OFF_CENTRE_V,
    SETTLING_NS,
    SETTLING_TICKS,
    Limits,
)
from pneud.safety.fault_row import Fault, Reaction
from pneud.safety.faults import TABLE
from pneud.safety.output import CEILING_V
from pneud.safety.supervisor import START_TICKS
from pneud.safety.watch import CHAMBER_PA
from pneud.signals import ENGAGED, State, ValveState

_STATES = {
    State.STARTING: f"the valve node is told to centre for {START_TICKS} ticks, whatever else is known",
    State.WAITING: "a sensor or the valve node does not answer",
    State.DISARMED: "everything answers; the valve is centred",
    State.TRACKING: "the load is led to the reference, then follows it",
    State.MOVING: "the load moves as a goto, a jog or a hold asks; then it is held",
    State.HOLDING: "the load is held still",
    State.HOMING: "the load is led against an end stop to find an incremental encoder's zero",
    State.STOPPING: "the load is brought to rest under control; then it is held, or the valve is centred",
    State.FAULT: "the valve is centred, and stays so until the fault is cleared",
    State.PROBING: "the valve is opened slowly and without a loop, and centred at the first bound",
    State.PRESSING: "the piston presses with a force, within bounds of travel, speed and time ([force.md](force.md))",
}
_REACTIONS = {
    Reaction.CENTRE: "the valve is centred in the same tick, past the slew limit, and disabled. Cannot arm",
    Reaction.STOP: "the load is brought to rest under control, then the valve is centred. Cannot arm",
    Reaction.NO_ARM: "the axis cannot arm; one that is engaged goes on",
    Reaction.LIMIT: "the output chain holds the command back; shown and logged, nothing else",
    Reaction.WARN: "shown and logged, nothing else",
}
# The state of CiA 402 that a drive would be in
_CIA_402 = {
    State.STARTING: "Not ready to switch on",
    State.WAITING: "Switch on disabled",
    State.DISARMED: "Ready to switch on",
    State.TRACKING: "Operation enabled (cyclic synchronous position)",
    State.MOVING: "Operation enabled (profile position)",
    State.HOLDING: "Operation enabled",
    State.HOMING: "Operation enabled (homing)",
    State.STOPPING: "Quick stop active; with a latched fault Fault reaction active",
    State.FAULT: "Fault",
    State.PROBING: "Operation enabled",
    State.PRESSING: "Operation enabled (profile torque)",
}
_DEBOUNCES = {
    "sensor_timeout_ns": "`bus.sensor_timeout_ms`",
    "valve_timeout_ns": "`bus.valve_timeout_ms`",
    "deadline_timeout_ns": "`bus.deadline_timeout_ms`",
    "overload_ns": "`bus.overload_timeout_ms`",
    "saturation_ns": "`limits.saturation_s`",
    **{name: f"{1e-6 * ns:g} ms" for name, ns in Limits._field_defaults.items()},
}
_TIMEOUTS = (
    (
        "`bus.sensor_timeout_ms`",
        "the axis: age of the last valid encoder, pressure and valve frame",
        "centre at once",
    ),
    ("`bus.deadline_timeout_ms`", "the axis: time without a tick while engaged", "centre at once"),
    (
        "`bus.valve_timeout_ms`",
        "the valve node: time without a valid command",
        "it centres by itself; `valve_timed_out`",
    ),
    (
        "`bus.valve_timeout_ms`",
        "the axis: engaged for longer, and the valve node is not enabled",
        "centre at once; `valve_rebooted`",
    ),
    (
        "`bus.input_timeout_ms`",
        "the axis: age of the last valid frame of each message with inputs",
        "controlled stop; `input_lost`",
    ),
    (
        "the node's own",
        "the node of the outputs: time without a message; it has to have such a time-out",
        "all outputs off: a brake holds ([inputs-outputs.md](inputs-outputs.md))",
    ),
)

_VALVES = {
    Status.NOT_READY: "the spool is where the valve as ordered goes without power: the load may move, or fall",
    Status.INIT: "as in NOT_READY",
    Status.DISABLED: "as in NOT_READY; so it is no centre, and a fault where the axis is engaged",
    Status.HOLD: "the spool is held on the hold setpoint, to which pneud gives 0: the chambers are shut",
    Status.ACTIVE: "the spool follows the setpoint",
    Status.FAULT_DISABLED: "as in NOT_READY, until the fault is reset",
    Status.FAULT_HOLD: "as in HOLD, until the fault is reset; a valve goes here for want of commands",
    Status.FAULT_REACTION: "on its way into one of the two above, as the valve is set up",
}

_TEXT = """\
# Safety

<!-- Made by docs/generators/safety.py; do not edit. `make pages` makes it anew. -->

## What pneud is not

pneud is a controller. It is **no safety function** in the sense of ISO 13849 or IEC 62061: it runs on an
ordinary computer, has one channel, and nobody has certified it. Do not put a hand where only pneud keeps
the load away.

**Centred is not a safe stop.** At 0 V (centre of a proportional 5/3 valve) both chambers are shut, or
leak a little. The air in them stays trapped and keeps its energy: the load may go on moving until the
pressures balance, may creep, and may jump when something that held it lets go. A person near the load
needs, outside of pneud and independent of it:

* a hardware valve that dumps the air of both chambers or blocks the rod, switched by the emergency stop;
* an emergency stop that does not pass through this computer or the CAN bus: the input `enable` does;
* a valve node that centres by itself when commands stop. pneud relies on that for its own death: it
  cannot centre a valve when its computer has stopped.

To dump the air takes that hardware valve. pneud only observes what it does, as a supply or a chamber
pressure that falls; it neither switches nor replaces it.

What pneud does see is in the table below. What it cannot see: a valve that does not do what its node
reports shows only in what the load then does; a slip of the encoder of less than `limits.innovation_m` at a
time shows not at all; a pressure sensor that drifts slowly looks like a force on the load; a load that is
held as hard as it is pushed looks the same as an encoder that stands still.

## States

{states}

*Engaged* are {engaged}: only in these can a voltage leave. In every other state each tick sends 0 V and
Enable 0.

* Only the requests *arm* and *home* engage, only from `disarmed`, and only while no fault is present that
  keeps from it. An armed axis holds still. An incremental encoder has to be homed before anything else
  moves; a jump of it, or its silence, loses the reference.
* A jog goes on only while it is renewed: its lease is counted in ticks, in the axis itself.
* Only the request *clear* leaves `fault`, and only when what led there is gone. It leads to `disarmed`:
  after a fault it takes *clear* and then *arm*. Nothing arms again by itself.
* *disarm*, and the end of the program, stop the load under control before the valve is centred; *stop*
  holds it then, or centres, as `limits.stop_then` says. While homing and probing each of them centres at
  once: the load is slow, with little force behind it, and no loop is there to stop it. After the end of
  the program was asked for, the axis does not arm again.
* Where there is a brake ([inputs-outputs.md](inputs-outputs.md)), it holds the load of every axis that is not
  engaged, a controlled stop ends with the valve centred only when it holds, and nothing is led while it does.
* No request widens a limit, and no input begins anything but the program that is loaded, of an armed axis.

What these sentences say is checked by tests that go through every state with every request, every fault and
every two faults at once, and by running the safety layer alone over logs.

The column CiA 402 names the state that an electric drive of that profile would be in. A drive has two steps
more between its states *ready to switch on* and *operation enabled*; here *arm* takes them in one.

No reference steps: a way with bounded acceleration and jerk (`limits.transfer`) leads from any motion to a
reference that is tracked, one within `limits.motion` to a position or to rest. A way that would leave
`limits.travel` is not begun; asked for when arming, that is `unreachable`. A stop that would leave it is
made harder than `limits.motion` instead. A jog brakes in time to rest at the end of the travel.

## One reading is no fact

A position further from where the load should be than encoder step, noise, a force of a tenth of the
piston's and what is usual lately explain, and pressures that have jumped or crossed a limit, are held
back: the tick goes on as if they had been lost. If the next reading says the same, both count, and are
whatever fault they are; so what is named below as a jump, a position or a pressure beyond a limit takes
two readings. If it does not, the first was odd. Odd readings are counted; more than three in ten of the
last 40 ms or so are `encoder_doubtful` or `pressure_doubtful`. Where no reading is believed for
`bus.sensor_timeout_ms`, it is as if none came. The log's ticks hold what was believed, with a bit for
what was held back and what confirmed it; the frames beside them hold what was said.

## On an end stop

An axis that lies on an end stop, or between it and `limits.travel`, can be armed: `travel` does not
show there. It then holds still where it lies. The first motion, whatever it is, begins with a way of at
most {away:g} mm/s to the nearest position that may be asked for; until the load is inside, the command
keeps within {gentle:g} % of its range, and force on the stop is no sign of a stuck encoder. A load that
gets further out by {slip:g} mm, or that moves outwards, is a fault as everywhere else, and one that is
inside and leaves its travel is `travel`. `limits.travel` may reach up to 10 mm behind the stops;
positions behind a stop cannot be asked for.

## Reactions

{reactions}

## Faults

A fault that centres or stops is *latched*: it is shown, and holds the axis in `fault`, until it is
cleared: by *clear*, and only once it is no longer present. The number is the bit in `present` and `latched`
of the log; it never changes its meaning. *For longer than* is how long it has to last before it counts; where
nothing stands there, a single tick is enough. *Gone* is when it is no longer present; where nothing stands
there, as soon as what is named under *when* is over.

{table}

Constants: the load moves above {moving:g} m/s; estimates are settled after {settling_ms:g} ms and
{settling_ticks} ticks; a valve off its centre by more than {off:g} V, or still enabled {leaving} ticks
after the axis has let go, is active. `encoder_jump` allows, over a gap between two readings, for what
`limits.chamber_max_pa` on the larger piston area could do to the load in that time. `pressure_jump` allows
{chamber_kpa:g} kPa, and what the open valve and the piston at `limits.speed_m_s` could do to the chamber
since its last reading. Any exception in a tick is `internal`.

## What a CANopen valve does in its states

A valve of profile CiA 408 ([canopen.md](canopen.md)) says in its status word what state it is in. *Disabled is
not centre*: where the spool goes then depends on how the valve was ordered, and what the load does then only
you know. Under local control (bit 4) it counts as a fault, whatever else it says.

{valves}

## The way of a command

law → finite? → slew limit (`limits.slew_v_s`) → ±`valve.u_max_v`, never above {ceiling:g} V → step of the
DBC → in range? → Enable 1.

A value that is not finite, or out of range in the end, becomes 0 V with Enable 0 and a latched fault.
Centring goes past all of this. Saturation is shown, and is no fault.

## Time-outs

{timeouts}

Between two valid frames the axis goes on with the last pressures and a predicted position, at most for
the time-out.
"""


def text() -> str:
    """The document."""
    return _TEXT.format(
        states=_table(
            ("state", "CiA 402", "meaning"), [(f"`{s.label}`", _CIA_402[s], _STATES[s]) for s in State]
        ),
        engaged=", ".join(f"`{state.label}`" for state in ENGAGED),
        reactions=_table(("reaction", "what happens"), [(r.value, _REACTIONS[r]) for r in Reaction]),
        table=_table(
            ("bit", "fault", "when", "for longer than", "reaction", "latched", "gone", "what to do"),
            [_row(fault) for fault in TABLE],
        ),
        valves=_table(
            ("status word, bits 0 … 3", "state of CiA 408", "counts as", "what the load has of it"),
            [
                (f"`{s:04b}`", s.name, ValveState(valve_state(s)).name.lower(), _VALVES[s])
                for s in sorted(Status)
            ],
        ),
        timeouts=_table(("time-out", "who watches", "what follows"), list(_TIMEOUTS)),
        moving=MOVING_M_S,
        settling_ms=SETTLING_NS * 1e-6,
        settling_ticks=SETTLING_TICKS,
        off=OFF_CENTRE_V,
        leaving=LEAVING_TICKS,
        ceiling=CEILING_V,
        chamber_kpa=CHAMBER_PA * 1e-3,
        away=AWAY.speed_m_s * 1e3,
        gentle=GENTLE * 1e2,
        slip=SLIP_M * 1e3,
    )


def _row(fault: Fault) -> tuple[str, ...]:
    return (
        str(int(fault.bit)),
        f"`{fault.name}`",
        fault.when,
        _DEBOUNCES.get(fault.debounce, ""),
        fault.reaction.value,
        "yes" if fault.latches else "no",
        fault.clears,
        fault.cure,
    )


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


if __name__ == "__main__":
    print(text(), end="")
