"""A daemon with several axes on a bus of its own: from arming to the end, its logs, and a kill."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from browser import Tab, chromium
from commands import PNEUD, eventually, pneud
from pneud import crew, resources
from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import PlaceError
from pneud.log.files.reader import read_log
from pneud.signals import RequestKind, State
from several import several

pytestmark = [pytest.mark.slow, pytest.mark.realtime]
RATE_HZ = 200.0


@contextmanager
def daemon(folder: Path, *options: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Two axes and their rigs, with time-outs that a busy machine does not reach."""
    several(folder, 2, RATE_HZ)
    file, path = folder / "several.toml", str(folder / "s.sock")
    file.write_text(file.read_text().replace("_timeout_ms = 50.0", "_timeout_ms = 400.0"))
    command = [
        *PNEUD,
        "--virtual",
        "--config",
        str(file),
        "--headless",
        "--json",
        "--log",
        str(folder / "logs"),
    ]
    process = subprocess.Popen(
        [
            *command,
            "--log",
            str(folder / "logs"),
            "--socket",
            path,
            "--bus",
            f"unixcan:axes-{os.getpid()}",
            *options,
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process, path
    finally:
        process.kill()
        process.communicate()


def states(path: str) -> list[str]:
    try:
        with Client(path) as client:
            return [one["state"] for one in client.ask("status")["axes"].values()]
    except PlaceError:
        return []


def logs(folder: Path) -> list[Path]:
    return sorted((folder / "logs").glob("*.mcap"))


def summary(process: subprocess.Popen[str]) -> dict[str, Any]:
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert "Traceback" not in err, err
    found: dict[str, Any] = json.loads(out)["axes"]
    return found


def test_two_axes_from_arming_to_the_end_and_their_replays(tmp_path: Path) -> None:
    with daemon(tmp_path) as (process, path):
        eventually(lambda: states(path) == ["tracking", "tracking"])
        with Client(path) as client:
            assert client.ask("stop")["axes"] == ["a1", "a2"]
            eventually(lambda: states(path) == ["holding", "holding"])
            with pytest.raises(RefusedError, match="names no axis"):
                client.ask("goto", x_mm=400.0)
            client.ask("goto_all", axes={"a1": 460.0, "a2": 440.0})
            eventually(lambda: states(path) == ["holding", "holding"])
            client.ask("disarm", axis="a2")
            eventually(lambda: states(path) == ["holding", "disarmed"])
            with pytest.raises(RefusedError, match="arm: not while the axis is holding"):
                client.ask("arm")
        found = summary(process)
    assert set(found) == {"a1", "a2"}
    assert all(one["frames"]["lost"] == 0 and one["log_dropped"] == 0 for one in found.values())
    ways = {}
    for log in logs(tmp_path):
        ticks = list(read_log(log))
        (asked,) = [t for t in ticks if t.request is not None and t.request.kind == RequestKind.GOTO]
        (ways[log.name[:2]],) = {asked.sent[0].data}
        assert json.loads(pneud("replay", log, "--json").stdout)["identical"]
    assert ways["a1"] == ways["a2"]  # by the same SYNC


def test_a_kill_leaves_both_logs(tmp_path: Path) -> None:
    with daemon(tmp_path) as (process, path):
        eventually(lambda: states(path) == ["tracking", "tracking"])
        with Client(path) as client:
            before = {name: one["ticks"] for name, one in client.ask("status")["axes"].items()}
        process.kill()
        process.wait()
        for log in logs(tmp_path):
            eventually(lambda log=log: kept(log) >= before[log.name[:2]])  # type: ignore[misc]


def kept(log: Path) -> int:
    """Ticks of a log, once it is whole."""
    reader = read_log(log)
    ticks = len(list(reader))
    return 0 if reader.truncated else ticks


def test_a_scenario_happens_to_the_axis_that_it_names(tmp_path: Path) -> None:
    text = (resources.scenarios() / "encoder-missing.toml").read_text()
    scenario = tmp_path / "a.toml"
    scenario.write_text(text.replace("schema = 1\n", 'schema = 1\naxis = "a2"\n', 1))
    with daemon(tmp_path, "--scenario", str(scenario)) as (process, path):
        eventually(lambda: states(path)[1:] == ["fault"])
        eventually(lambda: states(path) == ["holding", "fault"])  # as faults.others says
        found = summary(process)
    assert found["a2"]["faults"] == ["encoder_missing"]
    assert found["a1"]["faults"] == []
    assert found["a1"]["state"] == State.HOLDING.label
    assert "scenario" in found["a2"]
    assert "scenario" not in found["a1"]


def test_a_page_shows_and_commands_the_axis_that_is_chosen_on_it(tmp_path: Path) -> None:
    with daemon(tmp_path) as (_, path), chromium(tmp_path) as port:
        eventually(lambda: states(path) == ["tracking", "tracking"])
        words = ("web", "--operate", "--listen", "127.0.0.1:0", "--socket", path)
        with crew.program(*PNEUD, *words, out=subprocess.PIPE, err=subprocess.PIPE) as web:
            assert web.stdout is not None
            url = web.stdout.readline().split()[0]
            tab = Tab(port)
            tab.open(url)
            tab.until("document.getElementById('name').textContent === 'a1'")
            assert tab.js("[...document.querySelectorAll('#choice a')].map(a => a.textContent)") == [
                "a1",
                "a2",
            ]
            tab.js("document.querySelectorAll('#choice a')[1].click()")
            tab.until("document.getElementById('name')?.textContent === 'a2'")
            tab.until("!document.getElementById('controls').hidden")  # its key has come along
            tab.js("document.querySelector('[data-do=hold]').click()")
            eventually(lambda: states(path) == ["tracking", "holding"])
            tab.until("document.getElementById('state').textContent.startsWith('holding')")
            tab.js("document.getElementById('stop').click()")  # all of them
            eventually(lambda: states(path) == ["holding", "holding"])
            with urllib.request.urlopen(f"{url.partition('#')[0]}metrics") as answer:
                told = answer.read().decode()
            assert all(f'pneud_up{{axis="{name}"}} 1' in told for name in ("a1", "a2"))
            tab.close()
