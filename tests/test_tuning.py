"""Values sought over the runs of a campaign: the same trials however they came about, and their front."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from commands import object_of, pneud_here
from pneud.campaign import tune_page, tuning
from pneud.campaign.file import load_campaign
from pneud.campaign.plan import plan_of
from pneud.campaign.tuning import NEVER, Trial, Tuning, front, statistic
from pneud.config.reading import load_config, with_settings
from pneud.view.progress import silent

ROOT = Path(__file__).parent.parent
BRIEF = """\
schema = 1
config = "virtual.toml"
runs = 3

[[play]]
do = "move"
by_mm = 2.0
seconds = 0.2

[parameters]
"plant.cylinder.moving_mass_kg" = {loguniform = [0.7, 1.4], times = true}

[tune.objectives]
move_rms_m = "p90"
move_chatter_v = "mean"

[tune.parameters]
"control.k1" = {loguniform = [0.5, 2.0], times = true}
"control.eta_m_s3" = {uniform = [0.1, 0.6]}
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "brief.toml"
    path.write_text(BRIEF)
    return path


def tuned(file: Path, folder: Path, total: int, jobs: int = 1) -> list[Trial]:
    c, text, path = load_campaign(file)
    with closing(Tuning(c, plan_of(c, text, path), folder)) as found:
        return found.go(total, jobs, silent, print)


def test_trials_do_not_hang_on_processes_or_interruptions(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tuning, "FIRST", 3)  # so that what was found is asked for its advice
    whole = tuned(file, tmp_path / "whole", 6)
    assert [t.number for t in whole] == [*range(6)]
    assert len({repr(t.values) for t in whole}) == 6
    assert tuned(file, tmp_path / "by-two", 6, jobs=2) == whole

    real, left = tuning._Tryouts.rows_of, [4]

    def killed(*args: Any) -> Any:
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt
        return real(*args)

    monkeypatch.setattr(tuning._Tryouts, "rows_of", killed)
    with pytest.raises(KeyboardInterrupt):
        tuned(file, tmp_path / "parts", 6)
    assert tuned(file, tmp_path / "parts", 5) == whole[:5]
    assert tuned(file, tmp_path / "parts", 6) == whole
    assert tuned(file, tmp_path / "parts", 4) == whole  # there are more


def test_a_kill_at_any_byte_of_the_journal_is_no_hindrance(file: Path, tmp_path: Path) -> None:
    whole = tuned(file, tmp_path / "whole", 3)
    text = (tmp_path / "whole" / "tune.journal").read_bytes()
    for cut in (len(text) - 1, len(text) - 40, len(text) * 2 // 3, len(text) // 3, 10):
        folder = tmp_path / str(cut)
        folder.mkdir()
        (folder / "tune.journal").write_bytes(text[:cut])
        (folder / "tune.journal.lock").symlink_to("tune.journal")  # as who is killed with it leaves it
        assert tuned(file, folder, 3) == whole, cut


def test_what_is_configured_is_tried_first(file: Path, tmp_path: Path) -> None:
    (first,) = tuned(file, tmp_path / "t", 1)
    assert first.configured and first.whole
    assert first.values == {
        "control.k1": 1.0,
        "control.eta_m_s3": load_config("virtual.toml").control.eta_m_s3,
    }
    file.write_text(BRIEF.replace("[0.5, 2.0]", "[1.5, 2.0]"))
    (first,) = tuned(file, tmp_path / "beyond", 1)
    assert not first.configured


def test_the_command_writes_a_table_and_a_page_whose_values_a_configuration_takes(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    told = object_of(pneud_here("campaign", file, "--tune", 4, "--json"))
    assert (told["trials"], told["runs"]) == (4, 3)
    table = pl.read_parquet(told["rows"])
    assert table["trial"].to_list() == [0, 1, 2, 3]
    assert {one["trial"] for one in told["front"]} == set(table.filter(pl.col("front") == 1)["trial"])
    text = Path(told["page"]).read_text()
    assert "configured" in text and "<circle" in text
    own = tmp_path / "own.toml"
    own.write_text((ROOT / "configs" / "virtual.toml").read_text())
    values = told["front"][0]["values"]
    assert set(values) == {"control.k1", "control.eta_m_s3"}
    found = with_settings(own.read_text(), "own.toml", [f"{key}={value!r}" for key, value in values.items()])
    assert found.control.eta_m_s3 == values["control.eta_m_s3"]
    words = pneud_here("campaign", file, "--tune", 4).stdout.splitlines()
    assert "4 trials of 3 runs" in words[0]
    assert any("configured" in line or "trial" in line for line in words)


def test_values_with_which_a_run_fails_are_on_no_front(file: Path, tmp_path: Path) -> None:
    file.write_text(
        BRIEF.replace(
            '"control.eta_m_s3" = {uniform = [0.1, 0.6]}', '"control.alpha" = {choice = [0.9, 7.0]}'
        )
    )
    found = tuned(file, tmp_path / "t", 5)
    assert {t.whole for t in found} == {True, False}
    assert all(t.whole == (t.values["control.alpha"] == 0.9) for t in found)
    assert all(t.whole for t in front(found))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("[tune", "[other"), "other"),
        (("move_rms_m =", "move_far_m ="), "move_far_m: no such figure"),
        (('"p90"', '"p200"'), "tune.objectives"),
        (("{uniform = [0.1, 0.6]}", "{normal = [0.1, 0.6]}"), "is sought in uniform"),
        (('"control.k1"', '"control.k7"'), "control.k7"),
        (('"control.eta_m_s3"', '"control.eta"'), "tune.parameters: virtual.toml: control.eta"),
    ],
)
def test_what_cannot_be_tuned_is_refused(
    file: Path, tmp_path: Path, change: tuple[str, str], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    file.write_text(BRIEF.replace(*change))
    done = pneud_here("campaign", file, "--tune", 2)
    assert (done.returncode, done.stdout) == (2, "")
    assert words in done.stderr


def test_options_and_what_is_missing(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    plain = tmp_path / "plain.toml"
    plain.write_text(BRIEF.partition("[tune")[0])
    for words in (
        ("campaign", plain, "--tune", 2),
        ("campaign", file, "--tune", 0),
        ("campaign", file, "--tune", 2, "--run", 1),
    ):
        assert pneud_here(*words).returncode == 2
    tuned(file, tmp_path / "brief" / "tune", 1)
    file.write_text(BRIEF.replace("runs = 3", "runs = 2"))
    done = pneud_here("campaign", file, "--tune", 2)
    assert (done.returncode, "holds another tuning" in done.stderr) == (2, True)


@settings(max_examples=50)
@given(st.lists(st.tuples(*[st.integers(0, 4).map(float)] * 3), min_size=1, max_size=12))
def test_a_front_is_what_nothing_beats_and_what_beats_all_else(points: list[tuple[float, ...]]) -> None:
    trials = [Trial(i, {}, point) for i, point in enumerate(points)]
    best = front(trials)
    assert best
    assert not any(one.beats(other) for one in trials for other in best)
    for one in trials:
        assert any(other.figures == one.figures or other.beats(one) for other in best)
    assert front([Trial(0, {}, (NEVER, 0.0))]) == []


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=30))
def test_statistics_lie_among_the_values(values: list[float]) -> None:
    found = [statistic(values, which) for which in ("p1", "p50", "p90", "max")]
    assert found == sorted(found)
    assert found[-1] == max(values)
    assert min(values) - 1e-9 <= statistic(values, "mean") <= max(values) + 1e-9


def test_a_mean_with_a_figure_that_a_run_lacks_is_none() -> None:
    assert statistic([1.0, NEVER], "mean") == statistic([1.0, NEVER], "max") == NEVER
    assert statistic([1.0, NEVER], "p50") == 1.0
    trials = [Trial(0, {"k": 1.0}, (1.0, NEVER), True), Trial(1, {"k": 2.0}, (2.0, 3.0))]
    one, other = tune_page.Tuned("x", Path(), {"a_m": "max", "b_s": "max"}, trials, 1, {}).rows
    assert (one["a_m max"], one["b_s max"], one["front"]) == (1.0, None, 0)
    assert (other["a_m max"], other["b_s max"], other["front"]) == (2.0, 3.0, 1)
    assert [tune_page.shown("b_s", x) for x in (NEVER, 3.0)] == ["–", "3"]
    assert [t.number for t in tune_page.told(trials)] == [0, 1]


def test_values_as_toml() -> None:
    assert tune_page.toml({"control.k1": 2.0, "plant.valve.x": 1, "control.k2": 3.0}).split("\n") == [
        "[control]", "k1 = 2.0", "k2 = 3.0", "[plant.valve]", "x = 1",
    ]  # fmt: skip
