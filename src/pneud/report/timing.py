"""The timing of a recorded run in a few lines."""

from __future__ import annotations

from pneud.config.reading import parse
from pneud.loading import at_rate, codecs_of
from pneud.log.files.columns import blocks
from pneud.log.files.reader import LogReader
from pneud.replay.ending import Ending
from pneud.report.health import Health
from pneud.report.spread import Spread

SIMULATED = "simulated"


def in_words(log: LogReader) -> list[str]:
    """What the log says about when things happened; nothing in simulated time, or where there is no tick.

    Raises:
        ConfigError: the configuration in the log cannot be used by this version.
        DatabaseError: nor its DBC.
    """
    if log.metadata.get("bus") == SIMULATED:
        return []
    config = at_rate(parse(log.config_text, f"{log.path}:{log.config_name}"), log.rate_hz)
    codecs = codecs_of(config.bus, log.dbc_name, log.dbc, config.gas)
    health = Health(codecs, config.bus.sync is True, round(1e9 / log.rate_hz))
    lateness, latency, skipped, ending = Spread(), Spread(), 0, Ending()
    for block in blocks(log):
        if len(block.number):
            health.add(block)
            lateness.add(block.ticks["timing.lateness_ns"])
            latency.add(block.ticks["timing.latency_ns"])
            end, stalled = ending.look(block)
            own = end if stalled is None else stalled + 1
            skipped += int(block.ticks["measurement.skipped"][:own].sum())
    if not lateness.count:
        return []
    ages = ", ".join(f"{s.name.replace('_', ' ')} {s.age.in_words('/')}" for s in health.sources)
    return [
        f"recorded timing, µs p50/p99/max: wake-up lateness {lateness.in_words('/')},"
        f" sensor to command {latency.in_words('/')},"
        f" jitter of SYNC {health.sync_jitter.in_words('/')}; {skipped} ticks skipped",
        f"age of frames when the command was sent: {ages}",
    ]
