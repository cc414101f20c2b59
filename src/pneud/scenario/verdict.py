"""A scenario's run against what was expected of it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

from pneud.config.models import Config
from pneud.config.sections import ConfigError
from pneud.safety.faults import FAULT_NAMES, STOPS, names
from pneud.safety.supervisor import is_engaged
from pneud.signals import State, Tick

if TYPE_CHECKING:
    from pneud.scenario.format import Expect, Scenario


class Observed(NamedTuple):
    """What the axis has shown until its run was told to end."""

    present: int = 0  # bits of the fault table, ever
    latched: int = 0
    state: int = int(State.STARTING)  # the last one
    engaged: bool = False  # ever

    def then(self, tick: Tick) -> Observed:
        """After one more tick."""
        return Observed(
            self.present | tick.present,
            self.latched | tick.latched,
            tick.state,
            self.engaged or is_engaged(tick.state),
        )


def check_names(scenario: Scenario) -> None:
    """Make sure that the faults a scenario names stand in the table.

    Raises:
        ConfigError: one does not.
    """
    for name in (*scenario.expect.faults, *scenario.expect.also):
        if name not in FAULT_NAMES:
            raise ConfigError(f"scenario {scenario.name}: expect: {name!r} is no fault of the table")


def allowed_ticks(expect: Expect, config: Config) -> int | None:
    """How many ticks there may be from the evidence to 0 V, both ends included; None: within_ms counts."""
    rate = 1e-3 * config.loop.rate_hz
    if expect.within_ms is not None:
        return None
    if expect.after == "sensor_timeout":
        return math.ceil(config.bus.sensor_timeout_ms * rate) + 1
    if expect.after == "valve_timeout":
        # then its next status tells, and that takes no longer than other evidence
        return math.ceil(config.bus.valve_timeout_ms * rate) + expect.within_ticks
    return expect.within_ticks


def judge(scenario: Scenario, config: Config, seen: Observed, effects: dict[str, Any]) -> dict[str, Any]:
    """What came of a scenario, for JSON: `met`, and in `problems` why not."""
    expect = scenario.expect
    problems = [] if effects["onset"] else ["the fault never began"]
    shown = names(seen.present | seen.latched)
    lacking = [name for name in expect.faults if name not in shown]
    if lacking:
        problems.append(f"no {', '.join(lacking)}")
    unexpected = [name for name in names(seen.latched) if name not in (*expect.faults, *expect.also)]
    if unexpected:
        problems.append(f"unexpected {', '.join(unexpected)}")
    limit = allowed_ticks(expect, config)
    if expect.reaction == "centre":
        problems += _centred(expect, seen, effects, limit)
    elif expect.reaction == "stop":
        problems += [] if seen.latched & STOPS and seen.state == State.FAULT else ["no controlled stop"]
    elif expect.reaction == "no_arm":
        problems += ["it armed"] if seen.engaged else []
    else:
        problems += [] if is_engaged(seen.state) else [f"ended {State(seen.state).label}, not engaged"]
    if expect.reaction != "centre":  # the end of the run centres, too
        effects = effects | dict.fromkeys(("centred_ms", "ticks", "onset_ticks", "travel_mm"))
        limit = None
    return {
        "name": scenario.name,
        "met": not problems,
        "problems": problems,
        "reaction": expect.reaction,
        "faults": [n for n in shown if n in expect.faults or n in names(seen.latched)],
        "allowed_ticks": limit,
        **effects,
    }


def _centred(expect: Expect, seen: Observed, effects: dict[str, Any], limit: int | None) -> list[str]:
    problems = []
    if seen.state != State.FAULT:
        problems.append(f"ended {State(seen.state).label}, not in fault")
    if effects["centred_ms"] is None:
        return [*problems, "no 0 V on the bus"]
    if limit is None:
        assert expect.within_ms is not None
        if effects["centred_ms"] > expect.within_ms:
            problems.append(f"0 V after {effects['centred_ms']:.1f} ms, not {expect.within_ms:g}")
    elif effects["ticks"] is None:
        problems.append("0 V before there was evidence")
    elif effects["ticks"] > limit:
        problems.append(f"0 V in tick {effects['ticks']} of the evidence, not {limit}")
    if effects["travel_mm"] > expect.travel_mm:
        problems.append(f"{effects['travel_mm']:.1f} mm of travel, not {expect.travel_mm:g}")
    if effects["impact_m_s"] > expect.impact_m_s:
        problems.append(f"met an end stop at {effects['impact_m_s']:.2f} m/s, not {expect.impact_m_s:g}")
    return problems


def in_words(result: dict[str, Any]) -> str:
    """One line for people."""
    if not result["met"]:
        return f"scenario {result['name']}: not as expected: {'; '.join(result['problems'])}"
    words = f"scenario {result['name']}: {result['reaction']} as expected"
    if result["faults"]:
        words += f" ({', '.join(result['faults'])})"
    if result["reaction"] == "centre":
        words += (
            f", 0 V {result['centred_ms']:.1f} ms after the fault; {result['travel_mm']:.1f} mm of travel,"
            f" {result['peak_bar']:.2f} bar at most"
        )
    return words
