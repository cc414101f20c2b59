"""Gains while the loop runs: what they are, what they are asked to become, and what the file says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pneud.config import Config, ConfigError, load_config
from pneud.console.protocol import Error, ProtocolError
from pneud.console.server import Plan
from pneud.control.tuning import LAWS, TUNABLE
from pneud.signals import Request, RequestKind

Gains = dict[str, float | str]
"""By name, in the order of TUNABLE; the law by its name, all others numbers."""

_OBSERVER = ("lambda0", "lambda1", "gain_n_s2")


def gains_of(c: Config) -> Gains:
    """The gains of a configuration."""
    law = f"{c.control.law}-{c.control.discretisation}"
    return {name: law if name == "law" else float(_value(c, name)) for name in TUNABLE}


def _value(c: Config, name: str) -> float:
    value: float = getattr(c.control.observer if name in _OBSERVER else c.control, name)
    return value


def keys(name: str) -> tuple[tuple[str, ...], ...]:
    """Where a gain stands in the file; the law in two places."""
    if name == "law":
        return ("control", "law"), ("control", "discretisation")
    return (("control", "observer", name) if name in _OBSERVER else ("control", name),)


def difference(old: Gains, new: Gains) -> str:
    """What changes, in words; empty for nothing."""

    def shown(value: float | str) -> str:
        return value if isinstance(value, str) else f"{value:.10g}"

    return ", ".join(f"{n} {shown(old[n])} → {shown(new[n])}" for n in TUNABLE if old[n] != new[n])


class Tuning:
    """The running gains of one axis."""

    def __init__(self, config: Config, path: Path, text: str) -> None:
        """As they were loaded.

        Args:
            config: what runs.
            path: its file.
            text: the file's, as it was loaded.
        """
        self.running = gains_of(config)
        self._config = config
        self._path = path
        self._text = text

    def changed_on_disk(self) -> bool:
        """Whether the file is another one than that whose gains were taken last."""
        try:
            return self._path.read_text(encoding="utf-8") != self._text
        except (OSError, UnicodeDecodeError):
            return True

    def set(self, gains: Gains) -> Plan:
        """Change some of the gains.

        Raises:
            ProtocolError: there is no such gain, or no such law.
        """
        unknown = [name for name in gains if name not in TUNABLE]
        if unknown:
            raise ProtocolError(Error.INVALID, f"{unknown[0]!r} is none of {', '.join(TUNABLE)}")
        for name, value in gains.items():
            if (name == "law") != isinstance(value, str):
                kind = f"one of {', '.join(LAWS)}" if name == "law" else "a number"
                raise ProtocolError(Error.INVALID, f"{name} is {kind}")
        return self._plan("tune", {**self.running, **gains}, {})

    def reload(self) -> Plan:
        """Take the gains of the file; limits never, and everything else at the next start.

        Raises:
            ProtocolError: the file cannot be used, or has other limits.
        """
        try:
            config = load_config(self._path)
            text = self._path.read_text(encoding="utf-8")
        except (ConfigError, OSError, UnicodeDecodeError) as e:
            raise ProtocolError(Error.CONFIGURATION, str(e)) from None
        tunable = {".".join(key) for name in TUNABLE for key in keys(name)}
        running, found = _flat(self._config.model_dump()), _flat(config.model_dump())
        # the rate may have been given on the command line
        other = sorted(
            key
            for key in running.keys() | found.keys()
            if key not in tunable and key != "loop.rate_hz" and running.get(key) != found.get(key)
        )
        limits = [key for key in other if key.startswith("limits.")]
        if limits:
            raise ProtocolError(
                Error.CONFIGURATION,
                f"{self._path}: {', '.join(limits)} changed, and limits change at a restart only;"
                " nothing has been taken",
            )
        plan = self._plan("tune from the file", gains_of(config), {"at_restart": other})

        def done() -> dict[str, Any]:
            self._text = text
            return plan.done() if plan.done is not None else {}

        return plan._replace(done=done)

    def _plan(self, words: str, wanted: Gains, more: dict[str, Any]) -> Plan:
        law = wanted["law"]
        if law not in LAWS:
            raise ProtocolError(Error.INVALID, f"law is one of {', '.join(LAWS)}")
        values = tuple(float(LAWS.index(law)) if n == "law" else float(wanted[n]) for n in TUNABLE)
        changes = difference(self.running, wanted)

        def done() -> dict[str, Any]:
            self.running = wanted
            return {"gains": wanted, "changed": changes, **more}

        requests = (Request(RequestKind.GAINS, values),) if changes else ()
        return Plan(f"{words}: {changes or 'nothing to change'}", requests, done=done)


def _flat(table: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in table.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = value
    return flat
