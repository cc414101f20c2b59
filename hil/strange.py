"""Rigs that are not as the controller believes: it learns, moves, creeps and rests; a table, worst first.

    python -m hil.strange                              # virtual.toml on its derived truth, on the second rig
    python -m hil.strange --config axis.toml --plant axis-truth.toml
    python -m hil.strange --config cyl25x200.toml --plant second --size cyl25x200 --seed 3 --json
    python -m hil.strange --rigs folder --runs 2       # each NAME.toml there on its NAME-truth.toml, twice

Real time, daemon and plant as processes of their own on a `unixcan` channel in a temporary folder. `truth` is
a plant that differs from the configuration in everything at once (`FACTORS`), `second` is `hil.second_rig`;
anything else is a plant's configuration. The axis is armed, tracks the configured reference for a while, goes
forth and back by 1 and 10 mm, creeps at 20 mm/s through the middle and rests. Errors are those against the
true position where the plant tells it, else against the encoder. Exit status: 0 where every goal is met, 1
else.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from hil.second_rig import SIZES
from numpy.typing import NDArray

from pneud.bus.codec import DatabaseError
from pneud.config.flow import area_of
from pneud.config.models import Config
from pneud.config.sections import ConfigError
from pneud.console.client import Client, RefusedError
from pneud.console.endpoint import PlaceError
from pneud.loading import Loaded, load
from pneud.log.files.columns import blocks
from pneud.log.files.reader import read_log
from pneud.safety.faults import names
from pneud.signals import Answer, RequestKind, Source, State

Floats = NDArray[np.float64]

PNEUD = [sys.executable, "-m", "pneud.cli"]
MOVES_MM = (1.0, 1.0, -1.0, -1.0, 10.0, -10.0, -10.0, 10.0, -1.0, 1.0, 10.0, 1.0, -1.0, -10.0)
MOVE_S, JOIN_S = 1.5, 1.2  # with what follows it
CREEP_M_S, CREEP_S = 0.02, 1.5
STANDING_M_S, SLOW_TICKS = 0.001, 10  # slower over so many ticks, the load stands
BREAKAWAY_S = 0.25  # of constant speed, in which a load may get going
SETTLED_S = 1.0  # from which on it rests
PATIENCE_S = 60.0
TIMEOUT_MS = 250.0  # of nodes and controller: a shared machine stalls now and then, and that is not the point
GOALS_MM = {"moves": 0.5, "overshoot": 0.3, "rest": 0.05, "creep": 0.1}
TRUTH, SECOND = "truth", "second"
FACTORS = {
    "flow": 0.8,
    "mass": 1.2,
    "friction": 1.3,
    "dead zone": 1.5,
    "dead length": 1.5,
    "valve": 0.7,
    "bristles": 5.6,
}

PATIENT = {
    "bus": {f"{who}_timeout_ms": TIMEOUT_MS for who in ("sensor", "valve", "deadline")},
}  # what the axis's configuration says differently


def truth_of(c: Config) -> dict[str, Any]:
    """What a plant's configuration says differently where nothing is as the controller believes."""
    f, k, v = c.plant.friction, FACTORS, c.plant.valve
    longer_m = (k["dead length"] - 1.0) * c.cylinder.dead_length_1_m
    friction = {key: k["friction"] * getattr(f, key) for key in ("coulomb_n", "static_n", "viscous_n_s_m")}
    friction["bristle_stiffness_n_m"] = k["bristles"] * f.bristle_stiffness_n_m
    return PATIENT | {
        "cylinder": {
            "moving_mass_kg": k["mass"] * c.cylinder.moving_mass_kg,
            "dead_length_1_m": k["dead length"] * c.cylinder.dead_length_1_m,
            "dead_length_2_m": k["dead length"] * c.cylinder.dead_length_2_m,
        },
        "valve": {"orifice_area_m2": k["flow"] * area_of(c)},
        "plant": {
            "initial_x1_m": c.plant.initial_x1_m + longer_m,
            "valve": {
                "bandwidth_hz": k["valve"] * v.bandwidth_hz,
                "dead_zone_v": k["dead zone"] * v.dead_zone_v,
            },
            "friction": friction,
        },
    }


class Leg(NamedTuple):
    """A way that is asked for, and how long it and what follows take."""

    name: str
    to_mm: float
    lasts_s: float
    speed_mm_s: float | None = None


def legs(c: Config, moves: int, rest_s: float) -> list[Leg]:
    """The ways after tracking, from the middle of the travel."""
    middle = 500.0 * (c.limits.travel_min_m + c.limits.travel_max_m)
    half = 500.0 * CREEP_M_S * CREEP_S
    found, at = [Leg("join", middle, JOIN_S)], middle
    for move in MOVES_MM[:moves]:
        at += move
        found.append(Leg(f"{move:+g} mm", at, MOVE_S))
    return [
        *found,
        Leg("join", middle - half, JOIN_S),
        Leg("creep", middle + half, CREEP_S + 1.0, 1e3 * CREEP_M_S),
        Leg("creep", middle - half, CREEP_S + 1.0, 1e3 * CREEP_M_S),
        Leg("rest", middle, rest_s + SETTLED_S),
    ]


class Run(NamedTuple):
    """What a run has left."""

    log: Path
    truth: Path
    legs: list[Leg]
    trouble: str  # why it was cut short
    host: dict[str, Any]  # what the machine cost: ticks, those skipped, lateness, frames that came late


@contextlib.contextmanager
def process(command: list[str], folder: Path, says: str) -> Iterator[subprocess.Popen[bytes]]:
    """A process whose words go to a file, and which is ended whatever happens."""
    runtime = os.environ | {"XDG_RUNTIME_DIR": str(folder)}
    runtime.pop("RUNTIME_DIRECTORY", None)
    with (folder / says).open("wb") as words:
        child = subprocess.Popen(command, stdout=words, stderr=words, env=runtime)
    try:
        yield child
    finally:
        child.terminate()
        try:
            child.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()


def asked(socket: Path, verb: str, state: str, **fields: Any) -> None:
    """Ask until it is done, and wait for a state.

    Raises:
        TimeoutError: it never came; the text says what was said last.
    """
    deadline, why, done = time.monotonic() + PATIENCE_S, "", False
    while time.monotonic() < deadline:
        try:
            with Client(str(socket)) as client:
                if not done:
                    client.ask(verb, **fields)
                    done = True
                why = str(client.ask("status")["state"])
            if why == state:
                return
            if why == "fault":
                break
        except (PlaceError, RefusedError) as e:
            why = str(e)
        time.sleep(0.1)
    raise TimeoutError(f"{verb}: {why}")


def driven(socket: Path, ways: list[Leg], learn_s: float) -> str:
    """Let the axis go its ways; why it could not, or nothing."""
    try:
        asked(socket, "status", "disarmed")
        asked(socket, "arm", "holding")
        asked(socket, "track", "tracking", what="reference")
        time.sleep(learn_s)
        for leg in ways:
            speed = {} if leg.speed_mm_s is None else {"speed_mm_s": leg.speed_mm_s}
            with Client(str(socket)) as client:
                client.ask("goto", x_mm=leg.to_mm, **speed)
            time.sleep(leg.lasts_s)
        asked(socket, "disarm", "disarmed")
    except (TimeoutError, PlaceError, RefusedError) as e:
        return str(e)
    return ""


def run(plant: list[str], loaded: Loaded, given: argparse.Namespace, folder: Path) -> Run:
    """A run of the daemon with a plant."""
    bus, axis = ["--bus", "unixcan:strange"], folder / "axis.toml"
    shutil.copy(loaded.dbc, folder / loaded.config.bus.dbc)
    axis.write_text(loaded.text)
    socket, log = folder / "s", folder / "run.mcap"
    daemon = [*PNEUD, "--config", str(axis), *bus, "--headless", "--json"]
    ways = legs(loaded.config, given.moves, 0.5 * given.seconds)
    with (
        process([*plant, *bus], folder, "plant.txt"),
        process([*daemon, "--socket", str(socket), "--log", str(log)], folder, "daemon.txt"),
    ):
        trouble = driven(socket, ways, given.seconds)
    said = (folder / "daemon.txt").read_text().splitlines()
    told = json.loads(said[-1]) if said and said[-1].startswith("{") else {}
    host = {key: told.get(key) for key in ("ticks", "skipped", "lateness_us")}
    return Run(log, folder / "truth", ways, trouble, host | {"late": told.get("frames", {}).get("late")})


class Course(NamedTuple):
    """A log as columns; lengths in mm."""

    t_s: Floats
    state: NDArray[Any]
    target: Floats  # of the reference
    speed: Floats  # [mm/s]
    x: Floats
    u: Floats  # [V]
    latched: int
    gotos: list[int]  # where those that were taken begin

    def error(self, begin: int, end: int) -> Floats:
        """Reference minus position where both are known."""
        error = self.target[begin:end] - self.x[begin:end]
        return error[np.isfinite(error)]

    def ended(self, begin: int, end: int) -> int:
        """From where on the reference stands still."""
        moving = np.flatnonzero(np.abs(self.speed[begin:end]) > 0.0)  # no reference: not so
        return begin + (int(moving[-1]) + 1 if moving.size else 0)


NOTHING = Course(*(6 * (np.empty(0),)), latched=0, gotos=[])


def course(left: Run) -> Course:
    """What the log says, with the true positions where there are any; nothing, where it has no tick."""
    if not left.log.exists():
        return NOTHING
    fields = ("reference.position_m", "reference.velocity_m_s", "measurement.position_m", "command.voltage_v")
    reals: dict[str, list[Floats]] = {name: [] for name in fields}
    whole: dict[str, list[NDArray[Any]]] = {
        n: [] for n in ("t_ns", "state", "measurement.encoder_offset_ns", "measurement.fresh")
    }
    gotos, count, bits = [], 0, 0
    for block in blocks(read_log(left.log)):
        for first, words in block.faults("latched"):
            bits |= int(np.bitwise_or.reduce(words, initial=0)) << first
        for name, parts in reals.items():
            parts.append(block.real(name))
        for name, many in whole.items():
            many.append(np.asarray(block.ticks[name]).astype(np.int64))
        gotos += [
            count + i
            for i, request in block.requests
            if request.kind == RequestKind.GOTO and block.ticks["answer"][i] == Answer.TAKEN
        ]
        count += len(block.number)
    if not count:
        return NOTHING
    target, speed, x, u = (np.concatenate(reals[name]) for name in fields)
    t_ns, state, offset_ns, fresh = (np.concatenate(many) for many in whole.values())
    x = np.where(fresh & Source.ENCODER, x, math.nan)
    if left.truth.exists():
        at, true = np.fromfile(left.truth).reshape(-1, 2).T
        x = np.interp((t_ns + offset_ns) - at[0], at - at[0], true)
    return Course(1e-9 * (t_ns - t_ns[0]), state, 1e3 * target, 1e3 * speed, 1e3 * x, u, bits, gotos)


def moved(c: Course, leg: Leg, begin: int, end: int, band: float) -> dict[str, Any]:
    """How a move went: error, overshoot [mm]; from the reference's end until it stays within the band [s]."""
    ended = c.ended(begin, end)
    way = leg.to_mm - c.target[max(begin - 1, 0)]
    beyond = _most(math.copysign(1.0, way) * (c.x[begin:end] - leg.to_mm))
    outside = np.flatnonzero(np.abs(c.x[ended:end] - leg.to_mm) > band)
    settled = float(c.t_s[ended + outside[-1]] - c.t_s[ended]) if outside.size else 0.0
    return {
        "move": leg.name,
        "max_error_mm": _most(np.abs(c.error(begin, end))),
        "overshoot_mm": None if beyond is None else max(0.0, beyond),
        "settled_s": None if outside.size and ended + outside[-1] >= end - 2 else settled,
    }


def crept(c: Course, begin: int, end: int) -> dict[str, Any]:
    """The error's range [mm] at constant speed, once the load has got going and from the start.

    Then how it swings [Hz], and the share of time in which the load stands: where none, it does not stick.
    """
    constant = np.flatnonzero(np.abs(np.abs(c.speed[begin:end]) - 1e3 * CREEP_M_S) < 0.01) + begin
    first, last = (int(constant[0]), int(constant[-1]) + 1) if constant.size else (begin, begin)
    going = first + int(np.searchsorted(c.t_s[first:last], c.t_s[first] + BREAKAWAY_S))
    error = c.error(going, last)
    if error.size < SLOW_TICKS + 2:
        return dict.fromkeys(("peak_to_peak_mm", "with_breakaway_mm", "swing_hz", "standing"))
    swing = np.abs(np.fft.rfft((error - error.mean()) * np.hanning(error.size)))
    period_s = float(c.t_s[last - 1] - c.t_s[going]) / (last - 1 - going)
    way = np.abs(c.x[going + SLOW_TICKS : last] - c.x[going : last - SLOW_TICKS])
    slow = way < STANDING_M_S * 1e3 * SLOW_TICKS * period_s
    return {
        "peak_to_peak_mm": float(np.ptp(error)),
        "with_breakaway_mm": float(np.ptp(c.error(first, last))),
        "swing_hz": float((1 + np.argmax(swing[1:])) / (error.size * period_s)),
        "standing": float(np.mean(slow)),
    }


def rested(c: Course, begin: int, end: int) -> dict[str, Any]:
    """Error at rest [mm] and mean step of the command [V], from `SETTLED_S` after the way's end."""
    ended = c.ended(begin, end)
    still = ended + int(np.searchsorted(c.t_s[ended:end], c.t_s[ended] + SETTLED_S))
    held = still + int(np.argmin(np.append(c.state[still:end] == State.HOLDING, False)))
    return {
        "error_mm": _most(np.abs(c.error(still, held))),
        "mean_step_v": float(np.mean(np.abs(np.diff(c.u[still:held])))) if held > still + 1 else None,
    }


def tracked(c: Course, begin_s: float, end_s: float) -> dict[str, Any]:
    """RMS and greatest error [mm] between two times."""
    begin, end = np.searchsorted(c.t_s, (begin_s, end_s))
    error = c.error(int(begin), int(end))
    return {
        "rms_mm": float(np.sqrt(np.mean(error * error))) if error.size else None,
        "max_mm": _most(np.abs(error)),
    }


def _most(values: Floats) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.max()) if known.size else None


def judged(c: Course, left: Run, config: Config, name: str) -> dict[str, Any]:
    """What a run came to, and which goals it met; what is not known of a leg misses its goal."""
    band = max(0.02, 2e3 * config.control.motion.encoder_resolution_m)
    spans = list(zip(left.legs, c.gotos, [*c.gotos[1:], len(c.t_s)], strict=False))
    period_s = 1.0 / config.reference.frequency_hz if config.reference.frequency_hz > 0.0 else 1.0
    tracking = np.flatnonzero(c.state == State.TRACKING)
    first_s, last_s = (float(c.t_s[tracking[i]]) if tracking.size else math.nan for i in (0, -1))
    found: dict[str, Any] = {
        "case": name,
        "against": "truth" if left.truth.exists() else "encoder",
        "sine_before": tracked(c, first_s + 1.0, first_s + 1.0 + period_s),
        "sine_after": tracked(c, last_s - 2.0 * period_s, last_s),
        "moves": [moved(c, leg, i, j, band) for leg, i, j in spans if leg.name.endswith("mm")],
        "creep": [crept(c, i, j) for leg, i, j in spans if leg.name == "creep"],
        "rest": next((rested(c, i, j) for leg, i, j in spans if leg.name == "rest"), {}),
        "faults": names(c.latched),
        "trouble": left.trouble,
        "host": left.host,
    }
    values: dict[str, list[float | None]] = {
        "moves": [move["max_error_mm"] for move in found["moves"]],
        "overshoot": [move["overshoot_mm"] for move in found["moves"]],
        "creep": [creep["peak_to_peak_mm"] for creep in found["creep"]],
        "rest": [found["rest"].get("error_mm")],
    }
    moves, creeps = (
        sum(leg.name.endswith(ending) for leg in left.legs) for ending in ("mm", "creep")
    )  # that were to be made
    wanted = {"moves": moves, "overshoot": moves, "rest": 1, "creep": creeps}
    goals = []
    for what, limit in GOALS_MM.items():
        known = [value for value in values[what] if value is not None]
        worst = max(known, default=None)
        goals.append({
            "case": name, "what": what, "worst_mm": worst, "limit_mm": limit,
            "met": worst is not None and worst <= limit and len(known) == wanted[what],
        })  # fmt: skip
    found["goals"] = goals
    found["met"] = all(goal["met"] for goal in goals) and not found["faults"] and not left.trouble
    return found


def plant_of(which: str, config: Path, given: argparse.Namespace, folder: Path) -> tuple[str, list[str]]:
    """A plant's name and command."""
    if which == SECOND:
        size = given.size or (config.stem if config.stem in SIZES else "virtual")
        truth = ["--truth", str(folder / "truth")]
        draw = ["--size", size, "--seed", str(given.seed), "--timeout-ms", str(TIMEOUT_MS)]
        return f"second {size} {given.seed}", [sys.executable, "-m", "hil.second_rig", *truth, *draw]
    if which == TRUTH:
        of = load(given.truth_of or given.config)
        real = load(of.path, change=truth_of(of.config))
    else:
        real = load(which, change=PATIENT)
    path = folder / "truth.toml"
    path.write_text(real.text)
    shutil.copy(real.dbc, folder / real.config.bus.dbc)
    return which if which == TRUTH else real.path.stem, [*PNEUD, "plant", "--config", str(path)]


def case(loaded: Loaded, which: str, given: argparse.Namespace, again: str) -> dict[str, Any]:
    """A run of an axis on a plant, judged."""
    with tempfile.TemporaryDirectory(prefix="strange-") as temporary:
        folder = Path(temporary)
        plant, command = plant_of(which, loaded.path, given, folder)
        name = f"{loaded.path.stem}, {plant}{again}"
        left = run(command, loaded, given, folder)
        if given.keep:
            kept = given.keep / name.replace(",", "").replace(" ", "-")
            shutil.copytree(folder, kept, ignore=_sockets)
        return judged(course(left), left, loaded.config, name)


def words(cases: list[dict[str, Any]]) -> str:
    """The table that a person reads: goals, the worst first, then what each case came to."""

    def shown(value: float | None, form: str = ".3f") -> str:
        return "—" if value is None else format(value, form)

    goals = [goal for case in cases for goal in case["goals"]]
    missing = math.inf
    goals.sort(key=lambda g: -(missing if g["worst_mm"] is None else g["worst_mm"] / g["limit_mm"]))
    lines = [f"{'case':28} {'goal':10} {'worst mm':>9} {'limit':>6}"]
    for g in goals:
        mark = "" if g["met"] else "  missed"
        lines.append(f"{g['case']:28} {g['what']:10} {shown(g['worst_mm']):>9} {g['limit_mm']:>6}{mark}")
    for case in cases:
        before, after, rest = case["sine_before"], case["sine_after"], case["rest"]
        lines += [
            "",
            f"{case['case']} (against {case['against']})",
            f"  sine RMS/max: {shown(before['rms_mm'])}/{shown(before['max_mm'])} mm, after learning"
            f" {shown(after['rms_mm'])}/{shown(after['max_mm'])} mm",
            f"  rest: {shown(rest.get('error_mm'))} mm, mean step {shown(rest.get('mean_step_v'), '.4f')} V",
            f"  faults: {', '.join(case['faults']) or 'none'}{case['trouble'] and '; ' + case['trouble']}",
            f"  machine: {case['host']['skipped']} of {case['host']['ticks']} ticks skipped,"
            f" {case['host']['late']} frames late",
        ]
        lines += [
            f"  creep at 20 mm/s: {shown(creep['peak_to_peak_mm'])} mm peak to peak,"
            f" {shown(creep['swing_hz'], '.1f')} Hz,"
            f" standing {shown(creep['standing'], '.0%')} of the time; with the breakaway"
            f" {shown(creep['with_breakaway_mm'])} mm"
            for creep in case["creep"]
        ]
        for m in sorted(case["moves"], key=lambda m: -(m["max_error_mm"] or 0.0)):
            within = "never within" if m["settled_s"] is None else f"within after {m['settled_s']:.3f} s"
            lines.append(
                f"  {m['move']:>7}: error up to {shown(m['max_error_mm'])} mm,"
                f" overshoot {shown(m['overshoot_mm'])} mm, {within}"
            )
    return "\n".join(lines)


def pairs(given: argparse.Namespace) -> list[tuple[Path, str]]:
    """The axes' configurations, and the plant that each is to run on.

    Raises:
        ConfigError: there are none.
    """
    if given.rigs is None:
        return [(Path(given.config), which) for which in given.plant or (TRUTH, SECOND)]
    ending = f"-{TRUTH}.toml"
    truths = sorted(given.rigs.glob(f"*{ending}"))
    found = [(truth.with_name(truth.name.removesuffix(ending) + ".toml"), str(truth)) for truth in truths]
    if not found:
        raise ConfigError(f"{given.rigs}: no file is named NAME{ending}")
    for axis, truth in found:
        if not axis.exists():
            raise ConfigError(f"{truth}: the axis that is to run on it, {axis.name}, is not beside it")
    return found


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description="The axis on rigs that are not as it believes.")
    one = parser.add_mutually_exclusive_group()
    one.add_argument("--config", default="virtual.toml", help="of the axis")
    one.add_argument(
        "--rigs",
        type=Path,
        metavar="FOLDER",
        help="each NAME.toml there that has a NAME-truth.toml beside it, on that",
    )
    parser.add_argument("--plant", action="append", help="truth, second, or a plant's configuration")
    parser.add_argument("--runs", type=int, default=1, help="of each pair, about a minute each")
    parser.add_argument(
        "--truth-of", metavar="FILE", help="configuration that truth is made of, if not the axis's"
    )
    parser.add_argument("--size", choices=SIZES, help="of the second rig, if not named as the configuration")
    parser.add_argument("--seed", type=int, default=1, help="of the second rig")
    parser.add_argument("--seconds", type=float, default=20.0, help="of tracking; half as many of rest")
    parser.add_argument("--moves", type=int, default=len(MOVES_MM), help="how many of them")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="for logs and what the processes said")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    if given.rigs is not None and given.plant:
        parser.error("--rigs names the plants, too: leave --plant away")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # as an exception, so that everything is ended
    try:
        rigs = [(load(axis, change=PATIENT), which) for axis, which in pairs(given)]
        for _, which in rigs:
            if which not in (TRUTH, SECOND):
                load(which)  # what cannot be used is said before anything runs
    except (ConfigError, DatabaseError) as e:
        parser.error(str(e))
    cases = [
        case(loaded, which, given, f", run {n + 1}" if given.runs > 1 else "")
        for n in range(given.runs)
        for loaded, which in rigs
    ]
    met = all(case["met"] for case in cases)
    print(json.dumps({"schema": 1, "cases": cases, "met": met}) if given.json else words(cases))
    return 0 if met else 1


def _sockets(folder: str, entries: list[str]) -> list[str]:
    return [name for name in entries if Path(folder, name).is_socket() or name == "pneud"]


if __name__ == "__main__":
    sys.exit(main())
