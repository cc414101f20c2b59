"""What the machine refuses, for every verb and every path that it takes: one line, a status, nothing left."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from matplotlib.figure import Figure

from commands import PNEUD, background, eventually, pneud, pneud_forked, pneud_here
from mangled import simulated
from pneud import cli, resources
from pneud.config.reading import load_config
from pneud.console import results
from pneud.console.tuning import values_of
from pneud.log.files.naming import LogError
from pneud.service import machine
from pneud.study import paper
from pneud.verbs import bench, jog, status, teach, track, tune

LIMIT_S = 20.0  # of a command, most of which take milliseconds
DIGITS = "9" * 5000
BRACKETS = "[" * 2000


class Taken(NamedTuple):
    """A path that a command takes: {} in its words; LOG, RECORDING, DBC and OUT stand for good ones."""

    words: str
    suffix: str = ""
    environment: str = ""


READ = [
    Taken("check {}", ".toml"),
    Taken("sim {} --duration 0.01", ".toml"),
    Taken("sim --duration 0.01 --scenario {}", ".toml"),
    Taken("sim --compare {}", ".toml"),
    Taken("plant --bus unixcan:border --config {}", ".toml"),
    Taken("plant --bus unixcan:border --scenario {}", ".toml"),
    Taken("--virtual --config {}", ".toml"),
    Taken("--virtual --scenario {}", ".toml"),
    Taken("doctor {}", ".toml"),
    Taken("design {} --bandwidth 50 --error-mm 1", ".toml"),
    Taken("bench --config {}", ".toml"),
    Taken("install-service --destdir OUT --config {}", ".toml"),
    Taken("export {} -o OUT.csv", ".mcap"),
    Taken("identify {}", ".mcap"),
    Taken("identify LOG --against {}", ".json"),
    Taken("identify LOG --config {}", ".toml"),
    Taken("import {} --dbc DBC -o OUT.mcap", ".log"),
    Taken("import {} --dbc DBC -o OUT.mcap", ".asc"),
    Taken("import {} --dbc DBC -o OUT.mcap", ".blf"),
    Taken("import RECORDING --dbc {} -o OUT.mcap", ".dbc"),
    Taken("import RECORDING --dbc DBC --config {} -o OUT.mcap", ".toml"),
    Taken("recover {} -o OUT.mcap", ".mcap"),
    Taken("replay {}", ".mcap"),
    Taken("replay LOG {}", ".mcap"),
    Taken("replay LOG --config {}", ".toml"),
    Taken("replay LOG --against {}", ".mcap"),
    Taken("report {} -o OUT.html", ".mcap"),
    Taken("report LOG --reference {} -o OUT.html", ".json"),
    Taken("track {}", ".csv"),
    Taken("track {}", ".json"),
]
WRITTEN = [
    Taken("sim --duration 0.01 -o {}", ".mcap"),
    Taken("sim --duration 0.01 -o {}"),
    *(Taken("export LOG -o {}", suffix) for suffix in (".csv", ".parquet", ".log", ".asc", ".blf")),
    Taken("import RECORDING --dbc DBC -o {}", ".mcap"),
    Taken("recover LOG -o {}", ".mcap"),
    Taken("replay LOG -o {}", ".png"),
    Taken("replay LOG --against LOG -o {}", ".png"),
    Taken("report LOG -o {}", ".html"),
    Taken("report LOG --png -o {}", ".html"),
    Taken("reproduce -o {}"),
    Taken("bench --pairs 1 --rate-seconds 0 --turn 0.1 -o {}", ".html"),
    Taken("install-service --destdir {}"),
]
ASKING = [
    "status",
    "arm",
    "disarm",
    "stop",
    "clear",
    "home",
    "hold",
    "restart",
    "goto 1",
    "jog 1",
    "mark x",
    "top",
]
ASKING += [
    "commission --yes",
    "track sine",
    "track steps",
    "tune get",
    "tune set k1=1",
    "tune diff",
    "tune save",
    "tune reload",
]
SOCKETS = [
    *(Taken(f"{words} --socket {{}}", ".sock") for words in ASKING),
    Taken("status", ".sock", "PNEUD_SOCKET"),
    Taken("status", "", "XDG_RUNTIME_DIR"),
]


def names(folder: Path, suffix: str) -> dict[str, str]:
    """Names that nobody can read from, each of another kind."""
    (folder / "file").touch()
    (folder / f"loop{suffix}").symlink_to(f"loop{suffix}")
    (folder / f"folder{suffix}").mkdir()
    os.mkfifo(folder / f"pipe{suffix}")
    (folder / f"void{suffix}").symlink_to("/dev/null")
    (folder / f"endless{suffix}").symlink_to("/dev/zero")
    (folder / f"noise{suffix}").write_bytes(bytes(range(256)) * 3)
    return {
        "nothing": f"{folder}/nothing{suffix}",
        "below a file": f"{folder}/file/x{suffix}",
        "a loop": f"{folder}/loop{suffix}",
        "too long": "x" * 5000 + suffix,
        "a long path": f"{folder}/" + "x/" * 2500 + suffix,
        "no such user": f"~nosuchuser/x{suffix}",
        "no UTF-8": f"{folder}/bad\udcff{suffix}",
        "two lines": f"{folder}/two\nlines\x1b[2J{suffix}",
        "a folder": f"{folder}/folder{suffix}",
        "a pipe": f"{folder}/pipe{suffix}",
        "void": f"{folder}/void{suffix}",
        "endless": f"{folder}/endless{suffix}",
        "noise": f"{folder}/noise{suffix}",
    }


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("good")
    simulated(folder / "run.mcap", 0.2)
    assert pneud_here("export", folder / "run.mcap", "-o", folder / "run.log").returncode == 0
    (folder / "run.log.json").unlink()
    dbc = resources.configs() / "pneud.dbc"
    return {"LOG": str(folder / "run.mcap"), "RECORDING": str(folder / "run.log"), "DBC": str(dbc)}


class Daemon:
    """Whom `track` and `tune` ask."""

    def __init__(self, *_: str | None) -> None:
        pass

    def __enter__(self) -> Daemon:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def ask(self, verb: str, **_: object) -> dict[str, Any]:
        assert verb == "status", "nothing may be uploaded"
        bounds = dict.fromkeys(("speed_mm_s", "acceleration_mm_s2", "jerk_mm_s3"), 1e3)
        return {"limits": {**bounds, "min_mm": 0.0, "max_mm": 100.0}, "position_mm": 1.0}


@pytest.fixture(scope="module")
def cache() -> Path:
    """The usual one: nothing is to be compiled anew for every test."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


@pytest.fixture(autouse=True)
def in_hand(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, cache: Path) -> Iterator[None]:
    """No command of these goes on for long, or out of the test's folder."""

    def nothing(*_: object) -> None:
        raise LogError("got as far as its work")

    monkeypatch.setattr(paper, "reproduce", nothing)
    monkeypatch.setattr(bench, "_take_turns", nothing)
    monkeypatch.setattr(machine, "attempt", lambda *_: [])
    monkeypatch.setattr(Figure, "savefig", lambda _, path, **__: Path(path).write_bytes(b"picture"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    for name in ("HOME", "XDG_RUNTIME_DIR", "STATE_DIRECTORY", "TMPDIR"):
        (tmp_path / name).mkdir(mode=0o700)
        monkeypatch.setenv(name, str(tmp_path / name))
    monkeypatch.delenv("PNEUD_SOCKET", raising=False)
    monkeypatch.chdir(tmp_path)
    hangs = signal.signal(signal.SIGALRM, lambda *_: pytest.fail("hangs"))
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, hangs)


def words_of(taken: Taken, name: str, good: dict[str, str], out: Path) -> list[str]:
    """The words of a command."""
    known = {**good, "{}": name}
    found = []
    for word in taken.words.split(" "):
        for key, value in known.items():
            word = word.replace(key, value)  # noqa: PLW2901
        found.append(word.replace("OUT", str(out)))
    return found


def refused(done: subprocess.CompletedProcess[str], why: object) -> None:
    """Nothing on standard output, one printable line on standard error, and the status of a refusal."""
    assert done.returncode in (2, 3), (why, done)
    assert done.stdout == "", why
    (line,) = done.stderr.splitlines() or [""]
    assert line.startswith("pneud: "), (why, line)
    assert line.isprintable(), (why, line)


def run(taken: Taken, name: str, good: dict[str, str], out: Path) -> subprocess.CompletedProcess[str]:
    signal.alarm(int(LIMIT_S))
    try:
        return pneud_here(*words_of(taken, name, good, out))
    finally:
        signal.alarm(0)


def contents(folder: Path) -> set[str]:
    """What lies in a folder, apart from what is kept for later runs."""
    found = {path.relative_to(folder) for path in folder.rglob("*")}
    return {str(p) for p in found if p.parts[0] != "TMPDIR" and "pneud" not in p.parts}


def ids(taken: Taken) -> str:
    return f"{taken.environment} {taken.words}{taken.suffix}".strip()


@pytest.mark.parametrize("taken", READ, ids=ids)
def test_what_cannot_be_read(
    taken: Taken, good: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(track, "Client", Daemon)
    (tmp_path / "bad").mkdir()
    for kind, name in names(tmp_path / "bad", taken.suffix).items():
        before = contents(tmp_path)
        refused(run(taken, name, good, tmp_path / "out"), (kind, taken.words))
        assert contents(tmp_path) == before, kind


@pytest.mark.slow
@pytest.mark.parametrize("taken", WRITTEN, ids=ids)
def test_what_cannot_be_written(taken: Taken, good: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "bad").mkdir()
    for kind, name in names(tmp_path / "bad", taken.suffix).items():
        before = contents(tmp_path)
        if kind in ("a pipe", "endless"):
            continue
        if kind == "no UTF-8":  # names it when it has written it, which takes real streams
            if taken.words.startswith(("bench", "reproduce")):
                continue
            done = pneud_forked(*words_of(taken, name, good, tmp_path / "out"))
        else:
            done = run(taken, name, good, tmp_path / "out")
        if done.returncode in (0, 1):
            assert Path(name).exists(), kind
            assert all(line.startswith(REMARKS) for line in done.stderr.splitlines()), kind
            continue
        refused(done, kind)
        assert contents(tmp_path) == before or not taken.suffix, kind


@pytest.mark.parametrize("taken", SOCKETS, ids=ids)
def test_sockets_that_are_none(
    taken: Taken, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    # not where somebody else's daemon may run
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path_factory.mktemp("empty")))
    (tmp_path / "bad").mkdir()
    for kind, name in names(tmp_path / "bad", taken.suffix).items():
        if not taken.words.startswith("status") and kind not in ("too long", "no UTF-8", "two lines"):
            continue  # all of them look for it in the same way
        if taken.environment:
            monkeypatch.setenv(taken.environment, name)
        before = contents(tmp_path)
        refused(run(taken, name, {}, tmp_path / "out"), kind)
        assert contents(tmp_path) == before, kind


@pytest.fixture
def short_runtime(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A folder for sockets, whose paths have 107 bytes."""
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        monkeypatch.setenv("XDG_RUNTIME_DIR", folder)
        yield


DAEMON = [Taken("--virtual --duration 0.3 --headless --log {}", ".mcap")]
DAEMON += [Taken("--virtual --duration 0.3 --headless --log {}")]
DAEMON += [Taken("--virtual --duration 0.3 --headless --socket {}", ".sock")]
DAEMON += [Taken("--virtual --duration 0.3 --headless", ".sock", "PNEUD_SOCKET")]
DAEMON += [Taken("--virtual --duration 0.3 --headless", "", "STATE_DIRECTORY")]


@pytest.mark.slow
@pytest.mark.parametrize("taken", DAEMON, ids=ids)
def test_a_daemon_takes_a_name_or_refuses_it(
    taken: Taken, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, short_runtime: None
) -> None:
    (tmp_path / "bad").mkdir()
    for kind, name in names(tmp_path / "bad", taken.suffix).items():
        before = contents(tmp_path)
        if taken.environment:
            monkeypatch.setenv(taken.environment, name)
        done = pneud_forked(*words_of(taken, name, {}, tmp_path / "out"), timeout=LIMIT_S)
        assert "Traceback" not in done.stderr, (kind, done.stderr)
        if done.returncode in (2, 3):
            said = [line for line in done.stderr.splitlines() if not line.startswith(REMARKS)]
            refused(
                subprocess.CompletedProcess(done.args, done.returncode, done.stdout, "\n".join(said)), kind
            )
            assert contents(tmp_path) <= before, kind
        else:
            assert done.returncode in (0, 1), (kind, done)
            logs = [
                p for p in tmp_path.rglob("*.mcap") if p.is_file() and str(p) != f"{tmp_path}/bad/noise.mcap"
            ]
            assert logs, kind
            assert all(p.stat().st_size > 1000 for p in logs), (kind, done)
            for path in logs:
                path.unlink()


# what is said of a run or a recording that went as far as it could, and is no refusal
REMARKS = (
    *("pneud: the law runs in Python", "pneud: fifo", "pneud: no real time", "pneud: never armed"),
    *("requests were inferred", "174 commands are not"),
)


OTHERS = [t for t in READ if t.words.startswith(("check", "sim", "replay", "export", "recover", "track"))]


@pytest.mark.parametrize("taken", [*OTHERS, *SOCKETS[:3]], ids=ids)
def test_what_belongs_to_somebody_else(
    taken: Taken, good: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder of the tests may be entered by who runs them alone: all who is another is shut out."""
    if os.geteuid():
        pytest.skip("only root can be somebody else")
    monkeypatch.setattr(track, "Client", Daemon)
    shut = tmp_path / "shut"
    shut.mkdir(mode=0o700)
    unreadable = tmp_path / f"unreadable{taken.suffix}"
    unreadable.write_bytes(b"x")
    unreadable.chmod(0)
    run(taken, f"{tmp_path}/nothing{taken.suffix}", good, tmp_path / "out")  # loads what it needs
    before = contents(tmp_path)
    for name in (f"{shut}/x{taken.suffix}", str(unreadable)):
        if taken.environment:
            monkeypatch.setenv(taken.environment, name)
        os.seteuid(65534)
        try:
            done = run(taken, name, good, shut / "out")
        finally:
            os.seteuid(0)
        refused(done, name)
        assert contents(tmp_path) == before


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("check {}.toml", f"name = {DIGITS}"),
        ("check {}.toml", f"x = {BRACKETS}"),
        ("sim --scenario {}.toml", f"name = {DIGITS}"),
        ("sim --scenario {}.toml", f"x = {BRACKETS}"),
        ("replay LOG --config {}.toml", f"x = {BRACKETS}"),
        ("report LOG -o OUT.html --reference {}.json", DIGITS),
        ("report LOG -o OUT.html --reference {}.json", "[" * 100_000),
        ("track {}.json", f"[[{DIGITS}]]"),
        ("track {}.json", f"[[{'9' * 400}]]"),
        ("track {}.json", "[" * 100_000),
        ("track {}.csv", f"0,0\n1,{DIGITS}\n"),
        ("import RECORDING --dbc DBC -o OUT.mcap --config {}.toml", f"x = {BRACKETS}"),
    ],
)
def test_numbers_and_brackets_beyond_all_measure(
    name: str, text: str, good: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(track, "Client", Daemon)
    stem, dot, suffix = name.partition("{}")[2].split(" ")[0].partition(".")
    assert not stem
    assert dot
    (tmp_path / f"odd.{suffix}").write_text(text)
    refused(run(Taken(name), str(tmp_path / "odd"), good, tmp_path / "out"), name)


@pytest.mark.parametrize("value", [DIGITS, BRACKETS, "[" * 100_000, "'", "{" * 2000, "\udcff", "a\nb", "\0"])
def test_settings_beyond_all_measure(value: str, good: dict[str, str]) -> None:
    refused(pneud_here("replay", good["LOG"], "--set", f"control.k1={value}"), value[:10])
    refused(pneud_here("replay", good["LOG"], "--set", f"{value}=1"), value[:10])


def test_a_sidecar_of_brackets(good: dict[str, str], tmp_path: Path) -> None:
    recording = tmp_path / "run.log"
    recording.write_bytes(Path(good["RECORDING"]).read_bytes())
    for text in ("[" * 100_000, DIGITS, "[]", "\xff"):
        (tmp_path / "run.log.json").write_text(text, encoding="latin-1")
        refused(pneud_here("import", recording, "--dbc", good["DBC"], "-o", tmp_path / "x.mcap"), text[:9])


def streams(words: list[str], redirection: str, **more: Any) -> subprocess.CompletedProcess[str]:
    """A command whose standard streams are other ones."""
    return subprocess.run(
        ["sh", "-c", f'exec "$@" {redirection}', "sh", *PNEUD, *words],
        capture_output=True, text=True, check=False, timeout=60, **more,
    )  # fmt: skip


SAYING = ["--help", "--version", "check virtual.toml", "sim --duration 0.01", "replay LOG"]
PROGRAM = Path(__file__).parents[1] / "examples" / "programs" / "pick-and-place.toml"
CAMPAIGN = Path(__file__).parents[1] / "examples" / "campaigns" / "spread.toml"
GOLDEN = Path(__file__).with_name("golden") / "composite.mcap"
NEW = "new x -o OUT.toml --cylinder 25/10 --stroke 200 --mass 3 --valve 350 --yes"
WORKING = [*SAYING, "sim --duration 0.01 --json", "sim --help", "doctor", "doctor --json", "check SCENARIO"]
WORKING += ["replay LOG --json", "replay LOG --against LOG", "replay LOG --set control.k1=9e4"]
WORKING += ["export LOG -o OUT.csv", "export LOG -o OUT.log", "import RECORDING --dbc DBC -o OUT.mcap"]
WORKING += ["scenarios", "scenarios --json", "logs .", "logs . --json", "nodes explain canopen.toml"]
WORKING += ["map RECORDING", "map LOG --json", f"run {PROGRAM} --dry-run"]
WORKING += [f"campaign {CAMPAIGN} --runs 1 --jobs 1 -o OUT", f"campaign {CAMPAIGN} --run 0 --json"]
WORKING += ["commission --virtual --movement-test", "commission --virtual --movement-test --json"]
WORKING += ["recover LOG -o OUT.mcap", "report LOG -o OUT.html", "install-service --destdir OUT"]
WORKING += [f"learnt {GOLDEN}", f"learnt {GOLDEN} --json", NEW, f"{NEW} --json"]
WORKING += ["design virtual.toml --bandwidth 50 --error-mm 1", "bench --pairs 1 --disturb --json"]
TELLING = ["status --json", "arm", "disarm", "stop", "clear", "home", "hold", "goto 1", "jog 1 --for 0.01"]
TELLING += ["mark x", "force 100", "teach x -o OUT.toml", "track sine", "track steps 2 3"]
TELLING += ["tune get", "tune set k1=1", "tune diff", "tune save"]
TELLING += ["tune reload", *(f"{words} --json" for words in ("arm", "tune get", "jog 1 --for 0.01"))]
FULL = "standard output: No space left on device"
MUTE = {
    "plant",
    "top",
    "view",
    "web",
    "mqtt",
    "reproduce",
    "identify",
    "restart",
    "prove",
}  # silent; they draw; take long


class Console(Daemon):
    """Whom all verbs ask that print an answer."""

    def ask(self, verb: str, **fields: object) -> dict[str, Any]:
        config = resources.configs() / "virtual.toml"
        gains = values_of(load_config(config))
        return {**super().ask("status"), "axis": "x", "state": "holding", "changed": "", "gains": gains,
                "faults": [], "position_mm": 1.0, "config": str(config)}  # fmt: skip


def test_all_that_print_are_tried() -> None:
    assert {words.split()[0] for words in (*WORKING, *TELLING)} | MUTE >= set(cli.verbs())


@pytest.mark.slow
@pytest.mark.parametrize("words", [*WORKING, *TELLING])
def test_a_full_device_as_standard_output(
    words: str, good: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (results, status, jog, teach, track, tune):
        monkeypatch.setattr(module, "Client", Console)
    for name in ("_track", "_disturb"):
        monkeypatch.setattr(bench, name, lambda *_: {})
    scenario = str(resources.scenarios() / "babble.toml")
    done = pneud_forked(
        *words_of(Taken(words), "", {**good, "SCENARIO": scenario}, tmp_path / "out"), out_to="/dev/full"
    )
    assert done.returncode == 3, done
    said = [line for line in done.stderr.splitlines() if not line.startswith(REMARKS)]
    if "--json" in words:
        assert [json.loads(line)["error"]["message"] for line in said] == [FULL], done
    else:
        assert said == [f"pneud: {FULL}"], done


@pytest.mark.slow
@pytest.mark.parametrize("words", SAYING)
@pytest.mark.parametrize("closed", ["<&-", "<&- >&- 2>&-"])
def test_closed_standard_streams(words: str, closed: str, good: dict[str, str]) -> None:
    done = streams([good.get(word, word) for word in words.split()], closed)
    usual = streams([good.get(word, word) for word in words.split()], "")
    assert done.returncode == usual.returncode, done
    assert "Traceback" not in done.stderr
    if ">&-" not in closed:
        assert len(done.stdout) > 0.5 * len(usual.stdout)


@pytest.mark.slow
@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_a_run_with_closed_streams_has_its_log(closed: str, tmp_path: Path, short_runtime: None) -> None:
    log = tmp_path / "x.mcap"
    words = ["--virtual", "--headless", "--json", "--duration", "0.5", "--log", str(log)]
    done = streams(words, closed)
    assert done.returncode in (0, 1), done
    assert "Traceback" not in done.stderr
    assert log.stat().st_size > 1000
    assert pneud_here("export", log, "-o", tmp_path / "x.csv").returncode == 0


@pytest.mark.slow
def test_a_run_whose_log_is_removed_meanwhile_says_so(tmp_path: Path, short_runtime: None) -> None:
    log = tmp_path / "gone" / "x.mcap"
    log.parent.mkdir()
    with background("--virtual", "--headless", "--json", "--duration", "1", "--log", log) as daemon:
        eventually(lambda: log.exists() and log.stat().st_size > 0)
        shutil.rmtree(log.parent)
        _, err = daemon.communicate(timeout=60)
    assert daemon.returncode == 1
    assert f"{log} is not whole: its file or folder was removed" in err


@pytest.mark.slow
@pytest.mark.parametrize("words", ["--help", "check virtual.toml", "status"])
def test_nobody_waits_for_the_end_of_a_start(words: str) -> None:
    """Ctrl-C while modules are loaded; before Python's own start is over, the signal ends the process."""
    for ms in (5, 10, 20, 35, 50, 70, 100, 200):
        process = subprocess.Popen(
            [*PNEUD, *words.split()], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        time.sleep(ms / 1e3)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=LIMIT_S)
        if process.returncode == -signal.SIGINT or "pneud" not in err:
            continue  # the interpreter was not yet ours
        assert process.returncode in (130, 0, 1, 3), (ms, err)
        assert "Traceback" not in err, (ms, err)


def test_an_answer_of_another_version_is_said_to_be_one(tmp_path: Path) -> None:
    path = tmp_path / "x.sock"
    with socket.socket(socket.AF_UNIX) as daemon:
        daemon.bind(str(path))
        daemon.listen()

        def answer() -> None:
            with daemon.accept()[0] as client:
                client.recv(4096)
                client.sendall(
                    b'{"v": 1, "id": 1, "ok": true, "name": "x", "bus": "b", "state": "disarmed"}\n'
                )

        thread = threading.Thread(target=answer)
        thread.start()
        done = pneud_here("status", "--socket", path)
        thread.join()
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (3, "", 1), done
    assert "no 'silent_s': it is of another version than this pneud" in done.stderr


@contextmanager
def no_file_longer_than(size: int) -> Iterator[None]:
    """As `ulimit -f` has it, for this process and those that it starts."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


FILLED = [t for t in WRITTEN if t.words.startswith(("export", "import", "recover", "report LOG -o"))]


@pytest.mark.parametrize("taken", FILLED, ids=ids)
def test_what_the_disk_takes_no_more_of(taken: Taken, good: dict[str, str], tmp_path: Path) -> None:
    before = contents(tmp_path)
    with no_file_longer_than(1000):
        done = run(taken, f"{tmp_path}/x{taken.suffix}", good, tmp_path / "out")
    refused(done, taken.words)
    assert done.returncode == 3
    assert f"x{taken.suffix}: cannot be written: " in done.stderr
    assert done.stderr.endswith("ile too large\n")
    assert contents(tmp_path) == before


@pytest.mark.slow
def test_a_run_that_cannot_begin_leaves_no_empty_log(tmp_path: Path, short_runtime: None) -> None:
    with no_file_longer_than(100_000):
        done = pneud("--virtual", "--headless", "--duration", "1", "--log", tmp_path / "x.mcap")
    assert done.returncode == 3
    assert done.stderr.splitlines()[-1] == "pneud: no memory for the ring to the recorder: File too large"
    assert not (tmp_path / "x.mcap").exists()
