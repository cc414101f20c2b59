"""What faults can be injected by name, and what the axis is expected to do about each."""

from __future__ import annotations

import json as json_
from typing import Any

from pneud import resources
from pneud.scenario.files import load_scenario
from pneud.verbs import JsonOption


def scenarios(json: JsonOption = False) -> int:
    """List the scenarios that come with pneud, for `--scenario`.

    Returns:
        Exit status: 0.
    """
    found = [_facts(name) for name in sorted(path.stem for path in resources.scenarios().glob("*.toml"))]
    if json:
        print(json_.dumps({"schema": 1, "folder": str(resources.scenarios()), "scenarios": found}))
        return 0
    for s in found:
        where = " (pneud --virtual only)" if s["needs_machine"] else ""
        print(f"{s['name']:26} → {s['reaction']:10} {s['description']}{where}")
    return 0


def _facts(name: str) -> dict[str, Any]:
    s = load_scenario(name)
    return {
        "name": s.name,
        "description": s.description,
        "config": s.config,
        "duration_s": s.duration_s,
        "kinds": [fault.kind for fault in s.fault],
        "reaction": s.expect.reaction,
        "faults": list(s.expect.faults),
        "needs_machine": s.needs_machine,
        "needs_interface": s.needs_interface,
    }
