"""Programs in rounds: in simulated time by the thousand, over a daemon by the hundred.

    python -m hil.programs                      # one axis and two, 1,000 rounds each, simulated
    python -m hil.programs --real --cycles 100  # over daemons on unixcan, for a quiet machine
    python -m hil.programs --real --axes 2 --log logs  # those of two axes; the logs stay

Each line says how many rounds there were, whether every record came in its turn and every load that was in
position was so by the truth, how much the rounds differ in time, and, where there is a log, whether its
replay is identical. Exit status 1 where one of these does not hold.

In real time a machine that others work on stalls now and then, the loop or the software rig: ticks are
skipped, or come late by more than half a period, or without a position. Rounds in which three ticks in a row
are such, of any of the axes, are counted, and told apart: it is the others that may differ by no more than
2 ms, at least half of them all.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from pneud.config.conversions import plant_of
from pneud.console import programs
from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import PlaceError
from pneud.console.going import Sharing, go_through
from pneud.loading import Together, load_axes
from pneud.log.files.reader import read_log
from pneud.replay.dry_run import dry_run, dry_run_together
from pneud.replay.programming import Passing
from pneud.signals import Record
from pneud.view.progress import silent

FOLDER = Path(__file__).parent.parent / "examples" / "programs"
FORMS = (("pick-and-place.toml", "virtual.toml"), ("two-axes-pick-and-place.toml", "two-axes.toml"))
SPREAD_S = 2e-3
STALL_TICKS = 3  # in a row
PATIENCE_S = 60.0
MOST_TOLD = 10  # of what was wrong
PNEUD = (sys.executable, "-m", "pneud.cli")


class Rounds(NamedTuple):
    """What the rounds of an axis came to."""

    axis: str
    rounds: int
    wrong: int
    stalled: int  # of these, in which the machine did
    spread_s: float  # of the others
    whole_s: float  # of all
    round_s: float
    identical: bool | None  # None where there was no log

    @property
    def good(self) -> bool:
        """All holds."""
        enough = 2 * self.stalled <= self.rounds
        even = (self.spread_s if enough else self.whole_s) <= SPREAD_S + 1e-9
        return not self.wrong and even and self.identical is not False

    def in_words(self) -> str:
        """A line."""
        replay = {None: "", True: ", replay identical", False: ", replay differs"}[self.identical]
        stalls = f" ({1e3 * self.whole_s:.1f} ms with {self.stalled} stalled)" if self.stalled else ""
        return (
            f"{self.axis}: {self.rounds} rounds of {self.round_s:.3f} s,"
            f" spread {1e3 * self.spread_s:.1f} ms{stalls}, {self.wrong} wrong{replay}"
        )


def simulated(name: str, config: str, cycles: int, seed: int, folder: Path | None) -> Iterator[Rounds]:
    """Rounds in simulated time; with a folder for logs, they are replayed."""
    axes = load_axes(config)
    found = programs.compiled(
        programs.tree_of(FOLDER / name), [programs.facts_of(axis.config) for axis in axes]
    )
    if len(axes) == 1:
        each = {axes[0].config.name: dry_run(axes[0], found, 1, cycles, seed, folder, silent)}
    else:
        each = dry_run_together(axes, found, 1, cycles, seed, folder, silent)
    for axis, ran in each.items():
        s = ran.summary
        cycle = s["cycle_s"] or {"least": s["took_s"] or 0.0, "most": s["took_s"] or 0.0}
        lost = not s["ended"] or s["cycles"] != cycles
        spread_s = cycle["most"] - cycle["least"]
        same = identical(Path(s["log"])) if s["log"] else None
        wrong = len(s["wrong"]) + lost
        yield Rounds(axis, s["cycles"], wrong, 0, spread_s, spread_s, cycle["most"], same)


def identical(log: Path) -> bool:
    """Whether a replay is."""
    done = subprocess.run([*PNEUD, "replay", str(log), "--json"], capture_output=True, text=True, check=False)
    return bool(json.loads(done.stdout or "{}").get("identical"))


@contextmanager
def daemon(config: str, folder: Path) -> Iterator[Client]:
    """A daemon on a virtual bus, which tracks."""
    socket = folder / "console.sock"
    words = [*PNEUD, "--virtual", "--config", config, "--headless", "--log", str(folder / "logs"), "--socket"]
    with subprocess.Popen([*words, str(socket)], stdout=subprocess.DEVNULL) as process:
        try:
            with _connected(str(socket), process) as client:
                yield client
        finally:
            process.terminate()


@contextmanager
def _connected(socket: str, process: subprocess.Popen[bytes]) -> Iterator[Client]:
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s and process.poll() is None:
        try:
            with Client(socket) as client:
                while any(one["state"] != "tracking" for one in _each(client)):
                    time.sleep(0.1)
                yield client
                return
        except PlaceError:
            time.sleep(0.1)
    raise SystemExit("the daemon does not come to track")


def _each(client: Client) -> list[dict[str, Any]]:
    status = client.ask("status")
    return list(status["axes"].values()) if "axes" in status else [status]


@contextmanager
def _place(kept: Path | None, name: str) -> Iterator[Path]:
    """A folder for a run: a temporary one, or one of its own in that for logs."""
    if kept is None:
        with tempfile.TemporaryDirectory(prefix="pneud-") as place:
            yield Path(place)
    else:
        kept.mkdir(parents=True, exist_ok=True)
        yield Path(tempfile.mkdtemp(prefix=f"{Path(name).stem}-", dir=kept))


def real(name: str, config: str, cycles: int, kept: Path | None) -> Iterator[Rounds]:
    """Rounds over a daemon; what they came to is read from its logs."""
    axes = load_axes(config)
    tree = programs.tree_of(FOLDER / name)
    found = programs.compiled(tree, [programs.facts_of(axis.config) for axis in axes])
    with _place(kept, name) as folder:
        (folder / "logs").mkdir()
        with daemon(config, folder) as client:
            reply = client.ask("run", program=tree, cycles=cycles)
            told = Sharing(client, reply["axes"]) if "axes" in reply else client
            try:
                go_through(told, reply["order"], name, lambda _: None)
            except RefusedError as e:
                print(f"pneud: {e}", file=sys.stderr)
        yield from read(axes, found, folder / "logs", cycles)


def apart(times_s: list[float]) -> float:
    """By how much they differ."""
    return max(times_s, default=0.0) - min(times_s, default=0.0)


def stalls(record: Record, period_ns: int) -> bool:
    """Whether a tick is one of a machine that has stalled."""
    m, late_ns = record.tick.measurement, record.timing.lateness_ns
    return m.skipped > 0 or m.encoder_age_ns > 0 or m.pressure_age_ns > 0 or 2 * late_ns > period_ns


def read(axes: Together, found: programs.Compiled, logs: Path, cycles: int) -> Iterator[Rounds]:
    """What is in the logs of a run; a round in which one axis has stalled is such a one of all."""
    heard, stalled = [], set[int]()
    for axis, steps in zip(axes, found.steps, strict=True):
        (log,) = logs.glob("*.mcap") if len(axes) == 1 else logs.glob(f"{axis.config.name}-*.mcap")
        passing = Passing(steps, plant_of(axis.config).encoder_resolution_m)
        ended, in_a_row = False, 0
        period_ns = round(1e9 / axis.config.loop.rate_hz)
        for tick in read_log(log):
            passing.see(tick.record)
            ended = ended or tick.progress.lap >= cycles
            in_a_row = in_a_row + 1 if stalls(tick.record, period_ns) else 0
            if in_a_row >= STALL_TICKS:
                stalled.add(tick.progress.lap)
        heard.append((axis.config.name, log, passing, ended))
    for name, log, passing, ended in heard:
        for words in passing.wrong[:MOST_TOLD]:
            print(f"{name}: {words}", file=sys.stderr, flush=True)
        done = len({one.lap for one in passing.passed})
        wrong = len(passing.wrong) + (not ended or done != cycles)
        rounds_s = passing.rounds_s() or [0.0]
        # of the first round nobody knows when it would have begun
        even_s = [s for lap, s in enumerate(rounds_s, 1) if lap not in stalled]
        yield Rounds(
            name, done, wrong, len(rounds_s) - len(even_s), apart(even_s), apart(rounds_s),
            max(rounds_s), identical(log),
        )  # fmt: skip


def main() -> int:
    """Run them all.

    Returns:
        Exit status: 0 where all holds.
    """
    parser = argparse.ArgumentParser(prog="python -m hil.programs", description=__doc__)
    parser.add_argument("--real", action="store_true", help="over daemons, in real time")
    parser.add_argument("--cycles", type=int, default=None, help="rounds; default 1,000, or 100 in real time")
    parser.add_argument("--seed", type=int, default=0, help="of the noise, simulated")
    parser.add_argument(
        "--log", type=Path, default=None, help="a folder for logs; simulated, they are replayed then"
    )
    parser.add_argument("--axes", type=int, choices=(1, 2), default=None, help="of the program; default both")
    asked = parser.parse_args()
    good = True
    for name, config in FORMS if asked.axes is None else FORMS[asked.axes - 1 : asked.axes]:
        if asked.real:
            rounds = real(name, config, 100 if asked.cycles is None else asked.cycles, asked.log)
        else:
            cycles = 1000 if asked.cycles is None else asked.cycles
            rounds = simulated(name, config, cycles, asked.seed, asked.log)
        for one in rounds:
            print(f"{name}: {one.in_words()}", flush=True)
            good = good and one.good
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
