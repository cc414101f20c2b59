"""The steps of a commissioning, what ends them, and what is written."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from commands import pneud_here
from pneud import resources
from pneud.axis.stops import soft_limits
from pneud.config.proof import Proof, carry_over, digest, keep, proven
from pneud.config.sections import ConfigError
from pneud.console.client import Client, RefusedError
from pneud.control.probe import MOST_SPEED_M_S, MOST_TRAVEL_M
from pneud.loading import Loaded, load
from pneud.log.files.reader import read_log
from pneud.safety.faults import F
from pneud.safety.supervisor import is_engaged
from pneud.signals import Record, Request, RequestKind, State
from pneud.study.commissioning import procedure, written
from pneud.study.commissioning.bench import Simulated
from pneud.study.commissioning.live import TO_DO, Live
from pneud.study.commissioning.playing import PATIENCE_S, Played, Player
from pneud.study.commissioning.steps import Step, dynamic, first, ground_of, reach_m, static
from pneud.study.identification import estimating
from pneud.study.identification.motions import MOTIONS
from pneud.study.identification.parameters import Estimate
from running import running

SOURCE = "run.mcap, 2026-11-29"


@pytest.fixture(scope="module")
def virtual() -> Loaded:
    return load("virtual.toml")


def short(loaded: Loaded) -> list[Step]:
    """Rest, an opening, and a short way."""
    p = procedure.axis_of(loaded)
    edges, moves = static(p)[1], dynamic(p)[0]
    at = next(i for i, act in enumerate(edges.acts) if act.lease)
    return [edges._replace(acts=edges.acts[: at + 1]), moves]


class Intruder:
    """A player, and somebody else who asks for something when the axis has come to a state."""

    def __init__(self, player: Player, kind: RequestKind, state: State) -> None:
        self._player, self._wanted, self._state, self._waited = player, kind, state, 0

    @property
    def verdict(self) -> Played | None:
        return self._player.verdict

    def ask(self, state: int, present: int) -> Request | None:
        if state == self._state:
            self._waited += 1
            if self._waited == 50:
                return Request(self._wanted)
        return self._player.ask(state, present)

    def see(self, record: Record) -> None:
        self._player.see(record)


def ended(
    loaded: Loaded, folder: Path, around: Callable[[Player], Any] = lambda player: player
) -> tuple[Played, list[str], Simulated]:
    """What became of short steps, and what was announced."""
    announced: list[str] = []
    rig = Simulated(loaded, {}, 1, folder)
    player = Player(short(loaded), 1e-3, lambda step: announced.append(step.name))
    rig.play(around(player))
    assert player.verdict is not None
    return player.verdict, announced, rig


@pytest.mark.parametrize("change", [{}, {"limits": {"travel_min_m": 0.4, "travel_max_m": 0.55}}])
def test_all_steps_lie_within_the_limits(change: dict[str, Any]) -> None:
    p = procedure.axis_of(load("virtual.toml", change=change))
    steps = first(p) + static(p) + dynamic(p)
    low_m, high_m = soft_limits(p)
    assert all(low_m <= at_m <= high_m for at_m in reach_m(steps))
    for request in (r for step in steps for act in step.acts for r in act.requests):
        if request.kind == RequestKind.GOTO:
            assert 0.0 < request.values[1] <= p.motion.speed_m_s
        if request.kind == RequestKind.PROBE:
            assert request.values[2] <= MOST_TRAVEL_M
            assert request.values[3] <= MOST_SPEED_M_S
    assert {step.name for step in steps} == {"rest", "edges", "moves", "sine"}
    assert all(step.seconds > 0.0 and "mm" in step.words for step in steps)
    assert len(steps) == 1 + len(MOTIONS)


def test_what_is_slow_comes_first(virtual: Loaded) -> None:
    p = procedure.axis_of(virtual)
    assert ground_of(p).approach_m_s <= 0.4 * p.motion.speed_m_s
    assert [step.name for step in static(p)] == ["rest", "edges"]
    speeds = [r.values[1] for s in dynamic(p) if s.name == "moves" for r in s.acts[-1].requests]
    assert speeds == sorted(speeds)


@pytest.mark.slow
def test_steps_are_announced_and_end_at_rest(virtual: Loaded, tmp_path: Path) -> None:
    played, announced, rig = ended(virtual, tmp_path)
    assert played.whole
    assert announced == ["edges", "moves"]
    (log,) = rig.logs()
    states = {tick.state for tick in log}
    assert {State.PROBING, State.MOVING, State.HOLDING} <= states


@pytest.mark.slow
@pytest.mark.parametrize("state", [State.MOVING, State.PROBING])
@pytest.mark.parametrize("kind", [RequestKind.STOP, RequestKind.DISARM])
def test_a_stop_ends_them(state: State, kind: RequestKind, virtual: Loaded, tmp_path: Path) -> None:
    played, _, rig = ended(virtual, tmp_path, lambda player: Intruder(player, kind, state))
    assert played == Played("stopped")
    *_, last = rig.logs()[0]
    assert not is_engaged(last.state)


@pytest.mark.slow
def test_a_fault_ends_them(virtual: Loaded, tmp_path: Path) -> None:
    weak = {"plant": {"supply": {"receiver_m3": 1e-6, "regulator_l_min_bar": 0.01}}}
    rig = Simulated(virtual, weak, 1, tmp_path)
    player = Player(short(virtual)[1:], 1e-3, lambda step: None)
    rig.play(player)
    assert player.verdict is not None
    assert player.verdict.failure == "a fault"
    assert player.verdict.faults
    (log,) = rig.logs()
    assert State.MOVING in {tick.state for tick in log}


def test_what_cannot_be_armed_is_said(virtual: Loaded) -> None:
    player = Player(short(virtual), 1e-3, lambda step: None)
    for _ in range(round(PATIENCE_S / 1e-3) + 2):
        assert player.ask(State.DISARMED, 1 << F.SUPPLY_PRESSURE) is None or player.verdict is not None
    assert player.verdict == Played("the axis is disarmed", ("supply_pressure",))


def estimate(value: float, told: bool = True) -> Estimate:
    return Estimate(value, 0.9 * value, 1.1 * value, None, told)


def test_values_are_written_with_their_origin_and_comments_stay() -> None:
    loaded = load("virtual.toml")
    values = {
        "cylinder.moving_mass_kg": 17.5,
        "valve.orifice_area_m2": None,
        "valve.sonic_conductance_l_s_bar": 5.25,
        "valve.map": None,
        "reference.effective_centre_m": 0.51,
        "plant.valve": {"dead_zone_v": 0.2, "damping": 0.7},
        "plant.cylinder": {},
    }
    found = {"cylinder.moving_mass_kg": estimate(17.5)}
    what = written.changes(loaded.config, loaded.text, values, found)
    assert [c.key for c in what] == [
        "cylinder.moving_mass_kg", "valve.orifice_area_m2", "valve.sonic_conductance_l_s_bar",
        "reference.effective_centre_m", "plant.valve.bandwidth_hz", "plant.valve.dead_zone_v",
        "plant.valve.dac_bits",
    ]  # fmt: skip
    text = written.text_with(loaded.text, "virtual.toml", what, SOURCE)
    assert f"moving_mass_kg = 17.5  # 15.75 … 19.25 by {SOURCE}\n" in text
    assert f"# the paper's coordinate: stroke + dead_length_1_m; by {SOURCE}\n" in text
    assert "orifice_area_m2" not in text.partition("[loop]")[0]
    kept = [line for line in loaded.text.splitlines() if line.startswith("#")]
    assert kept == [line for line in text.splitlines() if line.startswith("#")]
    again = written.text_with(
        text, "x", [written.Change("cylinder.moving_mass_kg", 17.5, 18.0, "17 … 19")], "b.mcap, 2026-12-01"
    )
    assert "moving_mass_kg = 18.0  # 17 … 19 by b.mcap, 2026-12-01\n" in again


@pytest.mark.parametrize(
    ("remark", "kept"),
    [
        ("typical: half the width", ""),
        ("likewise", ""),
        ("the limit frequency of its sheet", ""),
        ("350 l/min ANR at 6 -> 5 bar", ""),
        ("piston, rod and load", "piston, rod and load; "),
    ],
)
def test_where_a_value_was_from_before_does_not_stay(remark: str, kept: str, virtual: Loaded) -> None:
    line = next(line for line in virtual.text.splitlines() if line.startswith("moving_mass_kg"))
    text = virtual.text.replace(line, f"moving_mass_kg = 15.0  # {remark}")
    change = written.Change("cylinder.moving_mass_kg", 15.0, 16.0, "15 … 17")
    text = written.text_with(text, "x", [change], SOURCE)
    assert f"moving_mass_kg = 16.0  # {kept}15 … 17 by {SOURCE}\n" in text


def test_what_makes_no_configuration_is_not_written(virtual: Loaded) -> None:
    change = written.Change("cylinder.moving_mass_kg", 15.0, -1.0, "")
    with pytest.raises(ConfigError, match="moving_mass_kg"):
        written.text_with(virtual.text, "virtual.toml", [change], SOURCE)


def test_a_proof_is_carried_over_to_what_is_known_better(virtual: Loaded, tmp_path: Path) -> None:
    file, of = tmp_path / "rig.toml", digest(virtual.config, b"")
    carry_over(file, of, "other")
    assert proven(file, "other") == Proof.MISSING
    keep(file, of, {"passed": True, "date": "today"})
    carry_over(file, "another", "other")
    assert proven(file, of) == Proof.PASSED
    carry_over(file, of, "other")
    assert proven(file, "other") == Proof.PASSED
    assert json.loads(file.with_suffix(".proof.json").read_text())["date"] == "today"


def copied(folder: Path) -> Path:
    """A configuration of one's own."""
    for name in ("virtual.toml", "pneud.dbc"):
        (folder / name).write_bytes((resources.configs() / name).read_bytes())
    return folder / "virtual.toml"


@pytest.mark.slow
def test_the_movement_test_alone_writes_nothing(tmp_path: Path) -> None:
    file = copied(tmp_path)
    before = file.read_bytes()
    done = pneud_here("commission", "--virtual", "--config", file, "--movement-test", "--json")
    said = json.loads(done.stdout)
    assert (done.returncode, said["verdict"], said["written"]) == (0, "passed", False)
    assert file.read_bytes() == before


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ("-o page.toml", "its name must end in .html"),
        ("-o none/page.html", "there is no folder none"),
        ("-o page.html --movement-test", "no use for -o"),
        ("--movement-test --skip-dynamic", "no use for --skip-dynamic"),
        ("--socket none --again", "no use for --socket, --again"),
    ],
)
def test_what_would_come_to_nothing_is_refused(
    options: str, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("page.toml").touch()
    done = pneud_here("commission", "--virtual", *options.split())
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert why in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["page.toml"]
    assert not Path("page.toml").read_bytes()


def test_a_file_that_cannot_be_written_is_said_before_anything_moves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "rig.toml").write_text(resources.find("virtual.toml").read_text(encoding="utf-8"))
    monkeypatch.setattr("os.access", lambda *_: False)
    done = pneud_here("commission", "--virtual", "--config", tmp_path / "rig.toml", "--yes")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (3, "", 1)
    assert "rig.toml: cannot be written" in done.stderr


@pytest.mark.slow
def test_a_page_that_there_is_nothing_for_is_said(tmp_path: Path) -> None:
    file = copied(tmp_path)
    file.write_text(f"{file.read_text()}\n[plant.wiring]\nsupply_shut = true\n")
    page = tmp_path / "page.html"
    done = pneud_here("commission", "--virtual", "--config", file, "-o", page)
    assert done.returncode == 1
    assert f"pneud: {page}: not written" in done.stderr
    assert not page.exists()


def test_a_seed_is_of_a_software_rig() -> None:
    done = pneud_here("commission", "--seed", "3")
    assert (done.returncode, "--virtual" in done.stderr) == (2, True)


class Quiet:
    """Somebody who agrees."""

    def __init__(self, agrees: bool = True) -> None:
        self.said: list[str] = []
        self._agrees = agrees

    def say(self, words: str) -> None:
        self.said.append(words)

    def agreed(self, changes: list[written.Change]) -> bool:
        assert changes
        return self._agrees


@pytest.mark.slow
@pytest.mark.parametrize("write", [True, False])
def test_slow_motion_alone_makes_a_slow_axis(
    write: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = {f"valve.dead_zone_{side}_v": estimate(0.12) for side in ("positive", "negative")}
    told |= {"valve.dead_zone_v": estimate(0.12), "cylinder.moving_mass_kg": estimate(20.0, told=False)}
    found = estimating.Identified(told, [], ["hardly any motion"], 100.0, None, None)
    monkeypatch.setattr(estimating, "identify", lambda table, config: found)
    monkeypatch.setattr(procedure, "_steps", lambda p, wishes: static(p)[:1])
    file = copied(tmp_path)
    before = file.read_text()
    rig = Simulated(load(file), {"cylinder": {}}, 1, tmp_path)
    wishes = procedure.Wishes(movement=False, dynamic=False, write=write)
    outcome = procedure.commission(rig, wishes, Quiet())
    assert outcome.after is not None
    assert (outcome.written, outcome.failure) == (write, "")
    assert (file.read_text() == before) is not write
    assert rig.loaded.config.valve.dead_zone_v == 0.12
    assert rig.loaded.config.cylinder.moving_mass_kg == 15.0
    assert rig.loaded.config.limits.motion.speed_m_s == pytest.approx(0.1)
    said = json.loads(json.dumps(procedure.as_json(outcome), allow_nan=False))
    assert said["warnings"] == [procedure.SLOW_ONLY]
    assert said["notes"] == ["hardly any motion"]
    assert said["verdict"] in ("passed", "missed")
    assert {"value", "low", "high", "configured"} <= said["parameters"]["valve.dead_zone_v"].keys()
    assert said["after"]["figures"]


@pytest.mark.parametrize("by", [Played("a fault", ("travel",)), KeyboardInterrupt()])
def test_edges_that_are_of_no_use_do_not_stay_in_the_file(
    by: Played | KeyboardInterrupt, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Kept(Simulated):
        """Like a daemon, of which there is only what its file says."""

        tries = False

    file = copied(tmp_path)
    before = file.read_text()
    came_to = [Played(), Played("a fault", ("tracking_error",)), by]

    def played(*_: object) -> Played:
        one = came_to.pop(0)
        if isinstance(one, KeyboardInterrupt):
            raise one
        return one

    def learnt(bench: Simulated, *_: object) -> bool:
        bench.adopt(before.replace("dead_zone_v = 0.1", "dead_zone_v = 0.2", 1), True)
        assert file.read_text() != before
        return True

    monkeypatch.setattr(procedure, "_learnt_edges", learnt)
    monkeypatch.setattr(procedure, "_played", played)
    rig = Kept(load(file), {}, 1, tmp_path)
    with contextlib.suppress(KeyboardInterrupt):
        outcome = procedure.commission(rig, procedure.Wishes(movement=False), Quiet())
        assert (outcome.verdict, outcome.faults) == ("interrupted", ("travel",))
    assert not came_to
    assert file.read_text() == before
    assert rig.loaded.config.valve.dead_zone_v == 0.1


def test_what_a_loop_cannot_follow_is_asked_for_more_slowly(
    virtual: Loaded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[list[Step]] = []
    came_to = [Played(), Played("a fault", ("overspeed",), 2), Played("a fault", ("overspeed",), 1), Played()]

    def played(bench: Simulated, steps: list[Step], _talk: Any) -> Played:
        asked.append(steps)
        return came_to.pop(0)

    monkeypatch.setattr(procedure, "_learnt_edges", lambda *_: False)
    monkeypatch.setattr(procedure, "_played", played)
    rig, talk = Simulated(virtual, {}, 1, tmp_path), Quiet()
    assert procedure._stepped(rig, procedure.Wishes(), talk).whole
    _, whole, half, quarter = asked
    assert [step.name for step in half] == [step.name for step in whole[-2:]] == ["moves", "moves"]
    assert (len(half), len(quarter)) == (2, 1)
    fastest = [
        max(r.values[1] for a in s[-1].acts for r in a.requests if len(r.values) > 1) for s in asked[1:]
    ]
    assert fastest == pytest.approx([0.5, 0.25, 0.125])
    assert sum("more slowly" in words for words in talk.said) == 2


@contextlib.contextmanager
def live(folder: Path) -> Iterator[tuple[Live, Path]]:
    """The axis of a daemon, and its file."""
    with running(folder, log_name="logs") as run:
        file = folder / "patient.toml"
        rig = Live(lambda: Client(run.socket), load(file))
        try:
            yield rig, file
        finally:
            rig.close()


@pytest.mark.slow
def test_the_same_steps_on_a_daemon_which_begins_anew(tmp_path: Path) -> None:
    with live(tmp_path) as (rig, file):
        announced: list[str] = []
        player = Player([short(rig.loaded)[1]], 1e-3, lambda step: announced.append(step.name))
        rig.play(player)
        assert player.verdict == Played()
        assert announced == ["moves"]
        (log,) = rig.logs()
        assert State.MOVING in {tick.state for tick in log}
        text = file.read_text()
        rig.adopt(text.replace("moving_mass_kg = 15.0", "moving_mass_kg = 16.0"), True)
        assert rig.loaded.config.cylinder.moving_mass_kg == 16.0
        status = rig._client.ask("status")
        assert (status["state"], status["config_changed"]) == ("disarmed", False)
        assert status["log"].endswith(rig.log_name)
        with pytest.raises(ConfigError):
            rig.adopt(text.replace("moving_mass_kg = 15.0", "moving_mass_kg = -1.0"), True)
        assert "moving_mass_kg = 16.0" in file.read_text()
    assert read_log(str(tmp_path / "logs" / rig.log_name)).config_text == file.read_text()


@pytest.mark.slow
def test_the_file_is_put_back_and_what_is_held_stays_so(tmp_path: Path) -> None:
    with live(tmp_path) as (rig, file):
        before, of = file.read_bytes(), digest(rig.loaded.config, rig.loaded.dbc.read_bytes())
        keep(file, of, {"passed": True})
        heavier = rig.loaded.text.replace("moving_mass_kg = 15.0", "moving_mass_kg = 16.0")
        rig.adopt(heavier, True)
        assert (file.read_bytes() == before, proven(file, of)) == (False, Proof.CHANGED)
        arm = Player([dynamic(procedure.axis_of(rig.loaded))[0]], 1e-3, lambda step: None)
        rig.play(arm)
        assert rig.put_back(before.decode()) == TO_DO.format("pneud disarm, ")
        assert (file.read_bytes() == before, proven(file, of)) == (True, Proof.PASSED)
        status = rig._client.ask("status")
        assert (status["state"], status["config_changed"]) == ("holding", True)
        rig._rest()
        assert rig.put_back(before.decode()) == ""
        status = rig._client.ask("status")
        assert (status["state"], status["config_changed"]) == ("disarmed", False)


@pytest.mark.slow
def test_a_stop_while_nobody_looks_is_not_gone_on_after(tmp_path: Path) -> None:
    with live(tmp_path) as (rig, file):
        before, steps = file.read_bytes(), [dynamic(procedure.axis_of(rig.loaded))[0]]
        rig.play(Player(steps, 1e-3, lambda step: None))
        rig.play(Player(steps, 1e-3, lambda step: None))  # its own ways are no one else's
        with rig._connect() as other:
            other.ask("stop")
        with pytest.raises(RefusedError, match="commanded the axis meanwhile: stop"):
            rig.adopt(rig.loaded.text.replace("moving_mass_kg = 15.0", "moving_mass_kg = 16.0"), True)
        with pytest.raises(RefusedError, match="commanded the axis meanwhile: stop"):
            rig.play(Player(steps, 1e-3, lambda step: None))
        assert file.read_bytes() == before
        assert rig._client.ask("status")["state"] in ("stopping", "holding")


@pytest.mark.slow
def test_somebody_elses_stop_ends_them_on_a_daemon(tmp_path: Path) -> None:
    with running(tmp_path) as run:
        rig = Live(lambda: Client(run.socket), load(tmp_path / "patient.toml"))

        player = Player(short(rig.loaded)[1:], 1e-3, lambda step: None)
        rig.play(Intruded(player, run.socket))
        assert player.verdict == Played("stopped")
        rig.close()


class Intruded(Intruder):
    """A player, and another client who stops the axis when it moves."""

    def __init__(self, player: Player, socket: str) -> None:
        super().__init__(player, RequestKind.STOP, State.MOVING)
        self._socket = socket

    def ask(self, state: int, present: int) -> Request | None:
        wanted = super().ask(state, present)
        if wanted is None or wanted.kind != RequestKind.STOP:
            return wanted
        with Client(self._socket) as other:
            other.ask("stop")
        return None
