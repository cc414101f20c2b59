"""`pneud run` and `pneud teach`: what they ask, what they wait for, and what they say."""

from __future__ import annotations

import json
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest

from commands import PNEUD, eventually, object_of, pneud, pneud_here
from console_bench import bench, served
from log_samples import noisy
from pneud.config.toml import tables_of
from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import PlaceError
from pneud.console.going import go_through
from pneud.control import program
from pneud.log.files.reader import read_log
from pneud.safety.faults import FAULT_CURES, F
from pneud.signals import Progress, Request, RequestKind, Stage, State
from test_goto_wait import daemon

PROGRAM = """\
schema = 1
name = "short"
[defaults]
tolerance_mm = 0.5
settle_s = 0.0
standing_mm_s = 20.0
[[record]]
do = "goto"
to_mm = 480.0
[[record]]
label = "pause"
do = "wait"
for_s = 0.05
"""
RECORD = next(noisy(1))
LATCHED = [{"name": "travel", "latched": True, "cure": "lead it back"}]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "short.toml"
    path.write_text(PROGRAM)
    return path


def test_a_program_is_handed_over_whole_and_set_going(tmp_path: Path, file: Path) -> None:
    with bench(tmp_path) as b:
        client = b.connect()
        from pneud.console import programs  # noqa: PLC0415

        tree = programs.tree_of(file)
        reply = b.ask(client, "run", program=tree, record=2, cycles=3)
        assert (reply["ok"], reply["records"]) == (True, 2)
        assert [r.kind for r in b.requests] == [RequestKind.RECORD] * 3 + [RequestKind.RUN]
        assert b.requests[0].values == (2.0, 2.0)
        assert program.step_of(b.requests[1].values).kind == program.GOTO  # type: ignore[union-attr]
        assert b.requests[-1].values == (2.0, 3.0, 0.0)
        assert b.said[-1].endswith("run short from record 2, 3 times → taken")
        b.ring.put(RECORD._replace(tick=RECORD.tick._replace(program=Progress(2, 1, int(Stage.DUE), 0))))
        told = b.ask(client, "status")["program"]
        assert told == {
            "name": "short", "stage": "under_way", "record": 2, "cycle": 1, "of": 2, "label": "pause",
            "words": "wait 0.05 s",
        }  # fmt: skip
        assert b.error(client, "run", program=tree, record=3) == "program"
        assert b.error(client, "run", program={"schema": 1}) == "program"
        assert b.error(client, "run", program=tree, load=True) == "invalid"  # no input would begin it
        assert b.ask(client, "run")["ok"]
        assert b.requests[-1] == Request(RequestKind.RUN, (0.0, 0.0, 0.0))


def status(stage: str = "under_way", state: str = "moving", **changes: Any) -> dict[str, Any]:
    told = {
        "name": "p",
        "stage": stage,
        "record": 2,
        "cycle": 0,
        "of": 2,
        "label": "pause",
        "words": "wait 1 s",
    }
    found = {"axis": "x", "state": state, "silent_s": 0.0, "faults": [], "program": told}
    return found | {"order": {"number": 7, "words": "run p"}} | changes


class Console:
    def __init__(self, *said: dict[str, Any] | None) -> None:
        self.said = list(said)

    def ask(self, verb: str) -> dict[str, Any]:
        assert verb == "status"
        found = self.said.pop(0)
        if found is None:
            raise PlaceError("the daemon's console has hung up")
        return found


def gone_through(*said: dict[str, Any] | None) -> dict[str, Any]:
    return go_through(Console(*said), 7, "run p", lambda _: None, lambda _: None)  # type: ignore[arg-type]


def test_the_end_is_waited_for() -> None:
    assert gone_through(status(), status("ended", "holding"))["state"] == "holding"


@pytest.mark.parametrize(
    ("said", "kind", "words"),
    [
        (
            status("stopped", "fault", faults=LATCHED),
            "fault",
            "record 2 of 2 (wait 1 s, 'pause'): fault travel",
        ),
        (status(order={"number": 8, "words": "goto 3 mm"}), "replaced", "replaced by goto 3 mm"),
        (status(order=None), "replaced", "replaced by another command"),
        (
            status("stopped", order={"number": 8, "words": "stop"}),
            "replaced",
            "replaced by stop; pneud run --resume goes on",
        ),
        (
            status("stopped", "stopping"),
            "stopped",
            "stopped; the axis is stopping; pneud run --resume goes on",
        ),
        (status(program=None), "stopped", "run p: stopped"),
        (status(silent_s=9.0), "gone", "the loop has been silent for 9.0 s"),
        (None, "gone", "hung up"),
    ],
)
def test_what_does_not_come_to_its_end_says_why(said: dict[str, Any] | None, kind: str, words: str) -> None:
    with pytest.raises(RefusedError) as e:
        gone_through(status(), said)
    assert e.value.kind == kind
    assert words in str(e.value)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("run", "give PROGRAM"),
        ("run {} --resume", "--resume goes on"),
        ("run {} --cycles -1", "--cycles -1"),
        ("run {} --from nowhere", "no record has that label"),
        ("run {} --from 0", "records count from 1"),
        ("run {} -o x.mcap", "for --dry-run"),
        ("run {} --dry-run --cycles 0", "--dry-run ends"),
        ("run {} --dry-run --from 9", "record 9: short has 2"),
        ("run none.toml", "cannot be read"),
        ("teach ''", "a point has a name"),
    ],
)
def test_what_makes_no_sense_is_told_in_one_line(file: Path, words: str, told: str) -> None:
    done = pneud_here(*(word.format(file) if word != "''" else "" for word in words.split()))
    assert (done.returncode, done.stdout) == (2, "")
    assert told in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("480.0", "4800.0", "record 1 (goto): 4800 mm lies outside the travel 21 … 979 mm; the nearest"),
        ("for_s", "for", "record 2 (wait), 'pause': has no 'for'; a wait takes "),
        ("schema = 1", "schema = 2", "schema = 1 has to stand in a program, not 2"),
        ("schema = 1", "schema =", "not valid TOML"),
        ("settle_s", "settle", "defaults: has no 'settle'; it takes"),
    ],
)
def test_what_is_wrong_with_a_program_is_told_the_same_with_or_without_a_daemon(
    tmp_path: Path, file: Path, old: str, new: str, words: str
) -> None:
    file.write_text(PROGRAM.replace(old, new, 1))
    with served(tmp_path) as b:
        asked = [pneud_here("run", file, *how) for how in (("--dry-run",), ("--socket", b.path))]
        objects = [pneud_here("run", file, "--json", *how) for how in (("--dry-run",), ("--socket", b.path))]
        assert not b.requests
    assert [(done.returncode, done.stdout) for done in (*asked, *objects)] == [(2, "")] * 4
    assert asked[0].stderr == asked[1].stderr
    assert asked[0].stderr.startswith(f"pneud: {file}: {words}")
    assert asked[0].stderr.count("\n") == 1
    assert objects[0].stderr == objects[1].stderr
    assert json.loads(objects[0].stderr)["error"]["type"] == "usage"


def test_a_dry_run_tells_each_record_and_draws_it(file: Path, tmp_path: Path) -> None:
    log = tmp_path / "dry.mcap"
    done = pneud_here("run", file, "--dry-run", "--cycles", 2, "-o", log)
    assert done.returncode == 0, done.stderr
    assert "goto 480 mm" in done.stdout
    assert "pause: wait 0.05 s" in done.stdout
    assert "2 rounds, " in done.stdout
    assert "│" in done.stdout
    ticks = list(read_log(log))
    assert {t.progress.step for t in ticks} == {0, 1, 2}
    assert ticks[-1].progress.stage == Stage.ENDED
    assert pneud_here("replay", log).returncode == 0
    found = object_of(pneud_here("run", file, "--dry-run", "--json"))
    assert [row["record"] for row in found["records"]] == [1, 2]
    assert found["ended"] is True
    assert found["air_l"] > 0.0


def test_a_dry_run_that_a_fault_ends_names_record_and_cure(file: Path) -> None:
    file.write_text(
        PROGRAM.replace(
            'do = "wait"\nfor_s = 0.05', 'do = "force"\nforce_n = 200\nlow_mm = 400\nhigh_mm = 485'
        )
    )
    done = pneud_here("run", file, "--dry-run")
    assert done.returncode == 1
    found = object_of(pneud_here("run", file, "--dry-run", "--json"))
    assert found["why"].startswith("fault force_window in record 2: ")
    assert FAULT_CURES[F.FORCE_WINDOW] in found["why"]
    assert found["why"] in done.stdout


def test_a_point_is_taught_into_a_file(tmp_path: Path) -> None:
    points = tmp_path / "points.toml"
    with served(tmp_path) as b:
        at = ("--socket", b.path, "-o", points)
        unknown = pneud_here("teach", "a", *at)
        assert (unknown.returncode, points.exists()) == (1, False)
        record = RECORD
        tick = record.tick._replace(state=int(State.HOLDING), present=0, latched=0)
        b.ring.put(record._replace(tick=tick._replace(estimate=tick.estimate._replace(position_m=0.1234))))
        assert pneud_here("teach", "a", *at).stdout == f"a = 123.4 mm, in {points}\n"
        assert object_of(pneud_here("teach", "b", "--json", *at))["mm"] == 123.4
        assert points.read_text() == "a = 123.4\nb = 123.4\n"
        for name in ("above the pick", "pick.1", 'der "höchste" 🏭'):
            pneud_here("teach", name, *at)
        names = ("a", "b", "above the pick", "pick.1", 'der "höchste" 🏭')
        assert tables_of(points.read_text()) == dict.fromkeys(names, 123.4)
    points.write_text("a = ")
    assert pneud_here("teach", "a", "-o", points).returncode == 2
    program = 'schema = 1\n[[record]]\ndo = "wait"\nfor_s = 1.0\n'
    points.write_text(program)
    refused = pneud_here("teach", "a", "-o", points)
    assert (refused.returncode, points.read_text()) == (2, program)
    assert "is no file of points, as 'record' is no position" in refused.stderr


@pytest.mark.slow
@pytest.mark.realtime
def test_over_a_running_daemon(tmp_path: Path, file: Path) -> None:
    with daemon(tmp_path) as (process, path, log):
        at = ("--socket", path)
        with Client(path) as client:
            eventually(lambda: client.ask("status")["state"] == "tracking")
        found = object_of(pneud("run", file, "--cycles", 2, "--json", *at))
        assert (found["program"]["stage"], found["program"]["cycle"]) == ("ended", 2)
        assert "program short: ended, record 2 of 2 (wait 0.05 s, 'pause'), 2 cycles done" in (
            pneud("status", *at).stdout
        )
        attended = subprocess.Popen([*PNEUD, "run", str(file), "--cycles", "0", *at], stderr=subprocess.PIPE)
        with Client(path) as client:
            eventually(lambda: client.ask("status")["program"]["stage"] == "under_way")
            attended.send_signal(signal.SIGINT)
            attended.communicate(timeout=30)
            eventually(lambda: client.ask("status")["program"]["stage"] == "stopped")
        assert pneud("run", "--resume", "--detach", *at).returncode == 0
        with Client(path) as client:
            eventually(lambda: client.ask("status")["program"]["stage"] == "under_way")
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=60)
    assert json.loads(pneud("replay", str(log), "--json").stdout)["identical"] is True
