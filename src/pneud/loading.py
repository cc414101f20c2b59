"""A configuration with everything that belongs to it: its text, the DBC, the codecs."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from pydantic import ValidationError

from pneud import resources
from pneud.bus.codec import Codecs, load_codecs
from pneud.config import Config, ConfigError, check_channel, explain, load_with_text


class Loaded(NamedTuple):
    """An axis as it stands in files."""

    config: Config
    path: Path
    text: str
    dbc: Path
    codecs: Codecs


def load(config_file: str | Path, rate_hz: float | None = None) -> Loaded:
    """Load a configuration and its DBC.

    Args:
        config_file: path, or bare name of one that comes with pneud.
        rate_hz: another rate than the configuration's.

    Raises:
        ConfigError: the configuration cannot be used.
        DatabaseError: the DBC cannot be used.
    """
    config, text, path = load_with_text(config_file)
    if rate_hz is not None:
        config = at_rate(config, rate_hz)
    try:
        dbc = resources.find(config.bus.dbc, path.parent)
    except FileNotFoundError as e:
        raise ConfigError(f"{path}: bus.dbc: {e}") from None
    return Loaded(config, path, text, dbc, load_codecs(config.bus, dbc))


def at_rate(config: Config, rate_hz: float) -> Config:
    """The configuration at another rate, checked like any other.

    Raises:
        ConfigError: the rate is out of bounds, or does not fit the rest.
    """
    data = config.model_dump(by_alias=True)
    data["loop"]["rate_hz"] = rate_hz
    try:
        return Config.model_validate(data)
    except ValidationError as e:
        raise ConfigError(f"--rate {rate_hz:g}: {explain(e)}") from None


def bus_name(option: str | None, config: Config) -> str:
    """The bus asked for with `--bus`, else the configuration's.

    Raises:
        ConfigError: not the form of a bus name.
    """
    if option is None:
        return config.bus.channel
    try:
        check_channel(option)
    except ValueError as e:
        raise ConfigError(f"--bus: {e}") from None
    return option
