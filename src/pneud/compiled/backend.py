"""How an axis is computed: by the functions as they are, or by their compiled versions.

The axis itself stays as it is: the compiled one has a compiled cycle. A tick of which C cannot do all, such
as one with a request, is done whole by the Python function.
"""

import hashlib
import os
import random
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from pneud.axis.cycle import Axis, cycle
from pneud.axis.state import AxisParameters, AxisState
from pneud.bus import wire
from pneud.compiled import slow
from pneud.log.live import packing
from pneud.rig import dynamics
from pneud.rt.folders import cache_folder
from pneud.signals import ALL_SOURCES, EncoderStatus, Measurement, Request, RequestKind, State, ValveState
from pure2c import BuildError, compile_functions, load_source
from pure2c.cache import Cache

FUNCTIONS: tuple[Callable[..., Any], ...] = (cycle, dynamics.advance)
SAMPLE_TICKS = 100
_NOTES = 64  # axes and libraries whose comparison stays known
_NOISE_PA = 2e4  # so that the command goes from end to end


class Backend(NamedTuple):
    """How axis and plant are computed, frames carried and records handed over."""

    axis: Callable[[AxisParameters], Axis]
    advance: Callable[..., dynamics.PlantState]
    carriage: wire.Carriage
    pack: packing.Pack | None
    name: str  # for the log
    reason: str = ""  # why it is not the compiled one
    identity: bytes = b""  # of the compiled functions


INTERPRETED = Backend(Axis, dynamics.advance, wire.CARRIAGE, None, "python")


def backend(mode: str, p: AxisParameters) -> Backend:
    """In C where that can be had, else in Python, which is said once.

    Args:
        mode: "off", "auto" or "required".
        p: the axis; a sample of its ticks must come out the same to the bit. What has come out the same is
            noted, and taken for granted as long as library, axis and C library are the same.

    Raises:
        BuildError: it is required and cannot be had.
    """
    if mode == "off":
        return INTERPRETED
    try:
        made = compiled()
        _compare(made, p)
    except BuildError as e:
        if mode == "required":
            raise BuildError(f"loop.compiled: {e}") from None
        slow.say("the law", str(e))
        return INTERPRETED._replace(reason=str(e))
    return made


def _compare(made: Backend, p: AxisParameters) -> None:
    """Refuse a compiled law that does not compute what Python does.

    Raises:
        BuildError: it does not.
    """
    libc = os.confstr("CS_GNU_LIBC_VERSION")
    note = hashlib.sha256(repr((made.identity, p, libc)).encode()).hexdigest()
    with suppress(OSError), Cache(cache_folder("compared"), keep=_NOTES) as notes:
        if notes.get(note) is not None:
            return
    if sample(made, p) != sample(INTERPRETED, p):
        raise BuildError("the compiled law does not compute what Python does")
    with suppress(OSError), Cache(cache_folder("compared"), keep=_NOTES) as notes:
        notes.put(note, b"")


def compiled() -> Backend:
    """In C, built if need be.

    Raises:
        BuildError: it cannot be had.
    """
    try:
        cache = cache_folder("compiled")
    except OSError as e:
        raise BuildError(str(e)) from None
    return built(cache)


def lacking() -> str:
    """Why it cannot be had, and the cure; empty where it can."""
    try:
        compiled()
    except BuildError as e:
        return str(e)
    return ""


@lru_cache(maxsize=1)
def built(cache: Path) -> Backend:
    """In C, of a cache; what this process has loaded stays."""
    made = compile_functions(FUNCTIONS, cache=cache, holding=True)
    kept, advance = made.functions
    frames = load_source(wire.SOURCE, cache=cache)
    parts: dict[str, Callable[..., Any]] = {"_cycle": kept, "_whole": whole, "_rehearsal": made.rehearsals[0]}
    methods = {name: staticmethod(part) for name, part in parts.items()}
    return Backend(
        type("CompiledAxis", (Axis,), methods),
        advance,
        wire.Carriage(frames.receive, frames.send),
        load_source(packing.SOURCE, cache=cache).pack,
        "compiled",
        identity=made.identity,
    )


def whole(state: Any) -> AxisState:
    """The state that the compiled function has left in C, or that it was given."""
    made: AxisState = state if isinstance(state, AxisState) else state.whole()
    return made


def sample(one: Backend, p: AxisParameters) -> list[str]:
    """What an axis makes of a made-up run, to the last digit: every tick, and the state after every tenth.

    What differs in a state shows in a tick, or is still there after the tenth. The axis starts, arms, and
    tracks for half of the time, in noise, a load that does not come.
    """
    axis = one.axis(p)
    noise = random.Random(1).uniform
    c, limits = p.controller.cylinder, p.limits
    centre_m = 0.5 * (limits.travel_min_m + limits.travel_max_m)
    p2_pa = 0.5 * p.controller.gas.supply_pa
    p1_pa = (p2_pa * c.A2 + c.rod_force_n) / c.A1
    period_ns = round(p.controller.h * 1e9)
    applied_v, found = 0.0, []
    for i in range(SAMPLE_TICKS):
        m = Measurement(
            (i + 1) * period_ns,
            ALL_SOURCES,
            centre_m + 1e-6 * round(noise(-2.0, 2.0)),
            p1_pa + noise(-_NOISE_PA, _NOISE_PA),
            p2_pa + noise(-_NOISE_PA, _NOISE_PA),
            p.controller.gas.supply_pa,
            applied_v,
            int(EncoderStatus.REFERENCED),
            int(ValveState.ENABLED if axis.state.supervisor.state == State.TRACKING else ValveState.CENTRED),
            *(0, 0, 0, 0, 0, 0, 0, 0, 0),
        )
        arm = Request(RequestKind.ARM, (1.0,)) if axis.state.supervisor.state == State.DISARMED else None
        tick = axis.cycle(m, arm, m.t_ns)
        applied_v = tick.command.voltage_v
        found.append(repr((tick, axis.state) if i % 10 == 9 else tick))
    return found
