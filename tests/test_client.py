"""A daemon in the hands of a script: what is asked, what is refused, and that it stops in the end."""

from __future__ import annotations

import asyncio
import threading
import time
import warnings
from pathlib import Path
from typing import Any

import pytest

import pneud
from commands import background, eventually
from console_bench import Bench, served
from log_samples import tick_at
from pneud.notebook import client as module
from pneud.signals import Answer, Record, Request, RequestKind, State, Timing
from running import serves
from test_notebook import examples, play


def kinds(b: Bench) -> list[RequestKind]:
    return [RequestKind(request.kind) for request in b.requests]


def stands_at(b: Bench, position_m: float, state: State = State.HOLDING) -> None:
    """The loop's record of a load that stands there, in position."""
    tick = tick_at(time.monotonic_ns())
    tick = tick._replace(
        state=int(state),
        in_position=int(state in (State.HOLDING, State.PRESSING)),
        present=0,
        latched=0,
        reference=tick.reference._replace(position_m=position_m),
        estimate=tick.estimate._replace(position_m=position_m),
    )
    b.ring.put(Record(tick, Timing(0, 0, 0, 0, 0, 0), (), 0, (), position_m))


def test_it_stops_at_its_end_what_it_has_set_going(tmp_path: Path) -> None:
    with served(tmp_path) as b:
        with pneud.Client(b.path) as axis:
            assert axis.status()["name"] == "virtual"
        assert kinds(b) == []
        with pytest.raises(ValueError, match="mine"), pneud.Client(b.path) as axis:
            assert axis.arm() == "holding"
            axis.goto(100.0, wait=False, speed_mm_s=20.0)
            raise ValueError("mine")
        assert kinds(b) == [RequestKind.ARM, RequestKind.GOTO, RequestKind.STOP]
        assert b.requests[1].values == (0.1, 0.02, 0.0, 0.0)


def test_what_is_refused_comes_in_the_consoles_words(tmp_path: Path) -> None:
    with served(tmp_path) as b, pneud.Client(b.path) as axis:
        with pytest.raises(pneud.RefusedError, match="5000 mm lies outside the travel") as e:
            axis.goto(5000.0)
        assert e.value.kind == "out_of_travel"
        assert e.value.error["nearest_mm"] == 979.0
        b.answer = lambda _: Answer.UNSTABLE
        with pytest.raises(pneud.RefusedError, match="the loop would not be stable with these gains"):
            axis.tune({"control.k1": 1.0})
        with pytest.raises(pneud.ConfigError, match="2 times but 1 positions"):
            axis.track(([0.0, 1.0], [2.0]))
        with pytest.raises(pneud.RefusedError, match=r"track: from 0 to .* s: speed"):
            axis.track(([0.0, 0.01], [100.0, 900.0]))
    with pytest.raises(pneud.PlaceError, match="no daemon serves it"):
        pneud.Client(tmp_path / "none.sock")


def test_a_goto_waits_until_the_load_is_there_and_a_jog_renews_its_lease(tmp_path: Path) -> None:
    with served(tmp_path) as b, pneud.Client(b.path) as axis:
        stands_at(b, 0.3)
        threading.Timer(0.15, stands_at, (b, 0.1)).start()
        begun_s = time.monotonic()
        with pytest.raises(pneud.RefusedError, match="the axis holds at 300"):
            axis.goto(100.0)
        time.sleep(max(0.0, 0.2 - (time.monotonic() - begun_s)))
        assert axis.goto(100.0)["position_mm"] == 100.0
        b.requests.clear()
        axis.jog(10.0, for_s=0.15)
        assert kinds(b) == [RequestKind.JOG, RequestKind.JOG, RequestKind.HOLD]


def test_a_force_waits_until_it_is_there(tmp_path: Path) -> None:
    async def pressed(b: Bench) -> Any:
        async with pneud.AsyncClient(b.path) as axis:
            return await axis.force(-40.0, rate_n_s=500.0)

    with served(tmp_path) as b:
        with pneud.Client(b.path) as axis:
            stands_at(b, 0.3, State.PRESSING)
            assert axis.force(40.0, between_mm=(200.0, 400.0))["state"] == "pressing"
            assert "order" in axis.force(50.0, wait=False, speed_mm_s=100.0, timeout_s=2.0)
            with pytest.raises(pneud.RefusedError, match=r"N are more than limits\.force and the supply"):
                axis.force(1e5)
        assert asyncio.run(pressed(b))["state"] == "pressing"
        assert [r.values for r in b.requests if r.kind == RequestKind.FORCE] == [
            pytest.approx((40.0, 0.0, 0.2, 0.4, 0.0, 0.0)),
            pytest.approx((50.0, 0.0, 0.0, 0.0, 0.1, 2.0)),
            pytest.approx((-40.0, 500.0, 0.0, 0.0, 0.0, 0.0)),
        ]
        assert kinds(b)[-1] == RequestKind.STOP  # what it has set going


def test_a_profile_is_uploaded_whole(tmp_path: Path) -> None:
    with served(tmp_path) as b, pneud.Client(b.path) as axis:
        axis.track(([0.1 * i for i in range(41)], [500.0] * 41))
        assert [k for k in kinds(b) if k != RequestKind.PIECE] == [RequestKind.TRACK]
        assert len(b.requests) == 1 + 40 + 1
        assert b.requests[-1] == Request(int(RequestKind.TRACK), (1.0,))
        axis.track()
        assert b.requests[-1] == Request(int(RequestKind.TRACK), (0.0,))


def test_gains_that_check_would_warn_of_are_a_warning(tmp_path: Path) -> None:
    with served(tmp_path) as b, pneud.Client(b.path) as axis:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert axis.tune({"control.k1": 90000.0})["k1"] == 90000.0
            assert axis.tune()["k1"] == 90000.0
        with pytest.warns(UserWarning, match="all hangs on the prediction"):
            axis.tune({"k3": 100000.0})


def test_events_since_the_last_call(tmp_path: Path) -> None:
    with served(tmp_path) as b, pneud.Client(b.path) as axis:
        stands_at(b, 0.3, State.DISARMED)
        stands_at(b, 0.3)
        assert [e.message for e in axis.events() if e.name == "state"] == ["disarmed", "disarmed → holding"]
        assert axis.events() == []


def test_to_await(tmp_path: Path) -> None:
    async def at_work(b: Bench) -> Any:
        async with pneud.AsyncClient(b.path) as axis:
            assert await axis.arm() == "holding"
            stands_at(b, 0.2, State.MOVING)
            going = asyncio.create_task(axis.goto(100.0))
            await asyncio.sleep(0.1)
            assert not going.done()
            assert await axis.stop() == "holding"
            with pytest.raises(pneud.RefusedError, match="goto 100 mm: replaced by stop"):
                await going
            return await axis.events()

    with served(tmp_path) as b:
        assert asyncio.run(at_work(b))
        assert kinds(b) == [RequestKind.ARM, RequestKind.GOTO, RequestKind.STOP, RequestKind.STOP]


def test_both_clients_have_the_same_calls() -> None:
    def calls(of: type) -> set[str]:
        return {name for name in vars(of) if not name.startswith("_")}

    assert calls(pneud.Client) == calls(pneud.AsyncClient)
    for name in calls(pneud.Client):
        assert (getattr(pneud.AsyncClient, name).__doc__ or "").startswith(f"As `Client.{name}`")


@pytest.mark.slow
@pytest.mark.realtime
def test_the_examples_of_the_docstrings_with_a_daemon(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = str(tmp_path / "console.sock")
    monkeypatch.setenv("PNEUD_SOCKET", path)
    with background("--virtual", "--headless", "--duration", 60, "--log", tmp_path / "x.mcap"):
        eventually(lambda: serves(path))
        found = {test.name.removeprefix(f"{module.__name__}."): test for test in examples(module)}
        assert {name for name in vars(pneud.Client) if not name.startswith("_")} - {"home", "clear"} <= {
            name.partition(".")[2] for name in found
        }
        names: dict[str, Any] = {"pneud": pneud, "asyncio": asyncio}

        def become(state: str) -> None:
            with pneud.Client() as looking:
                eventually(lambda: looking.status()["state"] == state)

        become("tracking")
        for name in ("Client", "AsyncClient"):
            play(found.pop(name), names)
            become("holding")  # they stop in the end
        with pneud.Client() as axis:
            names["axis"] = axis
            for call in ("goto", "force", "track", "jog", "hold", "tune", "status", "events", "mark"):
                play(found.pop(f"Client.{call}"), names)
            axis.track()
            for call, state in (("stop", "holding"), ("disarm", "disarmed"), ("arm", "holding")):
                play(found.pop(f"Client.{call}"), names)
                become(state)
        assert not found
