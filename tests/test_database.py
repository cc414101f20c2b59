"""What a DBC says, and that it is kept."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import cantools
import pytest

from pneud import resources
from pneud.bus import database
from pneud.bus.database import messages

DBC = (resources.configs() / "pneud.dbc").read_bytes()


@pytest.fixture
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.delenv("CACHE_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "pneud" / "databases"


@pytest.fixture
def parses(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """What has been given to the parser."""
    found: list[bytes] = []
    parsed = database._parsed

    def noted(dbc: bytes) -> list[database.MessageSpec]:
        found.append(dbc)
        return parsed(dbc)

    monkeypatch.setattr(database, "_parsed", noted)
    return found


def test_it_is_what_cantools_says() -> None:
    truth = cantools.database.load_file(resources.configs() / "pneud.dbc")
    assert isinstance(truth, cantools.database.can.Database)
    found = messages(DBC)
    assert [m.name for m in found] == [m.name for m in truth.messages]
    for one, true in zip(found, truth.messages, strict=True):
        assert (one.can_id, one.length, one.extended) == (true.frame_id, true.length, true.is_extended_frame)
        for signal, same in zip(one.signals, true.signals, strict=True):
            assert signal.name == same.name
            assert (signal.start, signal.length, signal.signed) == (same.start, same.length, same.is_signed)
            # text tells 1 from 1.0, and the codecs make exact fractions of it
            assert [repr(x) for x in signal[6:11]] == [
                repr(x) for x in (same.scale, same.offset, same.minimum, same.maximum, same.unit)
            ]
            assert signal[11:] == (same.is_multiplexer, same.multiplexer_signal, ())


def test_what_is_kept_is_the_same_to_the_last_digit(cache: Path, parses: list[bytes]) -> None:
    first = messages(DBC, keep=True)
    assert repr(messages(DBC, keep=True)) == repr(first)
    assert parses == [DBC]
    assert cache.stat().st_mode & 0o077 == 0
    assert len(list(cache.iterdir())) == 1


def test_nothing_is_kept_unless_asked(cache: Path) -> None:
    messages(DBC)
    assert not cache.exists()


def test_another_content_is_another_database(cache: Path, parses: list[bytes]) -> None:
    messages(DBC, keep=True)
    changed = DBC.replace(b"(0.0005,0)", b"(0.001,0)")
    assert messages(changed, keep=True) != messages(DBC, keep=True)
    assert parses == [DBC, changed]


@pytest.mark.parametrize("damage", [b"", b"[]", b"\xff\xfe", None])
def test_a_damaged_one_is_read_anew(cache: Path, parses: list[bytes], damage: bytes | None) -> None:
    good = messages(DBC, keep=True)
    (file,) = cache.iterdir()
    text = file.read_bytes()
    file.write_bytes(text.replace(b"0.0005", b"0.0006") if damage is None else damage)
    assert messages(DBC, keep=True) == good
    assert len(parses) == 2
    assert file.read_bytes() == text, "and mended"


def test_another_cantools_reads_anew(
    cache: Path, parses: list[bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    messages(DBC, keep=True)
    (tmp_path / "cantools").mkdir()
    (tmp_path / "cantools" / "__init__.py").touch()
    with monkeypatch.context() as m:
        m.delitem(sys.modules, "cantools")
        m.syspath_prepend(tmp_path)
        key = database._key(DBC)
    assert not (cache / f"{key}.json").exists()


def test_a_process_whose_module_is_exchanged_keeps_nothing_for_the_other_one(
    cache: Path, parses: list[bytes], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    messages(DBC, keep=True)
    (tmp_path / "database.py").write_text("of another version")
    monkeypatch.setattr(database, "__file__", str(tmp_path / "database.py"))
    messages(DBC, keep=True)
    assert len(list(cache.iterdir())) == len(parses) == 1


def test_a_folder_that_others_may_write_to_is_not_used(cache: Path, parses: list[bytes]) -> None:
    cache.mkdir(parents=True)
    cache.chmod(0o777)
    assert messages(DBC, keep=True) == messages(DBC, keep=True)
    assert len(parses) == 2
    assert not list(cache.iterdir())


def test_a_home_without_room_keeps_nothing(
    cache: Path, parses: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    assert messages(DBC, keep=True) == messages(DBC)
    assert not list(cache.iterdir())


def test_old_ones_go(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database, "_KEPT", 2)
    for number in range(4):
        messages(DBC + b"\n" * number, keep=True)
    assert len(list(cache.iterdir())) == 2
