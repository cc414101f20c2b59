"""The page in the browser beside a loop: twenty of it, one that never reads, one that sends garbage.

    python -m hil.web                          # ten pairs of 10 s without and with the crowd, then 20 stops
    python -m hil.web --pairs 3 --seconds 5 --json

Real time, one daemon with its software rig on a `unixcan` channel. In every pair the axis tracks for a while
with nobody there, and for a while with `pneud web` and its crowd; which comes first alternates. Compared are
the 99th percentiles of how late ticks began, and of sensor to command, and what the page's process holds in
memory, also while stops are timed; what it and its crowd take of a processor is told. The crowd are other
people's machines: it runs here at the lowest priority. A stop is timed from a page's word to the first
command that brakes. Let the machine do nothing else meanwhile. Exit status 1 where a goal is not met.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import math
import os
import secrets
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import PlaceError
from pneud.log.files.reader import read_log
from pneud.rt.processes import counters_of
from pneud.signals import RequestKind

PNEUD = [sys.executable, "-m", "pneud.cli"]
PAGES, STOPS = 20, 20
SETTLE_S = 2.0  # after somebody came or went, before ticks count
PATIENCE_S = 60.0
GARBAGE_S = 0.02  # between two pieces of it
GOAL_RATIO, GOAL_STOP_MS, GOAL_MB = 1.1, 20.0, 150.0


class Window(NamedTuple):
    """A stretch of the run."""

    crowded: bool
    begin_ns: int
    end_ns: int


# the crowd, in a process of its own


async def _reader(host: str, until_s: float) -> int:
    from websockets.asyncio.client import connect  # noqa: PLC0415

    seen = 0
    async with connect(f"ws://{host}/live", proxy=None, max_size=None, open_timeout=60) as line:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(until_s - time.monotonic()):
                while True:
                    found = json.loads(await line.recv())
                    if "picture" in found:
                        seen += 1
                        if seen % 2:  # as the page does
                            await line.send(json.dumps({"seen": found["picture"]}))
    return seen


async def _never_reads(host: str, until_s: float) -> None:
    """Comes again as soon as it is dropped."""
    address, port = host.split(":")
    hello = (
        f"GET /live HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
    )
    while time.monotonic() < until_s:
        _, writer = await asyncio.open_connection(address, int(port), limit=1)
        writer.transport.pause_reading()  # type: ignore[attr-defined]
        writer.write(hello.encode())
        await asyncio.sleep(min(12.0, max(0.0, until_s - time.monotonic())))
        writer.transport.abort()


async def _garbage(host: str, until_s: float) -> None:
    from websockets.asyncio.client import connect  # noqa: PLC0415
    from websockets.exceptions import ConnectionClosed  # noqa: PLC0415

    while time.monotonic() < until_s:
        with contextlib.suppress(ConnectionClosed, OSError, TimeoutError):
            async with connect(f"ws://{host}/live", proxy=None, max_size=None, open_timeout=60) as line:
                for said in ('{"do": "stop", "id": 1}', '{"hello": 1}', "[" * 2000, secrets.token_hex(50)):
                    await line.send(said)
                    await asyncio.sleep(GARBAGE_S)


async def _crowd(host: str, until_s: float) -> None:
    seen, *_ = await asyncio.gather(
        asyncio.gather(*(_reader(host, until_s) for _ in range(PAGES))),
        _never_reads(host, until_s),
        _garbage(host, until_s),
    )
    print(json.dumps(seen))


# the run


class Site:
    """The page's process."""

    def __init__(self, process: subprocess.Popen[str], url: str) -> None:
        self.process = process
        self.url, _, self.token = url.strip().partition("#")
        self.host = self.url.split("/")[2]

    def key(self) -> str:
        """What a page commands with."""
        body = json.dumps({"secret": self.token}).encode()
        headers = {"Content-Type": "application/json", "Origin": self.url[:-1]}
        with urllib.request.urlopen(
            urllib.request.Request(f"{self.url}session", body, headers), timeout=30
        ) as answer:
            return str(json.load(answer)["key"])

    def memory_mb(self) -> float:
        """What it holds."""
        found = counters_of(self.process.pid)
        return found["resident_bytes"] * 1e-6 if found is not None else 0.0


def _used_s(process: subprocess.Popen[str]) -> float:
    """Of a processor, so far."""
    found = counters_of(process.pid)
    return found["user_s"] + found["system_s"] if found is not None else math.nan


class Seen(NamedTuple):
    """What is gathered on the way."""

    memory_mb: list[float]
    pictures: list[int]
    page: list[float]  # share of a processor that its process took in each stretch
    crowd: list[float]  # and all browsers


@contextmanager
def _program(*words: str, idle: bool = False) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [*(("nice", "-n", "19") if idle else ()), *words],
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.communicate(timeout=PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()


@contextmanager
def _page(socket: str) -> Iterator[Site]:
    with _program(*PNEUD, "web", "--socket", socket, "--listen", "127.0.0.1:0", "--operate") as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        if not first.startswith("http"):
            raise SystemExit("hil.web: the page does not come")
        yield Site(process, first.split()[0])


@contextmanager
def _crowding(site: Site, seconds: float) -> Iterator[subprocess.Popen[str]]:
    words = (sys.executable, "-m", "hil.web", "--crowd", site.host, "--seconds", str(seconds))
    with _program(*words, idle=True) as process:
        yield process


def _alone(seconds: float) -> Window:
    time.sleep(SETTLE_S)
    begin_ns = time.monotonic_ns()
    time.sleep(seconds)
    return Window(False, begin_ns, time.monotonic_ns())


def _crowded(socket: str, seconds: float, seen: Seen) -> Window:
    with _page(socket) as site:
        with _crowding(site, seconds + 2.0 * SETTLE_S) as crowd:
            time.sleep(2.0 * SETTLE_S)
            began_s, page_s, crowd_s = time.monotonic(), _used_s(site.process), _used_s(crowd)
            begin_ns = time.monotonic_ns()
            for _ in range(max(1, round(seconds))):
                time.sleep(seconds / max(1, round(seconds)))
                seen.memory_mb.append(site.memory_mb())
            found = Window(True, begin_ns, time.monotonic_ns())
            lasted_s = time.monotonic() - began_s
            seen.page.append((_used_s(site.process) - page_s) / lasted_s)
            seen.crowd.append((_used_s(crowd) - crowd_s) / lasted_s)
            out, _ = crowd.communicate(timeout=PATIENCE_S)
        seen.pictures.extend(json.loads(out))
    return found


def _eventually(holds: Callable[[], bool]) -> None:
    give_up_s = time.monotonic() + PATIENCE_S
    while True:
        with contextlib.suppress(PlaceError, RefusedError):
            if holds():
                return
        if time.monotonic() > give_up_s:
            raise SystemExit("hil.web: the axis does not do what it was asked to")
        time.sleep(0.02)


def _status(socket: str) -> dict[str, Any]:
    with Client(socket) as client:
        return client.ask("status")


def _stops(socket: str, count: int, seen: Seen) -> list[int]:
    """When a page said stop [CLOCK_MONOTONIC, ns], while the crowd is there and the load moves."""
    from websockets.sync.client import connect  # noqa: PLC0415
    from websockets.typing import Origin  # noqa: PLC0415

    said: list[int] = []
    with _page(socket) as site, _crowding(site, 3.0 * count + SETTLE_S):
        time.sleep(SETTLE_S)
        with connect(
            f"ws://{site.host}/live", proxy=None, max_size=None, origin=Origin(site.url[:-1])
        ) as line:
            line.send(json.dumps({"hello": site.key()}))
            number = 0
            while len(said) < count:
                found = json.loads(line.recv(timeout=10))
                if "picture" not in found:
                    continue
                line.send(json.dumps({"seen": found["picture"]}))
                number += 1
                if found["state"] in ("tracking", "holding") and number % 10 == 0:
                    x_mm = 900.0 if found["position_mm"] < 500.0 else 100.0
                    order = {"do": "goto", "id": number, "x_mm": x_mm, "speed_mm_s": 60.0}
                    line.send(json.dumps(order))
                elif found["state"] == "moving" and abs(found["velocity_mm_s"] or 0.0) > 50.0:
                    said.append(time.monotonic_ns())
                    line.send(json.dumps({"do": "stop", "id": number}))
                    _eventually(lambda: _status(socket)["state"] != "moving")
                    seen.memory_mb.append(site.memory_mb())
    return said


def _judged(log: Path, windows: list[Window], said: list[int], seen: Seen) -> dict[str, Any]:
    found: list[dict[str, list[int]]] = [{"lateness": [], "latency": []} for _ in windows]
    braked, n, skipped = [], 0, 0
    for tick in read_log(log):
        if tick.request is not None and tick.request.kind == RequestKind.STOP:
            t = tick.timing
            braked.append(tick.t_ns + t.set_ns + t.cycle_ns + t.send_ns)
        while n < len(windows) and tick.t_ns > windows[n].end_ns:
            n += 1
        if n < len(windows) and tick.t_ns >= windows[n].begin_ns:
            found[n]["lateness"].append(tick.timing.lateness_ns)
            if tick.timing.latency_ns >= 0:
                found[n]["latency"].append(tick.timing.latency_ns)
            skipped += tick.measurement.skipped * windows[n].crowded
    pairs = []
    for k in range(0, len(windows), 2):
        by = {windows[k + i].crowded: found[k + i] for i in (0, 1)}
        pairs.append({
            name: {"alone_us": _p99_us(by[False][name]), "crowd_us": _p99_us(by[True][name])}
            for name in ("lateness", "latency")
        })  # fmt: skip
    stops_ms = []
    for at in said:
        first = next((to for to in braked if to >= at), None)
        if first is not None:
            stops_ms.append((first - at) * 1e-6)
    ratios = {
        name: statistics.median(p[name]["crowd_us"] / p[name]["alone_us"] for p in pairs)
        for name in ("lateness", "latency")
    } if pairs else {}  # fmt: skip
    mb = seen.memory_mb
    stop_ms = statistics.median(stops_ms) if stops_ms else None
    return {
        "pairs": pairs,
        "ratio_p99": {name: round(value, 3) for name, value in ratios.items()},
        "skipped_in_crowd": skipped,
        "stop_ms": None if stop_ms is None else {"median": round(stop_ms, 2), "max": round(max(stops_ms), 2)},
        "memory_mb": {"first": round(mb[0], 1), "max": round(max(mb), 1)} if mb else None,
        "processor": {
            name: round(statistics.median(shares), 3)
            for name, shares in (("page", seen.page), ("crowd", seen.crowd))
        } if seen.page else None,
        "met": all(value <= GOAL_RATIO for value in ratios.values())
        and (stop_ms is None or stop_ms <= GOAL_STOP_MS)
        and len(stops_ms) == len(said)
        and max(mb, default=0.0) <= GOAL_MB,
    }  # fmt: skip


def _p99_us(values: list[int]) -> float:
    return round(float(np.percentile(values, 99)) * 1e-3, 2) if values else float("nan")


def measure(pairs: int, seconds: float, stops: int, config: str) -> dict[str, Any]:
    """The whole run.

    Args:
        pairs: of stretches.
        seconds: of each.
        stops: how many.
        config: the axis.
    """
    name = f"{os.getpid()}-{secrets.token_hex(3)}"
    windows: list[Window] = []
    seen = Seen([], [], [], [])
    with tempfile.TemporaryDirectory(prefix="pneud-web-") as folder:
        socket, log = f"{folder}/console.sock", Path(folder, "run.mcap")
        daemon = (*PNEUD, "--virtual", "--headless", "--json", "--config", config, "--bus", f"unixcan:{name}",
                  "--socket", socket, "--log", str(log))  # fmt: skip
        with _program(*daemon):
            _eventually(lambda: _status(socket)["state"] == "tracking")
            for number in range(pairs):
                turns = (False, True) if number % 2 == 0 else (True, False)
                for crowded in turns:
                    windows.append(_crowded(socket, seconds, seen) if crowded else _alone(seconds))
                print(f"pair {number + 1} of {pairs}", file=sys.stderr)
            said = _stops(socket, stops, seen) if stops else []
        found = _judged(log, windows, said, seen)
    pictures = seen.pictures
    return {**found, "pictures": {"least": min(pictures), "most": max(pictures)} if pictures else None}


def main(words: list[str] | None = None) -> int:
    """Run it; exit status."""
    parser = argparse.ArgumentParser(prog="hil.web", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--pairs", type=int, default=10, help="stretches without and with the crowd")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each stretch")
    parser.add_argument("--stops", type=int, default=STOPS, help="how many are timed behind that")
    parser.add_argument("--config", default="virtual.toml", help="the axis")
    parser.add_argument("--json", action="store_true", help="print one object")
    parser.add_argument("--crowd", metavar="HOST:PORT", help=argparse.SUPPRESS)
    o = parser.parse_args(words)
    if o.crowd:
        asyncio.run(_crowd(o.crowd, time.monotonic() + o.seconds))
        return 0
    found = measure(o.pairs, o.seconds, o.stops, o.config)
    if o.json:
        print(json.dumps(found))
    else:
        for number, pair in enumerate(found["pairs"], 1):
            print(f"{number:3}  " + "   ".join(
                f"{name} p99 {p['alone_us']:8.1f} µs alone {p['crowd_us']:8.1f} with the crowd"
                for name, p in pair.items()
            ))  # fmt: skip
        for key in ("ratio_p99", "skipped_in_crowd", "stop_ms", "processor", "memory_mb", "pictures"):
            print(f"{key}: {found[key]}")
        print("met" if found["met"] else "not met")
    return 0 if found["met"] else 1


if __name__ == "__main__":
    sys.exit(main())
