"""Inputs and outputs by their roles, and a brake: what a configuration says of them, and as plain numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from pneud.config.mapping import SignalConfig
from pneud.config.sections import Section
from pneud.physics.plant import Board
from pneud.safety.brake import BrakeRules
from pneud.safety.station import Roles

if TYPE_CHECKING:
    from pneud.config.models import Config

MOST = 32  # inputs, and outputs
INPUT_ROLES = ("start", "enable", "brake_released")
OUTPUT_ROLES = ("in_position", "ready", "engaged", "fault", "brake")
"""Names that pneud acts on, or puts out itself; all others are for programs."""


class IoConfig(Section):
    """What inputs and outputs do; which there are stands in `bus.inputs` and `bus.outputs`."""

    enable_off: Literal["stop", "centre"] = "stop"  # what an engaged axis does without it
    start: Literal["nothing", "program"] = "nothing"  # what the input begins: the program that is loaded
    start_cycles: Annotated[int, Field(ge=0, le=1_000_000_000)] = 1  # rounds of it; 0: until it is stopped


class BrakeConfig(Section):
    """A brake or a clamp at the output `brake`, which holds the load where it gets no power.

    The input `brake_released`, if there is one, says that it has let go.
    """

    release_s: Annotated[float, Field(ge=0, le=10)] = 0.1  # from the output until it has let go
    engage_s: Annotated[float, Field(ge=0, le=10)] = 0.1  # from the output until it holds
    balance_s: Annotated[float, Field(gt=0, le=60)] = 1.0  # in which the piston comes to bear the load
    feedback_s: Annotated[float, Field(ge=0, le=10)] = 0.1  # that the input may be later
    power: Literal["frees", "holds"] = "frees"  # what the output does to the load where it is on
    at_rest: bool = False  # holds the load wherever it is in position, not only where it is disarmed


def check_io(inputs: Mapping[str, SignalConfig], outputs: Mapping[str, SignalConfig]) -> None:
    """Refuse what is no input and no output.

    Raises:
        ValueError: says which, and the cure.
    """
    for what, told in (("inputs", inputs), ("outputs", outputs)):
        if len(told) > MOST:
            raise ValueError(f"{what}: {len(told)} of them; {MOST} are the most")
        for name, value in told.items():
            if not name.isidentifier() or len(name) > MOST:
                raise ValueError(f"{what}.{name}: a name is letters, digits and _, at most {MOST}")
            if value.signal is None or "." not in value.signal:
                raise ValueError(f'{what}.{name}: give "MESSAGE.SIGNAL"')
            plain = SignalConfig(signal=value.signal, mask=value.mask, values=value.values)
            if value != plain:
                raise ValueError(f"{what}.{name}: is on or off; it takes signal, mask and values")
            if not set(value.values.values()) <= {0, 1}:
                raise ValueError(f"{what}.{name}: values says which numbers are 0 (off) and 1 (on)")
            if what == "outputs" and value.values and set(value.values.values()) != {0, 1}:
                raise ValueError(f"{what}.{name}: values has to tell what 0 (off) and 1 (on) are")


def check_station(c: Config) -> None:
    """Refuse roles that lack what they need.

    Raises:
        ValueError: says which, and the cure.
    """
    inputs, outputs = c.bus.inputs, c.bus.outputs
    if c.io.start == "program" and "start" not in inputs:
        raise ValueError('io.start = "program" needs an input: bus.inputs.start = "MESSAGE.SIGNAL"')
    if unknown := [name for name in c.plant.inputs if name not in inputs]:
        raise ValueError(f"plant.inputs.{unknown[0]} is no input; there is {', '.join(inputs) or 'none'}")
    if c.brake is None:
        for what, told, name in (("inputs", inputs, "brake_released"), ("outputs", outputs, "brake")):
            if name in told:
                raise ValueError(f"bus.{what}.{name} is of a brake; say how it is: [brake]")
    else:
        if "brake" not in outputs:
            raise ValueError('brake: needs an output: bus.outputs.brake = "MESSAGE.SIGNAL"')
        if c.reference.follow is not None:
            raise ValueError("brake: an axis that another one leads, or a gantry, cannot wait for it")
        if c.reference.join == "at_once":
            raise ValueError('brake: reference.join = "at_once" cannot wait for it; take "transfer"')


def _mask(told: Mapping[str, SignalConfig], name: str) -> int:
    return 1 << list(told).index(name) if name in told else 0


def roles_of(c: Config) -> Roles:
    """Which inputs and outputs do what, by the order in which they are named."""
    inputs, outputs = c.bus.inputs, c.bus.outputs
    if not inputs and not outputs:
        return Roles()
    return Roles(
        used=True,
        lost_ns=round(c.bus.input_timeout_ms * 1e6) if inputs else 0,
        enable=_mask(inputs, "enable"),
        cuts=c.io.enable_off == "centre",
        start=_mask(inputs, "start") if c.io.start == "program" else 0,
        laps=c.io.start_cycles,
        in_position=_mask(outputs, "in_position"),
        ready=_mask(outputs, "ready"),
        engaged=_mask(outputs, "engaged"),
        fault=_mask(outputs, "fault"),
        brake=_mask(outputs, "brake"),
    )


def brake_of(c: Config) -> BrakeRules:
    """What is known of the brake."""
    b = c.brake
    if b is None:
        return BrakeRules()
    release_ns, engage_ns, balance_ns, feedback_ns = (
        round(s * 1e9) for s in (b.release_s, b.engage_s, b.balance_s, b.feedback_s)
    )
    return BrakeRules(
        used=True,
        release_ns=release_ns,
        engage_ns=engage_ns,
        balance_ns=balance_ns,
        feedback=_mask(c.bus.inputs, "brake_released"),
        feedback_ns=feedback_ns,
        frees=b.power == "frees",
        at_rest=b.at_rest,
    )


def board_of(c: Config) -> Board:
    """The software rig's nodes of inputs and outputs."""
    p, b, inputs = c.plant, brake_of(c), c.bus.inputs
    if not inputs and not c.bus.outputs:
        return Board()
    return Board(
        inputs=sum(_mask(inputs, name) for name, on in ({"enable": True} | p.inputs).items() if on),
        period_s=p.input_period_ms * 1e-3,
        timeout_s=p.output_timeout_ms * 1e-3,
        brake=_mask(c.bus.outputs, "brake"),
        feedback=b.feedback,
        frees=b.frees,
        release_s=b.release_ns * 1e-9,
        engage_s=b.engage_ns * 1e-9,
    )
