"""Replay: identical or not, where, and what it refuses."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from axis_rig import quick
from commands import object_of
from commands import pneud_here as pneud
from log_samples import bits
from pneud import resources
from pneud.config.reading import parse
from pneud.console import profiles
from pneud.control.reference import Bounds
from pneud.loading import load
from pneud.log.files.naming import LogError, create_log
from pneud.log.files.reader import read_log
from pneud.log.files.writer import LogWriter
from pneud.log.format.header import LogHeader
from pneud.log.format.records import LoggedTick
from pneud.log.format.schema import message_class
from pneud.replay.feeding import Fed
from pneud.replay.lockstep import Simulation
from pneud.replay.replaying import replay
from pneud.safety.faults import FAULT_NAMES
from pneud.signals import Answer, Request, RequestKind, State

ENCODER, COMMAND = 0x181, 0x203


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated run of one second."""
    path = tmp_path_factory.mktemp("replay") / "sim.mcap"
    assert pneud("sim", "virtual.toml", "--duration", 1, "-o", path).returncode == 0
    return path


def rewritten(source: Path, target: Path, tick: int, can_id: int = ENCODER, place: int = 0) -> Path:
    """A copy of a log in which the lowest bit of one byte of one frame is the other one."""
    from mcap.reader import NonSeekingReader  # noqa: PLC0415
    from mcap.writer import Writer  # noqa: PLC0415

    changed = 0

    def flipped(number: int, data: bytes) -> bytes:
        """The message of frames with the bit flipped, where it is the one of that tick."""
        nonlocal changed
        message = message_class("pneud.Frames").FromString(data)
        index = tick + 1 - number
        if not 0 <= index < len(message.received):
            return data
        for column in message.columns:
            if column.can_id == can_id:
                planes = bytearray(column.data)
                planes[place * len(message.received) + index] ^= 1  # one frame of it in every tick
                column.data = bytes(planes)
                changed += 1
        again: bytes = message.SerializeToString()
        return again

    with source.open("rb") as f, target.open("wb") as g:
        writer = Writer(g)
        writer.start()
        reader = NonSeekingReader(f)
        channels: dict[int, int] = {}
        schemas: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            assert schema is not None
            if channel.id not in channels:
                if schema.id not in schemas:
                    schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.id]
                )
            data = message.data
            if channel.topic == "/can/frames":
                data = flipped(message.sequence, data)
            writer.add_message(
                channels[channel.id], message.log_time, data, message.publish_time, message.sequence
            )
        assert changed == 1
        with source.open("rb") as again:
            head = NonSeekingReader(again)
            for attachment in head.iter_attachments():
                writer.add_attachment(
                    attachment.create_time,
                    attachment.log_time,
                    attachment.name,
                    attachment.media_type,
                    attachment.data,
                )
        with source.open("rb") as again:
            for metadata in NonSeekingReader(again).iter_metadata():
                writer.add_metadata(metadata.name, dict(metadata.metadata))
        writer.finish()  # type: ignore[no-untyped-call]
    return target


def test_a_simulation_replays_to_the_bit(log: Path) -> None:
    done = pneud("replay", log, "--json")
    assert done.returncode == 0
    s = object_of(done)
    assert list(s) == [
        "schema",
        "ticks",
        "commands",
        "mismatches",
        "first_mismatch_tick",
        "engaged_ticks",
        "identical",
        "equivalent",
        "fingerprint",
        "truncated",
    ]
    assert s["identical"] is True
    assert s["equivalent"] is True
    assert s["fingerprint"] == "same"
    assert s["mismatches"] == 0
    assert s["first_mismatch_tick"] is None
    assert s["commands"] == s["ticks"] > 1000
    assert s["truncated"] is False


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_a_replay_has_the_axis_in_c_and_makes_no_tick_that_nobody_asks_for(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[int] = []
    whole = Fed.whole

    def noted(fed: Fed) -> LoggedTick:
        made.append(fed.number)
        return whole(fed)

    monkeypatch.setattr(Fed, "whole", noted)
    outcome = replay(read_log(log))
    assert (outcome.compiled, outcome.identical) == (True, True)
    assert not made
    seen = []
    assert replay(read_log(log), look=lambda logged, tick: seen.append(logged)).identical
    assert [bits(tick) for tick in seen] == [bits(tick) for tick in read_log(log)]
    interpreted = parse(read_log(log).config_text, "x").model_copy(deep=True)
    off = interpreted.model_copy(update={"loop": interpreted.loop.model_copy(update={"compiled": "off"})})
    assert not replay(read_log(log), off).compiled


def test_one_flipped_bit_is_found_in_its_tick(log: Path, tmp_path: Path) -> None:
    outcome = replay(read_log(rewritten(log, tmp_path / "flipped.mcap", tick=600)))
    assert not outcome.good
    assert outcome.first is not None
    assert outcome.first.tick == 600
    assert "encoder" in outcome.first.variable or "fresh" in outcome.first.variable


@pytest.mark.parametrize("place", [0, 2, 7], ids=["voltage", "enable", "crc"])
def test_one_flipped_bit_of_a_command_is_no_identical_log(log: Path, tmp_path: Path, place: int) -> None:
    outcome = replay(read_log(rewritten(log, tmp_path / "flipped.mcap", 600, COMMAND, place)))
    assert not outcome.good
    assert not outcome.equivalent
    assert outcome.first is not None
    assert outcome.first.tick == 600


def test_other_gains_differ_and_say_where(log: Path, tmp_path: Path) -> None:
    text = (resources.configs() / "virtual.toml").read_text()
    gain = next(line for line in text.splitlines() if line.startswith("k3 = "))
    other = parse(text.replace(gain, f"k3 = {float(gain.split('=')[1].split('#')[0]) * 1.01}"), "other")
    outcome = replay(read_log(log), other)
    assert outcome.mismatches > 0
    assert outcome.first is not None
    assert outcome.first.variable.startswith("command.")
    assert outcome.first.logged != outcome.first.replayed


def test_a_log_cut_short_replays_as_far_as_it_goes(log: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[: log.stat().st_size // 2])
    done = pneud("replay", cut, "--json")
    s = object_of(done)
    assert done.returncode == 0
    assert s["truncated"] is True
    assert s["identical"] is True
    assert 0 < s["ticks"] < 1000


def test_a_mended_log_replays(log: Path, tmp_path: Path) -> None:
    cut, mended = tmp_path / "cut.mcap", tmp_path / "mended.mcap"
    cut.write_bytes(log.read_bytes()[: log.stat().st_size * 2 // 3])
    assert pneud("recover", cut, "-o", mended).returncode == 0
    s = object_of(pneud("replay", mended, "--json"))
    assert s["identical"] is True
    assert s["truncated"] is False


def test_a_log_that_was_never_engaged_is_no_pass(tmp_path: Path) -> None:
    path = tmp_path / "short.mcap"
    pneud("sim", "virtual.toml", "--duration", "0.005", "-o", path)
    done = pneud("replay", path, "--json")
    assert done.returncode == 1
    assert object_of(done)["engaged_ticks"] == 0


@pytest.mark.parametrize("content", [b"", b"no log at all" * 100, b"\x89MCAP0\r\n"])
def test_a_foreign_file_is_one_line_and_exit_2(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "foreign.mcap"
    file.write_bytes(content)
    done = pneud("replay", file)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    with pytest.raises(LogError):
        read_log(file)


@pytest.mark.slow
def test_a_log_with_requests_of_every_kind_replays_to_the_bit(tmp_path: Path) -> None:
    here = load("virtual.toml")
    pieces = profiles.steps([0.44, 0.46, 0.45], 0.1, Bounds(0.5, 5.0, 100.0))
    asked = {
        80: Request(RequestKind.ARM),
        200: Request(RequestKind.GOTO, (0.5,)),
        350: Request(RequestKind.GOTO, (0.45, 0.2, 0.0, 0.0)),
        1000: Request(RequestKind.JOG, (0.1, 100.0)),
        1500: Request(RequestKind.GOTO, (3.0,)),
        2300: Request(RequestKind.HOLD),
        2800: Request(RequestKind.STOP),
        3000: Request(RequestKind.DISARM),
        **dict(enumerate(profiles.requests(pieces), start=1600)),
    }
    path = tmp_path / "told.mcap"
    header = LogHeader(
        "virtual", "simulated", 1000.0, "full", here.path.name, here.text, here.dbc.name,
        here.dbc.read_bytes(), FAULT_NAMES, 0, {},
    )  # fmt: skip
    writer = LogWriter(create_log(path), header)
    states, answers = set(), set()
    for record in Simulation(here, 3.6, how=quick(), requests=asked).records():
        writer.write(record)
        states.add(record.tick.state)
        answers.add(record.tick.answer)
    writer.close()
    assert states >= {State.HOLDING, State.MOVING, State.TRACKING, State.STOPPING, State.DISARMED}
    assert answers == {Answer.NONE, Answer.TAKEN, Answer.OUT_OF_TRAVEL}
    outcome = replay(read_log(path))
    assert (outcome.identical, outcome.first) == (True, None)
    assert outcome.ticks > 3600
