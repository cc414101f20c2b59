"""Proof that a rig has passed its movement test, kept beside the configuration.

It holds for the wiring, the cylinder, the valve and the sensors that it was made with: a digest of what the
configuration says of them tells whether that is still so.
"""

from __future__ import annotations

import hashlib
import json
from enum import StrEnum
from pathlib import Path
from typing import Any

from pneud.config.bus_tables import BusConfig
from pneud.config.flow import RATINGS
from pneud.config.models import Config
from pneud.config.protection import ProtectionConfig
from pneud.rt.outputs import replacing

_VALVE = {*RATINGS, "u_max_v"}  # the rest is tuned
_BUS = {"channel", "dbc", "frames"}
_FURTHER = ("signals", "messages", "nodes")  # where they are given
_OWN = ("schema", "digest")


class Proof(StrEnum):
    """What is known of a rig."""

    PASSED = "passed"
    FAILED = "failed"
    CHANGED = "changed"  # passed or failed, but with another configuration
    MISSING = "missing"


def place(config_file: Path) -> Path:
    """Where a configuration's proof is kept."""
    return config_file.with_suffix(".proof.json")


def digest(c: Config, dbc: bytes) -> str:
    """Of all that the movement test has tried.

    Args:
        c: the configuration.
        dbc: its DBC.
    """
    tried = {
        "cylinder": c.cylinder.model_dump(mode="json"),
        "valve": c.valve.model_dump(mode="json", include=_VALVE),
        "encoder": c.encoder.kind,
        "bus": _connected(c.bus),
        "dbc": hashlib.sha256(dbc).hexdigest(),
    }
    return hashlib.sha256(json.dumps(tried, sort_keys=True).encode()).hexdigest()


def _connected(bus: BusConfig) -> dict[str, Any]:
    """How the devices are connected; what is left out is not in it, so that a proof outlives another key."""
    found = bus.model_dump(mode="json", include=_BUS | {key for key in _FURTHER if getattr(bus, key)})
    for frame in found["frames"].values():
        for key, field in ProtectionConfig.model_fields.items():
            if frame[key] == field.default:
                del frame[key]
    for message in (*found["frames"].values(), *found.get("messages", {}).values()):
        if message["period_us"] is None:
            del message["period_us"]
    return found


def keep(config_file: Path, of: str, verdict: dict[str, Any]) -> Path:
    """Write what a movement test came to, whole or not at all.

    Args:
        config_file: that was tested.
        of: its digest.
        verdict: `passed`, and what else a person wants to know.

    Raises:
        OSError: it cannot be written.
    """
    path = place(config_file)
    text = json.dumps({"schema": 1, "digest": of, **verdict}, indent=1) + "\n"
    with replacing(path) as beside:
        beside.write_text(text, encoding="utf-8")
    return path


def carry_over(config_file: Path, of: str, to: str) -> None:
    """Have a proof hold for another configuration of the same rig, of which more is known.

    Args:
        config_file: that was tested.
        of: digest that the proof is for; one for another is left as it is.
        to: digest that it is for from now on.

    Raises:
        OSError: it cannot be written.
    """
    kept = _kept(config_file)
    if kept is not None and kept.get("digest") == of:
        keep(config_file, to, {name: value for name, value in kept.items() if name not in _OWN})


def proven(config_file: Path, of: str) -> Proof:
    """What is known of a rig with the configuration that it has now; what cannot be read proves nothing.

    Args:
        config_file: of the rig.
        of: its digest.
    """
    kept = _kept(config_file)
    if kept is None:
        return Proof.MISSING
    if kept.get("digest") != of:
        return Proof.CHANGED
    return Proof.PASSED if kept["passed"] else Proof.FAILED


def _kept(config_file: Path) -> dict[str, Any] | None:
    try:
        kept = json.loads(place(config_file).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return kept if isinstance(kept, dict) and isinstance(kept.get("passed"), bool) else None
