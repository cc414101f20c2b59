"""Wear: what is kept of each identification, which logs are looked at, what is drawn, and the exit status."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from commands import pneud_here
from pneud.config.reading import parse
from pneud.config.sections import ConfigError
from pneud.log.files.naming import LogError
from pneud.log.files.reader import read_log
from pneud.study.identification import courses, estimating, table, wear
from pneud.study.identification import parameters as key
from pneud.study.identification.estimating import Identified
from pneud.study.identification.parameters import Estimate
from pneud.study.identification.wear import Entry

GOLDEN = Path(__file__).parent / "golden"


def told(value: float, half: float = 0.5, known: bool = True) -> Estimate:
    return Estimate(value, value - half, value + half, 40.0, known)


def weeks(*values: float) -> list[Entry]:
    """An entry a week, of Coulomb friction."""
    return [
        Entry(f"2026-11-{7 * n + 1:02}T03:00", (f"{n}.mcap",), {key.COULOMB: told(value)})
        for n, value in enumerate(values)
    ]


def test_what_is_kept_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "wear.jsonl"
    assert wear.history(path) == []
    wear.write(path, weeks(40.0, 41.0))
    assert wear.history(path) == weeks(40.0, 41.0)
    path.write_text("{}\n")
    with pytest.raises(ConfigError, match=r"wear.jsonl:1: not what pneud identify --wear writes"):
        wear.history(path)
    with pytest.raises(ConfigError, match="cannot be read"):
        wear.history(tmp_path)


def test_each_parameter_is_compared_with_the_first_time_that_it_was_told() -> None:
    first, second, third = weeks(40.0, 41.0, 42.0)
    unsure = first._replace(parameters={key.COULOMB: told(40.0, known=False), key.SEEP: told(0.001, 1e-4)})
    found = wear.at_first([unsure, second, third])
    assert (found[key.COULOMB].value, found[key.SEEP].value) == (41.0, 0.001)
    assert [p.estimate.value for p in wear.course([unsure, second, third], key.COULOMB)] == [41.0, 42.0]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Of three logs, the older the earlier in the alphabet, and something else."""
    for age, name in enumerate(("c", "b", "a")):
        path = tmp_path / f"{name}.mcap"
        shutil.copy(GOLDEN / "composite.mcap", path)
        begun_s = 1e-9 * read_log(path).start_ns()
        os.utime(path, (begun_s + 1000.0 - age, begun_s + 1000.0 - age))
    (tmp_path / "wear.jsonl").touch()
    return tmp_path


def names(folder: Path) -> list[str]:
    return [log.path.name for log in wear.newest(folder)]


def test_the_newest_logs_are_as_many_as_tell_enough(folder: Path) -> None:
    assert names(folder) == ["b.mcap", "c.mcap"]  # 1000 s each
    with (folder / "c.mcap").open("rb") as written:
        fcntl.flock(written, fcntl.LOCK_EX)
        assert names(folder) == ["a.mcap", "b.mcap"]
    os.utime(folder / "c.mcap", (2e9, 2e9))
    assert names(folder) == ["c.mcap"]


def test_a_folder_without_a_finished_log_is_told(folder: Path) -> None:
    for path in folder.glob("*.mcap"):
        os.utime(path, (0.0, 0.0))  # as long as nothing
    with pytest.raises(LogError, match="no finished log"):
        wear.newest(folder)


def test_wear_is_drawn_once_there_are_two_dates() -> None:
    assert courses.section(weeks(40.0)).content == ""
    drawn = courses.section(weeks(40.0, 41.0, 60.0)).content
    assert drawn.count("<svg") == 1
    assert drawn.count("<circle") == 3
    assert drawn.count('fill="#d55e00"') == 1  # what is off stands out
    assert f"{key.COULOMB}: 40 at first, 60 now" in drawn


@pytest.fixture
def found(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, Estimate]]:
    """What is found in any log, to be changed by a test."""
    parameters = {key.COULOMB: told(40.0)}
    measured = (table.Table(1e-3, 0.0, ()), parse(read_log(GOLDEN / "composite.mcap").config_text, "x"))
    monkeypatch.setattr(table, "read", lambda *_: measured)
    monkeypatch.setattr(
        estimating, "identify", lambda *_: Identified(dict(parameters), [], [], 100.0, None, None)
    )
    return iter([parameters])


def test_the_exit_status_tells_of_wear_alone(
    folder: Path, found: Iterator[dict[str, Estimate]], tmp_path: Path
) -> None:
    (parameters,) = found
    kept, page = tmp_path / "wear.jsonl", tmp_path / "wear.html"
    kept.unlink()
    parameters[key.COULOMB] = told(60.0)  # another than configured, as it may have been from the start
    done = pneud_here("identify", folder, "--wear", kept, "-o", page)
    assert (done.returncode, done.stderr) == (0, "")
    assert "verdict: differs" in done.stdout
    assert len(wear.history(kept)) == 1
    assert "Wear" not in page.read_text()
    parameters[key.COULOMB] = told(61.0)
    done = pneud_here("identify", folder, "--wear", kept)  # the same logs again
    assert (done.returncode, len(wear.history(kept))) == (0, 1)
    parameters[key.COULOMB] = told(90.0)
    (folder / "c.mcap").unlink()
    done = pneud_here("identify", folder, "--wear", kept, "-o", page)
    assert done.returncode == 1
    assert "verdict: worn" in done.stdout
    assert "61 worn" in done.stdout
    assert f"{key.COULOMB}: 61 at first, 90 now" in page.read_text()


def test_one_earlier_identification_or_many() -> None:
    done = pneud_here("identify", GOLDEN / "composite.mcap", "--wear", "w", "--against", "b")
    assert done.returncode == 2
    assert "give one of them" in done.stderr
