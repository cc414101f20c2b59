"""Feed a log through the axis again."""

from __future__ import annotations

import json as json_

from pneud.config import load_config
from pneud.log.reader import read_log
from pneud.replaying import replay as run


def replay(log: str, config_file: str | None, json: bool) -> int:
    """Replay a log and say how it compares.

    Returns:
        Exit status: 0 where every command is the same (or equivalent on another numeric machine), 1 where
        one differs or the log was never engaged.

    Raises:
        LogError: not a log that this version reads.
        ConfigError: its configuration cannot be used.
        DatabaseError: its DBC cannot be used.
    """
    reader = read_log(log)
    o = run(reader, load_config(config_file) if config_file is not None else None)
    if json:
        print(
            json_.dumps(
                {
                    "schema": 1,
                    "ticks": o.ticks,
                    "commands": o.commands,
                    "mismatches": o.mismatches,
                    "first_mismatch_tick": o.first.tick if o.first is not None else None,
                    "engaged_ticks": o.engaged_ticks,
                    "identical": o.identical,
                    "equivalent": o.equivalent,
                    "fingerprint": "same" if o.same_fingerprint else "different",
                    "truncated": o.truncated,
                }
            )
        )
        return 0 if o.good else 1
    if o.truncated:
        print(f"cut short: {o.damage}; {o.ticks} ticks could be read")
    if o.first is not None:
        print(f"{o.mismatches} of {o.ticks} ticks differ; first at {o.first}")
    if o.identical:
        print(f"identical: {o.commands} commands in {o.ticks} ticks, {o.engaged_ticks} of them engaged")
    elif o.good:
        print(
            f"equivalent on this machine, whose mathematics rounds differently:"
            f" all {o.commands} commands within one step on the wire"
        )
    if o.engaged_ticks == 0:
        print("the axis was never engaged in this log, so the replay proves nothing")
    return 0 if o.good else 1
