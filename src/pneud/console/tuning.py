"""What may be tuned while the loop runs: what it is, is asked to become, and is in the file.

Gains and reference, and what is believed of valve and friction, and the filters.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pneud.config.conversions import model_of, reference_of
from pneud.config.models import Config
from pneud.config.reading import NONE, explain, parse
from pneud.config.sections import ConfigError
from pneud.config.toml import flat
from pneud.console.memory import Memory
from pneud.console.orders import Orders
from pneud.console.protocol import Error, ProtocolError
from pneud.control import model
from pneud.control.tunables import LAWS, SLIDING_LAWS, names_of
from pneud.signals import Request, RequestKind

Values = dict[str, float | str]
"""By name; the law by its name, all others numbers."""

REFERENCE = ("reference.effective_centre_m", "reference.amplitude_m", "reference.frequency_hz")
MAYBE_NONE = ("motion.bandwidth_rad_s", "motion.push_bandwidth_rad_s")  # 0 stands for none
MODEL = model.NAMES
NAMES = (*dict.fromkeys(name for law in LAWS for name in names_of(law)), *REFERENCE, *MODEL)
_OBSERVER = ("lambda0", "lambda1", "gain_n_s2")
_VALVE = ("valve.dead_zone_v", "valve.centre_v")


def values_of(c: Config) -> Values:
    """What a configuration says, also of laws that it has not chosen."""
    sliding = f"{c.control.law}-{c.control.discretisation}"
    law = sliding if sliding in SLIDING_LAWS else c.control.law
    return {name: law if name == "law" else _value(c, name) for name in NAMES}


def chosen(values: Values) -> Values:
    """The values of the law among them, in their order, the reference, and what is believed."""
    return {name: values[name] for name in (*names_of(str(values["law"])), *REFERENCE, *MODEL)}


def _value(c: Config, name: str) -> float:
    (key,) = keys(name)
    table: Any = c
    for step in key:
        table = getattr(table, step)
    return 0.0 if table is None else float(table)


def keys(name: str) -> tuple[tuple[str, ...], ...]:
    """Where a value stands in the file; the law in two places."""
    if name == "law":
        return ("control", "law"), ("control", "discretisation")
    if name in REFERENCE or name in _VALVE:
        return (tuple(name.split(".")),)
    return (("control", "observer", name) if name in _OBSERVER else ("control", *name.split(".")),)


def name_of(key: str) -> str:
    """The name of the value that stands at a key of the file; whatever else is given as it is."""
    return next((name for name in NAMES if ".".join(keys(name)[0]) == key), key)


def settings_of(setting: str) -> list[str]:
    """A name and its value, "k1=90000", as keys of the file and theirs; whatever else is given as it is."""
    name, _, value = setting.partition("=")
    if name not in NAMES:
        return [setting]
    if name in MAYBE_NONE and _is_zero(value):
        value = NONE
    parts = value.split("-") if name == "law" else [value]
    return [f"{'.'.join(key)}={part}" for key, part in zip(keys(name), parts, strict=False)]


def _is_zero(value: str) -> bool:
    try:
        return float(value) == 0.0
    except ValueError:
        return False


def believing(c: Config, values: Values) -> Config:
    """The configuration with other values of `MODEL`.

    Raises:
        ValidationError: they are none that it could have.
    """
    data = c.model_dump(by_alias=True)
    for name in MODEL:
        ((*tables, last),) = keys(name)
        table = data
        for step in tables:
            table = table[step]
        if values[name] != _value(c, name):
            table[last] = None if name in MAYBE_NONE and not values[name] else values[name]
            if name == "motion.bandwidth_rad_s":
                table |= dict.fromkeys(("encoder_noise_m", "force_walk_n_rs"))
    return Config.model_validate(data)


def difference(old: Values, new: Values) -> str:
    """What changes, in words; empty for nothing."""

    def shown(value: float | str) -> str:
        return value if isinstance(value, str) else f"{value:.10g}"

    return ", ".join(f"{n} {shown(old[n])} → {shown(v)}" for n, v in new.items() if old[n] != v)


class Tuning:
    """What runs on one axis of all that may be tuned."""

    def __init__(
        self,
        config: Config,
        path: Path,
        text: str,
        memory: Memory | None = None,
        own: Callable[[str], str] = str,
    ) -> None:
        """As they were loaded, or are remembered; `own` finds what is of this axis in the file's text."""
        self._own = own
        self._values = values_of(config)
        self._config = config
        self._path = path
        self._text = text
        self._memory = memory
        self._in_file: str | ConfigError = text
        self._read = ""  # the file's whole text that it is from, where it has been read
        kept = memory.kept() if memory is not None else None
        if kept is not None and "values" in kept:
            self._values, self._text = kept["values"], kept["text"]
            self._in_file = self._text

    def _keep(self) -> None:
        if self._memory is not None:
            self._memory.keep(values=self._values, text=self._text)

    @property
    def running(self) -> Values:
        """The values of the law that runs, the reference, and what is believed."""
        return chosen(self._values)

    def read(self) -> None:
        """See what is in the file, for the next two; this takes as long as the disk does."""
        try:
            text = self._path.read_text(encoding="utf-8-sig")
            if text != self._read:  # of several axes it takes a while to find what is said of one
                self._in_file, self._read = self._own(text), text
        except ConfigError as e:
            self._in_file, self._read = e, ""
        except (OSError, UnicodeDecodeError) as e:
            self._read = ""
            self._in_file = ConfigError(f"{self._path}: cannot be read: {getattr(e, 'strerror', e)}")

    def changed_on_disk(self) -> bool:
        """Whether the file, as it was read last, is another one than that whose values were taken."""
        return self._in_file != self._text

    def set(self, values: Values) -> Orders:
        """Change some of the values.

        Raises:
            ProtocolError: there is no such value or law, a value is of another law, or is none that the
                configuration could have.
        """
        unknown = [name for name in values if name not in NAMES]
        if unknown:
            raise ProtocolError(Error.INVALID, f"{unknown[0]!r} is none of {', '.join(NAMES)}")
        for name, value in values.items():
            if (name == "law") != isinstance(value, str):
                kind = f"one of {', '.join(LAWS)}" if name == "law" else "a number"
                raise ProtocolError(Error.INVALID, f"{name} is {kind}")
        wanted = self._values | values
        law = wanted["law"]
        if law not in LAWS:
            raise ProtocolError(Error.INVALID, f"law is one of {', '.join(LAWS)}")
        strange = [name for name in values if name not in chosen(wanted)]
        if strange:
            raise ProtocolError(Error.INVALID, f"{strange[0]} is no value of {law}; set law=… along with it")
        try:
            believing(self._config, wanted)
        except ValidationError as e:
            raise ProtocolError(Error.INVALID, explain(e)) from None
        return self._plan("tune", wanted, {})

    def reload(self) -> Orders:
        """Take the values of the file as it was read last; limits never, all else at the next start.

        So are edges of a dead zone that belong to a map of the valve.

        Raises:
            ProtocolError: the file cannot be used, or has other limits.
        """
        text = self._in_file
        try:
            if isinstance(text, ConfigError):
                raise text
            config = parse(text, str(self._path))
        except ConfigError as e:
            raise ProtocolError(Error.CONFIGURATION, str(e)) from None
        tunable = {".".join(key) for name in NAMES for key in keys(name)}
        running, found = flat(self._config.model_dump()), flat(config.model_dump())
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
        found_values = values_of(config)
        if config.valve.map or self._config.valve.map:
            other += [n for n in _VALVE if found_values[n] != self._values[n] and n not in other]
            found_values |= {n: self._values[n] for n in _VALVE}
        plan = self._plan("tune from the file", found_values, {"at_restart": sorted(other)})
        words = plan.words + (f" (at the next start only: {', '.join(other)})" if other else "")

        def done() -> dict[str, Any]:
            self._text = text
            self._keep()
            return plan.done() if plan.done is not None else {}

        return plan._replace(words=words, done=done)

    def _plan(self, words: str, wanted: Values, more: dict[str, Any]) -> Orders:
        reference = any(wanted[n] != self._values[n] for n in REFERENCE)
        model = any(wanted[n] != self._values[n] for n in MODEL)
        changes = difference(self._values, chosen(wanted))

        def done() -> dict[str, Any]:
            self._values = wanted
            self._keep()
            return {"gains": self.running, "changed": changes, **more}

        if not changes:
            return Orders(f"{words}: nothing to change", (), done=done)
        asked, back = (self._request(values, reference, model) for values in (wanted, self._values))
        return Orders(f"{words}: {changes}", (asked,), undo=back, done=done)

    def as_known(self) -> Request:
        """What has the axis be as it is known to be."""
        return self._request(self._values, reference=True, model=True)

    def _request(self, values: Values, reference: bool, model: bool) -> Request:
        law, *gains = (values[name] for name in names_of(str(values["law"])))
        found = (float(LAWS.index(str(law))), *map(float, gains))
        found += self._sine(values) if reference else ()
        return Request(RequestKind.GAINS, found + self._model(values) if model else found)

    def _model(self, wanted: Values) -> tuple[float, ...]:
        """What is believed as the axis knows it."""
        configured = model_of(self._config)
        changed = (
            wanted[n] if wanted[n] != _value(self._config, n) else c
            for n, c in zip(MODEL, configured, strict=False)
        )
        return (*map(float, changed), *configured[len(MODEL) :])

    def _sine(self, wanted: Values) -> tuple[float, ...]:
        """The reference as the axis knows it."""
        changed = {name.partition(".")[2]: wanted[name] for name in REFERENCE}
        reference = self._config.reference.model_copy(update=changed)
        return reference_of(self._config.model_copy(update={"reference": reference}))
