"""Several axes in one file, or in a folder with a file for each: every one a configuration of its own.

A file has `[[axis]]` tables, each with a name; what stands above them holds for all, and what an axis says
itself takes its place. What comes of it is the plain text of one axis, which is all that anybody else sees:
its log has it, and a replay needs nothing else.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import ValidationError

from pneud.config.bus_tables import FramesConfig
from pneud.config.conversions import COMPUTING_S, FRAME_BITS, STUFFING
from pneud.config.models import Config
from pneud.config.places import line_of
from pneud.config.reading import AXIS, explain, parse, text_of
from pneud.config.sections import ConfigError
from pneud.config.toml import TomlError, merged, tables_of, toml_text

_NONE = {"counter": "", "crc": ""}  # how a file says that a message has none


class Part(NamedTuple):
    """One axis of several, or the only one."""

    config: Config
    text: str
    path: Path


def axes_of(file: str | Path) -> tuple[Part, ...]:
    """The axes of a file, or of all files of a folder, in order.

    Raises:
        ConfigError: one cannot be used, or two have one name.
    """
    folder = Path(file)
    if not folder.is_dir():
        return parts_of(*text_of(file))
    files = sorted(folder.glob("*.toml"))
    if not files:
        raise ConfigError(f"{file}: a folder without a configuration; one .toml for each axis")
    parts = tuple(part for one in files for part in _parts(*text_of(one)))
    return _paired(_named(tuple(_delayed(part, n, len(parts)) for n, part in enumerate(parts)), str(file)))


def one_of(parts: Sequence[Part], axis: str | None, name: str) -> Part:
    """The axis asked for, which need not be named where there is but one.

    Raises:
        ConfigError: there is none of this name, or several and none is named.
    """
    if axis is None and len(parts) == 1:
        return parts[0]
    for part in parts:
        if part.config.name == axis:
            return part
    found = ", ".join(part.config.name for part in parts)
    if axis is None:
        raise ConfigError(f"{name}: has several axes ({found}); choose one, with --axis")
    raise ConfigError(f"--axis {axis}: {name} has no such axis; it has {found}")


def parts_of(text: str, path: Path) -> tuple[Part, ...]:
    """The axes of a file's text, as `axes_of`.

    Raises:
        ConfigError: one cannot be used, or two have one name.
    """
    return _paired(_named(tuple(_parts(text, path)), str(path)))


def name_of(file: str | Path, parts: Sequence[Part]) -> str:
    """What a daemon with these axes is called: as the only one, as the file says, or as the file itself."""
    if len(parts) == 1:
        return parts[0].config.name
    if not Path(file).is_dir() and isinstance(name := tables_of(text_of(file)[0]).get("name"), str):
        return name
    return Path(file).resolve().stem


def proof_file(path: Path, axis: str) -> Path:
    """The file beside which an axis's proof is kept: its own, or one of its name beside that of several."""
    try:
        several = AXIS in tables_of(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError):  # whoever loads it says so
        several = False
    return path.with_name(f"{path.stem}.{axis}{path.suffix}") if several else path


def own_text(axis: str, number: int, axes: int, others: dict[str, Any], text: str) -> str:
    """What a file says of one of the axes of a run, as `Part.text`.

    Args:
        axis: its name.
        number: its place among them, from 0.
        axes: how many there are.
        others: tables that it has from another one, as `mirrored`.
        text: of the file, which may have several.

    Raises:
        ConfigError: the file cannot be used, or has no such axis.
    """
    part = one_of(tuple(_parts(text, Path("the file"))), axis, "the file")
    return _with(_delayed(part, number, axes), others).text


def mirrored(config: Config) -> dict[str, Any]:
    """Tables that an axis has from another one, since of a gantry, and of a beam, it is said but once."""
    follow, beam = config.reference.follow, config.plant.beam
    found: dict[str, Any] = {}
    if follow is not None and follow.leads:
        found["reference"] = {"follow": follow.model_dump()}
    if beam is not None and beam.mirrored:
        found["plant"] = {"beam": beam.model_dump()}
    return found


def _paired(parts: tuple[Part, ...]) -> tuple[Part, ...]:
    """The axes, each with what another one's table says of it, too."""
    told: dict[str, dict[str, Any]] = {}
    for part in parts:
        name, follow, beam = part.config.name, part.config.reference.follow, part.config.plant.beam
        if follow is not None and follow.skew_m is not None and not follow.leads and follow.axis != name:
            other = follow.model_dump() | {"axis": name, "offset_m": -follow.offset_m, "leads": True}
            told.setdefault(follow.axis, {})["reference"] = {"follow": other}
        if beam is not None and beam.axis != name:
            other = beam.model_dump() | {"axis": name, "load_share": 1.0 - beam.load_share, "mirrored": True}
            told.setdefault(beam.axis, {})["plant"] = {"beam": other}
    return tuple(_with(part, _lacking(part.config, told.get(part.config.name, {}))) for part in parts)


def _lacking(config: Config, tables: dict[str, Any]) -> dict[str, Any]:
    """Those of the tables that an axis does not have itself."""
    has = {"reference": config.reference.follow is not None, "plant": config.plant.beam is not None}
    return {key: table for key, table in tables.items() if not has[key]}


def _with(part: Part, tables: dict[str, Any]) -> Part:
    if not tables:
        return part
    text = toml_text(merged(tables_of(part.text), tables))
    return Part(parse(text, str(part.path)), text, part.path)


def _named(parts: tuple[Part, ...], name: str) -> tuple[Part, ...]:
    names = [part.config.name for part in parts]
    for one in names:
        if names.count(one) > 1:
            raise ConfigError(f"{name}: two axes have the name {one}; each needs its own")
    return parts


def _parts(text: str, path: Path) -> Iterator[Part]:
    try:
        data = tables_of(text)
    except TomlError as e:
        raise ConfigError(f"{path}: {e}") from None
    own = data.pop(AXIS, None)
    if own is None:
        yield Part(parse(text, str(path)), text, path)
        return
    if not isinstance(own, list) or not all(isinstance(one, dict) for one in own):
        raise ConfigError(f"{path}: {AXIS}: must be tables, [[axis]], one for each")
    for number, tables in enumerate(own):
        name = tables.get("name")
        if name is None:
            raise ConfigError(f"{path}: axis {number + 1} has no name")
        whole = _with_frames(merged(data, tables))
        try:
            part = Part(Config.model_validate(whole), toml_text(whole), path)
        except ValidationError as e:
            seen = _Seen(text, number, tables)
            raise ConfigError(f"{path}: axis {name}: {explain(e, seen.line, Config)}") from None
        yield _delayed(part, number, len(own))


def _with_frames(data: dict[str, Any]) -> dict[str, Any]:
    """What is not said of a frame is as it is where nothing is said of it at all."""
    frames = data.get("bus", {}).get("frames") if isinstance(data.get("bus"), dict) else None
    if not isinstance(frames, dict):
        return data
    usual: dict[str, Any] = {}
    for role, values in FramesConfig().model_dump(by_alias=True).items():
        if isinstance(frames.get(role), dict):
            usual[role] = {
                k: _NONE.get(k) if v is None else v for k, v in values.items() if v is not None or k in _NONE
            }
    return merged(data, {"bus": {"frames": merged(usual, frames)}})


def _delayed(part: Part, number: int, axes: int) -> Part:
    """The axis with the time that its command takes behind the answers of all, and the commands before it.

    Raises:
        ConfigError: that is longer than a delay may be.
    """
    bus = part.config.bus
    if bus.command_delay_us is not None or axes == 1:
        return part
    frame_s = (FRAME_BITS + 64) * STUFFING / bus.bitrate_bit_s
    delay_s = (3 * axes + 1) * frame_s + COMPUTING_S + number * max(frame_s, COMPUTING_S)
    text = toml_text(merged(tables_of(part.text), {"bus": {"command_delay_us": round(1e6 * delay_s, 1)}}))
    return Part(parse(text, str(part.path)), text, part.path)


class _Seen:
    """A file as one of its axes sees it, for lines."""

    def __init__(self, text: str, number: int, tables: Mapping[str, Any]) -> None:
        self._shared, self._own = _halves(text, number)
        self._tables = tables

    def line(self, where: Sequence[str]) -> int:
        """The line on which a key of the axis stands, its own before that of all."""
        table: Any = self._tables
        for step in where:
            if not isinstance(table, Mapping) or step not in table:
                return line_of(self._shared, where)
            table = table[step]
        return line_of(self._own, where)


def _halves(text: str, number: int) -> tuple[str, str]:
    """The lines for all, and those of one axis as tables of its own; all others are empty."""
    shared, own, at = [], [], -1
    for line in text.splitlines():
        head = line.strip()
        begins = head.startswith("[[") and head.strip("[] \t").split("]")[0].strip() == AXIS
        at += begins
        shared.append(line if at < 0 else "")
        own.append(line.replace(f"[{AXIS}.", "[", 1) if at == number and not begins else "")
    return "\n".join(shared), "\n".join(own)
