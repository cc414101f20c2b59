"""A wheel carries everything pneud needs and works from any folder; nothing here asks a package index."""

from __future__ import annotations

import importlib.metadata
import shutil
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Sequence
from pathlib import Path

import pytest

import pneud

ROOT = Path(__file__).parent.parent
DATA = {"configs": "configs", "hil/scenarios": "scenarios", "systemd": "systemd"}


def run(command: Sequence[str | Path], cwd: Path) -> str:
    """Standard output of a command that must succeed."""
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
    return done.stdout


def build(kind: str, source: Path, into: Path) -> Path:
    run([sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", into], source)
    (made,) = into.iterdir()
    return made


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build("wheel", ROOT, tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bin folder of an environment with the wheel in it and this one's packages behind it."""
    environment = tmp_path_factory.mktemp("installed")
    run([sys.executable, "-m", "venv", "--without-pip", environment], environment)
    python = environment / "bin" / "python"
    run(
        [
            *(sys.executable, "-m", "pip", "--python", python),
            *("install", "--quiet", "--no-deps", "--no-index", "--disable-pip-version-check", wheel),
        ],
        environment,
    )
    purelib = "import sysconfig; print(sysconfig.get_path('purelib'))"
    site = Path(run([python, "-c", purelib], environment).strip())
    here = run([sys.executable, "-c", purelib], environment).strip()
    # Python reads no .pth files of a folder that a .pth file names, so this checkout stays out.
    (site / "dependencies.pth").write_text(f"{here}\n")
    return environment / "bin"


def own_files() -> set[str]:
    """The files a wheel must hold, by their names in it."""
    package = {p.relative_to(ROOT / "src") for p in (ROOT / "src" / "pneud").rglob("*")}
    data = {
        Path("pneud/_data") / packaged / p.relative_to(ROOT / checkout)
        for checkout, packaged in DATA.items()
        for p in (ROOT / checkout).rglob("*")
    }
    package = {p for p in package if p.suffix in {".py", ".typed"}}
    return {str(p) for p in package | {p for p in data if p.suffix and p.name != ".gitkeep"}}


@pytest.mark.slow
def test_wheel_holds_every_module_configuration_database_and_scenario(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    assert not own_files() - names
    assert {"pneud/_data/configs/virtual.toml", "pneud/_data/configs/pneud.dbc", "pneud/py.typed"} <= names
    assert any(name.endswith("/licenses/LICENSE") for name in names)


@pytest.mark.slow
def test_wheel_of_the_source_archive_is_the_wheel_of_the_checkout(wheel: Path, tmp_path: Path) -> None:
    archive = build("sdist", ROOT, tmp_path / "sdist")
    shutil.unpack_archive(archive, tmp_path)
    second = build("wheel", tmp_path / archive.name.removesuffix(".tar.gz"), tmp_path / "wheel")
    assert set(zipfile.ZipFile(second).namelist()) == set(zipfile.ZipFile(wheel).namelist())


@pytest.mark.slow
def test_installed_wheel_finds_and_loads_its_own_files_from_any_folder(
    installed: Path, tmp_path: Path
) -> None:
    program = """
import pneud
from pneud import resources
from pneud.config.models import load_config
for name in ("virtual.toml", load_config("virtual.toml").bus.dbc):
    print(resources.find(name))
print(resources.scenarios())
print(pneud.__file__)
"""
    lines = run([installed / "python", "-c", program], tmp_path).splitlines()
    assert len(lines) == 4
    assert all(Path(line).is_relative_to(installed.parent) for line in lines)
    assert all(Path(line).exists() for line in lines)


@pytest.mark.slow
def test_installed_entry_points_load(installed: Path, tmp_path: Path) -> None:
    program = """
from importlib.metadata import distribution
for point in distribution("pneud").entry_points:
    point.load()
    print(point.group, point.name)
"""
    lines = run([installed / "python", "-c", program], tmp_path).splitlines()
    assert set(lines) == {"console_scripts pneud", "can.interface unixcan"}


@pytest.mark.slow
def test_installed_command_starts(installed: Path, tmp_path: Path) -> None:
    assert "--virtual" in run([installed / "pneud", "--help"], tmp_path)


def test_this_environment_holds_the_checkout() -> None:
    """Tests that pass against some other installation of pneud would say nothing about this tree."""
    assert Path(pneud.__file__).is_relative_to(ROOT / "src")
    distribution = importlib.metadata.distribution("pneud")
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    points = {point.name: point.value for point in distribution.entry_points}
    assert points == declared["scripts"] | declared["entry-points"]["can.interface"]
    assert distribution.version == pneud.__version__
