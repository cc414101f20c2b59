"""Files that tools make are there whole, or as they were before."""

from __future__ import annotations

import itertools
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from commands import pneud_here
from pneud.replay import sidecar
from pneud.replay.lockstep import Simulation
from pneud.rt.outputs import replacing, replacing_all, write_whole
from pneud.signals import Record


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


@pytest.mark.parametrize("there", [True, False])
@pytest.mark.parametrize("links", [True, False])
def test_files_that_belong_together_are_replaced_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, there: bool, links: bool
) -> None:
    one, other = tmp_path / "run.log", tmp_path / "run.log.json"
    if there:
        one.write_text("old")
        other.write_text("old")
    if not links:
        monkeypatch.setattr("os.link", refusing)
    before = contents(tmp_path)
    for failure in ("in the block", "of the first", "of the second"):
        with monkeypatch.context() as m, pytest.raises(OSError, match="full"):
            if failure != "in the block":
                m.setattr(Path, "replace", failing_replace(of_the_second=failure == "of the second"))
            with replacing_all(one, other) as (first, second):
                first.write_text("new")
                second.write_text("new")
                if failure == "in the block":
                    raise OSError(28, "the disk is full")
        if links or not there or failure != "of the second":
            assert contents(tmp_path) == before, failure
        else:  # what was there cannot come back: the first is whole and new, the other one whole and old
            assert contents(tmp_path) == {"run.log": "new", "run.log.json": "old"}
    with replacing_all(one, other) as (first, second):
        first.write_text("newer")
        second.write_text("newer")
    assert contents(tmp_path) == {"run.log": "newer", "run.log.json": "newer"}


def contents(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir()}


def refusing(*_: object) -> None:
    raise PermissionError(1, "this disk knows no links")


def failing_replace(*, of_the_second: bool) -> Callable[[Path, Path], Path]:
    """`Path.replace` which refuses one of two files; what puts things back is let through."""
    usual, calls = Path.replace, iter((False, True) if of_the_second else (True,))

    def replace(path: Path, target: Path) -> Path:
        if next(calls, False):
            raise OSError(28, "the disk is full")
        return usual(path, target)

    return replace


def test_a_simulation_that_is_broken_off_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = Simulation.records

    def records(simulation: Simulation) -> Iterator[Record]:
        yield from itertools.islice(usual(simulation), 500)
        raise KeyboardInterrupt

    monkeypatch.setattr(Simulation, "records", records)
    done = pneud_here("sim", "--duration", 1, "-o", tmp_path / "x.mcap")
    assert done.returncode == 130
    assert not contents(tmp_path)


def test_an_export_whose_second_file_fails_leaves_both_as_they_were(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "logs").mkdir()
    (tmp_path / "out").mkdir()
    log, recording = tmp_path / "logs" / "x.mcap", tmp_path / "out" / "x.log"
    assert pneud_here("sim", "--duration", 0.1, "-o", log).returncode in (0, 1)
    assert pneud_here("export", log, "-o", recording).returncode == 0
    before = contents(recording.parent)
    assert set(before) == {"x.log", "x.log.json"}
    monkeypatch.setattr(sidecar, "write", refusing)
    assert pneud_here("export", log, "-o", recording).returncode in (2, 3)
    assert contents(recording.parent) == before
