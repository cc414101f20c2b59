"""Estimates beside what is configured and what was found before: what is off, and what has worn."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from pneud.config.sections import ConfigError
from pneud.rt.inputs import read_whole
from pneud.study.identification import parameters as key
from pneud.study.identification.parameters import Estimate

SCHEMA = 1

# How far a parameter may lie off before anybody need do something: a share of the value, and an amount.
TOLERANCES: Mapping[str, tuple[float, float]] = {
    key.AREA: (0.1, 0.0), key.CONDUCTANCE: (0.1, 0.0), key.CRITICAL: (0.0, 0.1), key.EXHAUST: (0.1, 0.0),
    key.CRITICAL_OUT: (0.0, 0.1),
    key.PLUS: (0.0, 0.03), key.MINUS: (0.0, 0.03), key.HALF: (0.0, 0.03), key.CENTRE: (0.0, 0.03),
    key.BANDWIDTH: (0.3, 0.0), key.DELAY: (0.0, 500.0), key.SEEP: (0.0, 0.002),
    key.SEEP_OUT: (0.0, 0.002), key.PLAY: (0.0, 0.03),
    key.DEAD1: (0.2, 0.002), key.DEAD2: (0.2, 0.002), key.EXPONENT: (0.0, 0.1), key.WALL: (0.5, 0.0),
    key.MASS: (0.1, 0.0), key.LOAD: (0.1, 5.0), key.COULOMB: (0.3, 0.0), key.STATIC: (0.3, 0.0),
    key.STRIBECK: (1.0, 0.0), key.VISCOUS: (0.3, 0.0), key.STIFFNESS: (2.0, 0.0), key.DAMPING: (5.0, 0.0),
    key.FORWARD: (0.0, 0.1),
}  # fmt: skip

AGREES, NEAR, OFF, UNTOLD = "agrees", "near", "off", "not told"


class Row(NamedTuple):
    """A parameter, and how it stands to what was known."""

    key: str
    estimate: Estimate
    verdict: str  # against the configuration
    before: Estimate | None = None  # of the earlier identification
    worn: bool = False  # it is another one since then


def rows(found: Mapping[str, Estimate], before: Mapping[str, Estimate]) -> list[Row]:
    """All parameters against the configuration, and against an earlier identification where it has them."""
    made = []
    for name, e in found.items():
        earlier = before.get(name)
        made.append(Row(name, e, _verdict(name, e), earlier, earlier is not None and _worn(name, e, earlier)))
    return made


def _verdict(name: str, e: Estimate) -> str:
    if not e.told or e.configured is None:
        return UNTOLD
    if e.low <= e.configured <= e.high:
        return AGREES
    return OFF if abs(e.value - e.configured) > tolerance(name, e.configured) else NEAR


def tolerance(name: str, value: float) -> float:
    """How far a parameter may lie from a value."""
    share, amount = TOLERANCES[name]
    return share * abs(value) + amount


def _worn(name: str, e: Estimate, before: Estimate) -> bool:
    apart = e.low > before.high or e.high < before.low
    return e.told and before.told and apart and abs(e.value - before.value) > tolerance(name, before.value)


def as_json(e: Estimate) -> dict[str, Any]:
    """A parameter as an object; non-finite numbers are null."""
    return {name: value if _plain(value) else None for name, value in e._asdict().items()}


def _plain(value: Any) -> bool:
    return isinstance(value, bool) or (isinstance(value, float | int) and math.isfinite(value))


class Earlier(NamedTuple):
    """An identification that was printed."""

    axis: str  # empty where it does not say
    parameters: Mapping[str, Estimate]


def earlier(path: Path) -> Earlier:
    """What `pneud identify --json` printed before.

    Raises:
        ConfigError: it cannot be read, or is nothing of the kind.
    """
    try:
        whole = json.loads(read_whole(path))
        return Earlier(str(whole.get("axis", "")), estimates(whole))
    except OSError as e:
        raise ConfigError(f"{path}: cannot be read: {e.strerror}") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise ConfigError(f"{path}: not what pneud identify --json prints") from None


def check_axis(path: Path, before: str, now: str) -> None:
    """Refuse to call it wear that another axis is another one; what does not say whose it is passes.

    Raises:
        ConfigError: an identification in a file was of another axis than the logs.
    """
    if before not in ("", now):
        raise ConfigError(f"{path}: is of axis {before}, the logs are of {now}")


def estimates(whole: Any) -> dict[str, Estimate]:
    """The parameters of an object that an identification has become.

    Raises:
        ValueError, KeyError, TypeError, AttributeError: it is nothing of the kind.
    """
    if whole["schema"] != SCHEMA:
        raise ValueError
    return {name: _estimate(one) for name, one in whole["parameters"].items() if name in TOLERANCES}


def _estimate(one: Mapping[str, Any]) -> Estimate:
    configured = one.get("configured")
    return Estimate(
        float(one["value"]),
        float(one["low"]),
        float(one["high"]),
        None if configured is None else float(configured),
        bool(one.get("told", True)),
    )
