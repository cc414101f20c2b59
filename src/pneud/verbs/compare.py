"""The law against its baselines, in simulated time."""

from __future__ import annotations

import importlib.util
import json as json_
import sys

from pneud.config.models import ConfigError
from pneud.loading import load
from pneud.study.comparison import as_json, compare, in_words

MOST_REST_S = 600.0


def compare_laws(config_file: str, rest_s: float, json: bool) -> int:
    """Run every law through every case and print the tables.

    Returns:
        Exit status, 0: the tables are the answer.

    Raises:
        ConfigError: the configuration cannot be used.
        DatabaseError: the DBC cannot be used.
    """
    if not 1.0 <= rest_s <= MOST_REST_S:
        raise ConfigError(f"--duration {rest_s:g}: with --compare, between 1 and {MOST_REST_S:g} s")
    compiled = importlib.util.find_spec("numba") is not None
    if not compiled:
        print(
            "pneud: three cases only without numba; for all: pip install 'pneud[sim]'",
            file=sys.stderr,
        )
    found = compare(load(config_file), rest_s, compiled)
    print(json_.dumps(as_json(found)) if json else in_words(found))
    return 0
