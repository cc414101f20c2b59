"""Pictures of the live screen, made of simulated runs: `python -m generators.screens [FOLDER]` in `docs`.

Writes `screen.svg` and `pictures/screen-NAME.svg` into FOLDER, else into `docs`.
The page is the one that a terminal shows; only how late ticks are is made up, since simulated time has none.
"""

from __future__ import annotations

import io
import random
import sys
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.terminal_theme import DEFAULT_TERMINAL_THEME, DIMMED_MONOKAI, TerminalTheme

from generators.pictures import FORMAT
from pneud.compiled.backend import backend
from pneud.config import conversions
from pneud.console.facts import RunFacts
from pneud.loading import load
from pneud.replay.lockstep import Operator, Simulation
from pneud.safety.cause import first_cause
from pneud.scenario.files import load_scenario
from pneud.signals import Record, Request, RequestKind, State
from pneud.view.hands import Leaving
from pneud.view.info import ScreenInfo, info_of
from pneud.view.screen import Page
from pneud.view.show import Show

DOCS = Path(__file__).parent.parent
AXIS = "virtual.toml"
LOG = "/var/lib/pneud/virtual-20260301T091500Z.mcap"


class Scene(NamedTuple):
    """What one picture shows."""

    records: tuple[Record, ...]
    size: tuple[int, int] = (120, 40)
    keys: str = ""  # pressed
    light: bool = False
    silent_s: float = 0.0


class Nobody:
    """An operator whose console is not there."""

    look_only = False
    message = ""
    status: dict[str, object] = {}  # noqa: RUF012

    def ask(self, verb: str, **fields: object) -> None:
        """Nothing is done."""

    def attend(self, now_s: float) -> None:
        """Nothing comes."""


@cache
def run(duration_s: float = 14.0, scenario: str = "", goto_m: float = 0.0) -> tuple[Record, ...]:
    """A run in simulated time: tracks the reference, with faults, or goes somewhere."""
    loaded = load(AXIS)
    p = conversions.axis_of(loaded.config, loaded.codecs.command_lsb_v)
    how = backend(loaded.config.loop.compiled, p)
    faults = load_scenario(scenario) if scenario else None
    operator = _go(goto_m) if goto_m else None
    simulation = Simulation(loaded, duration_s, 1, how, scenario=faults, operator=operator)
    return tuple(_timed(simulation.records()))


def _go(goto_m: float) -> Operator:
    steps = iter((Request(RequestKind.ARM), Request(RequestKind.GOTO, (goto_m, 0.0, 0.0, 0.0))))

    def ask(state: int, present: int) -> Request | None:
        idle = state in (State.DISARMED, State.HOLDING) and not present
        return next(steps, None) if idle else None

    return ask


def _timed(records: Iterable[Record]) -> Iterator[Record]:
    """Ticks with how late they might have been."""
    chance = random.Random(1)
    for record in records:
        late_ns = round(14e3 * chance.lognormvariate(0.0, 0.35))
        timing = record.timing._replace(lateness_ns=late_ns, latency_ns=61_000 + late_ns)
        yield record._replace(timing=timing)


def info() -> ScreenInfo:
    """The axis's."""
    loaded = load(AXIS)
    facts = RunFacts(loaded.config, loaded.path, loaded.text, "socketcan:vcan0", "", LOG)
    return info_of(facts.page(), first_cause, "pneud top")


def drawn(scene: Scene, title: str) -> str:
    """A scene as SVG."""
    polls = iter([list(scene.records)])
    times = iter([0.0, scene.silent_s])
    show = Show(
        lambda: next(polls, []),
        info(),
        lambda: False,
        log_counts=lambda: (len(scene.records), 0, 0),
        operator=Nobody(),
        leaving=Leaving("end"),
        clock=lambda: next(times, scene.silent_s),
    )
    show.hands.light = scene.light
    for key in scene.keys:
        show.hands.press(key)
    show.attend()
    console = Console(
        record=True, width=scene.size[0], file=io.StringIO(), force_terminal=True, color_system="truecolor"
    )
    console.print(Page(show.snapshot, show.history, scene.size, ascii_only=False), crop=False)
    theme: TerminalTheme = DEFAULT_TERMINAL_THEME if scene.light else DIMMED_MONOKAI
    unique_id = f"pneud-{title.replace(' ', '-')}"
    return console.export_svg(title=title, theme=theme, unique_id=unique_id, code_format=FORMAT)


def scenes() -> dict[str, Scene]:
    """All of them by name."""
    tracking = run()[:14_000]  # before it is told to stop
    return {
        "tracking": Scene(tracking),
        "small": Scene(tracking, (80, 24)),
        "large": Scene(tracking, (200, 60)),
        "light": Scene(tracking, light=True),
        "moving": Scene(run(4.0, goto_m=0.7)[:2400]),
        "fault": Scene(run(8.0, "supply-lost")),
        "nobody": Scene(run(8.0, "all-silent")),
        "help": Scene(tracking, keys="?"),
    }


def write(docs: Path) -> list[Path]:
    """Write all pictures into a folder of documents: the first one beside the pages."""
    (docs / "pictures").mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    for name, scene in scenes().items():
        path = (
            docs / ("pictures" if written else "") / ("screen.svg" if not written else f"screen-{name}.svg")
        )
        path.write_text(drawn(scene, f"pneud {name}"), encoding="utf-8")
        written.append(path)
    return written


if __name__ == "__main__":
    write(Path(sys.argv[1]) if len(sys.argv) > 1 else DOCS)
