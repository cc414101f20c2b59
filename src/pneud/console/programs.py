"""Programs from their files: checked whole, and made into the steps that an axis goes through.

What a program says is checked before anything moves: fields, labels, loops that never end, records that are
never reached, positions, speeds, and where relative ways lead.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pneud.config.conversions import expected_of, pressing_of
from pneud.config.models import Config
from pneud.config.station import OUTPUT_ROLES
from pneud.config.toml import TomlError, flat, tables_of
from pneud.console import records
from pneud.console.records import CLASSES, CODES, DEFAULTS, EXACT, FAST, START, TOP, ProgramError, told
from pneud.control import program
from pneud.control.program import Program, Step
from pneud.control.reference import Bounds
from pneud.signals import Request, RequestKind

_MM = 1e-3
FAR = 1e9  # stands for no bound
MOTION_TIMEOUT_S = 60.0  # that a motion has, unless it says otherwise
FAST_TOLERANCE = 10.0  # times the tolerance of a load in position
_BOUNDS = (
    *(("above_mm", "above", "mm"), ("below_mm", "below", "mm")),
    *(("above_n", "above", "N"), ("below_n", "below", "N")),
)
MOST_WALKED = 20_000  # steps that are gone through to see where relative ways lead
ROUNDING_M = 1e-9
EMPTY = Request(RequestKind.RECORD)  # takes the program of an axis away


class AxisFacts(NamedTuple):
    """What a program has to know of an axis."""

    name: str
    low_m: float  # positions that may be asked for
    high_m: float
    bounds: Bounds
    tolerance_m: float  # of a load in position
    velocity_m_s: float
    time_s: float
    inputs: tuple[str, ...] = ()  # by their bits
    outputs: tuple[str, ...] = ()
    out_n: float = 0.0  # greatest force of the piston outwards; 0 for one that is not pressed
    in_n: float = 0.0  # and inwards
    press_m_s: float = FAR  # the fastest that a load may be let to press


class Compiled(NamedTuple):
    """A program that may be run."""

    name: str
    records: tuple[dict[str, Any], ...]  # as the file has them, points in numbers
    axes: tuple[str, ...]
    steps: tuple[Program, ...]  # of each axis; all are as long

    @property
    def words(self) -> tuple[str, ...]:
        """What each record does, for people."""
        return tuple(map(in_words, self.records))


def facts_of(c: Config) -> AxisFacts:
    """What a program has to know of a configured axis."""
    limits, way, expected, pressing = c.limits, c.limits.motion, expected_of(c), pressing_of(c)
    alone = c.reference.follow is None or c.reference.follow.skew_m is None
    return AxisFacts(
        c.name,
        max(limits.travel_min_m, 0.0) + way.margin_m,
        min(limits.travel_max_m, c.cylinder.stroke_m) - way.margin_m,
        Bounds(min(way.speed_m_s, limits.speed_m_s), way.acceleration_m_s2, way.jerk_m_s3),
        expected.tolerance_m,
        expected.velocity_m_s,
        c.in_position.time_s,
        tuple(c.bus.inputs),
        tuple(c.bus.outputs),
        out_n=pressing.out_n if alone else 0.0,
        in_n=pressing.in_n if alone else 0.0,
        press_m_s=limits.speed_m_s,
    )


def compiled(tree: Mapping[str, Any], axes: Sequence[AxisFacts]) -> Compiled:
    """The steps of a program.

    Args:
        tree: tables as in the file, points as a table.
        axes: that it is for.

    Raises:
        ProgramError: it cannot be used.
    """
    unknown = [key for key in tree if key not in TOP]
    if unknown:
        raise ProgramError(f"a program has no {unknown[0]!r}; it takes {', '.join(TOP)}")
    if tree.get("schema") != records.SCHEMA:
        raise ProgramError(f"schema = {records.SCHEMA} has to stand in a program, not {tree.get('schema')!r}")
    name = tree.get("name", "")
    if not isinstance(name, str) or len(name) > 64 or not (name.isprintable() or not name):
        raise ProgramError("name is a text of at most 64 characters")
    listed, points, defaults = tree.get("record", []), tree.get("points", {}), tree.get("defaults", {})
    if not isinstance(listed, list) or not 1 <= len(listed) <= program.MOST_STEPS:
        raise ProgramError(f"a program has 1 to {program.MOST_STEPS} records: [[record]], do = …")
    if not isinstance(points, Mapping) or not isinstance(defaults, Mapping):
        raise ProgramError("points and defaults are tables")
    unknown = [key for key in defaults if key not in DEFAULTS]
    if unknown:
        raise ProgramError(f"defaults: has no {unknown[0]!r}; it takes {', '.join(DEFAULTS)}")
    names = tuple(axis.name for axis in axes)
    found = []
    for place, record in enumerate(listed, start=1):
        found.append(records.checked(place, _with_defaults(record, defaults), points, names))
    labels = _labels(found)
    steps = tuple(_steps(found, labels, axis, axes) for axis in axes)
    _check_ways(found, labels)
    for axis, own_steps in zip(axes, steps, strict=True):
        _check_places(found, own_steps, axis)
    return Compiled(name or "program", tuple(found), names, steps)


def requests(found: Compiled, place: int = 0, *, load: bool = False) -> list[Request]:
    """What hands the steps of an axis over. It is told how many come: none begins before all are there.

    Args:
        found: the program.
        place: of the axis among those of the program.
        load: an input may begin it as soon as it is there.
    """
    steps, whose = found.steps[place], program.ALONE if load else program.WITHHELD
    if len(found.axes) > 1:
        whose = program.SHARED
    return [
        Request(RequestKind.RECORD, (float(len(steps)), whose)),
        *(Request(RequestKind.RECORD, tuple(map(float, step))) for step in steps),
    ]


def named(tree: Mapping[str, Any]) -> set[str]:
    """Names of the axes that a program names, whether they are there or not."""
    found: set[str] = set()
    listed, points = tree.get("record"), tree.get("points")
    for record in listed if isinstance(listed, list) else ():
        if not isinstance(record, Mapping):
            continue
        for value in (record.get("to_mm"), record.get("by_mm")):
            place = points.get(value) if isinstance(points, Mapping) and isinstance(value, str) else value
            found |= {str(name) for name in place} if isinstance(place, Mapping) else set()
        found |= {str(record["axis"])} if "axis" in record else set()
    return found


def _with_defaults(record: Any, defaults: Mapping[str, Any]) -> Any:
    """A motion with what it does not say itself, as far as its class has a use for it."""
    if not isinstance(record, Mapping) or record.get("do") not in ("goto", "move"):
        return record
    kind = record.get("class", defaults.get("class", EXACT))
    useless = {FAST: ("settle_s", "standing_mm_s"), START: ("settle_s", "standing_mm_s", "tolerance_mm")}
    without = useless.get(kind, ()) if isinstance(kind, str) else ()
    return {**{key: value for key, value in defaults.items() if key not in without}, **record}


def begun(found: Compiled, record: int, cycles: int) -> Request:
    """What sets a program going.

    Raises:
        ProgramError: it has no such record.
    """
    if not 1 <= record <= len(found.records):
        raise ProgramError(f"record {record}: {found.name} has {len(found.records)}")
    return Request(RequestKind.RUN, (float(record), float(cycles), float(len(found.axes) > 1)))


def requests_to_begin(found: Compiled, record: int, cycles: int) -> list[list[Request]]:
    """What hands a program over to each of its axes, and sets it going.

    Raises:
        ProgramError: it has no such record.
    """
    last = begun(found, record, cycles)
    return [[*requests(found, place), last] for place in range(len(found.axes))]


def run_in_words(found: Compiled, record: int, cycles: int) -> str:
    """What is done with a program, for the log."""
    words = f"run {found.name}"
    words += f" from record {record}" if record != 1 else ""
    return words + (f", {cycles} times" if cycles > 1 else ", again and again" if cycles == 0 else "")


def _labels(found: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    labels: dict[str, int] = {}
    for place, record in enumerate(found, start=1):
        label = record.get("label")
        if label is None:
            continue
        if label in labels:
            raise ProgramError(f"{told(place, record)}: record {labels[label]} has that label, too")
        labels[label] = place
    return labels


def _goal(place: int, record: Mapping[str, Any], key: str, labels: Mapping[str, int]) -> int:
    label = record.get(key)
    if label is None:
        return 0
    if label not in labels:
        known = f"there is {', '.join(labels)}" if labels else "no record has one"
        raise ProgramError(f"{told(place, record)}: {key}: no label {label!r}; {known}")
    return labels[label]


def _steps(
    found: Sequence[dict[str, Any]], labels: Mapping[str, int], axis: AxisFacts, axes: Sequence[AxisFacts]
) -> Program:
    """What an axis does at each record."""
    steps, mass_kg = [], 0.0
    for place, record in enumerate(found, start=1):
        if len(axes) > 1 and "otherwise" in record:
            raise ProgramError(
                f"{told(place, record)}: otherwise is for one axis; several go through all records together"
            )
        if axis.name not in _whose(place, record, axes):
            steps.append(Step(program.PASS))
            continue
        mass_kg = record.get("mass_kg", mass_kg)
        steps.append(_step(place, record, labels, axis)._replace(mass_kg=mass_kg))
    return tuple(steps)


def _whose(place: int, record: Mapping[str, Any], axes: Sequence[AxisFacts]) -> tuple[str, ...]:
    """Names of the axes that do something at a record."""
    names, do = tuple(axis.name for axis in axes), record["do"]
    goal = record.get("to_mm", record.get("by_mm"))
    if isinstance(goal, Mapping):
        if "axis" in record:
            raise ProgramError(f"{told(place, record)}: names its axes twice; leave out axis")
        return tuple(goal)
    if "axis" in record:
        return (record["axis"],)
    if len(axes) == 1 or do in ("wait", "jump", "repeat"):
        return names
    for key, known in (("input", "inputs"), ("output", "outputs")):
        if key in record:
            return tuple(axis.name for axis in axes if record[key] in getattr(axis, known))[:1] or names[:1]
    raise ProgramError(f"{told(place, record)}: say which axis: axis = {names[0]!r}")


def _step(place: int, record: dict[str, Any], labels: Mapping[str, int], axis: AxisFacts) -> Step:
    where, do = told(place, record), record["do"]
    otherwise = _goal(place, record, "otherwise", labels)
    if otherwise and "timeout_s" not in record and do not in ("goto", "move"):
        raise ProgramError(f"{where}: otherwise is for a record that is late; give timeout_s, too")
    step = Step(CODES[do], timeout_s=record.get("timeout_s", 0.0), otherwise=otherwise)
    if do in ("goto", "move"):
        return _motion(where, record, step, axis)
    if do in ("wait", "track"):
        return step._replace(time_s=record["for_s"])
    if do in ("jump", "repeat"):
        return step._replace(to=_goal(place, record, "to", labels), times=int(record.get("times", 0)))
    if do == "output":
        if record["output"] in OUTPUT_ROLES and record["output"] in axis.outputs:
            raise ProgramError(f"{where}: pneud itself puts out {record['output']!r}; take another output")
        bit = _bit(where, "output", record["output"], axis.outputs)
        return step._replace(bit=bit, on=int(record["on"]))
    if do == "until":
        return _until(where, record, step, axis)
    return _press(where, record, step, axis)


def _motion(where: str, record: Mapping[str, Any], step: Step, axis: AxisFacts) -> Step:
    goal = record.get("to_mm", record.get("by_mm"))
    rates = [record.get(key, 0.0) * _MM for key in ("speed_mm_s", "acceleration_mm_s2", "jerk_mm_s3")]
    for rate, most, key in zip(
        rates, axis.bounds, ("speed_m_s", "acceleration_m_s2", "jerk_m_s3"), strict=True
    ):
        if rate > most:
            raise ProgramError(
                f"{where}: {rate / _MM:g} is more than limits.motion.{key} allows; at most {most / _MM:g}"
            )
    kind = record.get("class", EXACT)
    for key in ("settle_s", "standing_mm_s"):
        if key in record and kind != EXACT:
            raise ProgramError(f"{where}: {key} is for class = {EXACT!r}; this one is {kind!r}")
    if kind == START and "tolerance_mm" in record:
        raise ProgramError(f"{where}: class = {START!r} waits for no tolerance; leave out tolerance_mm")
    usual_m = axis.tolerance_m * (FAST_TOLERANCE if kind == FAST else 1.0)
    return step._replace(
        target_m=(goal[axis.name] if isinstance(goal, Mapping) else goal) * _MM,
        speed_m_s=rates[0],
        acceleration_m_s2=rates[1],
        jerk_m_s3=rates[2],
        ends=CLASSES[kind],
        tolerance_m=record["tolerance_mm"] * _MM if "tolerance_mm" in record else usual_m,
        velocity_m_s=record["standing_mm_s"] * _MM if "standing_mm_s" in record else axis.velocity_m_s,
        time_s=record.get("settle_s", axis.time_s) if kind == EXACT else 0.0,
        timeout_s=record.get("timeout_s", 0.0 if kind == START else MOTION_TIMEOUT_S),
    )


def _until(where: str, record: Mapping[str, Any], step: Step, axis: AxisFacts) -> Step:
    given = [key for key in records.UNTILS if key in record]
    units = {key.rpartition("_")[2] for key in given}
    if len(units) != 1 or ("on" in record and "input" not in record):
        raise ProgramError(
            f"{where}: waits for one thing: above_mm, below_mm; above_n, below_n; or input, on"
        )
    step = step._replace(time_s=record.get("for_s", 0.0))
    if "input" in record:
        bit = _bit(where, "input", record["input"], axis.inputs)
        return step._replace(what=program.INPUT, bit=bit, on=int(record.get("on", True)))
    unit = units.pop()
    scale = _MM if unit == "mm" else 1.0
    low = record[f"above_{unit}"] * scale if f"above_{unit}" in record else -FAR
    high = record[f"below_{unit}"] * scale if f"below_{unit}" in record else FAR
    if low > high:
        raise ProgramError(f"{where}: nothing is above {low / scale:g} and below {high / scale:g}")
    if unit == "mm" and (low > axis.high_m or high < axis.low_m):
        raise ProgramError(
            f"{where}: the axis never comes there; it goes from {axis.low_m / _MM:g} to"
            f" {axis.high_m / _MM:g} mm"
        )
    return step._replace(what=program.POSITION if unit == "mm" else program.THRUST, low=low, high=high)


def _press(where: str, record: Mapping[str, Any], step: Step, axis: AxisFacts) -> Step:
    if axis.out_n == 0.0:
        raise ProgramError(f"{where}: half of a gantry is not pressed; leave the record out")
    if not -axis.in_n <= record["force_n"] <= axis.out_n:
        raise ProgramError(
            f"{where}: {record['force_n']:g} N are more than limits.force and the supply allow,"
            f" {-axis.in_n:.4g} … {axis.out_n:.4g} N"
        )
    if ("low_mm" in record) != ("high_mm" in record):
        raise ProgramError(f"{where}: low_mm and high_mm go together")
    if "low_mm" in record:
        low_m, high_m = record["low_mm"] * _MM, record["high_mm"] * _MM
        if not axis.low_m - ROUNDING_M <= low_m < high_m <= axis.high_m + ROUNDING_M:
            raise ProgramError(
                f"{where}: the window {record['low_mm']:g} … {record['high_mm']:g} mm has to lie within the"
                f" travel {axis.low_m / _MM:g} … {axis.high_m / _MM:g} mm"
            )
    if record.get("speed_mm_s", 0.0) * _MM > axis.press_m_s:
        raise ProgramError(
            f"{where}: {record['speed_mm_s']:g} mm/s is faster than limits.speed_m_s,"
            f" {axis.press_m_s / _MM:g} mm/s"
        )
    return step._replace(
        force_n=record["force_n"],
        rate_n_s=record.get("ramp_n_s", 0.0),
        low_m=record.get("low_mm", 0.0) * _MM,
        high_m=record.get("high_mm", 0.0) * _MM,
        speed_m_s=record.get("speed_mm_s", 0.0) * _MM,
        time_s=record.get("settle_s", 0.0),
    )


def _bit(where: str, what: str, name: str, known: tuple[str, ...]) -> int:
    if name not in known:
        there = (
            f"there is {', '.join(known)}"
            if known
            else f'this axis has no {what}s: bus.{what}s.{name} = "MESSAGE.SIGNAL" makes it one'
        )
        raise ProgramError(f"{where}: no {what} {name!r}; {there}")
    return known.index(name)


def _check_ways(found: Sequence[Mapping[str, Any]], labels: Mapping[str, int]) -> None:
    """Refuse records that are never reached, and loops without end."""
    count = len(found)
    leads: dict[int, set[int]] = {}
    for place, record in enumerate(found, start=1):
        behind = set() if record["do"] == "jump" else {place + 1}
        behind |= {labels[record[key]] for key in ("to", "otherwise") if key in record}
        leads[place] = behind
    reached = _reached({1}, leads)
    lost = next((place for place in leads if place not in reached), 0)
    if lost:
        raise ProgramError(
            f"{told(lost, found[lost - 1])}: is never reached; give it a label that something goes to, or"
            " leave it out"
        )
    back: dict[int, set[int]] = {}
    for place, behind in leads.items():
        for goal in behind:
            back.setdefault(goal, set()).add(place)
    ending = _reached({count + 1}, back)
    if any(place not in ending for place in leads):
        endless = [place for place in leads if place not in ending and place in _reached(leads[place], leads)]
        span = (
            f"records {endless[0]} to {endless[-1]} go" if len(endless) > 1 else f"record {endless[0]} goes"
        )
        raise ProgramError(
            f"{span} round without end; end the loop with do = 'repeat', or the program there and run it"
            " with --cycles 0"
        )


def _reached(first: set[int], leads: Mapping[int, set[int]]) -> set[int]:
    found, left = set(first), list(first)
    while left:
        for goal in leads.get(left.pop(), ()):
            if goal not in found:
                found.add(goal)
                left.append(goal)
    return found


def _check_places(found: Sequence[Mapping[str, Any]], steps: Program, axis: AxisFacts) -> None:
    """Refuse positions that the axis does not go to, also where relative ways lead, two rounds far."""
    for place, step in enumerate(steps, start=1):
        if step.kind == program.GOTO:
            _check_place(told(place, found[place - 1]), step.target_m, axis, "")
    if not any(step.kind == program.MOVE or step.high_m > 0.0 for step in steps):
        return
    at_m: float | None = None
    near_m = FAR  # of that it is by now
    run = program.Run(program.DUE, next=1, laps=2, counts=(0,) * len(steps))
    for _ in range(MOST_WALKED):
        run = program.begins(run, steps)
        if run.stage == program.ENDED:
            return
        step = steps[run.record - 1]
        run = run._replace(stage=program.DUE)
        if step.kind in program.MOTIONS:
            near_m = FAR if step.ends == program.AT_ONCE else step.tolerance_m
        if step.kind == program.GOTO:
            at_m = step.target_m
        elif step.kind in (program.TRACK, program.FORCE):
            if step.high_m > 0.0 and at_m is not None:
                _check_window(told(run.record, found[run.record - 1]), step, at_m, near_m)
            at_m = None
        elif step.kind == program.MOVE and at_m is not None:
            at_m += step.target_m
            words = f" in round {run.lap + 1}" if run.lap else ""
            _check_place(told(run.record, found[run.record - 1]), at_m, axis, words)
        elif step.kind == program.JUMP:
            run = run._replace(next=step.to)
        elif step.kind == program.REPEAT:
            run = program.repeated(run, step)


def _check_place(where: str, to_m: float, axis: AxisFacts, words: str) -> None:
    if axis.low_m - ROUNDING_M <= to_m <= axis.high_m + ROUNDING_M:
        return
    nearest_m = min(max(to_m, axis.low_m), axis.high_m)
    raise ProgramError(
        f"{where}: {to_m / _MM:g} mm{words} lies outside the travel {axis.low_m / _MM:g} …"
        f" {axis.high_m / _MM:g} mm; the nearest allowed is {nearest_m / _MM:g} mm"
    )


def _check_window(where: str, step: Step, at_m: float, near_m: float) -> None:
    if step.low_m - near_m <= at_m <= step.high_m + near_m:
        return
    raise ProgramError(
        f"{where}: the load is at {at_m / _MM:g} mm by then, outside the window {step.low_m / _MM:g} …"
        f" {step.high_m / _MM:g} mm"
    )


def in_words(record: Mapping[str, Any]) -> str:
    """What a record does, for people."""
    do = record["do"]
    whose = f"{record['axis']}: " if "axis" in record else ""
    match do:
        case "goto" | "move":
            goal = record.get("to_mm", record.get("by_mm"))
            places = (
                " ".join(f"{name}={x:g}" for name, x in goal.items())
                if isinstance(goal, Mapping)
                else f"{goal:g}"
            )
            kind = record.get("class", EXACT)
            words = f"{do} {places} mm" + ("" if kind == EXACT else f", {kind}")
        case "track" | "wait":
            words = f"{do} {record['for_s']:g} s"
        case "force":
            words = f"force {record['force_n']:g} N"
        case "jump":
            words = f"jump to {record['to']}"
        case "repeat":
            words = f"repeat from {record['to']}, {record['times']:g} times"
        case "output":
            words = f"output {record['output']} {'on' if record['on'] else 'off'}"
        case _:
            parts = [f"{side} {record[key]:g} {unit}" for key, side, unit in _BOUNDS if key in record]
            if "input" in record:
                parts = [f"{record['input']} {'on' if record.get('on', True) else 'off'}"]
            words = f"until {' and '.join(parts)}"
    return whose + words


def tree_of(path: Path) -> dict[str, Any]:
    """The tables of a program's file, its points among them.

    Args:
        path: of the file; `points = "FILE"` is looked for beside it.

    Raises:
        ProgramError: it cannot be read.
    """
    tree = _read(path)
    points = tree.get("points")
    if isinstance(points, str):
        tree["points"] = _read(path.parent / points)
    return tree


def _read(path: Path) -> dict[str, Any]:
    try:
        tree = tables_of(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as e:
        raise ProgramError(f"{path}: cannot be read: {getattr(e, 'strerror', None) or e}") from None
    except TomlError as e:
        raise ProgramError(f"{path}: {e}") from None
    for key, value in flat(tree).items():
        _check_plain(f"{path}: {key}", value)
    return tree


def _check_plain(what: str, value: Any) -> None:
    """Refuse what TOML has, and no field takes: numbers that are none, and dates."""
    if isinstance(value, list):
        for place, one in enumerate(value, start=1):
            for key, inner in flat(one).items():
                _check_plain(f"{what} {place}{f': {key}' if key else ''}", inner)
    elif not isinstance(value, str | int | float) or (isinstance(value, float) and not math.isfinite(value)):
        raise ProgramError(f"{what} is {value}, neither a number nor a text")
