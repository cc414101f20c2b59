"""Mend a log that was cut short."""

from __future__ import annotations

from pathlib import Path

from pneud.log.files.recovery import recover as mend


def recover(log: str, output: Path) -> int:
    """Write what can be read of a log into another one.

    Raises:
        LogError: not a log, or the new one cannot be written.
    """
    report = mend(Path(log), output)
    print(f"{output}: {report.messages} messages from {report.chunks} chunks")
    if report.damaged_chunks:
        print(f"left out: {report.damaged_chunks} damaged chunks")
    if report.damage:
        print(f"the source: {report.damage}")
    return 0
