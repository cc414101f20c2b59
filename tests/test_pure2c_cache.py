"""Files that are believed and run: whole or not there, and nobody else's."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from pure2c.cache import Cache
from pure2c.folders import open_private

ROOT = os.geteuid() == 0
STRANGER = 12345


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Where a cache is to be."""
    return tmp_path / "home" / "cache"


def put(folder: Path, name: str, content: bytes, keep: int = 9) -> None:
    with Cache(folder, keep=keep) as cache:
        cache.put(name, content)


def get(folder: Path, name: str) -> bytes | None:
    with Cache(folder, keep=9) as cache:
        return cache.get(name)


def refused(path: Path) -> str:
    with pytest.raises(OSError) as caught:
        open_private(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_what_is_put_is_there_for_its_user_alone(folder: Path) -> None:
    put(folder, "a", b"content")
    assert get(folder, "a") == b"content"
    assert get(folder, "b") is None
    assert [stat.S_IMODE(path.stat().st_mode) for path in (folder.parent, folder, folder / "a")] == [
        *(0o700, 0o700, 0o600)
    ]
    put(folder, "a", b"")
    assert get(folder, "a") == b""
    assert [path.name for path in folder.iterdir()] == ["a"]


@pytest.mark.parametrize("left", range(len(b"content") + 32))
def test_a_file_that_was_cut_short_is_none(folder: Path, left: int) -> None:
    put(folder, "a", b"content")
    os.truncate(folder / "a", left)
    assert get(folder, "a") is None


def test_a_file_that_is_not_as_it_was_put_there_is_none(folder: Path) -> None:
    put(folder, "a", b"content")
    whole = (folder / "a").read_bytes()
    for i in range(len(whole)):
        (folder / "a").write_bytes(whole[:i] + bytes((whole[i] ^ 1,)) + whole[i + 1 :])
        assert get(folder, "a") is None
    (folder / "b").write_bytes(whole)
    assert get(folder, "b") is None, "under another name"
    (folder / "a").write_bytes(whole + b"\0")
    assert get(folder, "a") is None


def test_what_is_no_file_is_none_and_makes_room(folder: Path, tmp_path: Path) -> None:
    put(folder, "a", b"content")
    (tmp_path / "elsewhere").write_bytes((folder / "a").read_bytes())
    for make in (
        lambda path: path.symlink_to(tmp_path / "elsewhere"),
        lambda path: path.symlink_to(tmp_path / "nowhere"),
        os.mkfifo,
    ):
        (folder / "a").unlink()
        make(folder / "a")
        assert get(folder, "a") is None
        put(folder, "a", b"mended")
        assert get(folder, "a") == b"mended"
        assert stat.S_ISREG((folder / "a").lstat().st_mode)
    assert (tmp_path / "elsewhere").exists()
    assert not (tmp_path / "nowhere").exists()


def test_a_full_disk_leaves_what_was_there(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    put(folder, "a", b"content")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as m, pytest.raises(OSError, match="No space left"):
        m.setattr(os, "fsync", full)
        put(folder, "a", b"other")
    assert get(folder, "a") == b"content"
    assert len(list(folder.iterdir())) == 1


def test_the_oldest_go_and_what_the_killed_have_left(folder: Path) -> None:
    for i in range(4):
        put(folder, f"{i}", b"content")
        os.utime(folder / f"{i}", (i, i))
    for name, age_s in (("young", 0.0), ("old", 1e5)):
        (folder / f".{name}").mkdir()
        (folder / f".{name}" / "made.c").touch()
        changed = (folder / "3").stat().st_ctime - age_s
        os.utime(folder / f".{name}", (changed, changed))
    put(folder, "4", b"content", keep=2)
    assert {path.name for path in folder.iterdir()} == {"3", "4", ".young"}


def test_a_workshop_is_gone_afterwards(folder: Path) -> None:
    with Cache(folder, keep=9) as cache:
        with cache.workshop() as inside:
            os.close(os.open("made", os.O_CREAT, dir_fd=inside))
            (here,) = folder.iterdir()
            assert [path.name for path in here.iterdir()] == ["made"]
        assert not list(folder.iterdir())


def test_a_path_that_is_exchanged_afterwards_leads_nowhere(folder: Path) -> None:
    put(folder, "a", b"content")
    with Cache(folder, keep=9) as cache:
        folder.parent.rename(folder.parent.with_name("moved"))
        put(folder, "a", b"planted")
        assert cache.get("a") == b"content"
        cache.put("b", b"more")
    assert not (folder / "b").exists()
    assert get(folder.parent.with_name("moved") / "cache", "b") == b"more"


def test_nobody_else_may_write_to_what_leads_there(folder: Path) -> None:
    put(folder, "a", b"content")
    for mode in (0o777, 0o770, 0o702):
        folder.parent.chmod(mode)
        assert refused(folder) == f"{folder.parent}: others may write to it; chmod go-w {folder.parent}"
    for mode in (0o755, 0o1777):
        folder.parent.chmod(mode)
        assert get(folder, "a") == b"content"


def test_nobody_else_may_enter_it(folder: Path) -> None:
    put(folder, "a", b"content")
    for mode in (0o777, 0o755, 0o710):
        folder.chmod(mode)
        assert refused(folder) == f"{folder}: others may enter it; chmod 700 {folder}"


@pytest.mark.skipif(not ROOT, reason="needs to give folders away")
def test_it_is_nobody_elses(folder: Path) -> None:
    put(folder, "a", b"content")
    os.chown(folder / "a", STRANGER, STRANGER)
    assert get(folder, "a") is None
    os.chown(folder, STRANGER, STRANGER)
    assert refused(folder) == f"{folder}: belongs to user {STRANGER}, not to 0; remove it"
    os.chown(folder.parent, STRANGER, STRANGER)
    assert refused(folder) == f"{folder.parent}: belongs to user {STRANGER}, not to 0 or root"
    assert refused(folder.parent / "other") == refused(folder)
    assert not (folder.parent / "other").exists()


def test_another_user_is_told_whose_it_is(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    put(folder, "a", b"content")
    owner = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
    assert f"belongs to user {owner}, not to {owner + 1}" in refused(folder)


def test_own_links_are_followed(folder: Path, tmp_path: Path) -> None:
    put(folder, "a", b"content")
    (tmp_path / "absolute").symlink_to(folder.parent)
    (folder.parent / "relative").symlink_to("../home/cache")
    assert get(tmp_path / "absolute" / "relative", "a") == b"content"
    (tmp_path / "ahead").symlink_to(tmp_path / "made")
    put(tmp_path / "ahead", "b", b"more")
    assert get(tmp_path / "made", "b") == b"more"


@pytest.mark.skipif(not ROOT, reason="needs to give a link away")
def test_links_of_others_are_not(folder: Path, tmp_path: Path) -> None:
    put(folder, "a", b"content")
    (tmp_path / "link").symlink_to(folder.parent)
    os.chown(tmp_path / "link", STRANGER, STRANGER, follow_symlinks=False)
    assert "link: belongs to user 12345" in refused(tmp_path / "link" / "cache")


def test_a_link_to_itself_and_what_is_no_folder_are_named(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to("loop")
    assert refused(tmp_path / "loop" / "cache") == f"{tmp_path / 'loop'}: too many symbolic links"
    (tmp_path / "file").touch()
    for path in (tmp_path / "file", tmp_path / "file" / "cache"):
        assert refused(path) == f"{tmp_path / 'file'}: is no folder; remove it"
    assert "File name too long" in refused(tmp_path / ("n" * 300))
