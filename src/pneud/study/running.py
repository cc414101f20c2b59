"""What `pneud check` would say of values that somebody tunes, live or in a replay."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pneud.config.models import Config
from pneud.config.reading import load_with_text, with_settings
from pneud.config.sections import ConfigError
from pneud.console.tuning import NAMES, keys, settings_of
from pneud.control.tunables import in_slot
from pneud.study import gains, linear
from pneud.study.plausibility import findings

_KEYS = {".".join(key) for name in NAMES for key in keys(name)}


def doubts_of(c: Config) -> list[str]:
    """What is wrong with what may be tuned of a configuration, a line each."""
    law = in_slot(c.control.law)
    bandwidth = (gains.predict(c) if law is None else linear.predict(c, law)).bandwidth_rad_s
    implausible = (f for f in findings(c, 0.0, bandwidth) if f.key in _KEYS)
    return [*linear.doubts_of(c), *(f"{f.key}: {f.words}" for f in implausible)]


def doubts_running(values: Mapping[str, float | str], path: Path) -> list[str]:
    """The same of values that run, as `tune_get` tells them; nothing where the file could not have them.

    Args:
        values: by name.
        path: the daemon's configuration, for all else.
    """
    settings = [setting for name, value in values.items() for setting in settings_of(f"{name}={value}")]
    try:
        return doubts_of(with_settings(load_with_text(path)[1], str(path), settings))
    except ConfigError:
        return []
