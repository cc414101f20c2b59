"""A commented configuration from a dozen answers, asked for on a terminal or given as options."""

from __future__ import annotations

import json as json_
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from pneud.config import library
from pneud.config.sections import ConfigError, check_channel
from pneud.loading import load
from pneud.rt.outputs import replacing
from pneud.study.draft import Answers, Draft, drafted
from pneud.study.plausibility import findings
from pneud.verbs import JsonOption, VerbError

DEFAULT_NAME = "axis"
CYLINDERS, VALVES = library.choices(library.CYLINDERS), library.choices(library.VALVES)


class Question(NamedTuple):
    """Something that is asked for, as an option and on a terminal."""

    of: str  # of the answers
    option: str
    words: str
    read: Callable[[str], Any]  # raises ConfigError
    default: str  # empty: has to be said


def _number(low: float, high: float) -> Callable[[str], float]:
    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise ConfigError(f"{text!r}: must be a number between {low:g} and {high:g}")
        return value

    return read


def _name(text: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}", text):
        raise ConfigError(f"{text!r}: up to 64 letters, digits and . _ -")
    return text


def _kind(text: str) -> str:
    if text not in ("absolute", "incremental"):
        raise ConfigError(f"{text!r}: absolute or incremental")
    return text


def _bus(text: str) -> str:
    try:
        check_channel(text)
    except ValueError as e:
        raise ConfigError(str(e).removeprefix("bus ")) from None
    return text


QUESTIONS = (
    Question("name", "NAME", "Name of the axis", _name, DEFAULT_NAME),
    Question(
        "cylinder",
        "--cylinder",
        f"Cylinder: {CYLINDERS}",
        library.cylinder,
        "",
    ),
    Question(
        "valve",
        "--valve",
        f"Valve: {VALVES}",
        library.valve,
        "",
    ),
    Question("stroke_mm", "--stroke", "Stroke in mm", _number(10.0, 10_000.0), ""),
    Question("mass_kg", "--mass", "Moving mass in kg: piston, rod and load", _number(0.05, 5000.0), ""),
    Question(
        "inclination_deg",
        "--inclination",
        "Inclination of the way out in degrees: 0 level, 90 lifts the load",
        _number(-90.0, 90.0),
        "0",
    ),
    Question("supply_bar", "--supply", "Supply in bar above the atmosphere", _number(2.0, 10.0), "5"),
    Question("hose_m", "--hose", "Hose from the valve to each port in m", _number(0.0, 10.0), "0.3"),
    Question("encoder_step_um", "--encoder-step", "Step of the encoder in µm", _number(0.01, 100.0), "5"),
    Question("encoder", "--encoder", "Encoder: absolute, or incremental (homed first)", _kind, "absolute"),
    Question("bus", "--bus", "Bus: socketcan:can0 for a rig, auto for a virtual one", _bus, "auto"),
)


def new(
    name: Annotated[str | None, typer.Argument(metavar="NAME", help="Of the axis; default axis.")] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="To write; default NAME.toml.")
    ] = None,
    cylinder: Annotated[str | None, typer.Option("--cylinder", metavar="C", help=f"{CYLINDERS}.")] = None,
    valve: Annotated[
        str | None,
        typer.Option("--valve", metavar="V", help=f"{VALVES}."),
    ] = None,
    stroke: Annotated[str | None, typer.Option("--stroke", metavar="MM", help="Of the piston.")] = None,
    mass: Annotated[str | None, typer.Option("--mass", metavar="KG", help="Piston, rod and load.")] = None,
    inclination: Annotated[
        str | None,
        typer.Option("--inclination", metavar="DEG", help="Of the way out; 90 lifts the load; default 0."),
    ] = None,
    supply: Annotated[
        str | None, typer.Option("--supply", metavar="BAR", help="Above the atmosphere; default 5.")
    ] = None,
    hose: Annotated[
        str | None, typer.Option("--hose", metavar="M", help="From valve to port; default 0.3.")
    ] = None,
    encoder_step: Annotated[
        str | None, typer.Option("--encoder-step", metavar="UM", help="Default 5 µm.")
    ] = None,
    encoder: Annotated[
        str | None, typer.Option("--encoder", metavar="KIND", help="absolute (default) or incremental.")
    ] = None,
    bus: Annotated[str | None, typer.Option("--bus", metavar="BUS", help="Default auto.")] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Ask nothing: take what is usual.")] = False,
    json: JsonOption = False,
) -> int:
    """Write a configuration that `check` passes and `sim` runs.

    Returns:
        Exit status: 0.

    Raises:
        ConfigError: an answer cannot be used, or no rig is like that.
        VerbError: an answer is missing and there is no terminal to ask on, or the file is there.
        OSError: it cannot be written.
    """
    texts = (
        *(name, cylinder, valve, stroke, mass, inclination, supply, hose),
        *(encoder_step, encoder, bus),
    )
    given = {q.of: text for q, text in zip(QUESTIONS, texts, strict=True) if text is not None}
    answers = answered(given, None if yes or not sys.stdin.isatty() else _ask)
    path = output if output is not None else Path(f"{answers.name}.toml")
    if path.exists():
        raise VerbError(f"{path}: is there already; take another name, or -o FILE")
    draft = drafted(answers)
    with replacing(path) as beside:
        beside.write_text(draft.text, encoding="utf-8")
        found = findings(draft.config, load(beside).codecs.command_lsb_v, draft.bandwidth_rad_s)
        if wrong := [finding.words for finding in found if finding.is_error]:
            raise ConfigError(f"{answers.name}: no rig is like that: {'; '.join(wrong)}")
    draft = draft._replace(warnings=[f"{f.key}: {f.words}" for f in found] + draft.warnings)
    print(_as_json(path, draft) if json else _in_words(path, draft))
    return 0


def answered(given: dict[str, str], ask: Callable[[Question], Any] | None) -> Answers:
    """All answers: those given, and what is asked or usual for the others.

    Args:
        given: texts by the answer's name.
        ask: for one; None where nobody can be asked.

    Raises:
        ConfigError: one given cannot be used.
        VerbError: one is missing that is not usual, and nobody can be asked.
    """
    missing = [q.option for q in QUESTIONS if not q.default and q.of not in given]
    if missing and ask is None:
        raise VerbError(f"missing: {', '.join(missing)}; nothing is usual there, and there is nobody to ask")
    read: dict[str, Any] = {}
    for q in QUESTIONS:
        if q.of in given:
            try:
                read[q.of] = q.read(given[q.of])
            except ConfigError as e:
                raise ConfigError(f"{q.option} {e}") from None
    for q in QUESTIONS:
        if q.of not in read:
            read[q.of] = q.read(q.default) if ask is None else ask(q)
    return Answers(**read)


def _ask(q: Question) -> Any:
    """An answer from the terminal, asked for until it can be used."""
    while True:
        print(f"{q.words}{f' [{q.default}]' if q.default else ''}: ", end="", file=sys.stderr, flush=True)
        line = sys.stdin.readline()
        if not line:
            print(file=sys.stderr)
            raise VerbError(f"no answer to: {q.words}")
        try:
            return q.read(line.strip() or q.default)
        except ConfigError as e:
            print(e, file=sys.stderr)


def _as_json(path: Path, draft: Draft) -> str:
    return json_.dumps(
        {
            "schema": 1,
            "ok": True,
            "name": draft.config.name,
            "file": str(path),
            "bandwidth_rad_s": draft.bandwidth_rad_s,
            "warnings": draft.warnings,
        }
    )


def _in_words(path: Path, draft: Draft) -> str:
    lines = [
        f"{path}: gains for {draft.bandwidth_rad_s:g} rad/s; what is marked typical is to be measured",
        *(f"warning: {warning}" for warning in draft.warnings),
        f"try it: pneud sim {path}; with a screen: pneud --virtual --config {path}",
    ]
    return "\n".join(lines)
