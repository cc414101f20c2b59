"""The screen as pictures in text: sizes, light and dark terminals, letters alone, one line; and textual."""

from __future__ import annotations

import asyncio
import io
from collections.abc import Callable

import pytest
from rich.console import Console

from pneud.safety.cause import first_cause
from pneud.safety.faults import BLOCKS_ARM, FAULT_NAMES, F
from pneud.signals import Answer, Record, Request, RequestKind, State
from pneud.view.app import ScreenApp
from pneud.view.hands import Leaving
from pneud.view.info import ScreenInfo
from pneud.view.palette import palette
from pneud.view.screen import Page, status_line
from pneud.view.show import Show
from snapshots import assert_same
from test_screen_keys import Asked
from test_view import INFO, RECORD, T0

SIZES = ((80, 24), (120, 40), (200, 60))
FULL = INFO._replace(
    fault_names=FAULT_NAMES,
    blocks_arm=BLOCKS_ARM,
    first_cause=first_cause,
    speed_m_s=2.0,
    supply_min_pa=4.5e5,
    supply_max_pa=8e5,
    area_1_m2=1.2566e-3,
    area_2_m2=1.0566e-3,
    atmosphere_pa=1.01e5,
    dead_zone_v=0.1,
    bitrate_bit_s=1e6,
    elsewhere="pneud top",
)
ALONE = (F.ENCODER_MISSING, F.PRESSURE_MISSING, F.VALVE_MISSING, F.TRAVEL, F.SUPPLY_PRESSURE)


def swing(tick: int, period: int) -> float:
    """A triangle between −1 and 1: exact on every machine, as a sine is not."""
    phase = tick % period / period
    return 4.0 * phase - 1.0 if phase < 0.5 else 3.0 - 4.0 * phase


def tracking(count: int = 12_000) -> list[Record]:
    """A load that follows a triangle, seen every 10 ms."""
    request = Request(RequestKind.ARM, (1.0,))
    records = []
    for i in range(0, count, 10):
        x, v = 0.5 + 0.05 * swing(i, 2048), swing(i + 512, 2048)
        tick = RECORD.tick
        m = tick.measurement
        records.append(
            RECORD._replace(
                truth_m=x,
                tick=tick._replace(
                    t_ns=T0 + i * 1_000_000,
                    measurement=m._replace(
                        t_ns=T0 + i * 1_000_000,
                        position_m=x,
                        p1_pa=4e5 + 3e4 * swing(i, 4096),
                        p2_pa=4.5e5 - 4e4 * swing(i, 2048),
                    ),
                    estimate=tick.estimate._replace(position_m=x, velocity_m_s=0.1 if v > 0 else -0.1),
                    reference=tick.reference._replace(
                        position_m=x + 2.0**-17 * swing(i, 256), velocity_m_s=0.0
                    ),
                    command=tick.command._replace(voltage_v=0.4 * v + 0.125 * swing(i, 128)),
                    state=int(State.TRACKING if i else State.DISARMED),
                    request=request if i == 10 else None,
                    answer=int(Answer.TAKEN),
                ),
            )
        )
    return records


def ended(state: State, present: int = 0, latched: int = 0) -> list[Record]:
    """The same, and then something else."""
    *before, last = tracking(6_000)
    t_ns = last.tick.t_ns
    command = last.tick.command._replace(voltage_v=0.0)
    age_ns = 80_000_000 if present & bits(F.VALVE_MISSING) else 0
    m = last.tick.measurement._replace(pressure_age_ns=age_ns, valve_age_ns=age_ns)
    tick = last.tick._replace(
        measurement=m, state=int(state), present=present, latched=latched, command=command
    )
    return [
        *before,
        *(last._replace(tick=tick._replace(t_ns=t_ns + i * 10_000_000)) for i in range(1, 100)),
    ]


def show(records: list[Record], info: ScreenInfo = FULL, keys: str = "") -> Show:
    """A show of them."""
    polls = iter([records])
    found = Show(
        lambda: next(polls, []),
        info,
        lambda: False,
        log_counts=lambda: (12_345, 0, 0),
        operator=Asked(),
        leaving=Leaving("end"),
        clock=lambda: 1.0,
    )
    for key in keys:
        found.hands.press(key)
    found.attend()
    return found


def text_of(found: Show, size: tuple[int, int], ascii_only: bool = False) -> str:
    return "\n".join("".join(s.text for s in row) for row in found.picture(size, ascii_only))


def ansi_of(found: Show, size: tuple[int, int]) -> str:
    """With its colours, whose codes can be read."""
    palette.cache_clear()  # styles keep the codes of the first terminal that they were drawn for
    out = io.StringIO()
    console = Console(file=out, width=size[0], force_terminal=True, color_system="256", no_color=False)
    console.print(Page(found.snapshot, found.history, size, ascii_only=False), end="", crop=False)
    return out.getvalue().replace("\x1b", "␛")


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
def test_sizes(size: tuple[int, int]) -> None:
    assert_same(f"tracking-{size[0]}x{size[1]}", text_of(show(tracking()), size))


def bits(*faults: F) -> int:
    return sum(1 << fault for fault in faults)


SUPPLY = bits(F.SUPPLY_PRESSURE, F.CHAMBER_PRESSURE)


@pytest.mark.parametrize(
    ("name", "records", "keys"),
    [
        ("fault", lambda: ended(State.FAULT, SUPPLY, SUPPLY), ""),
        ("fault-over", lambda: ended(State.FAULT, 0, SUPPLY), ""),
        ("nobody", lambda: ended(State.WAITING, bits(*ALONE)), ""),
        ("disarmed", lambda: ended(State.DISARMED), ""),
        ("asking", lambda: ended(State.DISARMED), "a"),
        ("going", lambda: ended(State.HOLDING), "g12"),
        ("help", tracking, "?"),
    ],
)
def test_what_happens(name: str, records: Callable[[], list[Record]], keys: str) -> None:
    assert_same(name, text_of(show(records(), keys=keys), (80, 24)))


def test_letters_alone() -> None:
    text = text_of(show(tracking()), (80, 24), ascii_only=True)
    assert text.isascii()
    assert_same("ascii", text)


def test_dark_and_light_terminals() -> None:
    found = show(tracking())
    assert_same("dark", ansi_of(found, (80, 24)))
    found.hands.press("l")
    found.attend()
    assert_same("light", ansi_of(found, (80, 24)))


def test_a_terminal_that_says_it_is_light_gets_light_colours(monkeypatch: pytest.MonkeyPatch) -> None:
    for said, light in (
        ("0;15", True),
        ("15;0", False),
        ("15;default;0", False),
        ("7;8", False),
        ("", False),
    ):
        monkeypatch.setenv("COLORFGBG", said)
        assert show([]).snapshot.typed.light == light, said


def test_one_line_for_a_dumb_terminal() -> None:
    lines = [show(tracking()), show(ended(State.FAULT, SUPPLY, SUPPLY))]
    assert_same("dumb", "\n".join(status_line(found.snapshot, found.history) for found in lines))


@pytest.mark.parametrize("no_color", [False, True])
def test_textual_shows_the_page_and_takes_keys(monkeypatch: pytest.MonkeyPatch, no_color: bool) -> None:
    if no_color:
        monkeypatch.setenv("NO_COLOR", "1")
    found = show(tracking())

    async def use() -> None:
        app = ScreenApp(found, ascii_only=False)
        async with app.run_test(size=(80, 24)) as pilot:
            await pilot.pause()
            shown = "\n".join(app.picture.render_line(y).text for y in range(24))
            assert shown == text_of(found, (80, 24))
            assert "follows the reference" in shown
            picture = app.export_screenshot()
            assert "follows" in picture
            await pilot.press("question_mark")
            await pilot.pause()
            assert "keys" in app.picture.render_line(3).text
            await pilot.press("space", "a", "y", "left", "q")
        assert app.return_code == 0

    asyncio.run(use())
    operator = found.hands._operator
    assert isinstance(operator, Asked)
    assert [verb for verb, _ in operator.verbs] == ["stop", "jog"]  # the help took a key
    assert found.hands.over
