"""The page in a real browser against a running daemon: what it does, who may, and who holds up nobody."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
import re
import shutil
import socket
import ssl
import statistics
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from browser import Tab, chromium
from commands import PNEUD, Figures, eventually
from pneud import crew
from pneud.console.client import Client, RefusedError
from pneud.log.files.reader import read_log
from pneud.log.format.records import LoggedTick
from pneud.signals import RequestKind
from running import Running, running
from test_report_browser import axe_core

pytestmark = [pytest.mark.slow, pytest.mark.realtime]
STOPS = 20
AXE = """axe.run(document, { resultTypes: ["violations"] }).then(r => r.violations
  .filter(v => ["serious", "critical"].includes(v.impact))
  .map(v => v.id + ": " + v.nodes.map(n => n.html.slice(0, 120)).join(" | ")))"""
PROGRAM = """
schema = 1
name = "to and fro"
[[record]]
do = "goto"
to_mm = 400.0
[[record]]
do = "goto"
to_mm = 420.0
speed_mm_s = 10.0
"""
UPGRADE = "\r\n".join((
    "GET /live HTTP/1.1", "Host: {}", "Upgrade: websocket", "Connection: Upgrade",
    "Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "", "",
))  # fmt: skip


class Site:
    """A daemon's page."""

    def __init__(self, run: Running, process: subprocess.Popen[str], url: str) -> None:
        self.run = run
        self.process = process
        self.url, _, self.token = url.partition("#")
        self.host = self.url.split("/")[2]

    def status(self) -> dict[str, Any]:
        with Client(self.run.socket) as client:
            return client.ask("status")

    def state(self) -> str:
        return str(self.status()["state"])

    def ask(self, verb: str, **fields: Any) -> None:
        """Command from elsewhere, as soon as nobody else does."""
        give_up_s = time.monotonic() + 20.0
        while True:
            try:
                with Client(self.run.socket) as client:
                    client.ask(verb, **fields)
                return
            except RefusedError as e:
                if e.kind != "busy" or time.monotonic() > give_up_s:
                    raise
            time.sleep(0.1)

    def engage(self, x_mm: float | None = None) -> None:
        """Have it hold, somewhere."""
        if self.state() == "fault":  # a machine that is busy with other things may lose the console
            self.ask("clear")
        if self.state() == "disarmed":
            self.ask("arm")
            eventually(lambda: self.state() == "holding")
        if x_mm is not None:
            self.ask("goto", x_mm=x_mm, speed_mm_s=400.0)
            eventually(lambda: bool(self.status()["in_position"]))

    def get(self, path: str, **headers: str) -> tuple[int, dict[str, str], str]:
        request = urllib.request.Request(
            f"{self.url}{path}", headers={k.replace("_", "-"): v for k, v in headers.items()}
        )
        try:
            with urllib.request.urlopen(request, timeout=280) as answer:
                return answer.status, dict(answer.headers), answer.read().decode()
        except urllib.error.HTTPError as e:
            return e.code, dict(e.headers), e.read().decode()

    def key(self) -> str:
        body = json.dumps({"secret": self.token}).encode()
        request = urllib.request.Request(
            f"{self.url}session", body, {"Content-Type": "application/json", "Origin": self.url[:-1]}
        )
        with urllib.request.urlopen(request, timeout=30) as answer:
            return str(json.load(answer)["key"])


@contextlib.contextmanager
def page_of(run: Running, *options: str) -> Iterator[Site]:
    command = [*PNEUD, "web", "--socket", run.socket, "--listen", "127.0.0.1:0", *options]
    with crew.program(*command, out=subprocess.PIPE, err=subprocess.PIPE) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        assert first.startswith("http"), process.communicate()
        yield Site(run, process, first.split()[0])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    folder = tmp_path_factory.mktemp("programs")
    (folder / "slowly.toml").write_text(PROGRAM)
    options = ("--operate", "--programs", str(folder))
    with running(tmp_path_factory.mktemp("web")) as run, page_of(run, *options) as found:
        yield found


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    with chromium(tmp_path_factory.mktemp("browser")) as port:
        yield port


@pytest.fixture
def tab(site: Site, browser: int) -> Iterator[Tab]:
    tab = Tab(browser)
    tab.open(f"{site.url}#{site.token}")
    tab.until("!document.getElementById('controls').hidden")
    yield tab
    with contextlib.suppress(Exception):
        tab.close()


def requests(site: Site, since_ns: int) -> list[RequestKind]:
    """What has been asked of the loop since some time, or a little earlier."""
    return [RequestKind(tick.request.kind) for tick in ticks(site, since_ns) if tick.request is not None]


def ticks(site: Site, since_ns: int) -> Iterator[LoggedTick]:
    """From the last snapshot before; the daemon has run through all of the other tests."""
    return (tick for tick in read_log(site.run.log).items(since_ns) if isinstance(tick, LoggedTick))


def test_a_page_arms_goes_and_stops_by_escape(site: Site, tab: Tab) -> None:
    begun_ns = time.time_ns()
    assert site.token not in tab.js("location.href"), "where others could read it"
    tab.js("document.querySelector('[data-do=arm]').click()")
    tab.until("document.getElementById('sure').open")
    assert site.state() == "disarmed", "it asks first"
    tab.js("document.getElementById('yes').click()")
    tab.until("document.getElementById('state').textContent.startsWith('holding')")
    tab.until("document.getElementById('done').textContent.startsWith('in its life: strokes')")
    position_mm = site.status()["position_mm"]
    tab.js("document.getElementById('x').value = '900'; document.getElementById('speed').value = '25'")
    tab.js("document.getElementById('goto').requestSubmit()")
    tab.until("document.getElementById('state').textContent === 'moving'")
    eventually(lambda: abs(site.status()["position_mm"] - position_mm) > 2.0)
    tab.js("document.getElementById('x').focus()")
    tab.key("Escape")  # whatever is being typed
    eventually(lambda: site.state() != "moving")
    assert site.status()["position_mm"] < 890.0
    eventually(lambda: RequestKind.STOP in requests(site, begun_ns))  # once the recorder has written it


@pytest.mark.parametrize("how", ["goto", "jog"])
def test_with_the_page_goes_what_needs_an_operator(site: Site, tab: Tab, how: str) -> None:
    site.engage(300.0)
    if how == "goto":
        tab.js("document.getElementById('x').value = '900'; document.getElementById('speed').value = '25'")
        tab.js("document.getElementById('goto').requestSubmit()")
    else:
        tab.js("document.activeElement.blur()")
        tab.key("ArrowRight", up=False)
    eventually(lambda: site.state() == "moving")
    tab.close()
    eventually(lambda: site.state() != "moving")
    assert site.status()["position_mm"] < 890.0


def test_a_program_runs_is_held_without_its_page_and_goes_on_from_the_next_one(
    site: Site, browser: int, tab: Tab
) -> None:
    site.engage(300.0)
    time.sleep(2.1)  # that command's lease
    tab.js("document.getElementById('programs').open = true")
    tab.until("document.querySelector('#listed button') !== null")
    assert tab.js("document.querySelector('#listed tr').innerText").split()[:3] == ["to", "and", "fro"]
    tab.js("document.querySelector('#listed button').click()")
    tab.until("document.getElementById('program').textContent.includes('record 2 of 2')")
    tab.close()
    eventually(lambda: site.state() == "holding")
    assert site.status()["program"]["stage"] == "stopped"
    assert site.status()["position_mm"] < 419.0
    other = Tab(browser)
    try:
        other.open(f"{site.url}#{site.token}")
        other.until("!document.getElementById('resume').hidden")
        other.js("document.getElementById('resume').click()")
        other.until("document.getElementById('program').textContent.includes('ended')")
        assert site.status()["position_mm"] == pytest.approx(420.0, abs=1.0)
    finally:
        other.close()


def test_a_stop_is_soon_on_the_bus(site: Site, tab: Tab, figures: Figures) -> None:
    """From the key in the browser to the command of the tick that has taken it; reported, not judged."""
    site.engage(300.0)
    time.sleep(2.1)  # that command's lease
    pressed, begun_ns = [], time.time_ns()
    for number in range(STOPS):
        x_mm = 900 if site.status()["position_mm"] < 500.0 else 100
        go = f"document.getElementById('x').value = '{x_mm}'; document.getElementById('speed').value = '60'"
        tab.until("document.getElementById('state').textContent.startsWith('holding')")
        tab.js(f"{go}; document.getElementById('goto').requestSubmit(); document.activeElement.blur()")
        tab.until("document.getElementById('state').textContent === 'moving'")
        pressed.append(time.monotonic_ns())
        tab.key("Escape" if number % 2 else " ")
        eventually(lambda: site.state() != "moving")
    found = taken_ms(site, begun_ns, pressed)
    assert len(found) == len(pressed)
    median_ms = statistics.median(found)
    figures(f"from a key in the browser to the tick that stops: {median_ms:.1f} ms, {max(found):.1f} at most")


def taken_ms(site: Site, since_ns: int, pressed: list[int]) -> list[float]:
    """From each key to the first tick behind it that took a stop."""
    time.sleep(1.0)  # the recorder's
    stops = [
        t.t_ns for t in ticks(site, since_ns) if t.request is not None and t.request.kind == RequestKind.STOP
    ]
    firsts = [next((at for at in stops if at >= key), None) for key in pressed]
    return [(at - key) * 1e-6 for at, key in zip(firsts, pressed, strict=True) if at is not None]


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [390, 1200])
def test_the_page_suits_every_window_and_everybody(
    site: Site, browser: int, tmp_path: Path, width: int, dark: bool
) -> None:
    tab = Tab(browser)
    try:
        tab.call("Page.setBypassCSP", enabled=True)
        tab.size(width, 844, dark)
        tab.open(f"{site.url}#{site.token}")
        tab.until(
            "!document.getElementById('controls').hidden && document.querySelector('#gains input') !== null"
        )
        tab.js("for (const d of document.querySelectorAll('details')) d.open = true")
        tab.until("document.querySelectorAll('#logs tr').length > 0")
        assert tab.js("document.documentElement.scrollWidth") <= width
        box = tab.js("JSON.stringify(document.getElementById('stop').getBoundingClientRect())")
        stop = json.loads(box)
        assert (stop["width"] >= 200, stop["height"] >= 80, stop["bottom"] <= 844) == (True, True, True)
        over = "document.elementFromPoint({}, {}).closest('#stop') !== null"
        assert tab.js(over.format(stop["x"] + stop["width"] / 2, stop["y"] + stop["height"] / 2))
        drawn = """[...document.querySelectorAll('#curves canvas')].map(c => {
            const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
            let n = 0;
            for (let i = 3; i < d.length; i += 4) n += d[i] > 200;
            return n; }).every(n => n > 200)"""
        tab.until(drawn)
        tab.picture(tmp_path / f"page-{width}-{'dark' if dark else 'light'}.png")
        if axe_core():
            tab.js(axe_core() + ";0")
            found = tab.js(AXE)
            assert found == []
    finally:
        tab.close()


def test_a_page_without_the_token_only_looks(site: Site, browser: int) -> None:
    tab = Tab(browser)
    try:
        tab.open(site.url)
        tab.until("document.getElementById('position_mm').textContent !== '–'")
        assert tab.js("document.getElementById('controls').hidden && document.getElementById('stop').hidden")
        begun_ns = time.time_ns()
        before = len(requests(site, begun_ns))
        tab.js("document.querySelector('[data-do=arm]').click(); document.getElementById('yes').click()")
        tab.key("Escape")
        with socket_of(site) as line:
            for said in ({"hello": "x"}, {"do": "stop", "id": 1}):
                line.send(json.dumps(said))
            told = [json.loads(line.recv(timeout=10)) for _ in range(6)]
        assert {"reply": 1, "ok": False, "message": "this page may only look"} in told
        site.ask("mark", text="looked")
        eventually(lambda: RequestKind.MARK in requests(site, begun_ns))  # so that all before it is written
        assert len(requests(site, begun_ns)) == before + 1
    finally:
        tab.close()


@contextlib.contextmanager
def socket_of(site: Site, **headers: str) -> Iterator[Any]:
    from websockets.sync.client import connect  # noqa: PLC0415

    with connect(f"ws://{site.host}/live", proxy=None, origin=headers.get("origin"), open_timeout=30) as line:  # type: ignore[arg-type]
        yield line


def test_other_places_get_nothing(site: Site) -> None:
    from websockets.exceptions import InvalidStatus  # noqa: PLC0415

    for path in ("", "metrics", "logs", "reports/x", "session", "live"):
        assert site.get(path, Host="evil.example:80")[0] == 421
        assert site.get(path, Origin="http://evil.example")[0] == 403
    assert site.get("reports/x", Sec_Fetch_Site="cross-site")[0] == 403
    with pytest.raises(InvalidStatus, match="403"), socket_of(site, origin="http://evil.example"):
        pass
    assert site.get("session")[0] == 405
    assert site.get("reports/..%2f..%2fetc%2fpasswd")[0] == 404


def test_no_frame_no_script_of_others_and_nothing_kept(site: Site) -> None:
    for path in ("", "page.js", "metrics", "logs", "nothing"):
        _, headers, text = site.get(path)
        policy = headers["content-security-policy"]
        assert "frame-ancestors 'none'" in policy
        assert "unsafe" not in policy
        assert headers["cache-control"] == "no-store"
        assert site.token not in text
    assert "<script>" not in site.get("")[2]
    assert not re.search(r"\son\w+=|style=", site.get("")[2])


def test_a_report_is_made_when_it_is_asked_for_and_has_no_origin(site: Site) -> None:
    logs = json.loads(site.get("logs")[2])["logs"]
    assert [log["name"] for log in logs] == [site.run.log.name]
    status, headers, text = site.get(f"reports/{logs[0]['name']}")
    assert status == 200
    assert text.startswith("<!doctype html>")
    assert "sandbox allow-scripts" in headers["content-security-policy"]
    assert "allow-same-origin" not in headers["content-security-policy"]


def test_metrics_in_both_dialects(site: Site) -> None:
    _, headers, text = site.get("metrics")
    assert headers["content-type"].startswith("text/plain; version=0.0.4")
    assert "pneud_ticks_total{" in text
    for process in ("loop", "recorder", "keeper", "console", "web"):
        assert f'pneud_process_threads{{axis="virtual",process="{process}"}}' in text
    _, headers, text = site.get("metrics", Accept="application/openmetrics-text; version=1.0.0")
    assert headers["content-type"].startswith("application/openmetrics-text")
    assert text.endswith("# EOF\n")


def memory_mb(pid: int) -> float:
    found = re.search(r"VmRSS:\s+(\d+)", Path(f"/proc/{pid}/status").read_text())
    assert found is not None
    return int(found[1]) / 1e3


def test_nobody_holds_up_the_others(site: Site) -> None:
    """Twenty pages; one more never reads, one says nonsense, some connect and say nothing at all."""
    from websockets.asyncio.client import connect  # noqa: PLC0415
    from websockets.exceptions import ConnectionClosed  # noqa: PLC0415

    host, port = site.host.split(":")

    async def reader(seconds: float) -> int:
        pictures = 0
        async with connect(f"ws://{site.host}/live", proxy=None, max_size=None, open_timeout=60) as line:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(seconds):
                    while True:
                        found = json.loads(await line.recv())
                        if "picture" in found:
                            pictures += 1
                            await line.send(json.dumps({"seen": found["picture"]}))
        return pictures

    async def nonsense(*each: str | bytes) -> list[bool]:
        return [await ends(said) for said in each]

    async def ends(said: str | bytes) -> bool:
        async with connect(f"ws://{site.host}/live", proxy=None, max_size=None, open_timeout=60) as line:
            try:
                await line.send(said)
                while True:
                    await line.recv()
            except ConnectionClosed:
                return True

    async def flood() -> None:
        with contextlib.suppress(ConnectionClosed):
            async with connect(f"ws://{site.host}/live", proxy=None, max_size=None, open_timeout=60) as line:
                for _ in range(8_000):
                    await line.send('{"do": "stop", "id": 1}')

    async def never_reads() -> float:
        _, writer = await asyncio.open_connection(host, int(port), limit=1)
        writer.transport.pause_reading()  # type: ignore[attr-defined]
        writer.write(UPGRADE.format(site.host).encode())
        await asyncio.sleep(14.0)
        with contextlib.suppress(OSError):
            return float(await asyncio.to_thread(_dropped, writer.get_extra_info("socket")))
        return 1.0

    async def everybody() -> list[Any]:
        mute = [socket.create_connection((host, int(port))) for _ in range(10)]
        try:
            return await asyncio.gather(
                never_reads(), nonsense("{", b"\xff\x00", "[1]", '{"x": 1}', "x" * 5000), flood(),
                *(reader(12.0) for _ in range(20)),
            )  # fmt: skip
        finally:
            for one in mute:
                one.close()

    before = memory_mb(site.process.pid)
    dropped, ended, _, *pictures = asyncio.run(everybody())
    assert dropped == 1.0
    assert ended == [True] * 5
    assert min(pictures) > 24, "two a second on a machine that does other things"
    assert min(pictures) > 0.5 * max(pictures)
    assert memory_mb(site.process.pid) - before < 40.0
    assert site.get("metrics")[0] == 200


def _dropped(end: socket.socket) -> bool:
    """Whether the server has hung up, once all that came is read."""
    import os  # noqa: PLC0415

    other = socket.socket(fileno=os.dup(end.fileno()))
    other.settimeout(5.0)
    try:
        while other.recv(1 << 16):
            pass
    except ConnectionResetError:
        pass
    except TimeoutError:
        return False
    finally:
        other.close()
    return True


def test_a_page_that_sees_nothing_lets_go(site: Site) -> None:
    """The network is gone, and nobody has hung up: what needs an operator ends all the same."""
    site.engage(300.0)
    with socket_of(site) as line:
        line.send(json.dumps({"hello": site.key()}))
        until_welcome(line)
        line.send(json.dumps({"do": "goto", "id": 1, "x_mm": 900.0, "speed_mm_s": 25.0}))
        eventually(lambda: site.state() == "moving")
        eventually(lambda: site.state() != "moving")
    assert site.status()["position_mm"] < 890.0


def until_welcome(line: Any) -> None:
    for _ in range(100):
        found = json.loads(line.recv(timeout=10))
        if "picture" in found:
            line.send(json.dumps({"seen": found["picture"]}))
        if found.get("welcome"):
            return
    raise AssertionError("nobody said welcome")


def test_elsewhere_takes_tls_and_a_password(site: Site, tmp_path: Path) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("no openssl here to make a certificate with")
    chain, key, password = (tmp_path / name for name in ("cert.pem", "key.pem", "password"))
    make = [
        "openssl",
        "req",
        "-x509",
        "-newkey",
        "rsa:2048",
        "-nodes",
        "-subj",
        "/CN=pneud.example",
        "-days",
        "1",
    ]
    subprocess.run([*make, "-keyout", key, "-out", chain], check=True, capture_output=True, timeout=60)
    password.write_text("a very long secret\n")
    password.chmod(0o600)
    tls = ["--listen", "0.0.0.0:0", "--tls-cert", str(chain), "--tls-key", str(key)]
    for words, says in (
        (["--listen", "0.0.0.0:0"], "--tls-cert"),
        (tls, "--password-file"),
        ([*tls[:-1], str(chain), "--password-file", str(password)], "no certificate with its key"),
    ):
        done = subprocess.run([*PNEUD, "web", "--socket", site.run.socket, *words],
                              capture_output=True, text=True, timeout=60, check=False)  # fmt: skip
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1), done.stderr
        assert says in done.stderr
    with page_of(site.run, *tls, "--password-file", str(password), "--operate") as there:
        assert there.url.startswith("https://0.0.0.0:")
        assert there.token == "", "there is a password"
        port = int(there.host.rpartition(":")[2])
        trusting = ssl.create_default_context(cafile=str(chain))
        trusting.check_hostname = False

        def ask(method: str, path: str, body: str | None = None, **headers: str) -> http.client.HTTPResponse:
            line = http.client.HTTPSConnection("127.0.0.1", port, context=trusting, timeout=30)
            line.request(method, path, body, {k.replace("_", "-"): v for k, v in headers.items()})
            return line.getresponse()

        assert [ask("GET", path).status for path in ("/", "/logs", "/metrics")] == [200, 401, 401]
        assert ask("GET", "/metrics", Authorization="Bearer a very long secret").status == 200
        json_ = {"Content_Type": "application/json", "Origin": f"https://127.0.0.1:{port}"}
        assert ask("POST", "/session", '{"secret": "guess"}', **json_).status == 401
        time.sleep(1.1)
        entered = ask("POST", "/session", '{"secret": "a very long secret"}', **json_)
        cookie = entered.getheader("set-cookie") or ""
        assert {part.strip().lower() for part in cookie.split(";")} >= {
            "httponly",
            "secure",
            "samesite=strict",
            "path=/",
        }
        assert json.load(entered)["key"] not in cookie
        assert ask("GET", "/logs", Cookie=cookie.partition(";")[0]).status == 200
        assert there.process.poll() is None
        there.process.terminate()
        said = there.process.communicate(timeout=30)
    assert there.process.returncode == 0
    assert "a very long secret" not in "".join(said)
