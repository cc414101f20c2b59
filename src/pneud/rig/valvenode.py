"""The valve's node on the bus: takes commands, drives the DAC, falls back to centre when commands stop."""

from __future__ import annotations

from pneud.bus.codec import Codec
from pneud.rig.sensors import dac_output
from pneud.signals import ValveState

NEVER_NS = 1 << 62


class ValveNode:
    """State machine of the node; time comes with the calls.

    `state` is a `ValveState`, `output_v` what the DAC puts out, `deadline_ns` when the last valid command
    expires, `timeout_ns` after it came.
    """

    def __init__(self, codec: Codec, timeout_s: float, dac_bits: int, u_max_v: float) -> None:
        self._codec = codec
        self.timeout_ns = round(timeout_s * 1e9)
        self._dac_bits = dac_bits
        self._u_max_v = u_max_v
        self._last_counter = -1
        self.state = ValveState.BOOT
        self.output_v = 0.0
        self.deadline_ns = NEVER_NS

    def booted(self) -> None:
        """Start-up is over."""
        if self.state == ValveState.BOOT:
            self.state = ValveState.CENTRED

    def command(self, data: bytes, t_ns: int) -> None:
        """A VALVE_COMMAND has been received at `t_ns`; one that is not valid changes nothing."""
        codec = self._codec
        if not codec.valid(data):
            return
        if codec.counter_values > 1:
            counter = codec.counter(data)
            if counter == self._last_counter:
                return
            self._last_counter = counter
        voltage_v, enable, _ = codec.decode(data)
        if enable not in (0, 1):
            return
        self.deadline_ns = t_ns + self.timeout_ns
        self.booted()
        if enable == 0:
            if self.state != ValveState.FAULT:
                self.state = ValveState.CENTRED
            self.output_v = 0.0
        elif self.state in (ValveState.CENTRED, ValveState.ENABLED):
            self.state = ValveState.ENABLED
            self.output_v = dac_output(voltage_v, self._dac_bits, self._u_max_v)

    def leap(self, heard_ns: int, counter: int, output_v: float, state: ValveState) -> None:
        """As though the last of many valid commands had been heard, and had led to this."""
        self.deadline_ns, self._last_counter = heard_ns + self.timeout_ns, counter
        self.output_v, self.state = output_v, state

    def expire(self) -> None:
        """`deadline_ns` has come without a valid command."""
        self.deadline_ns = NEVER_NS
        self.output_v = 0.0
        if self.state != ValveState.FAULT:
            self.state = ValveState.TIMED_OUT

    def reset(self) -> None:
        """Be told that the end of commands is over; what else is wrong stays."""
        if self.state == ValveState.TIMED_OUT:
            self.state = ValveState.CENTRED

    def reboot(self) -> None:
        """Start anew, as after a loss of supply: centred, and without a command."""
        self._last_counter = -1
        self.state = ValveState.BOOT
        self.output_v = 0.0
        self.deadline_ns = NEVER_NS

    def fail(self) -> None:
        """The amplifier fails: centred for good."""
        self.state = ValveState.FAULT
        self.output_v = 0.0
