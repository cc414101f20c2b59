"""What the command line accepts, refuses and says."""

from __future__ import annotations

import ast
import importlib
import json
import re
from pathlib import Path

import pytest

from commands import object_of, pneud, pneud_here
from console_bench import served
from log_samples import noisy
from pneud import cli, resources
from pneud.cli import GROUPS, ORDER, verbs
from pneud.log.files.reader import read_log
from pneud.verbs import NEGATIVE_NUMBERS, check

GOLDEN = Path(__file__).with_name("golden") / "composite.mcap"


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["--virtual", "--bus", "can0"], "none of auto, socketcan:IF, unixcan:NAME"),
        (["--virtual", "--duration", "-1"], "--duration"),
        (["--virtual", "--rate", "1"], "--rate 1"),
        (["--virtual", "--config", "nowhere.toml"], "nowhere.toml: no such file"),
        (["--virtual", "check", "virtual.toml"], "--virtual belongs to the daemon"),
        (["--config", "virtual.toml"], "bus auto is for virtual runs"),
        (["plant", "--bus", "auto"], "name one"),
        (["sim", "virtual.toml", "--duration", "0"], "--duration 0"),
        (["replay", "nowhere.mcap"], "nowhere.mcap"),
    ],
)
def test_usage_error_is_one_line_exit_2_and_empty_stdout(args: list[str], says: str) -> None:
    done = pneud_here(*args)
    assert done.returncode == 2
    assert done.stdout == ""
    assert says in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert "Traceback" not in done.stderr


def test_unknown_option_is_a_usage_error() -> None:
    done = pneud_here("--nonsense")
    assert done.returncode == 2
    assert done.stdout == ""
    assert "--nonsense" in done.stderr


def test_missing_interface_is_exit_3_with_one_line() -> None:
    done = pneud("--config", "rig.toml", "--bus", "socketcan:nope0")
    assert done.returncode == 3
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1


def test_log_is_never_overwritten(tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    log.write_bytes(b"precious")
    done = pneud_here("sim", "virtual.toml", "-o", log, "--duration", "0.1")
    assert done.returncode == 2
    assert "never overwritten" in done.stderr
    assert log.read_bytes() == b"precious"


def test_verbs_come_in_their_order_and_others_behind_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert list(verbs())[: len(ORDER)] == list(ORDER)
    for name in ("sim.py", "a_verb.py", "_shared.py", "plant.py", "run.py", "print_.py"):
        (tmp_path / name).write_text("")
    monkeypatch.setattr(cli, "FOLDER", tmp_path)
    assert list(verbs()) == ["plant", "sim", "a-verb", "print"]


def test_help_has_each_verb_in_its_group() -> None:
    listed = pneud_here("--help").stdout
    places = [listed.index(f"\n{title}:\n") for title in GROUPS]
    assert places == sorted(places)
    for group, begin, end in zip(GROUPS.values(), places, [*places[1:], None], strict=True):
        assert re.findall(r"^  ([a-z-]+) ", listed[begin:end], re.MULTILINE) == list(group)
    assert "Others:" not in listed, "every verb has a place"


@pytest.mark.parametrize(
    ("args", "status", "kind", "says"),
    [
        (["check", "nowhere.toml"], 2, "usage", "nowhere.toml: no such file"),
        (["check"], 2, "usage", "FILE"),
        (["chek"], 2, "usage", "Did you mean 'check'?"),
        (["--nonsense"], 2, "usage", "--nonsense"),
        (["--virtual", "--duration", "-1"], 2, "usage", "--duration -1"),
        (["replay", "nowhere.mcap", "--set"], 2, "usage", "--set"),
        (["status", "--socket", "/nowhere/at/all"], 3, "machine", "/nowhere/at/all"),
    ],
)
def test_an_error_is_an_object_for_whoever_asked_for_one(
    args: list[str], status: int, kind: str, says: str
) -> None:
    done = pneud_here(args[0], "--json", *args[1:])
    assert (done.returncode, done.stdout) == (status, "")
    (line,) = done.stderr.splitlines()
    found = json.loads(line)
    assert (found["schema"], found["ok"], found["error"]["type"]) == (1, False, kind)
    assert says in found["error"]["message"]


@pytest.mark.parametrize(
    ("words", "suffix"),
    [
        ("report LOG -o x.pdf", ".html"),
        ("identify LOG -o x.pdf", ".html"),
        ("bench -o x.txt", ".html"),
        ("recover LOG -o x.log", ".mcap"),
        ("sim -o x.log", ".mcap"),
        ("import x.log -o x.csv", ".mcap"),
        ("export LOG -o x.xlsx", ".csv, .parquet, .log, .asc, .blf"),
        ("replay LOG -o x.html", ".png, .svg or .pdf"),
    ],
)
def test_an_output_with_the_suffix_of_another_format_is_refused(words: str, suffix: str) -> None:
    done = pneud_here(*words.replace("LOG", str(GOLDEN)).split())
    assert (done.returncode, done.stdout) == (2, "")
    assert re.search(r"x\.(pdf|txt|log|csv|xlsx|html)", done.stderr)
    assert done.stderr.rstrip().endswith(suffix) or suffix in done.stderr


def test_outputs_have_names_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for verb in ("report", "export", "recover"):
        assert pneud_here(verb, GOLDEN).returncode == 0
    assert {p.name for p in tmp_path.iterdir()} == {
        "composite.html",
        "composite.csv",
        "composite-recovered.mcap",
    }
    assert pneud_here("export", GOLDEN, "-o", "run.log").returncode == 0
    assert pneud_here("import", "run.log").returncode == 0
    assert read_log("run.mcap").rate_hz == read_log(GOLDEN).rate_hz


@pytest.mark.parametrize("verb", verbs())
def test_what_help_says_of_a_verb_is_the_first_line_of_its_module(verb: str) -> None:
    listed = " ".join(pneud_here("--help").stdout.split())
    done = pneud_here(verb, "--help")
    assert done.returncode == 0
    assert f"Usage: pneud {verb} [OPTIONS]" in done.stdout
    line = (ast.get_docstring(ast.parse(verbs()[verb].read_text())) or "").partition("\n")[0]
    assert re.fullmatch(r"[A-Z].*\.", line)
    assert f" {verb} {line}" in listed
    assert line in " ".join(done.stdout.split())


def test_verbs_of_a_verb_have_their_help() -> None:
    listed = " ".join(pneud_here("tune", "--help").stdout.split())
    module = importlib.import_module("pneud.verbs.tune")
    assert list(module.VERBS) == ["get", "set", "diff", "save", "reload"]
    for name, function in module.VERBS.items():
        line = (function.__doc__ or "").partition("\n")[0]
        assert f" {name} {line}" in listed
        assert line in " ".join(pneud_here("tune", name, "--help").stdout.split())


@pytest.mark.parametrize("verb", ["goto", "jog", "track"])
def test_numbers_with_a_minus_sign_are_no_options(verb: str) -> None:
    assert importlib.import_module(f"pneud.verbs.{verb}").SETTINGS == NEGATIVE_NUMBERS
    done = pneud_here(verb, *(["steps"] if verb == "track" else []), "-5", "--socket", "/nowhere/at/all")
    assert done.returncode == 3, done.stderr


def test_a_verb_that_is_mistyped_is_guessed() -> None:
    done = pneud_here("statsu")
    assert done.returncode == 2
    assert "Did you mean 'status'" in done.stderr


class NoSuchThingError(Exception):
    exit_code = 3


@pytest.mark.parametrize(
    ("error", "status", "says"),
    [
        (NoSuchThingError("no such thing"), 3, "pneud: no such thing\n"),
        (MemoryError(), 3, "pneud: not enough memory\n"),
        (KeyboardInterrupt(), 130, ""),
        (BrokenPipeError(), 0, ""),
    ],
)
def test_what_people_can_do_something_about_is_one_line_and_a_status(
    error: BaseException, status: int, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: object) -> None:
        raise error

    monkeypatch.setattr(check, "load_axes", fail)
    done = pneud_here("check", "virtual.toml")
    assert (done.returncode, done.stdout, done.stderr) == (status, "", says)


def test_a_mistake_of_the_program_shows_where_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(check, "load_axes", None)
    with pytest.raises(TypeError, match="not callable"):
        pneud_here("check", "virtual.toml")


def test_version() -> None:
    assert pneud_here("--version").stdout.startswith("pneud ")


def test_sim_object_is_the_documented_one() -> None:
    summary = object_of(pneud_here("sim", "virtual.toml", "--duration", "1", "--json"))
    assert list(summary) == [
        "schema",
        "state",
        "bus",
        "rate_hz",
        "ticks",
        "skipped",
        "lateness_us",
        "sensor_to_command_us",
        "tracking_mm",
        "command_v",
        "saturated_ticks",
        "frames",
        "amiss",
        "odd_readings",
        "log",
        "log_dropped",
        "faults",
    ]
    assert summary["state"] == "tracking"
    assert summary["ticks"] == 1000
    assert summary["lateness_us"] is None
    tracking = summary["tracking_mm"]
    assert (tracking["rms"], tracking["max"], tracking["periods"]) == (None, None, 0)
    assert "no whole period of the reference" in tracking["reason"]
    assert list(summary["frames"]) == ["rx", "tx", "lost", "crc", "stale", "late"]


@pytest.mark.parametrize(
    ("change", "duration_s", "why"),
    [
        (('kind = "absolute" ', 'kind = "incremental" '), 0.5, "encoder_unreferenced"),
        (("", ""), 0.005, "unsettled"),
        (("", ""), 0.3, ""),
    ],
)
def test_a_simulation_that_never_arms_says_why(
    change: tuple[str, str], duration_s: float, why: str, tmp_path: Path
) -> None:
    text = (resources.configs() / "virtual.toml").read_text()
    assert change[0] in text
    file = tmp_path / "axis.toml"
    file.write_text(text.replace(*change))
    done = pneud_here("sim", file, "--duration", duration_s, "--json")
    assert done.returncode == bool(why)
    assert object_of(done).get("never_armed") == ([why] if why else None)
    assert done.stderr == (f"pneud: never armed: {why}\n" if why else "")


def test_what_shows_only_when_the_axis_is_asked_to_arm_is_named_too() -> None:
    done = pneud_here("sim", "--scenario", "unreachable")
    assert done.returncode == 1
    assert done.stderr == "pneud: never armed: unreachable\n"


@pytest.mark.parametrize(
    ("moves", "words"),
    [
        ("1200", "1200 mm lies outside the travel 21 … 979 mm"),
        ("500@5000", "5000 mm/s is faster than limits.motion.speed_m_s"),
        ("5000N", "5000 N: limits.force and the supply allow"),
        ("-5000N", "-5000 N: limits.force and the supply allow"),
    ],
)
def test_moves_that_the_axis_may_not_make_are_refused_before_it_begins(moves: str, words: str) -> None:
    done = pneud_here("sim", "--goto", moves)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"pneud: --goto {moves}: {words}")


@pytest.mark.parametrize("verb", ["status", "top", "hold"])
def test_an_axis_that_is_not_there_is_refused_in_one_line(tmp_path: Path, verb: str) -> None:
    with served(tmp_path) as b:
        b.ring.put(next(noisy(1)))
        done = pneud_here(verb, "--axis", "y", "--socket", b.path)
    assert (done.returncode, done.stdout) == (1, "")
    assert re.fullmatch(r"pneud: .*no axis 'y'; .*virtual\n", done.stderr)
