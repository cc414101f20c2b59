"""Parts of a log: nothing is lost between them, each stands alone, and the right ones go."""

from __future__ import annotations

import fcntl
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from log_samples import FAULTS, OFFSET_NS, header, noisy, write_log
from pneud.log.files.naming import LogError, create_log, next_part
from pneud.log.files.reader import LoggedState, LogReader, read_log
from pneud.log.files.retention import PartInfo, part_info, protected, tidy, victims
from pneud.log.files.writer import LogWriter
from pneud.log.format.header import Rotation
from pneud.log.format.snapshot import SnapshotError, from_json, to_json
from pneud.signals import Record, State

S = 1_000_000_000


class Rest(NamedTuple):
    t_ns: int
    value: float


def rotation(path: Path, part: int = 40_000, quota: int = 0, *, folder: bool = True) -> Rotation:
    return Rotation(path, part, 0, quota, folder, 2 * S, 1 * S)


def faulty(record: Record) -> Record:
    return record._replace(tick=record.tick._replace(latched=1, state=int(State.FAULT)))


def written(path: Path, records: list[Record], r: Rotation) -> LogWriter:
    """A log in parts, with a snapshot every 100 records."""
    writer = LogWriter(create_log(path), header(), r)
    for n, record in enumerate(records, start=1):
        writer.write(record)
        if n % 100 == 0:
            writer.snapshot({"axis": Rest(record.tick.t_ns, n / 3)})
            writer.attend()
            if writer._tidying is not None:
                writer._tidying.join()
    writer.close()
    return writer


def test_no_record_is_missing_between_the_parts(tmp_path: Path) -> None:
    records = list(noisy(1500))
    writer = written(tmp_path / "x.mcap", records, rotation(tmp_path / "x.mcap"))
    names = sorted(p.name for p in tmp_path.iterdir())
    assert len(names) >= 4
    assert names[:3] == ["x.mcap", "x.part00002.mcap", "x.part00003.mcap"]
    assert writer.written == 1500
    assert writer.file_bytes <= sum(p.stat().st_size for p in tmp_path.iterdir())
    log = read_log(tmp_path)
    assert [t.number for t in log] == list(range(1, 1501))
    assert (log.truncated, log.missing, log.damage) == (False, 0, "")
    assert [t.t_ns for t in log] == [r.tick.t_ns for r in records]
    mixed = sorted(tmp_path.iterdir(), key=lambda p: hash(p.name))
    assert read_log(*mixed).paths == log.paths


def test_each_part_stands_alone_and_begins_with_the_state_of_the_axis(tmp_path: Path) -> None:
    written(tmp_path / "x.mcap", list(noisy(1050)), rotation(tmp_path / "x.mcap"))
    whole = read_log(tmp_path)
    for number, path in enumerate(sorted(tmp_path.iterdir()), start=1):
        part = read_log(path)
        assert part.config_text == whole.config_text
        assert part.metadata["run"] == whole.metadata["run"]
        assert part.metadata["part"] == str(number)
        items = list(part.items())
        assert part.missing == 0
        if number > 1:
            first, second = items[:2]
            assert isinstance(first, LoggedState)
            assert first.number == second.number - 1 == part.records_before


def test_reading_begins_at_the_snapshot_before_a_time(tmp_path: Path) -> None:
    written(tmp_path / "x.mcap", list(noisy(1000)), rotation(tmp_path / "x.mcap"))
    log = read_log(tmp_path)
    ticks = list(log)
    for number in (50, 150, 555, 999):
        items = list(log.items(ticks[number - 1].log_time_ns))
        first = items[0]
        if number < 100:
            assert not isinstance(first, LoggedState)
        else:
            assert isinstance(first, LoggedState)
            assert first.number == (number - 1) // 100 * 100
        numbers = [item.number for item in items if not isinstance(item, LoggedState)]
        assert numbers == list(range(first.number + 1 if number >= 100 else 1, 1001))
        assert log.missing == 0


def test_the_time_around_a_fault_is_marked(tmp_path: Path) -> None:
    records = list(noisy(600))
    records[299:] = map(faulty, records[299:])
    written(tmp_path / "x.mcap", records, rotation(tmp_path / "x.mcap", part=0))
    info = part_info(tmp_path / "x.mcap")
    assert info is not None
    at = records[299].tick.t_ns + OFFSET_NS
    assert info.kept == ((at - 2 * S, at + 1 * S),)
    assert (info.start_ns, info.end_ns) == tuple(records[i].tick.t_ns + OFFSET_NS for i in (0, -1))
    data = (tmp_path / "x.mcap").read_bytes()
    assert FAULTS[0].encode() in data
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) * 3 // 4])
    again = part_info(cut)
    assert again is not None
    assert again.kept == info.kept
    assert (again.name, again.run, again.number, again.start_ns) == (info.name, info.run, 1, info.start_ns)


def part(number: int, kept: tuple[tuple[int, int], ...] = (), run: str = "a", size: int = 10) -> PartInfo:
    start = number * 10
    return PartInfo(Path(f"{run}{number}"), size, "x", run, number, start, start + 10, kept)


def test_the_oldest_go_first_and_those_around_a_fault_last() -> None:
    parts = [part(n, ((28, 41),) if n == 4 else ()) for n in range(1, 8)]
    assert protected(parts) == {Path("a2"), Path("a3"), Path("a4")}
    assert [p.number for p in victims(parts, 45)] == [1, 5, 6]
    assert [p.number for p in victims(parts, 25)] == [1, 5, 6, 7, 2]
    assert list(victims(parts, 70)) == []
    assert [p.number for p in victims(parts, 0)] == [1, 5, 6, 7, 2, 3, 4]


def test_a_fault_protects_its_own_run_only() -> None:
    assert protected([part(1, ((0, 100),), "a"), part(2, (), "b")]) == {Path("a1")}


@given(st.lists(st.tuples(st.integers(1, 50), st.booleans()), max_size=12), st.integers(0, 300))
def test_what_is_left_fits_the_quota_and_nothing_goes_without_need(
    sizes: list[tuple[int, bool]], quota: int
) -> None:
    parts = [
        part(n, ((n * 10 + 5, n * 10 + 5),) if fault else (), size=size)
        for n, (size, fault) in enumerate(sizes)
    ]
    gone = list(victims(parts, quota))
    left = sum(p.size for p in parts) - sum(p.size for p in gone)
    assert left <= quota
    assert not gone or left + gone[-1].size > quota
    spared = protected(parts)
    for one, other in pairwise(gone):
        assert (one.path in spared, one.start_ns) < (other.path in spared, other.start_ns)


def test_the_quota_holds_while_the_log_is_written(tmp_path: Path) -> None:
    records = list(noisy(3000))
    records[0] = faulty(records[0])
    written(
        tmp_path / "x.mcap",
        records,
        rotation(tmp_path / "x.mcap", part=50_000, quota=250_000)._replace(keep_after_ns=S // 10),
    )
    # the one being written may go beyond its size by what lies between two snapshots
    assert sum(p.stat().st_size for p in tmp_path.iterdir()) <= 250_000 + 30_000
    assert (tmp_path / "x.mcap").exists()  # it holds the fault
    numbers = [t.number for t in read_log(*[p for p in tmp_path.iterdir() if p.name != "x.mcap"])]
    assert numbers == list(range(numbers[0], 3001))
    assert numbers[0] > 1000
    log = read_log(tmp_path)
    list(log)
    assert log.missing > 0
    assert any("to keep the quota" in e.message for e in log.events())


def test_only_logs_of_the_axis_go_and_none_that_is_being_written(tmp_path: Path) -> None:
    records = list(noisy(300))
    for name in ("old", "busy", "current"):
        write_log(tmp_path / f"{name}.mcap", records)
    (tmp_path / "foreign.mcap").write_bytes(bytes(10**6))
    other = LogWriter(create_log(tmp_path / "other.mcap"), header()._replace(name="other"))
    for r in records:
        other.write(r)
    other.close()
    with (tmp_path / "busy.mcap").open("rb") as busy:
        fcntl.flock(busy, fcntl.LOCK_EX)
        words = tidy(tmp_path / "current.mcap", rotation(tmp_path / "current.mcap", 1, 2))
    assert words == ["deleted old.mcap to keep the quota"]
    assert {p.stem for p in tmp_path.iterdir()} == {"busy", "current", "foreign", "other"}
    # with a file named, only parts of its run
    assert tidy(tmp_path / "current.mcap", rotation(tmp_path / "current.mcap", 1, 2, folder=False)) == []


def test_where_a_mark_may_be_lost_the_whole_part_is_spared(tmp_path: Path) -> None:
    records = list(noisy(300))
    path = tmp_path / "x.mcap"
    written(path, [faulty(records[0]), *records[1:]], rotation(path, part=10**9))
    whole = path.read_bytes()
    unfinished = whole[: whole.rindex(b"copy")]  # as of a run that was killed
    mark, name = whole.index(b"from_ns"), whole.index(b"kept")
    assert whole.count(b"kept") > 1, "the record and its index"
    for data in (whole, unfinished):
        for place in (mark, mark + 12, name - 13, name - 3, name + 8):
            damaged = bytearray(data)
            damaged[place] ^= 0x20
            path.write_bytes(damaged)
            info = part_info(path)
            assert info is not None
            assert protected([info]) == {path}


@pytest.mark.parametrize("key", ["run", "part", "crc32"])
def test_a_damaged_log_is_left_alone_and_hinders_nobody(tmp_path: Path, key: str) -> None:
    records = list(noisy(300))
    for name in ("damaged", "current", "old"):
        path = tmp_path / f"{name}.mcap"
        written(path, [faulty(records[0]), *records[1:]], rotation(path, part=10**9))
    data = bytearray((tmp_path / "damaged.mcap").read_bytes())
    data[data.index(key.encode())] ^= 1
    (tmp_path / "damaged.mcap").write_bytes(data)
    assert part_info(tmp_path / "damaged.mcap") is None
    words = tidy(tmp_path / "current.mcap", rotation(tmp_path / "current.mcap", 1, 2))
    assert words == ["deleted old.mcap to keep the quota, though it holds a fault"]


def test_a_part_that_cannot_be_made_leaves_the_log_where_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path) -> int:
        raise LogError(f"{path}: cannot be created")

    writer = LogWriter(create_log(tmp_path / "x.mcap"), header(), rotation(tmp_path / "x.mcap", part=1))
    monkeypatch.setattr("pneud.log.files.writer.create_log", refuse)
    for n, record in enumerate(noisy(300), start=1):
        writer.write(record)
        if n % 100 == 0:
            writer.snapshot(None)
    assert writer.close()
    log = read_log(tmp_path / "x.mcap")
    assert len(list(log)) == 300
    assert any("no next part" in e.message for e in log.events())


def test_names_of_parts_sort_and_are_free(tmp_path: Path) -> None:
    first = tmp_path / "x-20261122T022445Z.mcap"
    names = [first]
    for number in range(2, 12):
        names.append(next_part(names[-1], number))
        names[-1].touch()
    assert names == sorted(names, key=lambda p: p.name)
    assert next_part(first, 3).name == "x-20261122T022445Z.part00012.mcap"


def test_two_runs_or_two_copies_are_not_one_log(tmp_path: Path) -> None:
    write_log(tmp_path / "a.mcap", list(noisy(5)))
    write_log(tmp_path / "b.mcap", list(noisy(5)))
    with pytest.raises(LogError, match="two runs"):
        read_log(tmp_path)
    (tmp_path / "b.mcap").write_bytes((tmp_path / "a.mcap").read_bytes())
    with pytest.raises(LogError, match="the same part"):
        read_log(tmp_path)


def test_numbers_go_on_where_those_of_mcap_begin_anew(tmp_path: Path) -> None:
    writer = LogWriter(create_log(tmp_path / "x.mcap"), header())
    writer._number = 2**32 - 5
    for record in noisy(10):
        writer.write(record)
    writer.close()
    log = read_log(tmp_path / "x.mcap")
    log._files[0].records_before = 2**32 - 5
    assert [t.number for t in log] == list(range(2**32 - 4, 2**32 + 6))
    assert log.missing == 0


class Tree(NamedTuple):
    number: int
    flag: bool
    value: float
    maybe: Rest | None
    several: tuple[Rest, ...]
    pair: tuple[int, float]
    name: str


_numbers = st.floats(allow_nan=False)
_rests = st.builds(Rest, st.integers(-(2**63), 2**63), _numbers)


@given(
    st.builds(
        Tree,
        st.integers(),
        st.booleans(),
        _numbers,
        st.none() | _rests,
        st.lists(_rests, max_size=3).map(tuple),
        st.tuples(st.integers(), _numbers),
        st.text(),
    )
)
def test_a_tree_comes_back_to_the_bit(tree: Tree) -> None:
    assert repr(from_json(Tree, to_json(tree))) == repr(tree)


def test_numbers_that_are_not_finite_come_back() -> None:
    for value in (float("nan"), float("inf"), -float("inf"), -0.0):
        assert repr(from_json(Rest, to_json(Rest(1, value)))) == repr(Rest(1, value))


@pytest.mark.parametrize(
    "data",
    ["{", "[]", "1", '{"t_ns": 1}', '{"t_ns": 1.5, "value": 1.0}', '{"t_ns": 1, "value": "x"}',
     '{"t_ns": true, "value": 1.0}', '{"t_ns": 1, "value": 1.0, "other": 2}'],
)  # fmt: skip
def test_another_tree_is_refused(data: str) -> None:
    with pytest.raises(SnapshotError):
        from_json(Rest, data)


class Longer(NamedTuple):
    t_ns: int
    value: float
    other: Rest | None = None


def test_a_field_that_is_absent_has_its_default() -> None:
    assert from_json(Longer, to_json(Rest(1, 2.0))) == Longer(1, 2.0)
    assert from_json(Longer, to_json(Longer(1, 2.0, Rest(3, 4.0)))) == Longer(1, 2.0, Rest(3, 4.0))
    with pytest.raises(SnapshotError):
        from_json(Longer, '{"t_ns": 1, "other": null}')


def one_or_none(path: Path) -> LogReader | None:
    try:
        return read_log(path)
    except LogError as e:
        assert "\n" not in str(e)
        return None


def test_a_folder_with_a_damaged_part_reads_what_is_left(tmp_path: Path) -> None:
    written(tmp_path / "x.mcap", list(noisy(1000)), rotation(tmp_path / "x.mcap"))
    second = tmp_path / "x.part00002.mcap"
    data = bytearray(second.read_bytes())
    data[len(data) // 2] ^= 1
    second.write_bytes(data)
    log = read_log(tmp_path)
    numbers = [t.number for t in log]
    assert log.truncated
    assert log.damage.startswith("x.part00002.mcap: ")
    assert numbers[-1] == 1000
    assert log.missing == 1000 - len(numbers) > 0
