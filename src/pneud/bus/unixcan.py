"""unixcan as an interface of python-can: `can.Bus(interface="unixcan", channel="NAME")`.

python-can finds it through an entry point, so its own tools work: `python -m can.logger -i unixcan -c NAME`.
"""

from __future__ import annotations

import os
import select
from collections import deque
from collections.abc import Sequence
from typing import Any

import can
from can.typechecking import AutoDetectedConfig, CanFilters

from pneud.bus import wire
from pneud.bus.transport import Party, UnixCanError, channels
from pneud.signals import Frame

_STANDARD_MASK = 0x7FF
_EXTENDED_MASK = 0x1FFFFFFF


class UnixCanBus(can.BusABC):
    """A party on a unixcan channel, with frames of CAN FD; no bit rate."""

    def __init__(
        self,
        channel: Any,
        can_filters: CanFilters | None = None,
        *,
        receive_own_messages: bool = False,
        **kwargs: Any,
    ) -> None:
        """Join a channel.

        Args:
            channel: its name; python-can makes a number of a name of digits, which is the same channel.
            can_filters: see `can.BusABC.set_filters`.
            receive_own_messages: receive what this bus sends, too.
            kwargs: settings of other interfaces, such as a bit rate, which mean nothing here.

        Raises:
            can.CanInitializationError: the channel cannot be joined.
        """
        try:
            self._party = Party(str(channel), hear_self=receive_own_messages, fd=wire.FD_FLAG)
        except UnixCanError as e:
            raise can.CanInitializationError(str(e)) from None
        self.channel_info = f"unixcan channel {channel}"
        self._waiting: deque[Frame] = deque()
        self._more = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)  # readable while frames wait in here
        self._epoll = select.epoll()
        self._epoll.register(self._party.fileno(), select.EPOLLIN)
        self._epoll.register(self._more, select.EPOLLIN)
        super().__init__(channel, can_filters, **kwargs)

    def fileno(self) -> int:
        """A descriptor that is readable while there may be a message."""
        return self._epoll.fileno()

    @property
    def dropped(self) -> int:
        """Frames that other parties lost because they did not read."""
        return self._party.dropped

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._waiting:
            if not self._epoll.poll(timeout, 1):
                return None, False
            frames: list[Frame] = []
            if self._party.drain(0, frames) == 0:
                return None, False
            self._waiting.extend(frames)
            os.eventfd_write(self._more, 1)
        frame = self._waiting.popleft()
        if not self._waiting:
            os.eventfd_read(self._more)
        return _message(frame), False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002 - never waits
        """Hand a message to every party at once; one that has no room for it loses it, and that is counted.

        Raises:
            can.CanOperationError: no frame has so many bytes.
        """
        self._party.admit()  # who only sends never drains, and yet others want to join
        try:
            self._party.send(_identifier(msg), bytes(msg.data).ljust(msg.dlc, b"\0"))
        except ValueError as e:
            raise can.CanOperationError(f"unixcan: {e}") from None

    def shutdown(self) -> None:
        """Leave the channel."""
        if self._is_shutdown:
            return
        super().shutdown()
        self._epoll.close()
        os.close(self._more)
        self._party.close()

    @staticmethod
    def _detect_available_configs() -> Sequence[AutoDetectedConfig]:
        return [{"interface": "unixcan", "channel": name} for name in channels()]


def _identifier(msg: can.Message) -> int:
    flags = wire.CAN_EFF_FLAG if msg.is_extended_id else 0
    if msg.is_remote_frame:
        flags |= wire.CAN_RTR_FLAG
    if msg.is_error_frame:
        flags |= wire.CAN_ERR_FLAG
    if msg.is_fd:
        flags |= wire.FD_FLAG | (wire.SWITCH_FLAG if msg.bitrate_switch else 0)
    return int(msg.arbitration_id) | flags


def _message(frame: Frame) -> can.Message:
    extended = bool(frame.can_id & wire.CAN_EFF_FLAG)
    remote = bool(frame.can_id & wire.CAN_RTR_FLAG)
    error = bool(frame.can_id & wire.CAN_ERR_FLAG)
    return can.Message(
        timestamp=frame.stamp_ns * 1e-9,
        arbitration_id=frame.can_id & (_EXTENDED_MASK if extended or error else _STANDARD_MASK),
        is_extended_id=extended,
        is_remote_frame=remote,
        is_error_frame=error,
        dlc=len(frame.data),
        data=None if remote else frame.data,
        is_fd=bool(frame.can_id & wire.FD_FLAG),
        bitrate_switch=bool(frame.can_id & wire.SWITCH_FLAG),
    )
