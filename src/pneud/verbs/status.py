"""How the axis of the running daemon is: state, faults with cures, position, pressures, timing, log."""

import json as json_
from typing import Annotated, Any

import typer

from pneud.console.client import Client, RefusedError
from pneud.console.going import in_words as where
from pneud.console.results import refused
from pneud.verbs import AxisOption, JsonOption, SocketOption
from pneud.view import mileage
from pneud.view.learnt import in_brief

_SILENT_S = 0.5


def status(
    axis: AxisOption = None,
    socket: SocketOption = None,
    json: JsonOption = False,
    openmetrics: Annotated[
        bool, typer.Option("--openmetrics", help="Print numbers as monitoring reads them.")
    ] = False,
) -> int:
    """How the axis is.

    Returns:
        Exit status: 0, or 1 where there is no such axis.
    """
    try:
        with Client(socket, axis) as client:
            found = client.ask("status")
    except RefusedError as e:
        return refused(e, json)
    each = [found]
    if "axes" in found:
        each = [{**one, "lease": found["lease"]} for one in found["axes"].values()]
    if json:
        print(json_.dumps(found))
    elif openmetrics:
        from pneud.web.metrics import text_of  # noqa: PLC0415 - for those who ask for it

        print(text_of(each, openmetrics=True), end="")
    else:
        print("\n\n".join("\n".join(in_words(one)) for one in each))
    return 0


def in_words(s: dict[str, Any]) -> list[str]:
    """A status for people."""

    def number(value: float | None, form: str) -> str:
        return "–" if value is None else f"{value:{form}}"

    lines = [f"{s['name']} on {s['bus']}: {s['state']}"]
    if s["silent_s"] is not None and s["silent_s"] > _SILENT_S:
        lines.append(f"no ticks for {s['silent_s']:.1f} s")
    cause = s.get("cause") or {"faults": ()}
    several = len(cause["faults"]) > 1  # which would each have a cure, and mislead
    if several:
        lines.append(f"{cause['words']}: {cause['cure']}")
    for fault in s["faults"]:
        kind = " and ".join(k for k in ("latched", "present") if fault[k])
        cure = "" if several and fault["name"] in cause["faults"] else f": {fault['cure']}"
        lines.append(f"fault {fault['name']} ({kind}; {fault['effect']}){cure}")
    if s["state"] == "pressing":
        there = ", as asked for" if s["in_position"] else ""
        lines.append(f"force {number(s['force_n'], '.1f')} N{there}, at {number(s['position_mm'], '.3f')} mm")
    else:
        lines.append(
            f"position {number(s['position_mm'], '.3f')} mm, reference {number(s['reference_mm'], '.3f')} mm,"
            f" error {number(s['error_mm'], '.3f')} mm{', in position' if s['in_position'] else ''}"
        )
    if s["program"]:
        lines.append(_program(s["program"]))
    if s.get("station"):
        lines.append(_station(s["station"]))
    if s["hunting"]:
        lines.append(f"hunting ({s['hunting']['cause']}): check {s['hunting']['cure']}")
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
    lines += _readings(s) + _learnt(s)
    lines.append(f"done: {mileage.in_words(s['mileage'])}; {mileage.whence(s['mileage'])}")
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


def _program(p: dict[str, Any]) -> str:
    """How far a program is."""
    name, stage = p["name"] or "", str(p["stage"]).replace("_", " ")
    rounds = f"{p['cycle']} cycle{'' if p['cycle'] == 1 else 's'} done"
    return f"program {name}: {stage}, {where(p)}, {rounds}".replace(" :", ":")


def _station(s: dict[str, Any]) -> str:
    """What is on of inputs and outputs, and what the brake does."""
    on = [
        f"{what}: {', '.join(name for name, is_on in s[what].items() if is_on) or 'none'} on"
        for what in ("inputs", "outputs")
        if s[what]
    ]
    return "; ".join([*on, *([f"brake {s['brake']}"] if s["brake"] else [])])


def _readings(s: dict[str, Any]) -> list[str]:
    """What ticks had to go without."""

    def words(counts: dict[str, int]) -> str:
        return ", ".join(f"{count} {kind}" for kind, count in counts.items())

    return [f"readings amiss: {words(s['amiss'])}; in the last minute: {words(s['amiss_last_minute'])}"]


def _learnt(s: dict[str, Any]) -> list[str]:
    """What has been learnt, and what of it is as far off as it may be."""
    if s["learnt"] is None:
        return []
    begun = f" (from {s['learnt_from']} on)" if s["learnt_from"] else ""
    words = ", ".join(f"{label} {text}" for label, text, _ in in_brief(s["learnt"]))
    return [f"learnt{begun}: {words}"] + [
        f"{name} = {v['value']:g} is at its bound: check {v['check']}"
        for name, v in s["learnt"].items()
        if v["check"]
    ]
