"""A scenario's run against what was expected of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from pneud.config.models import Config
from pneud.config.sections import ConfigError
from pneud.loading import Loaded, devices_of
from pneud.safety.faults import FAULT_NAMES, STOPS, names
from pneud.safety.supervisor import is_engaged
from pneud.safety.unnoticed import Unnoticed, unnoticed
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
    """How many ticks there may be from the evidence to 0 V, both ends included; None: within_ms counts.

    Where sensors run free the evidence comes between two ticks, and one more begins before it is looked at.
    """
    rate = 1e-3 * config.loop.rate_hz
    if expect.within_ms is not None:
        return None
    return _ticks(expect, config, rate) + (not config.bus.sync)


def _ticks(expect: Expect, config: Config, rate: float) -> int:
    if expect.after == "sensor_timeout":
        return math.ceil(config.bus.sensor_timeout_ms * rate) + 1
    if expect.after == "valve_timeout":
        # then its next status tells, and that takes no longer than other evidence
        return math.ceil(config.bus.valve_timeout_ms * rate) + expect.within_ticks
    return expect.within_ticks


def blind_spots(axis: Loaded) -> list[Unnoticed]:
    """What the devices of an axis leave unnoticed, for `judge`."""
    return unnoticed(devices_of(axis.config, axis.codecs))


def judge(
    scenario: Scenario,
    config: Config,
    seen: Observed,
    effects: dict[str, Any],
    blind: Sequence[Unnoticed] = (),
) -> dict[str, Any]:
    """What came of a scenario, for JSON: `met`, and in `problems` why not.

    Where devices leave unnoticed what a scenario expects, and nothing is noticed of it, the faults are in
    `unnoticed`, and what is still safe is judged: another fault has taken the axis and it came to rest, or it
    goes on; in neither case has the load met an end stop harder than expected.

    Args:
        scenario: that was played.
        config: of the axis.
        seen: of it.
        effects: of the plant.
        blind: what the devices of the axis leave unnoticed.
    """
    expect = scenario.expect
    problems = [] if effects["onset"] else ["the fault never began"]
    shown = names(seen.present | seen.latched)
    never = [one.name for one in blind if one.wholly and one.name in shown]
    if never:
        problems.append(f"noticed {', '.join(never)}, which is said to be impossible here")
    lacking = [name for name in expect.faults if name not in shown]
    silent = [name for name in lacking if any(one.name == name for one in blind)]
    if lacking and silent == lacking:
        problems += _safe(expect, seen, effects)
        return _told(scenario, seen, effects, problems, silent, None)
    if lacking:
        problems.append(f"no {', '.join(lacking)}")
    named = (*expect.faults, *expect.also)
    # what one fault of a device cannot show may show as another one of it
    of = {one.name.partition("_")[0] for one in blind if one.name in named and one.name not in shown}
    unexpected = [n for n in names(seen.latched) if n not in named and n.partition("_")[0] not in of]
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
    return _told(scenario, seen, effects, problems, [], limit)


def _told(
    scenario: Scenario,
    seen: Observed,
    effects: dict[str, Any],
    problems: list[str],
    silent: list[str],
    limit: int | None,
) -> dict[str, Any]:
    expect, latched = scenario.expect, names(seen.latched)
    shown = names(seen.present | seen.latched)
    return {
        "name": scenario.name,
        "met": not problems,
        "problems": problems,
        "reaction": expect.reaction,
        "faults": [n for n in shown if n in expect.faults or n in latched],
        "unnoticed": silent,
        "allowed_ticks": limit,
        **effects,
    }


def _safe(expect: Expect, seen: Observed, effects: dict[str, Any]) -> list[str]:
    """What is wrong with a run in which a fault could not be noticed."""
    problems = []
    if seen.latched and seen.state != State.FAULT:
        problems.append(f"ended {State(seen.state).label}, not in fault")
    if not seen.latched and not is_engaged(seen.state):
        problems.append(f"ended {State(seen.state).label} without a fault, not engaged")
    if effects["impact_m_s"] > expect.impact_m_s:
        problems.append(f"met an end stop at {effects['impact_m_s']:.2f} m/s, not {expect.impact_m_s:g}")
    return problems


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
    if result["unnoticed"]:
        what = f"; {', '.join(result['faults'])} instead" if result["faults"] else ""
        return f"scenario {result['name']}: {', '.join(result['unnoticed'])} is not noticed here{what}"
    words = f"scenario {result['name']}: {result['reaction']} as expected"
    if result["faults"]:
        words += f" ({', '.join(result['faults'])})"
    if result["reaction"] == "centre":
        words += (
            f", 0 V {result['centred_ms']:.1f} ms after the fault; {result['travel_mm']:.1f} mm of travel,"
            f" {result['peak_bar']:.2f} bar at most"
        )
    return words
