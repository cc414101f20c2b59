"""What `pneud install-service` writes, refuses and leaves alone, and what doctor says of an installation."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from commands import pneud_here
from pneud import resources
from pneud.config.reading import load_config
from pneud.config.sections import ConfigError
from pneud.service import installation
from pneud.service.installation import InstallError, Unit, activate, axis_of, examine, files, put, units_of
from pneud.service.probe import Finding, Grade

COMMAND = Path("/opt/pneud/bin/pneud")
RIG, VCAN = Unit("rig", "can0"), Unit("vcan", "vcan0")
UNITS = Path("usr/local/lib/systemd/system")
SHOWN = {
    "NeedDaemonReload": "no",
    "UnitFileState": "enabled",
    "ActiveState": "active",
    "StatusText": "disarmed",
    "LimitRTPRIO": "98",
    "LimitMEMLOCK": "infinity",
}


def test_every_shipped_file_is_installed_somewhere() -> None:
    shipped = {path.name for path in resources.systemd().rglob("*") if path.is_file()}
    placed = {path.name for axis in (RIG, VCAN) for path in files(COMMAND, axis, networkd=True)}
    assert len(placed) == len(shipped)  # two are called pneud.conf, one unit is that of vcan0
    assert shipped - placed == {"pneud.sysusers", "pneud.tmpfiles"}


def test_the_unit_of_can0_is_the_shipped_one() -> None:
    for axis in (None, RIG):
        found = files(COMMAND, axis)
        assert found[UNITS / "pneud@.service"] == (resources.systemd() / "pneud@.service").read_text()
        assert not [path for path in found if "@rig" in path.name]


@pytest.mark.parametrize(
    "key", ["Restart=on-failure", "KillMode=control-group", "NotifyAccess=main", "Type=notify"]
)
def test_the_unit_keeps_what_was_found_out_the_hard_way(key: str) -> None:
    assert f"\n{key}\n" in (resources.systemd() / "pneud@.service").read_text()


@pytest.mark.parametrize(
    ("interface", "unit_name"), [("vcan0", "vcan0"), ("can1", "can1"), ("can-left", r"can\x2dleft")]
)
def test_another_interface_gets_its_own_unit(interface: str, unit_name: str) -> None:
    found = files(COMMAND, Unit("axis", interface))
    text, shipped = found[UNITS / "pneud@axis.service"], found[UNITS / "pneud@.service"]
    assert not re.search(r"\bcan0\b", text)
    assert f"BindsTo=sys-subsystem-net-devices-{unit_name}.device\n" in text
    assert f"WantedBy=sys-subsystem-net-devices-{unit_name}.device\n" in text
    assert (
        text.partition("[Service]")[2].partition("[Install]")[0]
        == (shipped.partition("[Service]")[2].partition("[Install]")[0])
    )


def test_the_timer_starts_what_looks_for_wear(tmp_path: Path) -> None:
    found = files(COMMAND, RIG)
    timer, service = (found[UNITS / f"pneud-wear@.{kind}"] for kind in ("timer", "service"))
    assert "OnCalendar=" in timer
    (line,) = re.findall(r"^ExecStart=(.*)$", service, re.MULTILINE)
    command, verb, *words = line.replace("%i", "rig").split()
    assert (command, verb) == (str(COMMAND), "identify")
    assert [word for word in words if word.startswith("/")] == [
        "/var/lib/pneud/rig", "/var/lib/pneud/rig/wear.jsonl", "/var/lib/pneud/rig/wear.html",
    ]  # fmt: skip
    done = pneud_here(verb, *(word.replace("/var/lib/pneud/rig", str(tmp_path)) for word in words))
    assert done.returncode == 2
    assert f"{tmp_path}: holds no finished log" in done.stderr


def test_every_unit_starts_the_command_of_this_installation() -> None:
    for path, text in files(Path("/srv/p/bin/pneud"), VCAN).items():
        assert "/opt/pneud" not in text
        if path.name.startswith(("pneud@", "pneud-plant@", "pneud-wear@.service")):
            assert "ExecStart=/srv/p/bin/pneud " in text


def test_networkd_files_are_those_of_the_kind_of_interface() -> None:
    folder = Path("usr/local/lib/systemd/network")
    rig = files(COMMAND, Unit("rig", "can3"), networkd=True)
    assert "Name=can3\n" in rig[folder / "60-can3.network"]
    assert "BitRate=1M" in rig[folder / "60-can3.network"]
    assert folder / "60-can3.netdev" not in rig
    assert "Kind=vcan" in files(COMMAND, VCAN, networkd=True)[folder / "60-vcan0.netdev"]
    assert not any(path.is_relative_to(folder) for path in files(COMMAND, VCAN))


def test_units_to_enable_stand_in_the_order_of_need() -> None:
    assert units_of(RIG) == ["pneud-can@can0", "pneud@rig"]
    assert units_of(VCAN) == ["pneud-vcan@vcan0", "pneud-plant@vcan", "pneud@vcan"]
    assert units_of(RIG, networkd=True)[:2] == ["systemd-networkd", "systemd-networkd-wait-online@can0"]


@pytest.mark.parametrize(
    ("name", "says"), [("virtual.toml", "socketcan:IF"), ("my axis.toml", "no name for a unit")]
)
def test_what_is_no_axis_for_a_service_is_refused(name: str, says: str, tmp_path: Path) -> None:
    source = "virtual.toml" if name == "virtual.toml" else "rig.toml"
    path = tmp_path / name
    path.write_text((resources.configs() / source).read_text())
    with pytest.raises(ConfigError, match=says):
        axis_of(path, load_config(path))
    done = pneud_here("install-service", "--config", path, "--destdir", tmp_path)
    assert (done.returncode, done.stdout) == (2, "")


def test_installing_twice_changes_nothing_and_a_configuration_is_never_overwritten(tmp_path: Path) -> None:
    words = ("install-service", "--config", "vcan.toml", "--destdir", tmp_path)
    first = pneud_here(*words)
    assert first.returncode == 0
    assert str(tmp_path / "etc/pneud/vcan.toml") in first.stdout
    assert first.stdout.endswith(
        "then: systemctl enable --now pneud-vcan@vcan0 pneud-plant@vcan pneud@vcan\n"
    )
    assert not (tmp_path / "etc/pneud/pneud.dbc").exists(), "pneud finds its own"
    config = tmp_path / "etc/pneud/vcan.toml"
    config.write_text("# mine\n")
    again = pneud_here(*words)
    assert again.stdout.startswith("all files are in place\n")
    assert "stays" in again.stderr
    assert config.read_text() == "# mine\n"


def test_a_database_of_ones_own_comes_along(tmp_path: Path) -> None:
    for name in ("rig.toml", "pneud.dbc"):
        (tmp_path / name).write_text((resources.configs() / name).read_text())
    root = tmp_path / "root"
    assert pneud_here("install-service", "--config", tmp_path / "rig.toml", "--destdir", root).returncode == 0
    assert (root / "etc/pneud/pneud.dbc").is_file()


def test_a_command_that_the_service_cannot_see_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "prefix", "/home/somebody/.venv")
    done = pneud_here("install-service")
    assert (done.returncode, done.stdout) == (3, "")
    assert "hidden from a service" in done.stderr
    assert done.stderr.count("\n") == 1


def test_networkd_needs_an_interface() -> None:
    done = pneud_here("install-service", "--networkd")
    assert (done.returncode, done.stdout) == (2, "")


def test_a_folder_that_cannot_be_written_is_told_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "usr").write_text("")
    with pytest.raises(InstallError, match="--destdir"):
        put(tmp_path, files(COMMAND, None))


def test_a_command_that_fails_or_is_missing_is_told_in_one_line() -> None:
    with pytest.raises(InstallError, match="a service needs systemd"):
        installation.call(["no-such-command-here"])
    with pytest.raises(InstallError, match="exit 1"):
        installation.call(["false"])
    assert installation.call(["echo", "a"]) == "a\n"


@pytest.mark.parametrize(
    ("there", "last"),
    [
        ([], "systemd-tmpfiles"),
        (["run/systemd/system"], "systemctl daemon-reload"),
        (["run/systemd/system", "run/udev/control"], "udevadm control --reload"),
    ],
)
def test_only_what_runs_is_told(there: list[str], last: str, tmp_path: Path) -> None:
    for folder in there:
        (tmp_path / folder).mkdir(parents=True)
    called: list[str] = []

    def run(words: Sequence[str]) -> str:
        called.append(" ".join(words))
        return ""

    activate(tmp_path, run)
    assert len(called) == 2 + len(there)
    assert called[-1].startswith(last)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A machine with a sound installation."""
    put(tmp_path, files(COMMAND, VCAN))
    put(tmp_path, {Path("etc/pneud/vcan.toml"): "", Path("etc/passwd"): "pneud:x:990:990::/:\n"})
    put(tmp_path, {Path("etc/group"): "root:x:0:\npneud:x:990:\n"})
    (tmp_path / "run/systemd/system").mkdir(parents=True)
    return tmp_path


def answers(**changes: str) -> Callable[[Sequence[str]], str]:
    return lambda _: "".join(f"{name}={value}\n" for name, value in (SHOWN | changes).items())


def found(root: Path, run: Callable[[Sequence[str]], str], axis: Unit | None = VCAN) -> dict[str, Finding]:
    return {finding.name: finding for finding in examine(axis, 80, root, run, COMMAND)}


def test_a_machine_without_the_service_has_no_rows(tmp_path: Path) -> None:
    assert found(tmp_path, answers()) == {}


def test_a_sound_installation_has_nothing_to_be_cured(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "base_prefix", "/usr")
    rows = found(root, answers())
    assert {finding.level for finding in rows.values()} == {Grade.OK}
    assert list(rows) == [
        "service units",
        "service user",
        "service configuration",
        "service",
        "service limits",
    ]
    assert rows["service"].found == "pneud@vcan.service: enabled, active (disarmed)"
    assert list(found(root, answers(), None)) == ["service units", "service user"]


@pytest.mark.parametrize(
    ("changes", "name", "level", "says", "cure"),
    [
        (
            {"UnitFileState": "disabled"},
            "service",
            Grade.WARNING,
            "disabled",
            "systemctl enable --now pneud-vcan@vcan0",
        ),
        ({"NeedDaemonReload": "yes"}, "service", Grade.WARNING, "changed since", "daemon-reload"),
        (
            {"ActiveState": "failed", "StatusText": ""},
            "service",
            Grade.WARNING,
            "failed",
            "reset-failed pneud@vcan",
        ),
        ({"LimitRTPRIO": "50"}, "service limits", Grade.LACK, "LimitRTPRIO=50", "systemctl cat"),
        ({"LimitRTPRIO": ""}, "service limits", Grade.LACK, "LimitRTPRIO=", "systemctl cat"),
        ({"LimitMEMLOCK": "8388608"}, "service limits", Grade.LACK, "8388608", "systemctl cat"),
    ],
)
def test_each_fault_of_a_service_is_one_finding(
    changes: dict[str, str],
    name: str,
    level: Grade,
    says: str,
    cure: str,
    root: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "base_prefix", "/usr")
    bad = [finding for finding in found(root, answers(**changes)).values() if finding.level != Grade.OK]
    assert [(finding.name, finding.level) for finding in bad] == [(name, level)]
    assert says in bad[0].found
    assert cure in bad[0].cure


def test_files_that_are_missing_stale_or_locked_are_found(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "base_prefix", "/usr")
    (root / UNITS / "pneud@vcan.service").unlink()
    (root / UNITS / "pneud-can@.service").write_text("[Unit]\n")
    (root / "etc/pneud/vcan.toml").chmod(0o600)
    (root / "etc/group").write_text("")
    rows = found(root, answers())
    assert "pneud@vcan.service" in rows["service units"].found
    assert "pneud-can@.service" in rows["service units"].found
    assert rows["service configuration"].level == rows["service user"].level == Grade.LACK
    (root / "etc/pneud/vcan.toml").unlink()
    assert "No such file" in found(root, answers())["service configuration"].found


def test_an_interpreter_that_the_service_cannot_see_is_found(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "base_prefix", "/root/.pyenv/versions/3.11")
    row = found(root, answers())["service user"]
    assert (row.level, "hidden" in row.found, "/opt/pneud" in row.cure) == (Grade.LACK, True, True)


def test_a_systemd_that_does_not_answer_is_told(root: Path) -> None:
    def fails(words: Sequence[str]) -> str:
        raise InstallError("systemctl show: no bus")

    assert found(root, fails)["service"].found == "systemctl show: no bus"
