"""Many logs as one table: what is in it, what is read again, and what becomes of logs that cannot be read."""

from __future__ import annotations

import builtins
import csv
import fcntl
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import duckdb
import polars as pl
import pytest

from commands import object_of, pneud_here
from pneud.farm import gathering
from pneud.farm.gathering import logs_below, readers, summarise
from pneud.farm.rows import Found, Row, rows_of
from pneud.farm.store import COLUMNS, CsvStore, store_of
from pneud.log.files.naming import LogError
from pneud.notebook.logs import read_log
from pneud.replay.motions import Motion

GOLDEN = Path(__file__).with_name("golden")
PAGE = Path(__file__).parent.parent / "docs" / "farm.md"


@pytest.fixture
def shop(tmp_path: Path) -> Path:
    """Three logs in two folders."""
    (tmp_path / "logs" / "monday").mkdir(parents=True)
    for name, place in (("virtual", "monday/a"), ("requests", "monday/b"), ("encoder-missing", "c")):
        shutil.copy(GOLDEN / f"{name}.mcap", tmp_path / "logs" / f"{place}.mcap")
    return tmp_path / "logs"


def found(path: Path) -> Found:
    there = path.stat()
    return Found(path, there.st_size, there.st_mtime_ns)


def summed(shop: Path, table: Path, *options: str, status: int = 0) -> dict[str, Any]:
    done = pneud_here("logs", shop, "--summary", table, "--json", *options)
    assert done.returncode == status, done.stderr
    return object_of(done)


def asked(query: str) -> list[Any]:
    found = duckdb.sql(query)
    assert found is not None
    return found.fetchall()


def test_every_motion_has_a_row_with_what_it_came_to(shop: Path) -> None:
    for path in sorted(shop.rglob("*.mcap")):
        rows, motions = rows_of(found(path)), read_log(path).motions()
        assert [row.motion for row in rows] == [*range(1, len(motions) + 1)]
        for row, motion in zip(rows, motions, strict=True):
            for name in set(Motion._fields) & set(Row._fields):
                value = getattr(motion, name)
                assert getattr(row, name) == (value if value == value else None), name
            assert row.duration_s == motion.duration_s
            assert row.begun_ns is not None and row.log_begun_ns is not None
            assert row.begun_ns - row.log_begun_ns == round(motion.begin_s * 1e9)


def test_a_row_says_what_the_run_was(shop: Path) -> None:
    path = shop / "c.mcap"
    log, rows = read_log(path), rows_of(found(path))
    first = rows[0]
    assert (first.axis, first.bus, first.run) == (log.facts["name"], log.facts["bus"], log.metadata["run"])
    assert (first.ticks, first.law, first.damage, first.closed) == (
        len(list(log)),
        log.config.control.law,
        "",
        True,
    )
    latched = {name for tick in log if tick.latched for name in tick.fault_names}
    assert set(first.run_faults.split()) <= latched
    assert first.run_faults
    (hurt,) = (row for row in rows if row.faults)
    assert hurt.ended_in == "fault"
    assert set(hurt.faults.split()) <= set(first.run_faults.split())


def test_only_logs_that_are_new_or_have_grown_are_read(shop: Path, tmp_path: Path) -> None:
    table = tmp_path / "year.parquet"
    first = summed(shop, table)
    assert (first["logs"], first["read"]) == (3, 3)
    before = pl.read_parquet(table)
    assert summed(shop, table)["read"] == 0
    assert pl.read_parquet(table).equals(before)
    shutil.copy(GOLDEN / "frames-lost.mcap", shop / "c.mcap")
    again = summed(shop, table)
    assert (again["read"], again["logs"]) == (1, 3)
    after = pl.read_parquet(table)
    assert set(after["log"]) == {str(path) for path in shop.rglob("*.mcap")}
    kept = pl.col("log") != str(shop / "c.mcap")
    assert after.filter(kept).equals(before.filter(kept))
    assert not after.filter(~kept).equals(before.filter(~kept))


def test_the_motions_of_a_log_outlive_it(shop: Path, tmp_path: Path) -> None:
    table = tmp_path / "year.parquet"
    motions = summed(shop, table)["motions"]
    (shop / "monday" / "a.mcap").unlink()
    done = summed(shop, table)
    assert (done["logs"], done["gone"], done["motions"]) == (2, 1, motions)
    assert "1 logs are no longer there" in pneud_here("logs", shop, "--summary", table).stdout


def test_damaged_logs_are_named_and_are_rows_with_the_reason(shop: Path, tmp_path: Path) -> None:
    whole = (GOLDEN / "frames-lost.mcap").read_bytes()
    (shop / "cut.mcap").write_bytes(whole[: len(whole) * 3 // 4])
    (shop / "noise.mcap").write_bytes(b"something else")
    (shop / "empty.mcap").touch()
    done = pneud_here("logs", shop, "--summary", tmp_path / "year.parquet")
    assert done.returncode == 1
    named = [line for line in done.stderr.splitlines() if line.startswith("pneud: ")]
    assert [Path(line.split(": ")[1]).name for line in named] == ["cut.mcap", "empty.mcap", "noise.mcap"]
    rows = pl.read_parquet(tmp_path / "year.parquet")
    for path, motions in (("cut", 1), ("noise", 0), ("empty", 0)):
        own = rows.filter(pl.col("log") == str(shop / f"{path}.mcap"))
        assert len(own) >= 1
        assert all(own["damage"])
        assert own["motion"].drop_nulls().len() >= motions
        assert not any(own["closed"])
    again = pneud_here("logs", shop, "--summary", tmp_path / "year.parquet")
    assert (again.returncode, again.stderr) == (0, "")  # they have been named


def test_a_log_that_is_being_written_is_not_damaged(shop: Path) -> None:
    path = shop / "c.mcap"
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 3 // 4])
    with path.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        (row, *_) = rows_of(found(path))
    assert (row.damage, row.closed) == ("", False)
    assert row.ticks > 0


def test_a_log_whose_configuration_is_of_another_version_is_told(
    shop: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise ValueError("no such key")

    monkeypatch.setattr("pneud.farm.rows._parsed", refuse)
    (row,) = rows_of(found(shop / "c.mcap"))
    assert "cannot be used: no such key" in row.damage
    assert (row.axis, row.motion) == ("virtual", None)


def test_what_nobody_foresaw_is_a_row_too(shop: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("out of luck")

    monkeypatch.setattr("pneud.farm.rows.LogReader", fail)
    (row,) = rows_of(found(shop / "c.mcap"))
    assert row.damage == "cannot be summarised: RuntimeError: out of luck"


def test_csv_says_the_same(shop: Path, tmp_path: Path) -> None:
    summed(shop, tmp_path / "a.csv")
    assert summed(shop, tmp_path / "a.csv")["read"] == 0
    summed(shop, tmp_path / "a.parquet")
    rows, table = (
        pl.read_csv(tmp_path / "a.csv", infer_schema_length=None),
        pl.read_parquet(tmp_path / "a.parquet"),
    )
    assert rows.columns == table.columns == [*COLUMNS]
    for name in ("log", "motion", "kind", "rms_error_m", "ticks", "changed_ns", "learnt_coulomb_n"):
        assert rows[name].to_list() == [x or None if x == "" else x for x in table[name].to_list()], name
    columns = "log, motion, epoch_us(begun), epoch_us(log_begun), closed, to_m"
    query = f"select {columns} from '{{}}' order by log, motion"
    one, other = (asked(query.format(tmp_path / f"a.{kind}")) for kind in ("csv", "parquet"))
    assert one == other


def test_without_pyarrow_it_is_csv_and_says_so(
    shop: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = builtins.__import__

    def refuse(name: str, *rest: Any, **more: Any) -> Any:
        if name.partition(".")[0] == "pyarrow":
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", refuse)
    done = pneud_here("logs", shop, "--summary", tmp_path / "year.parquet")
    assert done.returncode == 0
    assert done.stderr.count("\n") == 1
    assert "pip install 'pneud[parquet]'" in done.stderr
    assert (tmp_path / "year.csv").is_file()
    assert not (tmp_path / "year.parquet").exists()


def test_a_copy_counts_once_and_a_log_that_was_moved_stays_one(shop: Path, tmp_path: Path) -> None:
    table = tmp_path / "year.parquet"
    motions = summed(shop, table)["motions"]
    copy, original = shop / "copy.mcap", shop / "c.mcap"
    shutil.copy(original, copy)
    done = summed(shop, table)
    assert done["copies"] == [{"path": str(copy), "of": str(original)}]
    assert done["motions"] == motions
    assert summed(shop, table)["read"] == 0
    moved = shop / "monday" / "moved.mcap"
    original.rename(moved)
    copy.unlink()
    done = summed(shop, table)
    assert (done["motions"], done["copies"]) == (motions, [])
    assert str(moved) in set(pl.read_parquet(table)["log"])


def test_of_copies_the_longer_one_counts(shop: Path, tmp_path: Path) -> None:
    table, whole = tmp_path / "year.parquet", shop / "c.mcap"
    shutil.copy(whole, tmp_path / "whole.mcap")
    whole.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    summed(shop, table, status=1)
    (tmp_path / "whole.mcap").rename(shop / "recovered.mcap")
    done = summed(shop, table)
    assert done["copies"] == [{"path": str(whole), "of": str(shop / "recovered.mcap")}]
    assert summed(shop, table)["read"] == 0


def test_the_table_does_not_hang_on_who_was_first(shop: Path, tmp_path: Path) -> None:
    def backwards(many: Any) -> Iterator[list[Row]]:
        return iter([rows_of(one) for one in reversed(many)])

    tables = []
    for name, read in (("one", lambda many: map(rows_of, many)), ("other", backwards)):
        store, _ = store_of(tmp_path / f"{name}.csv")
        summarise([shop], store, read)
        tables.append((tmp_path / f"{name}.csv").read_bytes())
    with readers(2) as pool:
        summarise([shop], CsvStore(tmp_path / "pool.csv"), pool)
    assert tables[0] == tables[1] == (tmp_path / "pool.csv").read_bytes()


def test_what_was_read_before_an_interruption_stays(shop: Path, tmp_path: Path) -> None:
    def interrupted(many: Any) -> Iterator[list[Row]]:
        yield rows_of(many[0])
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        summarise([shop], CsvStore(tmp_path / "x.csv"), interrupted)
    assert len(CsvStore(tmp_path / "x.csv").known()) == 1
    with readers(1) as read:
        assert summarise([shop], CsvStore(tmp_path / "x.csv"), read).read == 2


def test_now_and_then_it_is_written(shop: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gathering, "SAVED_S", -1.0)
    store, saved = CsvStore(tmp_path / "x.csv"), []
    write: Callable[[], int] = store.save
    monkeypatch.setattr(store, "save", lambda: saved.append(write()))
    with readers(1) as read:
        summarise([shop], store, read)
    assert len(saved) == 3


def test_logs_are_looked_for_in_all_folders_below(shop: Path, tmp_path: Path) -> None:
    (shop / "x.txt").touch()
    (shop / ".hidden.mcap").touch()
    names = [log.path.name for log in logs_below([shop, shop / "c.mcap"])]
    assert names == ["c.mcap", "a.mcap", "b.mcap"]
    assert not (tmp_path / "none.parquet").exists()
    (tmp_path / "nothing").mkdir()
    assert summed(tmp_path / "nothing", tmp_path / "none.parquet")["motions"] == 0
    assert pl.read_parquet(tmp_path / "none.parquet").columns == [*COLUMNS]


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_a_table_of_something_else_is_not_touched(shop: Path, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"x{suffix}"
    other = pl.DataFrame({"a": [1]})
    other.write_csv(path) if suffix == ".csv" else other.write_parquet(path)
    before = path.read_bytes()
    done = pneud_here("logs", shop, "--summary", path)
    assert (done.returncode, done.stdout) == (2, "")
    assert "no summary of logs" in done.stderr
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(LogError):
        store_of(path)
    assert before


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("--summary", "x.txt"), "must end in .parquet or .csv"),
        (("--summary", "none/x.csv"), "there is no folder"),
        (("--summary", "x.csv", "nowhere"), "nowhere: there is no such folder"),
    ],
)
def test_what_cannot_be_done_is_refused(
    shop: Path, args: tuple[str, ...], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(shop)
    done = pneud_here("logs", *args) if len(args) == 3 else pneud_here("logs", shop, *args)
    assert (done.returncode in (1, 2, 3), done.stdout) == (True, "")
    assert words in done.stderr
    assert not list(shop.glob("x.*"))


def test_a_line_that_is_none_is_said(shop: Path, tmp_path: Path) -> None:
    table = tmp_path / "x.csv"
    summed(shop, table)
    lines = [*csv.reader(table.open())]
    lines[1][COLUMNS.index("ticks")] = "many"
    with table.open("w", newline="") as file:
        csv.writer(file).writerows(lines)
    done = pneud_here("logs", shop, "--summary", table)
    assert done.returncode == 2
    assert "is none of a summary" in done.stderr


def test_several_folders_are_listed(shop: Path) -> None:
    told = object_of(pneud_here("logs", shop, shop / "monday", "--json"))
    assert told["folders"] == [str(shop), str(shop / "monday")]
    assert len(told["logs"]) == 3
    assert pneud_here("logs", shop, shop / "monday").stdout.count("logs\n") == 2


def test_the_page_has_every_column() -> None:
    text = PAGE.read_text()
    named = set(re.findall(r"`([a-z_0-9]+)`", text))
    assert {name.removeprefix("learnt_") for name in COLUMNS} <= named
