"""Campaigns: what runs draw, how they are numbered, kept, handed out, and shown."""

from __future__ import annotations

import errno
import json
import math
import os
import random
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from commands import Figures, children, eventually, object_of, pneud, pneud_here
from pneud import __version__
from pneud.campaign import conduct, page, tables, unit
from pneud.campaign import record as record_module
from pneud.campaign.conduct import Conductor
from pneud.campaign.draws import drawn, quantile, share
from pneud.campaign.file import load_campaign
from pneud.campaign.plan import Plan, plan_of
from pneud.campaign.record import NAME, Chunk, Record, RecordError, Span, missing, rows_of
from pneud.campaign.rows import Rows
from pneud.campaign.sensitivities import correlation, ranks, spread, strongest
from pneud.campaign.workers import KILLED, ClusterError, fingerprint
from pneud.config.sections import ConfigError
from pneud.log.files.reader import read_log
from pneud.view.progress import silent

ROOT = Path(__file__).parent.parent
EXAMPLES = sorted((ROOT / "examples" / "campaigns").glob("*.toml"))
BRIEF = """\
schema = 1
config = "virtual.toml"
runs = 6

[[play]]
do = "move"
by_mm = 2.0
seconds = 0.3

[parameters]
"plant.cylinder.moving_mass_kg" = {loguniform = [0.5, 2.0], times = true}
"plant.valve.dead_zone_v" = {uniform = [0.0, 0.2]}
"""
shares = st.floats(1e-12, 1.0 - 1e-12)
numbers = st.floats(-1e3, 1e3)


def written(folder: Path, text: str = BRIEF, name: str = "brief.toml") -> Path:
    file = folder / name
    file.write_text(text)
    return file


def planned(file: Path) -> Plan:
    return plan_of(*load_campaign(file))


@pytest.fixture(scope="module")
def brief(tmp_path_factory: pytest.TempPathFactory) -> Plan:
    return planned(written(tmp_path_factory.mktemp("brief")))


@pytest.fixture(scope="module", autouse=True)
def impatient() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(conduct, "LOOK_S", 0.01)
        yield


# what is drawn


@given(numbers, st.floats(1e-3, 1e3), shares, shares)
def test_a_greater_share_never_draws_a_smaller_value_and_all_lie_within(
    low: float, width: float, one: float, other: float
) -> None:
    one, other = sorted((one, other))
    for law in (
        {"uniform": [low, low + width]},
        {"loguniform": [width, 10.0 * width]},
        {"normal": [low, width]},
        {"normal": [low, width], "within": [low - width, low + 2.0 * width]},
        {"normal": [low, 1e-3 * width], "within": [low + width, low + 2.0 * width]},
    ):
        first, second = quantile(law, one), quantile(law, other)
        assert first <= second
        if bounds := law.get("uniform") or law.get("loguniform") or law.get("within"):
            slack = 1e-9 * (1.0 + abs(bounds[0]) + abs(bounds[1]))
            assert bounds[0] - slack <= first <= second <= bounds[1] + slack


def test_draws_are_spread_as_their_law_says() -> None:
    laws: dict[str, dict[str, Any]] = {
        "even": {"uniform": [0.0, 2.0]},
        "bell": {"normal": [5.0, 2.0]},
        "one": {"choice": ["a", "b"], "weights": [3.0, 1.0]},
    }
    rows = [drawn(laws, seed) for seed in range(4000)]
    even, bell = (np.array([row[name] for row in rows]) for name in ("even", "bell"))
    assert (even.mean(), even.std()) == pytest.approx((1.0, 2.0 / math.sqrt(12.0)), abs=0.05)
    assert (bell.mean(), bell.std()) == pytest.approx((5.0, 2.0), abs=0.15)
    assert sum(row["one"] == "a" for row in rows) == pytest.approx(3000, abs=120)
    assert abs(correlation(even, bell)) < 0.05


@given(st.integers(0, 1 << 63), st.text(max_size=20))
def test_a_share_is_neither_nothing_nor_all(seed: int, name: str) -> None:
    assert 0.0 < share(seed, name) < 1.0


def test_one_parameter_more_changes_no_other() -> None:
    laws = {"a": {"uniform": [0.0, 1.0]}, "b": {"uniform": [0.0, 1.0]}}
    assert drawn(laws, 7)["b"] == drawn({"b": laws["b"]}, 7)["b"] != drawn(laws, 7)["a"]


# the file


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ('"plant.valve.dead_zone_v" = {uniform = [0.2, 0.0]}', "line 12: parameters.plant.valve.dead_zone_v"),
        ('"plant.valve.dead_zone_v" = {uniform = [0.0, 0.1], normal = [0.0, 1.0]}', "has uniform, normal"),
        ('"plant.valve.dead_zone_v" = {unifrom = [0.0, 0.1]}', "unknown key"),
        ('"plant.valve.dead_zonev" = [0.1]', "unknown key; is dead_zone_v meant?"),
        ('"plant.valve.dead_zone_v" = [7.0]', "line 12: parameters.plant.valve.dead_zone_v: virtual.toml"),
        ('"control.law" = {choice = ["pdi"]}', "line 12: parameters.control.law"),
        ('"control.law" = {uniform = [0.5, 2.0], times = true}', "control.law: there is no"),
        ('x = {within = [0.0, 1.0], uniform = [0.0, 1.0]}', "within belongs to normal"),
        ('x = {choice = [1.0], weights = [1.0, 2.0]}', "weights belong to choice"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_parameter_is_told_with_its_line(tmp_path: Path, line: str, says: str) -> None:
    text = "\n".join([*BRIEF.splitlines()[:-1], line, ""])
    with pytest.raises(ConfigError) as e:
        plan_of(*load_campaign(written(tmp_path, text)))
    assert says in str(e.value), str(e.value)
    assert str(e.value).startswith(str(tmp_path / "brief.toml"))
    assert "\n" not in str(e.value)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("runs = 6", "runs = 0", "line 3: runs = 0"),
        ("runs = 6", "rums = 6", "is runs meant?"),
        ('config = "virtual.toml"', 'config = "nowhere.toml"', "nowhere.toml: no such file"),
        ("by_mm = 2.0", "by_mm = 2.0\nto_mm = 3.0", "play: part 1: a move goes to_mm or by_mm"),
        ('do = "move"', 'do = "mvoe"', "play"),
        ("schema = 1", 'schema = 1\nscenarios = ["leak"]', 'by = "axis"'),
        (
            "schema = 1",
            'schema = 1\nmetrics = ["rmsm"]',
            "line 2: metrics: rmsm: no such figure; has move_rms_m",
        ),
        ("schema = 1", 'schema = 1\nworst = "rms"', "line 2: worst: no such figure"),
        ("schema = 1", "schema = 1 1", "not valid TOML"),
    ],
)
def test_what_is_wrong_with_a_file_is_one_line(tmp_path: Path, old: str, new: str, says: str) -> None:
    done = pneud_here("campaign", written(tmp_path, BRIEF.replace(old, new)), "-o", tmp_path / "out")
    assert (done.returncode, done.stdout) == (2, "")
    assert says in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("file", EXAMPLES, ids=lambda file: file.stem)
def test_an_example_is_a_campaign(file: Path) -> None:
    assert planned(file).total >= 16


# the numbers of runs


def test_runs_of_one_draw_have_one_seed_and_every_combination_is_there(tmp_path: Path) -> None:
    text = (
        BRIEF
        + '"control.k1" = [90000.0, 95000.0]\n"control.eta_m_s3" = {each = [0.5, 1.0, 2.0], times = true}\n'
    )
    plan = planned(written(tmp_path, text))
    assert (plan.combinations, plan.total) == (6, 36)
    labels = [plan.config_of(number)[1] for number in range(6)]
    assert len({tuple(label.items()) for label in labels}) == 6
    assert {plan.seed_of(number) for number in range(6)} == {plan.seed_of(0)} != {plan.seed_of(6)}
    assert plan.config_of(5)[0]["values"] == {"control.k1": 95000.0, "control.eta_m_s3": pytest.approx(0.6)}
    drawn = [drawn_of(plan, number) for number in (0, 5, 6)]
    assert drawn[0] == drawn[1] != drawn[2]
    assert plan.inputs == (
        *("control.k1", "control.eta_m_s3", "plant.cylinder.moving_mass_kg", "plant.valve.dead_zone_v"),
    )


def drawn_of(plan: Plan, number: int) -> dict[str, Any]:
    return drawn(plan.config_of(number)[0]["spread"], plan.seed_of(number))


def test_a_digest_is_that_of_all_but_the_number_of_runs(tmp_path: Path, brief: Plan) -> None:
    more = planned(written(tmp_path, BRIEF.replace("runs = 6", "runs = 60")))
    assert more.digest == brief.digest
    for old, new in (("0.2]", "0.3]"), ("by_mm = 2.0", "by_mm = 3.0"), ("runs = 6", "seed = 2")):
        assert planned(written(tmp_path, BRIEF.replace(old, new))).digest != brief.digest


# one run


def test_the_same_seed_makes_the_same_row_and_another_one_another(brief: Plan) -> None:
    rows = [brief.run(number) for number in (3, 4, 3)]
    assert rows[0] == rows[2] != rows[1]
    assert rows[0]["error"] == ""
    assert list(rows[0]) == list(brief.columns)
    assert 0.0 < cast(float, rows[0]["move_rms_m"]) < 1e-3
    assert cast(float, rows[0]["move_air_nl"]) > 0.0


def test_a_run_that_goes_wrong_is_a_row_that_says_so() -> None:
    base = unit.config("virtual.toml", play=[{"do": "move", "by_mm": 2.0, "seconds": 0.1}])
    far = unit.config("virtual.toml", play=[{"do": "move", "to_mm": 2000.0}])
    for config, says in (
        ({**base, "values": {"control.k1": -1.0}}, "control.k1"),
        ({**base, "values": {"control": 1.0, "control.k1": 1.0}}, "control is no table"),
        (far, "leads to 2000 mm; may be 21 … 979 mm"),
        ({**base, "dbc": b"nonsense"}, "pneud.dbc"),
    ):
        row = unit.run(config, 1)
        assert says in str(row["error"])
        assert "\n" not in str(row["error"])
        assert row["move_rms_m"] is None


def test_the_whole_axis_comes_to_about_the_same_as_law_and_plant_alone() -> None:
    play = (
        {"do": "move", "by_mm": 20.0, "seconds": 0.4},
        {"do": "push", "force_n": 40.0, "seconds": 0.3, "back_s": 0.3},
    )
    law, axis = (unit.run(unit.config("virtual.toml", play=play, how=how), 1) for how in ("law", "axis"))
    assert (law["error"], axis["error"], axis["state"], axis["faults"]) == ("", "", "holding", "")
    for column in ("move_rms_m", "move_max_m", "push_max_m", "push_rms_m"):
        assert cast(float, axis[column]) == pytest.approx(law[column], rel=0.5)
    assert cast(float, axis["move_air_nl"]) == pytest.approx(law["move_air_nl"], rel=0.2)
    assert cast(float, axis["move_in_position_s"]) < 1.0


def test_a_sine_and_a_rest_are_led_alike_by_both() -> None:
    play = ({"do": "sine", "seconds": 1.0, "learn_s": 0.5}, {"do": "rest", "seconds": 0.6, "settle_s": 0.3})
    law, axis = (unit.run(unit.config("virtual.toml", play=play, how=how), 1) for how in ("law", "axis"))
    assert (law["error"], axis["error"], axis["state"]) == ("", "", "holding")
    for column in ("sine_rms_m", "rest_max_m"):
        assert cast(float, axis[column]) == pytest.approx(law[column], rel=1.0, abs=1e-5)


def test_a_scenario_is_judged_and_its_faults_are_in_the_row() -> None:
    row = unit.run(unit.config("virtual.toml", scenario="encoder-missing"), 3)
    assert (row["error"], row["as_expected"], row["faults"]) == ("", 1, "encoder_missing")
    with pytest.raises(ConfigError, match="takes a real machine"):
        unit.config("virtual.toml", scenario="recorder-killed")


# what is kept


@given(st.lists(st.tuples(st.integers(0, 50), st.integers(1, 20)), max_size=12), st.integers(1, 60))
def test_what_is_missing_is_what_nobody_has_done(many: list[tuple[int, int]], total: int) -> None:
    done = [(begin, begin + length) for begin, length in many]
    has = {number for begin, end in done for number in range(begin, end)}
    lacks = [number for begin, end in missing(done, total) for number in range(begin, end)]
    assert lacks == [number for number in range(total) if number not in has]


def chunk(begin: int, end: int) -> Chunk:
    return Chunk(begin, end, [[number, 0.1 * number, ""] for number in range(begin, end)], 0.5, fingerprint())


COLUMNS: dict[str, type] = {"run": int, "x": float, "error": str}


@settings(max_examples=15)
@given(st.data())
def test_a_record_cut_off_anywhere_has_all_whole_chunks_and_takes_more(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("record")
    record = Record(folder, "digest", [*COLUMNS])
    ends = [record.path.stat().st_size]
    for begin in (0, 3, 6):
        record.add(chunk(begin, begin + 3))
        ends.append(record.path.stat().st_size)
    record.close()
    cut = data.draw(st.integers(0, ends[-1]))
    os.truncate(record.path, cut)
    again = Record(folder, "digest", [*COLUMNS])
    whole = sum(end <= cut for end in ends[1:])
    assert [c.begin for c in again.chunks()] == [0, 3, 6][:whole]
    for begin, end in missing([(c.begin, c.end) for c in again.chunks()], 9):
        again.add(chunk(begin, end))
    assert [row["run"] for row in rows_of(again, COLUMNS, 9)] == list(range(9))
    again.close()


def test_what_is_no_record_stays_as_it_is(tmp_path: Path) -> None:
    (tmp_path / NAME).write_text("somebody's notes\n")
    with pytest.raises(RecordError, match="is no record of a campaign"):
        Record(tmp_path, "digest", [*COLUMNS])
    assert (tmp_path / NAME).read_text() == "somebody's notes\n"


def test_a_disk_that_takes_no_more_is_named(tmp_path: Path) -> None:
    record = Record(tmp_path, "digest", [*COLUMNS])
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (record.path.stat().st_size + 50, limit[1]))
    try:
        with pytest.raises(OSError, match=NAME) as e:
            record.add(chunk(0, 9))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert e.value.errno == errno.EFBIG
    record.close()
    again = Record(tmp_path, "digest", [*COLUMNS])
    assert list(again.chunks()) == []
    again.close()


def test_a_line_that_was_altered_is_done_again(tmp_path: Path) -> None:
    record = Record(tmp_path, "digest", [*COLUMNS])
    record.add(chunk(0, 2))
    record.add(chunk(2, 4))
    record.close()
    text = record.path.read_bytes()
    record.path.write_bytes(text.replace(b"[1,0.1,", b"[1,0.2,"))
    again = Record(tmp_path, "digest", [*COLUMNS])
    assert [c.begin for c in again.chunks()] == [2]
    with pytest.raises(RecordError, match="2 runs are missing"):
        rows_of(again, COLUMNS, 4)
    again.close()


def test_a_folder_takes_one_campaign_and_one_at_work_in_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = Record(tmp_path, "digest", [*COLUMNS])
    with pytest.raises(RecordError, match="somebody is at work in it"):
        Record(tmp_path, "digest", [*COLUMNS])
    record.close()
    with pytest.raises(RecordError, match="holds another campaign"):
        Record(tmp_path, "another", [*COLUMNS])
    monkeypatch.setattr(record_module, "__version__", "9.9")
    with pytest.raises(RecordError, match=f"was begun by pneud {__version__}"):
        Record(tmp_path, "digest", [*COLUMNS])


# who does it


class Fallible:
    """Workers in whose place a dice stands: they do their chunk, or die of it with all others."""

    def __init__(self, dies: Callable[[Span], bool]) -> None:
        self.dies, self.renewed, self.lose = dies, 0, False
        self.waiting: list[tuple[Span, Future[Chunk]]] = []

    def submit(self, span: Span) -> Future[Chunk]:
        future: Future[Chunk] = Future()
        self.waiting.append((span, future))
        if len(self.waiting) >= 2 or span[1] - span[0] == 1:
            self.turn()
        return future

    def turn(self) -> None:
        waiting, self.waiting = self.waiting, []
        dead = False
        for span, future in waiting:
            dead = dead or self.dies(span)
            if dead:
                future.set_exception(BrokenProcessPool("died"))
            else:
                future.set_result(chunk(*span))

    def width(self) -> int:
        self.turn()  # nobody waits for ever
        return 2

    def lost(self, error: BaseException) -> bool:
        return isinstance(error, BrokenProcessPool)

    def there(self) -> bool:
        return not self.lose

    def renew(self, report: Callable[[str], None]) -> None:
        self.renewed += 1
        self.lose = False
        self.turn()

    def close(self) -> None:
        pass


class Deaf(Fallible):
    """Workers who lose what they are at, now and then, and say so only when they are asked."""

    def submit(self, span: Span) -> Future[Chunk]:
        if self.dies(span):
            self.lose = True
            return Future()
        return super().submit(span)


def a_plan(total: int) -> Any:
    return SimpleNamespace(
        total=total,
        kept=tuple(COLUMNS),
        config_of=lambda _: ({"spread": {}}, {}),
        seed_of=lambda number: number,
    )


@settings(max_examples=12)
@given(st.integers(0, 1 << 30), st.integers(1, 80), st.sampled_from((Fallible, Deaf)))
def test_whoever_dies_nothing_is_done_twice_and_nothing_is_missing(
    tmp_path_factory: pytest.TempPathFactory, seed: int, total: int, kind: type[Fallible]
) -> None:
    folder = tmp_path_factory.mktemp("runs")
    chance = random.Random(seed)
    workers = kind(lambda _: chance.random() < 0.1)
    record = Record(folder, "digest", [*COLUMNS])
    found = Conductor(a_plan(total), record, workers, silent, lambda _: None).go()
    done = [number for c in record.chunks() for number in range(c.begin, c.end)]
    assert sorted(done) == list(range(total))
    assert found.runs == total
    record.close()


def test_a_run_that_kills_its_process_is_found_and_given_up_and_all_others_are_done(tmp_path: Path) -> None:
    workers = Fallible(lambda span: span[0] <= 17 < span[1])
    record = Record(tmp_path, "digest", [*COLUMNS])
    said: list[str] = []
    Conductor(a_plan(64), record, workers, silent, said.append).go()
    rows = rows_of(record, COLUMNS, 64)
    record.close()
    assert [row["run"] for row in rows if row["error"] == KILLED] == [17]
    assert [row["run"] for row in rows] == list(range(64))
    assert any("run 17 is given up" in line for line in said)


def test_a_worker_with_another_pneud_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conduct, "__version__", "9.9")
    record = Record(tmp_path, "digest", [*COLUMNS])
    with pytest.raises(ClusterError, match="they must be alike"):
        Conductor(a_plan(4), record, Fallible(lambda _: False), silent, lambda _: None).go()
    record.close()


# what is shown


@given(st.lists(numbers, min_size=1, max_size=30))
def test_ranks_are_in_the_order_of_the_numbers_and_shared_by_equal_ones(values: list[float]) -> None:
    found = ranks(np.array(values))
    assert found.sum() == pytest.approx(0.5 * len(values) * (len(values) - 1))
    for a, one in zip(values, found, strict=True):
        for b, other in zip(values, found, strict=True):
            assert (a < b) == (one < other)


def test_a_correlation_of_ranks_knows_neither_units_nor_curves() -> None:
    x = np.linspace(0.1, 3.0, 40)
    assert correlation(x, np.exp(x)) == pytest.approx(1.0)
    assert correlation(x, -(x**3)) == pytest.approx(-1.0)
    assert math.isnan(correlation(x, np.ones(40)))
    assert math.isnan(correlation(x[:5], x[:5]))
    assert spread(np.array([math.nan])) is None


def test_a_time_that_never_comes_is_the_longest_and_one_of_a_run_that_failed_is_none() -> None:
    rows = Rows({"run": int, "x": float, "move_settled_s": float, "error": str}, 12)
    for number in range(12):
        time_s = None if number in (3, 7) else 0.1 * number
        rows.put(number, [number, float(number in (3, 7)), time_s, "failed" if number == 7 else ""])
    assert rows.greatest("move_settled_s", 3) == [3, 11, 10]
    found = spread(rows.ordered("move_settled_s"))
    assert found is not None
    assert (found.most, found.none) == (math.inf, 2)
    (rank,) = strongest(rows, ["move_settled_s"], ["x"])
    assert rank.correlation > 0.4
    assert rank.runs == 11
    assert page.in_words(found.most) == "never"


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("ran")
    file = written(folder)
    done = pneud_here("campaign", file, "--jobs", 1, "-o", folder / "out", "--json")
    assert done.returncode == 0, done.stderr
    return file, folder / "out", object_of(done)


def test_a_campaign_is_a_table_a_page_and_a_summary(ran: tuple[Path, Path, dict[str, Any]]) -> None:
    file, folder, found = ran
    assert (found["runs"], found["failed"], found["done_now"]) == (6, 0, 6)
    table = pq.read_table(folder / "rows.parquet")
    assert table["run"].to_pylist() == list(range(6))
    assert found["figures"]["move_rms_m"]["max"] == max(table["move_rms_m"].to_pylist())
    text = (folder / "index.html").read_text()
    assert f"pneud campaign {file} --run {found['worst'][0]['run']}" in text
    assert "all 6 runs were done" in text


def test_a_run_alone_is_its_row(ran: tuple[Path, Path, dict[str, Any]]) -> None:
    file, folder, _ = ran
    row = object_of(pneud_here("campaign", file, "--run", 4, "--json"))
    del row["schema"]
    assert row == pq.read_table(folder / "rows.parquet").to_pylist()[4]


def test_more_runs_leave_those_that_are_there(ran: tuple[Path, Path, dict[str, Any]], tmp_path: Path) -> None:
    file, folder, _ = ran
    before = pq.read_table(folder / "rows.parquet").to_pylist()
    record = (folder / NAME).read_bytes()
    (tmp_path / NAME).write_bytes(record)
    found = object_of(pneud_here("campaign", file, "-o", tmp_path, "--runs", 8, "--jobs", 1, "--json"))
    assert (found["runs"], found["done_now"]) == (8, 2)
    assert pq.read_table(tmp_path / "rows.parquet").to_pylist()[:6] == before


def test_without_pyarrow_rows_are_csv_and_that_is_said(
    ran: tuple[Path, Path, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, folder, _ = ran
    monkeypatch.setattr(tables, "parquet", lambda: False)
    (tmp_path / NAME).write_bytes((folder / NAME).read_bytes())
    done = pneud_here("campaign", file, "-o", tmp_path, "--jobs", 1)
    assert done.returncode == 0
    assert "pip install 'pneud[parquet]'" in done.stderr
    assert len((tmp_path / "rows.csv").read_text().splitlines()) == 7


def test_runs_that_fail_are_rows_commands_and_status_1(tmp_path: Path) -> None:
    text = BRIEF.replace("{uniform = [0.0, 0.2]}", "{choice = [0.1, 9.0]}")
    file = written(tmp_path, text.replace("runs = 6", "runs = 4\nseed = 2"))
    plan = planned(file)
    failed = [number for number in range(4) if plan.run(number)["error"]]
    assert 0 < len(failed) < 4
    done = pneud_here("campaign", file, "-o", tmp_path / "out", "--jobs", 1)
    assert done.returncode == 1
    assert f"pneud campaign {file} --run {failed[0]}" in done.stdout
    told = json.loads(pneud_here("campaign", file, "-o", tmp_path / "out", "--jobs", 1, "--json").stdout)
    assert [one["run"] for one in told["failures"]] == failed
    assert told["failures"][0]["command"] == f"pneud campaign {file} --run {failed[0]}"
    assert told["done_now"] == 0
    assert f"{len(failed)} of 4 runs failed" in (tmp_path / "out" / page.NAME).read_text()
    rows = pq.read_table(tmp_path / "out" / "rows.parquet").to_pylist()
    assert [row["run"] for row in rows if row["error"]] == failed
    assert all(row["seed"] == plan.seed_of(row["run"]) for row in rows)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--run", 6), "there are runs 0 … 5"),
        (("--run", 1, "--jobs", 2), "done here and alone"),
        (("--jobs", -1), "must not be negative"),
        (("--runs", 0), "must be at least 1"),
        (("--scheduler", "tcp://127.0.0.1:9", "--jobs", 2), "leave it out beside --scheduler"),
    ],
)
def test_options_that_make_no_sense_are_refused(tmp_path: Path, words: tuple[object, ...], says: str) -> None:
    done = pneud_here("campaign", written(tmp_path), *words)
    assert (done.returncode, done.stdout) == (2, "")
    assert says in done.stderr


# processes


@pytest.mark.slow
def test_two_processes_make_the_same_file_as_one_though_one_is_killed(tmp_path: Path) -> None:
    file = written(tmp_path, BRIEF.replace("runs = 6", "runs = 400"))
    one, two = tmp_path / "one", tmp_path / "two"
    assert pneud("campaign", file, "--jobs", 1, "-o", one).returncode == 0
    command = [sys.executable, "-m", "pneud.cli", "campaign", str(file), "--jobs", "2", "-o", str(two)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    eventually(lambda: (two / NAME).exists() and (two / NAME).read_bytes().count(b"\n") > 3)
    os.kill(children(process.pid)[0], signal.SIGKILL)
    said = process.communicate(timeout=120)
    assert process.returncode == 0, said
    assert (two / "rows.parquet").read_bytes() == (one / "rows.parquet").read_bytes()


@pytest.mark.slow
def test_workers_leave_when_who_began_them_is_killed_and_the_same_command_goes_on(tmp_path: Path) -> None:
    file = written(tmp_path, BRIEF.replace("runs = 6", "runs = 300"))
    folder = tmp_path / "out"
    command = [sys.executable, "-m", "pneud.cli", "campaign", str(file), "--jobs", "2", "-o", str(folder)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    eventually(lambda: (folder / NAME).exists() and (folder / NAME).read_bytes().count(b"\n") > 3)
    workers = children(process.pid)
    process.kill()
    process.wait()
    eventually(lambda: not any(Path(f"/proc/{pid}").exists() for pid in workers))
    found = object_of(pneud("campaign", file, "--jobs", 2, "-o", folder, "--json"))
    assert 0 < found["done_now"] < 300 == found["runs"]


@pytest.mark.slow
def test_the_worst_runs_have_a_report_each_to_which_the_page_leads(tmp_path: Path) -> None:
    file, folder = written(tmp_path), tmp_path / "out"
    found = object_of(pneud_here("campaign", file, "--jobs", 1, "-o", folder, "--reports", 2, "--json"))
    for one in found["worst"][:2]:
        assert read_log(folder / f"run-{one['run']}.mcap").metadata["campaign_run"] == str(one["run"])
        assert (folder / f"run-{one['run']}.html").stat().st_size > 10_000
        assert f'<a href="run-{one["run"]}.html">' in (folder / page.NAME).read_text()


@pytest.mark.slow
def test_ctrl_c_says_how_to_go_on_and_leaves_nobody_behind(tmp_path: Path) -> None:
    file, folder = written(tmp_path, BRIEF.replace("runs = 6", "runs = 4000")), tmp_path / "out"
    command = [sys.executable, "-m", "pneud.cli", "campaign", str(file), "--jobs", "2", "-o", str(folder)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    eventually(lambda: (folder / NAME).exists() and (folder / NAME).read_bytes().count(b"\n") > 3)
    workers = children(process.pid)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (130, "")
    assert err == f"pneud: what is done is kept in {folder}; the same command goes on from there\n"
    eventually(lambda: not any(Path(f"/proc/{pid}").exists() for pid in workers))


def test_a_scheduler_that_nobody_is_at_is_one_line(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    done = pneud_here("campaign", written(tmp_path), "--scheduler", "nonsense://x", "-o", tmp_path / "out")
    assert (done.returncode, done.stdout) == (3, "")
    assert "--scheduler nonsense://x: nobody answers there" in done.stderr


@pytest.mark.parametrize(
    ("runs", "kills"),
    [
        pytest.param(200, 4, id="few", marks=pytest.mark.slow),
        pytest.param(10_000, 20, id="all", marks=[pytest.mark.soak, pytest.mark.realtime]),  # efficiency
    ],
)
def test_all_ways_come_to_the_same_rows_whoever_is_killed(runs: int, kills: int, figures: Figures) -> None:
    pytest.importorskip("distributed")
    words = ["-m", "hil.many_runs", "--runs", str(runs), "--kills", str(kills)]
    if kills < 20:
        words += ["--every", "0.5"]
    done = subprocess.run(
        [sys.executable, *words], cwd=ROOT, capture_output=True, text=True, timeout=7200, check=False
    )
    lines = [line for line in done.stdout.splitlines() if kills == 20 or "efficiency" not in line]
    assert lines, done.stderr
    assert "not held" not in "\n".join(lines), done.stdout + done.stderr
    figures("; ".join(lines))


def test_the_record_is_json_that_anybody_reads(ran: tuple[Path, Path, dict[str, Any]]) -> None:
    _, folder, _ = ran
    lines = (folder / NAME).read_bytes().splitlines()
    head, *chunks = (json.loads(line.partition(b" ")[2]) for line in lines)
    assert head["columns"][0] == "run"
    assert sum(c["end"] - c["begin"] for c in chunks) == 6
