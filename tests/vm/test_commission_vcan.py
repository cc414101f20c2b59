"""Commissioning over real SocketCAN: a daemon, a plant in a process of its own, and the candump of it all."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from commands import Forked, pneud_forked
from dumped import dumped
from pneud import resources
from pneud.config.toml import changed_text
from pneud.console.client import Client
from pneud.console.endpoint import PlaceError
from pneud.loading import load
from pneud.study.commissioning.truths import drawn

pytestmark = pytest.mark.vm
CONFIG, TRUTH = "vcan.toml", "truth.toml"
SEED, NEAR_V = 12, 0.015


@contextmanager
def running(*args: object, cwd: Path) -> Iterator[Forked]:
    """A command, told to stop in the end."""
    process = Forked(*args, cwd=cwd)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        print(*process.communicate(60))


@contextmanager
def rig(folder: Path, truth: dict[str, Any], log: str = "run.mcap") -> Iterator[Path]:
    """A daemon on vcan0, disarmed, with a plant of which it knows nothing; its socket."""
    text = (resources.configs() / CONFIG).read_text()
    (folder / CONFIG).write_text(text)
    (folder / TRUTH).write_text(changed_text(text, {"plant": truth}))
    (folder / "pneud.dbc").write_bytes((resources.configs() / "pneud.dbc").read_bytes())
    socket, bus = folder / "s", ("--bus", "socketcan:vcan0")
    plant = ("plant", "--config", TRUTH, *bus)
    daemon = ("--config", CONFIG, *bus, "--headless", "--socket", socket, "--log", log)
    with running(*plant, cwd=folder), running(*daemon, cwd=folder) as process:
        for _ in range(600):
            assert process.poll() is None, process.communicate()
            with suppress(PlaceError):  # until it is served
                if status(socket)["state"] == "disarmed":
                    break
            time.sleep(0.1)
        yield socket


def status(socket: Path) -> dict[str, Any]:
    """Asked without a process, which takes seconds to start here."""
    with Client(str(socket)) as client:
        return client.ask("status")


def test_a_rig_on_vcan_is_commissioned_and_candump_tells_it_again(tmp_path: Path) -> None:
    seen = tmp_path / "bus.log"
    with rig(tmp_path, {}) as socket, dumped(seen):
        done = pneud_forked(
            "commission", "--movement-test", "--yes", "--json", "--socket", socket, cwd=tmp_path
        )
    print(done.stdout, done.stderr)
    assert done.returncode == 0
    assert json.loads(done.stdout)["findings"] == []
    assert json.loads((tmp_path / "vcan.proof.json").read_text())["passed"] is True
    bus = ("--dbc", "pneud.dbc", "--config", CONFIG, "-o", "heard.mcap")
    done = pneud_forked("import", seen, *bus, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.split(": ")[1].split()[0]) > 100


def test_a_rig_that_nobody_knows_is_commissioned_to_the_end_on_vcan(tmp_path: Path) -> None:
    truth = drawn(load(CONFIG).config, SEED)["plant"]
    with rig(tmp_path, truth, "logs") as socket:
        words = ("--skip-dynamic", "--yes", "--json", "-o", "page.html")  # gains take minutes of one slow CPU
        done = pneud_forked("commission", *words, "--socket", socket, cwd=tmp_path)
        found_then = status(socket)
    print(done.stdout, done.stderr)
    said = json.loads(done.stdout)
    assert (said["findings"], said["failure"], said["faults"], said["written"]) == ([], None, [], True)
    assert said["verdict"] in ("passed", "missed"), "gains for so slow a loop may miss a limit"
    assert {f["part"] for f in said["after"]["figures"]} == {"sine", "rest", "1 mm", "10 mm", "100 mm"}
    valve, found = truth["valve"], said["parameters"]
    for side, sign in (("positive", 1.0), ("negative", -1.0)):
        true_v = valve[f"dead_zone_{side}_v"] + sign * valve["centre_v"]
        assert abs(found[f"valve.dead_zone_{side}_v"]["value"] - true_v) < NEAR_V
    assert (found_then["state"], found_then["config_changed"]) == ("holding", False)
    assert load(tmp_path / CONFIG).config.valve.centre_v == pytest.approx(
        found["valve.centre_v"]["value"], 1e-3
    )
    assert (tmp_path / "page.html").stat().st_size > 10_000
    # the daemon has begun anew with the edges that were found first, and with all that was written
    assert len(list((tmp_path / "logs").glob("*.mcap"))) == 3


def test_swapped_hoses_are_named_on_vcan(tmp_path: Path) -> None:
    with rig(tmp_path, {"wiring": {"swapped_hoses": True}}) as socket:
        done = pneud_forked(
            "commission", "--movement-test", "--yes", "--json", "--socket", socket, cwd=tmp_path
        )
        armed = pneud_forked("arm", "--socket", socket, "--json", cwd=tmp_path)
    print(done.stdout, done.stderr, armed.stdout, armed.stderr)
    assert done.returncode == 1
    assert [f["name"] for f in json.loads(done.stdout)["findings"]] == ["swapped_hoses"]
    assert json.loads((tmp_path / "vcan.proof.json").read_text())["passed"] is False
