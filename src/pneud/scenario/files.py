"""Scenarios as they stand in files, and the axis that each is for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import ValidationError

from pneud import resources
from pneud.config.reading import explain
from pneud.config.sections import ConfigError
from pneud.config.toml import TomlError, tables_of
from pneud.loading import Loaded, Together, load, load_axes

if TYPE_CHECKING:
    from pneud.scenario.format import Scenario


def load_axis(
    config_file: str | None, rate_hz: float | None, scenario: Scenario | None, axis: str | None = None
) -> Loaded:
    """The axis of a virtual run, as a scenario wants it: the one named, the scenario's, or virtual.toml.

    Of a file with several it is the one of the name `axis`.

    Raises:
        ConfigError: the configuration cannot be used.
        DatabaseError: the DBC cannot be used.
    """
    if scenario is None:
        return load(config_file or "virtual.toml", rate_hz, axis=axis)
    loaded = load(config_file or scenario.config, rate_hz, scenario.change, axis)
    _check_station(scenario, loaded)
    return loaded


def load_all(config_file: str | None, rate_hz: float | None, scenario: Scenario | None) -> Together:
    """As `load_axis`, all axes of it.

    Raises:
        ConfigError: a configuration cannot be used, or the scenario is for another one.
        DatabaseError: a DBC cannot be used.
    """
    if scenario is None:
        return load_axes(config_file or "virtual.toml", rate_hz)
    axes = load_axes(config_file or scenario.config, rate_hz, scenario.change)
    if scenario.axis is not None and scenario.axis not in [axis.config.name for axis in axes]:
        raise ConfigError(f"scenario {scenario.name}: happens to axis {scenario.axis}, which is not there")
    _check_station(scenario, axes[place_of(scenario, axes)])
    return axes


def _check_station(scenario: Scenario, axis: Loaded) -> None:
    """Make sure that there are the inputs, the brake and the load cell to which a scenario does something.

    Raises:
        ConfigError: there are not.
    """
    inputs = axis.config.bus.inputs
    for fault in scenario.fault:
        name = getattr(fault, "input", "")
        if name and name not in inputs:
            there = f"there is {', '.join(inputs)}" if inputs else "it has none"
            of = f"scenario {scenario.name}: axis {axis.config.name}"
            raise ConfigError(f"{of} has no input {name!r}; {there} (bus.inputs)")
        if fault.kind == "inputs_lost" and not inputs:
            raise ConfigError(f"scenario {scenario.name}: axis {axis.config.name} has no inputs (bus.inputs)")
        if fault.kind == "brake_stuck" and axis.config.brake is None:
            raise ConfigError(f"scenario {scenario.name}: axis {axis.config.name} has no [brake]")
        if fault.kind == "load_cell" and axis.config.bus.load_cell is None:
            of = f"scenario {scenario.name}: axis {axis.config.name}"
            raise ConfigError(f"{of} has no load cell (bus.load_cell)")


def place_of(scenario: Scenario | None, axes: Sequence[Loaded]) -> int:
    """The place of the axis that a scenario happens to."""
    names = [axis.config.name for axis in axes]
    return names.index(scenario.axis) if scenario is not None and scenario.axis is not None else 0


def load_scenario(file: str | Path) -> Scenario:
    """Load a scenario.

    Args:
        file: path, or bare name of one that comes with pneud, with or without ".toml".

    Raises:
        ConfigError: the scenario cannot be used.
    """
    from pneud.scenario.format import parse_scenario  # noqa: PLC0415 - slow to import, for a few runs only

    name = str(file)
    try:
        path = resources.find(name if name.endswith(".toml") else f"{name}.toml")
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise ConfigError(
            f"{file}: no such scenario; those of pneud are in {resources.scenarios()}"
        ) from None
    except (OSError, UnicodeDecodeError) as e:
        raise ConfigError(f"{file}: cannot be read: {getattr(e, 'strerror', e)}") from None
    try:
        return parse_scenario(text)
    except TomlError as e:
        raise ConfigError(f"{path}: {e}") from None
    except ValidationError as e:
        raise ConfigError(f"{path}: {explain(e, text)}") from None


def in_simulation(scenario: Scenario) -> Scenario:
    """The scenario, if it takes no more than simulated time has.

    Raises:
        ConfigError: it takes more.
    """
    if scenario.needs_machine:
        raise ConfigError(
            f"scenario {scenario.name}: takes a real machine; pneud --virtual --scenario plays it"
        )
    return scenario


def is_scenario(file: str | Path) -> bool:
    """Whether a file says what it expects, as a scenario does and a configuration does not."""
    try:
        return "expect" in tables_of(resources.find(file).read_text(encoding="utf-8-sig"))
    except (OSError, ValueError):  # whoever loads it will say what is wrong
        return False
