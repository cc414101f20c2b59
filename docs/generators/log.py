"""The document of the log, `docs/log.md`; its tables are made from the schema."""

from __future__ import annotations

from collections.abc import Iterator

from google.protobuf.descriptor_pb2 import FieldDescriptorProto as F

from pneud.log.format.schema import SCHEMA, Field, tick_fields

# Meaning of every field; the unit stands at the end of its name
MEANINGS = {
    "t_ns": "this tick's SYNC, CLOCK_MONOTONIC",
    "measurement.t_ns": "the same",
    "measurement.fresh": "bits of the sources that answered this tick's SYNC: 1 encoder, 2 pressure, 4 valve status",
    "measurement.position_m": "newest valid encoder reading, stroke coordinate, 0 at the rear end stop",
    "measurement.p1_pa": "pressure of chamber 1 (cap end), absolute",
    "measurement.p2_pa": "pressure of chamber 2 (rod end), absolute",
    "measurement.supply_pa": "supply pressure, absolute",
    "measurement.applied_v": "what the valve's DAC put out",
    "measurement.encoder_status": "bits: 1 referenced, 2 warning, 4 error",
    "measurement.valve_state": "0 boot, 1 centred, 2 enabled, 3 timed out, 4 fault",
    "measurement.encoder_age_ns": "from the sampling of the encoder's last valid value to SYNC; 0 where it is fresh",
    "measurement.pressure_age_ns": "likewise for the pressures",
    "measurement.valve_age_ns": "likewise for the valve status",
    "measurement.encoder_defects": "why newer frames were not used: 1 corrupt, 2 counter frozen, 4 late;"
    " 16 held back as odd, 32 confirmed the one before",
    "measurement.pressure_defects": "likewise",
    "measurement.valve_defects": "likewise",
    "measurement.encoder_offset_ns": "sampling instant of the position, after SYNC;"
    " what SYNC waits for the own last command is in it",
    "measurement.skipped": "ticks skipped just before this one",
    "measurement.host": "bits of what the machine has to say (`Host` in `signals.py`)",
    "estimate.position_m": "position at the instant at which it was sampled",
    "estimate.velocity_m_s": "velocity",
    "estimate.force_n": "F̂, unmatched force acting on the load",
    "estimate.x3_n": "P1 A1 − P2 A2",
    "estimate.x3_hat_n": "x̂3 of the observer",
    "estimate.d_hat_n_s": "d̂ of the observer",
    "estimate.innovation_m": "encoder minus prediction",
    "estimate.opening_v": "command that the valve's spool is believed to follow",
    "reference.position_m": "where the load should be at that instant; NaN where there is no reference",
    "reference.velocity_m_s": "its first derivative",
    "reference.acceleration_m_s2": "its second derivative",
    "reference.jerk_m_s3": "its third derivative",
    "command.voltage_v": "what left for the valve, signed about its centre",
    "command.enable": "1 where the valve may follow, else 0",
    "command.saturated": "1 where the law asked for more than the output chain let through",
    "command.law_v": "what the law asked for; NaN where it was not asked",
    "command.s": "sliding variable",
    "command.ustar": "u* of the law",
    "timing.lateness_ns": "wake-up after the ideal grid",
    "timing.set_ns": "SYNC sent to set complete, or given up",
    "timing.cycle_ns": "the cycle itself",
    "timing.send_ns": "encoding and sending the command",
    "timing.latency_ns": "kernel stamp of the newest sensor frame to command sent",
    "timing.record_ns": "handing over the record of the tick before",
    "state": "state of the axis",
    "present": "bits of the fault table that hold now; their names stand in the metadata `faults`",
    "latched": "bits of the fault table that hold the axis in fault",
    "answer": "what became of this tick's request",
    "truth_m": "true position at SYNC, where a software plant tells it, else NaN",
    "check": "CRC-32 over the doubles of estimate, reference and command (voltage, law, s, u*), little-endian",
    "in_position": "1 where the load has come to rest at the end of the reference, within the tolerances",
    "hunting": "at its target the load or the command swings: what it most likely comes from",
    "request.kind": "what was asked for; only ticks with a request have it",
    "request.values": "its numbers",
}
_UNITS = (
    ("_m_s3", "m/s³"),
    ("_m_s2", "m/s²"),
    ("_m_s", "m/s"),
    ("_n_s", "N/s"),
    ("_ns", "ns"),
    ("_pa", "Pa"),
    ("_m", "m"),
    ("_n", "N"),
    ("_v", "V"),
)
_TYPES = {
    F.TYPE_FLOAT: "float",
    F.TYPE_DOUBLE: "double",
    F.TYPE_FIXED32: "fixed32",
    F.TYPE_FIXED64: "fixed64",
    F.TYPE_SFIXED64: "sfixed64",
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
an age of 2⁶² ns means that the source has never been heard. Logs of schema 2 lack `in_position` and `hunting`, which read as 0 then.

| field | unit | type | meaning |
|---|---|---|---|
"""

_TAIL = """
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

    from pneud import read_log
    from pneud.log.columns import blocks

    for tick in read_log("run.mcap"):          # objects, one by one
        print(tick.t_ns, tick.measurement.position_m, len(tick.frames))
    for block in blocks(read_log("run.mcap")): # arrays, thousands of ticks at a time
        print(block.real("estimate.force_n").max())

## In other tools

    pneud logs                                 # which there are; --json
    pneud report run.mcap                      # one page, run.html; several logs are compared
    pneud report run.mcap -o part.html --from 120 --to 125
    pneud bench --json > bench.json            # what this machine can do …
    pneud report run.mcap -o report.html --reference bench.json   # … beside the run's own timing
    pneud export run.mcap -o run.parquet       # or .csv: a row a tick
    pneud export run.mcap -o run.log           # frames: candump log; or .asc, .blf
    cantools decode configs/pneud.dbc < run.log

A report draws at most 8192 buckets of ticks for each line, with the least and the greatest value of each: every peak is
kept, whatever the length. `--from` and `--to` show a part with every tick.

Foxglove, [Lichtblick](https://github.com/lichtblick-suite/lichtblick) and PlotJuggler open the `.mcap` itself. Layouts
are in `configs/viewers`: `foxglove.json` for the first two (import it as a layout), `plotjuggler.xml` for the third.
`pneud view run.mcap --foxglove` starts Lichtblick, else Foxglove, with a log; `pneud view run.mcap --rerun` starts rerun.

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
        unit = next((unit for end, unit in _UNITS if field.name.endswith(end)), "")
        if field.type == F.TYPE_ENUM:
            kind = f"`{field.of}`"
        elif field.type == F.TYPE_FLOAT:
            kind = "real"
        else:
            kind = _TYPES[field.type]
        repeated = ", repeated" if field.repeated else ""
        yield f"| `{name}` | {unit} | {kind}{repeated} | {MEANINGS[name]} |\n"


def text() -> str:
    """The document."""
    _, fields, nested = tick_fields("compact")
    return _HEAD + "".join(_rows(fields, nested)) + _TAIL


if __name__ == "__main__":
    print(text(), end="")
