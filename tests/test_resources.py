"""Where the files that come with pneud are found."""

from __future__ import annotations

from pathlib import Path

import pytest

from pneud import resources
from pneud.config.sections import ConfigError
from pneud.loading import load

ROOT = Path(__file__).parent.parent


def test_a_checkout_uses_its_own_files() -> None:
    assert resources.configs() == ROOT / "configs"
    assert resources.scenarios() == ROOT / "hil" / "scenarios"
    assert resources.find("virtual.toml") == ROOT / "configs" / "virtual.toml"


@pytest.mark.parametrize("path", sorted((ROOT / "configs").glob("*.toml")), ids=lambda path: path.name)
def test_every_configuration_loads_by_its_bare_name(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert load(path.name).dbc.is_file()


def test_the_working_directory_wins_over_what_comes_with_pneud(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "virtual.toml").write_text("")
    assert resources.find("virtual.toml").resolve() == tmp_path / "virtual.toml"


def test_a_file_beside_the_one_that_names_it_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    beside = tmp_path / "axis"
    beside.mkdir()
    (beside / "pneud.dbc").write_text("")
    assert resources.find("pneud.dbc", beside=beside) == beside / "pneud.dbc"
    assert resources.find("virtual.toml", beside=beside) == ROOT / "configs" / "virtual.toml"


def test_an_absolute_path_and_a_home_directory_are_taken_as_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "mine.toml").write_text("")
    assert resources.find("~/mine.toml") == tmp_path / "mine.toml"
    assert resources.find(tmp_path / "mine.toml") == tmp_path / "mine.toml"


def test_a_path_is_not_looked_for_among_what_comes_with_pneud(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError):
        resources.find("elsewhere/virtual.toml")


def test_a_folder_is_not_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "virtual.toml").mkdir()
    assert resources.find("virtual.toml") == ROOT / "configs" / "virtual.toml"


def test_a_missing_file_is_named_in_one_line_with_the_places_searched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError) as error:
        load("nowhere.toml")
    text = str(error.value)
    assert "nowhere.toml" in text and str(ROOT / "configs") in text
    assert "\n" not in text
