"""`goto --wait`: until the load is in position, or why it does not come there."""

from __future__ import annotations

import json
import os
import secrets
import signal
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from commands import PNEUD, eventually, object_of, pneud
from console_bench import bench
from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import PlaceError
from pneud.console.waiting import SETTLE_S, wait, wait_for_force
from pneud.log.files.reader import read_log
from pneud.signals import State
from running import patient_axis, serves

LATCHED = [{"name": "travel", "latched": True, "cure": "lead it back"}]


class Console:
    """What a console says, one status after the other; the last one again and again."""

    def __init__(self, *said: dict[str, Any] | None) -> None:
        self.said = list(said)
        self.now_s = 100.0

    def ask(self, verb: str) -> dict[str, Any]:
        assert verb == "status"
        found = self.said.pop(0) if len(self.said) > 1 else self.said[0]
        if found is None:
            raise PlaceError("the daemon's console has hung up")
        return found

    def pause(self, seconds: float) -> None:
        assert seconds > 0.0
        self.now_s += seconds


def status(state: str = "holding", error_mm: float | None = 0.0, **changes: Any) -> dict[str, Any]:
    found = {
        "axis": "virtual",
        "state": state,
        "silent_s": 0.001,
        "faults": [],
        "order": {"number": 7, "words": "goto 120 mm"},
        "reference_mm": 120.0,
        "position_mm": 119.9,
        "error_mm": error_mm,
        "in_position": False,
    }
    return found | changes


MOVING = status("moving", 0.5, reference_mm=50.0)


def waited(
    console: Console, tolerance_mm: float | None = None, timeout_s: float | None = None
) -> dict[str, Any]:
    return wait(
        console,  # type: ignore[arg-type]
        7,
        120.0,
        tolerance_mm,
        timeout_s,
        clock=lambda: console.now_s,
        pause=console.pause,
    )


def test_it_waits_until_the_load_is_in_position() -> None:
    there = status(in_position=True)
    console = Console(*[MOVING] * 300, status("starting", None, silent_s=None), *[status()] * 3, there)
    assert waited(console) == there
    assert console.now_s == pytest.approx(100.0 + 304 * 0.05)


def test_another_tolerance_has_to_hold_for_a_while() -> None:
    console = Console(MOVING, status(error_mm=-0.09), status(error_mm=0.11), status(error_mm=0.09))
    assert waited(console, 0.1)["error_mm"] == 0.09
    assert console.now_s == pytest.approx(100.3)


@pytest.mark.parametrize(
    ("said", "kind", "text"),
    [
        (status("fault", None, faults=LATCHED), "fault", "fault travel: lead it back"),
        (status("stopping", faults=LATCHED), "fault", "fault travel"),
        (status(order={"number": 8, "words": "jog 5 mm/s"}), "replaced", "replaced by jog 5 mm/s"),
        (status("disarmed", None, order=None), "replaced", "replaced by another command"),
        (status("stopping"), "stopped", "the axis is stopping"),
        (status("disarmed", None), "stopped", "the axis is disarmed"),
        (status(reference_mm=90.0), "replaced", "the axis holds at 90.000 mm"),
        (None, "gone", "the daemon's console has hung up"),
        (MOVING | {"silent_s": 5.1}, "gone", "the loop has been silent for 5.1 s"),
    ],
)
def test_it_says_why_the_load_does_not_come_there(said: dict[str, Any] | None, kind: str, text: str) -> None:
    with pytest.raises(RefusedError) as refused:
        waited(Console(MOVING, said))
    assert refused.value.kind == kind
    assert str(refused.value).startswith("goto 120 mm: ")
    assert text in str(refused.value)


@pytest.mark.parametrize(
    ("timeout_s", "tolerance_mm", "until_s"),
    [(None, None, 10 * 0.05 + SETTLE_S), (2.0, None, 2.0), (2.0, 0.1, 2.0)],
)
def test_time_runs_out(timeout_s: float | None, tolerance_mm: float | None, until_s: float) -> None:
    console = Console(*[MOVING] * 10, status(error_mm=0.2))
    with pytest.raises(RefusedError, match=r"not in position in time; it is at 119\.900 mm") as refused:
        waited(console, tolerance_mm, timeout_s)
    assert refused.value.kind == "timeout"
    assert console.now_s == pytest.approx(100.0 + until_s)


def test_replies_and_status_tell_which_order_of_motion_was_the_last(tmp_path: Path) -> None:
    with bench(tmp_path) as b:
        client = b.connect()
        assert b.ask(client, "status")["order"] is None
        order = b.ask(client, "goto", x_mm=120)["order"]
        assert b.ask(client, "status")["order"] == {"number": order, "words": "goto 120 mm"}
        assert "order" not in b.ask(client, "mark", text="x")
        assert b.ask(client, "status")["order"]["number"] == order
        b.answer = lambda _: 2
        assert not b.ask(client, "goto", x_mm=130)["ok"]
        assert b.ask(client, "status")["order"]["number"] == order
        b.answer = lambda _: 1
        assert b.ask(client, "stop")["order"] > order
        assert b.ask(client, "status")["order"]["words"] == "stop"


# over a daemon that runs


@contextmanager
def daemon(folder: Path, config: Path | None = None) -> Iterator[tuple[subprocess.Popen[str], str, Path]]:
    """A virtual run without a terminal, its socket and its log."""
    path = f"/tmp/pneud-wait-{os.getpid()}-{secrets.token_hex(3)}.sock"
    log = folder / "run.mcap"
    process = subprocess.Popen(
        [
            *(*PNEUD, "--virtual", "--config", str(config or patient_axis(folder)), "--headless", "--json"),
            *("--socket", path, "--log", str(log)),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        eventually(lambda: serves(path) or process.poll() is not None)
        yield process, path, log
    finally:
        process.kill()
        process.communicate()
        for suffix in ("", ".lock"):
            Path(path + suffix).unlink(missing_ok=True)


def waiting(path: str, *words: str) -> subprocess.Popen[str]:
    """A `goto --wait` that has begun to move the load."""
    eventually(lambda: lease_is_free(path))
    process = subprocess.Popen(
        [*PNEUD, "goto", *words, "--wait", "--speed", "20", "--json", "--socket", path],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    with Client(path) as client:
        eventually(
            lambda: (order := client.ask("status")["order"]) and order["words"].startswith(f"goto {words[0]}")
        )
    return process


def refusal_of(process: subprocess.Popen[str]) -> str:
    out, err = process.communicate(timeout=30)
    assert (process.returncode, err) == (1, "")
    found = json.loads(out)
    assert found["ok"] is False
    kind: str = found["error"]["type"]
    return kind


@pytest.mark.slow
def test_over_a_running_daemon(tmp_path: Path) -> None:
    with daemon(tmp_path) as (process, path, log):
        at = ("--socket", path)
        with Client(path) as client:
            eventually(lambda: client.ask("status")["state"] == "tracking")
        found = object_of(pneud("goto", "450", "--wait", "--json", *at))
        assert (found["ok"], found["state"], found["in_position"]) == (True, "holding", True)
        assert found["position_mm"] == pytest.approx(450.0, abs=0.02)
        assert ", in position" in pneud("status", *at).stdout
        late = pneud("goto", "451", "--wait", "--timeout", "0.02", *at)
        assert late.returncode == 1
        assert (late.stdout, late.stderr.count("\n")) == ("", 1)
        one = waiting(path, "300")
        eventually(lambda: lease_is_free(path))
        with Client(path) as client:
            client.ask("goto", x_mm=452.0)
            assert refusal_of(one) == "replaced"
        with socket.socket(socket.AF_UNIX) as plain:
            plain.connect(path)
            lines = plain.makefile("rw")

            def asked(**fields: Any) -> dict[str, Any]:
                print(json.dumps({"v": 1, "id": 1, **fields}), file=lines, flush=True)
                reply: dict[str, Any] = json.loads(lines.readline())
                return reply

            order = asked(verb="goto", x_mm=455.0)["order"]
            eventually(lambda: (s := asked(verb="status"))["in_position"] and s["order"]["number"] == order)
            lines.close()
        last = waiting(path, "300")
        process.send_signal(signal.SIGTERM)
        assert refusal_of(last) in ("stopped", "gone")
        process.communicate(timeout=60)
    ticks = list(read_log(log))
    assert {t.state for t in ticks if t.in_position} == {State.HOLDING}
    assert pneud("replay", str(log)).returncode == 0


def lease_is_free(path: str) -> bool:
    with Client(path) as client:
        return bool(client.ask("status")["lease"] is None)


def test_a_force_is_waited_for_in_pressing_and_no_hold_before_it_counts() -> None:
    before = status("holding", in_position=True)
    console = Console(before, status("pressing"), found := status("pressing", in_position=True))
    assert wait_for_force(console, 7, 200.0, None, lambda: console.now_s, console.pause) is found  # type: ignore[arg-type]
    late = Console(status("pressing"))
    with pytest.raises(RefusedError, match=r"force 200 N: not in position in time") as e:
        wait_for_force(late, 7, 200.0, 1.0, lambda: late.now_s, late.pause)  # type: ignore[arg-type]
    assert e.value.kind == "timeout"
    torn = Console(status("stopping", faults=LATCHED))
    with pytest.raises(RefusedError, match="fault travel"):
        wait_for_force(torn, 7, 200.0, None, lambda: torn.now_s, torn.pause)  # type: ignore[arg-type]
