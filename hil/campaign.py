"""Plays the fault scenarios and judges what the axis did about them: a matrix as JSON and as an HTML page.

    .venv/bin/python hil/campaign.py --bus unixcan -o out    # every scenario that can be played there
    .venv/bin/python hil/campaign.py --bus unixcan --core    # the few that every change has to pass
    .venv/bin/python hil/campaign.py --bus sim               # in simulated time
    .venv/bin/python hil/campaign.py --bus sim --config my.toml   # on a rig of other devices
    hil/vm/run -t 900 -w out -- .venv/bin/python hil/campaign.py --bus vcan0 -o out

Exit status: 0 where everything came as expected, 1 where something did not.
"""

from __future__ import annotations

import argparse
import html
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from pneud import resources
from pneud.bus.link import open_link
from pneud.console.client import Client
from pneud.console.endpoint import PlaceError
from pneud.log.files.reader import LogReader
from pneud.report.frame import BAD, GOOD, Drawn, Section, Verdict, badge, document, strip, table
from pneud.scenario.files import load_scenario

PNEUD = [sys.executable, "-m", "pneud.cli"]
PATIENCE_S = 90.0
FLOOD = 20_000  # frames: several times as many as fit into the receive buffer
# played for every change: one of each way in which a fault is found, and what only processes can show
CORE = (
    "encoder-missing", "pressure-corrupt", "valve-frozen", "encoder-error", "valve-timed-out", "valve-reboot",
    "supply-lost", "piston-seized", "other-controller", "babble", "bus-off", "frames-lost-now-and-then",
    "set-late", "encoder-behind", "sync-skipped",
    "emcy", "unreachable", "no-realtime", "daemon-stands", "plant-stands", "recorder-stands",
    "console-killed", "recorder-killed", "log-full", "no-descriptors",
)  # fmt: skip
# what only a real interface and the rights over a machine show
CORE_VM = (
    "encoder-missing", "bus-off", "link-down", "link-deleted", "queue-full-for-long", "clock-step",
    "recorder-killed", "set-late",
)  # fmt: skip
SLOW = "vcan.toml"  # what a virtual machine with one slow CPU can carry
# what does not show there: its reference is slow, its law soft, and much may have happened between two ticks
TAKES_FAST_TICKS = frozenset((
    "braking-distance", "chamber-driven", "encoder-behind", "encoder-slip", "encoder-stuck",
    "force-disagrees", "overloaded", "pressure-jump", "saturated", "saturated-long", "unreachable",
    "valve-stuck-centred", "valve-stuck-open", "valve-stuck-reverse",
))  # fmt: skip
# where the valve hears nothing, it keeps its last voltage for its time-out, which is 200 ms there; with the
# 0.4 V that it takes to set a load in motion that sticks, it goes 110 mm
VALVE_DEAF = frozenset((
    "babble", "bus-off", "daemon-stands", "link-deleted", "link-down", "plant-stands", "queue-full-for-long",
    "send-blocked",
))  # fmt: skip
DEAF_TRAVEL_MM = 150.0
# of its reference, not of the way to it
AT_SLOW_PEAK = "when.velocity_above_m_s = 0.027\nwhen.velocity_below_m_s = 0.037"


class Case(dict[str, Any]):
    """One row of the matrix."""


def playable(name: str, bus: str) -> str:
    """Why a scenario cannot be played on a bus; empty if it can."""
    scenario = load_scenario(name)
    if bus == "sim":
        return "takes a real machine" if scenario.needs_machine else ""
    if bus.startswith("unixcan"):
        if scenario.needs_interface:
            return "takes a CAN interface of the kernel"
        if any(fault.kind == "clock_step" for fault in scenario.fault):
            return "sets the wall clock: only in the virtual machine"
    elif name in TAKES_FAST_TICKS:
        return "shows only at 1 kHz, which the virtual machine does not reach"
    elif name == "receive-overflow":
        return "the flood would come with SYNC, which a daemon that stands does not send; see overflow"
    elif name == "queue-full":
        return "is over before the virtual machine has begun with it"
    return ""


def slowed(name: str, folder: Path) -> str:
    """A scenario as a file for the slow configuration: its reference moves slowly, its ticks are long."""
    text = (resources.scenarios() / f"{name}.toml").read_text()
    text = re.sub(r"when\.velocity_above_m_s = .*", AT_SLOW_PEAK, text)
    text = re.sub(r"delay_periods = 0\.\d+", "delay_periods = 0.8", text)  # the answers come early in a tick
    # with more frames the virtual machine comes to nothing else
    text = re.sub(r"load = (0\.\d+)", lambda m: f"load = {float(m[1]) / 3.0:g}", text)
    scenario = load_scenario(name)
    expect = scenario.expect
    if expect.reaction == "centre":
        within_ms, travel_mm = expect.within_ms and 5.0 * expect.within_ms, 3.0 * expect.travel_mm
        reason = expect.reason or "here ticks are long, and some come late"
        if scenario.orders:
            # here a second may pass from the order to the deed, on which the load goes on
            within_ms, travel_mm = 3000.0, 100.0
        if name in VALVE_DEAF:
            travel_mm = DEAF_TRAVEL_MM
            reason = "the valve hears nothing, and keeps its last voltage for its time-out of 200 ms"
        text = re.sub(r"(within_ms|travel_mm|reason) = .*\n", "", text)
        limits = f"travel_mm = {travel_mm:g}\n" + (f"within_ms = {within_ms:g}\n" if within_ms else "")
        reason = f"reason = {json.dumps(reason)}\n"
        text = text.replace("[expect]\n", f"[expect]\n{limits}{reason}")
    file = folder / f"{name}.toml"
    file.write_text(text)
    return str(file)


def play(name: str, bus: str, folder: Path, config: str = "") -> Case:
    """One scenario, on another rig than its own where a configuration is given."""
    began = time.monotonic()
    scenario = load_scenario(name)
    command = [*PNEUD]
    if bus == "sim":
        command += ["sim", "--scenario", name, "--json"]
    else:
        played = name
        if bus.startswith("unixcan"):
            channel = f"unixcan:campaign-{os.getpid()}-{name[:24]}"
        else:
            channel = f"socketcan:{bus}"
            played = slowed(name, folder)
            command += ["--config", SLOW]
        log = folder / f"{name}.mcap"
        log.unlink(missing_ok=True)
        command += [
            "--virtual",
            "--scenario",
            played,
            "--bus",
            channel,
            "--headless",
            "--json",
            "--log",
            str(log),
        ]
        command += ["--duration", f"{scenario.duration_s + 2.0:g}", "--socket", str(folder / "s")]
    if config:
        command += [config] if bus == "sim" else ["--config", config]
    case = Case(name=name, description=scenario.description, expect=scenario.expect.model_dump())
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    except subprocess.TimeoutExpired:
        case.update(met=False, problems=[f"still at it after {PATIENCE_S:g} s"])
        return case
    case["seconds"] = time.monotonic() - began
    try:
        summary = json.loads(done.stdout)
        case.update(summary["scenario"])
    except (ValueError, KeyError):
        case.update(met=False, problems=[f"exit {done.returncode}: {done.stderr.strip()[-300:]}"])
        return case
    if "Traceback" in done.stderr:
        case["met"] = False
        case["problems"] = [*case["problems"], f"traceback: {done.stderr.strip()[-300:]}"]
    if summary["log"] and "recorder" not in name and "log-full" not in name:
        check_log(Path(summary["log"]), summary["faults"], case)
    return case


def check_log(log: Path, latched: list[str], case: Case) -> None:
    """Every fault that held the axis is in the log, too, and the log is whole."""
    reader = LogReader([log])
    logged = 0
    for tick in reader:
        logged |= tick.latched
    named = {name for bit, name in enumerate(reader.fault_names) if logged >> bit & 1}
    unlogged = sorted(set(latched) - named)
    if unlogged:
        case["met"] = False
        case["problems"] = [*case["problems"], f"not in the log: {', '.join(unlogged)}"]
    if reader.truncated or reader.missing:
        case["met"] = False
        case["problems"] = [*case["problems"], f"log damaged: {reader.damage or f'{reader.missing} missing'}"]


def refused(name: str, words: str, description: str, **options: Any) -> Case:
    """A start that has to be refused in one line, with nothing on standard output."""
    began = time.monotonic()
    command = [*PNEUD, "--virtual", "--duration", "1", "--headless", "--json", *options.pop("arguments", [])]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False, **options)
    problems = []
    if done.returncode not in (2, 3):
        problems.append(f"exit {done.returncode}")
    if done.stdout:
        problems.append("something on standard output")
    if words not in done.stderr or "Traceback" in done.stderr:
        problems.append(f"said: {done.stderr.strip()[-200:]}")
    return Case(
        name=name, description=description, reaction="refused", met=not problems, problems=problems,
        seconds=time.monotonic() - began, faults=[],
    )  # fmt: skip


def starts(folder: Path) -> list[Case]:
    """What is wrong before the start."""
    cases = []
    sealed = folder / "sealed"
    sealed.mkdir(exist_ok=True)
    file = sealed / "file"
    file.write_text("")
    cases.append(
        refused(
            "log-folder-unusable",
            str(file),
            "The folder for the log cannot be written to.",
            arguments=["--log", str(file / "run.mcap")],
        )
    )
    if os.geteuid() == 0 and mount("-t", "tmpfs", "-o", "ro,size=64k", "tmpfs", str(sealed)):
        cases.append(
            refused(
                "log-folder-read-only",
                "ead-only",
                "The folder for the log is on a file system that is read-only.",
                arguments=["--log", str(sealed / "run.mcap")],
            )
        )
        subprocess.run(["umount", str(sealed)], check=False)
    return cases


def full_disk(bus: str, folder: Path) -> list[Case]:
    """A real file system of 2 MB for the log."""
    small = folder / "small"
    small.mkdir(exist_ok=True)
    if os.geteuid() != 0 or not mount("-t", "tmpfs", "-o", "size=48k", "tmpfs", str(small)):
        return []
    began = time.monotonic()
    channel = f"unixcan:campaign-{os.getpid()}-full" if bus.startswith("unixcan") else f"socketcan:{bus}"
    command = [
        *PNEUD,
        "--virtual",
        "--config",
        SLOW,
        "--bus",
        channel,
        "--headless",
        "--json",
        "--duration",
        "20",
    ]
    done = subprocess.run(
        [*command, "--log", str(small / "run.mcap"), "--socket", str(folder / "s")],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    subprocess.run(["umount", "-l", str(small)], check=False)
    problems = []
    try:
        summary = json.loads(done.stdout)
        if summary["faults"] or summary["state"] != "tracking":
            problems.append(f"{summary['state']}, {summary['faults']}")
        if not summary["log_dropped"]:
            problems.append("lost nothing: the disk was not full")
    except ValueError:
        problems.append(f"exit {done.returncode}: {done.stderr.strip()[-300:]}")
    return [
        Case(
            name="disk-full", description="The log's disk is full: the axis goes on.",
            reaction="warn", met=not problems, problems=problems, seconds=time.monotonic() - began,
            faults=["disk_full"],
        )
    ]  # fmt: skip


def overflow(bus: str, folder: Path) -> list[Case]:
    """More frames than the kernel keeps for a daemon that stands still: only SocketCAN counts them."""
    began = time.monotonic()
    channel, socket, log = f"socketcan:{bus}", folder / "s", folder / "overflow.mcap"
    log.unlink(missing_ok=True)
    command = [*PNEUD, "--virtual", "--config", SLOW, "--bus", channel, "--headless", "--json"]
    daemon = subprocess.Popen(
        [*command, "--duration", "30", "--log", str(log), "--socket", str(socket)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    while daemon.poll() is None and state_of(socket) != "tracking":
        time.sleep(0.2)
    with open_link(channel, virtual=True) as link:
        daemon.send_signal(signal.SIGSTOP)
        for _ in range(FLOOD):
            link.send(0x7F0, bytes(8))
        daemon.send_signal(signal.SIGCONT)
    out, err = daemon.communicate(timeout=PATIENCE_S)
    case = Case(
        name="overflow", description="Somebody floods the bus while the daemon stands still.",
        reaction="centre", met=True, problems=[], seconds=time.monotonic() - began, faults=[],
    )  # fmt: skip
    try:
        summary = json.loads(out)
    except ValueError:
        return [case | {"met": False, "problems": [f"exit {daemon.returncode}: {err.strip()[-300:]}"]}]  # type: ignore[list-item]
    reader, present = LogReader([log]), 0
    for tick in reader:
        present |= tick.present
    shown = [name for bit, name in enumerate(reader.fault_names) if present >> bit & 1]
    case["faults"] = [name for name in shown if name in (*summary["faults"], "receive_overflow")]
    if not {"receive_overflow", "deadline"} <= set(shown) or summary["state"] != "fault":
        case.update(met=False, problems=[f"{summary['state']}, {shown}"])
    check_log(log, summary["faults"], case)
    return [case]


def state_of(socket: Path) -> str:
    """What the console says of the axis; empty as long as there is none."""
    try:
        with Client(str(socket)) as client:
            return str(client.ask("status")["state"])
    except PlaceError:
        return ""


def mount(*arguments: str) -> bool:
    """Whether a file system could be mounted."""
    return subprocess.run(["mount", *arguments], capture_output=True, check=False).returncode == 0


def unnoticed(case: Case) -> str:
    """Which faults cannot be noticed on this rig."""
    return f"not noticed here: {', '.join(case['unnoticed'])}" if case.get("unnoticed") else ""


def exceptions(case: Case) -> str:
    """Why more travel than usual is expected."""
    return str(case.get("expect", {}).get("reason", ""))


COLUMNS = (
    ("0 V after", "centred_ms", "{:.1f}\N{NO-BREAK SPACE}ms"),
    ("ticks", "ticks", "{}"),
    ("allowed", "allowed_ticks", "{}"),
    ("speed", "speed_m_s", "{:.3f}\N{NO-BREAK SPACE}m/s"),
    ("travel", "travel_mm", "{:.1f}\N{NO-BREAK SPACE}mm"),
    ("impact", "impact_m_s", "{:.2f}\N{NO-BREAK SPACE}m/s"),
    ("pressure", "peak_bar", "{:.2f}\N{NO-BREAK SPACE}bar"),
)


def page(bus: str, cases: list[Case], left_out: dict[str, str], seconds: float) -> str:
    """The matrix as a page that stands alone."""
    good = sum(case["met"] for case in cases)
    failed = tuple(f"{case['name']}: {'; '.join(case['problems'])}" for case in cases if not case["met"])
    verdict = Verdict(BAD if failed else GOOD, (*failed, f"{good} of {len(cases)} came as expected"))
    rows = []
    for case in cases:
        cells = [form.format(case[key]) if case.get(key) is not None else "" for _, key, form in COLUMNS]
        fault = f"<b>{html.escape(case['name'])}</b><br>{html.escape(case['description'])}"
        notes = "; ".join(case["problems"]) or unnoticed(case) or exceptions(case)
        rows.append(
            (
                badge(GOOD if case["met"] else BAD),
                Drawn(fault),
                case.get("reaction", ""),
                ", ".join(case.get("faults", [])),
                *cells,
                notes,
            )
        )
    head = ("came", "fault", "reaction", "named", *(head for head, _, _ in COLUMNS), "notes")
    others = "".join(f"<li>{html.escape(n)}: {html.escape(why)}</li>" for n, why in sorted(left_out.items()))
    words = (
        "<p><i>0 V after</i> counts from the fault's onset; <i>ticks</i> of the controller count from the"
        " first frame that shows the fault to the one with 0 V, both included; <i>travel</i> is the load's"
        " furthest way after that frame (where no frame shows the fault: after 0 V), <i>impact</i> its"
        " hardest meeting with an end stop, <i>pressure</i> the highest in a chamber, all from the true"
        " plant. What failed was played once more. The last column tells what went wrong, or why more than"
        " 20 mm of travel or 0.05 m/s of impact is expected.</p>"
    )
    return document(
        f"pneud: faults on {bus}",
        f"Faults on {bus}",
        [
            Section("Cases", words + table(head, rows, label="cases", words=4, last=1)),
            Section("Not played here", f"<ul>{others}</ul>" if others else ""),
        ],
        lead=strip(verdict, [("bus", bus), ("took", f"{seconds:.0f} s")]),
    )


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description="Plays the fault scenarios and judges the axis's reactions.")
    parser.add_argument("--bus", default="unixcan", help="sim, unixcan, or an interface such as vcan0")
    parser.add_argument("--core", action="store_true", help="only those that every change has to pass")
    parser.add_argument("--only", default="", help="names, separated by commas")
    parser.add_argument(
        "--config", default="", help="of another rig: what it cannot notice need not be noticed"
    )
    parser.add_argument("-o", "--output", type=Path, default=None, help="folder for matrix and logs")
    o = parser.parse_args()
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as temporary:
        folder = o.output or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        names = sorted(path.stem for path in resources.scenarios().glob("*.toml"))
        real = o.bus not in ("sim", "unixcan")
        if o.only:
            names = o.only.split(",")
        elif o.core:
            names = [name for name in names if name in (CORE_VM if real else CORE)]
        left_out = {name: why for name in names if (why := playable(name, o.bus))}
        cases = []
        for name in names:
            if name in left_out:
                continue
            case = play(name, o.bus, folder, o.config)
            if not case["met"] and o.bus != "sim":
                again = {"again": case["problems"]}
                case = play(name, o.bus, folder, o.config) | again  # type: ignore[assignment]
            cases.append(case)
            say(case)
        if o.bus != "sim" and not o.only:
            others = [*starts(folder), *full_disk(o.bus, folder), *(overflow(o.bus, folder) if real else [])]
            for case in others:
                cases.append(case)
                say(case)
        seconds = time.monotonic() - began
        (folder / "matrix.json").write_text(
            json.dumps(
                {"schema": 1, "bus": o.bus, "seconds": seconds, "cases": cases, "left_out": left_out},
                indent=1,
            )
        )
        (folder / "matrix.html").write_text(page(o.bus, cases, left_out, seconds))
    good = sum(case["met"] for case in cases)
    twice = sum("again" in case for case in cases)
    print(
        f"{o.bus}: {good} of {len(cases)} as expected, {twice} played a second time,"
        f" {len(left_out)} cannot be played here, {seconds:.0f} s"
    )
    return 0 if good == len(cases) else 1


def say(case: Case) -> None:
    """One line on a case."""
    words = "ok  " if case["met"] else "FAIL"
    figures = ""
    if case.get("ticks") is not None and case.get("travel_mm") is not None:
        figures = f"{case['ticks']} ticks, {case['travel_mm']:.1f} mm"
    again = f" (at the first try: {'; '.join(case['again'])})" if case.get("again") else ""
    told = "; ".join(case["problems"]) or unnoticed(case)
    print(f"{words} {case['name']:28} {figures} {told}{again}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
