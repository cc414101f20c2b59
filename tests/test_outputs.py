"""Files that tools make are there whole, or as they were before."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from pneud.rt.outputs import replacing, write_whole


def test_a_file_is_replaced_whole_and_keeps_its_mode(tmp_path: Path) -> None:
    file = tmp_path / "page.html"
    file.write_text("old")
    file.chmod(0o640)
    write_whole(file, "new µ")
    assert file.read_text(encoding="utf-8") == "new µ"
    assert stat.S_IMODE(file.stat().st_mode) == 0o640
    assert [file.name for file in tmp_path.iterdir()] == ["page.html"]


def test_what_fails_half_way_leaves_what_was_there(tmp_path: Path) -> None:
    file = tmp_path / "page.html"
    file.write_text("old")
    with pytest.raises(OSError, match="full"), replacing(file) as beside:
        beside.write_text("half of the n")
        raise OSError(28, "the disk is full")
    assert file.read_text() == "old"
    with pytest.raises(KeyboardInterrupt), replacing(tmp_path / "other") as beside:
        beside.write_text("half")
        raise KeyboardInterrupt
    assert [file.name for file in tmp_path.iterdir()] == ["page.html"]


def test_the_name_beside_keeps_the_ending(tmp_path: Path) -> None:
    with replacing(tmp_path / ("x" * 240 + ".parquet")) as beside:
        assert beside.suffix == ".parquet"
        beside.write_bytes(b"")
    assert (tmp_path / ("x" * 240 + ".parquet")).exists()


def test_a_link_stays_and_its_target_is_replaced(tmp_path: Path) -> None:
    target, link = tmp_path / "target", tmp_path / "link"
    target.write_text("old")
    link.symlink_to(target)
    write_whole(link, b"new")
    assert link.is_symlink()
    assert target.read_bytes() == b"new"


def test_a_device_is_written_to_as_it_is() -> None:
    write_whole(Path("/dev/null"), "x")
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)
    with pytest.raises(OSError, match="No space"):
        write_whole(Path("/dev/full"), "x")


def test_a_folder_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        write_whole(tmp_path / "absent" / "x", "x")
