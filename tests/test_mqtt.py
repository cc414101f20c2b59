"""Numbers for a plant: the facts of the metrics at a real broker, and what becomes of them where one goes."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import os
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import aiomqtt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from commands import PNEUD, eventually, pneud_here
from console_bench import bench
from pneud import crew
from pneud.console.endpoint import PlaceError
from pneud.mqtt import bridge
from pneud.mqtt.bridge import Bridge, Daemon, Statuses, statuses_of
from pneud.mqtt.broker import Broker, BrokerError, broker_of, password_of
from pneud.mqtt.facts import TopicError, checked, level, messages
from pneud.web.metrics import GROUPS, families
from running import Running, running
from test_metrics import filled

MOSQUITTO = shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/sbin")
needs_broker = pytest.mark.skipif(MOSQUITTO is None, reason="no mosquitto here: apt install mosquitto")


@pytest.fixture(scope="module")
def status(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    with bench(tmp_path_factory.mktemp("bench")) as b:
        return {**filled(b), "log": "/nowhere/run.mcap"}  # what is left on a disk changes


# facts


def leaves(value: Any, *path: str) -> Iterator[tuple[tuple[str, ...], Any]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from leaves(inner, *path, key)
    else:
        yield path, value


def test_they_are_the_facts_of_the_metrics(status: dict[str, Any]) -> None:
    told = {topic.rpartition("/")[2]: json.loads(payload) for topic, payload in messages("p", [status])}
    assert set(told) == set(GROUPS)
    facts = {name: value for group in told.values() for name, value in group.items()}
    for family in families(status)[1:]:
        value = facts[family.name]
        if family.name in ("state", "hunting"):
            held = [next(iter(labels.values())) for _, labels, held in family.samples if held]
            assert value == next(iter(held), None)
        elif family.name in ("fault_present", "fault_latched"):
            assert value == [labels["fault"] for _, labels, held in family.samples if held]
        elif family.name == "info":
            assert value == family.samples[0][1]
        else:
            found = dict(leaves(value))
            for behind, labels, number in family.samples:
                path: tuple[str, ...] = ("le", labels["le"]) if behind == "_bucket" else (behind[1:],)
                path = path if behind else tuple(labels.values())
                assert found.pop(path) == (pytest.approx(number) if math.isfinite(number) else None)
            assert not found
    assert facts["state"] == "fault"
    assert "travel" in facts["fault_latched"]


def test_what_nobody_knows_is_null_and_all_of_it_is_json(tmp_path: Path) -> None:
    with bench(tmp_path) as b:
        found = b.ask(b.connect(), "status")
    told = dict(messages("p", [found]))
    assert json.loads(told["p/load"])["position_meters"] is None
    assert not any("NaN" in payload or "Infinity" in payload for payload in told.values())


def test_several_axes_have_a_level_each(status: dict[str, Any]) -> None:
    topics = {topic for topic, _ in messages("p", [status, {**status, "name": "a/b"}])}
    assert topics == {f"p/{axis}/{group}" for axis in ("virtual", "a-b") for group in GROUPS}
    assert statuses_of({"axes": {"a": status, "b": status}}) == [status, status]
    assert statuses_of(status) == [status]


@given(st.text("+#/$\0\n\x7fé a", max_size=20))
@settings(max_examples=30)
def test_any_name_is_a_level(name: str) -> None:
    assert checked(level(name)) == level(name)
    assert "/" not in level(name)


@pytest.mark.parametrize("topic", ["", "a/+/b", "#", "$SYS/x", "/a", "a/", "a//b", "a\nb", "x" * 257])
def test_what_is_no_topic_is_refused(topic: str) -> None:
    with pytest.raises(TopicError) as told:
        checked(topic)
    assert "\n" not in str(told.value).replace(topic, "")


# which broker


@pytest.mark.parametrize(
    ("url", "host", "port", "tls"),
    [
        ("mqtt://localhost", "localhost", 1883, False),
        ("mqtt://[::1]:1999", "::1", 1999, False),
        ("mqtts://plant.example", "plant.example", 8883, True),
        ("mqtts://plant.example:443/", "plant.example", 443, True),
    ],
)
def test_a_url_names_a_broker(url: str, host: str, port: int, tls: bool) -> None:
    found = broker_of(url)
    assert (found.host, found.port, found.tls is not None) == (host, port, tls)
    assert broker_of(found.url)[:2] == found[:2]


@pytest.mark.parametrize(
    ("url", "more", "why"),
    [
        ("localhost", {}, "must be mqtt://HOST"),
        ("http://x", {}, "must be mqtt://HOST"),
        ("mqtt://", {}, "must be mqtt://HOST"),
        ("mqtt://x/topic", {}, "must be mqtt://HOST"),
        ("mqtt://x:y", {}, "must be mqtt://HOST"),
        ("mqtt://[x", {}, "must be mqtt://HOST"),
        ("mqtt://me:secret@x", {}, "others see a password"),
        ("mqtt://x", {"user": "me", "password": "secret"}, "read on the way"),
        ("mqtt://x", {"ca": Path("ca.pem")}, "certificates are for TLS"),
        ("mqtts://x", {"certificate": Path("c.pem")}, "belong together"),
        ("mqtts://x", {"password": "secret"}, "needs --user"),
    ],
)
def test_what_is_no_broker_is_refused_in_one_line(url: str, more: dict[str, Any], why: str) -> None:
    with pytest.raises(BrokerError, match=why) as told:
        broker_of(url, **more)
    assert "\n" not in str(told.value)
    assert "secret" not in str(told.value)


@pytest.mark.parametrize(
    ("url", "plain"), [("mqtt://localhost", False), ("mqtt://127.1.2.3", False), ("mqtt://x", True)]
)
def test_a_password_may_go_in_plain_text_where_nobody_reads_it(url: str, plain: bool) -> None:
    assert broker_of(url, "me", "secret", plain=plain).password == "secret"


def test_a_password_is_in_a_file_of_its_owner_alone(tmp_path: Path) -> None:
    file = tmp_path / "password"
    file.write_text("se cret \nmore\n")
    file.chmod(0o600)
    assert password_of(file) == "se cret "
    file.chmod(0o644)
    with pytest.raises(BrokerError, match="chmod 600"):
        password_of(file)
    file.write_text("\n")
    file.chmod(0o600)
    with pytest.raises(BrokerError, match="empty"):
        password_of(file)


@pytest.mark.parametrize("option", ["ca", "certificate"])
def test_what_is_no_certificate_is_told(tmp_path: Path, option: str) -> None:
    file = tmp_path / "x.pem"
    more: dict[str, Any] = {option: file, **({"key": file} if option == "certificate" else {})}
    with pytest.raises(FileNotFoundError):
        broker_of("mqtts://x", **more)
    file.write_text("none")
    with pytest.raises(OSError, match="no certificate"):
        broker_of("mqtts://x", **more)


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["--broker", "x"], "must be mqtt://HOST"),
        (["--topic", "a/#"], "no topic"),
        (["--every", "0"], "every"),
        (["--socket", "/nowhere"], "/nowhere"),
    ],
)
def test_a_mistake_is_told_before_anything_is_loaded(words: list[str], why: str) -> None:
    done = pneud_here("mqtt", *words)
    assert done.returncode in (2, 3)
    assert done.stdout == ""
    assert why in done.stderr


# a broker


class Mosquitto:
    """A real one, which can be ended and started again."""

    def __init__(self, folder: Path, *lines: str) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self._folder = folder
        (folder / "mosquitto.conf").write_text("\n".join((
            f"listener {self.port} 127.0.0.1", "log_type all", "log_dest stdout", "user root",
            *(lines or ("allow_anonymous true",)), "",
        )))  # fmt: skip
        self._process: subprocess.Popen[bytes] | None = None
        self.start()

    @property
    def log(self) -> str:
        return (self._folder / "mosquitto.log").read_text(errors="replace")

    def start(self) -> None:
        assert MOSQUITTO is not None
        with (self._folder / "mosquitto.log").open("ab") as log:
            self._process = subprocess.Popen(
                [MOSQUITTO, "-c", str(self._folder / "mosquitto.conf")], stdout=log, stderr=log
            )
        eventually(self._answers)

    def _answers(self) -> bool:
        assert self._process is not None
        assert self._process.poll() is None, self.log
        with contextlib.suppress(OSError):
            socket.create_connection(("127.0.0.1", self.port)).close()
            return True
        return False

    def end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    @property
    def broker(self) -> Broker:
        return Broker("127.0.0.1", self.port)


@pytest.fixture
def mosquitto(tmp_path: Path) -> Iterator[Mosquitto]:
    found = Mosquitto(tmp_path)
    yield found
    found.end()


class Told(Daemon):
    """A daemon that says what a test says."""

    def __init__(self, *statuses: Mapping[str, Any]) -> None:
        super().__init__(lambda: None)  # type: ignore[arg-type, return-value]
        self.statuses: Statuses | None = statuses

    def look(self) -> Statuses:
        if self.statuses is None:
            raise PlaceError("no pneud daemon is running")
        return self.statuses


@asynccontextmanager
async def bridging(daemon: Daemon, broker: Broker) -> AsyncIterator[Bridge]:
    found = Bridge(daemon, broker, "pneud/press", 0.02)
    task = asyncio.create_task(found.run())
    try:
        yield found
    finally:
        found._leave.set()
        await asyncio.wait_for(task, 10.0)


class Ear:
    """Hears everything that a broker has."""

    def __init__(self, client: aiomqtt.Client) -> None:
        self._client = client
        self.last: dict[str, str] = {}
        self.heard: list[tuple[str, str]] = []

    async def until(self, holds: Callable[[dict[str, str]], bool], longest_s: float = 20.0) -> None:
        async with asyncio.timeout(longest_s):
            if holds(self.last):
                return
            async for message in self._client.messages:
                topic, payload = str(message.topic), bytes(message.payload).decode()
                self.last[topic] = payload
                self.heard.append((topic, payload))
                if holds(self.last):
                    return


@asynccontextmanager
async def listening(broker: Broker) -> AsyncIterator[Ear]:
    async with aiomqtt.Client(broker.host, broker.port, username=broker.user, password=broker.password,
                              tls_context=broker.tls) as client:  # fmt: skip
        await client.subscribe("pneud/#", qos=1)
        yield Ear(client)


ONLINE = "pneud/press/online"


@needs_broker
def test_who_comes_later_gets_the_last_word_and_what_does_not_change_is_told_once(
    mosquitto: Mosquitto, status: dict[str, Any]
) -> None:
    daemon = Told(status)

    async def main() -> None:
        async with bridging(daemon, mosquitto.broker), listening(mosquitto.broker) as ear:
            await ear.until(lambda last: last.get(ONLINE) == "true" and len(last) == len(GROUPS) + 1)
            assert ear.last == {ONLINE: "true", **dict(messages("pneud/press", [status]))}
            count = len(ear.heard)
            daemon.statuses = ({**status, "state": "holding"},)
            await ear.until(lambda last: '"state":"holding"' in last["pneud/press/state"])
            assert len(ear.heard) == count + 1
        async with listening(mosquitto.broker) as ear:
            await ear.until(lambda last: len(last) == len(GROUPS) + 1)
            assert ear.last[ONLINE] == "false"

    asyncio.run(main())
    assert "Received SUBSCRIBE from pneud-" not in mosquitto.log


@needs_broker
def test_a_daemon_that_goes_is_offline_until_it_is_back(
    mosquitto: Mosquitto, status: dict[str, Any], capfd: pytest.CaptureFixture[str]
) -> None:
    daemon = Told(status)

    async def main() -> None:
        async with bridging(daemon, mosquitto.broker), listening(mosquitto.broker) as ear:
            await ear.until(lambda last: last.get(ONLINE) == "true")
            daemon.statuses = None
            await ear.until(lambda last: last[ONLINE] == "false")
            daemon.statuses = (status,)
            await ear.until(lambda last: last[ONLINE] == "true")

    asyncio.run(main())
    err = capfd.readouterr().err
    assert err.splitlines() == [
        "pneud: no pneud daemon is running; it is tried again",
        "pneud: the daemon is back",
    ]


@needs_broker
def test_a_broker_that_comes_back_is_told_everything_anew(
    mosquitto: Mosquitto, status: dict[str, Any], monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setattr(bridge, "APART_S", 0.05)
    monkeypatch.setattr(bridge, "FARTHEST_S", 0.2)

    async def main() -> None:
        async with bridging(Told(status), mosquitto.broker):
            async with listening(mosquitto.broker) as ear:
                await ear.until(lambda last: last.get(ONLINE) == "true")
            await asyncio.to_thread(mosquitto.end)
            await asyncio.sleep(0.15)
            await asyncio.to_thread(mosquitto.start)  # it has kept nothing
            async with listening(mosquitto.broker) as ear:
                await ear.until(lambda last: len(last) == len(GROUPS) + 1 and last[ONLINE] == "true")

    asyncio.run(main())
    said = capfd.readouterr().err.splitlines()
    assert said[-1].endswith("is back")
    assert 2 <= len(said) <= 3, said


@needs_broker
def test_tries_grow_rarer(mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch) -> None:
    mosquitto.end()
    monkeypatch.setattr(bridge, "APART_S", 1.0)
    rests: list[float] = []

    async def main() -> None:
        found = Bridge(Told(), mosquitto.broker, "x", 1.0)

        async def rest(longest_s: float) -> None:
            rests.append(longest_s)
            if len(rests) == 9:
                found._leave.set()

        monkeypatch.setattr(found, "_rest", rest)
        await found.run()

    asyncio.run(main())
    for found, wanted in zip(rests, (1, 2, 4, 8, 16, 32, 60, 60, 60), strict=True):
        assert found == pytest.approx(wanted, rel=0.21)


def test_a_broker_that_says_nothing_holds_up_nobody_who_leaves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bridge, "_LEAVE_S", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        broker = Broker("127.0.0.1", silent.getsockname()[1])

        async def main() -> float:
            found = Bridge(Told(), broker, "x", 1.0)
            task = asyncio.create_task(found.run())
            await asyncio.sleep(0.1)
            begun_s = time.monotonic()
            found._leave.set()
            await asyncio.wait_for(task, 8.0)
            return time.monotonic() - begun_s

        assert asyncio.run(main()) < 6.0


@needs_broker
def test_the_wrong_password_is_told_and_the_right_one_lets_in(
    tmp_path: Path, status: dict[str, Any], capfd: pytest.CaptureFixture[str]
) -> None:
    words = tmp_path / "passwords"
    words.touch(0o600)
    tool = shutil.which("mosquitto_passwd")
    if tool is None:
        pytest.skip("no mosquitto_passwd here: apt install mosquitto")
    subprocess.run([tool, "-b", str(words), "press", "right"], check=True, capture_output=True)
    found = Mosquitto(tmp_path, "allow_anonymous false", f"password_file {words}")

    right, wrong = (found.broker._replace(user="press", password=word) for word in ("right", "wrong"))
    tried_twice(found, status, wrong, right)
    (line,) = capfd.readouterr().err.splitlines()
    assert "uthori" in line
    assert "wrong" not in line


def tried_twice(found: Mosquitto, status: dict[str, Any], wrong: Broker, right: Broker) -> None:
    """Not let in, then let in; the broker ends."""

    async def main() -> None:
        async with bridging(Told(status), wrong):
            await asyncio.sleep(0.3)
        async with bridging(Told(status), right), listening(right) as ear:
            await ear.until(lambda last: last.get(ONLINE) == "true")

    try:
        asyncio.run(main())
    finally:
        found.end()


def certificates(folder: Path) -> tuple[Path, Path, Path]:
    """A certificate for 127.0.0.1 that vouches for itself, its key, and a certificate of somebody else."""
    if shutil.which("openssl") is None:
        pytest.skip("no openssl here to make a certificate with")
    made = []
    for name in ("broker", "other"):
        chain, key = folder / f"{name}.pem", folder / f"{name}.key"
        subprocess.run(
            ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes",
             "-keyout", str(key), "-out", str(chain), "-days", "2", "-subj", f"/CN={name}",
             "-addext", "subjectAltName=IP:127.0.0.1"],
            check=True, capture_output=True,
        )  # fmt: skip
        made += [chain, key]
    return made[0], made[1], made[2]


@needs_broker
def test_tls_asks_who_vouches_for_the_broker(
    tmp_path: Path, status: dict[str, Any], capfd: pytest.CaptureFixture[str]
) -> None:
    chain, key, other = certificates(tmp_path)
    found = Mosquitto(tmp_path, "allow_anonymous true", f"certfile {chain}", f"keyfile {key}")
    url = f"mqtts://127.0.0.1:{found.port}"

    tried_twice(found, status, broker_of(url, ca=other), broker_of(url, ca=chain))
    (line,) = capfd.readouterr().err.splitlines()
    assert "certificate" in line


# as its user would


@contextmanager
def publishing(run: Running, port: int) -> Iterator[subprocess.Popen[str]]:
    command = [*PNEUD, "mqtt", "--socket", run.socket, "--broker", f"mqtt://127.0.0.1:{port}",
               "--topic", "pneud/press", "--every", "0.2"]  # fmt: skip
    with crew.program(*command, out=subprocess.PIPE, err=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline().endswith("pneud/press  (Ctrl-C ends it)\n")
        yield process


@needs_broker
@pytest.mark.slow
@pytest.mark.realtime
def test_a_plant_sees_a_daemon_arm_and_its_will_when_the_bridge_is_killed(
    tmp_path: Path, mosquitto: Mosquitto
) -> None:
    with running(tmp_path) as run:

        async def main() -> None:
            with publishing(run, mosquitto.port) as process:
                async with listening(mosquitto.broker) as ear:
                    await ear.until(lambda last: last.get(ONLINE) == "true")
                    assert json.loads(ear.last["pneud/press/state"])["state"] == "disarmed"
                    names = set(json.loads(ear.last["pneud/press/processes"])["process_threads"])
                    assert {"loop", "recorder", "console", "keeper", "mqtt"} <= names
                    from pneud.console.client import Client  # noqa: PLC0415

                    with Client(run.socket) as client:  # nobody holds the lease: a bridge only looks
                        client.ask("arm")
                    await ear.until(lambda last: '"state":"holding"' in last["pneud/press/state"])
                    process.send_signal(signal.SIGKILL)
                    await ear.until(lambda last: last[ONLINE] == "false")
            with publishing(run, mosquitto.port) as process:
                async with listening(mosquitto.broker) as ear:
                    await ear.until(lambda last: last.get(ONLINE) == "true")
                    process.send_signal(signal.SIGTERM)
                    await ear.until(lambda last: last[ONLINE] == "false")
                assert await asyncio.to_thread(process.wait, 20) == 0

        asyncio.run(main())
        run.end()
    assert "Received SUBSCRIBE from pneud-" not in mosquitto.log
