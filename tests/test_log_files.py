from __future__ import annotations

import math
import re
from pathlib import Path

import pytest

from pneud.log.files.naming import LogError, create_log, log_path
from pneud.log.format.fingerprint import numeric_fingerprint, versions

NOW = 1_795_314_285.0


@pytest.fixture(autouse=True)
def no_state_directory(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))


def test_the_default_folder_is_made_and_the_name_tells_axis_and_time(tmp_path: Path) -> None:
    path = log_path(None, "virtual", NOW)
    assert path == tmp_path / "home/.local/state/pneud/virtual-20261122T022445Z.mcap"
    assert path.parent.is_dir()
    assert not path.exists()


def test_the_state_directory_of_systemd_wins_and_only_its_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", f"{tmp_path / 'a'}:{tmp_path / 'b'}")
    assert log_path(None, "x", NOW).parent == tmp_path / "a"


def test_a_folder_gets_names_that_are_free(tmp_path: Path) -> None:
    names = []
    for _ in range(3):
        path = log_path(str(tmp_path / "logs"), "rig", NOW)
        path.touch()
        names.append(path.name)
    stem = "rig-20261122T022445Z"
    assert names == [f"{stem}.mcap", f"{stem}-2.mcap", f"{stem}-3.mcap"]


def test_a_name_that_is_no_file_name_is_made_one(tmp_path: Path) -> None:
    assert log_path(str(tmp_path), "../a b/ü", NOW).name == "a-b-20261122T022445Z.mcap"
    assert log_path(str(tmp_path), "//", NOW).name.startswith("log-")


def test_a_file_is_taken_as_named_and_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    assert log_path(str(path), "virtual") == path
    path.write_bytes(b"precious")
    with pytest.raises(LogError, match="never overwritten"):
        log_path(str(path), "virtual")
    with pytest.raises(LogError, match="never overwritten"):
        create_log(path)
    assert path.read_bytes() == b"precious"


def test_what_cannot_be_is_said_in_one_line(tmp_path: Path) -> None:
    plain = tmp_path / "plain"
    plain.touch()
    for option in map(str, (plain, plain / "below", tmp_path / "none" / "x.mcap", plain / "x.mcap")):
        with pytest.raises(LogError) as caught:
            log_path(option, "virtual")
        assert "\n" not in str(caught.value)
        assert str(plain) in str(caught.value) or "none" in str(caught.value)
        assert caught.value.exit_code == 2
    with pytest.raises(LogError, match="cannot be created"):
        create_log(plain / "x.mcap")


def test_the_fingerprint_is_stable_and_depends_on_the_mathematics(monkeypatch: pytest.MonkeyPatch) -> None:
    first = numeric_fingerprint()
    assert re.fullmatch(r"[0-9a-f]{16}", first)
    assert numeric_fingerprint() == first
    power = math.pow
    monkeypatch.setattr(
        math, "pow", lambda a, b: math.nextafter(power(a, b), 1e9) if b > 2.9 else power(a, b)
    )
    assert numeric_fingerprint() != first


def test_versions_name_what_a_log_depends_on() -> None:
    found = versions()
    assert {"python", "libc", "machine", "pneud", "mcap", "protobuf"} <= set(found)
    assert all(isinstance(value, str) for value in found.values())
