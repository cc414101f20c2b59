"""pneud under systemd: PID 1 of the guest is Debian's own, the commands are those of docs/rig-pc.md.

The tests share one machine and run in the order in which they stand; each one begins with a healthy service.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import shutil
import signal
import struct
import subprocess
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from mcap.reader import make_reader

from pneud.loop.turn import END_TICKS
from pneud.signals import ValveState

pytestmark = pytest.mark.systemd
ROOT = Path(__file__).parent.parent.parent
PNEUD = "/opt/pneud/bin/pneud"
AXIS, PLANT, VCAN = "pneud@vcan", "pneud-plant@vcan", "pneud-vcan@vcan0"
N_SLCAN = 17  # the line discipline of CAN on a serial line
PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"


def tried(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(words, capture_output=True, text=True, timeout=100, check=False)


def run(*words: str) -> str:
    """Output of a command that must succeed."""
    done = tried(*words)
    if done.returncode:
        pytest.fail(f"{' '.join(words)}: {done.returncode}\n{done.stdout}{done.stderr}{journal()}")
    return done.stdout


def journal() -> str:
    """The last that the service's units had to say."""
    return tried("journalctl", "--no-pager", "-n", "40", "-u", "pneud*", "-u", "systemd-networkd*").stdout


def shown(name: str, unit: str = AXIS) -> str:
    """A property of a unit."""
    return run("systemctl", "show", unit, f"--property={name}", "--value").strip()


def eventually(holds: Callable[[], bool], what: str, patience_s: float = 30.0) -> None:
    deadline = time.monotonic() + patience_s
    while not holds():
        if time.monotonic() > deadline:
            pytest.fail(f"in vain: {what}; {shown('ActiveState')}, {shown('StatusText')}\n{journal()}")
        time.sleep(0.1)


def says(unit: str, status: str) -> bool:
    return shown("ActiveState", unit) == "active" and shown("StatusText", unit) == status


def disarmed() -> bool:
    return says(AXIS, "disarmed")


def engage() -> None:
    """Arm by the operator's command; a guest that stood still too long is a fault, and not this test's."""

    def holds() -> bool:
        told = shown("StatusText")
        if told.startswith("fault"):
            tried(PNEUD, "clear")
        elif told == "disarmed":
            tried(PNEUD, "arm")
            time.sleep(0.5)  # the line is told four times a second
        return told == "holding"

    eventually(holds, "holding")


def main_pid() -> int:
    return int(shown("MainPID"))


def newest_log() -> Path:
    return max(Path("/var/lib/pneud/vcan").glob("*.mcap"), key=lambda path: path.stat().st_mtime_ns)


def is_whole(log: Path) -> bool:
    """Whether the recorder finished this file: it has its footer, and ticks."""
    with log.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None and summary.statistics is not None
    return summary.statistics.message_count > 0


def documented() -> list[str]:
    """The commands of docs/rig-pc.md, as they stand there."""
    text = (ROOT / "docs" / "rig-pc.md").read_text()
    (block,) = re.findall(r"^```sh\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    return [line for line in block.splitlines() if line]


@pytest.fixture(scope="module", autouse=True)
def installed(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Installs as documented; only the package index is another one."""
    wheels = ROOT / "build" / "wheels"
    folder = tmp_path_factory.mktemp("download")
    (wheel,) = wheels.glob("pneud-*.whl")
    shutil.copy(wheel, folder)
    commands = documented()
    assert len(commands) <= 5
    index = {"PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(wheels), "PIP_CONFIG_FILE": os.devnull}
    for command in commands:
        start = time.monotonic()
        done = subprocess.run(
            ["/bin/bash", "-c", command],
            cwd=folder,
            env={"PATH": PATH, "HOME": "/root", **index},
            capture_output=True,
            text=True,
            check=False,
        )
        print(f"{time.monotonic() - start:5.1f} s  {command}")
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"


@pytest.fixture(autouse=True)
def healthy(installed: None) -> Iterator[None]:
    """A service that runs, disarmed; whatever a test did to it."""
    run("systemctl", "reset-failed", AXIS)
    run("systemctl", "start", VCAN, PLANT, AXIS)
    eventually(disarmed, "disarmed")
    yield


def test_units_are_correct_and_closed() -> None:
    units = [AXIS, "pneud@rig", PLANT, VCAN, "pneud-can@can0", "pneud-wear@vcan"]
    named = [*(f"{unit}.service" for unit in units), "pneud-wear@vcan.timer"]
    done = tried("systemd-analyze", "verify", *named)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    for unit in sorted(Path("/usr/local/lib/systemd/system").glob("pneud*.service")):
        told = run("systemd-analyze", "security", "--offline=true", "--no-pager", str(unit))
        level = re.search(r"exposure level for \S+: ([\d.]+)", told)
        assert level is not None and float(level[1]) <= 2.0, told


def test_the_timer_has_the_logs_looked_at_each_night() -> None:
    run("systemctl", "start", "pneud-wear@vcan.timer")
    assert (
        run("systemctl", "list-timers", "--no-pager", "pneud-wear@vcan.timer").count(
            "pneud-wear@vcan.service"
        )
        == 1
    )
    run("systemctl", "stop", "pneud-wear@vcan.timer")


def test_the_unit_of_another_interface_differs_in_nothing_else() -> None:
    folder = Path("/usr/local/lib/systemd/system")
    ours, shipped = ((folder / name).read_text() for name in ("pneud@vcan.service", "pneud@.service"))
    assert ours.partition("[Unit]")[2] == re.sub(r"\bcan0\b", "vcan0", shipped.partition("[Unit]")[2])


def test_nothing_runs_as_root_or_with_rights() -> None:
    for unit in (AXIS, PLANT):
        group = Path("/sys/fs/cgroup") / shown("ControlGroup", unit).lstrip("/")
        pids = (group / "cgroup.procs").read_text().split()
        assert pids
        for pid in pids:
            status = Path("/proc", pid, "status").read_text()
            (uids,) = re.findall(r"^Uid:\t(.*)$", status, re.MULTILINE)
            assert "0" not in uids.split()
            assert re.search(r"^CapEff:\t0+$", status, re.MULTILINE)
            assert re.search(r"^CapBnd:\t0+$", status, re.MULTILINE)
            assert re.search(r"^NoNewPrivs:\t1$", status, re.MULTILINE)
    assert Path("/var/lib/pneud/vcan").owner() == Path("/run/pneud").owner() == "pneud"


def test_doctor_finds_the_installation_sound() -> None:
    done = tried(PNEUD, "doctor", "/etc/pneud/vcan.toml", "--json")
    findings = {finding["name"]: finding for finding in json.loads(done.stdout)["findings"]}
    for name in ("service", "service units", "service user", "service configuration", "service limits"):
        assert findings[name]["level"] == "ok", findings[name]
    assert "enabled, active (disarmed)" in findings["service"]["found"]


def test_with_unpowered_nodes_it_is_ready_waits_and_stays() -> None:
    run("systemctl", "stop", PLANT)
    run("systemctl", "restart", AXIS)  # returns when it is ready
    waiting = "waiting: encoder_missing, pressure_missing, valve_missing"
    eventually(lambda: says(AXIS, waiting), "waiting")
    before = main_pid(), shown("NRestarts")
    time.sleep(3 * 2.0)  # three times WatchdogSec
    assert says(AXIS, waiting)
    assert (main_pid(), shown("NRestarts")) == before
    run("systemctl", "start", PLANT)
    eventually(disarmed, "the nodes are found when they get power")


def test_the_group_is_served_and_nobody_else() -> None:
    as_nobody = ("setpriv", "--reuid=nobody", "--regid=nogroup")
    member = (*as_nobody, "--groups=pneud", PNEUD, "status")
    eventually(lambda: tried(*member).returncode == 0, "an answer to a member")
    other = tried(*as_nobody, "--clear-groups", PNEUD, "status")
    assert (other.returncode, other.stdout) == (3, "")


def test_a_hang_ends_by_the_watchdog_and_begins_again_disarmed() -> None:
    engage()
    pid, restarts, log = main_pid(), int(shown("NRestarts")), newest_log()
    os.kill(pid, signal.SIGSTOP)
    eventually(lambda: main_pid() not in (0, pid), "another process")
    eventually(disarmed, "disarmed")
    assert int(shown("NRestarts")) == restarts + 1
    told = run("journalctl", "--no-pager", "-u", AXIS)
    assert "Watchdog timeout" in told
    assert "Fatal Python error: Aborted" in told, "and where it hung"
    assert is_whole(log)
    assert newest_log() != log


def test_a_crash_is_followed_by_a_start_and_the_log_is_whole() -> None:
    engage()
    pid, log = main_pid(), newest_log()
    os.kill(pid, signal.SIGKILL)
    eventually(lambda: main_pid() not in (0, pid), "another process")
    eventually(disarmed, "disarmed")
    assert is_whole(log)


def test_restarts_in_good_order_are_no_failures_and_the_third_crash_is_the_last() -> None:
    for n in range(4):  # one more than there may be starts
        run("systemctl", "restart", AXIS)
        eventually(disarmed, f"disarmed after restart {n}")
    run("systemctl", "stop", AXIS)
    assert (shown("Result"), shown("ActiveState")) == ("success", "inactive")
    run("systemctl", "reset-failed", AXIS)  # forgets earlier starts
    run("systemctl", "start", AXIS)
    for crash in range(3):
        eventually(disarmed, f"disarmed before crash {crash}")
        if crash == 2:
            engage()
        os.kill(main_pid(), signal.SIGKILL)
        eventually(lambda: not disarmed(), "gone")
    eventually(lambda: shown("ActiveState") == "failed", "failed")
    time.sleep(3.0)
    assert (shown("ActiveState"), main_pid()) == ("failed", 0)
    applied, state = valve()
    assert (applied, state) == (0, ValveState.TIMED_OUT), "the node holds the valve centred"


def valve() -> tuple[int, int]:
    """What the valve node answers to a SYNC: the output of its DAC and its state."""
    dump = subprocess.Popen(["candump", "-L", "-n", "1", "vcan0,183:7FF"], stdout=subprocess.PIPE, text=True)
    time.sleep(0.5)
    run("cansend", "vcan0", "080#01")
    data = bytes.fromhex(dump.communicate(timeout=20)[0].split("#")[1])
    return int.from_bytes(data[:2], "little", signed=True), data[2]


def test_a_reload_takes_gains_and_reference_and_keeps_the_process() -> None:
    pid, file = main_pid(), Path("/etc/pneud/vcan.toml")
    text = file.read_text()

    def tuned(name: str) -> float:
        value: float = json.loads(run(PNEUD, "tune", "get", "--json"))["gains"][name]
        return value

    try:
        file.write_text(text.replace("amplitude_m = 0.05", "amplitude_m = 0.03"))
        run("systemctl", "reload", AXIS)
        eventually(lambda: tuned("reference.amplitude_m") == 0.03, "the file's amplitude")
        file.write_text(text.replace("amplitude_m = 0.05", "amplitude_m = 0.6"))
        run("systemctl", "reload", AXIS)
        eventually(lambda: "beyond limits.travel" in run("journalctl", "--no-pager", "-u", AXIS), "why not")
        assert tuned("reference.amplitude_m") == 0.03
    finally:
        file.write_text(text)
        run("systemctl", "reload", AXIS)
    eventually(lambda: tuned("reference.amplitude_m") == 0.05, "as before")
    assert (disarmed(), main_pid()) == (True, pid)


def test_a_stop_sends_the_centre_and_ends_well() -> None:
    engage()
    dump = subprocess.Popen(["candump", "-L", "vcan0,203:7FF"], stdout=subprocess.PIPE, text=True)
    time.sleep(0.5)
    start = time.monotonic()
    run("systemctl", "stop", AXIS)
    print(f"stopped in {time.monotonic() - start:.2f} s")
    dump.send_signal(signal.SIGINT)
    commands = [bytes.fromhex(line.split("#")[1]) for line in dump.communicate(timeout=20)[0].splitlines()]
    enabled = [command[2] for command in commands]
    assert enabled[0] == 1
    assert enabled[-END_TICKS:] == [0] * END_TICKS
    assert not any(any(command[:2]) for command in commands[-END_TICKS:]), "0 V"
    assert (shown("Result"), shown("ExecMainStatus"), shown("ActiveState")) == ("success", "0", "inactive")
    assert is_whole(newest_log())


def told_since(cursor: str) -> str:
    """What the axis's unit has told the journal since."""
    return run("journalctl", "--no-pager", "-u", AXIS, f"--after-cursor={cursor}")


def cursor() -> str:
    """Where the journal ends now."""
    return run("journalctl", "--no-pager", "-n", "0", "--show-cursor").partition("cursor: ")[2].strip()


def test_a_full_disk_is_told_when_it_comes_and_when_it_goes() -> None:
    logs, begun = Path("/var/lib/pneud/vcan"), cursor()
    run("systemctl", "stop", AXIS)
    run("mount", "-t", "tmpfs", "-o", "size=2M", "tmpfs", str(logs))
    try:
        run("systemctl", "start", AXIS)
        eventually(disarmed, "disarmed")
        tried("dd", "if=/dev/zero", f"of={logs}/filling", "bs=4096")
        eventually(lambda: says(AXIS, "disarmed: disk_full"), "the status line names it")
        eventually(lambda: "pneud: disk_full: the log's disk" in told_since(begun), "the journal, too")
        (logs / "filling").unlink()
        eventually(disarmed, "the status line is as before")
        eventually(lambda: "pneud: disk_full is over" in told_since(begun), "and the journal says so")
        assert told_since(begun).count("disk_full") == 2
    finally:
        run("systemctl", "stop", AXIS)
        run("umount", str(logs))


def test_a_dead_recorder_is_told() -> None:
    begun = cursor()
    (recorder, *_) = Path(f"/proc/{main_pid()}/task/{main_pid()}/children").read_text().split()
    os.kill(int(recorder), signal.SIGKILL)
    eventually(lambda: says(AXIS, "disarmed: recorder_lost"), "the status line names it")
    eventually(lambda: "pneud: recorder_lost: the recorder process is gone" in told_since(begun), "told")
    run("systemctl", "stop", AXIS)
    assert "records: the recorder was lost" in told_since(begun)
    assert (shown("Result"), shown("ExecMainStatus")) == ("exit-code", "1"), "its log is lost"


def test_a_stop_after_a_fault_ends_well() -> None:
    engage()
    run("systemctl", "stop", PLANT)
    eventually(lambda: shown("StatusText").startswith("fault: "), "a latched fault")
    run("systemctl", "stop", AXIS)
    assert (shown("Result"), shown("ExecMainStatus"), shown("ActiveState")) == ("success", "0", "inactive")


def test_the_interface_takes_the_service_along_and_brings_it_back() -> None:
    run("ip", "link", "delete", "vcan0")
    eventually(lambda: shown("ActiveState") == "inactive", "stopped with its interface")
    eventually(lambda: shown("ActiveState", PLANT) == "inactive", "its nodes, too")
    run("ip", "link", "add", "vcan0", "type", "vcan")
    run("ip", "link", "set", "vcan0", "up")
    eventually(disarmed, "back with its interface")


def test_a_service_is_not_armed_by_an_option() -> None:
    assert "INVOCATION_ID" in os.environ, "this test, too, runs as a service"
    done = tried(PNEUD, "--config", "/etc/pneud/vcan.toml", "--arm")
    assert (done.returncode, done.stdout) == (2, "")
    assert "pneud arm" in done.stderr


def test_a_wrong_configuration_is_tried_once() -> None:
    run("systemctl", "stop", AXIS)
    file = Path("/etc/pneud/vcan.toml")
    text = file.read_text()
    file.write_text(text.replace("rate_hz", "rate"))
    try:
        assert tried("systemctl", "start", AXIS).returncode != 0
        time.sleep(2.0)
        assert (shown("ActiveState"), shown("ExecMainStatus"), shown("NRestarts")) == ("failed", "2", "0")
    finally:
        file.write_text(text)


@pytest.fixture
def adapter() -> Iterator[bytearray]:
    """A CAN adapter can0 on a serial line; gives what it is told to do."""
    run("insmod", f"/usr/lib/uml/modules/{os.uname().release}/kernel/drivers/net/can/slcan/slcan.ko")
    far, near = os.openpty()
    tty.setraw(near)
    fcntl.ioctl(near, termios.TIOCSETD, struct.pack("i", N_SLCAN))
    written = bytearray()

    def read() -> None:
        with contextlib.suppress(OSError):  # when the adapter is unplugged
            while True:
                written.extend(os.read(far, 4096))

    threading.Thread(target=read, daemon=True).start()
    yield written
    os.close(near)


def test_the_unit_as_shipped_serves_an_axis_on_an_adapter(adapter: bytearray, tmp_path: Path) -> None:
    config = tmp_path / "other.toml"
    text = Path("/etc/pneud/vcan.toml").read_text()
    config.write_text(text.replace("vcan0", "can0").replace('"vcan"', '"other"'))
    told = run(PNEUD, "install-service", "--config", str(config))
    (units,) = re.findall(r"^then: systemctl enable --now (.*)$", told, re.MULTILINE)
    run("systemctl", "enable", "--now", *units.split())
    assert shown("FragmentPath", "pneud@other") == "/usr/local/lib/systemd/system/pneud@.service"
    (link,) = json.loads(run("ip", "-details", "-json", "link", "show", "can0"))
    can = link["linkinfo"]["info_data"]
    assert (can["bittiming_bitrate"], link["txqlen"]) == (1_000_000, 128)
    eventually(lambda: shown("StatusText", "pneud@other").startswith("waiting: encoder_missing"), "waiting")
    eventually(lambda: b"\rt0801" in adapter and b"\rt2038" in adapter, "SYNC and commands on the wire")
    run("systemctl", "stop", "pneud@other")
    assert Path("/run/pneud").is_dir(), "the axes share it"
    assert disarmed()


def test_networkd_makes_the_interface_as_well() -> None:
    told = run(PNEUD, "install-service", "--config", "vcan.toml", "--networkd")
    (units,) = re.findall(r"^then: systemctl enable --now (.*)$", told, re.MULTILINE)
    run("systemctl", "disable", "--now", VCAN)
    eventually(lambda: shown("ActiveState") == "inactive", "stopped with its interface")
    # the interface is there a moment before it is up, and a service that is too early tries again
    tried("systemctl", "enable", "--now", *units.split())
    eventually(disarmed, "disarmed")
    assert Path("/sys/class/net/vcan0/tx_queue_len").read_text().strip() == "128"
    run("systemctl", "disable", "--now", *units.split()[:2])
    run("ip", "link", "delete", "vcan0")
