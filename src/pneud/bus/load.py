"""Whether the wire carries a tick: its frames, one after the other, with every bit that may be stuffed."""

from __future__ import annotations

import math
from typing import NamedTuple

from pneud.bus.codec import Codec, Codecs
from pneud.bus.wire import CAN_EFF_FLAG, EXTENDED_BITS
from pneud.config.conversions import COMPUTING_S
from pneud.config.models import Config

CONTROL_BITS = 34  # of a standard frame without data, from its start to the end of the checksum: stuffed
FIXED_BITS = 13  # delimiters, acknowledgement, end of frame, space between frames: never stuffed
NODE_S = 20e-6  # from SYNC's end until a node has its answer ready


class Load(NamedTuple):
    """What a tick costs at worst [s]."""

    answers_s: float  # from SYNC's first bit to the last bit of the last answer
    tick_s: float  # to the last bit of the command


def longest_s(data_bytes: int, bitrate_bit_s: float, can_id: int = 0) -> float:
    """How long a frame is on the wire at worst: a stuffed bit after every four but the first [s]."""
    stuffed = CONTROL_BITS + 8 * data_bytes + (EXTENDED_BITS if can_id & CAN_EFF_FLAG else 0)
    return (stuffed + (stuffed - 1) // 4 + FIXED_BITS) / bitrate_bit_s


def load_of(config: Config, codecs: Codecs) -> Load:
    """What this axis's frames cost in every tick."""
    rate = config.bus.bitrate_bit_s

    def taken_s(codec: Codec) -> float:
        return longest_s(codec.length, rate, codec.can_id)

    asked_s = taken_s(codecs.sync) + NODE_S if config.bus.sync else 0.0
    answers_s = asked_s + sum(taken_s(answer.codec) for answer in codecs.answers)
    return Load(answers_s, answers_s + COMPUTING_S + taken_s(codecs.valve_command))


def overload(config: Config, codecs: Codecs) -> str:
    """Why the bus cannot carry the configured rate, with the cure; empty where it can.

    An infinite bit rate, as of a bus without a wire, carries any.
    """
    period_s, bits = 1.0 / config.loop.rate_hz, config.bus.bitrate_bit_s
    if not math.isfinite(bits):
        return ""
    load = load_of(config, codecs)
    deadline_s = config.loop.set_deadline * period_s
    if load.tick_s > period_s:
        what = f"a tick's frames take up to {1e3 * load.tick_s:.2f} ms of {1e3 * period_s:.2f} ms"
        most_hz = 1.0 / load.tick_s
    elif load.answers_s > deadline_s:
        what = (
            f"the answers take up to {1e3 * load.answers_s:.2f} ms, beyond loop.set_deadline"
            f" ({1e3 * deadline_s:.2f} ms)"
        )
        most_hz = config.loop.set_deadline / load.answers_s
    else:
        return ""
    return (
        f"loop.rate_hz = {config.loop.rate_hz:g} on {1e-3 * bits:g} kbit/s: {what};"
        f" take at most {math.floor(most_hz):g} Hz, or a faster bus"
        " (bus.bitrate_bit_s; inf where frames go over no wire)"
    )
