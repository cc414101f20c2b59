"""The whole of a commissioning: movement test, steps, estimates, gains, what is written, and verification."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from pneud.axis.state import AxisParameters
from pneud.config import conversions
from pneud.config.models import Config
from pneud.loading import Loaded
from pneud.log.files.naming import LogError
from pneud.loop.summary import finite
from pneud.signals import Record, Request
from pneud.study.commissioning.bench import Bench
from pneud.study.commissioning.movement import MOVE_M, SPEED_M_S, Finding, Verdict
from pneud.study.commissioning.testing import MovementTest

if TYPE_CHECKING:  # the movement test alone goes without scipy
    from pneud.study.commissioning.estimated import Values
    from pneud.study.commissioning.found import Found
    from pneud.study.commissioning.playing import Played
    from pneud.study.commissioning.steps import Step
    from pneud.study.commissioning.trying import Attempt
    from pneud.study.commissioning.verification import Verified
    from pneud.study.commissioning.written import Change

LOOP = {"tracking_error", "braking_distance", "overspeed"}  # faults of a loop whose valve is another
AXIS_S, VERIFYING_S = 300.0, 60.0  # of motion in all, at most; what a verification takes of it, about
MOST_TRIES = 4  # of gains on the rig
GENTLER = (0.5, 0.25)  # of limits.motion, where a loop with what is believed so far cannot follow
SHORT = 3  # motions of the verification that are tried beforehand: a sine, and rest
SLOWER = 0.2  # of limits.motion, where nothing has been found out about quick motion
SLOW_ONLY = (
    "nothing is found out about quick motion; mass, flow and friction are hardly told, gains stay,"
    f" and limits.motion become {SLOWER:g} of what they are"
)
NO_BETTER = "nothing that was tried is better than what was there before, which the configuration has again"


class Wishes(NamedTuple):
    """How a commissioning is to be done."""

    movement: bool = True  # the movement test; it has been passed where not
    steps: bool = True  # more than that
    dynamic: bool = True  # quick motion, too
    write: bool = True


class Talk(Protocol):
    """The person who looks on."""

    def say(self, words: str) -> None:
        """Tell of what is done."""

    def agreed(self, changes: list[Change]) -> bool:
        """Ask whether the configuration is to be written."""


class Outcome(NamedTuple):
    """What a commissioning has come to."""

    verdict: str
    movement: Verdict | None = None
    failure: str = ""  # what ended it
    faults: tuple[str, ...] = ()
    found: Found | None = None
    before: Verified | None = None
    after: Verified | None = None
    written: bool = False
    tried: tuple[Attempt, ...] = ()  # what was put to use, and verified, in this order
    axis_s: float = 0.0  # how long the axis was at work

    @property
    def warnings(self) -> list[str]:
        """What is to be minded."""
        slow_only = self.found is not None and self.found.chosen is None
        cautions = [] if self.found is None else self.found.cautions
        return [SLOW_ONLY] * slow_only + [NO_BETTER] * (self.verdict == "worse") + cautions

    @property
    def good(self) -> bool:
        """All that was to be done has been, and holds."""
        return self.verdict in ("passed", "identified")


def commission(bench: Bench, wishes: Wishes, talk: Talk) -> Outcome:
    """From the movement test to an axis that works; where it does not come to its end, all is as it was.

    Raises:
        LogError: the steps have left too little in the log.
        ConfigError: what has been found makes no configuration.
        OSError: a file cannot be written.
    """
    before, whole = bench.loaded.text, False
    try:
        outcome = _commissioned(bench, wishes, talk)
        whole = outcome.verdict != "interrupted"
        return outcome._replace(axis_s=bench.axis_s)
    finally:
        if not whole and bench.loaded.text != before:
            left = bench.put_back(before)
            talk.say("; ".join(["the configuration is as it was", *([left] if left else [])]))


def _commissioned(bench: Bench, wishes: Wishes, talk: Talk) -> Outcome:
    movement: Verdict | None = None
    if wishes.movement:
        movement = _movement(bench)
        if wishes.write and not movement.unfinished:
            bench.prove(movement)
        # a valve that is open at 0 V hides how the rig is wired, which no simulation can get wrong
        goes_on = wishes.steps and bench.tries and movement.findings == (Finding.OPEN_AT_REST,)
        if not movement.passed and not goes_on:
            return Outcome("failed", movement, faults=movement.faults)
    if not wishes.steps:
        return Outcome("passed", movement)
    played = _stepped(bench, wishes, talk)
    if not played.whole:
        return Outcome("interrupted", movement, played.failure, played.faults)
    before = _verified(bench, talk, SHORT) if wishes.dynamic else None
    if before is not None and before.failure and not _of_the_loop(before.faults):
        return Outcome("interrupted", movement, before.failure, before.faults)
    talk.say("estimates and gains")
    found = _found(bench, wishes)
    so_far = Outcome("identified", movement, found=found, before=before)
    keep = wishes.write and talk.agreed(found.changes)
    if not keep and not bench.tries:
        return so_far
    return _settled(bench, so_far, keep, talk)


def _settled(bench: Bench, so_far: Outcome, keep: bool, talk: Talk) -> Outcome:
    """With the gains that have proven best on the rig; as it was before, where none is better than that."""
    from pneud.study.commissioning import trying  # noqa: PLC0415

    assert so_far.found is not None
    text = bench.loaded.text
    tried = _tried(bench, so_far.found, keep, talk)
    best = tried[-1]
    if not best.after.failure or _of_the_loop(best.after.faults):
        best = min(tried, key=lambda one: one.rank)
        worse = trying.is_worse(best.after, so_far.before)
        words = "worse" if worse else "passed" if best.after.holds else "missed"
        if worse or best is not tried[-1]:
            bench.adopt(text if worse else best.found.text, keep)
    else:
        words = "interrupted"
    return so_far._replace(
        verdict=words, found=best.found, after=best.after, failure=best.after.failure,
        faults=best.after.faults, written=keep and words in ("passed", "missed"), tried=tuple(tried),
    )  # fmt: skip


def _tried(bench: Bench, found: Found, keep: bool, talk: Talk) -> list[Attempt]:
    """Gains put to use and verified: slower ones, as long as something is missed and that helps."""
    from pneud.study.commissioning import gains  # noqa: PLC0415
    from pneud.study.commissioning.trying import Attempt  # noqa: PLC0415

    tried: list[Attempt] = []
    while True:
        bench.adopt(found.text, keep)
        tried.append(Attempt(found, _verified(bench, talk)))
        after, chosen = tried[-1].after, found.chosen
        if after.holds or (after.failure and not _of_the_loop(after.faults)):
            return tried
        helps = all(one.after.failure for one in tried[:-1]) or tried[-1].rank < tried[-2].rank
        time_left = len(tried) < MOST_TRIES and bench.axis_s + VERIFYING_S <= AXIS_S
        slower = gains.slower(found.believed, chosen) if chosen and helps and time_left else None
        if slower is None:
            return tried
        talk.say(f"that is beyond its limits; slower gains, for {slower.bandwidth_rad_s:.4g} rad/s")
        found = found._replace(chosen=slower)


def _of_the_loop(faults: tuple[str, ...]) -> bool:
    """Whether no more than a loop that believes in another rig explains what has ended a motion."""
    return bool(faults) and LOOP.issuperset(faults)


def planned(loaded: Loaded, wishes: Wishes) -> list[str]:
    """What will move, how far and how fast: a line for each step."""
    p, lines = axis_of(loaded), []
    if wishes.movement:
        words = "the load is pushed both ways, and moves some"
        lines.append(f"movement test: {words} {1e3 * MOVE_M:g} mm at {1e3 * SPEED_M_S:g} mm/s at most")
    if wishes.steps:
        from pneud.study.commissioning.steps import first  # noqa: PLC0415

        lines += map(_announced, [*first(p), *_steps(p, wishes)])
        lines += [] if wishes.dynamic else [f"warning: {SLOW_ONLY}"]
        again = "; again with slower gains, where it is not within its limits" if wishes.dynamic else ""
        lines.append(f"verification: a sine, rest and steps about the middle of the travel{again}")
    return lines


def _steps(p: AxisParameters, wishes: Wishes) -> list[Step]:
    from pneud.study.commissioning.steps import dynamic, static  # noqa: PLC0415

    return static(p) + (dynamic(p) if wishes.dynamic else [])


def axis_of(loaded: Loaded) -> AxisParameters:
    """The axis of a configuration."""
    return conversions.axis_of(loaded.config, loaded.codecs.command_lsb_v)


def _stepped(bench: Bench, wishes: Wishes, talk: Talk) -> Played:
    """All steps: once the valve's edges are known, and again where a loop could not be closed.

    With other edges, if these explain it, and otherwise more slowly, from the step on that has not come to
    its end.
    """
    from pneud.study.commissioning.steps import dynamic, first, gentler  # noqa: PLC0415

    played = _played(bench, first(axis_of(bench.loaded)), talk)
    if played.whole:
        _learnt_edges(bench, wishes, talk)
        played = _played(bench, _steps(axis_of(bench.loaded), wishes), talk)
    if _of_the_loop(played.faults):
        talk.say("the loop could not be closed: the valve's edges, from what has been seen so far")
        if _learnt_edges(bench, wishes, talk):
            played = _played(bench, _steps(axis_of(bench.loaded), wishes), talk)
    for share in GENTLER if wishes.dynamic else ():
        p = axis_of(bench.loaded)
        steps = dynamic(p._replace(motion=gentler(p.motion, share)))
        if _of_the_loop(played.faults) and played.left <= len(steps):
            talk.say(f"the loop could not follow; more slowly, by {share:g} of limits.motion")
            played = _played(bench, steps[-played.left :], talk)
    return played


def _played(bench: Bench, steps: list[Step], talk: Talk) -> Played:
    from pneud.study.commissioning.playing import Played, Player  # noqa: PLC0415
    from pneud.study.commissioning.steps import length_s  # noqa: PLC0415

    talk.say(f"{len(steps)} steps, {length_s(steps):.0f} s")
    begun: list[Step] = []

    def announce(step: Step) -> None:
        begun.append(step)
        talk.say(_announced(step))

    player = Player(steps, axis_of(bench.loaded).controller.h, announce)
    bench.play(player)
    played = player.verdict or Played("it has not come to its end")
    return played if played.whole else played._replace(left=len(steps) - max(0, len(begun) - 1))


class _Tested:
    """The movement test, which looks at ticks alone."""

    def __init__(self, p: AxisParameters) -> None:
        self._test = MovementTest(p)

    @property
    def verdict(self) -> Verdict | None:
        return self._test.verdict

    def ask(self, state: int, present: int) -> Request | None:
        return self._test.ask(state, present)

    def see(self, record: Record) -> None:
        self._test.see(record.tick)


def _movement(bench: Bench) -> Verdict:
    test = _Tested(axis_of(bench.loaded))
    bench.play(test)
    return test.verdict or Verdict((Finding.UNDECIDED,))


def _announced(step: Step) -> str:
    return f"{step.name}: {step.words}, {step.seconds:.0f} s"


def _found(bench: Bench, wishes: Wishes) -> Found:
    from pneud.study.commissioning import estimated, gains  # noqa: PLC0415
    from pneud.study.commissioning.found import Found  # noqa: PLC0415
    from pneud.study.identification import estimating, explaining, table  # noqa: PLC0415

    loaded, c = bench.loaded, bench.loaded.config
    measured, _ = table.read(bench.logs())
    identified = estimating.identify(measured, c)
    told, step_m = identified.parameters, estimated.encoder_step_m(measured)
    values = estimated.believed(told, step_m, c)
    values |= _in_place(values, c)
    believed = estimated.changed(c, values)
    slips = identified.moved is not None and identified.moved.slips
    values |= estimated.rig(told, step_m, identified.noise_pa, believed, slips)
    values |= {} if wishes.dynamic else _slower(c)
    believed = estimated.changed(c, values)
    chosen = None
    if wishes.dynamic:
        chosen = gains.choose(believed, told, loaded.codecs.command_lsb_v, moved=identified.moved)
    odd = explaining.unexplained(identified.valved, identified.moved, identified.noise_pa, c)
    return Found(identified, values, believed, chosen, loaded, _source(bench), odd)


def _learnt_edges(bench: Bench, wishes: Wishes, talk: Talk) -> bool:
    """Put the valve's edges to use, where they lie elsewhere than configured; whether that was done."""
    from pneud.study.commissioning import written  # noqa: PLC0415
    from pneud.study.identification import comparing, ramps, table  # noqa: PLC0415
    from pneud.study.identification import parameters as key  # noqa: PLC0415

    loaded, c = bench.loaded, bench.loaded.config
    try:
        edges = ramps.edges(table.read(bench.logs())[0], c)
    except LogError:  # too little in them
        return False
    off = any(row.verdict == comparing.OFF for row in comparing.rows(edges, {}))
    if c.valve.map or len(edges) < 2 or not off:
        return False
    values = {key.HALF: max(edges[key.HALF].value, 0.0), key.CENTRE: edges[key.CENTRE].value}
    changes = written.changes(c, loaded.text, values, edges)
    if not bench.tries and not (wishes.write and talk.agreed(changes)):
        return False
    bench.adopt(_text_with(changes, bench), not bench.tries)
    return True


def _text_with(changes: list[Change], bench: Bench) -> str:
    """The configuration's text with changes, each with where it is from."""
    from pneud.study.commissioning import written  # noqa: PLC0415

    return written.text_with(bench.loaded.text, str(bench.loaded.path), changes, _source(bench))


def _source(bench: Bench) -> str:
    """Where values are from that are found now."""
    return f"{bench.log_name}, {time.strftime('%Y-%m-%d')}"


def _in_place(values: Values, c: Config) -> Values:
    """Places in the paper's coordinate, which begins with the dead length, stay where they are."""
    by_m = values.get("cylinder.dead_length_1_m", c.cylinder.dead_length_1_m) - c.cylinder.dead_length_1_m
    return {
        "reference.effective_centre_m": round(c.reference.effective_centre_m + by_m, 7),
        "plant.initial_x1_m": round(c.plant.initial_x1_m + by_m, 7),
    }


def _slower(c: Config) -> Values:
    """Limits of motion for an axis of which only slow motion is known."""
    return {f"limits.motion.{name}": SLOWER * getattr(c.limits.motion, name) for name in _BOUNDS}


_BOUNDS = ("speed_m_s", "acceleration_m_s2", "jerk_m_s3")


def _verified(bench: Bench, talk: Talk, most: int | None = None) -> Verified:
    """What the axis is worth, by all motions or the first ones."""
    from pneud.study.commissioning.verification import Verification, Verified, course  # noqa: PLC0415
    from pneud.study.judging import tolerances  # noqa: PLC0415

    p, c = axis_of(bench.loaded), bench.loaded.config
    parts = course(p, c.cylinder.stroke_m)[:most]
    talk.say(f"verification: {'; '.join(part.words for part in parts if part.name)}")
    check = Verification(p, parts, tolerances(c.control.motion.encoder_resolution_m))
    bench.play(check)
    return check.verdict or Verified((), "it has not come to its end")


def as_json(o: Outcome) -> dict[str, Any]:
    """For scripts."""
    found = o.found
    parameters = {} if found is None else found.identified.parameters
    return {
        "schema": 1,
        "verdict": o.verdict,
        "parameters": {name: finite(e._asdict()) for name, e in parameters.items()},
        "changes": [] if found is None else [finite(c._asdict()) for c in found.changes],
        "gains": None if found is None or found.chosen is None else found.chosen.as_json(),
        "before": {} if o.before is None else o.before.as_json(),
        "after": {} if o.after is None else o.after.as_json(),
        "tried": [one.as_json() for one in o.tried],
        "axis_s": o.axis_s,
        "notes": [] if found is None else found.identified.notes,
        "unexplained": [] if found is None else found.unexplained,
        "warnings": o.warnings,
        "failure": o.failure or None,
        "faults": list(o.faults),
        "written": o.written,
    }
