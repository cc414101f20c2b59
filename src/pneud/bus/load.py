"""Whether the wire carries a tick: its frames, one after the other, with every bit that may be stuffed."""

import math
from typing import NamedTuple

from pneud.bus.codec import Codec, Codecs
from pneud.bus.wire import (
    CAN_EFF_FLAG,
    EXTENDED_BITS,
    FD_CODE_BITS,
    FD_EXTENDED_BITS,
    FD_HEAD_BITS,
    FD_TAIL_BITS,
    fd_check_bits,
)
from pneud.config.conversions import COMPUTING_S
from pneud.config.models import Config

CONTROL_BITS = 34  # of a standard frame without data, from its start to the end of the checksum: stuffed
FIXED_BITS = 13  # delimiters, acknowledgement, end of frame, space between frames: never stuffed
NODE_S = 20e-6  # from SYNC's end until a node has its answer ready


class Load(NamedTuple):
    """What a tick costs at worst [s]."""

    answers_s: float  # from SYNC's first bit to the last bit of the last answer
    tick_s: float  # to the last bit of the command


def longest_s(data_bytes: int, bitrate_bit_s: float, can_id: int = 0, data_bit_s: float = 0.0) -> float:
    """How long a frame is on the wire at worst: a stuffed bit after every four but the first [s].

    Args:
        data_bytes: of the frame.
        bitrate_bit_s: of the bus.
        can_id: identifier, with its flag where it has 29 bits.
        data_bit_s: of the data of a frame of CAN FD; 0 for a classic one.
    """
    if data_bit_s and bitrate_bit_s < math.inf:
        head = FD_HEAD_BITS + (FD_EXTENDED_BITS if can_id & CAN_EFF_FLAG else 0)
        body = FD_CODE_BITS + 8 * data_bytes
        slow = head + (head - 1) // 4
        fast = body + (head + body - 1) // 4 - (head - 1) // 4 + fd_check_bits(data_bytes)
        return (slow + FD_TAIL_BITS) / bitrate_bit_s + fast / data_bit_s
    stuffed = CONTROL_BITS + 8 * data_bytes + (EXTENDED_BITS if can_id & CAN_EFF_FLAG else 0)
    return (stuffed + (stuffed - 1) // 4 + FIXED_BITS) / bitrate_bit_s


def load_of(config: Config, *axes: Codecs) -> Load:
    """What the frames of axes on one bus cost in every tick.

    Args:
        config: of any of them.
        axes: the frames of each; all answer one SYNC.
    """
    rate = config.bus.bitrate_bit_s

    def taken_s(codec: Codec) -> float:
        return longest_s(codec.length, rate, codec.can_id, codec.data_bit_s)

    answers_s = taken_s(axes[0].sync) + NODE_S if config.bus.sync else 0.0
    for codecs in axes:
        answers_s += sum(taken_s(answer.codec) for answer in codecs.answers)
        if codecs.switching is not None:
            answers_s += sum(taken_s(message.codec) for message in codecs.switching.messages)
        if codecs.load_cell is not None:
            answers_s += taken_s(codecs.load_cell.codec)
    # the next axis computes while a command is on the wire
    commands = [taken_s(codecs.valve_command) for codecs in axes]
    waits_s = sum(max(command_s, COMPUTING_S) for command_s in commands[:-1])
    return Load(answers_s, answers_s + COMPUTING_S + waits_s + commands[-1])


def most_hz(config: Config, load: Load) -> float:
    """The highest rate at which the bus carries so much in every tick."""
    return min(1.0 / load.tick_s, config.loop.set_deadline / load.answers_s)


def most_axes(config: Config, codecs: Codecs) -> int:
    """How many axes like one fit on its bus at its rate; 0 where not even that one does.

    Raises:
        ValueError: the bus is no wire, and carries any number.
    """
    if not math.isfinite(config.bus.bitrate_bit_s):
        raise ValueError("a bus without a wire carries any number of axes")
    axes = 0
    while most_hz(config, load_of(config, *[codecs] * (axes + 1))) >= config.loop.rate_hz:
        axes += 1
    return axes


def overload(config: Config, *axes: Codecs) -> str:
    """Why the bus cannot carry the configured rate, with the cure; empty where it can.

    An infinite bit rate, as of a bus without a wire, carries any.
    """
    period_s, bits = 1.0 / config.loop.rate_hz, config.bus.bitrate_bit_s
    if not math.isfinite(bits):
        return ""
    load = load_of(config, *axes)
    deadline_s = config.loop.set_deadline * period_s
    several = f" of {len(axes)} axes" if len(axes) > 1 else ""
    if load.tick_s > period_s:
        what = f"a tick's frames{several} take up to {1e3 * load.tick_s:.2f} ms of {1e3 * period_s:.2f} ms"
    elif load.answers_s > deadline_s:
        what = (
            f"the answers{several} take up to {1e3 * load.answers_s:.2f} ms, beyond loop.set_deadline"
            f" ({1e3 * deadline_s:.2f} ms)"
        )
    else:
        return ""
    return (
        f"loop.rate_hz = {config.loop.rate_hz:g} on {1e-3 * bits:g} kbit/s: {what};"
        f" take at most {math.floor(most_hz(config, load)):g} Hz, or a faster bus"
        " (bus.bitrate_bit_s; inf where frames go over no wire)"
    )
