"""The document of the log, `docs/log.md`; its tables are made from the schema."""

from __future__ import annotations

from collections.abc import Iterator

from google.protobuf.descriptor_pb2 import FieldDescriptorProto as F

from pneud.log.format.meanings import MEANINGS, SCHEMA, meaning_of, unit_of
from pneud.log.format.schema import DERIVED, Field, tick_fields

__all__ = ["MEANINGS", "text"]

_TYPES = {
    F.TYPE_FLOAT: "float",
    F.TYPE_DOUBLE: "double",
    F.TYPE_FIXED32: "fixed32",
    F.TYPE_FIXED64: "fixed64",
    F.TYPE_SFIXED64: "sfixed64",
    F.TYPE_STRING: "string",
    F.TYPE_UINT32: "uint32",
}

_HEAD = f"""# Logs

A log is an [MCAP](https://mcap.dev) file, or several parts of one run. Any MCAP reader decodes it without pneud: the
schemas are in the file. This describes log schema {SCHEMA}.

| topic | schema | what |
|---|---|---|
| `/axis/tick` | `pneud.Tick`, or `pneud.FullTick` with `log.detail = "full"` | one message a tick: everything that one cycle read and decided, and where its time went |
| `/can/frames` | `pneud.Frames` | the frames of some consecutive ticks, by columns |
| `/events` | `foxglove.Log` | what happened, in words: states, faults, requests, marks |
| `/axis/state` | JSON | every two seconds all state of the axis, from which a replay can begin; with what has been learnt |

`log_time` is the instant of the tick as Unix time (in simulated time: from 0). Sequence numbers count the ticks from
1; a gap is where records were dropped. Attached are the configuration and the DBC; the metadata `pneud` hold bus, rate, detail,
fault names by bit, the offset of the clocks (`realtime_offset_ns`: Unix minus monotonic), versions and the numeric
fingerprint; `setup` holds the report of the real-time set-up.

## `/axis/tick`

Reals are floats of 32 bits in `pneud.Tick` (of estimate and reference but their positions, and of `law_v`, `s`, `ustar`, the
last byte is zero) and doubles in `pneud.FullTick`; `check` is of the doubles in both, so that a replay compares to the
bit. Units are SI and stand at the end of each name. Negative times mean that there was none;
an age of 2⁶² ns means that the source has never been heard. Logs of schema 2 lack `in_position` and `hunting`, which read as 0 then; those of schema 3
lack the comments in their schemas; before schema 6 there was no fault beyond bit 62, which `present_more` and `latched_more` are for, and no program; before schema 7 there were no inputs and outputs, which are in `station`, and no load cell, in `weighed`.

| field | unit | type | meaning |
|---|---|---|---|
"""

_DERIVED = """
What follows from these fields is in no log, which would grow by a tenth. It stands behind them in the messages of `--live` and of
`pneud export run.mcap -o viewers.mcap`, in tables (`.csv`, `.parquet`), and on the ticks of `read_log`:

| field | unit | type | meaning |
|---|---|---|---|
"""

_TAIL = """
`error_m` and `true_error_m` are the errors of screen, `status`, summary and report as well. The reference belongs to the instant at
which the position was sampled, `measurement.encoder_offset_ns` after SYNC; the true position belongs to SYNC, so the reference is
taken back to it by its derivatives.

`tracking_mm` in the summary (`--json`) and in the report is over whole periods of a reference that repeats, from 5 s of tracking on
(`periods`, `after_s`), so that it does not hang on where a run ends. Of a run that is too short it is over the last whole period
before; where there is none, over the motions that came to their end.
`motions` has the last hundred of these, each with `rms` and `max`: moves, jogs, uploaded profiles. `against` says what the error is
taken against: the `plant` (its true position), or the `encoder` (the estimate made of it). Where there is nothing to judge, `rms` and
`max` are null and `reason` says why. `command_v` is of the same ticks; `saturated_ticks` and `amiss` are of the whole run.

Unit and meaning of each field stand as comments in the schemas of the file, and as metadata (`unit`, `description`) of the columns
of a `.parquet`.

## `/can/frames`

`received`, `before` and `sent` count the frames of each tick: those received, those among them that were drained
before SYNC left, those sent (SYNC and the command). `order` says which column each frame lies in, tick by tick,
received ones first. A column holds all frames of one identifier and length: `can_id` (as in `struct can_frame`, with its
flag bits) and `length`; `stamp_after_t_ns` and `data` by byte planes, first the first bytes of all its entries, then the
second ones; stamps are little-endian signed 64-bit integers, counted from `t_ns` of the frame's tick. `pneud export` writes
them as a recording that other tools read.

## What may be missing

A recorder that does not keep up, and a disk that is full, cost records, never a tick: what is missing is counted
(`log_dropped`) and named in `/events`, and a run whose file was finished may end with 0. A run whose log has no end, because the
recorder died or failed or the disk took nothing to the last, says why and ends with 1, however the axis fared.

## In Python

```python
from pneud import read_log
from pneud.log.files.columns import blocks

for tick in read_log("run.mcap"):  # objects, one by one
    print(tick.t_s, tick.state_name, tick.error_m, tick.fault_names)
for block in blocks(read_log("run.mcap")):  # arrays, thousands of ticks at a time
    print(block.real("estimate.force_n").max())
```

## In other tools

    pneud logs                                 # which there are; --json
    pneud logs logs --summary year.parquet     # what was done in all of them: farm.md
    pneud report run.mcap                      # one page, run.html; several logs are compared
    pneud report run.mcap -o part.html --from 2 --to 4
    pneud bench --json > bench.json            # what this machine can do …
    pneud report run.mcap -o report.html --reference bench.json   # … beside the run's own timing
    pneud export run.mcap -o run.parquet       # or .csv: a row a tick
    pneud export run.mcap -o viewers.mcap      # for viewers: with errors and names in the ticks
    pneud export run.mcap -o run.log           # frames: candump log; or .asc, .blf
    cantools decode configs/pneud.dbc < run.log

A report begins with a verdict and why, then each motion with its error, settling, air and work, and each fault close up.
Its lines are drawn in at most 8192 buckets of ticks, with the least and the greatest value of each: every peak is kept,
whatever the length. Zoomed in, every tick is there of some minutes at 1 kHz: of stretches with events first, then of
those with the greatest errors; the page says which. `--from` and `--to` show a part. `--open` shows the page.

Foxglove, [Lichtblick](https://github.com/lichtblick-suite/lichtblick) and PlotJuggler open the `.mcap` itself; what `pneud export`
writes for viewers has errors and names in its ticks as well. Layouts
are in `configs/viewers`: `foxglove.json` for the first two (import it as a layout), `plotjuggler.xml` for the third.
`pneud view run.mcap --foxglove` starts Lichtblick, else Foxglove, with a log and its errors, states and faults by name; the layout has
a list of the faults. `pneud view run.mcap --rerun` starts rerun with the same curves, arranged by a blueprint, and a table of the faults:
from when to when, whether latched, and what to look at.

`pneud --virtual --live` (or the daemon on a rig; `pip install 'pneud[live]'`) serves the run as it goes at
ws://127.0.0.1:8765, as it says on standard error with a link for the browser, to viewers that speak `foxglove.sdk.v1`: `/axis/tick`, `/can/frames` and `/events`, with the configuration as
parameters that cannot be changed. Viewers look; nothing that they say reaches the axis. `--live-at ADDRESS:PORT` serves
elsewhere, over IPv6 too (`[::1]:8765`). Who may look:

- On a loopback address: whoever has an account on this machine, without a token.
- On any other address: whoever has the token, which is made at each start. pneud tells the URL to open in one line on standard
  error and on its screen, `ws://axis:8765/?token=…`; `Authorization: Bearer …` does as well. The way is not encrypted.
- Of web pages: those of this machine (`localhost`, `127.0.0.1`, `[::1]`, any port), `https://app.foxglove.dev` and
  `https://studio.foxglove.dev`; further ones with `--live-origin https://viewer.example`, once for each. Applications
  that are no web pages say no origin, or `file://`, and are taken.

Others get an HTTP status (401, 403, …) with one line that says why. Behind that door the server listens on a loopback network
of its own, which nothing else reaches. Where the machine gives it none, which is said on standard error, it is a port of
127.0.0.1 that users of this machine can look at without being asked. The server is a
process of its own, which the loop does not wait for.

## There and back: `pneud export` and `pneud import`

A recording of a bus says when each tick began (SYNC), what the nodes sent and what left for the valve. Beside exported
frames lies `NAME.json` with what no bus carries: configuration, DBC, requests, skipped ticks, and what the machine had to say.
With it, `pneud import run.log -o again.mcap` gives a log whose ticks and commands are those of the first one to the bit.
Exported frames stand in the order in which the axis took them, SYNC with the instant at which its tick began.

That holds for candump logs, which pneud writes and reads to the nanosecond. `.asc` and `.blf` are written by python-can, whose
times are floating-point seconds: stamps move by up to a microsecond, and with them the computed commands by a step on the wire
in more than half of the ticks (of a run in real time 73 % after `.asc`, 59 % after `.blf`). Times of the loop and a software
plant's true position are in no export.

Of a recording without that file, `pneud import run.log --dbc my.dbc --config my.toml -o run.mcap` takes the configuration
(default `rig.toml`), and infers requests from `Enable`: a rise arms and tracks the configured reference, a fall
disarms, a rise after a fault clears first. What else was asked for, such as a stop or a move, leaves no trace on a bus.
The log has the commands that were sent; `pneud replay` says where the axis would have sent others.

A recording is read as far as it goes. What cannot be read is passed over and said, a line for each kind with the first place:
lines and objects that are damaged or cut short, frames of CAN FD and CAN XL. The exit status is 1 then. Direction says who
recorded, not who sent: a recorder that listens marks all frames as received, and they are taken as they are. Only where SYNCs
are marked as sent, frames of the controller that are marked as received are another's. Where the clock was set in between, or
the recording pauses for more than 2³¹ ticks, that is said, and time goes on from there.
"""


def _rows(fields: list[Field], nested: dict[str, list[Field]], group: str = "") -> Iterator[str]:
    for field in fields:
        name = group + field.name
        if field.type == F.TYPE_MESSAGE:
            yield from _rows(nested[field.of.rpartition(".")[2]], nested, f"{name}.")
            continue
        unit = unit_of(field.name)
        if field.type == F.TYPE_ENUM:
            kind = f"`{field.of}`"
        elif field.type == F.TYPE_FLOAT:
            kind = "real"
        else:
            kind = _TYPES[field.type]
        repeated = ", repeated" if field.repeated else ""
        yield f"| `{name}` | {unit} | {kind}{repeated} | {meaning_of(name)} |\n"


def text() -> str:
    """The document."""
    _, fields, nested = tick_fields("compact")
    return _HEAD + "".join(_rows(fields, nested)) + _DERIVED + "".join(_rows(list(DERIVED), {})) + _TAIL


if __name__ == "__main__":
    print(text(), end="")
