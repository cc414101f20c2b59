"""The verbs that talk to a running daemon, where none runs or a console without a loop stands in for it."""

from __future__ import annotations

import os
import socket
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from commands import object_of, pneud_here
from console_bench import served
from pneud import resources
from pneud.config.conversions import axis_of
from pneud.config.reading import load_config
from pneud.console import endpoint
from pneud.console.client import Client
from pneud.console.endpoint import PlaceError
from pneud.console.results import show
from pneud.console.tuning import MODEL, NAMES, REFERENCE, chosen, values_of
from pneud.control.tunables import LAWS, TUNABLE, names_of, tunables
from pneud.signals import Answer, RequestKind


@pytest.fixture
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A runtime folder in which nothing runs."""
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    monkeypatch.delenv("PNEUD_SOCKET", raising=False)
    monkeypatch.setattr(endpoint, "SYSTEM_FOLDER", tmp_path / "none")
    return tmp_path


@pytest.mark.parametrize(
    "words",
    [
        *("status", "arm", "disarm", "stop", "clear", "home", "hold", "goto 5", "goto -5", "jog -20.5"),
        *("track sine", "track steps 100 200", "tune get", "tune set k1=3", "tune diff", "tune save"),
        *("tune reload", "mark hello", "top"),
    ],
)
def test_without_a_daemon_the_exit_status_is_3_and_one_line_says_what_helps(
    words: str, runtime: Path
) -> None:
    done = pneud_here(*words.split())
    assert done.returncode == 3, done.stderr
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert "no running daemon" in done.stderr


@pytest.mark.parametrize(
    "words",
    [
        *(
            "goto",
            "goto here",
            "goto nan",
            "goto 5 --speed -1",
            "goto 5 --tolerance 0.1",
            "goto 5 --wait --timeout 0",
            "goto 5 --wait --tolerance -1",
            "jog inf",
            "jog 5 --for 0",
            "mark",
            "tune set",
        ),
        *(
            "tune set k1",
            "tune set k9=3",
            "tune set k1=x",
            "tune set k1=nan",
            "tune set k1=-inf",
            "tune set k1=1e999",
            "tune set reference.kind=sine",
            "tune set amplitude_m=0.1",
            "track sine 5",
            "tune nonsense",
        ),
    ],
)
def test_what_is_no_command_is_a_usage_error(words: str, runtime: Path) -> None:
    done = pneud_here(*words.split())
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    assert done.stderr


def test_several_daemons_are_listed_and_dead_ones_are_not(runtime: Path) -> None:
    one = endpoint.bind("one", None, virtual=False)
    dead = socket.socket(socket.AF_UNIX)
    dead.bind(str(runtime / "dead.sock"))
    dead.close()
    endpoint.find(None).close()
    two = endpoint.bind("two", None, virtual=False)
    with pytest.raises(PlaceError, match=r"one\.sock, .*two\.sock") as several:
        endpoint.find(None)
    assert several.value.exit_code == 2
    endpoint.find(str(two.path)).close()
    for it in (one, two):
        it.listener.close()
        os.close(it.lock)


def test_all_folders_are_looked_through(
    runtime: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = tmp_path / "run"
    system.mkdir()
    monkeypatch.setattr(endpoint, "SYSTEM_FOLDER", system)
    service = endpoint.bind("service", str(system / "service.sock"), virtual=False)
    endpoint.find(None).close()
    own = endpoint.bind("own", None, virtual=False)
    with pytest.raises(PlaceError, match=r"service\.sock, .*own\.sock; choose one") as several:
        endpoint.find(None)
    assert several.value.exit_code == 2
    service.listener.close()
    os.close(service.lock)
    endpoint.find(None).close()
    own.listener.close()
    os.close(own.lock)


@pytest.mark.skipif(os.geteuid() != 0, reason="another user takes root")
def test_a_folder_that_may_not_be_entered_hides_no_daemon_of_ones_own(
    runtime: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = tmp_path / "run"
    system.mkdir(mode=0o700)
    monkeypatch.setattr(endpoint, "SYSTEM_FOLDER", system)

    def found_by_nobody() -> str:
        reading, writing = os.pipe()
        child = os.fork()
        if not child:
            try:
                os.setgroups([])
                os.setresgid(65534, 65534, 65534)
                os.setresuid(65534, 65534, 65534)
                os.environ["RUNTIME_DIRECTORY"] = str(own)
                mine = endpoint.bind("mine", None, virtual=True) if with_daemon else None
                endpoint.find(None).close()
                os.write(writing, b"found" if mine is not None else b"found another's")
            except Exception as e:
                os.write(writing, str(e).encode())
            finally:
                os._exit(0)
        os.waitpid(child, 0)
        os.close(writing)
        said = os.read(reading, 4096).decode()
        os.close(reading)
        return said

    with tempfile.TemporaryDirectory(dir="/tmp") as folder:  # all above pytest's own is shut
        os.chown(folder, 65534, 65534)
        own = Path(folder)
        with_daemon = True
        assert found_by_nobody() == "found"
        with_daemon = False
        said = found_by_nobody()
    assert said.startswith("no daemon of yours runs (pneud --virtual starts one)")
    assert str(system) in said


def test_a_daemon_whose_console_is_gone_is_told_from_none(runtime: Path) -> None:
    place = endpoint.bind("axis", None, virtual=False)
    place.listener.close()
    for given in (None, str(place.path)):
        with pytest.raises(
            PlaceError, match=f"process {os.getpid()}.* runs, but .* its console is gone"
        ) as e:
            endpoint.find(given)
        assert e.value.exit_code == 3
    os.close(place.lock)
    with pytest.raises(PlaceError, match="no running daemon"):
        endpoint.find(None)


def test_a_lock_that_is_a_link_is_not_followed(runtime: Path, tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("precious")
    (runtime / "axis.sock.lock").symlink_to(victim)
    with pytest.raises(PlaceError, match="no socket for the console"):
        endpoint.bind("axis", None, virtual=False)
    assert victim.read_text() == "precious"


def test_a_living_daemon_keeps_its_socket_and_a_dead_ones_is_replaced(runtime: Path) -> None:
    first = endpoint.bind("axis", None, virtual=False)
    assert stat.S_IMODE(first.path.stat().st_mode) in (0o660, 0o600)
    with pytest.raises(PlaceError, match="another pneud") as taken:
        endpoint.bind("axis", None, virtual=False)
    assert taken.value.exit_code == 3
    beside = endpoint.bind("axis", None, virtual=True)
    assert beside.path.name == f"axis-{os.getpid()}.sock"
    first.listener.close()
    os.close(first.lock)  # as the kernel does when a process dies; the socket's name stays
    again = endpoint.bind("axis", None, virtual=False)
    endpoint.find(str(again.path)).close()
    (runtime / "file").write_text("precious")
    with pytest.raises(PlaceError, match="is no socket"):
        endpoint.bind("axis", str(runtime / "file"), virtual=False)
    assert (runtime / "file").read_text() == "precious"
    for it in (beside, again):
        it.listener.close()
        os.close(it.lock)


def test_results_and_refusals_as_objects(tmp_path: Path) -> None:
    with served(tmp_path) as b:
        at = ("--socket", b.path, "--json")
        assert object_of(pneud_here("goto", "-0.5e2", *at))["error"]["nearest_mm"] == 21.0
        assert pneud_here("goto", "-50", "--socket", b.path).returncode == 1
        assert object_of(pneud_here("goto", 120, "--accel", 500, *at)) == {
            "schema": 1,
            "ok": True,
            "axis": "virtual",
            "order": 1,
            "state": "holding",
        }
        assert object_of(pneud_here("status", *at))["name"] == "virtual"
        assert "nobody commands" in pneud_here("status", "--socket", b.path).stdout
        assert pneud_here("jog", "-20", "--for", 0.25, *at).returncode == 0
        found = object_of(pneud_here("track", "steps", 100, 110, "--dwell", 0.1, *at))
        assert found["pieces"] > 3
        assert pneud_here("track", "steps", 100, 5, *at).returncode == 1
        kinds = [r.kind for r in b.requests]
    assert kinds[0] == RequestKind.GOTO
    assert kinds[1 : kinds.index(RequestKind.HOLD)] == [RequestKind.JOG] * (kinds.index(RequestKind.HOLD) - 1)
    assert kinds[-1] == RequestKind.TRACK
    assert kinds.count(RequestKind.PIECE) == found["pieces"] + 1


def test_tuning_changes_compares_and_saves_and_the_comments_stay(tmp_path: Path) -> None:
    file = tmp_path / "axis.toml"
    text = (resources.configs() / "virtual.toml").read_text()
    file.write_text(text)
    file.chmod(0o640)
    with served(tmp_path, file) as b:
        at = ("--socket", b.path, "--json")
        settings = ("k1=90000", "gain_n_s2=2300", "law=ismc-explicit")
        words = "law composite-implicit → ismc-explicit, k1 95000 → 90000, gain_n_s2 2400 → 2300"
        assert object_of(pneud_here("tune", "set", *settings, *at))["changed"] == words
        assert b.requests[-1].values[:2] == (3.0, 90000.0)
        assert len(b.requests[-1].values) == len(TUNABLE)
        assert object_of(pneud_here("tune", "set", "law=lqr", *at))["error"]["type"] == "invalid"
        assert set(object_of(pneud_here("tune", "diff", *at))["changes"]) == {"law", "k1", "gain_n_s2"}
        assert object_of(pneud_here("tune", "save", *at))["changed"] == words
        saved = text.replace('law = "composite"', 'law = "ismc"').replace("95000.0", "90000.0")
        saved = saved.replace("2400.0", "2300.0")
        saved = saved.replace('discretisation = "implicit"', 'discretisation = "explicit"', 1)
        assert file.read_text() == saved
        assert stat.S_IMODE(file.stat().st_mode) == 0o640
        assert object_of(pneud_here("tune", "get", *at))["gains"]["law"] == "ismc-explicit"

        file.write_text(text.replace("amplitude_m = 0.05", "amplitude_m = 0.04"))
        found = object_of(pneud_here("tune", "reload", *at))
        assert found["gains"]["k1"] == 95000.0
        assert found["gains"]["reference.amplitude_m"] == 0.04
        assert (found["changed"].split(", ")[-1], found["at_restart"]) == (
            "reference.amplitude_m 0.05 → 0.04",
            [],
        )
        file.write_text(text.replace("tracking_error_m = 0.02", "tracking_error_m = 0.03"))
        refused = object_of(pneud_here("tune", "reload", *at))["error"]
        assert "limits.tracking_error_m changed" in refused["message"]
        file.write_text("rubbish")
        assert object_of(pneud_here("tune", "reload", *at))["error"]["type"] == "configuration"
        assert pneud_here("tune", "diff", *at).returncode == 2
    assert list(tmp_path.glob(".*")) == []


def test_keys_of_the_file_are_tuned_by_too_and_doubtful_gains_are_warned_of(tmp_path: Path) -> None:
    file = tmp_path / "axis.toml"
    file.write_text((resources.configs() / "virtual.toml").read_text())
    with served(tmp_path, file) as b:
        at = ("--socket", b.path)
        done = pneud_here("tune", "set", "control.k1=90000", "control.observer.gain_n_s2=2300", *at)
        assert (done.returncode, done.stderr) == (0, "")
        assert "k1 95000 → 90000, gain_n_s2 2400 → 2300" in done.stdout
        assert pneud_here("tune", "set", "control.law=pid", *at).stderr == ""
        # what serves here takes everything, also what an axis would refuse
        done = pneud_here("tune", "set", "law=composite-implicit", "k3=100000", *at)
        assert done.returncode == 0
        assert done.stderr.startswith("pneud: warning: ")
        refused = pneud_here("tune", "set", "limits.tracking_error_m=1", *at)
        assert (refused.returncode, refused.stdout) == (2, "")
        assert "take effect at a restart" in refused.stderr


def test_the_reference_is_tuned_like_a_gain(tmp_path: Path) -> None:
    file = tmp_path / "axis.toml"
    text = (resources.configs() / "virtual.toml").read_text()
    file.write_text(text)
    wanted = text.replace("amplitude_m = 0.05", "amplitude_m = 0.03")
    wanted = wanted.replace("frequency_hz = 0.5", "frequency_hz = 1.25")
    with served(tmp_path, file) as b:
        at = ("--socket", b.path, "--json")
        settings = ("reference.amplitude_m=0.03", "reference.frequency_hz=1.25")
        words = "reference.amplitude_m 0.05 → 0.03, reference.frequency_hz 0.5 → 1.25"
        assert object_of(pneud_here("tune", "set", *settings, *at))["changed"] == words
        file.write_text(wanted)
        asked = axis_of(load_config(file), 0.0005)
        assert b.requests[-1].values == (*tunables(asked.controller), *asked.reference)
        file.write_text(text)
        assert object_of(pneud_here("tune", "diff", *at))["changes"] == {
            "reference.amplitude_m": {"file": 0.05, "running": 0.03},
            "reference.frequency_hz": {"file": 0.5, "running": 1.25},
        }
        assert object_of(pneud_here("tune", "save", *at))["changed"] == words
        assert file.read_text() == wanted
        assert "reference.frequency_hz = 1.25" in pneud_here("tune", "get", "--socket", b.path).stdout
        assert object_of(pneud_here("tune", "set", "k1=90000", *at))["changed"] == "k1 95000 → 90000"
        assert len(b.requests[-1].values) == len(TUNABLE)

        b.answer = lambda _: Answer.OUT_OF_TRAVEL
        refused = object_of(pneud_here("tune", "set", "reference.amplitude_m=0.6", *at))["error"]
        assert refused["type"] == "out_of_travel"
        assert refused["message"].startswith(
            "tune: reference.amplitude_m 0.03 → 0.6: the way leaves the travel"
        )
        assert object_of(pneud_here("tune", "get", *at))["gains"]["reference.amplitude_m"] == 0.03


def test_another_law_is_set_with_its_gains_saved_and_left_again(tmp_path: Path) -> None:
    file = tmp_path / "axis.toml"
    text = (resources.configs() / "virtual.toml").read_text()
    file.write_text(text)
    with served(tmp_path, file) as b:
        at = ("--socket", b.path, "--json")
        for settings, words in (
            (("pid.kp=2000",), "pid.kp is no value of composite-implicit"),
            (("law=pid", "k1=90000"), "k1 is no value of pid"),
            (("law=3",), "law is one of"),
        ):
            error = object_of(pneud_here("tune", "set", *settings, *at))["error"]
            assert error["type"] == "invalid"
            assert words in error["message"]
        assert pneud_here("tune", "set", "pid.kq=1", *at).returncode == 2
        assert b.requests == []
        changed = object_of(pneud_here("tune", "set", "law=pid", "pid.kp=2000", *at))["changed"]
        assert changed == "law composite-implicit → pid, pid.kp 2540 → 2000"
        assert b.requests[-1].values == (4.0, 2000.0, 32000.0, 75.6, 202.0, 0.01, 2e-5, 200.0)
        gains = object_of(pneud_here("tune", "get", *at))["gains"]
        assert tuple(gains) == (*names_of("pid"), *REFERENCE, *MODEL)
        assert object_of(pneud_here("tune", "diff", *at))["changes"] == {
            "law": {"file": "composite-implicit", "running": "pid"},
            "pid.kp": {"file": 2540.0, "running": 2000.0},
        }
        assert object_of(pneud_here("tune", "save", *at))["changed"] == changed
        saved = load_config(file)
        assert (saved.control.law, saved.control.pid.kp) == ("pid", 2000.0)
        assert saved.control.discretisation == "implicit"
        assert "# cap end, bore 40 mm" in file.read_text()

        wanted = ("law=adrc", "adrc.observer_rad_s=220", "reference.amplitude_m=0.03")
        pneud_here("tune", "set", *wanted, *at)
        sent = list(map(float, b.requests[-1].values))
        assert sent[:6] == [5.0, 373000.0, 15600.0, 216.0, 0.02, 220.0]
        assert len(b.requests[-1].values) == 9
        file.write_text(text + "\n[control.adrc]\nk1 = 300000.0\n")
        back = object_of(pneud_here("tune", "reload", *at))
        assert back["at_restart"] == []
        assert back["changed"] == "law adrc → composite-implicit, reference.amplitude_m 0.03 → 0.05"
        assert len(b.requests[-1].values) == len(TUNABLE) + 3
        pneud_here("tune", "set", "law=adrc", *at)
        assert list(b.requests[-1].values) == [5.0, 300000.0, 15600.0, 216.0, 0.02, 0.0]


def test_how_a_reference_is_joined_waits_for_the_next_start(tmp_path: Path) -> None:
    file = tmp_path / "axis.toml"
    text = (resources.configs() / "virtual.toml").read_text()
    file.write_text(text)
    with served(tmp_path, file) as b:
        file.write_text(text.replace("amplitude_m = 0.05", 'amplitude_m = 0.04\njoin = "at_once"'))
        found = object_of(pneud_here("tune", "reload", "--socket", b.path, "--json"))
        assert found["changed"] == "reference.amplitude_m 0.05 → 0.04"
        assert found["at_restart"] == ["reference.join"]
    assert "(at the next start only: reference.join) → taken" in b.said[-1]


@pytest.mark.parametrize("name", ["virtual.toml", "paper-case1.toml"])
def test_the_values_of_a_file_are_those_of_the_loop(name: str) -> None:
    config = load_config(resources.configs() / name)
    values = values_of(config)
    assert tuple(values) == NAMES
    assert tuple(chosen(values)) == (*TUNABLE, *REFERENCE, *MODEL)
    running = tunables(axis_of(config, 0.0005).controller)
    assert [values[n] for n in TUNABLE if n != "law"] == list(running[1:])
    assert LAWS[int(running[0])] == values["law"]
    r = config.reference
    assert [values[n] for n in REFERENCE] == [r.effective_centre_m, r.amplitude_m, r.frequency_hz]


def test_a_client_is_told_when_the_console_hangs_up(tmp_path: Path) -> None:
    with served(tmp_path) as b:
        client = Client(str(b.path))
        assert client.ask("status")["name"] == "virtual"
    with pytest.raises(PlaceError, match="hung up"):
        client.ask("status")
    client.close()


def test_a_stop_loads_none_of_the_heavy_libraries(runtime: Path) -> None:
    code = (
        "import sys; from pneud.cli import app\n"
        "try: app(['stop'])\n"
        "except SystemExit as e: assert e.code == 3, e.code\n"
        "print(*({'numpy', 'cantools', 'can', 'google.protobuf', 'rich'} & sys.modules.keys()))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize(
    ("whose", "printed"),
    [({"axes": ["x", "y"]}, "x, y: armed\n"), ({"axis": "x"}, "x: armed\n"), ({}, "armed\n")],
)
def test_a_result_names_the_axes_that_it_is_of(
    whose: dict[str, object], printed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    show(whose, False, "armed")
    assert capsys.readouterr().out == printed
