"""In what logs that are compared differ before anything moved: configuration, bus, machine, version."""

from __future__ import annotations

from collections.abc import Sequence

from pneud.config.toml import flat, tables_of
from pneud.report.gather import LoggedRun

OF_EACH_RUN = ("run", "crc32", "realtime_offset_ns", "faults", "part", "records_before")


def differences(runs: Sequence[LoggedRun]) -> list[tuple[str, list[str]]]:
    """Keys, and what each log says; those in which all agree are left out. The configuration comes first."""
    configs = [flat(tables_of(run.log.config_text)) for run in runs]
    found = _unequal([{key: str(value) for key, value in one.items()} for one in configs])
    kept = [{k: v for k, v in run.log.metadata.items() if k not in OF_EACH_RUN} for run in runs]
    return found + _unequal(kept) + _unequal([run.log.setup for run in runs])


def _unequal(texts: Sequence[dict[str, str]]) -> list[tuple[str, list[str]]]:
    keys = dict.fromkeys(key for text in texts for key in text)
    rows = [(key, [text.get(key, "–") for text in texts]) for key in keys]
    return [(key, values) for key, values in rows if len(set(values)) > 1]
