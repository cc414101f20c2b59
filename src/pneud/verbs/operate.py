"""What operators ask of a running daemon, one request a call; and its status in words."""

from __future__ import annotations

import json as json_
import time
from typing import Any

from pneud.console.client import Client, RefusedError
from pneud.console.results import refused, show

_JOG_LEASE_S = 0.3
_SILENT_S = 0.5
_RENEWALS = 3  # of a lease, before it would run out


def ask(socket: str | None, json: bool, verb: str, **fields: Any) -> int:
    """One request, and the state that the axis is in afterwards.

    Returns:
        Exit status: 0, or 1 where it was refused.

    Raises:
        PlaceError: no daemon to talk to.
    """
    with Client(socket) as client:
        try:
            reply = client.ask(verb, **fields)
        except RefusedError as e:
            return refused(e, json)
    show(reply, json, reply.get("state", "done"))
    return 0


def jog(socket: str | None, json: bool, velocity_mm_s: float, duration_s: float | None) -> int:
    """Move at a speed until Ctrl-C or the end of a time, then hold; if this process dies, the lease runs out.

    Returns:
        Exit status: 0, or 1 where it was refused.

    Raises:
        PlaceError: no daemon to talk to.
    """
    with Client(socket) as client:
        try:
            end_s = time.monotonic() + (duration_s if duration_s is not None else float("inf"))
            try:
                while time.monotonic() < end_s:
                    client.ask("jog", velocity_mm_s=velocity_mm_s, lease_s=_JOG_LEASE_S)
                    time.sleep(max(0.0, min(_JOG_LEASE_S / _RENEWALS, end_s - time.monotonic())))
            except KeyboardInterrupt:
                pass
            reply = client.ask("hold")
        except RefusedError as e:
            return refused(e, json)
    show(reply, json, reply["state"])
    return 0


def status(socket: str | None, json: bool) -> int:
    """How the axis is.

    Returns:
        Exit status: 0.

    Raises:
        PlaceError: no daemon to talk to.
    """
    with Client(socket) as client:
        found = client.ask("status")
    print(json_.dumps(found) if json else "\n".join(in_words(found)))
    return 0


def in_words(s: dict[str, Any]) -> list[str]:
    """A status for people."""

    def number(value: float | None, form: str) -> str:
        return "–" if value is None else f"{value:{form}}"

    lines = [f"{s['name']} on {s['bus']}: {s['state']}"]
    if s["silent_s"] is not None and s["silent_s"] > _SILENT_S:
        lines.append(f"no ticks for {s['silent_s']:.1f} s")
    for fault in s["faults"]:
        kind = " and ".join(k for k in ("latched", "present") if fault[k])
        lines.append(f"fault {fault['name']} ({kind}; {fault['effect']}): {fault['cure']}")
    lines.append(
        f"position {number(s['position_mm'], '.3f')} mm, reference {number(s['reference_mm'], '.3f')} mm,"
        f" error {number(s['error_mm'], '.3f')} mm"
    )
    bar = s["pressures_bar"] or dict.fromkeys(("p1", "p2", "supply"))
    lines.append(
        f"p1 {number(bar['p1'], '.2f')} bar, p2 {number(bar['p2'], '.2f')} bar,"
        f" supply {number(bar['supply'], '.2f')} bar, command {number(s['command_v'], '+.3f')} V"
    )
    timing = ""
    for key, label in (("lateness_us", "late"), ("sensor_to_command_us", "sensor to command")):
        if s[key]:
            timing += (
                f"; {label} {s[key]['p50']:.0f} µs p50, {s[key]['p99']:.0f} p99, {s[key]['max']:.0f} max"
            )
    lines.append(f"{s['ticks']} ticks at {s['rate_hz']:g} Hz, {s['skipped']} skipped{timing}")
    lease = s["lease"]
    lines.append(
        f"commanded by uid {lease['uid']} pid {lease['pid']} for {lease['left_s']:.1f} s more"
        if lease
        else "nobody commands"
    )
    lost = f", {s['log_dropped']} lost" if s["log_dropped"] else ""
    lines.append(f"log {s['log']}: {s['log_written']} records{lost}")
    changed = " (changed since it was loaded: pneud tune diff)" if s["config_changed"] else ""
    lines.append(f"configuration {s['config']}{changed}")
    return lines
