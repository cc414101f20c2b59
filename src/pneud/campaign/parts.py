"""What a run does, part after part, and the figures that each part comes to."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter

from pneud.config.sections import NonNegative, Positive, Section

FIGURES = ("rms_m", "max_m", "chatter_v", "saturated", "air_nl")
"""Of every part: error, mean |Δu|, share of ticks at the greatest command, normal litres from the supply."""
SETTLES, OVERSHOOTS, ARRIVES = "settled_s", "overshoot_m", "in_position_s"
WORDS = ("state", "faults")
WHOLE = (*WORDS, "frames_lost")  # of an axis, beside its parts
OF_SCENARIO = ("as_expected",)
Longest = Annotated[float, Field(gt=0, le=1e5)]


class SinePart(Section):
    """The configured reference is joined and followed."""

    do: Literal["sine"]
    name: str = ""
    seconds: Longest = 10.0
    learn_s: NonNegative = 5.0  # behind the joining, before errors count


class RestPart(Section):
    """The load comes to rest at the centre of the sine, or stays where it stands."""

    do: Literal["rest"]
    name: str = ""
    seconds: Longest = 5.0
    settle_s: NonNegative = 2.0  # at rest, before errors count


class MovePart(Section):
    """A way to a position, or by so much."""

    do: Literal["move"]
    name: str = ""
    to_mm: float | None = None
    by_mm: float | None = None
    seconds: Longest = 1.5  # behind the way


class PushPart(Section):
    """A force that comes and goes while the load stands."""

    do: Literal["push"]
    name: str = ""
    force_n: float  # against positive motion
    seconds: Longest = 1.5
    back_s: Positive = 1.5  # without it again


AnyPart = Annotated[SinePart | RestPart | MovePart | PushPart, Field(discriminator="do")]
Parts = tuple[SinePart | RestPart | MovePart | PushPart, ...]
_PARTS: TypeAdapter[Parts] = TypeAdapter(tuple[AnyPart, ...])
USUAL: tuple[dict[str, Any], ...] = ({"do": "sine"},)


def parts_of(play: Any) -> Parts:
    """The parts of plain tables, each with a name of its own.

    Raises:
        pydantic.ValidationError: they are none.
        ValueError: one cannot follow the other; the text is one line for a person.
    """
    parts = named(_PARTS.validate_python(play))
    if why := wrong_order(parts):
        raise ValueError(why)
    return parts


def named(parts: Parts) -> Parts:
    """Those without a name have that of what they do, with a number from the second one on."""
    found: list[Any] = []
    for part in parts:
        name = part.name or part.do
        taken = {one.name for one in found}
        number = 2
        while name in taken:
            name, number = f"{part.name or part.do}_{number}", number + 1
        found.append(part.model_copy(update={"name": name}))
    return tuple(found)


def wrong_order(parts: Parts) -> str:
    """Why one part cannot follow the other, or cannot be done; "" where all can."""
    before = None
    for number, part in enumerate(parts, 1):
        if isinstance(part, MovePart) and (part.to_mm is None) == (part.by_mm is None):
            return f"part {number}: a move goes to_mm or by_mm, one of both"
        if before == "sine" and part.do in ("sine", "push"):
            return f"part {number}: behind a sine a rest or a move has to come before a {part.do}"
        if part.do == "sine" and part.learn_s >= part.seconds:
            return f"part {number}: learn_s = {part.learn_s:g} leaves nothing of {part.seconds:g} s to judge"
        if part.do == "rest" and part.settle_s >= part.seconds:
            return (
                f"part {number}: settle_s = {part.settle_s:g} leaves nothing of {part.seconds:g} s to judge"
            )
        before = part.do
    return "" if parts else "nothing is played"


def columns_of(parts: Parts, whole_axis: bool, scenario: bool) -> dict[str, type]:
    """The figures of a run by their columns, in order, and what kind of value each is."""
    found: dict[str, type] = {}
    for part in parts:
        own = [*FIGURES]
        if part.do in ("move", "push"):
            own.append(SETTLES)
        if part.do == "move":
            own += [OVERSHOOTS, ARRIVES] if whole_axis else [OVERSHOOTS]
        found |= {f"{part.name}_{figure}": float for figure in own}
    if whole_axis:
        found |= {name: str if name in WORDS else int for name in WHOLE}
    if scenario:
        found |= dict.fromkeys(OF_SCENARIO, int)
    return found


def finite(value: float) -> float | None:
    """A figure, or None where it has none, such as a time that never comes."""
    return value if math.isfinite(value) else None
