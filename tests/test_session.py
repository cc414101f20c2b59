"""An operator's session: the running daemon asked through its socket, and the log of it all replayed."""

from __future__ import annotations

import json
import os
import secrets
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from commands import PNEUD, children, eventually, kill, object_of, pneud, pneud_here
from pneud.console.client import Client, RefusedError
from pneud.log.files.reader import read_log
from pneud.log.format.records import LoggedTick
from pneud.signals import Answer, RequestKind
from running import patient_axis, serves

pytestmark = pytest.mark.slow


@pytest.fixture
def axis(tmp_path: Path) -> Path:
    return patient_axis(tmp_path)


@contextmanager
def daemon(axis: Path, log: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A virtual run without a terminal, and its socket."""
    path = f"/tmp/pneud-test-{os.getpid()}-{secrets.token_hex(3)}.sock"
    process = subprocess.Popen(
        [
            *PNEUD,
            "--virtual",
            "--config",
            str(axis),
            "--headless",
            "--json",
            "--socket",
            path,
            "--log",
            str(log),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        eventually(lambda: serves(path) or process.poll() is not None)
        yield process, path
    finally:
        process.kill()
        process.communicate()
        Path(path).unlink(missing_ok=True)
        Path(path + ".lock").unlink(missing_ok=True)


NOT_ASKED = {  # here; programs and pressing have sessions of their own, and nobody asks for the last one
    *(RequestKind.HOME, RequestKind.RESTART, RequestKind.FORCE),
    *(RequestKind.RECORD, RequestKind.RUN, RequestKind.GO_ON),
    RequestKind.CENTRE,
}


def ended(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Stop the daemon in order: exit status, output, errors."""
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=60)
    return process.returncode, out, err


def until(client: Client, state: str) -> None:
    eventually(lambda: client.ask("status")["state"] == state)


def asked(log: Path) -> list[tuple[RequestKind, Answer]]:
    """Requests and answers in the log."""
    ticks: list[LoggedTick] = list(read_log(log))
    return [(RequestKind(t.request.kind), Answer(t.answer)) for t in ticks if t.request is not None]


def test_a_session_from_arming_to_disarming_and_its_replay(axis: Path, tmp_path: Path) -> None:
    log = tmp_path / "session.mcap"
    samples = tmp_path / "way.csv"
    samples.write_text("t_s,x_mm\n0,450\n0.6,455\n1.2,450\n")
    with daemon(axis, log) as (process, path):
        with Client(path) as client:
            until(client, "tracking")
            assert client.ask("stop")["state"] == "stopping"
            until(client, "holding")
            client.ask("disarm")
            until(client, "disarmed")

            # a probe, which ends by itself
            eventually(lambda: not client.ask("status")["faults"])
            bounds = {"travel_mm": 1.0, "speed_mm_s": 30.0, "force_n": 20.0}
            assert client.ask("probe", voltage_v=0.3, rate_v_s=0.5, **bounds)["state"] == "probing"
            until(client, "disarmed")

            # arm → goto → retarget in motion
            eventually(lambda: not client.ask("status")["faults"])
            assert client.ask("arm")["state"] == "holding"
            assert client.ask("goto", x_mm=520.0)["state"] == "moving"
            time.sleep(0.2)
            assert client.ask("goto", x_mm=450.0)["state"] == "moving"
            until(client, "holding")
            found = client.ask("status")
            assert found["position_mm"] == pytest.approx(450.0, abs=0.5)
            with pytest.raises(RefusedError) as refused:
                client.ask("goto", x_mm=3.0)
            assert refused.value.error["nearest_mm"] == 21.0

            # jog → lease lost
            assert client.ask("jog", velocity_mm_s=10.0, lease_s=0.2)["state"] == "moving"
            until(client, "holding")
            assert pneud_here("status", "--socket", path, "--json").returncode == 0
            client.ask("jog", velocity_mm_s=-10.0, lease_s=1.0)
        with Client(path) as client:  # the other one has gone while jogging
            until(client, "holding")
            client.ask("stop")

            # fault → clear refused while it is present → cleared
            plant = children(process.pid)[2]
            kill(plant, signal.SIGSTOP)
            until(client, "fault")
            eventually(lambda: "encoder_missing" in [f["name"] for f in client.ask("status")["faults"]])
            with pytest.raises(RefusedError) as refused:
                client.ask("clear")
            assert refused.value.kind == "blocked"
            assert "encoder_missing" in [f["name"] for f in refused.value.error["faults"]]
            kill(plant, signal.SIGCONT)

            def cleared() -> bool:
                try:
                    return bool(client.ask("clear")["state"] == "disarmed")
                except RefusedError:
                    return False

            def armed() -> bool:
                try:
                    return bool(client.ask("arm")["state"] == "holding")
                except RefusedError as e:
                    assert e.kind == "blocked"  # the load still swings on the trapped air
                    return False

            eventually(cleared)
            eventually(armed)

        # what people type: track a file, tune, save, disarm
        def said(*words: str, status: int = 0) -> dict[str, object]:
            done = pneud_here(*words, "--socket", path, "--json")
            assert done.returncode == status, (words, done.stdout, done.stderr)
            return object_of(done)

        assert said("track", str(samples))["state"] == "tracking"
        assert said("tune", "set", "k1=90000", "k3=103")["changed"] == "k1 95000 → 90000, k3 104 → 103"
        assert said("tune", "set", "k1=1e9", status=1)["error"]["type"] == "unstable"  # type: ignore[index]
        assert said("tune", "diff")["changes"] == {
            "k1": {"file": 95000.0, "running": 90000.0},
            "k3": {"file": 104.0, "running": 103.0},
        }
        before = axis.read_text()
        said("tune", "save")
        assert said("tune", "diff")["changes"] == {}
        assert axis.read_text() == before.replace("95000.0", "90000.0").replace("k3 = 104.0", "k3 = 103.0")

        # the file is edited and the daemon told by a signal
        axis.write_text(axis.read_text().replace("k1 = 90000.0", "k1 = 91000.0"))
        process.send_signal(signal.SIGHUP)
        with Client(path) as client:
            eventually(lambda: client.ask("tune_get")["gains"]["k1"] == 91000.0)
            until(client, "holding")
        axis.write_text(axis.read_text().replace("travel_max_m = 0.98", "travel_max_m = 0.9"))
        assert said("tune", "reload", status=1)["error"]["type"] == "configuration"  # type: ignore[index]
        said("mark", "end of the session")
        said("disarm")
        with Client(path) as client:
            until(client, "disarmed")
        status, out, err = ended(process)
    assert status == 1, err  # there was a fault
    assert json.loads(out)["faults"]

    kinds = [kind for kind, answer in asked(log) if answer == Answer.TAKEN]
    for kind in RequestKind:
        assert (kind in kinds) is (kind not in NOT_ASKED), kind
    again = object_of(pneud("replay", log, "--json"))
    assert again["identical"] is True
    assert again["mismatches"] == 0
    told = [e.message for e in read_log(log).events() if e.name == "console"]
    who = f"uid {os.geteuid()} pid {os.getpid()}: "
    assert who + "goto 520 mm → taken" in told
    assert who + "clear → blocked" in told
    assert who + "tune: k1 95000 → 90000, k3 104 → 103 → taken" in told
    assert who + "mark end of the session → taken" in told
    assert any("has gone while jogging: hold → taken" in words for words in told)
    assert any(words.startswith("SIGHUP: tune from the file: k1 90000 → 91000") for words in told)


def test_the_reference_in_the_file_is_taken_while_the_axis_tracks(axis: Path, tmp_path: Path) -> None:
    log = tmp_path / "reload.mcap"
    text = axis.read_text()

    def reloaded(change: tuple[str, str]) -> None:
        axis.write_text(text.replace(*change))
        process.send_signal(signal.SIGHUP)

    def amplitude_m() -> float:
        value: float = client.ask("tune_get")["gains"]["reference.amplitude_m"]
        return value

    with daemon(axis, log) as (process, path):
        with Client(path) as client:
            until(client, "tracking")
            reloaded(("amplitude_m = 0.05", "amplitude_m = 0.03"))
            eventually(lambda: amplitude_m() == 0.03)
            found = client.ask("tune_set", gains={"reference.frequency_hz": 1.0, "k1": 90000.0})
            assert found["changed"] == "k1 95000 → 90000, reference.frequency_hz 0.5 → 1"
            # no room for the run-up
            near = {"reference.effective_centre_m": 0.0932, "reference.frequency_hz": 2.0}
            with pytest.raises(RefusedError) as refused:
                client.ask("tune_set", gains=near)
            assert refused.value.kind == "out_of_travel"
            with pytest.raises(RefusedError) as refused:
                client.ask("tune_set", gains={"reference.frequency_hz": 15.0})
            assert refused.value.kind == "beyond_limits"
            assert process.stderr is not None
            reloaded(("amplitude_m = 0.05", "amplitude_m = 0.6"))
            assert any("beyond limits.travel" in line for line in iter(process.stderr.readline, ""))
            assert (amplitude_m(), client.ask("status")["state"]) == (0.03, "tracking")
            reloaded(("k2 = ", "k2 = 0.01 # "))
            assert any("not Hurwitz" in line for line in iter(process.stderr.readline, ""))
            reloaded(("", ""))
            eventually(lambda: amplitude_m() == 0.05)
            client.ask("stop")
            until(client, "holding")
        status, out, err = ended(process)
    assert (status, json.loads(out)["faults"]) == (0, []), err
    again = object_of(pneud("replay", log, "--json"))
    assert (again["identical"], again["mismatches"]) == (True, 0)
    told = [e.message for e in read_log(log).events() if e.name == "console"]
    assert "SIGHUP: tune from the file: reference.amplitude_m 0.05 → 0.03 → taken" in told
    assert any(words.endswith("reference.frequency_hz 1 → 15 → beyond_limits") for words in told)
    assert [answer for kind, answer in asked(log) if kind == RequestKind.GAINS] == [
        Answer.TAKEN,
        Answer.TAKEN,
        Answer.OUT_OF_TRAVEL,
        Answer.BEYOND_LIMITS,
        Answer.TAKEN,
    ]


def test_a_console_that_is_gone_for_good_is_reported_and_the_axis_rests(axis: Path, tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    with daemon(axis, log) as (process, path):
        with Client(path) as client:
            until(client, "tracking")
            client.ask("hold")
            client.ask("jog", velocity_mm_s=5.0, lease_s=0.3)
        kill(children(process.pid)[1])  # its keeper
        assert process.stderr is not None
        assert any("the console is gone" in line for line in iter(process.stderr.readline, ""))
        time.sleep(1.5)  # for the silence to be noticed and the load to come to rest
        status, out, err = ended(process)
    assert status == 1, err
    assert "the console is gone" not in err  # it has been said once
    summary = json.loads(out)
    assert (summary["state"], summary["faults"]) == ("fault", ["console_lost"])
    assert not Path(path).exists()
    assert object_of(pneud("replay", log, "--json"))["identical"] is True


def test_two_daemons_of_one_name_are_told_apart(axis: Path, tmp_path: Path) -> None:
    environment = {**os.environ, "RUNTIME_DIRECTORY": str(tmp_path)}
    environment.pop("PNEUD_SOCKET", None)

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*PNEUD, *words], env=environment, capture_output=True, text=True, timeout=60, check=False
        )

    assert run("status").returncode == 3
    ones = []
    try:
        for n in range(2):
            arguments = [
                "--virtual",
                "--config",
                str(axis),
                "--headless",
                "--log",
                str(tmp_path / f"{n}.mcap"),
            ]
            ones.append(
                subprocess.Popen(
                    [*PNEUD, *arguments],
                    env=environment,
                    stderr=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                )
            )
            eventually(lambda: len(list(tmp_path.glob("*.sock"))) == len(ones))
            time.sleep(0.3)
        done = run("status")
        assert done.returncode == 2
        assert done.stdout == ""
        assert "virtual.sock" in done.stderr
        ones[1].send_signal(signal.SIGTERM)
        ones[1].wait(30)
        assert run("status", "--json").returncode == 0
    finally:
        for one in ones:
            one.kill()
            one.wait()
