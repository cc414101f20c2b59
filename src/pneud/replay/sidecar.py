"""What a log says and no bus carries, in a file beside the exported frames.

Frames tell when each tick began and what it sent and heard. The rest goes here: the configuration and DBC,
what was asked of the axis, which ticks were skipped, what the machine had to say, and, where no SYNC tells
it, how long before its command each tick began.
"""

from __future__ import annotations

import base64
import binascii
import json
from pathlib import Path
from typing import Any, NamedTuple

from pneud.log.files.naming import LogError
from pneud.log.files.reader import LogReader
from pneud.rt.inputs import read_whole
from pneud.signals import Request

SCHEMA = 1
_KEPT = ("name", "bus", "rate_hz", "config", "dbc", "faults", "realtime_offset_ns", "fingerprint")


def beside(path: Path) -> Path:
    """Where the file lies that belongs to exported frames."""
    return path.with_name(path.name + ".json")


class Sidecar(NamedTuple):
    """What belongs to exported frames; ticks are counted from 0 by their SYNC, or command without."""

    metadata: dict[str, str]
    config_text: str
    dbc: bytes
    requests: dict[int, Request]
    skipped: dict[int, int]  # ticks skipped just before one, where there were any
    host: dict[int, int]  # bits of `Host`, where they change
    lasted_ns: dict[int, int]  # from the beginning of each tick to its command, where there is no SYNC

    @property
    def offset_ns(self) -> int:
        """Unix time minus the log's own."""
        return int(self.metadata["realtime_offset_ns"])


class Collector:
    """Notes what does not go into the frames, tick by tick."""

    def __init__(self, log: LogReader) -> None:
        self.log = log
        self._requests: dict[int, Request] = {}
        self._skipped: dict[int, int] = {}
        self._host: dict[int, int] = {}
        self._lasted_ns: dict[int, int] = {}
        self._last_host = 0

    def add(
        self, tick: int, request: Request | None, skipped: int, host: int, lasted_ns: int | None = None
    ) -> None:
        """Take the tick of a SYNC, or the one of a command, which came `lasted_ns` after its beginning."""
        if request is not None:
            self._requests[tick] = request
        if skipped:
            self._skipped[tick] = skipped
        if host != self._last_host:
            self._host[tick] = self._last_host = host
        if lasted_ns is not None:
            self._lasted_ns[tick] = lasted_ns

    def sidecar(self) -> Sidecar:
        """Everything noted."""
        log = self.log
        kept = {key: log.metadata[key] for key in _KEPT if key in log.metadata}
        told = self._requests, self._skipped, self._host, self._lasted_ns
        return Sidecar(kept, log.config_text, log.dbc, *told)


def write(path: Path, s: Sidecar) -> None:
    """Write it.

    Raises:
        OSError: the file cannot be written.
    """
    content = {
        "pneud": SCHEMA,
        "metadata": s.metadata,
        "config": s.config_text,
        "dbc": base64.b64encode(s.dbc).decode("ascii"),
        "requests": [[tick, kind, *values] for tick, (kind, values) in s.requests.items()],
        "skipped": list(s.skipped.items()),
        "host": list(s.host.items()),
        "lasted_ns": list(s.lasted_ns.items()),
    }
    path.write_text(json.dumps(content, indent=1, ensure_ascii=False), encoding="utf-8")


def read(path: Path) -> Sidecar | None:
    """Read it; None where there is none.

    Raises:
        LogError: it is something else, or damaged.
    """
    try:
        content: Any = json.loads(read_whole(path))
    except FileNotFoundError:
        return None
    except OSError as e:
        raise LogError(f"{path}: cannot be read: {e.strerror}") from None
    except (ValueError, RecursionError):
        content = None
    try:
        if content["pneud"] != SCHEMA:
            raise LogError(f"{path}: is of another version of pneud; export the log again")
        metadata = {str(key): str(value) for key, value in content["metadata"].items()}
        found = Sidecar(
            metadata,
            str(content["config"]),
            base64.b64decode(content["dbc"], validate=True),
            {
                int(t): Request(int(kind), tuple(map(float, values)))
                for t, kind, *values in content["requests"]
            },
            {int(tick): int(count) for tick, count in content["skipped"]},
            {int(tick): int(bits) for tick, bits in content["host"]},
            {int(tick): int(lasted_ns) for tick, lasted_ns in content.get("lasted_ns", ())},
        )
        _ = found.offset_ns, float(metadata["rate_hz"]), metadata["config"], metadata["dbc"], metadata["bus"]
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError, binascii.Error):
        raise LogError(f"{path}: not what pneud export writes beside frames; move it away") from None
    return found
