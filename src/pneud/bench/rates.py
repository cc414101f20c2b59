"""The highest rate that a contestant holds, on a bus whose frames take no time."""

from __future__ import annotations

from pathlib import Path

from pneud.bench.contestants import AbsentError, TrackScript, Turn
from pneud.bench.sample import Sample
from pneud.config.models import Config
from pneud.config.toml import toml_text
from pneud.loading import at_rate, load

RATES_HZ = (250.0, 500.0, 1000.0, 1500.0, 2000.0, 2500.0, 3000.0, 3500.0, 4000.0, 4500.0, 5000.0)
MOST_SKIPPED = 0.002  # part of the ticks; hosts take CPUs away even from those who do nothing
MOST_INCOMPLETE = 0.01
ATTEMPTS = 2  # so that one pause of the host does not decide


def held(sample: Sample) -> bool:
    """Whether a turn kept its rate: nearly no tick skipped, nearly every one with a complete set."""
    return (
        sample.ticks > 0
        and not sample.note
        and sample.skipped <= MOST_SKIPPED * sample.ticks
        and sample.incomplete <= MOST_INCOMPLETE * sample.ticks
    )


def highest(turn: Turn, track: TrackScript, seconds: float) -> float | None:
    """The highest of RATES_HZ that a contestant holds, by bisection; None if it holds none of them.

    Raises:
        AbsentError: it could not take part at any rate that was tried.
    """
    best, left, right = None, 0, len(RATES_HZ)
    reason, started = "", False
    while left < right:
        middle = (left + right) // 2
        held_it = False
        for _ in range(ATTEMPTS):
            try:
                sample = turn(at(track, RATES_HZ[middle]), RATES_HZ[middle], seconds)
            except AbsentError as e:
                reason = str(e)
                continue
            started = True
            if held(sample):
                held_it = True
                break
        if held_it:
            best, left = RATES_HZ[middle], middle + 1
        else:
            right = middle
    if not started:
        raise AbsentError(reason)
    return best


def without_bus_time(track: TrackScript) -> TrackScript:
    """The same axis on a bus of infinite bit rate."""
    data = track.axis.config.model_dump(by_alias=True, exclude_defaults=True)
    data.setdefault("bus", {})["bitrate_bit_s"] = float("inf")
    data["bus"]["dbc"] = str(track.axis.dbc.resolve())
    data.setdefault("plant", {})["bitrate_bit_s"] = float("inf")
    file = track.scratch / "no-bus-time.toml"
    file.write_text(toml_text(data))
    return track._replace(axis=load(file), config_file=file)


def at(track: TrackScript, rate_hz: float) -> TrackScript:
    """The same axis at another rate."""
    config: Config = at_rate(track.axis.config, rate_hz)
    file: Path = track.scratch / f"at-{rate_hz:g}.toml"
    file.write_text(toml_text(config.model_dump(by_alias=True, exclude_defaults=True)))
    return track._replace(axis=track.axis._replace(config=config), config_file=file)
