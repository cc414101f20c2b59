"""All that was found on a bus: as tables of text, as JSON, and as the mapping that a configuration needs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import tomlkit

from pneud.study.mapping.decoding import MOVES, Course, Decoder
from pneud.study.mapping.guessing import Guess, guess
from pneud.study.mapping.patterns import Check
from pneud.study.mapping.watching import Seen, Watch

SIGNALS_HEAD = ("signal", "from", "to", "unit", "values/s", "moves", "with position")
MESSAGES_HEAD = ("id", "bytes", "message", "Hz", "jitter", "when", "change", "counter", "checksum")


class Found(NamedTuple):
    """What a bus carries."""

    seconds: float
    messages: list[Seen]
    names: dict[int, str]  # of the messages that the DBC knows
    courses: list[Course]
    guess: Guess
    sync: bool  # the position answers SYNC, or nothing tells
    special: set[str]  # signals that count or check
    extras: dict[str, dict[str, Any]]  # what a message of the mapping has besides, by its name


def look(watch: Watch, decoder: Decoder | None, given: Mapping[str, str]) -> Found:
    """Make sense of what has been heard."""
    ids = sorted(watch.frames)
    messages = [watch.seen(can_id, decoder.places(can_id) if decoder else ()) for can_id in ids]
    courses = [c for can_id in ids for c in (decoder.courses(watch, can_id) if decoder else ())]
    names = {i: decoder.messages[i].name for i in ids if decoder and i in decoder.messages}
    special = _special(messages, names, decoder)
    guessed = guess((c for c in courses if c.name not in special), given)
    if (sync_name := names.get(watch.sync_id)) is not None:
        counted = next((name for name in special if name.startswith(f"{sync_name}.")), sync_name)
        guessed.filled.setdefault("sync", counted)
    mapped = {name.partition(".")[0] for name in guessed.filled.values()} - {sync_name}
    extras = {}
    for seen in messages:
        name = names.get(seen.can_id)
        if name in mapped and decoder and (extra := _extra(seen, decoder)):
            extras[name] = extra
    encoder = guessed.filled.get("position_m", ".").partition(".")[0]
    timing = next((s.timing for s in messages if names.get(s.can_id) == encoder), "answers SYNC")
    sync = timing in ("answers SYNC", "rare")
    return Found(watch.seconds, messages, names, courses, guessed, sync, special, extras)


def _special(messages: list[Seen], names: dict[int, str], decoder: Decoder | None) -> set[str]:
    """Signals that count or check."""
    found = set()
    for seen in messages:
        for what in (seen.counter, seen.check):
            if what is not None and decoder and (signal := decoder.signal_at(seen.can_id, what.place)):
                found.add(f"{names[seen.can_id]}.{signal}")
    return found


def _extra(seen: Seen, decoder: Decoder) -> dict[str, Any]:
    """Counter and checksum of a message, as far as the DBC has signals for them."""
    extra: dict[str, Any] = {}
    if seen.counter is not None and (name := decoder.signal_at(seen.can_id, seen.counter.place)):
        extra["counter"] = name
        if seen.counter.wrapped and seen.counter.last != (1 << seen.counter.place.length) - 1:
            extra["counter_max"] = seen.counter.last
    if seen.check is not None and (name := decoder.signal_at(seen.can_id, seen.check.place)):
        extra["crc"] = name
        check: Check = seen.check
        if check.rule != "pneud":
            extra["protection"] = check.rule
        if check.data_id is not None:
            extra["data_id"] = list(check.data_id) if isinstance(check.data_id, tuple) else check.data_id
        if check.data_id_mode != "both":
            extra["data_id_mode"] = check.data_id_mode
        if check.rule.startswith("e2e"):
            extra.pop("counter_max", None)  # the rule has it
    return extra


def table(found: Found, dbc: str) -> str:
    """The mapping as TOML."""
    document = tomlkit.document()
    document["bus"] = bus = tomlkit.table()
    put(bus, found, dbc)
    return tomlkit.dumps(document)


def put(bus: Any, found: Found, dbc: str) -> None:
    """Put the mapping into the table `bus` of a configuration, in the place of the one that it had."""
    bus["dbc"] = dbc
    bus["sync"] = found.sync
    for key in ("frames", "signals", "messages"):
        bus.pop(key, None)
    bus["signals"] = signals = tomlkit.table()
    for value, name in found.guess.filled.items():
        signals[value] = name
    if found.extras:
        bus["messages"] = messages = tomlkit.table(is_super_table=True)
        for name, extra in found.extras.items():
            messages[name] = one = tomlkit.table()
            for key, value in extra.items():
                one[key] = value


def as_json(found: Found) -> dict[str, Any]:
    """All of it as plain values."""
    mover = _mover(found)
    return {
        "seconds": round(found.seconds, 6),
        "messages": [
            {
                "id": seen.shown,
                "extended": len(seen.shown) == 8,
                "name": found.names.get(seen.can_id),
                "bytes": list(seen.lengths),
                "frames": seen.frames,
                "rate_hz": _figures(seen.rate_hz),
                "jitter_s": _figures(seen.jitter_s),
                "timing": seen.timing,
                "delay_s": None if seen.delay_s != seen.delay_s else _figures(seen.delay_s),
                "changing_bytes": list(seen.changing),
                "counter": seen.counter
                and {"at": str(seen.counter.place), "first": seen.counter.first, "last": seen.counter.last},
                "checksum": seen.check
                and {
                    "at": str(seen.check.place),
                    "protection": seen.check.rule,
                    "data_id": seen.check.data_id,
                    "data_id_mode": seen.check.data_id_mode,
                },
            }
            for seen in found.messages
        ],
        "signals": [
            {
                "name": c.name,
                "unit": c.signal.unit,
                "low": _figures(c.values.min()),
                "high": _figures(c.values.max()),
                "distinct_per_s": _figures(c.distinct_per_s),
                "moving": _figures(c.moving),
                "with_position": _figures(c.along(mover)) if mover else None,
            }
            for c in found.courses
        ],
        "guess": found.guess.filled,
        "doubts": found.guess.doubts,
        "sync": found.sync,
        "mapping": {"signals": found.guess.filled, "messages": found.extras},
    }


def message_rows(found: Found) -> list[tuple[str, ...]]:
    """A row for each identifier, under `MESSAGES_HEAD`."""
    return [
        (
            seen.shown,
            "–".join(map(str, dict.fromkeys((seen.lengths[0], seen.lengths[-1])))),
            found.names.get(seen.can_id, ""),
            f"{seen.rate_hz:.4g}" if seen.rate_hz else "",
            f"{1e6 * seen.jitter_s:.0f} µs" if seen.rate_hz else "",
            f"SYNC + {1e6 * seen.delay_s:.0f} µs" if seen.delay_s > 0.0 else seen.timing,
            _spans(seen.changing),
            "" if seen.counter is None else f"{seen.counter.place}: {seen.counter.first}…{seen.counter.last}",
            "" if seen.check is None else f"{seen.check.place}: {seen.check.rule}{_identifier(seen.check)}",
        )
        for seen in found.messages
    ]


def signal_rows(found: Found, *, now: bool = False) -> list[tuple[str, ...]]:
    """A row for each signal that tells something, under `SIGNALS_HEAD`; what moves comes first."""
    mover = _mover(found)
    rows: list[tuple[str, ...]] = []
    for c in sorted(found.courses, key=lambda c: -(c.moving_now if now else c.moving)):
        if c.name in found.special or c.values.min() == c.values.max():
            continue
        moving = c.moving_now if now else c.moving
        rows.append(
            (
                c.name,
                f"{c.values.min():.6g}",
                f"{c.values.max():.6g}",
                c.signal.unit or "",
                f"{c.distinct_per_s:.4g}",
                f"yes, {moving:.0f}×" if moving > MOVES else "",
                f"{c.along(mover):+.2f}" if mover and mover is not c and moving > MOVES else "",
            )
        )
    return rows


def _mover(found: Found) -> Course | None:
    position = found.guess.filled.get("position_m")
    return next((c for c in found.courses if c.name == position), None)


def _identifier(check: Check) -> str:
    if check.data_id is None:
        return ""
    ids = check.data_id if isinstance(check.data_id, tuple) else (check.data_id,)
    mode = "" if check.data_id_mode == "both" else f" {check.data_id_mode}"
    return f", data_id{mode} {' '.join(f'0x{one:X}' for one in ids)}"


def _spans(numbers: tuple[int, ...]) -> str:
    """Numbers in order, those in a row as from–to."""
    spans: list[list[int]] = []
    for n in numbers:
        if spans and n == spans[-1][-1] + 1:
            spans[-1].append(n)
        else:
            spans.append([n])
    return " ".join(str(s[0]) if len(s) == 1 else f"{s[0]}–{s[-1]}" for s in spans)


def _figures(value: float) -> float:
    return float(f"{value:.6g}")
