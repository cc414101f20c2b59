"""What this machine can and cannot do in real time, and the cure for each lack: found and told."""

from __future__ import annotations

import json as json_
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from pneud.config.models import Config
from pneud.config.sections import ConfigError
from pneud.loading import load_axes
from pneud.log.files.naming import log_folder
from pneud.rt.setup import Report, own_cpu
from pneud.service import installation, machine
from pneud.service.machine import Facts
from pneud.service.probe import Finding, Grade, Wanted, examine, worst_first

_STYLE = {Grade.LACK: "bold red", Grade.WARNING: "yellow", Grade.OK: "green"}
_SIGN = {Grade.LACK: "lack", Grade.WARNING: "warn", Grade.OK: "ok"}


def diagnose(
    config_file: str,
    json: bool,
    read: Callable[..., Facts] = machine.read,
    attempt: Callable[[int, int | None, bool], list[Report]] = machine.attempt,
    service: Callable[..., Iterator[Finding]] = installation.examine,
) -> int:
    """Examine the machine, and the service where one is installed, for a configuration; print what is found.

    Returns:
        Exit status: 0 when everything that the configuration requires is there, else 1.

    Raises:
        ConfigError: the configuration cannot be used.
        DatabaseError: its DBC cannot be used.
        LogError: there is no folder for logs.
    """
    loaded = load_axes(config_file)[0]  # what it asks of the machine is the same for all
    wanted = wanted_by(loaded.config)
    facts = read(wanted.interface, log_folder(None))
    findings = examine(
        facts, attempt(wanted.priority, wanted.cpu, loaded.config.realtime.lock_memory), wanted
    )
    try:
        axis = installation.axis_of(loaded.path, loaded.config)
    except ConfigError:  # a service of it cannot be there
        axis = None
    findings = worst_first([*findings, *service(axis, wanted.priority)])
    ok = all(finding.level != Grade.LACK for finding in findings)
    if json:
        print(json_.dumps(as_object(str(loaded.path), facts, findings)))
    else:
        _print(f"{facts.kernel}, {facts.cpu_model}", loaded.config.name, findings, _Paper(highlight=False))
    return 0 if ok else 1


class _Paper(Console):
    """A console whose reader may go away, as any other's."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


def wanted_by(c: Config) -> Wanted:
    """What a configuration asks of the machine."""
    kind, _, name = c.bus.channel.partition(":")
    r = c.realtime
    interface = name if kind == "socketcan" else None
    return Wanted(r.priority, own_cpu(r.cpu), r.lock_memory, r.required, interface, c.loop.rate_hz)


def as_object(config: str, facts: Facts, findings: Sequence[Finding]) -> dict[str, Any]:
    """The object that `--json` prints."""
    facts_ = facts._asdict()
    facts_["interface"] = facts.interface._asdict() if facts.interface is not None else None
    return {
        "schema": 1,
        "ok": all(finding.level != Grade.LACK for finding in findings),
        "config": config,
        "machine": facts_,
        "findings": [finding._asdict() | {"level": finding.level.label} for finding in findings],
    }


def _print(machine_name: str, axis: str, findings: Sequence[Finding], console: Console) -> None:
    console.print(Text(machine_name, style="bold"), soft_wrap=True)
    for finding in findings:
        line = Text(f"{_SIGN[finding.level]:5}", style=_STYLE[finding.level])
        console.print(line + Text(f"{finding.name}: {finding.found}", style=""), soft_wrap=True)
        if finding.level != Grade.OK:
            for word, text in (("why", finding.reason), ("cure", finding.cure)):
                detail = Text(f"{word:5}", style="dim") + Text(text, style="")
                if console.is_terminal:
                    console.print(Padding(detail, (0, 0, 0, 5)))
                else:
                    console.print(Text("     ") + detail, soft_wrap=True)
    lacks = sum(finding.level == Grade.LACK for finding in findings)
    warnings = sum(finding.level == Grade.WARNING for finding in findings)
    verdict = (
        f"lacks {lacks} of what axis {axis} requires" if lacks else f"all that axis {axis} requires is there"
    )
    console.print(f"{verdict}; {warnings} {'warning' if warnings == 1 else 'warnings'}", soft_wrap=True)
