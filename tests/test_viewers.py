"""What other people's programs read: logs with @mcap/core and rerun, a run as it goes with a viewer's client.

The JavaScript packages are found through NODE_PATH; where they or the programs are missing, the tests are
skipped and say so.
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from commands import background, pneud_here
from generators import log as document
from mangled import simulated
from pneud.config.toml import flat
from pneud.log.files.reader import read_log
from pneud.log.format.schema import DERIVED, tick_fields, topics
from pneud.resources import configs
from pneud.view.viewers import Listener

CLIENTS = Path(__file__).parent / "clients"
VIEWERS = configs() / "viewers"


def node(script: str, *args: object) -> Any:
    """What a JavaScript client prints."""
    program = shutil.which("node")
    needed = ("@foxglove/ws-protocol", "@mcap/core", "fzstd", "protobufjs", "ws")
    probe = ";".join(f"require({name!r})" for name in needed)
    if program is None or subprocess.run([program, "-e", probe], capture_output=True, check=False).returncode:
        pytest.skip(f"no node with {' '.join(needed)}: npm install them somewhere and set NODE_PATH")
    done = subprocess.run(
        [program, str(CLIENTS / script), *map(str, args)],
        capture_output=True, text=True, timeout=120, check=False, env=dict(os.environ),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("logs") / "run.mcap"
    simulated(path, 1.5)
    return path


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port: int = listener.getsockname()[1]
        return port


@pytest.mark.slow
@pytest.mark.realtime
def test_a_viewers_client_plots_the_sine(tmp_path: Path) -> None:
    port = free_port()
    where = f"127.0.0.1:{port}"
    options = ("--virtual", "--headless", "--duration", 60, "--log", tmp_path / "x.mcap", "--live-at", where)
    with background(*options):
        seen = node("live.js", f"ws://{where}", 6)
    assert seen["topics"] == {
        "/axis/tick": "pneud.Tick",
        "/can/frames": "pneud.Frames",
        "/events": "foxglove.Log",
    }
    assert seen["frames"] > 1000
    assert seen["parameters"] > 50
    assert seen["before"] == seen["after"] == 95000.0
    t, x = np.array(seen["samples"]).T
    assert len(t) > 2000
    late = t > t[-1] - 2.5e9  # past the way to the reference
    phase = math.pi * (t[late] - t[-1]) * 1e-9
    basis = np.stack((np.sin(phase), np.cos(phase), np.ones(late.sum())), axis=1)
    (a, b, _), *_ = np.linalg.lstsq(basis, x[late], rcond=None)
    fitted = basis @ np.linalg.lstsq(basis, x[late], rcond=None)[0]
    assert math.hypot(a, b) == pytest.approx(0.05, rel=0.02)
    assert np.sqrt(np.mean((fitted - x[late]) ** 2)) < 1e-3


@pytest.mark.slow
def test_mcap_core_reads_a_log(log: Path) -> None:
    seen = node("mcap.js", log)
    ticks = list(read_log(log))
    assert seen["done"]
    assert seen["topics"]["/axis/tick"] == len(ticks)
    assert {"virtual.toml", "pneud.dbc"} <= set(seen["attachments"])
    assert "pneud" in seen["metadata"]
    assert seen["events"] == [e.message for e in read_log(log).events()]
    positions = [t.measurement.position_m for t in ticks]
    assert [p for p in seen["positions"] if p is not None] == [p for p in positions if not math.isnan(p)]


@pytest.mark.slow
def test_rerun_converts_a_log(log: Path, tmp_path: Path) -> None:
    rerun = shutil.which("rerun", path=f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    if rerun is None:
        pytest.skip("no rerun here: pip install rerun-sdk")
    rrd = tmp_path / "x.rrd"
    subprocess.run(
        [rerun, "mcap", "convert", log, "-o", rrd], capture_output=True, timeout=120, check=True,
    )  # fmt: skip
    done = subprocess.run(
        [rerun, "rrd", "print", rrd], capture_output=True, text=True, timeout=120, check=True
    )
    for entity in ("/axis/tick", "/can/frames", "/events"):
        assert entity in done.stdout


@pytest.mark.parametrize("where", ["8765", "127.0.0.1:x", ":8765", "127.0.0.1:70000"])
def test_an_address_that_is_none(where: str) -> None:
    done = pneud_here("--virtual", "--live-at", where)
    assert done.returncode == 2
    assert "ADDRESS:PORT" in done.stderr
    assert done.stdout == ""


def test_a_port_that_is_taken() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        done = pneud_here("--virtual", "--live-at", f"127.0.0.1:{listener.getsockname()[1]}")
    assert done.returncode == 2
    assert "cannot listen there" in done.stderr


def test_parameters_are_for_show() -> None:
    class Parameter:
        def __init__(self, name: str, value: Any) -> None:
            self.name, self.value = name, value

    tables = {"control": {"k1": 95000.0, "observer": {"lambda0": 5.3}}, "name": "virtual"}
    listener = Listener(flat(tables), Parameter)
    everything = {p.name: p.value for p in listener.on_get_parameters(None, [])}
    assert everything == {"control.k1": 95000.0, "control.observer.lambda0": 5.3, "name": "virtual"}
    (answer,) = listener.on_set_parameters(None, [Parameter("control.k1", 1.0)])
    assert answer.value == 95000.0


def test_only_what_somebody_wants_is_packed() -> None:
    class Thing:
        def __init__(self, number: int, topic: str = "") -> None:
            self.id, self.topic = number, topic

    listener = Listener({}, lambda name, value: (name, value))
    tick, events = Thing(1, "/axis/tick"), Thing(2, "/events")
    for client, channel in ((7, tick), (8, tick), (8, events)):
        listener.on_subscribe(Thing(client), channel)
    assert listener.topics == {"/axis/tick", "/events"}
    listener.on_unsubscribe(Thing(8), events)
    listener.on_unsubscribe(Thing(8), tick)
    assert listener.topics == {"/axis/tick"}
    listener.on_unsubscribe(Thing(7), tick)
    assert listener.topics == set()


def field_names() -> set[str]:
    _, fields, nested = tick_fields("compact")
    names = set()
    for field in fields:
        inner = nested.get(field.of.rpartition(".")[2])
        names |= {f"{field.name}.{f.name}" for f in inner} if inner is not None else {field.name}
    return names


def test_the_document_of_the_log_is_made_from_the_schema() -> None:
    written = (Path(__file__).parent.parent / "docs" / "log.md").read_text()
    assert written == document.text(), "python docs/generators/log.py > docs/log.md"
    assert field_names() == set(document.MEANINGS)
    assert all(f"| `{field.name}` |" in written for field in DERIVED)
    for topic in topics("compact"):
        assert f"`{topic.topic}`" in written


def test_layouts_show_what_there_is() -> None:
    known = field_names() | {field.name for field in DERIVED}
    foxglove = (VIEWERS / "foxglove.json").read_text()
    paths = re.findall(r'"value": "(.*?)"', foxglove)
    assert len(paths) > 15
    paths += [p for p in re.findall(r'"topicPath": "(.*?)"', foxglove) if p.startswith("/axis/tick.")]
    assert {path.removeprefix("/axis/tick.") for path in paths} <= known
    assert {"/axis/tick.error_m", "/axis/tick.true_error_m", "/axis/tick.fault_names"} <= set(paths)
    layout = json.loads(foxglove)
    placed = set(re.findall(r'"(\w+!\w+)"', json.dumps(layout["layout"])))
    assert placed == set(layout["configById"])
    curves = [c.get("name", "") for c in ElementTree.parse(VIEWERS / "plotjuggler.xml").iter("curve")]
    assert len(curves) > 15
    assert {c.removeprefix("/axis/tick/").replace("/", ".") for c in curves} <= known
