"""A guess at which signal fills which value of the axis, by units, names and motion; a person steers it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

from pneud.study.mapping.decoding import MOVES, Course

LENGTHS = ("m", "mm", "um", "µm", "μm")
PRESSURES = ("Pa", "hPa", "kPa", "MPa", "mbar", "bar")
VOLTS = ("V", "mV")
COUNTS = 16  # bits that a position without a unit has at the least
TIMES = ("s", "ms", "us", "µs", "μs")
VALUES = (
    *("position_m", "status", "age_s", "p1_pa", "p2_pa", "difference_pa", "supply_pa"),
    *("applied_v", "state", "voltage_v", "enable", "sequence"),
)
_COMMAND = re.compile(r"command|cmd|set.?point|target|demand|soll", re.I)
_SUPPLY = re.compile(r"supply|source|line|rail|^ps$|p_?s(up)?$", re.I)
_CHAMBER_2 = re.compile(r"2|b$|rod", re.I)


class Guess(NamedTuple):
    """What fills the values, and what was doubtful about it."""

    filled: dict[str, str]  # "MESSAGE.SIGNAL" by value
    doubts: list[str]


def guess(courses: Iterable[Course], given: Mapping[str, str]) -> Guess:
    """Fill the values.

    Args:
        courses: what every signal has said.
        given: "MESSAGE.SIGNAL" by value, as a person has it; "none" where the rig has no such signal.
    """
    every = list(courses)
    filled = {value: name for value, name in given.items() if name != "none"}
    doubts: list[str] = []

    def free(units: tuple[str, ...], fits: Callable[[Course], bool] = lambda _: True) -> list[Course]:
        taken = set(filled.values())
        return [c for c in every if (c.signal.unit or "") in units and c.name not in taken and fits(c)]

    def fill(value: str, found: list[Course]) -> list[Course]:
        """Give a value the first one; what is left."""
        if value in given or not found:
            return found
        filled[value] = found[0].name
        return found[1:]

    def command(c: Course) -> bool:
        return c.commanded or bool(_COMMAND.search(c.name))

    positions = sorted(free(LENGTHS, lambda c: not command(c)), key=lambda c: -c.moving)
    if not positions and "position_m" not in given:
        counts = free(("",), lambda c: not command(c) and c.signal.length >= COUNTS and c.moving > MOVES)
        positions = sorted(counts, key=lambda c: -c.moving)[:1]
        doubts += [f"position_m: {c.name} moves and has no unit; give m_per_count" for c in positions]
    fill("position_m", positions)
    if "position_m" not in given and len(positions) > 1:
        doubts.append(f"position_m: {positions[0].name} moves most; {positions[1].name} is a length, too")
    _pressures(sorted(free(PRESSURES), key=lambda c: c.name), fill, doubts)
    fill("voltage_v", sorted(free(VOLTS, command), key=lambda c: "volt" not in c.name.lower()))
    fill("applied_v", free(VOLTS, lambda c: not command(c)))
    for value, beside, pattern, units in (
        ("status", "position_m", "status|flags|valid", ("",)),
        ("age_s", "position_m", "", TIMES),
        ("state", "applied_v", "state|status", ("",)),
        ("enable", "voltage_v", "enable|control|on$", ("",)),
        ("sequence", "voltage_v", "seq", ("",)),
    ):
        message = filled.get(beside, ".").partition(".")[0]
        here = [c for c in free(units) if c.message == message]
        fill(value, [c for c in here if re.search(pattern, c.signal.name, re.I)])
    doubts += [
        f"{value}: nothing found; name it with {option}"
        for value, option in (("position_m", "--position"), ("voltage_v", "--voltage"))
        if value not in filled and value not in given
    ]
    chambers = [value for value in ("p1_pa", "p2_pa", "difference_pa") if value in filled]
    if len(chambers) < 2:
        doubts.append("p1_pa and p2_pa: fewer than two pressures found; name them with --p1 and --p2")
    return Guess({value: filled[value] for value in VALUES if value in filled}, doubts)


def _pressures(
    pressures: list[Course], fill: Callable[[str, list[Course]], list[Course]], doubts: list[str]
) -> None:
    """Supply by its name, or of three the one that moves least; the others in the order of their names."""
    named = [c for c in pressures if _SUPPLY.search(c.signal.name) or _SUPPLY.search(c.message)]
    if not named and len(pressures) > 2:
        named = [min(pressures, key=lambda c: c.moving)]
        doubts.append(f"supply_pa: {named[0].name}, as it moves least")
    fill("supply_pa", named)
    chambers = sorted(
        (c for c in pressures if c not in named[:1]), key=lambda c: bool(_CHAMBER_2.search(c.signal.name))
    )
    fill("p2_pa", fill("p1_pa", chambers))
