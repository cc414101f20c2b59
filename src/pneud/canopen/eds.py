"""An EDS file: what a device says that it has.

Read leniently, since few of those in use are as they should be: numbers with leading zeros, limits of signed
types as unsigned ones, sections in any order.
"""

from __future__ import annotations

import configparser
import re
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from pneud.canopen.objects import BY_CODE, U32, Object
from pneud.rt.inputs import read_whole

_SECTION = re.compile(r"([0-9A-F]{4})(?:sub([0-9A-F]{1,2}))?", re.IGNORECASE)
_NODE_ID = re.compile(r"\$NODEID", re.IGNORECASE)


class EdsError(Exception):
    """An EDS cannot be used; the text is one line for a person."""

    exit_code = 2


class Entry(NamedTuple):
    """One object that a device has."""

    object: Object
    access: str  # ro, wo, rw, rww, rwr, const
    default: str  # as it stands, perhaps with $NODEID
    low: int | None
    high: int | None

    def initial(self, node: int) -> bytes:
        """What it is after power-up: in bytes; text as it is."""
        kind = self.object.type
        if kind.size == 0:
            return self.default.encode()
        value = _number(_NODE_ID.sub(str(node), self.default or "0"))
        return (value & ((1 << 8 * kind.size) - 1)).to_bytes(kind.size, "little")


class Eds(NamedTuple):
    """All of a device's objects, by index and sub-index."""

    name: str
    entries: dict[tuple[int, int], Entry]

    def typed(self, o: Object) -> Object:
        """An object with the type that the device has for it; as it is where the device has none."""
        found = self.entries.get((o.index, o.sub))
        return o if found is None or found.object.type.size == 0 else replace(o, type=found.object.type)

    def has(self, o: Object) -> bool:
        """Whether the device has it."""
        return (o.index, o.sub) in self.entries


def read_eds(path: Path) -> Eds:
    """Read an EDS.

    Raises:
        EdsError: it cannot be read, or is none; names the section.
    """
    try:
        text = read_whole(path).decode("latin-1")
    except OSError as e:
        raise EdsError(f"{path}: cannot be read: {e.strerror or e}") from None
    return parse_eds(text, str(path))


def parse_eds(text: str, name: str) -> Eds:
    """As `read_eds`, of its text."""
    parser = configparser.RawConfigParser(strict=False, inline_comment_prefixes=(";",), allow_no_value=True)
    try:
        parser.read_string(text.lstrip("\ufeffï»¿"))
    except configparser.Error as e:
        raise EdsError(f"{name}: no EDS: {' '.join(str(e).split())}") from None
    entries: dict[tuple[int, int], Entry] = {}
    for section in parser.sections():
        match = _SECTION.fullmatch(section)
        if match is None or not parser.has_option(section, "DataType"):
            continue
        index, sub = int(match[1], 16), int(match[2] or "0", 16)
        try:
            entries[index, sub] = _entry(dict(parser.items(section)), index, sub)
        except ValueError as e:
            raise EdsError(f"{name}: section [{section}]: {e}") from None
    if not entries:
        raise EdsError(f"{name}: no EDS: it has no objects")
    return Eds(name, entries)


_TEXT = U32._replace(name="text", code=9, size=0)


def _entry(items: dict[str, str | None], index: int, sub: int) -> Entry:
    code = _number(items.get("datatype") or "")
    kind = BY_CODE.get(code, _TEXT)
    limits = [_limit(items.get(key), kind.size, kind.signed) for key in ("lowlimit", "highlimit")]
    name = items.get("parametername") or ""
    access = (items.get("accesstype") or "rw").lower()
    default = (items.get("defaultvalue") or "").replace(" ", "")
    if kind.size:
        _number(_NODE_ID.sub("1", default or "0"))
    else:
        default = items.get("defaultvalue") or ""
    return Entry(Object(index, sub, kind, name), access, default, *limits)


def _limit(text: str | None, size: int, signed: bool) -> int | None:
    """A limit; of a signed type it may stand there as the bits it has."""
    if not text or not size:
        return None
    try:
        value = _number(text)
    except ValueError:
        return None  # of what nobody knows the meaning, nothing is held against a value
    if signed and value >= 1 << (8 * size - 1):
        value -= 1 << 8 * size
    return value


def _number(text: str) -> int:
    """Decimal, with leading zeros or without, or hexadecimal, and sums of them."""
    total = 0
    for term in text.replace("-", "+-").split("+"):
        if not (part := term.strip()):
            continue
        sign, digits = (-1, part[1:].strip()) if part.startswith("-") else (1, part)
        try:
            total += sign * int(digits, 16 if digits.lower().startswith("0x") else 10)
        except ValueError:
            raise ValueError(f"{text!r} is no number") from None
    if not text.strip():
        raise ValueError("a number is lacking")
    return total
