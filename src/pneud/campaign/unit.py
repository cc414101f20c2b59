"""One run: a configuration and a seed in, a row out. Nothing else runs anything.

`run` is a function of its arguments alone: the same row in any process, in any order, on any machine whose
mathematics rounds alike. What it is given is plain data, made once by `config`, so that whoever hands out
runs need not know what is in it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import ValidationError

from pneud.bus.codec import Codecs, codecs_from
from pneud.campaign import by_axis, by_law
from pneud.campaign.by_law import RunError
from pneud.campaign.draws import drawn, noise_seed
from pneud.campaign.parts import USUAL, Parts, columns_of, parts_of
from pneud.config.conversions import axis_of, expected_of, plant_of
from pneud.config.models import Config
from pneud.config.reading import explain
from pneud.config.sections import ConfigError
from pneud.config.toml import merged, tables_of, toml_text
from pneud.loading import Loaded, fitting, load
from pneud.log.files.writer import LogWriter
from pneud.scenario.files import in_simulation, load_scenario
from pneud.scenario.format import Scenario, parse_scenario

Cell = float | int | str | None
Row = dict[str, Cell]
LAW, AXIS = "law", "axis"
SEED, ERROR = "seed", "error"
PLANT = "plant."  # what the rig has otherwise than the controller believes
_KEPT = 32  # codecs of a process


def config(
    file: str | Path,
    *,
    axis: str | None = None,
    values: Mapping[str, Any] | None = None,
    spread: Mapping[str, Mapping[str, Any]] | None = None,
    play: Sequence[Mapping[str, Any]] = (),
    scenario: str = "",
    how: str = LAW,
    times: Sequence[str] = (),
) -> dict[str, Any]:
    """What `run` takes: plain data, with the texts of all files in it.

    Args:
        file: a configuration, or the bare name of one that comes with pneud.
        axis: which one, where there are several.
        values: put in place of the file's, by their keys with dots.
        spread: what is drawn for each run, by name: one of `draws.LAWS` with its numbers; `times`: the value
            is that times what is configured; `keys`: which values it is, where the name is not a key itself.
        play: parts, as in the file of a campaign; a sine if nothing is said.
        scenario: name or file of one, for the whole axis.
        how: "law" for law and plant alone, "axis" for all of it in simulated time.
        times: keys of which `base_of` is wanted, beside those that are drawn.

    Raises:
        ConfigError: something of it cannot be used.
        DatabaseError: the DBC cannot be used.
    """
    loaded = load(file, axis=axis)
    tables = tables_of(loaded.text)
    text = ""
    if scenario:
        wanted = in_simulation(load_scenario(scenario))
        how, tables = AXIS, merged(tables, wanted.change)
        text = toml_text(wanted.model_dump(mode="json", by_alias=True, exclude_none=True))
        play = play or ({"do": "sine", "seconds": wanted.duration_s, "learn_s": 0.0},)
    try:
        parts = parts_of([dict(part) for part in play or USUAL])
    except ValidationError as e:
        raise ConfigError(f"play: {explain(e)}") from None
    except ValueError as e:
        raise ConfigError(f"play: {e}") from None
    if scenario and [part.do for part in parts] != ["sine"]:
        raise ConfigError(f"scenario {scenario}: is played along the sine alone; leave out what else is done")
    return {
        "name": loaded.path.name,
        "path": str(loaded.path),
        "tables": tables,
        "dbc": loaded.dbc.read_bytes(),
        "dbc_path": str(loaded.dbc),
        "values": dict(values or {}),
        "spread": {name: dict(law) for name, law in (spread or {}).items()},
        "bases": _bases(merged(tables, nested(values or {})), spread or {}, times),
        "play": [part.model_dump() for part in parts],
        "scenario": text,
        "how": how,
    }


def run(config: Mapping[str, Any], seed: int) -> Row:
    """The row of one run; what goes wrong is in its `error`, which is "" where nothing did.

    Args:
        config: from `config`.
        seed: of all that is left to chance: what is drawn, the sensors' noise, what a scenario hits.
    """
    row: Row = dict.fromkeys(columns(config))
    row[SEED], row[ERROR] = seed, ""
    try:
        found = drawn(config["spread"], seed)
        row |= found
        row |= _played(config, found, seed)
    except Exception as e:
        # one run of a million must not take the others with it; its row says how to see it
        text = str(e) if hasattr(e, "exit_code") else f"{type(e).__name__}: {e}"
        row[ERROR] = " ".join(text.split())
    return row


def logged(
    config: Mapping[str, Any],
    seed: int,
    begin: Callable[[Loaded], LogWriter],
    look: Callable[[float, float], None] = lambda _, __: None,
) -> dict[str, Cell]:
    """A run of the whole axis again, with a log.

    Args:
        config: from `config`.
        seed: of the run.
        begin: from the axis to the writer of its log.
        look: as for `by_axis.play`.

    Raises:
        ConfigError: the values of this run are none that a configuration may have.
        DatabaseError: the DBC does not go with them.
        RunError: a part could not be done.
    """
    one = prepared(config, drawn(config["spread"], seed))
    loaded = one.loaded()
    return by_axis.play(loaded, one.parts, noise_seed(seed), one.scenario, begin(loaded), look)


def columns(config: Mapping[str, Any]) -> dict[str, type]:
    """The columns of a row in their order, and the kind of value in each."""
    found: dict[str, type] = {SEED: int}
    for name, law in config["spread"].items():
        values = law.get("choice")
        found[name] = type(values[0]) if values else float
        if values and found[name] in (int, bool) and any(isinstance(value, float) for value in values):
            found[name] = float
    parts = parts_of(config["play"])
    return found | columns_of(parts, config["how"] == AXIS, bool(config["scenario"])) | {ERROR: str}


class Prepared(NamedTuple):
    """A run that has not begun."""

    config: Config
    tables: Mapping[str, Any]
    parts: Parts
    scenario: Scenario | None
    given: Mapping[str, Any]

    @property
    def codecs(self) -> Codecs:
        """Of its frames."""
        return _codecs(self.config, self.given["dbc"], self.given["dbc_path"])

    def loaded(self) -> Loaded:
        """All of the axis."""
        path, dbc = Path(self.given["path"]), Path(self.given["dbc_path"])
        return fitting(Loaded(self.config, path, toml_text(dict(self.tables)), dbc, self.codecs))


def prepared(config: Mapping[str, Any], found: Mapping[str, Any]) -> Prepared:
    """What a run is made of, with its own values.

    Args:
        config: from `config`.
        found: what it has drawn.

    Raises:
        ConfigError: the values of this run are none that a configuration may have.
    """
    tables = merged(config["tables"], nested(config["values"]))
    own: dict[str, Any] = {}
    for name, value in found.items():
        law = config["spread"][name]
        for key in law.get("keys") or (name,):
            own[key] = value * _base(tables, config["bases"][key]) if law.get("times") else value
    tables = merged(tables, nested(own))
    try:
        checked = Config.model_validate(tables)
    except ValidationError as e:
        raise ConfigError(f"{config['name']}: {explain(e, model=Config)}") from None
    text = config["scenario"]
    return Prepared(checked, tables, _parts(config), _scenario(text) if text else None, config)


def _played(config: Mapping[str, Any], found: Mapping[str, Any], seed: int) -> Mapping[str, Cell]:
    one = prepared(config, found)
    if config["how"] == AXIS:
        return by_axis.play(one.loaded(), one.parts, noise_seed(seed), one.scenario)
    axis = axis_of(one.config, one.codecs.command_lsb_v)
    tolerance_m = expected_of(one.config).tolerance_m
    return by_law.play(axis, plant_of(one.config), one.parts, tolerance_m, noise_seed(seed))


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Tables within tables, of keys with dots.

    Raises:
        ConfigError: one key is a value and a table.
    """
    whole: dict[str, Any] = {}
    for key, value in values.items():
        table = whole
        *tables, last = key.split(".")
        for name in tables:
            table = table.setdefault(name, {})
            if not isinstance(table, dict):
                raise ConfigError(f"{key}: {name} is no table")
        table[last] = value
    return whole


def base_of(config: Mapping[str, Any], key: str) -> float:
    """What a value is that something is times of, in the configuration as it stands."""
    return _base(merged(config["tables"], nested(config["values"])), config["bases"][key])


def _bases(
    tables: Mapping[str, Any], spread: Mapping[str, Mapping[str, Any]], more: Sequence[str]
) -> dict[str, tuple[str, float]]:
    """Where each value stands that something is times of, and what it is where a file is silent.

    Raises:
        ConfigError: there is no such number.
    """
    keys = [key for name, law in spread.items() if law.get("times") for key in law.get("keys") or (name,)]
    keys += more
    if not keys:
        return {}
    try:
        usual = Config.model_validate(tables).model_dump(by_alias=True)
    except ValidationError as e:
        raise ConfigError(explain(e)) from None
    found: dict[str, tuple[str, float]] = {}
    for key in keys:
        # what the rig is not said to have otherwise, it has as the axis believes
        for place in (key, key.removeprefix(PLANT)):
            if (number := _number(usual, place)) is not None:
                found[key] = (place, number)
                break
        else:
            raise ConfigError(f"{key}: there is no number that it could be times of")
    return found


def _base(tables: Mapping[str, Any], base: tuple[str, float]) -> float:
    place, usual = base
    number = _number(tables, place)
    return usual if number is None else number


def _number(tables: Mapping[str, Any], key: str) -> float | None:
    value: Any = tables
    for step in key.split("."):
        value = value.get(step) if isinstance(value, Mapping) else None
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _parts(config: Mapping[str, Any]) -> Parts:
    return parts_of(config["play"])


@lru_cache(maxsize=_KEPT)
def _scenario(text: str) -> Scenario:
    return parse_scenario(text)


_CODECS: dict[tuple[bytes, str], Codecs] = {}


def _codecs(c: Config, dbc: bytes, name: str) -> Codecs:
    """Of the frames; they are made once of the same bus."""
    about = dbc, repr((c.bus, c.gas if c.bus.signals is not None else None))
    if about not in _CODECS:
        if len(_CODECS) >= _KEPT:
            _CODECS.clear()
        _CODECS[about] = codecs_from(c.bus, Path(name), dbc, c.gas)
    return _CODECS[about]


__all__ = ["Cell", "Row", "RunError", "columns", "config", "logged", "run"]
