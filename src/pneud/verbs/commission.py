"""Test what is connected to what, with small bounded openings of the valve, and keep what came of it.

The running daemon is asked for one probe after another; with `--virtual` it is the software rig, in simulated
time, which is no proof.
"""

from __future__ import annotations

import json as json_
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from pneud.config import conversions
from pneud.config.proof import digest, keep
from pneud.console.client import Client, RefusedError
from pneud.loading import Loaded, load
from pneud.log.live.ring import Ring
from pneud.replay.lockstep import Simulation, backend_of
from pneud.signals import RequestKind, State
from pneud.study.commissioning.movement import CURES, MOVE_M, SPEED_M_S, Verdict
from pneud.study.commissioning.testing import LEASE_S, MovementTest
from pneud.verbs import ConfigOption, JsonOption, SeedOption, SocketOption, VerbError

LONGEST_S = 180.0  # of axis time
LOOK_S = 0.01


def commission(
    config_file: ConfigOption = None,
    virtual: Annotated[
        bool, typer.Option("--virtual", help="The software rig, in simulated time; it proves nothing.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Write no proof.")] = False,
    seed: SeedOption = 0,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> int:
    """Open the valve a little both ways, and say what is wrong.

    Returns:
        Exit status: 0 where the test is passed, 1 where not, or where the daemon refused.

    Raises:
        ConfigError: the configuration cannot be used.
        DatabaseError: the DBC cannot be used.
        BuildError: the compiled law is required and cannot be had.
        PlaceError: no daemon to talk to.
        VerbError: nobody agrees, the axis is not at rest, or the proof cannot be kept.
    """
    if virtual:
        loaded = load(config_file or "virtual.toml")
        return _tell(_simulated(loaded, seed), None, json)
    with Client(socket) as client:
        status = client.ask("status")
        if status["state"] != State.DISARMED.label or status["config_changed"]:
            found = "its file has changed" if status["config_changed"] else f"the axis is {status['state']}"
            raise VerbError(f"commission: {found}; it has to be disarmed, and to run what its file says", 1)
        loaded = load(status["config"])
        if config_file is not None and load(config_file).text != loaded.text:
            raise VerbError(f"commission: the daemon runs {status['config']}, another configuration")
        _agreed(yes)
        try:
            verdict = _on_the_rig(client, loaded)
        except RefusedError as e:
            raise VerbError(f"commission: {e}", 1) from None
    proof = None if dry_run or verdict.unfinished else _kept(loaded, verdict, status)
    return _tell(verdict, proof, json)


def _agreed(yes: bool) -> None:
    """Say what will move, and ask.

    Raises:
        VerbError: nobody agrees.
    """
    words = "the load is pushed both ways, and moves some"
    print(f"movement test: {words} {1e3 * MOVE_M:g} mm at {1e3 * SPEED_M_S:g} mm/s at most", file=sys.stderr)
    if not yes and not (sys.stdin.isatty() and typer.confirm("go on?", err=True)):
        raise VerbError("commission: nobody agreed; --yes does without")


def _simulated(loaded: Loaded, seed: int) -> Verdict:
    test = MovementTest(conversions.axis_of(loaded.config, loaded.codecs.command_lsb_v))
    for record in Simulation(loaded, LONGEST_S, seed, backend_of(loaded), operator=test.ask).records():
        test.see(record.tick)
    return _whole(test)


def _on_the_rig(client: Client, loaded: Loaded) -> Verdict:
    """The daemon's axis; whatever ends this, no probe outlives its lease."""
    test = MovementTest(conversions.axis_of(loaded.config, loaded.codecs.command_lsb_v))
    fields, descriptor = client.attach()
    if fields["layout"] != Ring.layout():
        raise VerbError("commission: the daemon is of another version")
    ring = Ring.attach(descriptor, fields["slots"], fields["slot_bytes"])
    reader = ring.reader()
    reader.poll()
    begun_ns = time.monotonic_ns()
    while test.verdict is None and not ring.closed and time.monotonic_ns() - begun_ns < LONGEST_S * 1e9:
        for record in reader.poll():
            tick = record.tick
            if tick.t_ns < begun_ns:
                continue
            test.see(tick)
            wanted = test.ask(tick.state, tick.present)
            if wanted is not None and wanted.kind == RequestKind.PROBE:
                _ask(client, wanted.values)
        time.sleep(LOOK_S)
    return _whole(test)


def _ask(client: Client, values: tuple[float, ...]) -> None:
    voltage_v, rate_v_s, travel_m, speed_m_s, force_n, _ = values
    bounds = {"travel_mm": 1e3 * travel_m, "speed_mm_s": 1e3 * speed_m_s, "force_n": force_n}
    try:
        client.ask("probe", voltage_v=voltage_v, rate_v_s=rate_v_s, **bounds, lease_s=LEASE_S)
    except RefusedError as e:
        if e.kind != "wrong_state":  # it may have ended while it was renewed
            raise


def _whole(test: MovementTest) -> Verdict:
    if test.verdict is None:
        raise VerbError("commission: the movement test has not come to its end", 1)
    return test.verdict


def _kept(loaded: Loaded, verdict: Verdict, status: dict[str, Any]) -> Path:
    told = {
        "passed": verdict.passed,
        "findings": [str(f) for f in verdict.findings],
        "date": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "bus": status["bus"],
        "log": status["log"],
    }
    try:
        return keep(loaded.path, digest(loaded.config, loaded.dbc.read_bytes()), told)
    except OSError as e:
        raise VerbError(f"commission: the proof cannot be kept: {e.strerror}: {e.filename}", 3) from None


def _tell(verdict: Verdict, proof: Path | None, json: bool) -> int:
    words = "passed" if verdict.passed else "failed"
    findings = [{"name": str(f), "cure": CURES[f]} for f in verdict.findings]
    if json:
        kept = None if proof is None else str(proof)
        found = {"schema": 1, "verdict": words, "findings": findings, "faults": list(verdict.faults)}
        print(json_.dumps({**found, "proof": kept}))
    else:
        lines = [f"movement test: {words}", *(f"{f['name']}: {f['cure']}" for f in findings)]
        lines += [f"faults: {', '.join(verdict.faults)}"] if verdict.faults else []
        lines += [f"kept in {proof}"] if proof is not None else []
        print("\n".join(lines))
    return 0 if verdict.passed else 1
